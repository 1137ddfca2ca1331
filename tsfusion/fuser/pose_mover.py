# SPDX-License-Identifier: MIT
"""Fuse keyframes again at the poses that corrections give, in between new keyframes."""

import errno
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from heapq import heapify, heappop, heappush
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.errors import JournalError, TsfusionError
from tsfusion.fuser.fuser_messages import CorrectionProgress
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.keyframe_rows import FlatPose, square
from tsfusion.journal import Position
from tsfusion.journal.ledger import Ledger
from tsfusion.wire.records import codec

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume

REST_FACTOR = 3.0  # moves get a quarter of a busy fuser's time
RETRY_S = 0.5  # until the next attempt at a record that is unreadable, or whose folder is missing
_PATIENCE_S = 10.0  # for such a record
_SAY_INTERVAL = 0.2  # seconds between two messages of progress

_LEVER = 2.0  # metres from a sensor at which a turn of it counts
_SPARE = 1024  # entries of the heap that may be of no use

log = logging.getLogger(__name__)


class ReadPatience:
    """Patience with a record that cannot be read for now: its folder, file or disk may come back."""

    def __init__(self, is_away: Callable[[], bool]) -> None:
        self._is_away = is_away
        self.since: float | None = None  # time.monotonic() of the first failure; None = nothing failed

    def waits(self, error: JournalError) -> bool:
        """Return True if the record is to be read again later. The first failure is logged."""
        if not error.temporary:
            return False
        if self.since is None:
            log.warning("%s; it is tried again", error)
            self.since = time.monotonic()
        return time.monotonic() - self.since < _PATIENCE_S or self._is_away()


class Move(NamedTuple):
    """Change of a keyframe in the map: to another pose, out of the map, or back into it.

    `fused`, `wanted`: (4, 4) float64 `T_world_camera`; None = not in the map.
    """

    session: bytes
    seq: int
    position: Position
    fused: NDArray[np.float64] | None
    wanted: NDArray[np.float64] | None


class PendingMoves:
    """Moves that corrections ask for and the ledger lists, the largest first."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        # Minus metres, ticket, session, number, newest pose: of use while the ledger wants this very array
        self._heap: list[tuple[float, int, bytes, int, FlatPose]] = []
        self._tickets = 0
        self.stuck: set[tuple[bytes, int]] = set()  # keyframes that cannot be moved
        for session, seq in ledger.wanted:
            self.note(session, [seq])

    def __len__(self) -> int:
        return len(self.ledger.wanted) - len(self.stuck)

    def note(self, session: bytes, seqs: Iterable[int]) -> None:
        """Queue the moves of keyframes that a correction has given new poses or removed."""
        for seq in seqs:
            self.stuck.discard((session, seq))
            wanted = self.ledger.wanted.get((session, seq))
            if wanted is not None:
                self._tickets += 1
                metres = _metres(self.ledger.place_of(session, seq)[1], wanted)
                heappush(self._heap, (-metres, self._tickets, session, seq, wanted))
        if len(self._heap) > 2 * len(self.ledger.wanted) + _SPARE:
            self._heap = [one for one in self._heap if self._is_valid(one)]
            heapify(self._heap)

    def next(self) -> Move | None:
        """Return the move with the largest distance, removals first; None if all are done."""
        while self._heap and not self._is_valid(self._heap[0]):
            heappop(self._heap)
        if not self._heap:
            return None
        _, _, session, seq, wanted = self._heap[0]
        position, fused = self.ledger.place_of(session, seq)
        return Move(session, seq, position, _pose(fused), _pose(wanted))

    def moved(self) -> None:
        """Record in the ledger that the move returned by `next` is done."""
        _, _, session, seq, _ = heappop(self._heap)
        self.ledger.set_fused(session, seq)

    def give_up(self) -> None:
        """Record that the move returned by `next` cannot be done: the keyframe stays at its fused pose."""
        _, _, session, seq, _ = heappop(self._heap)
        self.stuck.add((session, seq))

    def drop_deleted(self, before_segment: int) -> None:
        """Remove moves of keyframes that the journal no longer has: segments below `before_segment`."""
        self.ledger.drop_deleted(before_segment)
        self.stuck &= self.ledger.wanted.keys()

    def _is_valid(self, entry: tuple[float, int, bytes, int, FlatPose]) -> bool:
        return self.ledger.wanted.get(entry[2:4]) is entry[4]


def _metres(fused: FlatPose, wanted: FlatPose) -> float:
    """Return roughly how far a keyframe's surface moves; infinite if it enters or leaves the map."""
    apart = (fused - wanted).reshape(3, 4)
    metres = float(np.linalg.norm(apart[:, 3]) + _LEVER * np.linalg.norm(apart[:, :3]) / np.sqrt(2))
    return metres if np.isfinite(metres) else np.inf


def _pose(rows: FlatPose) -> NDArray[np.float64] | None:
    return None if np.isnan(rows[0]) else square(rows[None])[0]


class PoseMover:
    """Mover of keyframes to corrected poses. Call `move` when `wait` is over.

    Args:
        integrate: adds a keyframe of a session to the map, within its client's quota.
        moves: False = move nothing; waiting keyframes count as unavailable.
        expects: number of moves expected soon; they count as waiting, so that the map is not called settled.
        rest_factor: after a move, pause for so many times its duration while keyframes arrive.
    """

    def __init__(
        self,
        volume: "Volume",
        ledger: Ledger,
        folder: Path,
        *,
        integrate: Callable[[Keyframe, bytes], Any],
        is_away: Callable[[], bool],
        say: Callable[[CorrectionProgress], None],
        begin: Callable[[bytes], None] = lambda _session: None,
        moves: bool = True,
        expects: Callable[[], int] = lambda: 0,
        rest_factor: float = REST_FACTOR,
    ) -> None:
        self.moved = 0  # keyframes
        self._volume, self._folder, self.pending = volume, folder, PendingMoves(ledger)
        self._integrate, self._patience, self._say = integrate, ReadPatience(is_away), say
        self._begin, self._moves = begin, moves
        self._expects, self._rest_factor = expects, rest_factor
        self._seconds = 0.0
        self._next = 0.0  # time.monotonic()
        self._said = 0.0
        self._given_up: Counter[str] = Counter()  # by reason

    @property
    def waiting(self) -> int:
        """Number of keyframes whose newest pose is not fused yet."""
        return len(self.pending) if self._moves else 0

    def wait(self, idle: bool) -> float | None:
        """Return the seconds until the next move: 0 when idle, else the rest of a pause; None = never."""
        if not self.waiting:
            return None
        return 0.0 if idle and self._patience.since is None else max(self._next - time.monotonic(), 0.0)

    def progress(self) -> CorrectionProgress:
        """Return the counts of moved, removed and waiting keyframes, as a message."""
        return CorrectionProgress(
            self._volume.keyframes,
            self.pending.ledger.removed,
            self.waiting + self._expects(),
            self.pending.ledger.unavailable + len(self.pending.ledger.wanted) - self.waiting,
            self.moved,
            self._seconds,
            self.pending.ledger.forgotten,
            self.pending.ledger.first_segment,
        )

    def say(self) -> None:
        """Send the counts of moved and waiting keyframes to the gateway."""
        self._said = time.monotonic()
        self._say(self.progress())

    def move(self) -> bool:
        """Do the largest pending move, or give it up; return False if it must be tried again later."""
        move = self.pending.next()
        if move is None:
            return False
        began = time.monotonic()
        try:
            self._fuse_elsewhere(move)
        except (TsfusionError, MemoryError) as error:
            if isinstance(error, JournalError) and self._waits_for(error, move):
                self._next = time.monotonic() + RETRY_S
                return False
            self._give_up(move, error)
        else:
            self.pending.moved()
            self.moved += 1
        self._patience.since = None
        now = time.monotonic()
        self._seconds += now - began
        self._next = now + self._rest_factor * (now - began)
        if not self.waiting or now - self._said > _SAY_INTERVAL:
            self.say()
        return True

    def drop_deleted(self) -> None:
        """Drop the moves of keyframes whose segments were deleted at the journal's size limit."""
        waiting = self.waiting
        with suppress(JournalError):
            if segments := journal.segments(self._folder):
                self.pending.drop_deleted(min(segments))
        if self.waiting != waiting:
            self.say()

    def _fuse_elsewhere(self, move: Move) -> None:
        """Add the keyframe at its new pose and subtract it at its old one; an error changes nothing."""
        found = codec.decode(journal.read(self._folder, move.position).frames)
        if not isinstance(found, Keyframe):
            raise JournalError(f"{self._folder} holds no keyframe where number {move.seq} was")
        self._begin(move.session)
        if move.wanted is not None:
            wanted = replace(found, T_world_camera=move.wanted)
            self._integrate(wanted, move.session)
        if move.fused is not None:
            try:
                self._volume.retract(replace(found, T_world_camera=move.fused))
            except (TsfusionError, MemoryError):
                if move.wanted is not None:
                    self._volume.retract(wanted)
                raise

    def _waits_for(self, error: JournalError, move: Move) -> bool:
        """Return True if a record that cannot be read may come back later, with its folder, file or disk."""
        is_deleted = error.errno == errno.ENOENT and self._is_deleted(move.position.segment)
        return not is_deleted and self._patience.waits(error)

    def _is_deleted(self, segment: int) -> bool:
        """Return True if a segment was deleted at the journal's size limit: the journal begins after it."""
        try:
            return any(number > segment for number in journal.segments(self._folder)[:1])
        except JournalError:
            return False

    def _give_up(self, move: Move, error: Exception) -> None:
        self.pending.give_up()
        reason = type(error).__name__
        self._given_up[reason] += 1
        if self._given_up[reason] == 1:
            log.error(
                "keyframe %d stays where it was fused, though a correction moves it: %s (others for this "
                "reason are only counted)",
                move.seq,
                error,
            )
