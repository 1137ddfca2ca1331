# SPDX-License-Identifier: MIT
"""Condition of a map: in a word, in lines for a person, and in numbers, with its questions."""

import time
from collections import Counter, deque
from typing import Literal

import numpy as np

from tsfusion.core.readable_numbers import count_of
from tsfusion.gateway.checkpoint_orders import CheckpointOrders
from tsfusion.gateway.disk_pause import DiskPause
from tsfusion.gateway.fuser_backlog import FuserBacklog
from tsfusion.gateway.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.keyframe_outcomes import KeyframeOutcomes
from tsfusion.gateway.sessions import Sessions
from tsfusion.journal import Journal
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire import keyframe_times
from tsfusion.wire.health import MapHealth, MapState
from tsfusion.wire.keyframe_times import Spread
from tsfusion.wire.mesh_updates import MeshUpdate

_FOR_GONE = "what no checkpoint holds of them is lost, unless they are put back"
_STALLED_AFTER = 10.0  # seconds in which keyframes wait and none is fused
_NEWEST = 1024  # answers, whose delays count
# refused: not passed on to the fuser; late: their time was over; failed: the fuser could not
Outcome = Literal["answered", "refused", "late", "failed"]


class QuestionCounts:
    """The figures of one map."""

    def __init__(self) -> None:
        self.by_outcome: Counter[str] = Counter()
        self._delays_ms: deque[float] = deque(maxlen=_NEWEST)

    def add(self, outcome: Outcome, seconds: float | None = None) -> None:
        """Count a question; with the seconds that its answer took."""
        self.by_outcome[outcome] += 1
        if seconds is not None:
            self._delays_ms.append(1e3 * seconds)

    @property
    def delay_ms(self) -> Spread:
        """From when the newest questions came to when their answers left, milliseconds."""
        return keyframe_times.spread(np.array(self._delays_ms))


class MapCondition:
    """Condition of an open map, whose parts are given.

    Attributes:
        warm: the fuser has been ready once: from then on it is known what the map has.
        moved: when the fuser answered, or had nothing to answer (`time.monotonic()`).
        last_keyframe: when the last one came (likewise); None = none did.
        loss: what is neither in a checkpoint nor in the journal; empty = nothing.
        newest_mesh: that viewers were told of; None = there is none.
    """

    def __init__(
        self,
        fuser: FuserSupervisor,
        journal: Journal,
        quarantine: Quarantine,
        *,
        disk: DiskPause,
        sessions: Sessions,
        backlog: FuserBacklog,
        outcomes: KeyframeOutcomes,
        checkpoints: CheckpointOrders,
        questions: QuestionCounts,
    ) -> None:
        self._fuser, self._journal, self._quarantine, self._disk = fuser, journal, quarantine, disk
        self._sessions, self._backlog, self._outcomes = sessions, backlog, outcomes
        self._checkpoints, self._questions = checkpoints, questions
        self.warm = False
        self.moved = 0.0
        self.last_keyframe: float | None = None
        self.loss = ""
        self.newest_mesh: MeshUpdate | None = None

    @property
    def drained(self) -> bool:
        """Whether the map has every keyframe of the journal, where the newest correction of it says."""
        return self._fuser.idle and self._backlog.is_empty and not self._outcomes.moves.waiting

    @property
    def state(self) -> MapState:
        """The state in a word."""
        if self._fuser.failed:
            return "failed"
        if not self.warm or self._fuser.waits:
            return "opening"
        if not self._fuser.ready:
            return "restarting"
        return "idle" if self.drained else "busy"

    @property
    def problem(self) -> str:
        """Reason why keyframes are not accepted or not fused, and what to do; empty = they are."""
        if problem := self._disk.problem or self._fuser.problem:
            return problem
        stalled = self.warm and not self._backlog.is_empty and time.monotonic() - self.moved > _STALLED_AFTER
        if stalled and self._fuser.ready:
            return "keyframes wait and none is fused: its fuser makes a mesh or a checkpoint, or it hangs"
        return "keyframes wait, and its fuser is still starting again: read the log" if stalled else ""

    @property
    def notices(self) -> list[str]:
        """Problems that a person should know of, though keyframes are taken and will be fused."""
        damaged, put_back = self._journal.damaged, self._journal.put_back
        lost = count_of(damaged, "keyframe of its journal is", "keyframes of its journal are")
        notices = [f"{lost} damaged and lost"] if damaged else []
        if absent := self._journal.absent:
            gone = count_of(absent, "segment of its journal was", "segments of its journal were")
            notices.append(f"{gone} not there at the start: {_FOR_GONE}")
        if missing := self._journal.missing:
            first = f"{missing[0]:06d}.mcap"
            gone = count_of(len(missing), "segment of its journal is", "segments of its journal are")
            notices.append(f"{gone} gone, first {first}: {_FOR_GONE}")
        if put_back:
            notices.append(
                f"its journal was taken away while it was written to, {count_of(put_back, 'time')}, and was "
                "put back with every keyframe: find out who deletes or moves files there"
            )
        if self._checkpoints.problem:
            notices.append(f"no checkpoint can be written: {self._checkpoints.problem}")
        if self.state == "restarting" and not self.problem:
            notices.append("its fuser ended, and another one takes over: the log says why")
        notices += filter(None, (self._quarantine.problem, self.loss))
        return [*notices, *self._outcomes.notices.values()]

    def health(self, corrections: int, corrections_waiting: int) -> MapHealth:
        """Health of the map, as far as it is known without asking the fuser.

        Args:
            corrections: in the journal.
            corrections_waiting: keyframes that they have still to move, or to take away.
        """
        now, outcomes = time.monotonic(), self._outcomes
        return MapHealth(
            state=self.state,
            problem=self.problem,
            keyframes_durable=outcomes.taken + outcomes.rejected.total() + self._backlog.keyframes,
            keyframes_fused=outcomes.fused,
            waiting=self._backlog.keyframes,
            rejected=dict(outcomes.rejected),
            quarantined=len(self._quarantine),
            sessions=self._sessions.of_clients,
            journal_bytes=self._journal.nbytes,
            journal_damaged=self._journal.damaged,
            fuser_restarts=self._fuser.restarts,
            blocks=outcomes.blocks,
            map_bytes=outcomes.map_bytes,
            last_keyframe_s=None if self.last_keyframe is None else max(now - self.last_keyframe, 0.0),
            delay_ms=outcomes.delays.summary(),
            delay_bound_ms=outcomes.delays.bound_ms,
            corrections=corrections,
            corrections_waiting=corrections_waiting,
            corrections_unavailable=outcomes.moves.unavailable,
            keyframes_moved=outcomes.moves.moved,
            moving_s=outcomes.moves.seconds,
            keyframes_forgotten=outcomes.moves.forgotten,
            checkpoints=self._checkpoints.written,
            journal_missing=self._journal.absent + len(self._journal.missing),
            journal_put_back=self._journal.put_back,
            fusing_s=self._fuser.seconds_at_work,
            questions=dict(self._questions.by_outcome),
            question_ms=self._questions.delay_ms,
            mesh_epoch=self.newest_mesh.epoch if self.newest_mesh else "",
            mesh_number=self.newest_mesh.number if self.newest_mesh else 0,
        )
