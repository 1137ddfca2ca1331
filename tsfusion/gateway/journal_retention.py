# SPDX-License-Identifier: MIT
"""Keeps a map's journal to its limit: what two checkpoints hold may go, oldest first."""

import logging
import time
from collections.abc import Iterable

from tsfusion.core.errors import JournalError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.keyframe_index import KeyframeIndex
from tsfusion.gateway.sessions import Sessions
from tsfusion.journal import Journal

log = logging.getLogger(__name__)

_SAVE_INTERVAL = 10.0  # seconds between checkpoints that are made only for the journal's sake


class JournalRetention:
    """Call `step` for ever. The limit is passed only by what came since the checkpoint before the last."""

    def __init__(
        self, journal: Journal, index: KeyframeIndex, sessions: Sessions, max_bytes: int | None
    ) -> None:
        self._journal = journal
        self._index = index
        self._sessions = sessions
        self._max_bytes = max_bytes
        self._covered = self._covering = 0  # segments below: in the checkpoint before the last, in the last
        self._saving = False
        self._saved = float("-inf")

    def on_ready(self) -> None:
        """A fuser has begun, at the last checkpoint."""
        self._saving = False
        self._covering = self._coverage()

    def on_saved(self, saved: fuser_messages.Saved) -> None:
        """The fuser wrote a checkpoint, or did not have to."""
        self._saving = False
        self._saved = time.monotonic()
        if saved.written:
            self._covered, self._covering = self._covering, self._coverage()

    def _coverage(self) -> int:
        """The segments below this one hold only keyframes that the map has."""
        unfused = (
            self._index.segment(session.entries[done])
            for session in self._sessions
            if (done := self._index.after(session, session.in_map)) < len(session.entries)
        )
        return min(unfused, default=self._journal.segment)

    def step(self, fuser: FuserSupervisor, needed: Iterable[int]) -> None:
        """Make room where there is need and it can be made.

        Args:
            needed: indices of keyframes that somebody will ask for.
        """
        if self._max_bytes is None or self._journal.nbytes <= self._max_bytes:
            return
        try:
            self._journal.retire(self._covered, self._max_bytes)
            self._index.forget(self._journal.first, self._sessions, [*needed, *fuser.in_flight])
        except JournalError as error:
            log.warning("%s", error)
        due = not self._saving and time.monotonic() - self._saved > _SAVE_INTERVAL
        if due and fuser.ready and self._journal.nbytes > self._max_bytes:
            self._saving = fuser.send(fuser_messages.Save())
