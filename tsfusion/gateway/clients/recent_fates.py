# SPDX-License-Identifier: MIT
"""Fates of one client's keyframes in the last minute."""

import time
from collections import deque

_STEP = 5.0  # seconds that one count covers
_STEPS = 12
_FEWEST = 3  # keyframes that say something about a client
_NEARLY_ALL = 0.9
_HELD_AFTER = 10.0  # seconds in which every keyframe was held off
_REASON_CHARACTERS = 200


class RecentFates:
    """Counts of the keyframes of one client: in the map, turned away for good, held off for now."""

    def __init__(self) -> None:
        self._counts: deque[tuple[int, int, int]] = deque(maxlen=_STEPS + 1)  # step, in the map, turned away
        self._why = ""
        self._held_since = self._held_last = 0.0  # `time.monotonic()`; 0 = the last keyframe was taken

    def fused(self) -> None:
        """Count a keyframe that came into the map."""
        self._count(1, 0)

    def turned_away(self, why: str) -> None:
        """Count a keyframe that was refused at the door, or that the map could not take."""
        self._why = why[:_REASON_CHARACTERS]
        self._count(0, 1)

    def _count(self, good: int, bad: int) -> None:
        step = int(time.monotonic() // _STEP)
        if self._counts and self._counts[-1][0] == step:
            _, good_before, bad_before = self._counts.pop()
            good, bad = good + good_before, bad + bad_before
        self._counts.append((step, good, bad))

    def held(self) -> None:
        """Note that a keyframe was held off."""
        self._held_last = time.monotonic()
        self._held_since = self._held_since or self._held_last

    def taken(self) -> None:
        """Note that a keyframe was taken into the journal."""
        self._held_since = 0.0

    def problem(self, hold: str = "") -> str:
        """Reason why next to none of the client's keyframes comes into the map; empty = they do.

        Args:
            hold: why the server held keyframes off the last time; empty = that is no problem of the client.
        """
        now = time.monotonic()
        recent = [one for one in self._counts if one[0] > now // _STEP - _STEPS]
        good, bad = (sum(one[column] for one in recent) for column in (1, 2))
        if bad >= _FEWEST and bad >= _NEARLY_ALL * (good + bad):
            which = "none" if not good else "next to none"
            return f"{which} of its {good + bad} keyframes of the last minute came into the map: {self._why}"
        if hold and self._held_since and now - self._held_since > _HELD_AFTER > now - self._held_last:
            return f"every keyframe is held off: {hold}"
        return ""
