# SPDX-License-Identifier: MIT
"""Poses as they come in from elsewhere, by time; the oldest are forgotten."""

from array import array
from bisect import bisect_left

import numpy as np

from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import Trajectory, quaternion

_NUMBERS = 7  # translation and quaternion; all NaN says that the sender was lost


class PoseHistory:
    """At most `limit` poses and losses, sorted by stamp; 64 bytes each."""

    def __init__(self, limit: int = 100_000) -> None:
        self._limit = limit
        self._stamps = array("q")
        self._numbers = array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def last_ns(self) -> int:
        """The latest stamp. Only where there is one."""
        return self._stamps[-1]

    def add(self, stamp_ns: int, T: Transform | None) -> None:
        """A pose, or None for lost; a stamp that is there already is replaced."""
        row = array("d", [np.nan] * _NUMBERS if T is None else [*T[:3, 3], *quaternion(T[:3, :3])])
        at = bisect_left(self._stamps, stamp_ns)
        if at < len(self) and self._stamps[at] == stamp_ns:
            self._numbers[_NUMBERS * at : _NUMBERS * (at + 1)] = row
            return
        self._stamps.insert(at, stamp_ns)
        self._numbers[_NUMBERS * at : _NUMBERS * at] = row
        if len(self) > self._limit:
            gone = self._limit // 10 or 1
            del self._stamps[:gone], self._numbers[: _NUMBERS * gone]

    def at(self, stamp_ns: int, *, max_gap_ns: int) -> Transform | None:
        """The pose at a time, interpolated between its neighbours as `Trajectory.at` does; None = unknown."""
        right = bisect_left(self._stamps, stamp_ns)
        neighbours = [k for k in (right - 1, right) if 0 <= k < len(self)]
        rows = np.array([self._numbers[_NUMBERS * k : _NUMBERS * (k + 1)] for k in neighbours])
        known = [not np.isnan(row).any() for row in rows]
        if not any(known):
            return None
        stamps = np.array([self._stamps[k] for k in neighbours], dtype=np.int64)
        return Trajectory(stamps[known], rows[known, :3], rows[known, 3:]).at(stamp_ns, max_gap_ns=max_gap_ns)

    def decided(self, stamp_ns: int, *, max_gap_ns: int) -> bool:
        """Whether what is to come cannot add to the answer: there is word from at or soon after the time."""
        right = bisect_left(self._stamps, stamp_ns)
        return right < len(self) and self._stamps[right] - stamp_ns <= max_gap_ns
