# SPDX-License-Identifier: MIT
"""What a journal holds, and whether all of it is as it was written."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec import Struct

from tsfusion import journal
from tsfusion.core.errors import DecodeError, InvalidKeyframe, JournalError
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import check_pose
from tsfusion.journal import state_folder
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.record_scan import Damage
from tsfusion.journal.state_folder import JournalPlace, Watcher
from tsfusion.wire import codec, corrections
from tsfusion.wire.corrections import SessionCorrections
from tsfusion.wire.keyframe_header import unpack


class Problem(Struct, frozen=True):
    """A place in a journal that is not as it should be.

    `torn`: the end of a write that was cut off before it was acknowledged. `note`: nothing is wrong with
    what is there. Both are no damage.
    """

    kind: Literal["damage", "torn", "note"]
    segment: str
    offset: int
    nbytes: int
    lost: int  # keyframes
    what: str


class SegmentInfo(Struct, kw_only=True):
    """One file. `state`: closed with an index, or open: being written, or its writer was killed."""

    name: str
    nbytes: int
    keyframes: int = 0
    lost: int = 0
    state: Literal["closed", "open", "damaged"] = "open"


class SessionInfo(Struct, kw_only=True):
    """The keyframes of one spool: `seq` numbers them, `client` is whose key they came under.

    Attributes:
        revision: of its corrections the newest; 0 = there are none.
        corrected: keyframes that they name.
        moved_m, turned_deg: the most that any of these in the journal is away from where it was sent.
    """

    session: str
    client: str
    keyframes: int
    first_seq: int
    last_seq: int
    first_logged_ns: int  # wall clock
    last_logged_ns: int
    revision: int = 0
    corrected: int = 0
    moved_m: float = 0.0
    turned_deg: float = 0.0


class JournalInfo(Struct, kw_only=True):
    """A journal at a glance."""

    path: str
    keyframes: int
    nbytes: int
    lost: int
    segments: list[SegmentInfo]
    sessions: list[SessionInfo]
    problems: list[Problem]
    quarantined: list[dict[str, Any]]  # name, bytes


class Verdict(Struct, kw_only=True):
    """Whether a journal is whole. `lost`: keyframes that cannot be had any more, at least."""

    path: str
    intact: bool
    keyframes: int
    segments: int
    nbytes: int
    lost: int
    problems: list[Problem]


def summarize(place: JournalPlace, watch: Watcher) -> JournalInfo:
    """Read every record's CRC and head; nothing is decoded.

    Raises:
        JournalError: when the folder cannot be listed.
    """
    segments = {path: _segment(path) for path in place.files()}
    sessions: dict[bytes, SessionInfo] = {}
    problems: list[Problem] = []
    moves = _Moves(_corrections(place, problems))
    for path, step in place.steps(watch):
        segment = segments.setdefault(path, _segment(path))
        if isinstance(step, Damage):
            problems.append(problem(path, step))
            segment.lost += step.lost
            segment.state = segment.state if step.torn else "damaged"
        else:
            segment.keyframes += 1
            moves.note(_count(sessions, step), step)
    return JournalInfo(
        path=str(place.path),
        keyframes=sum(segment.keyframes for segment in segments.values()),
        nbytes=sum(segment.nbytes for segment in segments.values()),
        lost=sum(segment.lost for segment in segments.values()),
        segments=list(segments.values()),
        sessions=list(sessions.values()),
        problems=problems,
        quarantined=[{"name": path.name, "bytes": _segment(path).nbytes} for path in place.quarantined()],
    )


def _segment(path: Path) -> SegmentInfo:
    try:
        nbytes = path.stat().st_size
    except OSError:
        nbytes = 0
    return SegmentInfo(name=path.name, nbytes=nbytes, state="closed" if journal.is_closed(path) else "open")


def _corrections(place: JournalPlace, problems: list[Problem]) -> dict[bytes, SessionCorrections]:
    try:
        return {} if place.corrections is None else corrections.read(place.corrections)
    except JournalError as error:
        problems.append(Problem("damage", state_folder.CORRECTIONS_FOLDER, 0, 0, 0, str(error)))
        return {}


class _Moves:
    """How far corrections move what a journal holds."""

    def __init__(self, said: dict[bytes, SessionCorrections]) -> None:
        self._said = said

    def note(self, session: SessionInfo, record: Record) -> None:
        said = self._said.get(record.session)
        if said is None:
            return
        session.revision, session.corrected = said.revision, len(said)
        at = int(np.searchsorted(said.seqs, record.seq))
        if at == len(said) or said.seqs[at] != record.seq:
            return
        try:
            sent = check_pose([*_rows(unpack(record.frames[0]).pose), (0.0, 0.0, 0.0, 1.0)])
        except (DecodeError, InvalidKeyframe, IndexError):
            return  # `verify` says so
        move = se3.inverse(sent) @ said.poses[at]
        session.moved_m = max(session.moved_m, se3.distance(move))
        session.turned_deg = max(session.turned_deg, math.degrees(se3.angle(move)))


def _rows(pose: tuple[float, ...]) -> list[tuple[float, ...]]:
    return [pose[at : at + 4] for at in (0, 4, 8)]


def _count(sessions: dict[bytes, SessionInfo], record: Record) -> SessionInfo:
    known = sessions.get(record.session)
    if known is None:
        known = sessions[record.session] = SessionInfo(
            session=record.session.hex(),
            client=record.client,
            keyframes=0,
            first_seq=record.seq,
            last_seq=record.seq,
            first_logged_ns=record.logged_ns,
            last_logged_ns=record.logged_ns,
        )
    known.keyframes += 1
    known.last_seq = record.seq
    known.last_logged_ns = record.logged_ns
    return known


def problem(path: Path, damage: Damage) -> Problem:
    """A damaged place as a report names it."""
    kind: Literal["damage", "torn"] = "torn" if damage.torn else "damage"
    return Problem(kind, path.name, damage.position.offset, damage.nbytes, damage.lost, damage.what)


def verify(place: JournalPlace, watch: Watcher) -> Verdict:
    """Read and decode every keyframe.

    Raises:
        JournalError: when the folder cannot be listed.
    """
    files = place.files()
    checks = _Checks()
    problems = list(_missing(files))
    keyframes = 0
    for path, step in place.steps(watch):
        if isinstance(step, Damage):
            problems.append(problem(path, step))
        else:
            keyframes += 1
            problems += checks.of(path, step)
    return Verdict(
        path=str(place.path),
        intact=not any(one.kind == "damage" for one in problems),
        keyframes=keyframes,
        segments=len(files),
        nbytes=sum(_segment(path).nbytes for path in files),
        lost=sum(one.lost for one in problems),
        problems=problems,
    )


def _missing(files: list[Path]) -> Iterator[Problem]:
    numbers = [journal.segment_number(path) for path in files]
    for before, number, path in zip(numbers, numbers[1:], files[1:], strict=False):
        if number > before + 1:
            absent = number - before - 1
            yield Problem("note", path.name, 0, 0, 0, f"{absent} numbers before this one have no file")


class _Checks:
    """What can be wrong with a record whose CRC is right."""

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}
        self._seen: set[tuple[bytes, int]] = set()

    def of(self, path: Path, record: Record) -> list[Problem]:
        found = [*self._order(record), *_content(record)]
        at, nbytes = record.position.offset, record.nbytes
        return [Problem(kind, path.name, at, nbytes, lost, what) for kind, lost, what in found]

    def _order(self, record: Record) -> Iterator[tuple[Literal["damage", "note"], int, str]]:
        key, name = (record.session, record.seq), _name(record)
        if key in self._seen:
            yield "note", 0, f"{name} is here a second time: it counts once"
        elif record.seq < self._last.get(record.session, 0):
            yield "damage", 0, f"{name} comes after {self._last[record.session]}: a map would leave it out"
        self._seen.add(key)
        self._last[record.session] = max(record.seq, self._last.get(record.session, 0))


def _content(record: Record) -> Iterator[tuple[Literal["damage"], int, str]]:
    try:
        header = unpack(record.frames[0] if record.frames else b"")
        codec.decode(record.frames)
    except (DecodeError, InvalidKeyframe) as error:
        yield "damage", 1, f"{_name(record)} is no keyframe: {error}"
        return
    if (header.session, header.seq) != (record.session, record.seq):
        said = f"{header.seq} of session {header.session.hex()[:8]}"
        yield "damage", 0, f"{_name(record)} says of itself that it is {said}"


def _name(record: Record) -> str:
    return f"keyframe {record.seq} of session {record.session.hex()[:8]}"
