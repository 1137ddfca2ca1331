# SPDX-License-Identifier: MIT
"""The keyframes of a map's journal at their final poses, as the map has them when it is settled."""

import logging
from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import DecodeError, InvalidKeyframe
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.journal.keyframe_poses import KeyframePoses
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.state_folder import JournalPlace, Watcher
from tsfusion.wire import codec
from tsfusion.wire.corrections import Correction
from tsfusion.wire.record_header import KeyframeHeader, unpack_keyframe

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
        watch: Watcher = lambda _done, _all: None,
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
