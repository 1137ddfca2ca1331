# SPDX-License-Identifier: MIT
"""`tsfusion scan`."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.scanner.sources.source import Source

_ENDING = b"\nending: what is on its way is finished (press Ctrl-C again to end at once)\n"
_SOURCE, _POSES, _KEYFRAMES = "Source", "Poses", "Keyframes"


def _option(panel: str, metavar: str, help_: str, **settings: Any) -> Any:
    return typer.Option(metavar=metavar, help=help_, rich_help_panel=panel, **settings)


# By name: settings of the `scan` table.
SCAN_OPTIONS: dict[str, Any] = {
    "localizer": Annotated[str | None, _option(
        _POSES, "NAME",
        "What finds poses: rgbd, stereo or lidar (default: by what the source gives); given (the source's "
        "own poses); trajectory or feed (those of another SLAM).")],
    "trajectory": Annotated[str | None, _option(
        _POSES, "FILE", "Take poses from this file of another SLAM, in TUM's or KITTI's format.")],
    "feed": Annotated[str | None, _option(
        _POSES, "ADDRESS", "Take poses live from the SLAM that publishes them at tcp://HOST:PORT.")],
    "time_offset": Annotated[float | None, _option(
        _POSES, "SECONDS", "Added to a frame's time to look up its pose in --trajectory or --feed.")],
    "max_gap": Annotated[float | None, _option(
        _POSES, "SECONDS", "Longest gap to bridge in --trajectory or --feed; default 0.2.")],
    "loop_closure": Annotated[bool | None, typer.Option(
        "--loop-closure/--no-loop-closure", rich_help_panel=_POSES,
        help="Recognise places seen before, and correct the poses since.")],
    "patience": Annotated[float | None, _option(
        _POSES, "SECONDS", "A sensor lost for so long begins a new map; default 1.", min=0.0)],
    "min_overlap": Annotated[float | None, _option(
        _KEYFRAMES, "SHARE", "New keyframe when less of the last one's view is still seen; default 0.8.")],
    "distance": Annotated[float | None, _option(
        _KEYFRAMES, "METRES", "New keyframe after so much movement; default 0.1, for stereo and LiDAR 2.")],
    "angle": Annotated[float | None, _option(
        _KEYFRAMES, "DEGREES", "New keyframe after so much turning; default 10.")],
    "max_rate": Annotated[float | None, _option(
        _KEYFRAMES, "HZ", "At most so many keyframes a second; default: no limit.")],
}  # fmt: skip


@partial(options.takes_map_settings, also=SCAN_OPTIONS)
def scan(
    context: typer.Context,
    *,
    source: Annotated[
        str,
        _option(_SOURCE, "SPEC", "A dataset, or live: realsense, camera:0, folder:PATH (docs/sources.md)."),
    ],
    calibration: Annotated[
        Path | None,
        _option(
            _SOURCE, "FILE", "Of a live camera: Kalibr, OpenCV, ROS or EuRoC (a file, or a folder of two)."
        ),
    ] = None,
    rate: Annotated[
        float | None,
        _option(
            _SOURCE, "HZ", "Frames a second of a recording; default: as fast as they are taken.", min=1e-3
        ),
    ] = None,
    max_frames: Annotated[int | None, _option(_SOURCE, "N", "Stop after so many frames.", min=1)] = None,
    start: Annotated[int, _option(_SOURCE, "N", "Skip so many frames at the beginning.", min=0)] = 0,
    stride: Annotated[int, _option(_SOURCE, "N", "Take every N-th frame only.", min=1)] = 1,
    sequence: options.Sequence = None,
    modality: options.Modality = None,
    option: options.DatasetOptions = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("out"),
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
            help="With --connect: the folder where keyframes wait until the server has them.",
        ),
    ] = Path("tsfusion-spool"),
    config: options.ConfigFile = None,
    json: options.Json = False,
    **settings: Any,
) -> None:
    """Localise a sensor, choose keyframes and send them; Ctrl-C ends the scan and keeps its results.

    Without --connect, the scan starts its own server and leaves the mesh. With it, keyframes that the server
    does not have at the end stay in the spool, and the next scan sends them first.
    """
    options.check_target_flags(context, connect, own=options.MAP_OPTIONS, remote={"spool"})
    from tsfusion.cli import output, progress, run_summary
    from tsfusion.pipelines.scan import scan as run

    recording = {"sequence": sequence, "modality": modality, **options.dataset_options(option)}
    opened = _open(
        context, source, recording, calibration=calibration, rate=rate,
        part={"start": start, "stride": stride, "limit": max_frames},
    )  # fmt: skip
    with opened, _ended_by_signals(opened), progress.shown(quiet=json) as display:
        chosen = options.configuration(config, preset={"sensor": opened.sensor}, **settings)
        client = options.client_settings(
            chosen, connect, control=control, map=map_, key=key, server_key=server_key
        )
        result = run(
            opened, out, config=chosen.scan, volume=chosen.volume, client=client, connect=connect,
            spool=spool, min_weight=settings["min_weight"], progress=display,
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
    """The source of that name; of a recording, the part that is asked for."""
    from tsfusion.scanner.sources.recorded import LimitedSource
    from tsfusion.scanner.sources.registry import is_live, open_source

    if is_live(spec):
        options.refuse(
            context,
            ("sequence", "modality", "option", "rate", "start", "stride"),
            "is for recordings, and this source is live: leave it out",
        )
        live = open_source(spec, calibration=calibration)
        return live if part["limit"] is None else LimitedSource(live, part["limit"])
    options.refuse(context, ("calibration",), "is for a live camera, and this is a recording: leave it out")
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
    """Close the source at the first Ctrl-C or SIGTERM: the scan ends as at the end of a recording.

    The second one interrupts as usual.
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
