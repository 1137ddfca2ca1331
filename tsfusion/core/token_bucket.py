# SPDX-License-Identifier: MIT
"""A rate with bursts."""


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
