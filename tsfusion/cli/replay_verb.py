# SPDX-License-Identifier: MIT
"""`tsfusion replay` and `tsfusion demo`."""

from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options, output
from tsfusion.core.readable_numbers import count_of

if TYPE_CHECKING:
    from tsfusion.datasets import Dataset

_STREET = {"sensor": "stereo", "voxel_size": 0.1}  # a Kinect does not work in daylight


@options.takes_map_settings
def replay(
    context: typer.Context,
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="A recording; `tsfusion datasets` names the layouts.")
    ],
    *,
    out: options.OutFlag = None,
    overwrite: options.Overwrite = False,
    state: options.StateFlag = None,
    connect: options.Connect = None,
    map_: options.NewMap = None,
    same_frame: options.SameFrame = False,
    control: options.Control = None,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    trajectory: options.TrajectoryFlag = None,
    origin: options.OriginFlag = None,
    rate: options.Rate = None,
    max_frames: options.MaxFrames = None,
    start: options.Start = 0,
    stride: options.Stride = 1,
    sequence: options.Sequence = None,
    modality: options.ModalityFlag = None,
    calibration: options.Calibration = None,
    intrinsics: options.IntrinsicsFlag = None,
    option: options.DatasetOptions = None,
    unpack: options.Unpack = False,
    check_: Annotated[
        bool,
        options.option("--check/--no-check", None, "Stop when poses, camera and depth disagree.", rare=True),
    ] = True,
    up: options.UpDirection = None,
    keep_islands: options.KeepIslands = None,
    config: options.ConfigFile = None,
    view: options.ViewFlag = None,
    json: options.RunJson = False,
    **settings: Any,
) -> None:
    """Fuse a recording that has poses, or a journal: mesh and figures."""
    from tsfusion.datasets import select
    from tsfusion.pipelines.report import shortfall

    # Any server makes a mesh with another `min_weight`.
    own = {*options.MAP_OPTIONS, "state"} - {"min_weight"}
    options.check_target_flags(context, connect, own=own, remote=options.only_for_kept_maps(state))
    given_up = options.up_direction(up)
    dataset = open_recording(
        path,
        **options.dataset_options(
            option, unpack=unpack, sequence=sequence, modality=modality, trajectory=trajectory,
            origin=origin,
            **options.camera(intrinsics, calibration),
        ),
    )  # fmt: skip
    opened, usual, absent = dataset, getattr(dataset, "usual", None), getattr(dataset, "absent", 0)
    chosen = options.configuration_for(dataset.sensor, config, usual=usual, tell=connect is None, **settings)
    posed = len(dataset)
    if start or stride > 1 or max_frames is not None:
        dataset = select(dataset, start=start, stride=stride, limit=max_frames)
    for reason, count in dataset.skipped.items():
        typer.echo(f"left out {count_of(count, 'frame')} {reason}", err=True)
    missed = [shortfall.of_poses(posed, dataset.skipped), shortfall.of_absence(absent)]
    doubt, warnings = _checked(dataset) if check_ and not _is_synthetic(path) else ("", [])
    if doubt:
        missed.insert(0, f"the map is wrong in places (--no-check accepts it): {doubt}")
    client = options.client_settings(
        chosen, connect, control=control, map=map_, key=key, server_key=server_key
    )
    if state is not None:
        _refuse_own_journal(opened, state, client.map)
    _run(
        dataset, out, view=view, overwrite=overwrite, json=json,
        volume=options.own_volume(chosen, client, settings), server=options.own_server(chosen, state),
        client=client, connect=connect, same_frame=same_frame,
        rate=rate, min_weight=settings["min_weight"], up=given_up, keep_islands=keep_islands,
        warnings=warnings, missed=missed, sensor=settings["sensor"],
    )  # fmt: skip


def open_recording(path: Path, /, *, unpack: bool = False, **given: Any) -> "Dataset":
    """Open a dataset or a journal.

    Args:
        unpack: whether to unpack an archive beside itself.
        given: settings of the dataset; None = not given.
    """
    from tsfusion.journal.state_folder import is_journal

    if is_journal(path):
        from tsfusion.cluster import keyframe_sources
        from tsfusion.core.errors import DatasetError
        from tsfusion.journal.journaled_keyframes import JournalRecording

        for name, value in given.items():
            if value is not None and name != "posed":
                raise DatasetError(f"--{name} has no effect on a journal: leave it out")
        saved = keyframe_sources.saved_beside(path, None)  # before the journal, which may grow meanwhile
        journaled = JournalRecording(path)
        journaled.usual = keyframe_sources.settings_of(saved)
        journaled.absent = keyframe_sources.absent(saved, journaled.keyframes)
        return journaled
    from tsfusion.datasets import describe, open_dataset

    dataset = open_dataset(path, unpack=unpack, **given)
    if not _is_synthetic(path):
        output.text(f"found: {describe(dataset)}", err=True, indent=7)
    return dataset


def _refuse_own_journal(dataset: "Dataset", state: Path, map_name: str) -> None:
    """Raise InvalidConfig where a journal would be replayed into the map that it is of."""
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.journal import state_folder
    from tsfusion.journal.journaled_keyframes import JournalRecording

    folder = state_folder.map_folder(state, map_name).resolve()
    if isinstance(dataset, JournalRecording) and folder in Path(dataset.name).resolve().parents:
        raise InvalidConfig(
            f"{dataset.name} is of the map {map_name} in {state}: its keyframes would count twice there; "
            "choose another --state or --map"
        )


def _is_synthetic(path: Path) -> bool:
    """True for a synthetic dataset, which would have to be rendered before it can be described."""
    return str(path).startswith("synthetic:")


def _checked(dataset: "Dataset") -> tuple[str, list[str]]:
    """Mistake in a part of the poses, empty = none; and other oddities.

    What was not said when the recording was found is printed on stderr.

    Raises:
        IncompleteRun: where poses, camera or depth are wrong in the whole recording.
    """
    from tsfusion.core.errors import DatasetError, IncompleteRun, JournalError
    from tsfusion.datasets.dataset import first_frame
    from tsfusion.evaluation import pose_check

    try:
        report, untimed = pose_check.check(dataset), first_frame(dataset).untimed
    except (DatasetError, JournalError):  # the replay comes to that frame, and tells
        return "", []
    doubt = report.text if report.verdict == "disagree" else ""
    if doubt and report.frames is None:
        raise IncompleteRun(f"nothing is fused, as {doubt} (--no-check fuses it all the same)")
    warnings = [report.color] if report.color is not None and not doubt else []
    for line in filter(None, [doubt, *warnings]):
        output.text(f"warning: {line}", err=True)
    return doubt, warnings + [untimed] * bool(untimed)


@options.takes_map_settings
def demo(
    *,
    out: options.OutFlag = None,
    overwrite: options.Overwrite = False,
    world: Annotated[str, typer.Option(metavar="NAME", help="room, or street (stereo, 0.1 m).")] = "room",
    count: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Keyframes; default 90, in the street 40.")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Random seed of the sensor's noise.")] = 0,
    rate: Annotated[
        float | None,
        typer.Option(
            "--rate", metavar="HZ", min=1e-3, help="Keyframes a second; default 6, in the street 4."
        ),
    ] = None,
    config: options.ConfigFile = None,
    view: options.ViewFlag = None,
    json: options.RunJson = False,
    **settings: Any,
) -> None:
    """Scan a synthetic world, and measure the error of its mesh."""
    chosen = options.configuration(config, preset=_STREET if world == "street" else None, **settings)
    from tsfusion.datasets import Synthetic

    path, usual_count, usual_rate = ("tour", 90, 6.0) if world == "room" else (None, 40, 4.0)
    dataset = Synthetic(world, sensor=chosen.volume.sensor, count=count or usual_count, seed=seed, path=path)
    _run(
        dataset, out, view=view, overwrite=overwrite, json=json, volume=chosen.volume,
        client=options.client_settings(chosen), rate=rate or usual_rate, min_weight=settings["min_weight"],
        truth=f"synthetic:{world}",
    )  # fmt: skip


def _run(
    dataset: "Dataset",
    out: Path | None,
    *,
    view: str | None,
    json: bool,
    truth: str | None = None,
    **settings: Any,
) -> None:
    from tsfusion.cli import progress, run_summary
    from tsfusion.pipelines.runs.replay import replay as run

    end = Event()
    with progress.ended_by_signals(end.set), progress.shown(quiet=json) as display:
        result = run(
            dataset, out, viewer=progress.page_beside(view, display, truth=truth), progress=display,
            ended=end.is_set, **settings,
        )  # fmt: skip
    if json:
        output.as_json(result)
    else:
        run_summary.print_replay(result)
        progress.print_page_again(view, result.folder, settings.get("connect"))
    run_summary.check(result)
