# SPDX-License-Identifier: MIT
"""Model cameras with distorted lenses; undistort images and rectify stereo pairs.

Lens models are OpenCV's: `radtan` (Brown-Conrady; ROS: plumb_bob, rational_polynomial) and `equidistant`
(Kannala-Brandt; OpenCV: fisheye). The result is a pinhole camera of the same size with square pixels. Its
view is cropped to seen pixels, or widened to the whole view.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, InvalidKeyframe
from tsfusion.geometry.keyframe import (
    MAX_BASELINE_M,
    MAX_IMAGE_SIDE,
    Intrinsics,
    check_intrinsics,
    check_pose,
)

Model = Literal["pinhole", "radtan", "equidistant"]
Size = tuple[int, int]  # height, width

MODELS: dict[str, Model] = {
    "": "pinhole", "none": "pinhole", "pinhole": "pinhole",
    "radtan": "radtan", "radial-tangential": "radtan", "plumb_bob": "radtan", "rational_polynomial": "radtan",
    "equidistant": "equidistant", "equi": "equidistant", "fisheye": "equidistant",
    "kannala_brandt4": "equidistant",
}  # fmt: skip
MAX_NO_SKEW = 1e-3  # pixels: a smaller skew counts as none
_COEFFICIENTS = {"pinhole": (0,), "radtan": (4, 5, 8, 12, 14), "equidistant": (4,)}
_MAX_ANGLE = np.radians(60)  # from the axis: a wider fisheye would need too many pixels in a flat image
_INSET = 0.5  # pixels of the border that interpolation could mix with the outside
_EDGE_POINTS = 33  # along each border of the image
_MAX_ITERATIONS = 50
_MAX_RESIDUAL = 1e-10  # on the unit plane


@dataclass(frozen=True)
class Camera:
    """Calibrated camera with a lens model. Raises InvalidConfig, naming the wrong value."""

    intrinsics: Intrinsics  # pixels
    size: Size  # (height, width) of its images
    model: Model = "pinhole"  # lens model
    # radtan: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]; equidistant: k1 k2 k3 k4
    distortion: tuple[float, ...] = ()
    skew: float = 0.0  # K[0, 1] of the matrix: pixels by which a column shifts at y / z = 1

    def __post_init__(self) -> None:
        expected = _COEFFICIENTS.get(self.model)
        if expected is None:
            raise InvalidConfig(
                f"model of a camera must be one of {', '.join(_COEFFICIENTS)}, got {self.model!r}"
            )
        if len(self.distortion) not in expected or not np.isfinite(self.distortion).all():
            counts = " or ".join(map(str, expected))
            raise InvalidConfig(
                f"distortion of a {self.model} camera must be {counts} finite numbers, got {self.distortion}"
            )
        if len(self.size) != 2 or not 2 <= min(self.size) <= max(self.size) <= MAX_IMAGE_SIDE:
            raise InvalidConfig(
                f"size of a camera must be 2 to {MAX_IMAGE_SIDE} pixels a side, got {self.size}"
            )
        if not np.isfinite(self.skew):
            raise InvalidConfig(f"skew of a camera must be finite pixels, got {self.skew}")
        try:
            check_intrinsics(self.intrinsics)
        except InvalidKeyframe as error:
            raise InvalidConfig(str(error)) from error

    @property
    def is_pinhole(self) -> bool:
        return self.model == "pinhole" and not self.skew

    def resized(self, size: Size) -> "Camera":
        """Return the camera of the same images scaled to another size of the same aspect ratio."""
        factor = size[1] / self.size[1]
        return replace(self, intrinsics=self.intrinsics.scaled(factor), size=size, skew=self.skew * factor)

    @classmethod
    def named(cls, K: Any, size: Size, model: str, distortion: Any = (), skew: float = 0.0) -> "Camera":
        """Make a camera from a 3×3 matrix (or its 9 numbers, or fx fy cx cy) and a model name of `MODELS`.

        If all coefficients are 0, the camera is a pinhole camera. A matrix replaces `skew` by its own skew.
        """
        if model.lower() not in MODELS:
            raise InvalidConfig(
                f"distortion model must be one of {', '.join(filter(None, MODELS))}, got {model!r}"
            )
        numbers = np.asarray(K, dtype=np.float64).ravel()
        if numbers.size == 9:
            skew, numbers = float(numbers[1]), numbers[[0, 4, 2, 5]]
        if numbers.size != 4:
            raise InvalidConfig(
                f"camera matrix must have 9 numbers, or be fx fy cx cy; got {numbers.size} numbers"
            )
        coefficients = tuple(map(float, np.asarray(distortion, dtype=np.float64).ravel()))
        chosen = MODELS[model.lower()] if any(coefficients) else "pinhole"
        intrinsics = Intrinsics(*map(float, numbers))
        used = coefficients if chosen != "pinhole" else ()
        size = int(size[0]), int(size[1])
        return cls(intrinsics, size, chosen, used, 0.0 if abs(skew) < MAX_NO_SKEW else skew)

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project (n, 3) points in the camera's axes, z > 0, to (n, 2) pixels."""
        points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 3)
        if not len(points):
            return np.zeros((0, 2))
        still, K, D = np.zeros(3), self.intrinsics.matrix, np.array(self.distortion)
        if self.model == "equidistant":
            pixels = cv2.fisheye.projectPoints(points, still, still, K, D)[0]
        else:
            pixels = cv2.projectPoints(points, still, still, K, D)[0]
        found = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        found[:, 0] += self._sheared(found[:, 1])
        return found

    def _sheared(self, rows: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the shift of columns by the camera's skew in (n,) image rows, pixels."""
        return np.asarray(self.skew / self.intrinsics.fy * (rows - self.intrinsics.cy), np.float64)

    def rays(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the direction of (n, 2) pixels as (n, 2) x/z and y/z, limited to 60° from the axis."""
        K = self.intrinsics
        pixels = np.array(pixels, dtype=np.float64).reshape(-1, 2)
        if self.skew:
            pixels[:, 0] -= self._sheared(pixels[:, 1])
            return replace(self, skew=0.0).rays(pixels)
        distorted = (pixels - (K.cx, K.cy)) / (K.fx, K.fy)
        if self.model == "equidistant":
            return _cut(_from_fisheye(distorted, self.distortion))
        rays = distorted
        for _ in range(_MAX_ITERATIONS):  # as cv2.undistortPoints does, until convergence
            ones = np.ones((len(rays), 1))
            seen = (self.project(np.hstack([rays, ones])) - (K.cx, K.cy)) / (K.fx, K.fy)
            missing = distorted - seen
            rays = _cut(rays + missing)
            if np.abs(missing).max(initial=0) < _MAX_RESIDUAL:
                break
        return rays


def _from_fisheye(distorted: NDArray[np.float64], k: tuple[float, ...]) -> NDArray[np.float64]:
    """Undistort (n, 2) image points x, y (f = 1) to x/z, y/z: Newton's method on r = θ(1 + Σ kᵢ θ²ⁱ)."""
    powers = np.array([0, 1, 2, 3, 4])
    c = np.array([1.0, *k])
    r = np.linalg.norm(distorted, axis=1)
    angle = np.minimum(r, _MAX_ANGLE)
    for _ in range(_MAX_ITERATIONS):
        terms = angle[:, None] ** (2 * powers)
        slope = terms @ (c * (2 * powers + 1))
        angle = np.clip(angle - (angle * (terms @ c) - r) / np.maximum(slope, 0.1), 0, _MAX_ANGLE)
    rays: NDArray[np.float64] = distorted * (np.tan(angle) / np.maximum(r, 1e-12))[:, None]
    return rays


def _cut(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    cut: NDArray[np.float64] = rays * np.minimum(1, np.tan(_MAX_ANGLE) / np.maximum(length, 1e-12))
    return cut


class Undistorter:
    """Undistort a camera's images to those of a pinhole camera with `intrinsics` and `size`.

    Args:
        keep: 0 crops to the largest upright rectangle that the camera saw completely; 1 keeps its whole view
            (up to 60° from the axis), with black elsewhere; values in between are allowed.
    """

    def __init__(self, camera: Camera, *, keep: float = 0.0) -> None:
        self.camera, self.size = camera, camera.size
        self.intrinsics = _flat([(camera, np.eye(3))], camera.size, keep)
        self._maps = _Maps(camera, np.eye(3), self.intrinsics, camera.size)

    def image(self, image: NDArray[Any]) -> NDArray[Any]:
        """Undistort an image, (H, W) or (H, W, channels), interpolated; 0 where the camera did not see."""
        return self._maps.image(image)

    def depth(self, depth: NDArray[Any]) -> NDArray[Any]:
        """Undistort depth, (H, W) of any type, without interpolation; 0 where the camera did not see.

        Depth along the optical axis does not change: the camera does not turn.
        """
        return self._maps.nearest(depth)


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two cameras; `p_right = T_right_left @ p_left`. Raises InvalidConfig, naming the wrong value."""

    left: Camera
    right: Camera
    T_right_left: NDArray[np.float64]

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "T_right_left", check_pose(self.T_right_left))
        except InvalidKeyframe as error:
            raise InvalidConfig(f"T_right_left: {str(error).removeprefix('T_world_camera ')}") from error
        baseline = float(np.linalg.norm(self.T_right_left[:3, 3]))
        if not 0 < baseline <= MAX_BASELINE_M:
            got = f"{baseline:.4g}: are these millimetres?" if baseline else "no translation"
            raise InvalidConfig(f"T_right_left must hold the baseline in metres, got {got}")


class Rectifier:
    """Rectify a rig's pairs to those of two equal pinhole cameras whose rows match.

    Attributes:
        intrinsics, size: those of both pinhole cameras.
        baseline_m, baseline_fx: metres; metre · pixels.
        T_left_rectified: (4, 4), a rotation: `T_world_rectified = T_world_left @ T_left_rectified`.

    Raises InvalidConfig if one camera is above the other, or they are swapped.
    """

    def __init__(self, rig: StereoRig) -> None:
        R, t = rig.T_right_left[:3, :3], rig.T_right_left[:3, 3]
        undistorted = (np.eye(3), np.zeros(5))
        R_left, R_right, _, P_right = cv2.stereoRectify(
            *undistorted, *undistorted, rig.left.size[::-1], R, t[:, None]
        )[:4]
        if abs(P_right[1, 3]) > abs(P_right[0, 3]):
            raise InvalidConfig(f"the cameras of a rig must stand side by side, got a baseline along y: {t}")
        if P_right[0, 3] > 0:
            raise InvalidConfig(
                f"the right camera of the rig stands to the left (T_right_left moves by {t}): swap them"
            )
        self.rig, self.size, self.baseline_m = rig, rig.left.size, float(np.linalg.norm(t))
        self.T_left_rectified = np.eye(4)
        self.T_left_rectified[:3, :3] = R_left.T
        turned = [(rig.left, R_left), (rig.right, R_right)]
        self.intrinsics = _flat(turned, self.size, 0.0)
        self.baseline_fx = self.baseline_m * self.intrinsics.fx
        self._left, self._right = (_Maps(camera, R, self.intrinsics, self.size) for camera, R in turned)

    def pair(self, left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Rectify both images; 0 where a camera did not see."""
        return self._left.image(left), self._right.image(right)


class _Maps:
    """Maps from the pixels of an undistorted image to the camera's, in fixed point (1/32 px), for OpenCV."""

    def __init__(self, camera: Camera, R: NDArray[np.float64], flat: Intrinsics, size: Size) -> None:
        self._size = camera.size
        K, D, new = camera.intrinsics.matrix, np.array(camera.distortion), flat.matrix
        made = cv2.fisheye if camera.model == "equidistant" else cv2
        self._columns, self._rows = made.initUndistortRectifyMap(K, D, R, new, size[::-1], cv2.CV_32FC1)
        self._columns += camera._sheared(self._rows).astype(np.float32)
        self._whole, self._fraction = cv2.convertMaps(self._columns, self._rows, cv2.CV_16SC2)

    @cached_property
    def _nearest(self) -> Any:
        return cv2.convertMaps(self._columns, self._rows, cv2.CV_16SC2, nninterpolation=True)[0]

    def image(self, image: NDArray[Any]) -> NDArray[Any]:
        moved: NDArray[Any] = cv2.remap(self._checked(image), self._whole, self._fraction, cv2.INTER_LINEAR)
        return moved

    def nearest(self, image: NDArray[Any]) -> NDArray[Any]:
        nothing = np.empty(0)
        moved: NDArray[Any] = cv2.remap(self._checked(image), self._nearest, nothing, cv2.INTER_NEAREST)
        return moved

    def _checked(self, image: NDArray[Any]) -> NDArray[Any]:
        if image.shape[:2] != self._size:
            raise InvalidConfig(
                f"the camera was calibrated for images of {self._size[1]}×{self._size[0]}, "
                f"got {image.shape[1]}×{image.shape[0]}"
            )
        return image


def _flat(cameras: list[tuple[Camera, NDArray[np.float64]]], size: Size, keep: float) -> Intrinsics:
    """Return the intrinsics of a pinhole camera for the common (keep 0) or whole (1) view of the cameras."""
    if not 0 <= keep <= 1:
        raise InvalidConfig(f"keep must be between 0 and 1, got {keep}")
    inner, outer = np.array([_seen(camera, R) for camera, R in cameras]).swapaxes(0, 1)
    low, high = slice(0, 2), slice(2, 4)  # x and y
    least = np.concatenate([inner[:, low].max(axis=0), inner[:, high].min(axis=0)])
    most = np.concatenate([outer[:, low].min(axis=0), outer[:, high].max(axis=0)])
    left, top, right, bottom = (1 - keep) * least + keep * most
    if right <= left or bottom <= top:
        raise InvalidConfig("the cameras see nothing in common, or their calibration is wrong")
    height, width = size
    scales = (width - 1) / (right - left), (height - 1) / (bottom - top)
    f = (1 - keep) * max(scales) + keep * min(scales)
    centre = (width - 1) / 2 - f * (left + right) / 2, (height - 1) / 2 - f * (top + bottom) / 2
    return Intrinsics(float(f), float(f), float(centre[0]), float(centre[1]))


def _seen(camera: Camera, R: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    """Return the largest rectangle within a rotated camera's view, and the smallest around it, x/z, y/z."""
    last_row, last_column = (side - 1 - _INSET for side in camera.size)
    along = np.linspace(0, 1, _EDGE_POINTS)
    u, v = _INSET + along * (last_column - _INSET), _INSET + along * (last_row - _INSET)
    edges = []
    for columns, rows in ((_INSET, v), (u, _INSET), (last_column, v), (u, last_row)):
        pixels = np.stack(np.broadcast_arrays(columns, rows), axis=1)
        turned = np.column_stack([camera.rays(pixels), np.ones(_EDGE_POINTS)]) @ R.T
        edges.append(turned[:, :2] / turned[:, 2:])
    inner, outer = np.zeros(4), np.zeros(4)
    for axis, (a, b) in enumerate(((edges[0], edges[2]), (edges[1], edges[3]))):
        low, high = sorted((a[:, axis], b[:, axis]), key=np.mean)  # fy < 0: the image is upside down
        inner[[axis, axis + 2]] = low.max(), high.min()
    everything = np.concatenate(edges)
    outer[:] = (*everything.min(axis=0), *everything.max(axis=0))
    return inner.tolist(), outer.tolist()
