# SPDX-License-Identifier: MIT
"""`tsfusion scan`."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.scanner.sources.source import Source

_ENDING = b"\nending: what is on its way is finished (again: at once)\n"
_SOURCE, _POSES, _KEYFRAMES = "Source", "Poses", "Keyframes"


def _option(panel: str, metavar: str, help_: str, **settings: Any) -> Any:
    return typer.Option(metavar=metavar, help=help_, rich_help_panel=panel, **settings)


@options.takes_map_settings
def scan(
    context: typer.Context,
    *,
    source: Annotated[
        str,
        _option(_SOURCE, "SPEC", "A dataset, or live: realsense, camera:0, folder:PATH (docs/sources.md)."),
    ],
    calibration: Annotated[
        Path | None,
        _option(_SOURCE, "FILE", "Of a camera: Kalibr, OpenCV, ROS or EuRoC (a file, or a folder of two)."),
    ] = None,
    rate: Annotated[
        float | None,
        _option(_SOURCE, "HZ", "Frames a second of a recording; else as fast as they go.", min=1e-3),
    ] = None,
    max_frames: Annotated[int | None, _option(_SOURCE, "N", "Stop after so many.", min=1)] = None,
    start: Annotated[int, _option(_SOURCE, "N", "Skip so many first.", min=0)] = 0,
    stride: Annotated[int, _option(_SOURCE, "N", "Every N-th frame.", min=1)] = 1,
    sequence: Annotated[str | None, _option(_SOURCE, "NN", "KITTI: the sequence.")] = None,
    modality: Annotated[str | None, _option(_SOURCE, "KIND", "KITTI: stereo or lidar.")] = None,
    option: options.DatasetOptions = None,
    localizer: Annotated[
        str | None,
        _option(
            _POSES,
            "NAME",
            "rgbd, stereo or lidar (by what the source gives); given (its own poses), trajectory or feed.",
        ),
    ] = None,
    trajectory: Annotated[
        str | None, _option(_POSES, "FILE", "Poses of another SLAM: a TUM or KITTI file.")
    ] = None,
    feed: Annotated[
        str | None, _option(_POSES, "ADDRESS", "Poses of another SLAM, live: tcp://… it is heard at.")
    ] = None,
    time_offset: Annotated[
        float | None,
        _option(_POSES, "SECONDS", "Added to a frame's time before its pose is looked up there."),
    ] = None,
    max_gap: Annotated[
        float | None,
        _option(_POSES, "SECONDS", "Between two such poses; across a longer gap there is none; else 0.2."),
    ] = None,
    loop_closure: Annotated[
        bool | None,
        typer.Option(
            "--loop-closure/--no-loop-closure", help="Look for places seen before.", rich_help_panel=_POSES
        ),
    ] = None,
    patience: Annotated[
        float | None, _option(_POSES, "SECONDS", "Lost for so long, a new map begins; else 1.", min=0.0)
    ] = None,
    min_overlap: Annotated[
        float | None, _option(_KEYFRAMES, "SHARE", "Of the last keyframe's view; below, a new one; else 0.8.")
    ] = None,
    distance: Annotated[
        float | None, _option(_KEYFRAMES, "METRES", "To the next; else 0.1, for stereo and LiDAR 2.")
    ] = None,
    angle: Annotated[float | None, _option(_KEYFRAMES, "DEGREES", "To the next; else 10.")] = None,
    max_rate: Annotated[
        float | None, _option(_KEYFRAMES, "HZ", "At most so many a second; else as many as the rules take.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where the results go.")] = Path("out"),
    connect: options.Connect = None,
    control: options.Control = None,
    map_: options.Map = None,
    key: options.Key = None,
    server_key: options.ServerKey = None,
    spool: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            envvar="TSFUSION_SPOOL",
            help="With --connect: keyframes wait here until the server has them.",
        ),
    ] = Path("tsfusion-spool"),
    config: options.ConfigFile = None,
    json: options.Json = False,
    **settings: Any,
) -> None:
    """Localise a sensor, pick keyframes and send them; Ctrl-C ends well.

    Without --connect it starts a server of its own and leaves the mesh. With it, what the server does not
    have in the end stays in the spool, and the next scan sends it first.
    """
    options.check_target_flags(context, connect, own=options.MAP_OPTIONS, remote={"spool"})
    from tsfusion.cli import output, progress, run_summary
    from tsfusion.core.config import override
    from tsfusion.pipelines.scan import scan as run

    recording = {"sequence": sequence, "modality": modality, **options.dataset_options(option)}
    opened = _open(
        context, source, recording, calibration=calibration, rate=rate,
        part={"start": start, "stride": stride, "limit": max_frames},
    )  # fmt: skip
    with opened, _ended_by_signals(opened), progress.shown(quiet=json) as display:
        chosen = options.configuration(config, preset={"sensor": opened.sensor}, **settings)
        rules = override(
            chosen.scan, localizer=localizer, trajectory=trajectory, feed=feed, loop_closure=loop_closure,
            time_offset=time_offset, max_gap=max_gap,
            patience=patience, min_overlap=min_overlap, distance=distance, angle=angle, max_rate=max_rate,
        )  # fmt: skip
        client = options.client_settings(
            chosen, connect, control=control, map=map_, key=key, server_key=server_key
        )
        result = run(
            opened, out, config=rules, volume=chosen.volume, client=client, connect=connect, spool=spool,
            min_weight=settings["min_weight"], progress=display,
        )  # fmt: skip
    if json:
        output.as_json(result)
    else:
        run_summary.print_scan(result, out, spool, connect)


def _open(
    context: typer.Context,
    spec: str,
    recording: dict[str, Any],
    *,
    calibration: Path | None,
    rate: float | None,
    part: dict[str, Any],
) -> "Source":
    """The source by its name, as much of it as is asked for."""
    from tsfusion.scanner.sources.recorded import LimitedSource
    from tsfusion.scanner.sources.registry import is_live, open_source

    if is_live(spec):
        options.refuse(
            context,
            ("sequence", "modality", "option", "rate", "start", "stride"),
            "is for recordings, and this source is live",
        )
        live = open_source(spec, calibration=calibration)
        return live if part["limit"] is None else LimitedSource(live, part["limit"])
    options.refuse(context, ("calibration",), "is for a live camera")
    from tsfusion.cli.replay import open_recording
    from tsfusion.core.errors import DatasetError
    from tsfusion.datasets import select
    from tsfusion.scanner.sources.recorded import RecordedSource

    path = Path(spec)
    if not spec.startswith("synthetic:") and not path.expanduser().exists():
        raise DatasetError(
            f"{spec} does not exist; expected a dataset, synthetic:room, synthetic:street, or live: "
            "realsense, camera:0, folder:PATH (docs/sources.md)"
        )
    dataset = open_recording(path, **recording, posed=False)
    return RecordedSource(select(dataset, **part), rate=rate)


@contextmanager
def _ended_by_signals(source: "Source") -> Iterator[None]:
    """The first Ctrl-C or SIGTERM closes the source, and the scan ends as at the end of a recording.

    The second one does what it always does.
    """
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}

    def stop(signum: int, frame: FrameType | None) -> None:
        for each, handler in before.items():
            signal.signal(each, handler)
        source.close()
        os.write(2, _ENDING)  # safe inside a handler, which `print` is not

    for signum in before:
        signal.signal(signum, stop)
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
