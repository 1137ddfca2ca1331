# SPDX-License-Identifier: MIT
"""Sessions whose keyframes touched the blocks of a map last: the stamps at which the session changed."""

from array import array

import numpy as np
from numpy.typing import NDArray


class TouchedBy:
    """Sessions by the stamp of a keyframe (`Volume.stamp`)."""

    def __init__(self) -> None:
        self._sessions: dict[bytes, int] = {}
        self._firsts = array("q")  # stamps from which on keyframes are of another session than before
        self._numbers = array("q")  # of that session

    def note(self, stamp: int, session: bytes) -> None:
        """Note that keyframes from this stamp on are of a session."""
        number = self._sessions.setdefault(session, len(self._sessions))
        if not self._numbers or self._numbers[-1] != number:
            self._firsts.append(stamp)
            self._numbers.append(number)

    def of(self, stamps: NDArray[np.int32]) -> tuple[tuple[bytes, ...], NDArray[np.int32]]:
        """The sessions of (n,) stamps, and for each the row in them; −1 = not known."""
        if not self._firsts:
            return (), np.full(len(stamps), -1, np.int32)
        run = np.searchsorted(np.array(self._firsts), stamps, side="right") - 1
        numbers = np.where(run >= 0, np.array(self._numbers)[run], -1)
        used, rows = np.unique(numbers, return_inverse=True)
        first = int(np.count_nonzero(used < 0))
        sessions = list(self._sessions)
        return tuple(sessions[one] for one in used[first:]), (rows - first).astype(np.int32)
