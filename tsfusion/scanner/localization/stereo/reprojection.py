# SPDX-License-Identifier: MIT
"""Find the motion between two stereo views by reprojection, weighted by the uncertainty of depth.

A point's error in the second view has two causes. The corner was followed inexactly, and its disparity is
inexact. An inexact disparity moves the point along a line, farther the nearer the point is. The weight is
reduced along this line alone (each point's disparity is marginalised), so that noise in depth does not turn
the camera.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.features import Pixels, back_project

Vectors = NDArray[np.float64]

PIXEL_SIGMA = 0.3  # pixels, deviation of a followed corner
DISPARITY_SIGMA = (
    0.5  # pixels, for half-resolution matching: median 0.3, ninth decile 1.5 on Middlebury's Motorcycle
)
HUBER = 2.0  # standard deviations
MAX_DEVIATION = 4.0  # standard deviations, for points that agree
MIN_DEPTH = 0.01  # metres
MIN_DISPARITY = 0.2  # pixels, after the offset is added
MAX_ITERATIONS = 10


@dataclass(frozen=True)
class StereoCamera:
    """Rectified pair of cameras. `baseline_fx` is the focal length times the baseline, px·m."""

    intrinsics: Intrinsics
    baseline_fx: float

    def lift(self, pixels: Pixels, disparity: NDArray[np.floating]) -> Vectors:
        """Return points of the left camera: (n, 2) pixels, (n,) pixels of disparity > 0 → (n, 3) metres."""
        return back_project(pixels, self.baseline_fx / disparity, self.intrinsics)

    def project(self, points: Vectors) -> Pixels:
        """Return the left camera's pixels: (n, 3) metres → (n, 2). Points behind it land far outside."""
        K, z = self.intrinsics, np.maximum(points[:, 2], MIN_DEPTH)
        return np.stack([K.fx * points[:, 0] / z + K.cx, K.fy * points[:, 1] / z + K.cy], 1).astype(
            np.float32
        )


@dataclass(frozen=True, eq=False)
class StereoMotion:
    """Motion found by `refine`."""

    T_old_new: se3.Transform  # (4, 4) pose of the second camera in the axes of the first
    agree: NDArray[np.bool_]  # (n,) bool, points with an error that their uncertainty explains
    offset: float  # pixels to add to every disparity; 0 if not estimated
    offset_sigma: float  # pixels, standard deviation of the offset


def refine(
    T_old_new: se3.Transform,
    old: Pixels,
    disparity: NDArray[np.floating],
    new: Pixels,
    rig: StereoCamera,
    *,
    with_offset: bool = False,
) -> StereoMotion | None:
    """Refine a motion by Gauss-Newton. Return None if the points do not determine it.

    Args:
        old, new: (n, 2) pixels in the first and the second image.
        disparity: (n,) pixels in the first image, > 0.
        with_offset: True also estimates one offset for all disparities. The offset differs from a motion
            because it bends space: far points pass too slowly for their disparity, near points as fast as
            expected.
    """
    size = 7 if with_offset else 6
    T_new_old, offset = se3.inverse(T_old_new), 0.0
    H = np.eye(size)
    deviation = np.zeros(len(old))
    for _ in range(MAX_ITERATIONS):
        residual, J = _linearised(T_new_old, old, disparity + offset, new, rig)
        along = J[6]
        toward = (along * residual).sum(axis=0)
        share = DISPARITY_SIGMA**2 / (PIXEL_SIGMA**2 + DISPARITY_SIGMA**2 * (along**2).sum(axis=0))
        squared = (residual**2).sum(axis=0) - share * toward**2
        deviation = np.sqrt(np.maximum(squared, 0)) / PIXEL_SIGMA
        weight = HUBER / np.maximum(deviation, HUBER)
        H, gradient = _normal_equations(J[:size], along, residual, weight, share * weight)
        if not np.isfinite(H).all():
            return None
        values = np.abs(np.linalg.eigvalsh(H))
        if values.min() <= 1e-14 * values.max():
            return None
        step = -np.linalg.solve(H, gradient)
        T_new_old = se3.exp(step[:6]) @ T_new_old
        if with_offset:
            offset = max(offset + float(step[6]), MIN_DISPARITY - float(disparity.min()))
        if np.abs(step).max() < 1e-6:
            break
    sigma = PIXEL_SIGMA * float(np.sqrt(np.linalg.inv(H)[-1, -1])) if with_offset else 0.0
    return StereoMotion(se3.inverse(T_new_old), deviation < MAX_DEVIATION, offset, sigma)


def _normal_equations(
    J: Vectors, along: Vectors, residual: Vectors, weight: Vectors, taken: Vectors
) -> tuple[Vectors, Vectors]:
    """Return sums of weight·JᵀJ and weight·Jᵀr, reduced by the weights `taken` along each point's line."""
    weighted = (J * weight).reshape(len(J), -1)
    J_along = along[0] * J[:, 0] + along[1] * J[:, 1]
    taken_along = J_along * taken
    H = weighted @ J.reshape(len(J), -1).T - taken_along @ J_along.T
    return H, weighted @ residual.ravel() - taken_along @ (along * residual).sum(axis=0)


def _linearised(
    T_new_old: se3.Transform, old: Pixels, disparity: NDArray[np.floating], new: Pixels, rig: StereoCamera
) -> tuple[Vectors, Vectors]:
    """Return residuals (2, n), pixels; and their Jacobian (7, 2, n) by a twist in new axes and disparity."""
    K, X = rig.intrinsics, rig.lift(old, disparity).T
    x, y, z = T_new_old[:3, :3] @ X + T_new_old[:3, 3:]
    behind = z < MIN_DEPTH
    inverse_z = 1 / np.where(behind, MIN_DEPTH, z)
    fu, fv = K.fx * inverse_z, K.fy * inverse_z
    u, v = fu * x, fv * y
    residual = np.stack([u + K.cx - new[:, 0], v + K.cy - new[:, 1]])
    J = np.zeros((7, 2, len(x)))
    J[0, 0], J[2, 0] = fu, -u * inverse_z
    J[1, 1], J[2, 1] = fv, -v * inverse_z
    J[3] = J[2] * y - J[1] * z
    J[4] = J[0] * z - J[2] * x
    J[5] = J[1] * x - J[0] * y
    by_disparity = T_new_old[:3, :3] @ (-X / disparity)
    J[6] = J[0] * by_disparity[0] + J[1] * by_disparity[1] + J[2] * by_disparity[2]
    J[:, :, behind] = 0
    return residual, J
