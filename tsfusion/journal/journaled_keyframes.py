# SPDX-License-Identifier: MIT
"""The keyframes of a journal: at their final poses, as the map has them, or as they came, as a dataset.

Sessions and times can be chosen as a person writes them.
"""

import copy
import datetime
import logging
import math
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
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
from tsfusion.geometry.object_cards import ShownRecording
from tsfusion.geometry.origin import Origin
from tsfusion.journal import state_folder
from tsfusion.journal.keyframe_poses import KeyframePoses
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.record_scan import scan_records
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.wire.records import codec
from tsfusion.wire.records.corrections import Correction
from tsfusion.wire.records.record_header import KeyframeHeader, unpack_keyframe

_LEAST_DIGITS = 4  # of a session's name


def last_logged_ns(place: JournalPlace) -> int:
    """Wall clock of the last record of a journal; raises JournalError when there is none."""
    for file in reversed(place.files()):
        stamps = [step.logged_ns for step in scan_records(file) if isinstance(step, Record)]
        if stamps:
            return max(stamps)
    raise JournalError(
        f"no keyframes in {place.path}; expected a state folder, a spool folder or an .mcap file"
    )


def moment_ns(text: str, last_ns: int) -> int:
    """The wall clock that a person means.

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
            f"{clock(last_ns)} (when that was), got {text!r}"
        ) from error


def clock(stamp_ns: int) -> str:
    """A wall clock as `moment_ns` reads it, to the second."""
    try:
        moment = datetime.datetime.fromtimestamp(stamp_ns / 1e9, tz=datetime.timezone.utc)
    except (OverflowError, OSError, ValueError):
        return f"{stamp_ns} ns"
    return moment.strftime("%Y-%m-%d %H:%M:%SZ")


def sessions_named(name: str, clients: Mapping[bytes, str]) -> list[bytes]:
    """The sessions of a client, or the one session that begins with these digits.

    Args:
        clients: session → name of its client; empty = no keys.

    Raises:
        JournalError: when there is none, or when several sessions begin so; it lists what there is.
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
    """The records of one session, as far as they were read.

    Attributes:
        client: name of the key that they came under; empty = no keys.
        last_seq: of its last record, a keyframe or a correction.
        first_ns, last_ns: when its first and last records were journaled, by the server's wall clock.
    """

    key: bytes
    client: str
    first_ns: int
    keyframes: int = 0
    last_seq: int = 0
    last_ns: int = 0

    @property
    def name(self) -> str:
        """The client's name, or the session's first digits where the server has no keys."""
        return self.client or self.key.hex()[:8]


class FinalKeyframe(NamedTuple):
    """A keyframe at its final pose, and whose it is."""

    keyframe: Keyframe
    session: JournaledSession


class KeyframePlace(NamedTuple):
    """A keyframe's session and number, and where its record begins in a file."""

    session: bytes
    seq: int
    file: Path
    offset: int


class JournaledKeyframes:
    """The keyframes of a journal that no correction removed, each at its newest pose, in journal order.

    Each once, also when a crash left a second copy. Those that a map could not take are among them, those
    that the server was told to forget are not. Arrays are read one keyframe at a time; a keyframe takes some
    300 bytes otherwise.

    Args:
        until_ns: leave out all that was journaled later, also corrections; by the server's wall clock. What
            was forgotten later does not come back.
        watch: called with the bytes read and all bytes, while the headers are read.
        tells: whether the log tells of damage.

    Attributes:
        sessions: of the whole journal up to `until_ns`.
        unreadable: number of records without a readable header by reason.
        recorded: number of keyframes that are, or were until they were erased, in the journal.
        lost: number of keyframes that damage has destroyed, at least.
        left_out: session and number of those that the server was told to forget, of which `forgotten` are
            so many, and of those that corrections removed.
        worlds: that its keyframes name: coordinate frames of scans that found their poses themselves;
            empty = poses were given.
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
        self._poses = KeyframePoses(None, {})
        self._places: list[KeyframePlace] = []
        for file, step in place.steps(watch):
            if isinstance(step, journal.Erased):
                self.recorded += 1
            elif isinstance(step, journal.Damage):
                self.lost += step.lost
                if tells:
                    log.log(logging.WARNING if step.torn else logging.ERROR, "%s: %s", file, step.what)
            elif step.session == SERVER_SESSION:
                self._forget(step)
            else:
                self.recorded += not step.is_correction
                if until_ns is None or step.logged_ns <= until_ns:
                    self._note(file, step)
        self.left_out.update((one.session, one.seq) for one in self._places if self._pose(one) is None)
        self.forgotten = sum(self._poses.is_forgotten(*key) for key in self.left_out)
        self._places = [place for place in self._places if self._pose(place) is not None]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> FinalKeyframe:
        """Read a keyframe.

        Raises:
            JournalError: when it cannot be read any more.
            DecodeError, InvalidKeyframe: when it is of no use, to a server neither.
        """
        place = self._places[index]
        found = codec.decode_keyframe(journal.read_at(place.file, place.offset).frames)
        T = self._pose(place)
        assert T is not None  # others are left out
        return FinalKeyframe(replace(found, T_world_camera=T), self.sessions[place.session])

    def places(self) -> list[KeyframePlace]:
        """Places of all keyframes, in their order."""
        return list(self._places)

    def poses(self) -> NDArray[np.float64]:
        """(n, 4, 4) final poses of all, T_world_camera; nothing is read for it."""
        return np.array([self._pose(place) for place in self._places]).reshape(-1, 4, 4)

    def keep_only(self, sessions: Collection[bytes]) -> None:
        """Leave out the keyframes of other sessions. Corrections count whoever sent them."""
        self._places = [place for place in self._places if place.session in sessions]

    def pose_of(self, session: bytes, seq: int) -> NDArray[np.float64] | None:
        """Pose of a keyframe, (4, 4) T_world_camera; None = it is not there, or left out."""
        return self._poses.pose_of(session, seq)

    def _pose(self, place: KeyframePlace) -> NDArray[np.float64] | None:
        return self.pose_of(place.session, place.seq)

    def _note(self, file: Path, record: Record) -> None:
        key, seq = record.session, record.seq
        session = self.sessions.setdefault(key, JournaledSession(key, record.client, record.logged_ns))
        if seq <= session.last_seq:
            return
        session.last_seq, session.last_ns = seq, record.logged_ns
        if self._poses.is_forgotten(key, seq):
            if not record.is_correction:
                self.left_out.add((key, seq))
            return
        try:
            if record.is_correction:
                found = codec.decode(record.frames)
                assert isinstance(found, Correction)
                self._poses.correct(key, found)
                return
            header = unpack_keyframe(record.frames[0])
            sent = _without_measurement(header)
            self._poses.add(key, seq, record.position, self._poses.placed(key, sent))
        except (DecodeError, InvalidKeyframe, IndexError) as error:
            self.unreadable[str(error)] += 1
            return
        session.keyframes += 1
        self.worlds.add(header.world)
        self._places.append(KeyframePlace(key, seq, file, record.position.offset))

    def _forget(self, record: Record) -> None:
        with suppress(DecodeError):  # `tsfusion journal verify` tells of it
            found = codec.decode(record.frames)
            if isinstance(found, Correction) and found.target is not None:
                self._poses.forget(found.target, found.removed)


def _without_measurement(header: KeyframeHeader) -> Keyframe:
    """A keyframe of no points, at its place."""
    rows = np.array(header.pose).reshape(3, 4)
    T = np.vstack([rows, (0.0, 0.0, 0.0, 1.0)])
    return Keyframe(points=np.empty((0, 3), np.float32), T_world_camera=T)


LOST = "lost to damage"  # reason of `JournalRecording.skipped`


class JournalRecording(ShownRecording):
    """The keyframes of a state folder (of one map, or of the one named), a map's folder or its `journal`, a
    spool folder or one `.mcap` segment: each once, at its final pose, in journal order.

    Keyframes the map had to reject are among them. Those that the server was told to forget, that
    corrections removed, or that damage cost are left out and counted in `skipped`.

    Raises:
        JournalError: when there is no keyframe.
    """

    usual: Mapping[str, Any] = MappingProxyType({})  # settings of the map whose journal it is, if known
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
            raise JournalError(
                f"no keyframes in {place.path}; expected a state folder, a spool folder or an .mcap file"
            )
        self._poses = found.poses()
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
        """A keyframe, or some; raises JournalError when it cannot be read any more."""
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
        """(4, 4) final T_world_camera of a keyframe, which is not read for it."""
        return np.asarray(self._poses[index])

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[index] for index in range(len(self)))
