# SPDX-License-Identifier: MIT
"""The surface that one frame measured, and the deviation of other frames' points from it."""

from copy import copy
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.stereo_matching import Matcher

MAX_POINTS = 800  # of a frame that are compared with another
# Two good measurements may differ by the sum of these three.
MIN_TOLERANCE = 0.004  # metres
DEPTH_TOLERANCE = 0.02  # of the depth
DISPARITY_TOLERANCE = 1.0  # pixels
EDGE_JUMP = 0.05  # of the depth, between neighbouring pixels: an edge, which no two cameras see alike
MAX_STEREO_WIDTH = 500  # pixels; a wider pair is scaled before it is matched
STEREO_SCALE = 0.5
LIDAR_TOLERANCE = 0.04  # metres
SCAN_CELL = 0.01  # of the range: side of the cells in which one point of a scan is kept
GROUND_SLICE = 0.03  # of the range: thickness of the slice that holds the ground
MIN_GROUND_SHARE = 0.25  # share of the points in one such slice that makes it the ground
MAX_DISTANCE = 1e6  # metres; points beyond it are invalid
MAX_TREE_POINTS = 20_000  # of a scan that others are compared with
NEIGHBOURS = 12  # of a scan's point that show the plane through it: on its ring and on the next ones
FLAT = 0.2  # of a neighbourhood's width: its thickness at most, and its breadth at least, to show a plane
EXACT_KD_TREE = 4  # FLANN_INDEX_KDTREE_SINGLE
_CELL_HASH = np.array([0x9E3779B97F4A7C1, 0x2545F4914F6CDD1D, 0x1B873593CC9E2D51])  # wraps at 64 bits
_MIN_Z = 1e-6  # metres: a point nearer than this is behind the camera


class DepthView(Protocol):
    """The surface that a frame measured."""

    @property
    def points(self) -> NDArray[np.float64]:
        """(3, n) float64, a part of the measured points, in the sensor's axes, metres."""
        ...

    @property
    def range_m(self) -> float:
        """Their median distance along the axis (of a scan: from the sensor)."""
        ...

    @property
    def camera(self) -> Intrinsics | None:
        """Intrinsics of the image; None of a scan."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W) of the image, (N,) of a scan."""
        ...

    @property
    def stereo(self) -> bool:
        """True if depth is proportional to the focal length."""
        ...

    def deviation(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) distance of (3, n) points from the measured surface, in units of the tolerance.

        Infinite where a point is out of view, or nothing was measured.
        """
        ...

    def seen_by(self, camera: Intrinsics, *, along_ray: bool = False) -> "DepthView":
        """The surface if another camera had measured it, or along each pixel's ray; a scan is the same."""
        ...


def depth_view(frame: Frame) -> DepthView | None:
    """The view of a frame; None when too little was measured."""
    made: DepthView
    if frame.points is not None:
        made = _ScanView(frame.keyframe(np.eye(4), frame.motion).measurement)
    elif frame.kind == "pair":
        made = _stereo_view(frame)
    else:
        assert frame.depth_m is not None
        assert frame.intrinsics is not None
        baseline = frame.baseline_fx if frame.kind == "disparity" else None
        made = _ImageView(frame.depth_m, frame.intrinsics, baseline)
    return made if made.points.shape[1] >= MAX_POINTS // 8 else None


def _stereo_view(frame: Frame) -> "_ImageView":
    assert frame.left is not None
    assert frame.right is not None
    assert frame.intrinsics is not None
    assert frame.baseline_fx is not None
    left, right, scale = frame.left, frame.right, 1.0
    if left.shape[1] > MAX_STEREO_WIDTH:
        scale = STEREO_SCALE
        left, right = (
            np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
            for image in (left, right)
        )
    disparity = Matcher(speckle=50)(left, right).astype(np.float32) / 16
    baseline_fx = frame.baseline_fx * scale
    depth = np.zeros(disparity.shape, np.float32)
    np.divide(np.float32(baseline_fx), disparity, out=depth, where=disparity > 1)
    return _ImageView(depth, frame.intrinsics, frame.baseline_fx, scale)


class _ImageView:
    """Depth of a pinhole camera; of a stereo camera, the depth is proportional to its focal length."""

    def __init__(
        self,
        depth_m: NDArray[np.float32],
        camera: Intrinsics,
        baseline_fx: float | None,
        scale: float = 1.0,
    ) -> None:
        """Take depth in an image `scale` times the size of the one that `camera` and `baseline_fx` are of."""
        self._baseline_fx, self._scale = baseline_fx, scale
        self.stereo = baseline_fx is not None
        self.shape = tuple(round(side / scale) for side in depth_m.shape)
        rows, columns = np.nonzero(_without_edges(depth_m))
        chosen = np.linspace(0, len(rows) - 1, min(MAX_POINTS, len(rows))).astype(np.intp)
        self._pixels = np.stack([columns[chosen], rows[chosen]]).astype(np.float64)
        self._z = depth_m[rows[chosen], columns[chosen]].astype(np.float64)
        self._depth = np.pad(depth_m, 1)  # whatever is out of view falls on its border
        self.range_m = float(np.median(self._z)) if len(self._z) else 0.0
        self._take(camera)

    def seen_by(self, camera: Intrinsics, *, along_ray: bool = False) -> "_ImageView":
        other = copy(self)
        if along_ray:
            height, width = (side - 2 for side in self._depth.shape)
            lengths = self._K.ray_lengths((height, width))
            column, row = self._pixels.astype(np.intp)
            other._depth = np.asarray(self._depth / np.pad(lengths, 1, mode="edge"), np.float32)
            other._z = self._z / lengths[row, column]
        if self._baseline_fx is not None:
            factor = camera.fx * self._scale / self._K.fx
            other._depth, other._z = self._depth * np.float32(factor), self._z * factor
            other._baseline_fx, other.range_m = self._baseline_fx * factor, self.range_m * factor
        other._take(camera)
        return other

    def _take(self, camera: Intrinsics) -> None:
        self.camera: Intrinsics | None = camera
        self._K = K = camera if self._scale == 1 else camera.scaled(self._scale)
        fx_b = self._baseline_fx
        self._disparity = 0.0 if fx_b is None else DISPARITY_TOLERANCE / (fx_b * self._scale)
        self._focal, self._centre = np.array([[K.fx], [K.fy]]), np.array([[K.cx], [K.cy]])
        self.points = np.empty((3, len(self._z)))
        self.points[:2] = (self._pixels - self._centre) / self._focal * self._z
        self.points[2] = self._z

    def deviation(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        height, width = self._depth.shape
        z = points[2]
        pixels = points[:2] / np.maximum(z, _MIN_Z)
        pixels *= self._focal
        pixels += self._centre + 1  # of the depth with its border
        np.rint(pixels, out=pixels)
        np.maximum(pixels, 0, out=pixels)
        np.minimum(pixels, [[width - 1], [height - 1]], out=pixels)
        column, row = pixels.astype(np.intp)
        measured = self._depth.take(row * width + column, mode="clip").astype(np.float64)
        tolerance = MIN_TOLERANCE + measured * (DEPTH_TOLERANCE + self._disparity * measured)
        result: NDArray[np.float64] = np.abs(z - measured) / tolerance
        result[(measured <= 0) | (z <= _MIN_Z)] = np.inf
        return result


def _without_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels with depth whose neighbours have about the same."""
    least, most = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    smooth: NDArray[np.bool_] = (least > 0) & (most - least < EDGE_JUMP * depth)
    smooth[[0, -1]] = smooth[:, [0, -1]] = False
    return smooth


class _ScanView:
    """Points of a LiDAR without the ground, which would fit itself under many wrong motions.

    Rings go with the sensor, so that with the distance to the nearest point alone scans fit best where it has
    not moved: the surface is the plane through neighbouring points, and nobody knows it beside a single ring.
    """

    camera: Intrinsics | None = None
    stereo = False

    def __init__(self, points: NDArray[np.float32]) -> None:
        self.shape = (len(points),)
        finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        distance = np.linalg.norm(finite, axis=1)
        finite = finite[(distance > 1e-6) & (distance < MAX_DISTANCE)]
        self.range_m = float(np.median(np.linalg.norm(finite, axis=1))) if len(finite) else 0.0
        kept = _one_per_cell(_above_ground(finite, self.range_m), max(SCAN_CELL * self.range_m, 1e-6))
        kept = _evenly_chosen(kept, MAX_TREE_POINTS)
        self._kept, self._tree = kept, _kd_tree(kept) if len(kept) else None
        self._box = (kept.min(axis=0), kept.max(axis=0)) if len(kept) else (np.zeros(3), np.zeros(3))
        self.points = np.ascontiguousarray(_evenly_chosen(kept, MAX_POINTS // 2).T)

    def seen_by(self, camera: Intrinsics, *, along_ray: bool = False) -> "_ScanView":
        del camera, along_ray
        return self

    def deviation(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        assert self._tree is not None
        rows = points.T
        near = ((rows >= self._box[0]) & (rows <= self._box[1])).all(axis=1)
        deviation = np.full(len(rows), np.inf)
        if near.any():
            found, squared = self._tree.knnSearch(rows[near].astype(np.float32), 1, params={})
            normals, reach = self._planes
            nearest = found[:, 0]
            off = np.abs(((rows[near] - self._kept[nearest]) * normals[nearest]).sum(axis=1))
            aside = np.sqrt(np.maximum(squared[:, 0] - off**2, 0))
            tolerance = LIDAR_TOLERANCE + 0.005 * self.range_m + 0.01 * np.linalg.norm(rows[near], axis=1)
            deviation[near] = np.hypot(off, np.maximum(aside - reach[nearest], 0)) / tolerance
            deviation[~np.isfinite(deviation)] = np.inf
        return deviation

    @cached_property
    def _planes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Normal of the plane through each point, and its reach, metres.

        Both are zero where points lie in no plane, and NaN along a single ring.
        """
        assert self._tree is not None
        count = min(NEIGHBOURS, len(self._kept))
        found, squared = self._tree.knnSearch(self._kept.astype(np.float32), count, params={})
        around = self._kept[found]
        around -= around.mean(axis=1, keepdims=True)
        spread, axes = np.linalg.eigh(around.transpose(0, 2, 1) @ around)
        thick, broad, wide = np.sqrt(np.maximum(spread, 0)).T
        is_flat = (thick < FLAT * broad) & (broad > FLAT * wide)
        known = is_flat.astype(np.float64)
        upright = np.abs(axes[:, 1 + int(np.argmin(self._kept[:, 1:].std(axis=0))), 2])
        known[(broad <= FLAT * wide) & (upright < 0.5)] = np.nan
        return axes[:, :, 0] * known[:, None], np.sqrt(squared[:, -1]) * known


def _evenly_chosen(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    return np.asarray(points[np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.intp)])


def _kd_tree(points: NDArray[np.float64]) -> Any:
    index: Any = cv2.flann_Index  # type: ignore[attr-defined]
    return index(points.astype(np.float32), {"algorithm": EXACT_KD_TREE})


def _above_ground(points: NDArray[np.float64], range_m: float) -> NDArray[np.float64]:
    for axis in (2, 1):  # LiDARs have z up, what was moved to a camera's axes y down
        heights = np.round(points[:, axis] / max(GROUND_SLICE * range_m, 1e-9)).astype(np.int64)
        values, counts = np.unique(heights, return_counts=True)
        if len(values) and counts.max() > MIN_GROUND_SHARE * len(points):
            return np.asarray(points[np.abs(heights - values[np.argmax(counts)]) > 1])
    return points


def _one_per_cell(points: NDArray[np.float64], cell: float) -> NDArray[np.float64]:
    cells = np.round(points / cell).astype(np.int64)
    _, first = np.unique(cells @ _CELL_HASH, return_index=True)
    return np.asarray(points[np.sort(first)])
