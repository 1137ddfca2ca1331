# SPDX-License-Identifier: MIT
"""Verification that two views show one place: matches, poses both ways, the depth of every pixel."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.scanner.localization import features
from tsfusion.scanner.localization.loop_closure.dense_alignment import Agreement, agreement, refine
from tsfusion.scanner.localization.loop_closure.place_index import PlaceView

MAX_RATIO = 0.9  # of the best descriptor distance to the second
MAX_DIFFERENT_BITS = 64  # of 256, in a match
PIXEL_TOLERANCE = 3.0  # pixels at 640 of width
MIN_INLIERS = 20
MIN_SPREAD = 0.05  # share of the image covered by the hull of the matches that agree
MAX_DISTANCE, MAX_DEGREES = 0.06, 4.0  # between the poses found both ways; the first of the scene's depth
# Shares of the pixels with depth in both views, for measured depth and for depth from stereo: those that
# must agree, and those, at most, where one camera sees through the other's surface. True loops in a kitchen
# (Kinect) have >= 0.92 and <= 0.007, false ones of a corridor with a tiled floor <= 0.90 and >= 0.065.
MIN_AGREEMENT = (0.85, 0.6)
MAX_THROUGH = (0.04, 0.12)
MIN_OVERLAP = 0.2  # share of the pixels with depth


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopCheck:
    """Result of comparing two views."""

    # (4, 4) pose of the new camera in the old one's axes; None = none was found
    T_old_new: se3.Transform | None = None
    refused: str | None = None  # reason not to take them for the same place; None = they are the same
    inliers: int = 0  # number of matches that agree with the pose
    sigma: float = 0.0  # standard deviation of the pose, metres
    depths: Agreement | None = None  # agreement of the dense depths; None = not compared


def check(old: PlaceView, new: PlaceView) -> LoopCheck:
    """Compare two views of a camera, or of two cameras.

    Repeated structure is refused where the depth of either view contradicts the other. Places that are alike
    in every pixel pass; only the trajectory tells them apart.
    """
    first, second = matches(old.descriptors, new.descriptors)
    if len(first) < MIN_INLIERS:
        return LoopCheck(refused=f"{len(first)} matches")
    forward = _pose(old.points[first], new.pixels[second], new)
    backward = None if forward is None else _pose(new.points[second], old.pixels[first], old)
    if forward is None or backward is None:
        return LoopCheck(refused=f"no pose from {len(first)} matches")
    inliers = forward[1] | backward[1]
    count = int(inliers.sum())
    first, second = first[inliers], second[inliers]
    T = forward[0]
    depth = float(np.nanmedian(old.points[first][:, 2]))
    apart = T @ backward[0]
    if se3.distance(apart) > MAX_DISTANCE * depth or np.degrees(se3.angle(apart)) > MAX_DEGREES:
        return LoopCheck(T_old_new=T, refused="the poses found both ways differ", inliers=count)
    T = T @ se3.exp(-0.5 * se3.log(apart))
    if count < MIN_INLIERS:
        return LoopCheck(T_old_new=T, refused=f"{count} matches agree", inliers=count)
    spread = min(_hull(old.pixels[first], old.size), _hull(new.pixels[second], new.size))
    if spread < MIN_SPREAD:
        return LoopCheck(T_old_new=T, refused=f"matches cover {spread:.0%} of the image", inliers=count)
    T = refine(old, new, T, first, second)
    depths = agreement(old, new, T)
    refused = _contradiction(depths, measured=old.measured and new.measured)
    near = float(np.nanpercentile(old.points[first][:, 2], 25))
    sigma = max(0.01, 0.01 * near, 0.3 * max(old.noise, new.noise) * near**2)
    return LoopCheck(T_old_new=T, refused=refused, inliers=count, sigma=sigma, depths=depths)


def matches(old: NDArray[np.uint8], new: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Match (n, 32) and (m, 32) descriptors: rows that are clearly each other's nearest."""
    if min(len(old), len(new)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # Of ±1 vectors the product is 256 minus twice the Hamming distance: one for both directions.
    distance = 128 - (_signs(old) @ _signs(new).T) / 2
    rows, best = np.arange(len(old)), distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[best] == rows
    nearest = distance[rows, best]
    distance[rows, best] = np.inf
    kept = np.flatnonzero(
        mutual & (nearest < MAX_DIFFERENT_BITS) & (nearest < MAX_RATIO * distance.min(axis=1))
    )
    return kept, best[kept]


def _signs(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.unpackbits(descriptors, axis=1).astype(np.float32) * 2 - 1


def _pose(
    points: NDArray[np.float32], pixels: NDArray[np.float32], camera: PlaceView
) -> tuple[se3.Transform, NDArray[np.bool_]] | None:
    """T_points_camera by RANSAC over three points (P3P) and refinement, and (n,) which points agree."""
    known = np.isfinite(points[:, 2])
    tolerance = PIXEL_TOLERANCE * max(camera.size[0] / 640, 0.5)
    found = features.resection(
        points[known],
        pixels[known],
        camera.intrinsics,
        tolerance=tolerance,
        minimum=8,
        iterations=150,
        method=cv2.SOLVEPNP_P3P,
    )
    if found is None:
        return None
    inliers = np.zeros(len(points), bool)
    inliers[known] = found[1]
    return found[0], inliers


def _hull(pixels: NDArray[np.float32], size: tuple[int, int]) -> float:
    return float(cv2.contourArea(cv2.convexHull(pixels))) / (size[0] * size[1])


def _contradiction(depths: Agreement, *, measured: bool) -> str | None:
    if depths.overlap < MIN_OVERLAP:
        return f"the views share {depths.overlap:.0%}"
    if depths.through > MAX_THROUGH[not measured]:
        return f"{depths.through:.0%} of the pixels see through the other view's surfaces"
    if depths.agree < MIN_AGREEMENT[not measured]:
        return f"the depths agree in {depths.agree:.0%} of the pixels"
    return None
