# SPDX-License-Identifier: MIT
"""Find and track corners (Shi and Tomasi 1994; Lucas and Kanade 1981), and find camera poses from them."""

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics

Pixels = NDArray[np.float32]  # (n, 2), x then y

_WINDOW = (19, 16)  # pixels across and down: as exact as 21 × 21 on recordings, and cheaper; 15 × 15 is worse
_LEVELS = 3
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
_MAX_RETURN_ERROR = 1.0  # pixels between a corner and the result of tracking it forth and back
SAME_LIGHT = 0.15  # share of the mean grey level by which images of one exposure differ
_BLOCK = 5  # pixels a side of the window around a corner
_SECOND_DIFFERENCES = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
# Smallest eigenvalue of the Sobel gradients in a window: noise of one grey level hardly ever gives more.
_NOISE_EIGENVALUE = 1000.0


def corners(gray: NDArray[np.uint8], count: int, *, mask: NDArray[np.uint8] | None = None) -> Pixels:
    """Find at most `count` corners, (n, 2), where `mask` is not 0, at least a 60th of the width apart."""
    apart = max(4, gray.shape[1] // 60)
    found = cv2.goodFeaturesToTrack(gray, count, 0.005, apart, mask=mask, blockSize=_BLOCK)
    return np.empty((0, 2), np.float32) if found is None else found.reshape(-1, 2).astype(np.float32)


def stronger_than_noise(gray: NDArray[np.uint8], pixels: Pixels) -> NDArray[np.bool_]:
    """Return True for corners that are stronger than the image's noise: (n, 2) → (n,).

    The noise is estimated after Immerkær ("Fast noise variance estimation", 1996), but by the median, because
    plain walls must count.
    """
    rough = cv2.filter2D(gray, cv2.CV_16S, _SECOND_DIFFERENCES)[::3, ::3]
    sigma = float(np.median(np.abs(rough))) / (0.6745 * 6)
    across, down = (cv2.Sobel(gray, cv2.CV_16S, 1 - axis, axis) for axis in (0, 1))
    near = np.arange(_BLOCK) - _BLOCK // 2
    column = np.clip(pixels[:, 0, None, None].astype(np.intp) + near, 0, gray.shape[1] - 1)
    row = np.clip(pixels[:, 1, None, None].astype(np.intp) + near[:, None], 0, gray.shape[0] - 1)
    x, y = across[row, column].astype(np.float64), down[row, column].astype(np.float64)
    xx, xy, yy = (product.sum(axis=(1, 2)) for product in (x * x, x * y, y * y))
    strength = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    above: NDArray[np.bool_] = strength > _NOISE_EIGENVALUE * max(sigma, 1.0) ** 2
    return above


def follow(
    old: NDArray[np.uint8],
    new: NDArray[np.uint8],
    points: Pixels,
    *,
    guess: Pixels | None = None,
    thorough: bool = True,
) -> tuple[Pixels, NDArray[np.bool_]]:
    """Track (n, 2) points from one grey image to another. Also return (n,) True where tracking back agrees.

    Args:
        guess: (n, 2) pixels, expected in the new image.
        thorough: True tracks back at all scales instead of the finest alone, for guesses that may be far off.
    """
    if not len(points):
        return points.copy(), np.zeros(0, bool)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW if guess is not None else 0
    start = points.copy() if guess is None else np.ascontiguousarray(guess, dtype=np.float32)
    moved, there, _ = cv2.calcOpticalFlowPyrLK(
        old, new, points, start, winSize=_WINDOW, maxLevel=_LEVELS, criteria=_STOP, flags=flags
    )
    returned, back, _ = cv2.calcOpticalFlowPyrLK(
        new, old, moved, points.copy(), winSize=_WINDOW, maxLevel=_LEVELS if thorough else 0,
        criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    near = np.abs(returned - points).max(axis=1) < _MAX_RETURN_ERROR
    ok: NDArray[np.bool_] = (there.ravel() == 1) & (back.ravel() == 1) & near
    return moved, ok


def in_light_of(old: NDArray[np.uint8], new: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return `new` with the mean and contrast of `old` if their light differs: `follow` compares levels."""
    (mean, spread), (mean_now, spread_now) = (np.ravel(cv2.meanStdDev(image)) for image in (old, new))
    if abs(mean_now - mean) < SAME_LIGHT * mean or spread_now < 1:
        return new
    gain = spread / spread_now
    return np.asarray(cv2.addWeighted(new, gain, new, 0, mean - gain * mean_now), np.uint8)


def resection(
    points: NDArray[np.floating],
    pixels: NDArray[np.floating],
    intrinsics: Intrinsics,
    *,
    guess: se3.Transform | None = None,
    tolerance: float = 2.0,
    minimum: int = 6,
    iterations: int = 100,
    method: int = cv2.SOLVEPNP_ITERATIVE,
) -> tuple[se3.Transform, NDArray[np.bool_]] | None:
    """Find the camera pose from (n, 3) points and their (n, 2) pixels, by RANSAC and refinement (PnP).

    Args:
        guess: T_points_camera to start with.
        tolerance: largest error of an inlier, pixels.
        minimum: number of inliers that must agree.
        iterations, method: of RANSAC; `cv2.SOLVEPNP_…`.

    Returns:
        T_points_camera (4, 4) and the (n,) inliers, or None if fewer than `minimum` agree.
    """
    if len(points) < minimum:
        return None
    cv2.setRNGSeed(0)  # equal input gives equal poses
    rvec = tvec = None
    if guess is not None:
        T_camera_points = se3.inverse(guess)
        rvec = se3.rotation_vector(T_camera_points[:3, :3]).reshape(3, 1)
        tvec = T_camera_points[:3, 3].reshape(3, 1).copy()
    points3, pixels2 = points.astype(np.float64), pixels.astype(np.float64)
    found, rvec, tvec, chosen = cv2.solvePnPRansac(
        points3, pixels2, intrinsics.matrix, None, rvec, tvec, guess is not None,
        iterations, tolerance, 0.999, flags=method,
    )  # fmt: skip
    if not found or chosen is None or len(chosen) < minimum:
        return None
    inliers = np.zeros(len(points), bool)
    inliers[chosen.ravel()] = True
    rvec, tvec = cv2.solvePnPRefineLM(points3[inliers], pixels2[inliers], intrinsics.matrix, None, rvec, tvec)
    return se3.inverse(se3.transform(cv2.Rodrigues(rvec)[0], tvec.ravel())), inliers


def bilinear(image: NDArray[np.floating], pixels: Pixels) -> NDArray[np.float32]:
    """Interpolate the image at (n, 2) pixels. Return 0 outside, and where a neighbour is 0 (no depth)."""
    u, v = pixels[:, 0], pixels[:, 1]
    x, y = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1] - 1) & (y < image.shape[0] - 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    a, b = u - x, v - y
    corner = (image[y, x], image[y, x + 1], image[y + 1, x], image[y + 1, x + 1])
    whole = inside & (np.minimum.reduce(corner) > 0)
    mixed = (1 - b) * ((1 - a) * corner[0] + a * corner[1]) + b * ((1 - a) * corner[2] + a * corner[3])
    return np.where(whole, mixed, 0).astype(np.float32)


def back_project(pixels: Pixels, depth: NDArray[np.floating], intrinsics: Intrinsics) -> NDArray[np.float64]:
    """Return the 3D points of pixels: (n, 2) pixels, (n,) metres → (n, 3) metres in the camera's axes."""
    K = intrinsics
    z = depth.astype(np.float64)
    return np.stack([(pixels[:, 0] - K.cx) / K.fx * z, (pixels[:, 1] - K.cy) / K.fy * z, z], axis=1)
