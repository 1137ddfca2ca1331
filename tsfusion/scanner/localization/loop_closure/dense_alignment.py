# SPDX-License-Identifier: MIT
"""Align two views with depth: refine their relative pose, and measure how well the depths agree."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.loop_closure.place_index import PlaceView

MAX_ITERATIONS = 8
STRIDE = 3  # every third depth pixel is used to find the pose; all pixels to judge it
DEPTH_FLOOR = 0.01  # metres, the part of the depth error that does not grow with distance
DENSE_WEIGHT = 3000  # a whole depth image counts as so many independent measurements
MATCH_SIGMA = 5.0  # pixels, error of a match at width 640: colour and depth may not be registered


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Shares of one view's depth pixels, projected into the other; each the worse of both directions."""

    overlap: float  # share of the depth pixels that fall on a depth pixel
    agree: float  # share of these pixels where the depth is the expected one
    through: float  # share of these pixels where the other camera saw farther, through the surface


def agreement(old: PlaceView, new: PlaceView, T_old_new: se3.Transform) -> Agreement:
    """Return how well the depths agree if the new camera is at `T_old_new` (4, 4) in the old one's axes."""
    one, two = _into(new, old, T_old_new), _into(old, new, se3.inverse(T_old_new))
    return Agreement(
        overlap=min(one.overlap, two.overlap),
        agree=min(one.agree, two.agree),
        through=max(one.through, two.through),
    )


def refine(
    old: PlaceView,
    new: PlaceView,
    T_old_new: se3.Transform,
    first: NDArray[np.int64],
    second: NDArray[np.int64],
) -> se3.Transform:
    """Refine T_old_new by matched features (rows `first` of the old view, `second` of the new) and by depth.

    Gauss-Newton minimises reprojection errors in both directions and, for depth cameras, also distances to
    the tangent planes of the old depth image.
    """
    T = T_old_new
    target = _DepthNormals(old) if old.measured and new.measured else None
    points = _points(new)[::STRIDE]
    for _ in range(MAX_ITERATIONS):
        H, g = np.zeros((6, 6)), np.zeros(6)
        backward = se3.inverse(T)
        terms = [
            _reprojection(backward, old.points[first], new.pixels[second], new, towards_old=False),
            _reprojection(T, new.points[second], old.pixels[first], old, towards_old=True),
        ]
        if target is not None:
            terms.append(target.planes(T, points, max(old.noise, new.noise)))
        for J, r, w in terms:
            H += (J * w[:, None]).T @ J
            g -= (J * w[:, None]).T @ r
        step = np.linalg.solve(H + 1e-9 * np.eye(6), g)
        T = se3.exp(step) @ T
        if np.abs(step).max() < 1e-4:
            break
    return se3.nearest(T)


def openness(old: PlaceView, new: PlaceView, T_old_new: se3.Transform) -> float:
    """Return the standard deviation, metres, that the depths leave T_old_new in its worst direction."""
    J, _, w = _DepthNormals(old).planes(T_old_new, _points(new)[::STRIDE], max(old.noise, new.noise))
    least = float(np.linalg.eigvalsh((J * w[:, None]).T @ J)[0])
    return float(max(least, 1e-9) ** -0.5)


Term = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]  # Jacobian, residual, weight


def _reprojection(
    T: se3.Transform,
    points: NDArray[np.float32],
    pixels: NDArray[np.float32],
    camera: PlaceView,
    *,
    towards_old: bool,
) -> Term:
    """Return reprojection errors, pixels, of points in the other camera. The step is a twist in old axes."""
    known = np.isfinite(points[:, 2])
    p, pixels = points[known].astype(np.float64), pixels[known]
    q = se3.apply(T, p)
    ahead = q[:, 2] > 0.05
    p, q, pixels = p[ahead], q[ahead], pixels[ahead]
    K = camera.intrinsics
    x, y, z = q.T
    r = np.stack([K.fx * x / z + K.cx - pixels[:, 0], K.fy * y / z + K.cy - pixels[:, 1]], axis=1)
    projection = np.zeros((len(q), 2, 3))
    projection[:, 0, 0], projection[:, 0, 2] = K.fx / z, -K.fx * x / z**2
    projection[:, 1, 1], projection[:, 1, 2] = K.fy / z, -K.fy * y / z**2
    # q = exp(step) T p towards the old view, or T' exp(-step) p where T' leads from the old view to the new.
    motion = np.zeros((len(q), 3, 6))
    motion[:, :, :3] = np.eye(3)
    motion[:, :, 3:] = -se3.hat(q if towards_old else p)
    if not towards_old:
        motion = -T[:3, :3] @ motion
    J = (projection @ motion).reshape(-1, 6)
    sigma = MATCH_SIGMA * camera.size[0] / 640
    size = np.linalg.norm(r, axis=1) / sigma
    w = np.minimum(1.0, 2.0 / np.maximum(size, 1e-9)) / sigma**2
    return J, r.ravel(), np.repeat(w, 2)


class _DepthNormals:
    """Points and normals of a view's depth image."""

    def __init__(self, view: PlaceView) -> None:
        self._view = view
        z = view.depth_mm.astype(np.float64) / 1000
        self._points = _lift(z, view.small)
        across, down = np.gradient(self._points, axis=1), np.gradient(self._points, axis=0)
        normals = np.cross(across, down)
        length = np.linalg.norm(normals, axis=2)
        low, high = _window(z)
        whole = (low > 0) & (high - low < 0.08 * high) & (length > 0)
        self._normals = np.where(whole[:, :, None], normals / np.maximum(length, 1e-12)[:, :, None], 0)

    def planes(self, T: se3.Transform, points: NDArray[np.float64], noise: float) -> Term:
        """Return distances, metres, of points from the tangent planes at the pixels that they fall on."""
        q = se3.apply(T, points)
        rows, columns, inside = _pixels(q, self._view)
        q = q[inside]
        p, n = self._points[rows, columns], self._normals[rows, columns]
        r = ((q - p) * n).sum(axis=1)
        sigma = DEPTH_FLOOR + 2 * noise * p[:, 2] ** 2
        near = (np.abs(r) < 5 * sigma) & ((n != 0).any(axis=1))
        q, n, r, sigma = q[near], n[near], r[near], sigma[near]
        J = np.concatenate([n, np.cross(q, n)], axis=1)
        w = np.minimum(1.0, 1.5 * sigma / np.maximum(np.abs(r), 1e-12)) / sigma**2
        return J, r, w * (DENSE_WEIGHT * STRIDE / self._view.depth_mm.size)


def _into(source: PlaceView, target: PlaceView, T: se3.Transform) -> Agreement:
    """Return the agreement in one direction; `T` is T_target_source."""
    points = _points(source)
    low, high = _window(target.depth_mm.astype(np.float32) / 1000)
    q = se3.apply(T, points)
    rows, columns, inside = _pixels(q, target)
    z = q[inside, 2]
    low, high = low[rows, columns], high[rows, columns]
    seen = high > 0
    low, high, z = low[seen], high[seen], z[seen]
    tolerance = 2 * DEPTH_FLOOR + 3 * (source.noise + target.noise) * z**2
    count = max(len(z), 1)
    through = float((z < low - tolerance).sum()) / count
    hidden = float((z > high + tolerance).sum()) / count
    return Agreement(overlap=len(z) / max(len(points), 1), agree=1 - through - hidden, through=through)


def _points(view: PlaceView) -> NDArray[np.float64]:
    """Return the points of all depth pixels, (n, 3) metres in the camera's axes."""
    z = view.depth_mm.astype(np.float64) / 1000
    return _lift(z, view.small)[z > 0]


def _lift(z: NDArray[np.float64], K: Intrinsics) -> NDArray[np.float64]:
    """Return the points of a depth image: (h, w) metres → (h, w, 3)."""
    v, u = np.mgrid[: z.shape[0], : z.shape[1]]
    return np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=2)


def _pixels(
    points: NDArray[np.float64], view: PlaceView
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return rows and columns of the depth pixels that points fall on, and (n,) True for these points."""
    K, (height, width) = view.small, view.depth_mm.shape
    z = np.maximum(points[:, 2], 1e-6)
    u, v = np.rint(points[:, 0] / z * K.fx + K.cx), np.rint(points[:, 1] / z * K.fy + K.cy)
    inside = (points[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    return v[inside].astype(np.int64), u[inside].astype(np.int64), inside


def _window(z: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the smallest and largest depth of 3×3 pixels, 0 if the middle pixel has no depth."""
    far = np.where(z > 0, z, np.inf).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(far, kernel), cv2.dilate(z.astype(np.float32), kernel)
    return np.where(z > 0, low, 0), np.where(z > 0, high, 0)
