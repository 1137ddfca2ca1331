# SPDX-License-Identifier: MIT
"""Growth of counts, and a bound of it."""

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


class Bucket:
    """A token bucket: `rate` a second on average, `burst` seconds of it at once."""

    def __init__(self, rate: float, now: float, *, burst: float = 2.0) -> None:
        self._rate = rate
        self._level = self._most = burst * rate
        self._then = now

    def wait(self, amount: float, now: float) -> float:
        """Seconds until an amount may pass; one that is larger than the bucket passes when that is full."""
        self._level = min(self._level + (now - self._then) * self._rate, self._most)
        self._then = now
        return max(min(amount, self._most) - self._level, 0.0) / self._rate

    def spend(self, amount: float) -> None:
        """Count an amount that passes now."""
        self._level -= amount
