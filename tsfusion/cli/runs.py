# SPDX-License-Identifier: MIT
"""`tsfusion scan`, `replay` and `demo`: open a recording or a sensor, and carry out a run."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options, output
from tsfusion.core.readable_numbers import count_of

if TYPE_CHECKING:
    from tsfusion.core.config import Config, ScanConfig
    from tsfusion.datasets import Dataset
    from tsfusion.scanner.sources.source import Source

_STREET = {"sensor": "stereo", "voxel_size": 0.1}  # a Kinect does not work in daylight

_pose_option = partial(options.option, panel="Poses", rare=True)
_keyframe_option = partial(options.option, panel="Keyframes", rare=True)

# By name: settings of the `scan` table.
SCAN_OPTIONS: dict[str, Any] = {
    "localizer": Annotated[str | None, options.option(
        "--localizer", "NAME", "rgbd, stereo, lidar, or given (its poses).")],
    "trajectory": Annotated[str | None, options.option(
        "--trajectory", "FILE", "Poses of another SLAM, as TUM or KITTI.")],
    "feed": Annotated[str | None, options.option(
        "--feed", "ADDRESS", "Live poses of a SLAM: tcp://HOST:PORT.")],
    "time_offset": Annotated[float | None, _pose_option(
        "--time-offset", "SECONDS", "Added to a frame's time before its pose is looked up.")],
    "max_gap": Annotated[float | None, _pose_option(
        "--max-gap", "SECONDS", "Longest gap to bridge in --trajectory or --feed; default 0.2.")],
    "loop_closure": Annotated[bool | None, _pose_option(
        "--loop-closure/--no-loop-closure", None,
        "Recognise places seen before, and correct the poses since.")],
    "patience": Annotated[float | None, _pose_option(
        "--patience", "SECONDS", "A new map begins after the sensor was lost so long; default 1.", min=0.0)],
    "min_overlap": Annotated[float | None, _keyframe_option(
        "--min-overlap", "SHARE",
        "New keyframe when a smaller share of the last one's view is seen; default 0.8.")],
    "distance": Annotated[float | None, _keyframe_option(
        "--distance", "METRES",
        "New keyframe after so much movement; default 0.1, for stereo and LiDAR 2.")],
    "angle": Annotated[float | None, _keyframe_option(
        "--angle", "DEGREES", "New keyframe after so much turning; default 10.")],
    "max_rate": Annotated[float | None, _keyframe_option(
        "--max-rate", "HZ", "At most so many keyframes a second; default: no limit.")],
}  # fmt: skip


@partial(options.takes_map_settings, also=options.RUN_OPTIONS | SCAN_OPTIONS)
def scan(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="PATH|SOURCE",
            help="A recording; or live: realsense, oak, orbbec, ros2, camera:0 (stereo), folder:PATH.",
        ),
    ],
    *,
    align: Annotated[
        bool,
        options.option("--align", None, "First find where the scan is in the map."),
    ] = False,
    spool: Annotated[
        Path,
        options.option(
            "--spool",
            "DIR",
            "With --connect: where keyframes wait until the server has them; the next scan sends the rest.",
            rare=True,
        ),
    ] = Path("tsfusion-spool"),
    **flags: Any,
) -> None:
    """Localise a sensor and fuse its keyframes until the end or Ctrl-C."""
    remote = {"spool", "align", *options.only_for_kept_maps(flags["state"])}
    connect = flags["connect"]
    options.check_target_flags(context, connect, own={*options.MAP_OPTIONS, "state"}, remote=remote)
    if connect is not None:
        options.refuse(
            context, ("up", "keep_islands"), "has no effect with --connect: give it to `tsfusion mesh`"
        )
    up = options.up_direction(flags["up"])
    if align:
        from tsfusion.evaluation.surface_fit import check_installed

        options.refuse(context, ("same_frame",), "and --align exclude each other: one says that it is known")
        check_installed()
    _choose_poses(context, flags)
    trajectory = flags["trajectory"]
    opened, warnings = _open(context, source, flags)
    if waits_for := getattr(opened, "waits_for", str)():
        own = "as given" if flags["localizer"] == "given" else "found from the frames"
        poses = flags["trajectory"] or flags["feed"] or own
        typer.echo(f"{waits_for}; poses: {poses}", err=True)
    with opened:
        chosen = _configuration(opened, flags)
        found = _check_poses(
            context, chosen.scan, opened.sensor, is_given_late=trajectory != flags["trajectory"]
        )
        _run(opened, chosen, flags, scan=found, spool=spool, align=align, up=up, warnings=warnings)


@partial(options.takes_map_settings, also=options.RUN_OPTIONS)
def replay(
    context: typer.Context,
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="A recording; `tsfusion datasets` names the layouts.")
    ],
    *,
    trajectory: options.TrajectoryFlag = None,
    check_: Annotated[
        bool,
        options.option("--check/--no-check", None, "Stop when poses, camera and depth disagree.", rare=True),
    ] = True,
    **flags: Any,
) -> None:
    """Fuse a recording that has poses, or a journal: mesh and figures."""
    from tsfusion.pipelines.report import shortfall
    from tsfusion.scanner.sources.source import RecordedSource

    # Any server makes a mesh with another `min_weight`.
    own, state = {*options.MAP_OPTIONS, "state"} - {"min_weight"}, flags["state"]
    options.check_target_flags(context, flags["connect"], own=own, remote=options.only_for_kept_maps(state))
    up = options.up_direction(flags["up"])
    opened = open_recording(path, **options.recording_options(flags, trajectory=trajectory))
    chosen = _configuration(opened, flags)
    dataset = _part(opened, flags)
    for reason, count in dataset.skipped.items():
        typer.echo(f"left out {count_of(count, 'frame')} {reason}", err=True)
    doubt, warnings = _checked(dataset) if check_ and not _is_synthetic(path) else ("", [])
    missed = [
        f"the map is wrong in places (--no-check accepts it): {doubt}" if doubt else "",
        shortfall.of_poses(len(opened), dataset.skipped),
        shortfall.of_absence(getattr(opened, "absent", 0)),
    ]
    if state is not None:
        _refuse_own_journal(opened, state, flags["map_"] or chosen.client.map)
    _run(
        RecordedSource(dataset, rate=flags["rate"]), chosen, flags, kind="replay", up=up, warnings=warnings,
        missed=missed, distance=getattr(dataset, "distance", None),
    )  # fmt: skip


@partial(options.takes_map_settings, also=options.RESULT_OPTIONS)
def demo(
    *,
    world: Annotated[
        str, typer.Option(metavar="NAME", help="room, or street (stereo, 0.1 m voxels).")
    ] = "room",
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
    **flags: Any,
) -> None:
    """Scan a synthetic world, and measure the error of its mesh."""
    preset = _STREET if world == "street" else None
    chosen = options.configuration(flags["config"], preset=preset, **options.settings(flags))
    from tsfusion.datasets import Synthetic
    from tsfusion.scanner.sources.source import RecordedSource

    path, usual_count, usual_rate = ("tour", 90, 6.0) if world == "room" else (None, 40, 4.0)
    dataset = Synthetic(world, sensor=chosen.volume.sensor, count=count or usual_count, seed=seed, path=path)
    flags |= {"rate": rate or usual_rate, "sensor": None}
    _run(
        RecordedSource(dataset, rate=flags["rate"]), chosen, flags, kind="replay",
        distance=dataset.distance, truth=f"synthetic:{world}",
    )  # fmt: skip


def _run(
    source: "Source",
    chosen: "Config",
    flags: dict[str, Any],
    *,
    truth: str | None = None,
    **plan: Any,
) -> None:
    """Carry out a run, and print its results.

    Args:
        truth: known surface of the world, for the page.
        plan: arguments of `RunPlan` that the flags do not give.
    """
    from tsfusion.cli import progress, run_summary
    from tsfusion.pipelines.runs.run import RunPlan, run

    connect = flags.get("connect")
    names = ("control", "key", "server_key")
    link = {name: flags.get(name) for name in names} | {"map": flags.get("map_")}
    client = options.client_settings(chosen, connect, **link)
    asked = {name: flags[name] for name in RUN_SETTINGS if name in flags}
    planned = RunPlan(
        source=source, client=client, connect=connect, volume=options.own_volume(chosen, client, flags),
        server=options.own_server(chosen, flags.get("state")), **asked | plan,
    )  # fmt: skip
    with progress.ended_by_signals(source.close), progress.shown(quiet=flags["json"]) as display:
        page = progress.page_beside(flags["view"], display, truth=truth)
        result = run(planned, flags["out"], display, overwrite=flags["overwrite"], viewer=page)
    if flags["json"]:
        output.as_json(result)
    else:
        run_summary.print_run(result, planned.spool, connect)
        progress.print_page_again(flags["view"], result.folder, connect)
    run_summary.check(result)


# Flags that are settings of a `RunPlan` with the same name
RUN_SETTINGS = ("same_frame", "rate", "min_weight", "keep_islands", "sensor", "max_frames")


def _configuration(recording: Any, flags: dict[str, Any]) -> "Config":
    """Return the usual settings of the recording, overridden by those of the file and by the flags."""
    return options.configuration_for(
        recording.sensor, flags["config"], usual=getattr(recording, "usual", None),
        tell=flags["connect"] is None, **options.settings(flags),
    )  # fmt: skip


def _part(dataset: "Dataset", flags: dict[str, Any]) -> "Dataset":
    from tsfusion.datasets import select

    start, stride, limit = flags["start"], flags["stride"], flags["max_frames"]
    if not start and stride == 1 and limit is None:
        return dataset
    return select(dataset, start=start, stride=stride, limit=limit)


def _choose_poses(context: typer.Context, settings: dict[str, Any]) -> None:
    """Leave only one source of poses in the flags. A typed flag beats an environment variable.

    Raises:
        InvalidConfig: when two sources are left, or a typed one has no effect.
    """
    from tsfusion.core.errors import InvalidConfig

    sources = [name for name in ("trajectory", "feed") if settings[name] is not None]
    if len(sources) == 2:
        typed = [name for name in sources if options.is_typed(context, name)]
        if len(typed) != 1:
            raise InvalidConfig("--trajectory and --feed are two sources of poses: leave one out")
        settings |= {name: None for name in sources if name not in typed}
        sources = typed
    wanted = settings["localizer"]
    for name in sources:
        if wanted is None:  # whatever a file says
            settings["localizer"] = name
        elif wanted not in ("auto", name) and not (name == "trajectory" and wanted == "given"):
            options.refuse(context, (name,), f"has no effect with --localizer {wanted}")
            settings[name] = None


def _check_poses(
    context: typer.Context, config: "ScanConfig", sensor: str, *, is_given_late: bool
) -> "ScanConfig":
    """Return the settings without a source of poses that a flag overrides.

    Args:
        is_given_late: the poses of --trajectory have become the recording's own, one for each frame.

    Raises:
        InvalidConfig: for flags about poses that the localizer does not use.
    """
    from msgspec.structs import replace

    name: str = config.localizer
    if name in ("trajectory", "feed"):  # a file may name the other
        config = replace(config, **{"feed" if name == "trajectory" else "trajectory": None})
    if name == "auto":
        by_sensor = "lidar" if sensor == "lidar" else "images"
        name = "trajectory" if config.trajectory else "feed" if config.feed else by_sensor
    if name not in ("trajectory", "feed"):
        no_lookup = "is for poses that are looked up by time (--trajectory, --feed), and these are not"
        options.refuse(context, ("time_offset", "max_gap"), no_lookup)
        if not is_given_late:
            options.refuse(context, ("trajectory", "feed"), f"has no effect with --localizer {name}")
    if config.loop_closure and name in ("trajectory", "feed", "given", "lidar"):
        options.refuse(context, ("loop_closure",), "needs poses that are found from images (rgbd, stereo)")
    return config


def _open(context: typer.Context, spec: str, flags: dict[str, Any]) -> "tuple[Source, list[str]]":
    """Open the source that the flags describe. Return it with the oddities of its frames.

    Of a recording, only the selected frames are opened. If the recording or the trajectory in `flags` has no
    times, the trajectory's poses become the recording's own.
    """
    from tsfusion.scanner.sources.source import RecordedSource, is_live, open_source

    if is_live(spec):
        options.refuse(
            context,
            ("sequence", "modality", "unpack", "rate", "start", "stride"),
            "is for recordings, and this source is live: leave it out",
        )
        camera = options.camera(flags["intrinsics"], flags["calibration"])
        if spec.partition(":")[0] == "ros2" and flags["localizer"] == "given":
            camera["posed"] = True
        return open_source(spec, **options.dataset_options(flags["option"], **camera)), []
    from tsfusion.core.errors import DatasetError
    from tsfusion.datasets.folder_frames import WithTrajectory, pairs_by_time

    path, flag, origin = Path(spec), flags["trajectory"], flags["origin"]
    if not _is_synthetic(path) and not path.expanduser().exists():
        raise DatasetError(
            f"{spec} does not exist; expected a dataset, synthetic:room, synthetic:street, or live: "
            "realsense, camera:0, folder:PATH, ros2 (docs/sources.md)"
        )
    given = options.recording_options(flags, posed=False, trajectory=flag)
    dataset = open_recording(path, **given | ({} if flag is None else {"trajectory": None}))
    warnings = [] if _is_synthetic(path) else _warnings(dataset)
    if flag is not None:
        trajectory = Path(flag).expanduser()
        if "crs" in given or not pairs_by_time(trajectory, dataset):
            dataset = WithTrajectory(dataset, trajectory)
            dataset.take_off_origin(origin, given.get("crs"))
            flags |= {"trajectory": None, "localizer": "given"}
            typer.echo(f"poses: {trajectory}, one a frame in order or at its time", err=True)
    return RecordedSource(_part(dataset, flags), rate=flags["rate"]), warnings


def refuse_live(source: str) -> None:
    """Raise DatasetError for a live source, because only a scan finds its poses."""
    from tsfusion.core.errors import DatasetError
    from tsfusion.scanner.sources.source import is_live

    if is_live(source) and not Path(source).exists():
        raise DatasetError(f"{source} is live and gives no poses: `tsfusion scan {source}` finds them")


def open_recording(path: Path, /, *, unpack: bool = False, **given: Any) -> "Dataset":
    """Open a dataset or a journal.

    Args:
        unpack: True to unpack an archive beside itself.
        given: settings of the dataset; None = not given.
    """
    from tsfusion.core.errors import DatasetError
    from tsfusion.journal.state_folder import is_journal

    refuse_live(str(path))
    if is_journal(path):
        from tsfusion.cluster import keyframe_sources
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
    """Raise InvalidConfig if a journal would be replayed into the map that it belongs to."""
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
    """True for a synthetic dataset. It is not described, because it would have to be rendered first."""
    return str(path).startswith("synthetic:")


def _checked(dataset: "Dataset") -> tuple[str, list[str]]:
    """Return a mistake in part of the poses (empty if none), and other oddities of a recording.

    Findings that were not printed when the recording was found are printed on stderr.

    Raises:
        IncompleteRun: when poses, camera or depth are wrong in the whole recording.
    """
    from tsfusion.core.errors import DatasetError, IncompleteRun, JournalError
    from tsfusion.datasets.dataset import first_frame
    from tsfusion.evaluation import pose_check

    try:
        report, untimed = pose_check.check(dataset), first_frame(dataset).untimed
    except (DatasetError, JournalError):  # the replay reports it when it reaches that frame
        return "", []
    doubt = report.text if report.verdict == "disagree" else ""
    if doubt and report.frames is None:
        raise IncompleteRun(f"nothing is fused, as {doubt} (--no-check fuses it all the same)")
    warnings = [report.color] if report.color is not None and not doubt else []
    for line in filter(None, [doubt, *warnings]):
        output.text(f"warning: {line}", err=True)
    return doubt, warnings + [untimed] * bool(untimed)


def _warnings(dataset: "Dataset") -> list[str]:
    """Return oddities of a recording's frames, a sentence each, and print new ones on stderr.

    Raises:
        DatasetError: when their depth cannot be used, or its unit is unknown.
    """
    from tsfusion.core import process
    from tsfusion.core.errors import DatasetError
    from tsfusion.datasets.dataset import first_frame
    from tsfusion.evaluation import pose_check
    from tsfusion.evaluation.camera_check import centre_doubt

    try:
        (depth, color), first = pose_check.check_frames(dataset), first_frame(dataset)
    except DatasetError:  # the scan reports it when it reaches that frame
        return []
    process.give_back_memory()
    if depth is not None:
        raise DatasetError(f"{dataset.name}: {depth}")
    if color is not None:
        color += "; where the sensor is lost because of it, --option color=false tracks by the depth alone"
    centre = centre_doubt(first.intrinsics, first.shape)
    for line in filter(None, (color, centre)):
        output.text(f"warning: {line}", err=True)
    return [text for text in (color, centre, first.untimed) if text]
