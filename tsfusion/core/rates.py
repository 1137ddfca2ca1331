# SPDX-License-Identifier: MIT
"""Growth of counts."""

import time
from collections import deque

_WINDOW = 5.0  # seconds over which growth is counted
_SHORTEST = 1.0  # seconds until there is a rate


class Rates:
    """Growth of two counts a second, over the last seconds; None = too short a time to tell.

    Counts that fall are those of something new, and begin anew.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[float, int, int]] = deque()

    def __call__(self, first: int, second: int) -> tuple[float | None, float | None]:
        """Take the counts of now, and return how much each grows a second."""
        now = time.monotonic()
        if self._samples and (first < self._samples[-1][1] or second < self._samples[-1][2]):
            self._samples.clear()
        self._samples.append((now, first, second))
        while len(self._samples) > 2 and now - self._samples[0][0] > _WINDOW:
            self._samples.popleft()
        then, first_then, second_then = self._samples[0]
        seconds = now - then
        if seconds < _SHORTEST:
            return None, None
        return (first - first_then) / seconds, (second - second_then) / seconds
