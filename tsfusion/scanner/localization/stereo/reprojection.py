# SPDX-License-Identifier: MIT
"""The motion between two views from points of the first one, weighed by how well their depth is known.

A point's error in the second view has two causes: where it was followed to, and its disparity. The second
moves it along a line, by the more the nearer it is. Its share is taken out of the weight along that line
alone (each point's disparity is marginalised), so that noise in depth cannot pull at the rotation.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.features import Pixels, back_project

Vectors = NDArray[np.float64]

PIXEL_SIGMA = 0.3  # of a followed corner
DISPARITY_SIGMA = 0.5  # of half-resolution matching: median 0.3, ninth decile 1.5 on Middlebury's Motorcycle
_HUBER = 2.0  # standard deviations
_AGREES = 4.0  # standard deviations
_NEAREST = 0.01  # metres before the camera
_LEAST_DISPARITY = 0.2  # pixels, after the offset
_STEPS = 10


@dataclass(frozen=True)
class StereoCamera:
    """A rectified pair of cameras: `baseline_fx` is its focal length times its baseline, px·m."""

    intrinsics: Intrinsics
    baseline_fx: float

    def lift(self, pixels: Pixels, disparity: NDArray[np.floating]) -> Vectors:
        """(n, 2) pixels with (n,) pixels of disparity > 0 → (n, 3) points of the left camera."""
        return back_project(pixels, self.baseline_fx / disparity, self.intrinsics)

    def project(self, points: Vectors) -> Pixels:
        """(n, 3) points of the left camera → (n, 2) pixels; those behind it land far outside."""
        K, z = self.intrinsics, np.maximum(points[:, 2], _NEAREST)
        return np.stack([K.fx * points[:, 0] / z + K.cx, K.fy * points[:, 1] / z + K.cy], 1).astype(
            np.float32
        )


@dataclass(frozen=True, eq=False)
class Motion:
    """What `refine` found.

    Attributes:
        T_old_new: (4, 4) the second camera seen from the first.
        agree: (n,) bool, the points whose errors their uncertainties explain.
        offset: pixels to add to every disparity, where it was asked for.
        offset_sigma: pixels, its standard deviation.
    """

    T_old_new: se3.Transform
    agree: NDArray[np.bool_]
    offset: float
    offset_sigma: float


def refine(
    T_old_new: se3.Transform,
    old: Pixels,
    disparity: NDArray[np.floating],
    new: Pixels,
    rig: StereoCamera,
    *,
    with_offset: bool = False,
) -> Motion | None:
    """Gauss-Newton from a good guess; None when the points do not fix the motion.

    Args:
        old, new: (n, 2) pixels in the first and the second image.
        disparity: (n,) pixels in the first, > 0.
        with_offset: also find what all disparities lack. It can be told from the motion because it bends
            space: far points pass by too slowly for their disparity, near ones as they should.
    """
    size = 7 if with_offset else 6
    T_new_old, offset = se3.inverse(T_old_new), 0.0
    H = np.eye(size)
    deviation = np.zeros(len(old))
    for _ in range(_STEPS):
        residual, J = _linearised(T_new_old, old, disparity + offset, new, rig)
        along = J[:, :, 6]
        share = DISPARITY_SIGMA**2 / (PIXEL_SIGMA**2 + DISPARITY_SIGMA**2 * (along**2).sum(axis=1))
        squared = (residual**2).sum(axis=1) - share * (along * residual).sum(axis=1) ** 2
        deviation = np.sqrt(np.maximum(squared, 0)) / PIXEL_SIGMA
        weight = _HUBER / np.maximum(deviation, _HUBER)
        J = J[:, :, :size]
        H, gradient = _normal_equations(J, residual, along, weight, share * weight)
        if not np.isfinite(H).all() or np.linalg.cond(H) > 1e14:
            return None
        step = -np.linalg.solve(H, gradient)
        T_new_old = se3.exp(step[:6]) @ T_new_old
        if with_offset:
            offset = max(offset + float(step[6]), _LEAST_DISPARITY - float(disparity.min()))
        if np.abs(step).max() < 1e-6:
            break
    sigma = PIXEL_SIGMA * float(np.sqrt(np.linalg.inv(H)[-1, -1])) if with_offset else 0.0
    return Motion(se3.inverse(T_new_old), deviation < _AGREES, offset, sigma)


def _normal_equations(
    J: Vectors, residual: Vectors, along: Vectors, weight: Vectors, taken: Vectors
) -> tuple[Vectors, Vectors]:
    """Sums of weight·JᵀJ and weight·Jᵀr, less what is `taken` out of them along each point's line."""
    size = J.shape[2]
    weighted = (weight[:, None, None] * J).reshape(-1, size)
    J_along = np.einsum("nk,nki->ni", along, J)
    taken_along = (J_along * taken[:, None]).T
    H = weighted.T @ J.reshape(-1, size) - taken_along @ J_along
    gradient = weighted.T @ residual.ravel() - taken_along @ (along * residual).sum(axis=1)
    return H, gradient


def _linearised(
    T_new_old: se3.Transform, old: Pixels, disparity: NDArray[np.floating], new: Pixels, rig: StereoCamera
) -> tuple[Vectors, Vectors]:
    """(n, 2) pixel residuals, and (n, 2, 7) by a twist of the new camera's axes and by disparity."""
    K, X = rig.intrinsics, rig.lift(old, disparity)
    x, y, z = se3.apply(T_new_old, X).T
    behind = z < _NEAREST
    inverse_z = 1 / np.where(behind, _NEAREST, z)
    residual = np.stack([K.fx * x * inverse_z + K.cx - new[:, 0], K.fy * y * inverse_z + K.cy - new[:, 1]], 1)
    J = np.zeros((len(X), 2, 7))
    J[:, 0, 0], J[:, 0, 2] = K.fx * inverse_z, -K.fx * x * inverse_z**2
    J[:, 1, 1], J[:, 1, 2] = K.fy * inverse_z, -K.fy * y * inverse_z**2
    a = J[:, :, :3]
    J[:, :, 3] = a[:, :, 2] * y[:, None] - a[:, :, 1] * z[:, None]
    J[:, :, 4] = a[:, :, 0] * z[:, None] - a[:, :, 2] * x[:, None]
    J[:, :, 5] = a[:, :, 1] * x[:, None] - a[:, :, 0] * y[:, None]
    by_disparity = (-X / disparity[:, None]) @ T_new_old[:3, :3].T
    J[:, :, 6] = np.einsum("nij,nj->ni", a, by_disparity)
    J[behind] = 0
    return residual, J
