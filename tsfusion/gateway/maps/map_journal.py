# SPDX-License-Identifier: MIT
"""Open a map's journal, compare it with the checkpoint, and keep it to its size limit.

Segments are deleted, oldest first, once two checkpoints hold them. A fuser writes most checkpoints by itself.
"""

import logging
import time
from collections.abc import Iterable
from pathlib import Path

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.core.readable_numbers import count_of
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser_messages import Ready
from tsfusion.gateway.clients.client_routes import Sessions
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.records.journaled_records import KeyframeIndex
from tsfusion.journal import Journal, ReadingWatcher, state_folder

_SEGMENTS_KEPT = 4  # segments of a journal with a limit are at most a quarter of that limit
_LONGEST_WAIT = 0.2  # most seconds of a step for a lost segment that is written again


def open_journal(folder: Path, server: ServerConfig, watch: ReadingWatcher) -> Journal:
    """Open the map's journal, with segments small enough to keep it to its limit."""
    segment_bytes = server.segment_bytes
    if server.journal_bytes is not None:
        segment_bytes = min(segment_bytes, server.journal_bytes // _SEGMENTS_KEPT)
    return Journal(
        folder / state_folder.JOURNAL_FOLDER,
        segment_bytes,
        min_free_bytes=server.min_free_bytes,
        longest_wait=_LONGEST_WAIT,
        watch=watch,
    )


def warn_of_shorter_journal(name: str, journal: Journal, sessions: Sessions, ready: Ready) -> None:
    """Log a warning if the checkpoint holds keyframes that the complete journal lacks."""
    shorter = [key for key, done in ready.done.items() if sessions.progress(key)[0] < done.seq]
    if shorter and journal.first == 1:
        log.warning(
            "its checkpoint holds keyframes of %s that its journal %s lacks: was the journal "
            "deleted, or is its disk not mounted? The map cannot be built again from it",
            count_of(len(shorter), "session"),
            journal.folder,
            extra=logs.about(map=name),
        )


def describe_contents(ready: Ready, waiting: int) -> str:
    """Return the contents of a map that was opened in words, for the log.

    Args:
        waiting: number of keyframes of its journal that are not in the map yet.
    """
    if not ready.done and not waiting:
        return "a new map is open"
    rest = f"; {waiting} more are fused from its journal" if waiting else ""
    return f"the map is open, with {count_of(ready.keyframes, 'keyframe')}{rest}"


def find_loss(name: str, journal: Journal, ready: Ready) -> str:
    """Log and return a text about records that neither a checkpoint nor the journal has; empty without."""
    if ready.done or journal.first <= 1:
        return ""
    found = f"its checkpoints are lost, and with them what was journaled before segment {journal.first}"
    log.error("%s", found, extra=logs.about(map=name))
    return found


log = logging.getLogger(__name__)

_SAVE_PAUSE = 10.0  # seconds before a failed checkpoint is tried again
_SAVE_INTERVAL = 10.0  # shortest time between checkpoints ordered only to shorten the journal


class JournalRetention:
    """Deletion of old segments at a journal's size limit; keyframes that two checkpoints lack always stay."""

    def __init__(
        self, journal: Journal, index: KeyframeIndex, sessions: Sessions, max_bytes: int | None
    ) -> None:
        self._journal = journal
        self._index = index
        self._sessions = sessions
        self._max_bytes = max_bytes
        # All segments below these numbers are in the last checkpoint, and in the checkpoint before it.
        self._in_last = self._in_previous = 0
        self._saving = False
        self._saved_at = float("-inf")  # time.monotonic()
        self._expired = 0  # the fuser was told to forget keyframes of lower segments
        self._window_from: int | None = None
        # Segments below these have no keyframe that must still leave the last two checkpoints
        self._window = (0, 0)

    def on_ready(self) -> None:
        """Record that a new fuser began with the last checkpoint."""
        self._expired = 0
        self._saving = False
        self._in_last = self._first_needed()

    def on_saved(self, saved: fuser_messages.Saved) -> None:
        """Record the end of a checkpoint: if it was written, it may allow to delete segments."""
        self._saving = False
        self._saved_at = time.monotonic()
        if saved.written:
            self._in_previous, self._in_last = self._in_last, self._first_needed()
            self._window = (self._window[1], self._window_from or 0)

    def _first_needed(self) -> int:
        """Return the number of the oldest segment with a keyframe that the map does not have."""
        unfused = (
            self._index.segment(session.entries[done])
            for session in self._sessions
            if (done := self._index.after(session, session.in_map)) < len(session.entries)
        )
        return min(unfused, default=self._journal.segment)

    def step(self, fuser: FuserSupervisor, needed: Iterable[int], *, window_from: int | None = None) -> None:
        """Delete segments if the journal is too large. If that is not enough, order a checkpoint.

        Args:
            needed: indices of keyframes that must stay in the index.
            window_from: oldest segment with a keyframe in a map that forgets old keyframes; None for other
                maps. Such a map needs the record of a keyframe to forget it, so it forgets before the segment
                is deleted.
        """
        self._window_from = None if window_from is None else window_from or self._journal.segment
        if self._max_bytes is None or self._journal.nbytes <= self._max_bytes:
            return
        try:
            below = self._in_previous
            if self._window_from is not None:
                below = min(below, *self._window)
                self._expire(fuser, self._window_from)
            self._journal.retire(below, self._max_bytes)
            self._index.forget(self._journal.first, self._sessions, [*needed, *fuser.in_flight])
        except JournalError as error:
            log.warning("%s", error)
        due = not self._saving and time.monotonic() - self._saved_at > _SAVE_INTERVAL
        if due and fuser.ready and self._journal.nbytes > self._max_bytes:
            self._saving = fuser.send(fuser_messages.Save())

    def _expire(self, fuser: FuserSupervisor, window_from: int) -> None:
        """Order the fuser to remove the oldest segment's keyframes from the map, to delete the segment."""
        before = window_from + 1
        is_due = window_from < self._journal.segment and before > self._expired
        if is_due and fuser.ready and fuser.send(fuser_messages.Expire(before)):
            self._expired = before


class CheckpointOrders:
    """Orders for a fuser's checkpoints: after a failed one, after segments were lost, before a map leaves.

    Attributes:
        written: number of checkpoints since the map was opened.
        problem: why no checkpoint can be written; empty without a problem.
        is_answered: True if no checkpoint of `ask` is still to come.
    """

    def __init__(self, fuser: FuserSupervisor, journal: Journal) -> None:
        self._fuser, self._journal = fuser, journal
        self.written = 0
        self.problem = ""
        self.is_answered = True
        self._ask_at = 0.0  # time.monotonic()
        self._missing = 0  # lost segments of the journal at the last order

    def ask(self) -> None:
        """Order a checkpoint now, if the fuser is ready."""
        self.is_answered = not (self._fuser.ready and self._fuser.send(fuser_messages.Save()))

    def on_saved(self, saved: fuser_messages.Saved) -> None:
        """Record that a checkpoint is written, or why not; a failed one is ordered again later."""
        self.is_answered = True
        self.written += saved.written
        self.problem = saved.problem
        self._ask_at = time.monotonic() + _SAVE_PAUSE

    def step(self) -> None:
        """Order a checkpoint if the last one failed some time ago, or journal segments were lost since."""
        now, missing = time.monotonic(), len(self._journal.missing)
        is_due = self.problem and now >= self._ask_at
        if (
            self._fuser.ready
            and (is_due or missing > self._missing)
            and self._fuser.send(fuser_messages.Save())
        ):
            self._ask_at = now + _SAVE_PAUSE
            self._missing = missing
        self._missing = min(self._missing, missing)
