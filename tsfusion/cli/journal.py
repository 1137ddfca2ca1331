# SPDX-License-Identifier: MIT
"""`tsfusion journal`: describe or check a journal, save its whole keyframes, export it to other tools."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from tsfusion.cli import options, verbs
from tsfusion.cli.output import first_of, size
from tsfusion.core.readable_numbers import OnProgress, count_of

if TYPE_CHECKING:
    from tsfusion.journal.inspection import JournalFault, JournalInfo, JournalVerdict, SessionInfo
    from tsfusion.journal.recovery import Recovery
    from tsfusion.journal.ros2_export import Export
    from tsfusion.journal.state_folder import JournalPlace

_Returned = TypeVar("_Returned")
_MOST_FILES = 20  # printed; --json has all

app = typer.Typer(
    cls=verbs.Group,
    help="Describe, check, rescue or export the keyframes of a journal.\n\n"
    "None of this changes a journal, and all of it works while a server runs.",
)

JournalArgument = Annotated[
    Path,
    typer.Argument(
        metavar="PATH",
        help="A server's state folder, the folder of one of its maps, a journal or spool folder, an .mcap.",
    ),
]
JournalMapFlag = Annotated[
    str | None, typer.Option("--map", metavar="NAME", help="Map of the folder, if it has several.")
]


@verbs.verb(app, "tsfusion journal info my-maps", "tsfusion journal info my-maps --map yard --json")
def info(path: JournalArgument, map_: JournalMapFlag = None, json: options.Json = False) -> None:
    """Describe what a journal holds: segments, sessions, keyframes, damage, quarantine.

    Checks the CRC of each keyframe and decodes none: as fast as the disk.

    A session is what one scanner sent from one spool. Its keyframes are
    numbered; the numbers may have gaps, as a scanner leaves out what comes
    too fast. A segment is closed, with an index, or open: being written, or
    cut short by a crash, which costs nothing.

    Exit status 0 also for a damaged journal; `verify` has another for it.
    """
    from tsfusion.journal.inspection import summarize

    _run("reading", path, map_, summarize, _describe_info, json=json)


@verbs.verb(app, "tsfusion journal verify my-maps", "tsfusion journal verify tsfusion-spool/default")
def verify(path: JournalArgument, map_: JournalMapFlag = None, json: options.Json = False) -> None:
    """Read and decode every keyframe; exit status 1 when anything is damaged.

    Each bad place is named by segment and byte. `damage`: the bytes are not
    those that were written. `torn`: a crash or a power cut took the end of a
    write; it was never acknowledged, and its scanner sends it again. `note`:
    unusual, but nothing is wrong with the keyframes. `erased`: a keyframe was
    deleted on purpose (`tsfusion map forget --erase`).
    """
    from tsfusion.journal.inspection import verify as check

    if not _run("checking", path, map_, check, _describe_verdict, json=json).intact:
        raise typer.Exit(1)


@verbs.verb(
    app, "tsfusion journal recover my-maps saved", "tsfusion journal recover my-maps/maps/yard saved-yard"
)
def recover(
    path: JournalArgument,
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="A folder that does not exist yet, or is empty.")
    ],
    map_: JournalMapFlag = None,
    json: options.Json = False,
) -> None:
    """Write every whole keyframe of a damaged or unfinished journal into a new one.

    OUT holds closed segments with an index, which any MCAP reader opens;
    `replay` and `mesh` take it too. So does a server, as the `journal` folder
    of a map: move the map.tsf beside it away, for it counts in the bytes of
    the old journal, and it is built again. PATH is only read. OUT appears
    when all of it is on the disk.

    Exit status 1: OUT is there, but some keyframes could not be saved; the
    damaged places are named.
    """
    from tsfusion.core.config import ServerConfig
    from tsfusion.journal.recovery import recover as save

    def work(place: "JournalPlace", watch: "OnProgress") -> "Recovery":
        return save(place, out, ServerConfig().segment_bytes, watch)

    if _run("saving", path, map_, work, partial(_describe_recovery, out), json=json).lost:
        raise typer.Exit(1)


@verbs.verb(
    app,
    "tsfusion journal export my-maps yard.mcap --map yard",
    "tsfusion journal export my-maps yard.mcap --points",
)
def export(
    path: JournalArgument,
    out: Annotated[
        Path, typer.Argument(metavar="OUT.mcap", help="The file to write; replaced if it exists.")
    ],
    map_: JournalMapFlag = None,
    points: Annotated[
        bool, typer.Option("--points", help="Write depth as points, too: Foxglove draws no depth in 3-D.")
    ] = False,
    json: options.Json = False,
) -> None:
    """Write the keyframes as ROS 2 messages into one MCAP file: Foxglove, RViz and `ros2 bag play` read it.

    NAME is a scanner's, from its key, else `scanner`; further sessions are
    numbered. Frames: world → NAME, a camera's with z forward. Topics:

    /tf, /NAME/pose                where it was, as corrected since
    /NAME/depth/image              16UC1 mm as sent; stereo: 32FC1 m
    /NAME/depth/camera_info        also for the colour image
    /NAME/color/image/compressed   the JPEG as sent
    /NAME/points                   LiDAR, and --points; rgb where there is colour

    A message's time is its sensor's clock, or its arrival without one.
    Needs rosbags, the extra `ros`. contrib/foxglove has a layout for Foxglove.

    Exit status 1: OUT is there, but without the damaged keyframes.
    """
    from tsfusion.journal.ros2_export import export as write

    def work(place: "JournalPlace", watch: "OnProgress") -> "Export":
        return write(place, out, watch, clouds=points)

    if _run("exporting", path, map_, work, partial(_describe_export, out), json=json).lost:
        raise typer.Exit(1)


def _run(
    doing: str,
    path: Path,
    map_name: str | None,
    work: Callable[["JournalPlace", "OnProgress"], _Returned],
    describe: Callable[[_Returned], str],
    *,
    json: bool,
) -> _Returned:
    """Do the work of a verb on a journal, with progress on stderr, and print its result."""
    from tsfusion.cli import output, progress
    from tsfusion.journal.state_folder import find_journal

    place = find_journal(path, map_name)
    _check_journal(place)
    with progress.reading(f"{doing} {place.path}", quiet=json) as watch:
        result = work(place, watch)
    output.result(result, describe(result), json=json)
    return result


def _check_journal(place: "JournalPlace") -> None:
    """Raise JournalError if there is no segment, or if a single file is no MCAP."""
    from tsfusion.core.errors import JournalError
    from tsfusion.journal.mcap_layout import MAGIC

    expected = "expected a state folder, a map's, a journal or an .mcap file"
    if not place.files():
        raise JournalError(f"no journal in {place.path}; {expected}")
    if place.path.is_file():
        with place.path.open("rb") as file:
            if not MAGIC.startswith(file.read(len(MAGIC))):
                raise JournalError(f"{place.path} is no MCAP file; {expected}")


def _describe_recovery(out: Path, done: "Recovery") -> str:
    lines = [f"{out}: {_records(done)} in {count_of(done.segments, 'segment')}, {size(done.nbytes)}"]
    if done.copies:
        lines.append(f"{count_of(done.copies, 'record')} stood there twice and is saved once")
    return "\n".join([*lines, *_problem_lines(done.problems), _loss(done.lost)])


def _describe_export(out: Path, done: "Export") -> str:
    head = f"{out}: {count_of(done.keyframes, 'keyframe')}, {size(done.nbytes)}"
    topics = [f"  {topic}  {count}" for topic, count in done.messages.items()]
    return "\n".join([head, *topics, *_problem_lines(done.problems), _loss(done.lost)])


def _records(found: "Recovery | JournalVerdict") -> str:
    keyframes = count_of(found.keyframes, "keyframe")
    return keyframes + (f" and {count_of(found.corrections, 'correction')}" if found.corrections else "")


def _loss(lost: int) -> str:
    return f"{count_of(lost, 'keyframe')} lost, at least" if lost else "no keyframe is lost"


def _describe_info(found: "JournalInfo") -> str:
    lines = [
        f"journal    {found.path}",
        f"keyframes  {found.keyframes}, {size(found.nbytes)}",
        *([f"corrections {found.corrections}"] if found.corrections else []),
        *([f"erased     {count_of(found.erased, 'keyframe')}"] if found.erased else []),
        f"damage     {_loss(found.lost)}",
    ]
    kept = sum(one["bytes"] for one in found.quarantined)
    if found.quarantined:
        names = ", ".join(one["name"] for one in found.quarantined[:_MOST_FILES])
        lines.append(f"quarantine {count_of(len(found.quarantined), 'file')}, {size(kept)}: {names}")
    rows = [
        f"  {one.name:<12} {one.state:<8} {one.keyframes:>7} keyframes  {size(one.nbytes):>8}"
        + (f"  {one.lost} lost" if one.lost else "")
        for one in found.segments
    ]
    lines += [f"segments   {len(found.segments)}", *first_of(rows)]
    lines += [f"sessions   {len(found.sessions)}", *first_of([_session(one) for one in found.sessions])]
    return "\n".join([*lines, *_problem_lines(found.problems)])


def _session(one: "SessionInfo") -> str:
    from tsfusion.journal.journaled_keyframes import clock

    first, last = clock(one.first_logged_ns), clock(one.last_logged_ns)
    forgotten = f"  {one.forgotten} forgotten" if one.forgotten else ""
    return (
        f"  {one.session[:8]}  {one.client or 'no key':<12} {one.keyframes:>7} keyframes  "
        f"{one.first_seq}…{one.last_seq}  {first} – {last}{_corrected(one)}{forgotten}"
    )


def _corrected(one: "SessionInfo") -> str:
    if not one.corrections:
        return ""
    most = f"{one.moved_m:.3g} m, {one.turned_deg:.2g}°"
    removed = f", {one.removed} removed" if one.removed else ""
    return f"  {one.corrected} corrected by up to {most}{removed} ({count_of(one.corrections, 'correction')})"


def _describe_verdict(verdict: "JournalVerdict") -> str:
    read = f"{_records(verdict)} in {count_of(verdict.segments, 'segment')}"
    judged = "intact" if verdict.intact else f"damaged; {_loss(verdict.lost)}"
    return "\n".join(
        [*_problem_lines(verdict.problems), f"{verdict.path}: {read}, {size(verdict.nbytes)}: {judged}"]
    )


def _problem_lines(problems: "list[JournalFault]") -> list[str]:
    return first_of([
        f"{one.kind:<7} {one.segment}, byte {one.offset}: {one.what}"
        + (f" ({count_of(one.lost, 'keyframe')} lost)" if one.lost else "")
        for one in problems
    ])  # fmt: skip
