# SPDX-License-Identifier: MIT
"""Summarise the contents of a journal, and verify that its records are intact."""

import math
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from msgspec import Struct

from tsfusion import journal
from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import DecodeError, InvalidKeyframe
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe_rows import FlatPose, square
from tsfusion.journal.journaled_keyframes import sent_keyframe
from tsfusion.journal.ledger import Ledger
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.record_scan import Damage, Erased
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.wire.records import codec
from tsfusion.wire.records.corrections import Correction
from tsfusion.wire.records.record_header import unpack, unpack_keyframe


class JournalFault(Struct, frozen=True):
    """A stretch of a journal with something to report.

    `torn`: the end of a write that was cut off before it was acknowledged. `note`: the bytes there are right.
    `erased`: a keyframe was deleted on purpose. None of these three kinds is damage.
    """

    kind: Literal["damage", "torn", "note", "erased"]
    segment: str
    offset: int
    nbytes: int
    lost: int  # keyframes
    what: str


class SegmentInfo(Struct, kw_only=True):
    """One segment file. An `open` file has no index: it is being written, or its writer was killed."""

    name: str
    nbytes: int
    keyframes: int = 0
    corrections: int = 0
    erased: int = 0
    lost: int = 0
    state: Literal["closed", "open", "damaged"] = "open"


class SessionInfo(Struct, kw_only=True):
    """The records of one spool: `seq` is their number, `client` the name of the access key of their sender.

    Attributes:
        corrected: keyframes in the journal to which the newest correction gives another pose than was sent.
        removed: keyframes in the journal that the newest correction takes out of the map.
        forgotten: keyframes that the server was told to forget.
        moved_m, turned_deg: the largest distance (metres) and angle (degrees) between the sent and the newest
            pose of a corrected keyframe in the journal.
    """

    session: str
    client: str
    keyframes: int
    first_seq: int
    last_seq: int
    first_logged_ns: int  # wall clock
    last_logged_ns: int
    corrections: int = 0
    corrected: int = 0
    removed: int = 0
    forgotten: int = 0
    moved_m: float = 0.0
    turned_deg: float = 0.0


class JournalInfo(Struct, kw_only=True):
    """A summary of a journal, for `tsfusion journal info`."""

    path: str
    keyframes: int
    corrections: int
    nbytes: int
    lost: int
    segments: list[SegmentInfo]
    sessions: list[SessionInfo]
    problems: list[JournalFault]
    quarantined: list[dict[str, Any]]  # name, bytes
    erased: int = 0  # keyframes that were deleted on purpose


class JournalVerdict(Struct, kw_only=True):
    """The result of `verify`. `lost`: lower bound of the keyframes that are lost."""

    path: str
    intact: bool
    keyframes: int
    corrections: int
    segments: int
    nbytes: int
    lost: int
    problems: list[JournalFault]


def summarize(place: JournalPlace, watch: OnProgress) -> JournalInfo:
    """Summarise a journal: check every record's CRC and header, and decode the arrays of corrections only.

    Raises:
        JournalError: the folder cannot be listed.
    """
    segments = {path: _segment(path) for path in place.files()}
    sessions: dict[bytes, SessionInfo] = {}
    problems: list[JournalFault] = []
    ledger = Ledger()  # of keyframes at their sent poses
    for path, step in place.steps(watch):
        segment = segments.setdefault(path, _segment(path))
        if isinstance(step, Erased) and step.is_clear:
            segment.erased += 1
        elif isinstance(step, Damage):
            problems.append(problem(path, step))
            segment.lost += step.lost
            segment.state = segment.state if step.torn else "damaged"
        else:
            segment.keyframes += not step.is_correction
            segment.corrections += step.is_correction
            ledger.take_forgetting(step)
            if step.session != SERVER_SESSION:
                _note(ledger, step, is_next=step.seq > _count(sessions, step))
    for key, session in sessions.items():
        session.forgotten = ledger.forgotten_of(key).count
    for (key, seq), newest in ledger.wanted.items():
        if seq not in ledger.forgotten_of(key):
            _count_move(sessions[key], ledger.place_of(key, seq)[1], newest)
    return JournalInfo(
        path=str(place.path),
        keyframes=sum(segment.keyframes for segment in segments.values()),
        corrections=sum(segment.corrections for segment in segments.values()),
        nbytes=sum(segment.nbytes for segment in segments.values()),
        lost=sum(segment.lost for segment in segments.values()),
        segments=list(segments.values()),
        sessions=list(sessions.values()),
        problems=problems,
        quarantined=[{"name": path.name, "bytes": _segment(path).nbytes} for path in place.quarantined()],
        erased=sum(segment.erased for segment in segments.values()),
    )


def _segment(path: Path) -> SegmentInfo:
    try:
        nbytes = path.stat().st_size
    except OSError:
        nbytes = 0
    return SegmentInfo(name=path.name, nbytes=nbytes, state="closed" if journal.is_closed(path) else "open")


def _note(ledger: Ledger, record: Record, *, is_next: bool) -> None:
    """Add a scanner's record to a ledger; an unreadable record is left to `verify`."""
    with suppress(DecodeError, InvalidKeyframe, IndexError):
        if record.is_correction:
            found = codec.decode(record.frames)
            assert isinstance(found, Correction)
            ledger.correct(record.session, found)
        elif is_next:
            sent = sent_keyframe(unpack_keyframe(record.frames[0]))
            ledger.add(record.session, record.seq, record.position, sent)


def _count_move(session: SessionInfo, sent: FlatPose, newest: FlatPose) -> None:
    if np.isnan(newest[0]):
        session.removed += 1
        return
    before, after = square(np.stack([sent, newest]))
    move = se3.inverse(before) @ after
    session.corrected += 1
    session.moved_m = max(session.moved_m, se3.distance(move))
    session.turned_deg = max(session.turned_deg, math.degrees(se3.angle(move)))


def _count(sessions: dict[bytes, SessionInfo], record: Record) -> int:
    """Count a record in its session. Return the highest number before it, 0 = none."""
    known = sessions.get(record.session)
    if known is None:
        known = sessions[record.session] = SessionInfo(
            session=record.session.hex(),
            client=record.client,
            keyframes=0,
            first_seq=record.seq,
            last_seq=0,
            first_logged_ns=record.logged_ns,
            last_logged_ns=record.logged_ns,
        )
    known.keyframes += not record.is_correction
    known.corrections += record.is_correction
    before, known.last_seq = known.last_seq, max(known.last_seq, record.seq)
    known.last_logged_ns = record.logged_ns
    return before


def problem(path: Path, damage: Damage) -> JournalFault:
    """Return a damaged or erased stretch of a segment file as the fault that a report shows."""
    kind: Literal["damage", "torn", "erased"] = "torn" if damage.torn else "damage"
    if isinstance(damage, Erased):
        kind = "erased"
    return JournalFault(kind, path.name, damage.position.offset, damage.nbytes, damage.lost, damage.what)


def verify(place: JournalPlace, watch: OnProgress) -> JournalVerdict:
    """Read and decode every record of a journal.

    Raises:
        JournalError: the folder cannot be listed.
    """
    files = place.files()
    checks = _Checks()
    problems = [] if place.is_a_maps else list(_missing(files))
    keyframes = corrections = 0
    for path, step in place.steps(watch):
        if isinstance(step, Damage):
            problems.append(problem(path, step))
        else:
            keyframes += not step.is_correction
            corrections += step.is_correction
            problems += checks.of(path, step)
    return JournalVerdict(
        path=str(place.path),
        intact=not any(one.kind == "damage" for one in problems),
        keyframes=keyframes,
        corrections=corrections,
        segments=len(files),
        nbytes=sum(_segment(path).nbytes for path in files),
        lost=sum(one.lost for one in problems),
        problems=problems,
    )


def _missing(files: list[Path]) -> Iterator[JournalFault]:
    numbers = [journal.segment_number(path) for path in files]
    for before, number, path in zip(numbers, numbers[1:], files[1:], strict=False):
        if number > before + 1:
            absent = number - before - 1
            yield JournalFault("note", path.name, 0, 0, 0, f"{absent} numbers before this one have no file")


class _Checks:
    """Checks that a record with a correct CRC comes in order, comes once, and can be decoded."""

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}
        self._seen: set[tuple[bytes, int]] = set()

    def of(self, path: Path, record: Record) -> list[JournalFault]:
        found = [*self._order(record), *_content(record)]
        at, nbytes = record.position.offset, record.nbytes
        return [JournalFault(kind, path.name, at, nbytes, lost, what) for kind, lost, what in found]

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
        yield "damage", 1, f"{_name(record)} is no {_kind(record)}: {error}"
        return
    if (header.session, header.seq) != (record.session, record.seq):
        name = f"{header.seq} of session {header.session.hex()[:8]}"
        yield "damage", 0, f"{_name(record)} says of itself that it is {name}"


def _kind(record: Record) -> str:
    return "correction" if record.is_correction else "keyframe"


def _name(record: Record) -> str:
    return f"{_kind(record)} {record.seq} of session {record.session.hex()[:8]}"
