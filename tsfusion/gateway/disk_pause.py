# SPDX-License-Identifier: MIT
"""The time in which a map takes no keyframes because its disk refuses them."""

import logging
import time

from tsfusion.core import logs
from tsfusion.core.errors import MISSING, JournalError
from tsfusion.gateway.problems import Problem
from tsfusion.journal import Journal

log = logging.getLogger(__name__)

_DISK_PAUSE = 1.0  # seconds without keyframes after the disk refused one, and between two looks at it


class DiskPause:
    """The time after the disk refused a keyframe, in which no other is tried."""

    def __init__(self, journal: Journal, map_name: str) -> None:
        self.problem = ""  # why no keyframe is taken; empty = they are
        self.is_away = False  # the journal's folder is not to be found
        self._journal = journal
        self._map = map_name
        self._until = self._look_at = 0.0  # time.monotonic()
        self._shows = False  # whether a look at the disk shows the problem, and so its end

    def seconds_left(self, now: float) -> float:
        """Seconds until a keyframe is tried again; 0 = none has to wait."""
        return max(self._until - now, 0.0)

    def begin(self, error: JournalError) -> None:
        """Pause because of an error."""
        if Problem(str(error)).key != Problem(self.problem).key:  # the same one is logged once
            log.error("no keyframes are taken: %s", error, extra=logs.about(map=self._map))
        self.problem = str(error)
        self.is_away = error.errno in MISSING
        self._shows = self.is_away or error.errno is None
        self._until = self._look_at = time.monotonic() + _DISK_PAUSE

    def end(self) -> None:
        """Take keyframes (again)."""
        if self.problem:
            log.warning("keyframes are taken again", extra=logs.about(map=self._map))
            self.problem, self.is_away, self._shows = "", False, False

    def step(self) -> None:
        """Look once a second whether the disk would take a keyframe, though none comes.

        Clients may wait for the end of a pause, and a person is to be told before the next scan.
        """
        if time.monotonic() >= self._look_at:
            self.look()

    def look(self) -> None:
        """Look now whether the disk would take a keyframe."""
        self._look_at = time.monotonic() + _DISK_PAUSE
        try:
            self._journal.check()
        except JournalError as error:
            self.begin(error)
            self._shows = True
        else:
            self._until = 0.0
            if self._shows:  # else only the next keyframe can tell
                self.end()
