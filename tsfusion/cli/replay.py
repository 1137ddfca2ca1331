# SPDX-License-Identifier: MIT
"""`tsfusion replay` and `tsfusion demo`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.config import Config
    from tsfusion.datasets import Dataset

_DATASET = "Dataset"
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the results go.")]
Rate = Annotated[
    float | None,
    typer.Option(
        "--rate", metavar="HZ", min=1e-3, help="Keyframes per second; else as fast as they are fused."
    ),
]
Limit = Annotated[
    int | None,
    typer.Option("--max-keyframes", metavar="N", min=1, rich_help_panel=_DATASET, help="Stop after so many."),
]


def replay(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="A dataset; `tsfusion datasets list` names the layouts.")
    ],
    *,
    out: Out = Path("out"),
    connect: options.Connect = None,
    control: options.Control = None,
    rate: Rate = None,
    max_keyframes: Limit = None,
    start: Annotated[
        int, typer.Option(metavar="N", min=0, rich_help_panel=_DATASET, help="Skip so many first.")
    ] = 0,
    stride: Annotated[
        int, typer.Option(metavar="N", min=1, rich_help_panel=_DATASET, help="Every N-th keyframe.")
    ] = 1,
    sequence: Annotated[
        str | None, typer.Option(metavar="NN", rich_help_panel=_DATASET, help="KITTI: the sequence.")
    ] = None,
    modality: Annotated[
        str | None, typer.Option(metavar="KIND", rich_help_panel=_DATASET, help="KITTI: stereo or lidar.")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(metavar="FILE", rich_help_panel=_DATASET, help="KITTI: poses to use instead."),
    ] = None,
    state: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Keep the own server's journal and map here.")
    ] = None,
    voxel_size: options.VoxelSize = None,
    sensor: options.Sensor = None,
    regularizer: options.Regularizer = None,
    smoothness: options.Smoothness = None,
    max_range: options.MaxRange = None,
    min_weight: options.MinWeight = None,
    threads: options.Threads = None,
    config: options.ConfigFile = None,
    json: options.Json = False,
) -> None:
    """Send a recorded dataset (or a journal) through the whole path; leave mesh, picture and figures."""
    from tsfusion.datasets import select

    chosen = options.configuration(
        config, voxel_size=voxel_size, sensor=sensor, regularizer=regularizer, smoothness=smoothness,
        max_range=max_range, threads=threads,
    )  # fmt: skip
    dataset = _open(path, sequence=sequence, modality=modality, poses=poses)
    if start or stride > 1 or max_keyframes is not None:
        dataset = select(dataset, start=start, stride=stride, limit=max_keyframes)
    for reason, count in dataset.skipped.items():
        typer.echo(f"left out {count} frames {reason}", err=True)
    _run(
        dataset, out, chosen, connect=connect, control=control, rate=rate, min_weight=min_weight, state=state,
        sensor_given=sensor is not None, json=json,
    )  # fmt: skip


def _open(path: Path, **given: Any) -> "Dataset":
    if path.suffix == ".mcap" or any(path.glob("*.mcap")) or any(path.glob("journal/*.mcap")):
        from tsfusion.recording import Recording

        return Recording(path)
    from tsfusion.datasets import open_dataset

    return open_dataset(path, **given)


def demo(
    *,
    out: Out = Path("out"),
    world: Annotated[str, typer.Option(metavar="NAME", help="room, or street (stereo, 0.1 m).")] = "room",
    count: Annotated[int, typer.Option(metavar="N", min=1, help="Keyframes.")] = 40,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of the sensor's noise.")] = 0,
    rate: Annotated[
        float, typer.Option("--rate", metavar="HZ", min=1e-3, help="Keyframes per second.")
    ] = 4.0,
    voxel_size: options.VoxelSize = None,
    sensor: options.Sensor = None,
    regularizer: options.Regularizer = None,
    smoothness: options.Smoothness = None,
    min_weight: options.MinWeight = None,
    threads: options.Threads = None,
    config: options.ConfigFile = None,
    json: options.Json = False,
) -> None:
    """Scan a synthetic world whose surface is known, and measure how far the mesh is from it."""
    if world == "street":  # a Kinect sees no street
        sensor, voxel_size = sensor or "stereo", voxel_size or 0.1
    chosen = options.configuration(
        config, voxel_size=voxel_size, sensor=sensor, regularizer=regularizer, smoothness=smoothness,
        threads=threads,
    )  # fmt: skip
    from tsfusion.datasets import Synthetic

    dataset = Synthetic(world, sensor=chosen.volume.sensor, count=count, seed=seed)
    _run(dataset, out, chosen, rate=rate, min_weight=min_weight, sensor_given=True, json=json)


def _run(
    dataset: "Dataset",
    out: Path,
    chosen: "Config",
    *,
    sensor_given: bool,
    json: bool,
    state: Path | None = None,
    control: str | None = None,
    **settings: Any,
) -> None:
    from tsfusion import pipeline
    from tsfusion.cli import show
    from tsfusion.config import VolumeConfig, override

    volume = chosen.volume
    if not sensor_given and volume.sensor == VolumeConfig().sensor:
        volume = override(volume, sensor=dataset.sensor)
    server = override(chosen.server, listen="tcp://127.0.0.1:0", state=str(state)) if state else None
    with show.progress(quiet=json) as progress:
        run = pipeline.replay(
            dataset, out, volume=volume, server=server, client=override(chosen.client, control=control),
            progress=progress, **settings,
        )  # fmt: skip
    if json:
        show.as_json(run)
    else:
        show.summary(run, out)
