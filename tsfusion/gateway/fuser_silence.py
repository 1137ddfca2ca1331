# SPDX-License-Identifier: MIT
"""Time for which a fuser process has owed an answer, and how much of that time it could work."""

import time

from tsfusion.core import process

_INTERVAL = 0.25  # seconds between two looks
_LONGEST_STEP = 1.0  # seconds that one look counts: what is beyond them, the gateway itself stood still


class FuserSilence:
    """Seconds since a process answered, by what it could do in them. Call `look` again and again.

    A process that is stopped (SIGSTOP, a debugger) or that waits for a disk does nothing, so that no keyframe
    is to blame. Nor is one while the gateway stands still, too: the machine or the container was suspended.

    Args:
        pid: of the process.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._looked = time.monotonic()
        self.answered()

    def answered(self) -> None:
        """Begin anew: the process has said something, or owes nothing."""
        self.working = self.stopped = self.disk = 0.0

    def look(self, *, owes: bool) -> None:
        """Count the seconds since the last look.

        Args:
            owes: whether the process has to answer something. One that is stopped is noticed anyway.
        """
        now = time.monotonic()
        if now - self._looked < _INTERVAL:
            return
        step, self._looked = min(now - self._looked, _LONGEST_STEP), now
        state = process.state(self._pid)
        if state in ("T", "t"):
            self.stopped += step
            return
        self.stopped = 0.0
        if not owes:
            self.answered()
        elif state == "D":
            self.disk += step
        else:
            self.working += step
