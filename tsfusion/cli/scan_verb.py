# SPDX-License-Identifier: MIT
"""`tsfusion scan`."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.core.config import ScanConfig
    from tsfusion.datasets import Dataset
    from tsfusion.scanner.sources.source import Source

_pose_option = partial(options.option, panel="Poses", rare=True)
_keyframe_option = partial(options.option, panel="Keyframes", rare=True)

# By name: settings of the `scan` table.
SCAN_OPTIONS: dict[str, Any] = {
    "localizer": Annotated[str | None, options.option(
        "--localizer", "NAME", "rgbd, stereo, lidar; given: its poses.")],
    "trajectory": Annotated[str | None, options.option(
        "--trajectory", "FILE", "Poses of another SLAM: TUM's or KITTI's.")],
    "origin": options.OriginFlag,
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
        "--patience", "SECONDS", "A sensor lost for so long begins a new map; default 1.", min=0.0)],
    "min_overlap": Annotated[float | None, _keyframe_option(
        "--min-overlap", "SHARE",
        "New keyframe when less of the last one's view is still seen; default 0.8.")],
    "distance": Annotated[float | None, _keyframe_option(
        "--distance", "METRES",
        "New keyframe after so much movement; default 0.1, for stereo and LiDAR 2.")],
    "angle": Annotated[float | None, _keyframe_option(
        "--angle", "DEGREES", "New keyframe after so much turning; default 10.")],
    "max_rate": Annotated[float | None, _keyframe_option(
        "--max-rate", "HZ", "At most so many keyframes a second; default: no limit.")],
}  # fmt: skip


@partial(options.takes_map_settings, also=SCAN_OPTIONS)
def scan(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(metavar="PATH|SOURCE", help="A recording, realsense, camera:0, folder:PATH."),
    ],
    *,
    out: options.OutFlag = None,
    overwrite: options.Overwrite = False,
    state: options.StateFlag = None,
    connect: options.Connect = None,
    map_: options.NewMap = None,
    same_frame: options.SameFrame = False,
    align: Annotated[
        bool,
        options.option("--align", None, "First find the scan's place in that map."),
    ] = False,
    control: options.Control = None,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    spool: Annotated[
        Path,
        options.option(
            "--spool",
            "DIR",
            "With --connect: where keyframes wait until the server has them; the next scan sends the rest.",
            rare=True,
        ),
    ] = Path("tsfusion-spool"),
    calibration: options.Calibration = None,
    intrinsics: options.IntrinsicsFlag = None,
    rate: options.Rate = None,
    max_frames: options.MaxFrames = None,
    start: options.Start = 0,
    stride: options.Stride = 1,
    sequence: options.Sequence = None,
    modality: options.ModalityFlag = None,
    option: options.DatasetOptions = None,
    unpack: options.Unpack = False,
    up: options.UpDirection = None,
    keep_islands: options.KeepIslands = None,
    config: options.ConfigFile = None,
    view: options.ViewFlag = None,
    json: options.RunJson = False,
    **settings: Any,
) -> None:
    """Localise a sensor and fuse its keyframes until the end or Ctrl-C."""
    remote = {"spool", "align", *options.only_for_kept_maps(state)}
    options.check_target_flags(context, connect, own={*options.MAP_OPTIONS, "state"}, remote=remote)
    if connect is not None:
        options.refuse(
            context, ("up", "keep_islands"), "has no effect with --connect: give it to `tsfusion mesh`"
        )
    given_up = options.up_direction(up)
    if align:
        from tsfusion.evaluation.surface_fit import check_installed

        options.refuse(context, ("same_frame",), "and --align exclude each other: one says that it is known")
        check_installed()
    from tsfusion.cli import output, progress, run_summary
    from tsfusion.pipelines.runs.scan import scan as run

    _choose_poses(context, settings)
    trajectory = settings["trajectory"]
    opened, warnings = _open(
        context, source, option,
        camera=options.camera(intrinsics, calibration), rate=rate,
        recording={"unpack": unpack, "sequence": sequence, "modality": modality},
        part={"start": start, "stride": stride, "limit": max_frames}, settings=settings,
    )  # fmt: skip
    if waits_for := getattr(opened, "waits_for", str)():
        poses = settings["trajectory"] or settings["feed"] or "found from the frames"
        typer.echo(f"{waits_for}; poses: {poses}", err=True)
    with opened, progress.ended_by_signals(opened.close), progress.shown(quiet=json) as display:
        usual = getattr(opened, "usual", None)
        chosen = options.configuration_for(
            opened.sensor, config, usual=usual, tell=connect is None, **settings
        )
        config_of_scan = _check_poses(
            context, chosen.scan, opened.sensor, is_given_late=trajectory != settings["trajectory"]
        )
        client = options.client_settings(
            chosen, connect, control=control, map=map_, key=key, server_key=server_key
        )
        result = run(
            opened, out, overwrite=overwrite, config=config_of_scan,
            volume=options.own_volume(chosen, client, settings),
            server=options.own_server(chosen, state), client=client, connect=connect, spool=spool,
            same_frame=same_frame, align=align, min_weight=settings["min_weight"], up=given_up,
            keep_islands=keep_islands, viewer=progress.page_beside(view, display), progress=display,
            warnings=warnings, sensor=settings["sensor"],
        )  # fmt: skip
    if json:
        output.as_json(result)
    else:
        run_summary.print_scan(result, spool, connect)
        progress.print_page_again(view, result.folder, connect)
    run_summary.check(result)


def _choose_poses(context: typer.Context, settings: dict[str, Any]) -> None:
    """Leave one source of poses in the flags; what was typed beats the environment.

    Raises:
        InvalidConfig: where two are left, or a typed one has no effect.
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
    """The settings without a source of poses that a flag beats.

    Args:
        is_given_late: the flag's trajectory is the recording's own by now, one pose a frame.

    Raises:
        InvalidConfig: for flags about poses that the localizer does not ask for.
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


def _open(
    context: typer.Context,
    spec: str,
    option: list[str] | None,
    *,
    camera: dict[str, Any],
    rate: float | None,
    recording: dict[str, Any],
    part: dict[str, Any],
    settings: dict[str, Any],
) -> "tuple[Source, list[str]]":
    """The source of that name with what `--option` gives, of a recording the part that is asked for; and what
    is odd about its frames.

    Where the recording or the trajectory in `settings` has no times, its poses are made the recording's own.
    """
    from tsfusion.scanner.sources.named_sources import is_live, open_source
    from tsfusion.scanner.sources.source import LimitedSource

    if is_live(spec):
        options.refuse(
            context,
            ("sequence", "modality", "unpack", "rate", "start", "stride"),
            "is for recordings, and this source is live: leave it out",
        )
        live = open_source(spec, **options.dataset_options(option, **camera))
        return live if part["limit"] is None else LimitedSource(live, part["limit"]), []
    from tsfusion.cli.replay_verb import open_recording
    from tsfusion.core.errors import DatasetError
    from tsfusion.datasets import select
    from tsfusion.datasets.given_trajectory import WithTrajectory, pairs_by_time
    from tsfusion.scanner.sources.source import RecordedSource

    path = Path(spec)
    if not spec.startswith("synthetic:") and not path.expanduser().exists():
        raise DatasetError(
            f"{spec} does not exist; expected a dataset, synthetic:room, synthetic:street, or live: "
            "realsense, camera:0, folder:PATH (docs/sources.md)"
        )
    flag = settings["trajectory"]
    origin = settings["origin"]
    given = options.dataset_options(
        option, posed=False, trajectory=flag, origin=origin, **recording, **camera
    )
    dataset = open_recording(path, **given | ({} if flag is None else {"trajectory": None}))
    warnings = [] if spec.startswith("synthetic:") else _warnings(dataset)
    if settings["trajectory"] is not None:
        trajectory = Path(settings["trajectory"]).expanduser()
        if "crs" in given or not pairs_by_time(trajectory, dataset):
            dataset = WithTrajectory(dataset, trajectory)
            dataset.take_off_origin(origin, given.get("crs"))
            settings |= {"trajectory": None, "localizer": "given"}
            typer.echo(f"poses: {trajectory}, one a frame in order or at its time", err=True)
    return RecordedSource(select(dataset, **part), rate=rate), warnings


def _warnings(dataset: "Dataset") -> list[str]:
    """Oddities of a recording's frames, a sentence each; new ones are printed on stderr, too.

    Raises:
        DatasetError: their depth cannot be used, or nobody knows its unit.
    """
    from tsfusion.cli import output
    from tsfusion.core import process
    from tsfusion.core.errors import DatasetError
    from tsfusion.datasets.dataset import first_frame
    from tsfusion.evaluation import pose_check

    try:
        (depth, color), untimed = pose_check.check_frames(dataset), first_frame(dataset).untimed
    except DatasetError:  # the scan comes to that frame, and tells
        return []
    process.give_back_memory()
    if depth is not None:
        raise DatasetError(f"{dataset.name}: {depth}")
    if color is not None:
        color += "; where the sensor is lost because of it, --option color=false tracks by the depth alone"
        output.text(f"warning: {color}", err=True)
    return [text for text in (color, untimed) if text]
