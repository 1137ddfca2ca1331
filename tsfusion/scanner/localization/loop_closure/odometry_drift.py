# SPDX-License-Identifier: MIT
"""Uncertainty of odometry, and how it grows along the chain of tracking keyframes."""

from dataclasses import dataclass

import numpy as np

from tsfusion.geometry import se3
from tsfusion.scanner.localization.loop_closure.pose_graph import PoseGraphEdge


@dataclass(frozen=True, kw_only=True)
class OdometryDrift:
    """Standard deviations of odometry over a way; a radian of turning counts as a metre of way."""

    translation: float = 0.02  # metres after one metre; grows with the root of the way
    rotation: float = 0.01  # radians, likewise
    translation_bias: float = 0.01  # systematic error, metres a metre
    rotation_bias: float = 0.002  # radians a metre
    floor: float = 0.002  # metres (and a third of it in radians) of each single step


class OdometryChain:
    """Tracking keyframes in order: odometry's poses, and the motion between any two with its covariance.

    The covariance of a stretch is a difference of two sums in the world's axes: it costs the same over ten
    keyframes and over ten thousand.
    """

    def __init__(self, drift: OdometryDrift) -> None:
        self._drift = drift
        self.poses: dict[int, se3.Transform] = {}  # keyframe → (4, 4) T_world_camera by odometry
        self.edges: list[PoseGraphEdge] = []  # from each to the next, for the pose graph
        self.ways: dict[int, float] = {}  # keyframe → metres and radians along the path since the first
        self._sums: dict[int, se3.Matrix6] = {}  # (6, 6), world axes

    def add(self, number: int, T_world_camera: se3.Transform) -> None:
        """Append a keyframe with its (4, 4) pose by odometry."""
        last = next(reversed(self.poses), None)
        if last is None:
            self.ways[number], self._sums[number] = 0.0, np.zeros((6, 6))
        else:
            step = se3.inverse(self.poses[last]) @ T_world_camera
            way = se3.distance(step) + se3.angle(step)
            d = self._drift
            variances = [d.translation**2 * way + d.floor**2] * 3 + [d.rotation**2 * way + d.floor**2 / 9] * 3
            A = se3.adjoint(T_world_camera)
            self.edges.append(PoseGraphEdge(last, number, step, np.diag(1 / np.array(variances))))
            self.ways[number] = self.ways[last] + way
            self._sums[number] = self._sums[last] + (A * variances) @ A.T
        self.poses[number] = T_world_camera

    def between(self, start: int, end: int) -> tuple[se3.Transform, se3.Matrix6]:
        """`T_start_end` by odometry, and its (6, 6) covariance as a twist in the axes of `end`."""
        T = se3.inverse(self.poses[start]) @ self.poses[end]
        A = se3.adjoint(se3.inverse(self.poses[end]))
        way, d = abs(self.ways[end] - self.ways[start]), self._drift
        forward = 1.0 if self.ways[end] >= self.ways[start] else -1.0
        walk = forward * A @ (self._sums[end] - self._sums[start]) @ A.T
        bias = [(d.translation_bias * way) ** 2] * 3 + [(d.rotation_bias * way) ** 2] * 3
        return T, walk + np.diag(bias)
