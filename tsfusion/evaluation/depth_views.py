# SPDX-License-Identifier: MIT
"""Measured surfaces that others can be compared with: how far do moved points lie from what a frame saw?"""

from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.stereo_matching import Matcher

_POINTS = 800  # of a frame that are moved
_TOLERANCE = 0.02  # of the depth
_FLOOR = 0.004  # metres, and
_DISPARITY = 1.0  # pixels: what two good measurements may differ by
_JUMP = 0.05  # between neighbouring pixels, of the depth: an edge, which neither camera sees alike
_HALF = 0.5
_STEREO_WIDTH = 500  # above it a pair is halved before it is matched
_LIDAR_FLOOR = 0.04  # metres
_CELL = 0.01  # of the range: points of a scan closer than that count as one
_GROUND = 0.03  # of the range: thickness of the slice that holds the ground
_FLAT = 0.25  # share of the points in one such slice that makes it the ground
_FARTHEST = 1e6  # metres: beyond it no LiDAR measures
_TREE = 20_000  # points of a scan that others are compared with
_EXACT_TREE = 4  # FLANN_INDEX_KDTREE_SINGLE


class DepthView(Protocol):
    """A frame's measurement.

    Attributes:
        points: (n, 3) float64, some of what was measured, in the sensor's axes, metres.
        range_m: their median distance along the axis (of a scan: from the sensor).
    """

    points: NDArray[np.float64]
    range_m: float

    def off(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far (n, 3) points lie from the measured surface, in what sensors may differ by.

        Infinite where the frame did not look or saw nothing.
        """
        ...


def view_of(frame: Frame) -> DepthView | None:
    """The frame's measurement, None when too little was measured."""
    made: DepthView
    if frame.points is not None:
        made = _Scan(frame.points)
    elif frame.kind == "pair":
        made = _matched(frame)
    else:
        assert frame.depth_m is not None
        assert frame.intrinsics is not None
        baseline = frame.baseline_fx if frame.kind == "disparity" else None
        made = _Image(frame.depth_m, frame.intrinsics, baseline)
    return made if len(made.points) >= _POINTS // 8 else None


def _matched(frame: Frame) -> "_Image":
    assert frame.left is not None
    assert frame.right is not None
    assert frame.intrinsics is not None
    assert frame.baseline_fx is not None
    left, right, scale = frame.left, frame.right, 1.0
    if left.shape[1] > _STEREO_WIDTH:
        scale = _HALF
        left, right = (
            np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
            for image in (left, right)
        )
    disparity = Matcher(speckle=50)(left, right).astype(np.float32) / 16
    baseline_fx = frame.baseline_fx * scale
    depth = np.zeros(disparity.shape, np.float32)
    np.divide(np.float32(baseline_fx), disparity, out=depth, where=disparity > 1)
    return _Image(depth, frame.intrinsics.scaled(scale), baseline_fx)


class _Image:
    """Depth of a pinhole camera."""

    def __init__(self, depth_m: NDArray[np.float32], K: Intrinsics, baseline_fx: float | None) -> None:
        self._depth, self._K = depth_m, K
        self._disparity = 0.0 if baseline_fx is None else _DISPARITY / baseline_fx
        rows, columns = np.nonzero(_smooth(depth_m))
        chosen = np.linspace(0, len(rows) - 1, min(_POINTS, len(rows))).astype(np.intp)
        rows, columns = rows[chosen], columns[chosen]
        z = depth_m[rows, columns].astype(np.float64)
        self.points = np.stack([(columns - K.cx) / K.fx * z, (rows - K.cy) / K.fy * z, z], axis=1)
        self.range_m = float(np.median(z)) if len(z) else 0.0

    def off(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        K, (height, width) = self._K, self._depth.shape
        z = points[:, 2]
        front = z > 1e-6
        near = np.where(front, z, 1.0)
        column = np.clip(np.rint(K.fx * points[:, 0] / near + K.cx), -1, width).astype(np.intp)
        row = np.clip(np.rint(K.fy * points[:, 1] / near + K.cy), -1, height).astype(np.intp)
        seen = front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        result = np.full(len(points), np.inf)
        measured = self._depth[row[seen], column[seen]].astype(np.float64)
        tolerance = _FLOOR + _TOLERANCE * measured + self._disparity * measured**2
        result[seen] = np.where(measured > 0, np.abs(z[seen] - measured) / tolerance, np.inf)
        return result


def _smooth(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels with depth whose neighbours have about the same."""
    least, most = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    smooth: NDArray[np.bool_] = (least > 0) & (most - least < _JUMP * depth)
    smooth[[0, -1]] = smooth[:, [0, -1]] = False
    return smooth


class _Scan:
    """Points without order, as of a LiDAR; the ground, which fits itself however it is moved, is left out."""

    def __init__(self, points: NDArray[np.float32]) -> None:
        finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        distance = np.linalg.norm(finite, axis=1)
        finite = finite[(distance > 1e-6) & (distance < _FARTHEST)]
        self.range_m = float(np.median(np.linalg.norm(finite, axis=1))) if len(finite) else 0.0
        kept = _thinned(_above_ground(finite, self.range_m), max(_CELL * self.range_m, 1e-6))
        kept = _spread(kept, _TREE)
        self._tree = _tree(kept) if len(kept) else None
        self._box = (kept.min(axis=0), kept.max(axis=0)) if len(kept) else (np.zeros(3), np.zeros(3))
        self.points = _spread(kept, _POINTS // 2)

    def off(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        assert self._tree is not None
        near = ((points >= self._box[0]) & (points <= self._box[1])).all(axis=1)
        off = np.full(len(points), np.inf)
        if near.any():
            _, squared = self._tree.knnSearch(points[near].astype(np.float32), 1, params={})
            tolerance = _LIDAR_FLOOR + 0.005 * self.range_m + 0.01 * np.linalg.norm(points[near], axis=1)
            off[near] = np.sqrt(squared[:, 0]) / tolerance
        return off


def _spread(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    return np.asarray(points[np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.intp)])


def _tree(points: NDArray[np.float64]) -> Any:
    index: Any = cv2.flann_Index  # type: ignore[attr-defined]
    return index(points.astype(np.float32), {"algorithm": _EXACT_TREE})


def _above_ground(points: NDArray[np.float64], range_m: float) -> NDArray[np.float64]:
    for axis in (2, 1):  # LiDARs have z up, what was moved to a camera's axes y down
        heights = np.round(points[:, axis] / max(_GROUND * range_m, 1e-9)).astype(np.int64)
        values, counts = np.unique(heights, return_counts=True)
        if len(values) and counts.max() > _FLAT * len(points):
            return np.asarray(points[np.abs(heights - values[np.argmax(counts)]) > 1])
    return points


def _thinned(points: NDArray[np.float64], cell: float) -> NDArray[np.float64]:
    _, first = np.unique(np.round(points / cell).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(first)])
