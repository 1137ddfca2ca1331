# SPDX-License-Identifier: MIT
"""The journaled records that a map's fuser has not answered, and the fair order in which it gets them."""

import time
from collections import OrderedDict, deque
from collections.abc import Mapping

from tsfusion.fuser.fuser_messages import Fuse, SessionProgress
from tsfusion.gateway.clients.sessions import Session, Sessions
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.records.fuser_time import FuserTime
from tsfusion.gateway.records.keyframe_index import KeyframeIndex


class FuserBacklog:
    """Hand out records of the client that took least of the fuser's time, of each of its sessions in turn.

    Attributes:
        leaving: number of keyframes that a record forgets, by its index.
        last_progress: when the fuser answered, or had nothing to answer (`time.monotonic()`).
    """

    def __init__(self, index: KeyframeIndex, sessions: Sessions) -> None:
        self._index = index
        self._sessions = sessions
        self._queues: OrderedDict[str, deque[Session]] = OrderedDict()  # by owner, the last one served last
        self._time = FuserTime()
        self.leaving: dict[int, int] = {}
        self.last_progress = 0.0
        self._count()

    @property
    def is_empty(self) -> bool:
        return not self.keyframes and not self.corrections

    def _count(self) -> None:
        """Count the keyframes and corrections that are not answered."""
        waiting = [session.entries[session.handed :] for session in self._sessions]
        self.corrections = sum(map(self._index.corrections, waiting))
        self.keyframes = sum(map(len, waiting)) - self.corrections

    def add(self, session: Session, *, is_correction: bool = False) -> None:
        """Add the record of a session that was journaled just now."""
        if self.is_empty:
            self.last_progress = time.monotonic()
        self.keyframes += not is_correction
        self.corrections += is_correction
        self._enqueue(session)

    def on_done(self, index: int, seconds: float) -> None:
        """Take out a record that the fuser answered, after so many seconds of work."""
        self.last_progress = time.monotonic()
        self.leaving.pop(index, None)
        self._time.settle(index, seconds)
        is_correction = self._index[index].is_correction
        self.keyframes -= not is_correction
        self.corrections -= is_correction

    def _enqueue(self, session: Session) -> None:
        if session.handed < len(session.entries):
            queue = self._queues.setdefault(session.owner, deque())
            if session not in queue:
                queue.append(session)

    def restart(self, done: Mapping[bytes, SessionProgress]) -> None:
        """Begin where a new fuser begins, with `done` of each session: hand out all the rest again."""
        self._queues.clear()
        self._time.restart()
        for session in self._sessions:
            progress = done.get(session.key)
            session.in_map = progress.seq if progress else 0
            session.handed = self._index.after(session, progress.seq) if progress else 0
            self._enqueue(session)
        self._count()

    def hand_out(self, fuser: FuserSupervisor) -> None:
        """Hand out as many records as the fuser wants."""
        while self._queues and fuser.wants_work:
            owner = self._time.next_of(self._queues)
            if not self._time.has_room_for(owner):
                return
            queue = self._queues[owner]
            session = queue[0]
            entry = self._index[session.entries[session.handed]]
            order = Fuse(
                entry.index,
                entry.position,
                session.key,
                entry.stamps.seq,
                session.client,
                session.world or "",
                is_correction=entry.is_correction,
                more=len(self._queues) > 1 or session.handed + 1 < len(session.entries) or len(queue) > 1,
            )
            if not fuser.fuse(order):
                return
            self._time.charge(owner, entry.index)
            session.handed += 1
            queue.popleft()
            if session.handed < len(session.entries):
                queue.append(session)
            self._queues.move_to_end(owner)
            if not queue:
                del self._queues[owner]
