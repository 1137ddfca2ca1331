# SPDX-License-Identifier: MIT
"""Whether two views show one place, and from where: matches, poses both ways, the depth of every pixel."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.scanner.localization.loop_closure.dense_alignment import Agreement, agreement, refined
from tsfusion.scanner.localization.loop_closure.place_index import PlaceView

_RATIO = 0.9  # of the best descriptor distance to the second
_FARTHEST = 64  # bits of 256 in which a match may differ
_TOLERANCE = 3.0  # pixels at 640 of width
_INLIERS = 20
_SPREAD = 0.05  # of the image, covered by the hull of what agrees
_DISAGREE = (0.06, 4.0)  # of the scene's depth; degrees: between the poses found both ways
# Shares of the pixels that say something, for measured depth and for matched: those that must agree, and
# those, at most, where one camera saw through what the other saw. Seen: true loops >= 0.92 and <= 0.007 in
# a kitchen (Kinect), false ones of a corridor with a tiled floor <= 0.90 and >= 0.065.
_AGREE = (0.85, 0.6)
_THROUGH = (0.04, 0.12)
_OVERLAP = 0.2  # of the pixels with depth


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopCheck:
    """What came of comparing two views.

    Attributes:
        T_old_new: (4, 4) pose of the new camera in the old one's axes; None where refused before one was
            found.
        refused: why they are not taken for the same place; None = they are.
        inliers: matches that agree with the pose.
        sigma: metres by which the pose may be off.
        depths: how the dense depths agree; None where not compared.
    """

    T_old_new: se3.Transform | None = None
    refused: str | None = None
    inliers: int = 0
    sigma: float = 0.0
    depths: Agreement | None = None


def check(old: PlaceView, new: PlaceView) -> LoopCheck:
    """Compare two views of a camera, or of two cameras.

    Repeated structure is refused where anything differs: depth that contradicts is looked for in both
    directions. Places that are alike in every pixel pass; only a trajectory tells them apart.
    """
    first, second = matches(old.descriptors, new.descriptors)
    if len(first) < _INLIERS:
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
    if se3.distance(apart) > _DISAGREE[0] * depth or np.degrees(se3.angle(apart)) > _DISAGREE[1]:
        return LoopCheck(T_old_new=T, refused="the poses found both ways differ", inliers=count)
    T = T @ se3.exp(-0.5 * se3.log(apart))
    if count < _INLIERS:
        return LoopCheck(T_old_new=T, refused=f"{count} matches agree", inliers=count)
    spread = min(_hull(old.pixels[first], old.size), _hull(new.pixels[second], new.size))
    if spread < _SPREAD:
        return LoopCheck(T_old_new=T, refused=f"matches cover {spread:.0%} of the image", inliers=count)
    T = refined(old, new, T, first, second)
    depths = agreement(old, new, T)
    refused = _contradiction(depths, measured=old.measured and new.measured)
    near = float(np.nanpercentile(old.points[first][:, 2], 25))
    sigma = max(0.01, 0.01 * near, 0.3 * max(old.noise, new.noise) * near**2)
    return LoopCheck(T_old_new=T, refused=refused, inliers=count, sigma=sigma, depths=depths)


def matches(old: NDArray[np.uint8], new: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of (n, 32) and (m, 32) descriptors that are each other's best, clearly."""
    if min(len(old), len(new)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # Of ±1 vectors the product is 256 minus twice the Hamming distance: one for both directions.
    distance = 128 - (_signs(old) @ _signs(new).T) / 2
    rows, best = np.arange(len(old)), distance.argmin(axis=1)
    mutual = distance.argmin(axis=0)[best] == rows
    nearest = distance[rows, best]
    distance[rows, best] = np.inf
    kept = np.flatnonzero(mutual & (nearest < _FARTHEST) & (nearest < _RATIO * distance.min(axis=1)))
    return kept, best[kept]


def _signs(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.unpackbits(descriptors, axis=1).astype(np.float32) * 2 - 1


def _pose(
    points: NDArray[np.float32], pixels: NDArray[np.float32], camera: PlaceView
) -> tuple[se3.Transform, NDArray[np.bool_]] | None:
    """T_points_camera and which agree, from three points at a time (P3P) and refinement."""
    known = np.flatnonzero(np.isfinite(points[:, 2]))
    if len(known) < 8:
        return None
    cv2.setRNGSeed(0)
    tolerance = _TOLERANCE * max(camera.size[0] / 640, 0.5)
    points3, pixels2 = points[known].astype(np.float64), pixels[known].astype(np.float64)
    K = camera.intrinsics.matrix
    found, rvec, tvec, chosen = cv2.solvePnPRansac(
        points3, pixels2, K, None, iterationsCount=150, reprojectionError=tolerance, confidence=0.999,
        flags=cv2.SOLVEPNP_P3P,
    )  # fmt: skip
    if not found or chosen is None or len(chosen) < 8:
        return None
    rows = chosen.ravel()
    rvec, tvec = cv2.solvePnPRefineLM(points3[rows], pixels2[rows], K, None, rvec, tvec)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rvec)[0], tvec.ravel()
    inliers = np.zeros(len(points), bool)
    inliers[known[rows]] = True
    return se3.inverse(T), inliers


def _hull(pixels: NDArray[np.float32], size: tuple[int, int]) -> float:
    return float(cv2.contourArea(cv2.convexHull(pixels))) / (size[0] * size[1])


def _contradiction(depths: Agreement, *, measured: bool) -> str | None:
    if depths.overlap < _OVERLAP:
        return f"the views share {depths.overlap:.0%}"
    if depths.through > _THROUGH[not measured]:
        return f"{depths.through:.0%} of the pixels see through the other view's surfaces"
    if depths.agree < _AGREE[not measured]:
        return f"the depths agree in {depths.agree:.0%} of the pixels"
    return None
