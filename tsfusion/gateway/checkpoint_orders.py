# SPDX-License-Identifier: MIT
"""Checkpoints that the gateway asks a map's fuser for, beside those that it writes by itself."""

import time

from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway.fuser_supervisor import FuserSupervisor
from tsfusion.journal import Journal

_SAVE_PAUSE = 10.0  # seconds until a checkpoint is tried again that could not be written


class CheckpointOrders:
    """Ask again where a checkpoint failed, where segments of the journal have gone, and before a map leaves.

    Attributes:
        written: number of checkpoints since the map was opened.
        problem: why none can be written; empty = one can.
        is_answered: nothing that `ask` asked for is to come any more.
    """

    def __init__(self, fuser: FuserSupervisor, journal: Journal) -> None:
        self._fuser, self._journal = fuser, journal
        self.written = 0
        self.problem = ""
        self.is_answered = True
        self._ask_at = 0.0  # time.monotonic()
        self._missing = 0  # segments of the journal that were missing when one was asked for

    def ask(self) -> None:
        """Have one written now, if there is a fuser."""
        self.is_answered = not (self._fuser.ready and self._fuser.send(fuser_messages.Save()))

    def on_saved(self, saved: fuser_messages.Saved) -> None:
        """Take what the fuser says of one."""
        self.is_answered = True
        self.written += saved.written
        self.problem = saved.problem
        self._ask_at = time.monotonic() + _SAVE_PAUSE

    def step(self) -> None:
        """Ask for one where that is due."""
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
