# SPDX-License-Identifier: MIT
"""Received poses by time, in bounded memory."""

from array import array
from bisect import bisect_left

import numpy as np

from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import Trajectory, quaternion

_NUMBERS = 7  # translation and quaternion; all NaN where the sender was lost


class PoseHistory:
    """At most `limit` poses and losses, sorted by timestamp; 64 bytes each. The oldest are forgotten."""

    def __init__(self, limit: int = 100_000) -> None:
        self._limit = limit
        self._stamps = array("q")
        self._numbers = array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def last_ns(self) -> int:
        """Latest timestamp; the history must not be empty."""
        return self._stamps[-1]

    def add(self, stamp_ns: int, T: Transform | None) -> None:
        """Add a pose, or None for a loss; an entry with the same timestamp is replaced."""
        row = array("d", [np.nan] * _NUMBERS if T is None else [*T[:3, 3], *quaternion(T[:3, :3])])
        at = bisect_left(self._stamps, stamp_ns)
        if at < len(self) and self._stamps[at] == stamp_ns:
            self._numbers[_NUMBERS * at : _NUMBERS * (at + 1)] = row
            return
        self._stamps.insert(at, stamp_ns)
        self._numbers[_NUMBERS * at : _NUMBERS * at] = row
        if len(self) > self._limit:
            oldest = self._limit // 10 or 1
            del self._stamps[:oldest], self._numbers[: _NUMBERS * oldest]

    def at(self, stamp_ns: int, *, max_gap_ns: int) -> Transform | None:
        """Pose at a time, interpolated between its neighbours as `Trajectory.at` does; None = unknown."""
        right = bisect_left(self._stamps, stamp_ns)
        neighbours = [k for k in (right - 1, right) if 0 <= k < len(self)]
        rows = np.array([self._numbers[_NUMBERS * k : _NUMBERS * (k + 1)] for k in neighbours])
        known = [not np.isnan(row).any() for row in rows]
        if not any(known):
            return None
        stamps = np.array([self._stamps[k] for k in neighbours], dtype=np.int64)
        return Trajectory(stamps[known], rows[known, :3], rows[known, 3:]).at(stamp_ns, max_gap_ns=max_gap_ns)

    def decided(self, stamp_ns: int, *, max_gap_ns: int) -> bool:
        """Whether later messages cannot change the pose: there is an entry at the time or soon after it."""
        right = bisect_left(self._stamps, stamp_ns)
        return right < len(self) and self._stamps[right] - stamp_ns <= max_gap_ns
