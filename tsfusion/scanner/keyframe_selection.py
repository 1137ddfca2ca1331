# SPDX-License-Identifier: MIT
"""Selection of the map's keyframes. (Trackers have keyframes of their own.)"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import ScanConfig
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame

INDOORS, OUTDOORS = 0.1, 2.0  # metres between keyframes
_STRIDE = 16  # pixels between those whose overlap is computed


class Selector(Protocol):
    """Rule that chooses keyframes."""

    def reason(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> str | None:
        """Reason why the frame is one, in a word; None = it is not."""

    def accept(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> None:
        """Make the frame the last keyframe."""

    def reset(self) -> None:
        """Make the next frame the first of a new world."""


class KeyframeSelector:
    """Select frames that see enough new surface.

    A frame becomes a keyframe when less than `min_overlap` of the last keyframe's pixels (those with a depth)
    lie in its view, or the sensor has moved by `distance` or turned by `angle` since, but not sooner than
    `max_rate` allows.
    Stereo pairs and points have no overlap: their depth is unknown yet, or on all sides.

    Args:
        config: the rules.
        outdoors: whether `distance` is 2 m where the config leaves it open, instead of 0.1 m.
    """

    def __init__(self, config: ScanConfig, *, outdoors: bool) -> None:
        self._config = config
        self._distance = config.distance or (OUTDOORS if outdoors else INDOORS)
        self._last: tuple[NDArray[np.float64], int] | None = None
        self._overlap: Callable[[NDArray[np.float64]], float] | None = None

    def reason(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> str | None:
        """Rule that selects the frame: `first`, `distance`, `angle` or `overlap`; None = not selected."""
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
        """Make the frame the last keyframe, which the next ones are compared with."""
        self._last = (T_world_camera, frame.timestamp_ns)
        self._overlap = _overlap(frame)

    def reset(self) -> None:
        """Make the next frame the first of a new world."""
        self._last = self._overlap = None


class EveryFrame:
    """Selector of a replay, whose frames are keyframes already."""

    def reason(self, _frame: Frame, _T_world_camera: NDArray[np.float64]) -> str:
        return "every"

    def accept(self, _frame: Frame, _T_world_camera: NDArray[np.float64]) -> None:
        pass

    def reset(self) -> None:
        pass


def _overlap(frame: Frame) -> Callable[[NDArray[np.float64]], float] | None:
    """Function from T_now_last to the share of this frame's pixels that are in the view from there."""
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
