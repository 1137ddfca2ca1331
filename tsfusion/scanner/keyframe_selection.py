# SPDX-License-Identifier: MIT
"""Select the frames that become keyframes of the map. (A tracker has other keyframes, for odometry.)"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import ScanConfig
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame

INDOORS, OUTDOORS = 0.1, 2.0  # metres between keyframes
_STRIDE = 16  # the overlap is computed for every 16th pixel in each direction


class Selector(Protocol):
    """Rule that decides which frames become keyframes."""

    def reason(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> str | None:
        """Return the reason why the frame becomes a keyframe, in one word, or None if it does not."""

    def accept(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> None:
        """Note that the frame was taken as a keyframe: later frames are compared with it."""

    def reset(self) -> None:
        """Forget the last keyframe: the next frame is the first of a new world (coordinate frame)."""


class KeyframeSelector:
    """Select frames that see enough new surface.

    A frame becomes a keyframe when one of three things happened since the last keyframe: the sensor moved by
    `distance`, it turned by `angle`, or less than `min_overlap` of the last keyframe's pixels with depth lie
    in the new view. Keyframes come no faster than `max_rate`. Stereo pairs and points have no overlap. A
    pair's depth is not known yet; points have depth on all sides.

    Args:
        config: the rules.
        outdoors: True sets `distance` to 2 m instead of 0.1 m, unless the config gives a distance.
    """

    def __init__(self, config: ScanConfig, *, outdoors: bool) -> None:
        self._config = config
        self._distance = config.distance or (OUTDOORS if outdoors else INDOORS)
        self._last: tuple[NDArray[np.float64], int] | None = None
        self._overlap: Callable[[NDArray[np.float64]], float] | None = None

    def reason(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> str | None:
        """Return the selecting rule, `first`, `distance`, `angle` or `overlap`, or None if none selects."""
        if self._last is None:
            return "first"
        T_world_last, stamp = self._last
        rate = self._config.max_rate
        if rate is not None and 0 <= frame.timestamp_ns - stamp < 1e9 / rate:
            return None
        T_last_now = se3.inverse(T_world_last) @ T_world_camera
        if se3.distance(T_last_now) >= self._distance:
            return "distance"
        if np.degrees(se3.angle(T_last_now)) >= self._config.angle:
            return "angle"
        if self._overlap is not None and self._overlap(se3.inverse(T_last_now)) < self._config.min_overlap:
            return "overlap"
        return None

    def accept(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> None:
        self._last = (T_world_camera, frame.timestamp_ns)
        self._overlap = _overlap(frame)

    def reset(self) -> None:
        self._last = self._overlap = None


class EveryFrame:
    """Selector for a replay: each of its frames was a keyframe before."""

    def reason(self, _frame: Frame, _T_world_camera: NDArray[np.float64]) -> str:
        return "every"

    def accept(self, _frame: Frame, _T_world_camera: NDArray[np.float64]) -> None:
        pass

    def reset(self) -> None:
        pass


def _overlap(frame: Frame) -> Callable[[NDArray[np.float64]], float] | None:
    """Return a function from `T_now_last` to the share of this frame's pixels that a new view sees."""
    K, depth = frame.intrinsics, frame.depth_m
    if depth is None or K is None:
        return None
    height, width = depth.shape
    z = depth[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE].astype(np.float64)
    v, u = np.nonzero(z)
    z = z[v, u]
    if not len(z):
        return None
    u, v = u * _STRIDE + _STRIDE // 2, v * _STRIDE + _STRIDE // 2
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)

    def overlap(T_now_last: NDArray[np.float64]) -> float:
        x, y, z = se3.apply(T_now_last, points).T
        ahead = z > 0
        column, row = K.fx * x[ahead] / z[ahead] + K.cx, K.fy * y[ahead] / z[ahead] + K.cy
        inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
        return float(inside.sum() / len(points))

    return overlap
