# SPDX-License-Identifier: MIT
"""Find a pose from corners and planes together by Gauss-Newton, and decide whether to accept it.

Reprojection errors of corners and distances to planes are weighted by their deviations. The Geman-McClure
kernel makes both robust; its width shrinks from round to round.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.rgbd import point_to_plane
from tsfusion.scanner.localization.rgbd.rgbd_frame import RGBDFrame, TrackingKeyframe

PIXEL = 1.0  # pixels at 640 columns, expected deviation of a followed corner
ROBUST_WIDTH = 3.0  # deviations; a residual of this size counts a quarter
FIRST_PLANE_WEIGHT = 0.1  # a corner has 1; used until the correlation of neighbouring blocks is known
MIN_SCALE, MIN_CORNER_SCALE, MAX_SCALE = 0.1, 0.6, 3.0  # bounds: deviation divided by the expected one
FIT_OFFSETS_SQUARED = 6.0  # blocks²: sum over a plane's 3 × 3 blocks of their offsets along one axis
SMOOTH_TILT = 0.03  # radians: smooth errors of a sensor tilt its planes by this
DAMPING = 1e-6  # share of the information's trace
COARSE_STEP, FINE_STEP = 3e-4, 2e-5  # metres or radians: a smaller step ends a coarse round, the last
ROUNDS = ((4, 15, 0.3), (2, 6, 0.05), (1, 3, 0.03))  # blocks between points, iterations, gate in metres
ON_PLANE = 0.01  # metres: a point so near, plus three deviations, is on its plane
MIN_PATTERN_ENERGY = 0.1  # of 1: with less energy, there is no pattern to compare
NOISE_FACTOR = 3.0  # safety factor for the information that noise alone would give
# Errors of neighbouring pixels are alike, so that the information is over-counted. These make the covariance
# of noise alone one that covers 90 % of the errors of nine recordings and rooms (docs/localization.md).
COVERING_FACTOR = 1.6  # deviations
DISAGREEMENT_POWER = 0.75  # of χ² between corners and planes
UNKNOWN_DISAGREEMENT = 5.0  # χ² where there are no corners to disagree
FLOOR_SHARE = 1e-3  # of the mean information: a direction that only corners or only planes tell

MIN_OVERLAP, MIN_OVERLAP_STRICT = 0.25, 0.4  # shares
MIN_AGREEING, MIN_AGREEING_STRICT, MIN_AGREEING_DEPTH_ALONE = 0.7, 0.8, 0.92  # shares
# Shares: of depth, and of depth and image summed. A pose with less waits until all guesses were tried: a
# pattern may repeat.
STRONG_AGREEING, STRONG_SUPPORT = 0.9, 1.7
SUPPORT_BETTER = 0.05  # of the sum, between two poses
MIN_LIKENESS, MIN_LIKENESS_STRICT = 0.2, 0.3  # correlations
MAX_UNCERTAINTY = 0.1  # metres
MAX_UNCERTAINTY_FOUND = 0.2  # metres, for a lost camera that is found where the image is so much alike:
FOUND_LIKENESS = 0.6  # correlation; a wrong place or a shift along a wall does not look so


@dataclass(frozen=True, eq=False)
class AlignmentTarget:
    """Tracking keyframe that the new frame is aligned to."""

    T_target_anchor: se3.Transform  # (4, 4), known pose of the anchor
    surface: point_to_plane.PlaneImage
    points: NDArray[np.float64]  # (n, 3) metres, corners in the target camera's axes
    pixels: NDArray[np.float32]  # (n, 2), these corners in the new image
    T_late: se3.Transform = field(default_factory=lambda: np.eye(4))  # motion during the delay of colour


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The pose found and the information about it, as (6, 6) matrices for a twist from the left."""

    T_anchor_camera: se3.Transform  # (4, 4)
    planes: se3.Matrix6  # information from the distances to planes
    spurious: se3.Matrix6  # the part of `planes` that noise in the normals alone would give
    corners: se3.Matrix6  # information from the reprojection of corners
    used: se3.Matrix6  # information of corners and planes that the pose was found with
    pull: se3.Twist  # of the corners, against that of the planes
    overcount: float  # variance of the pose, divided by the variance that the information claims

    def along(self, motion: se3.Twist) -> tuple[float, float]:
        """Return the information about a share of `motion` that only corners make, and their pull to it."""
        of_corners = self.corners @ motion
        explained = np.linalg.solve(self.used + 1e-9 * np.eye(6), of_corners)
        return float(motion @ of_corners - of_corners @ explained), float(motion @ self.pull)


def solve(
    targets: Sequence[AlignmentTarget],
    here: point_to_plane.PlaneImage,
    camera: Intrinsics,
    columns: int,
    T_anchor_camera: se3.Transform,
) -> PoseEstimate:
    """Find the pose near a start pose that fits corners and planes best.

    Args:
        targets: the anchor first; the other targets are used in the last round only.
        here: planes of the new frame.
        camera, columns: intrinsics and width of the new frame's image.
        T_anchor_camera: (4, 4) start.
    """
    T, trust = T_anchor_camera, FIRST_PLANE_WEIGHT
    pixel = PIXEL * columns / 640
    planes, corners, spurious, real = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6)), np.eye(6)
    for apart, iterations, gate in ROUNDS:
        some = here.every(apart) if apart > 1 else None
        reach = pixel * (4 if apart == ROUNDS[0][0] else 1)
        for iteration in range(iterations):
            is_first = apart == 1 and iteration == 0
            planes, corners, pull, towards_planes = (np.zeros(shape) for shape in ((6, 6), (6, 6), 6, 6))
            for target in targets if apart == 1 else targets[:1]:
                T_target_camera = target.T_target_anchor @ T
                found = point_to_plane.match(target.surface, here, T_target_camera, some)
                if is_first and target is targets[0]:
                    trust = 1 / point_to_plane.correlated_blocks(found, target.surface.shape[1])
                H_planes, g_planes, weight = _planes(found, gate, apart**2 * trust)
                H_corners, g_corners = _corners(target, camera, target.T_late @ T_target_camera, reach)
                A = se3.adjoint(target.T_target_anchor)
                planes, corners = planes + A.T @ H_planes @ A, corners + A.T @ H_corners @ A
                towards_planes, pull = towards_planes + A.T @ g_planes, pull + A.T @ g_corners
                if is_first:
                    spurious = spurious + A.T @ _spurious(found, weight, target.surface) @ A
            if is_first and corners.any():
                real = _real_share(planes, spurious)
            H, g = real @ planes + corners, pull + real @ towards_planes
            step = np.linalg.solve(H + (DAMPING * np.trace(H) + 1e-9) * np.eye(6), g)
            T = se3.exp(step) @ T
            if np.abs(step).max() < (FINE_STEP if apart == 1 else COARSE_STEP):
                break
    disagreement = _disagreement(real @ planes, corners, pull)
    overcount = COVERING_FACTOR**2 * max(1.0, disagreement) ** DISAGREEMENT_POWER / trust
    return PoseEstimate(se3.nearest(T), planes, spurious, corners, H, pull, overcount)


def _disagreement(planes: se3.Matrix6, corners: se3.Matrix6, pull: se3.Twist) -> float:
    """Return χ² for each degree of freedom between the pose by corners alone and that by planes alone."""
    if not corners.any() or not planes.any():
        return UNKNOWN_DISAGREEMENT
    apart = sum(np.linalg.inv(H + FLOOR_SHARE * np.trace(H) / 6 * np.eye(6)) for H in (planes, corners))
    return float(pull @ apart @ pull) / 6


def _planes(
    found: point_to_plane.Match, gate: float, trust: float
) -> tuple[se3.Matrix6, se3.Twist, point_to_plane.Floats]:
    """Return normal equations of the distances to planes, and the (m,) weights of the distances."""
    near = np.abs(found.distance) < np.float32(gate) + 3 * found.sigma
    if np.count_nonzero(near) < 12:
        return np.zeros((6, 6)), np.zeros(6), np.zeros(len(near), np.float32)
    whitened = found.distance / found.sigma
    size = np.abs(whitened.compress(near))
    size.partition(len(size) // 2)
    scale = np.float32(np.clip(1.48 * size[len(size) // 2], MIN_SCALE, MAX_SCALE))
    ratio = whitened / (scale * np.float32(ROBUST_WIDTH))
    weight = np.float32(trust) * near / ((1 + ratio * ratio) * scale * found.sigma) ** 2
    H, g = point_to_plane.equations(found, weight)
    return H, g, weight


def _spurious(
    found: point_to_plane.Match, weight: point_to_plane.Floats, there: point_to_plane.PlaneImage
) -> se3.Matrix6:
    """Return the information that errors of the planes' normals alone would give, (6, 6)."""
    slope = there.roughness * found.sigma * (there.intrinsics.fx / found.moved[2])
    return _isotropic(found.moved, weight * (slope * slope / FIT_OFFSETS_SQUARED + SMOOTH_TILT**2))


def _real_share(planes: se3.Matrix6, spurious: se3.Matrix6) -> se3.Matrix6:
    """Return the factor, (6, 6), that leaves of `planes` the information beyond the spurious one.

    Without it, a plain wall holds the camera where it was, against the corners.
    """
    root = np.linalg.cholesky(spurious + 1e-6 * np.eye(6))
    whiten = np.linalg.inv(root)
    values, axes = np.linalg.eigh(whiten @ planes @ whiten.T)
    share = np.maximum(0, 1 - 1 / np.maximum(values, 1e-9))
    factor: se3.Matrix6 = (root @ axes * share) @ axes.T @ whiten
    return factor


def _isotropic(points: point_to_plane.Floats, weight: NDArray[np.floating]) -> se3.Matrix6:
    """Return the information of points that are known in all three directions, (6, 6)."""
    p, w = points.astype(np.float64), weight.astype(np.float64)
    total, first, second = w.sum(), p @ w, (p * w) @ p.T
    H = np.zeros((6, 6))
    H[:3, :3] = total * np.eye(3)
    H[:3, 3:] = -se3.hat(first)
    H[3:, :3] = se3.hat(first)
    H[3:, 3:] = np.trace(second) * np.eye(3) - second
    return H


def _corners(
    target: AlignmentTarget, camera: Intrinsics, T_target_camera: se3.Transform, pixel: float
) -> tuple[se3.Matrix6, se3.Twist]:
    """Return normal equations of the reprojection errors of a target's corners."""
    if not len(target.points):
        return np.zeros((6, 6)), np.zeros(6)
    X = target.points.T
    R = T_target_camera[:3, :3].T
    x, y, z = R @ (X - T_target_camera[:3, 3:])
    ok = z > 0.05
    z = np.where(ok, z, 1.0)
    fu, fv, n = camera.fx / z, camera.fy / z, len(z)
    residual = np.empty(2 * n)
    residual[:n] = fu * x + (camera.cx - target.pixels[:, 0])
    residual[n:] = fv * y + (camera.cy - target.pixels[:, 1])
    du, dv = residual[:n], residual[n:]
    size = np.abs(residual)
    size.partition(n)
    sigma = pixel * min(max(1.48 * float(size[n]) / pixel, MIN_CORNER_SCALE), MAX_SCALE)
    weight = ok / (1 + (du * du + dv * dv) / (sigma * ROBUST_WIDTH) ** 2) ** 2 / sigma**2
    J = np.empty((6, 2 * n))  # of the negative residuals
    J[:3, :n] = R[2][:, None] * (fu * x / z) - R[0][:, None] * fu
    J[:3, n:] = R[2][:, None] * (fv * y / z) - R[1][:, None] * fv
    for half in (J[:, :n], J[:, n:]):
        half[3] = X[1] * half[2] - X[2] * half[1]
        half[4] = X[2] * half[0] - X[0] * half[2]
        half[5] = X[0] * half[1] - X[1] * half[0]
    weighted = J * np.concatenate([weight, weight])
    return weighted @ J.T, -(weighted @ residual)


@dataclass(frozen=True, eq=False)
class PoseEvidence:
    """Evidence for a pose: how well the frame agrees with a keyframe."""

    overlap: float  # share of the frame's points that fall onto planes of the keyframe
    agreeing: float  # share of these points that lie on their planes
    likeness: float | None  # -1 to 1, correlation of grey patterns; None without image or pattern
    corners: int  # number of corners that agree
    covariance: se3.Matrix6  # of the pose in the keyframe's axes, as a twist in the frame's camera's axes
    uncertainty: float  # metres, deviation in the worst direction; of a rotation, the motion of the surface

    @property
    def support(self) -> float:
        """Share of the depth that agrees, and likeness of the image, summed: 2 at most."""
        return self.agreeing + (self.likeness or 0.0)

    @property
    def is_strong(self) -> bool:
        """True if no other guess need be tried."""
        return self.agreeing >= STRONG_AGREEING or self.support >= STRONG_SUPPORT

    def beats(self, other: "PoseEvidence") -> bool:
        """Return True if depth and image together agree clearly better."""
        return self.support > other.support + SUPPORT_BETTER

    def doubt(self, *, strict: bool) -> str | None:
        """Return the reason to reject the pose, or None to accept it.

        Measured in a recorded kitchen: true poses agreed by 0.92 or more in depth and 0.35 or more in the
        image, wrong poses by 0.26 and 0.05 or less. But poses some centimetres off agreed by 0.9 in depth
        alone.

        Args:
            strict: True asks for more, for a pose that was not expected.
        """
        agreeing = MIN_AGREEING_STRICT if strict else MIN_AGREEING
        likeness = MIN_LIKENESS_STRICT if strict else MIN_LIKENESS
        if self.likeness is None:
            agreeing = MIN_AGREEING_DEPTH_ALONE
        overlap = MIN_OVERLAP_STRICT if strict else MIN_OVERLAP
        if self.overlap < overlap:
            return f"{self.overlap:.0%} of the view is of what is known, at least {overlap:.0%} must be"
        if self.agreeing < agreeing:
            return f"{self.agreeing:.0%} of the depth agrees, at least {agreeing:.0%} must"
        if self.likeness is not None and self.likeness < likeness:
            return f"the image agrees by {self.likeness:.2f}, it must by {likeness:.2f} of 1"
        is_alike = strict and (self.likeness or 0.0) > FOUND_LIKENESS
        limit = MAX_UNCERTAINTY_FOUND if is_alike else MAX_UNCERTAINTY
        if self.uncertainty > limit:
            return (
                f"the view leaves the pose open by {min(self.uncertainty, 9.99):.3f} m (a plain wall?), "
                f"at most {limit:.3f} m is allowed"
            )
        return None


def pose_evidence(
    current: RGBDFrame, keyframe: TrackingKeyframe, estimate: PoseEstimate, corners: int
) -> PoseEvidence:
    """Return the evidence for an estimate of the current frame's pose in a keyframe's axes."""
    found = point_to_plane.match(keyframe.frame.surface, current.surface, estimate.T_anchor_camera, None)
    agree = np.abs(found.distance) < ON_PLANE + 3 * found.sigma
    total = max(1, current.surface.points.shape[1])
    covariance, uncertainty = _covariance(estimate, found)
    return PoseEvidence(
        overlap=len(agree) / total,
        agreeing=float(agree.mean()) if len(agree) else 0.0,
        likeness=_likeness(current, keyframe, found),
        corners=corners,
        covariance=covariance,
        uncertainty=uncertainty,
    )


def _likeness(current: RGBDFrame, keyframe: TrackingKeyframe, found: point_to_plane.Match) -> float | None:
    if current.pattern is None or keyframe.frame.pattern is None or not len(found.block):
        return None
    here, there = current.pattern[current.surface.index[found.chosen]], keyframe.frame.pattern[found.block]
    energy = float(here @ here + there @ there) / 2
    return float(here @ there) / energy if energy > MIN_PATTERN_ENERGY * len(here) else None


def _covariance(estimate: PoseEstimate, found: point_to_plane.Match) -> tuple[se3.Matrix6, float]:
    """Return the pose's covariance, and the deviation of the surface seen in the worst direction, metres."""
    if not len(found.block):
        return np.diag(np.full(6, np.inf)), float("inf")
    center = found.moved.mean(axis=1).astype(np.float64)
    around = np.eye(4)
    around[:3, 3] = center
    lever = max(0.1, float(np.sqrt(found.moved.astype(np.float64).var(axis=1).sum())))
    to_metres = se3.adjoint(around) @ np.diag([1, 1, 1, *[1 / lever] * 3])
    planes, noise, corners = (
        to_metres.T @ H @ to_metres
        for H in (estimate.planes, NOISE_FACTOR * estimate.spurious, estimate.corners)
    )
    values, axes = np.linalg.eigh(planes - noise)
    known, axes = np.linalg.eigh(axes @ np.diag(np.maximum(values, 0)) @ axes.T + corners)
    variances = estimate.overcount / np.maximum(known, 1e-9)
    to_camera = se3.adjoint(se3.inverse(estimate.T_anchor_camera)) @ to_metres @ axes
    return (to_camera * variances) @ to_camera.T, float(np.sqrt(variances.max()))
