# SPDX-License-Identifier: MIT
"""Corrections of another SLAM's poses, moved to the tracking keyframes they lie between."""

from array import array
from bisect import bisect_left, bisect_right

import numpy as np

from tsfusion.geometry import se3
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import Trajectory, quaternion
from tsfusion.scanner.localization.localizer import PoseCorrections
from tsfusion.scanner.localization.pose_feed.feed_messages import FeedCorrections

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
        """True if later messages cannot change the pose: there is an entry at the time or soon after it."""
        right = bisect_left(self._stamps, stamp_ns)
        return right < len(self) and self._stamps[right] - stamp_ns <= max_gap_ns


class MapDeformation:
    """Motion of odometry's world by corrected poses, as a function of time.

    At each corrected timestamp it is the corrected pose times the inverse of the pose sent before. Between
    two timestamps it is interpolated; before the first and after the last it is constant.
    """

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._moves: list[se3.Transform] = []
        self._T_corrected_world = np.eye(4)
        self._loops = 0
        self._is_new = False
        self._anchors: dict[int, tuple[int, se3.Transform]] = {}
        self._revision = 0

    def add(self, anchor: int, stamp_ns: int, T_world_camera: se3.Transform) -> None:
        """Add a tracking keyframe."""
        self._anchors[anchor] = stamp_ns, T_world_camera

    def apply(self, corrected: FeedCorrections, history: PoseHistory, max_gap_ns: int) -> int:
        """Apply new corrections; return the number of their timestamps without a known pose."""
        before = [history.at(stamp, max_gap_ns=max_gap_ns) for stamp in corrected.stamps_ns]
        known = [
            (stamp, after @ se3.inverse(T))
            for stamp, after, T in zip(corrected.stamps_ns, corrected.poses, before, strict=True)
            if T is not None
        ]
        unknown = len(corrected.stamps_ns) - len(known)
        if known or corrected.T_corrected_world is not None:
            self._stamps, self._moves = [stamp for stamp, _ in known], [move for _, move in known]
            last = self._moves[-1] if known else np.eye(4)
            self._T_corrected_world = (
                last if corrected.T_corrected_world is None else corrected.T_corrected_world
            )
            self._loops, self._is_new = corrected.loops, True
        return unknown

    def new_corrections(self) -> PoseCorrections | None:
        """Corrected poses of all tracking keyframes since `reset`; None if they were returned before."""
        if not self._is_new:
            return None
        self._is_new, self._revision = False, self._revision + 1
        return PoseCorrections(
            revision=self._revision,
            anchors={
                number: se3.nearest(self._move(stamp) @ T) for number, (stamp, T) in self._anchors.items()
            },
            T_corrected_world=self._T_corrected_world,
            loops=self._loops,
        )

    def reset(self) -> None:
        """Forget the tracking keyframes; the corrections stay."""
        self._anchors.clear()
        self._revision = 0

    def _move(self, stamp_ns: int) -> se3.Transform:
        if not self._moves:
            return self._T_corrected_world
        right = bisect_right(self._stamps, stamp_ns)
        if right == len(self._stamps):
            return self._T_corrected_world if stamp_ns > self._stamps[-1] else self._moves[-1]
        if right == 0:
            return self._moves[0]
        begin, end = self._stamps[right - 1], self._stamps[right]
        share = (stamp_ns - begin) / (end - begin)
        step = se3.log(self._moves[right] @ se3.inverse(self._moves[right - 1]))
        return se3.exp(share * step) @ self._moves[right - 1]
