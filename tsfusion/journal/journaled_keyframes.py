# SPDX-License-Identifier: MIT
"""Read the keyframes of a journal at their final poses, for a map or as a dataset.

Also parse the sessions and times that a person gives to choose keyframes.
"""

import copy
import datetime
import logging
import math
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.config import SERVER_SESSION, VolumeConfig
from tsfusion.core.errors import DecodeError, InvalidConfig, InvalidKeyframe, JournalError
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.keyframe_rows import KeyframeRows, square
from tsfusion.geometry.object_cards import ShownRecording
from tsfusion.geometry.origin import Origin
from tsfusion.journal import state_folder
from tsfusion.journal.ledger import Ledger
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.wire.records import codec
from tsfusion.wire.records.corrections import Correction
from tsfusion.wire.records.record_header import KeyframeHeader, unpack_keyframe

_LEAST_DIGITS = 4  # fewest hex digits that may name a session


def none_in(place: JournalPlace) -> JournalError:
    """Return the error that a journal has no keyframes."""
    return JournalError(
        f"no keyframes in {place.path}; expected a state folder, a spool folder or an .mcap file"
    )


def moment_ns(text: str, last_ns: int) -> int:
    """Return the wall clock time that a text means, nanoseconds.

    Args:
        text: seconds before the last record, such as `90`, or an ISO time such as `2026-05-01 14:30` (this
            machine's zone) or `2026-05-01T12:30:00Z`.

    Raises:
        InvalidConfig: for anything else.
    """
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if 0 <= seconds < math.inf:
        return last_ns - round(seconds * 1e9)
    try:
        moment = datetime.datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
        return round(moment.timestamp() * 1e9)
    except (ValueError, OverflowError, OSError) as error:
        raise InvalidConfig(
            f"a time must be seconds before the last record, such as 90, or ISO such as "
            f"{clock(last_ns)} (the time of that record), got {text!r}"
        ) from error


def clock(stamp_ns: int) -> str:
    """Return a wall clock time as text that `moment_ns` can read, to the second."""
    try:
        moment = datetime.datetime.fromtimestamp(stamp_ns / 1e9, tz=datetime.timezone.utc)
    except (OverflowError, OSError, ValueError):
        return f"{stamp_ns} ns"
    return moment.strftime("%Y-%m-%d %H:%M:%SZ")


def sessions_named(name: str, clients: Mapping[bytes, str]) -> list[bytes]:
    """Return the sessions of a client, or the one session whose hex name begins with these digits.

    Args:
        clients: session → name of its client; an empty name = the server has no keys.

    Raises:
        JournalError: no session matches, or the digits match several; the message lists the sessions.
    """
    if found := [key for key, client in clients.items() if name and client == name]:
        return found
    if len(name) >= _LEAST_DIGITS:
        found = [key for key in clients if key.hex().startswith(name.lower())]
    if len(found) == 1:
        return found
    there = ", ".join(f"{key.hex()[:8]} ({client or 'no key'})" for key, client in clients.items())
    problem = "several sessions begin with" if found else "no session or client is named"
    raise JournalError(f"{problem} {name!r}; the journal has {there or 'none'}")


log = logging.getLogger(__name__)


@dataclass
class JournaledSession:
    """The records of one session that have been read so far.

    Attributes:
        client: name of the access key of the client that sent them; empty = the server has no keys.
        last_seq: number of the last record, a keyframe or a correction.
        first_ns, last_ns: when the first and last records were journaled, by the server's wall clock.
    """

    key: bytes
    client: str
    first_ns: int
    keyframes: int = 0
    last_seq: int = 0
    last_ns: int = 0

    @property
    def name(self) -> str:
        """The client's name, or the session's first digits if the server has no keys."""
        return self.client or self.key.hex()[:8]


class FinalKeyframe(NamedTuple):
    """A keyframe at its final pose, and its session."""

    keyframe: Keyframe
    session: JournaledSession


class JournaledKeyframes:
    """The keyframes of a journal that no correction removed, each at its newest pose, in journal order.

    Each keyframe counts once, even if a crash left a second copy. Keyframes that a map could not take are
    included; forgotten keyframes are not. Arrays are read one keyframe at a time.

    Args:
        until_ns: leave out all records journaled later, also corrections, by the server's wall clock.
            Keyframes forgotten later stay left out.
        watch: called with the bytes read and the total bytes, while the headers are read.
        tells: write damage to the log.

    Attributes:
        rows: the keyframes; their `segments` are indices into `files`.
        files: files of the journal with a keyframe.
        sessions: sessions of the whole journal up to `until_ns`.
        unreadable: number of records without a readable header, by reason.
        recorded: number of keyframes in the journal, erased ones included.
        lost: lower bound of the number of keyframes that damage has destroyed.
        left_out: session and number of each forgotten keyframe and of each that a correction removed.
        forgotten: number of forgotten keyframes in `left_out`.
        worlds: worlds (coordinate frames) that the keyframes name; an empty name = poses were given.
    """

    def __init__(
        self,
        place: JournalPlace,
        *,
        until_ns: int | None = None,
        watch: OnProgress = lambda _done, _all: None,
        tells: bool = True,
    ) -> None:
        self.name = str(place.path)
        self.sessions: dict[bytes, JournaledSession] = {}
        self.unreadable = Counter[str]()
        self.recorded = self.lost = 0
        self.left_out = set[tuple[bytes, int]]()
        self.worlds = set[str]()
        self._ledger = Ledger()
        self.files: list[Path] = []
        for file, step in place.steps(watch):
            if isinstance(step, journal.Erased):
                self.recorded += 1
            elif isinstance(step, journal.Damage):
                self.lost += step.lost
                if tells:
                    log.log(logging.WARNING if step.torn else logging.ERROR, "%s: %s", file, step.what)
            elif step.session == SERVER_SESSION:
                self._ledger.take_forgetting(step)
            else:
                self.recorded += not step.is_correction
                if until_ns is None or step.logged_ns <= until_ns:
                    self._note(file, step)
        rows = self._ledger.newest().in_order()
        self.left_out.update(rows[~rows.in_map])
        self.forgotten = sum(seq in self._ledger.forgotten_of(key) for key, seq in self.left_out)
        self.rows: KeyframeRows = rows[rows.in_map]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> FinalKeyframe:
        """Read a keyframe.

        Raises:
            JournalError: the record cannot be read any more.
            DecodeError, InvalidKeyframe: the record is no valid keyframe; a server cannot use it either.
        """
        session = self.sessions[self.rows.sessions[self.rows.session[index]]]
        found = codec.decode_keyframe(self.record(index).frames)
        return FinalKeyframe(replace(found, T_world_camera=self.rows[[index]].matrices[0]), session)

    def record(self, index: int) -> Record:
        """Return the record of a keyframe; raise JournalError if it cannot be read any more."""
        return journal.read_at(self.files[self.rows.segments[index]], int(self.rows.offsets[index]))

    def keep_only(self, sessions: Collection[bytes]) -> None:
        """Leave out the keyframes of other sessions. Corrections still count, whatever session sent them."""
        rows = [row for row, session in enumerate(self.rows.sessions) if session in sessions]
        self.rows = self.rows[np.isin(self.rows.session, rows)]

    def pose_of(self, session: bytes, seq: int) -> NDArray[np.float64] | None:
        """Return a keyframe's pose, (4, 4) T_world_camera; None if it is unknown or left out."""
        return self._ledger.pose_of(session, seq)

    def _note(self, file: Path, record: Record) -> None:
        key, seq = record.session, record.seq
        session = self.sessions.setdefault(key, JournaledSession(key, record.client, record.logged_ns))
        if seq <= session.last_seq:
            return
        session.last_seq, session.last_ns = seq, record.logged_ns
        if seq in self._ledger.forgotten_of(key):
            if not record.is_correction:
                self.left_out.add((key, seq))
            return
        try:
            if record.is_correction:
                found = codec.decode(record.frames)
                assert isinstance(found, Correction)
                self._ledger.correct(key, found)
                return
            header = unpack_keyframe(record.frames[0])
            place = journal.Position(self._number(file), record.position.offset)
            self._ledger.add(key, seq, place, self._ledger.placed(key, sent_keyframe(header)))
        except (DecodeError, InvalidKeyframe, IndexError) as error:
            self.unreadable[str(error)] += 1
            return
        session.keyframes += 1
        self.worlds.add(header.world)

    def _number(self, file: Path) -> int:
        if not self.files or self.files[-1] != file:
            self.files.append(file)
        return len(self.files) - 1


def sent_keyframe(header: KeyframeHeader) -> Keyframe:
    """Return a keyframe with the pose in a header and without points, enough for a ledger."""
    T = square(np.array([header.pose]))[0]
    return Keyframe(points=np.empty((0, 3), np.float32), T_world_camera=T)


LOST = "lost to damage"  # reason of `JournalRecording.skipped`


class JournalRecording(ShownRecording):
    """The keyframes of a state folder, map folder, `journal` folder, spool folder or `.mcap` segment.

    Each keyframe appears once, at its final pose, in journal order. Keyframes that the map rejected are
    included. `skipped` counts the keyframes forgotten, removed by corrections, or lost to damage.

    Raises:
        JournalError: there is no keyframe.
    """

    usual: Mapping[str, Any] = MappingProxyType({})  # settings of the journal's map, if known
    absent: int = 0  # keyframes of that map that it no longer has, if known

    def __init__(self, path: str | os.PathLike[str], map_name: str | None = None) -> None:
        place = state_folder.find_journal(Path(path), map_name)
        self.name = str(place.path)
        self.keyframes = found = JournaledKeyframes(place)
        self._chosen = range(len(found))
        removed = len(found.left_out) - found.forgotten
        left_out = {"forgotten": found.forgotten, "removed by corrections": removed, LOST: found.lost}
        self.skipped = {reason: count for reason, count in {**found.unreadable, **left_out}.items() if count}
        if not len(found):
            raise none_in(place)
        self._poses = found.rows.matrices
        first = self[0]
        self.sensor = first.sensor or VolumeConfig().sensor
        self.timestamps_ns: NDArray[np.int64] | None = None
        worlds = [*found.worlds]
        self.origin = Origin.of_world(worlds[0]) if len(worlds) == 1 else None

    def __len__(self) -> int:
        return len(self._chosen)

    @overload
    def __getitem__(self, index: int) -> Keyframe: ...

    @overload
    def __getitem__(self, index: slice) -> "JournalRecording": ...

    def __getitem__(self, index: int | slice) -> "Keyframe | JournalRecording":
        """Return a keyframe, or a recording of some; raise JournalError if a record is unreadable."""
        if isinstance(index, slice):
            some = copy.copy(self)
            some._chosen = self._chosen[index]
            return some
        try:
            return self.keyframes[self._chosen[index]].keyframe
        except (DecodeError, InvalidKeyframe) as error:
            raise JournalError(f"{self.name}: keyframe {index} cannot be used: {error}") from error

    def _first(self) -> Keyframe:
        return self[0]

    def pose(self, index: int) -> NDArray[np.float64]:
        """Return the final pose of a keyframe, (4, 4) T_world_camera, without reading the keyframe."""
        return np.asarray(self._poses[index])

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[index] for index in range(len(self)))
