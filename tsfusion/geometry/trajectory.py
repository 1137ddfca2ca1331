# SPDX-License-Identifier: MIT
"""Interpolate poses over time, and convert rotations to and from quaternions."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.se3 import Transform, transform

PoseAt = Callable[[int], Transform | None]  # (4, 4) at a time in nanoseconds; None = not known
_EXACT_NS = 1_000_000  # nanoseconds; a pose this near is used without interpolation


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses in time order.

    Attributes:
        timestamps_ns: (n,) int64, strictly increasing.
        translations: (n, 3) float64, metres; NaN = unknown pose.
        quaternions: (n, 4) float64, x y z w, unit length, or NaN.
    """

    timestamps_ns: NDArray[np.int64]
    translations: NDArray[np.float64]
    quaternions: NDArray[np.float64]

    @classmethod
    def of(cls, timestamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> "Trajectory":
        """Make a trajectory from (n, 4, 4) poses; NaN = unknown pose."""
        return cls(timestamps_ns, poses[:, :3, 3], np.array([quaternion(T[:3, :3]) for T in poses]))

    def at(self, timestamp_ns: int, *, max_gap_ns: int) -> Transform | None:
        """Interpolate the pose at a time between its neighbours (SLERP and linear), never beyond the ends.

        Return None if the neighbours are more than `max_gap_ns` apart and none is within a millisecond, or if
        a neighbour is unknown.
        """
        stamps = self.timestamps_ns
        right = int(np.searchsorted(stamps, timestamp_ns))
        nearest = min(
            (i for i in (right - 1, right) if 0 <= i < len(stamps)),
            key=lambda i: abs(int(stamps[i]) - timestamp_ns),
        )
        if right in (0, len(stamps)) or stamps[right] - stamps[right - 1] > max_gap_ns:
            near = abs(int(stamps[nearest]) - timestamp_ns) <= _EXACT_NS
            return _known(self.quaternions[nearest], self.translations[nearest]) if near else None
        share = (timestamp_ns - stamps[right - 1]) / (stamps[right] - stamps[right - 1])
        t = (1 - share) * self.translations[right - 1] + share * self.translations[right]
        between = _known(slerp(self.quaternions[right - 1], self.quaternions[right], share), t)
        if between is None and stamps[right] == timestamp_ns:
            return _known(self.quaternions[right], self.translations[right])
        return between

    def positions(self, times_ns: NDArray[np.float64], *, max_gap_s: float) -> NDArray[np.float64]:
        """Interpolate translations at (n,) times: (n, 3), NaN in holes, longer gaps and beyond the ends."""
        stamps = self.timestamps_ns
        right = np.clip(np.searchsorted(stamps, times_ns), 1, len(stamps) - 1)
        begin, end = stamps[right - 1, None], stamps[right, None]
        share = (times_ns[:, None] - begin) / (end - begin)
        found = (1 - share) * self.translations[right - 1] + share * self.translations[right]
        return np.where((share < 0) | (share > 1) | (end - begin > max_gap_s * 1e9), np.nan, found)


def _known(quaternion: NDArray[np.float64], translation: NDArray[np.float64]) -> Transform | None:
    return rigid(quaternion, translation) if np.isfinite(quaternion).all() else None


def slerp(q0: NDArray[np.float64], q1: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Interpolate between unit quaternions: `share` of the shorter way from `q0` to `q1` (SLERP)."""
    cosine = float(q0 @ q1)
    if cosine < 0:
        q1, cosine = -q1, -cosine
    if cosine > 0.9999995:  # the sine below would lose its digits
        mixed = (1 - share) * q0 + share * q1
    else:
        angle = np.arccos(cosine)
        mixed = (np.sin((1 - share) * angle) * q0 + np.sin(share * angle) * q1) / np.sin(angle)
    unit: NDArray[np.float64] = mixed / np.linalg.norm(mixed)
    return unit


def rigid(quaternion: NDArray[np.float64], translation: NDArray[np.float64]) -> Transform:
    """Make a (4, 4) transform from a unit quaternion (x y z w) and a translation."""
    x, y, z, w = quaternion
    R = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return transform(R, translation)


def quaternion(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a (3, 3) rotation to a (4,) unit quaternion x y z w with w >= 0."""
    # The largest of the four squares is at least 1/4: dividing by its root loses no digits.
    squares = np.array(
        [
            1 + R[0, 0] - R[1, 1] - R[2, 2],
            1 - R[0, 0] + R[1, 1] - R[2, 2],
            1 - R[0, 0] - R[1, 1] + R[2, 2],
            1 + R[0, 0] + R[1, 1] + R[2, 2],
        ]
    )
    k = int(squares.argmax())
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    rows = ((squares[0], xy, xz, x), (xy, squares[1], yz, y), (xz, yz, squares[2], z), (x, y, z, squares[3]))
    unit: NDArray[np.float64] = np.array(rows[k]) / np.linalg.norm(rows[k])
    return -unit if unit[3] < 0 else unit
