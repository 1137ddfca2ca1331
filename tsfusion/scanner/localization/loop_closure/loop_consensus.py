# SPDX-License-Identifier: MIT
"""Decide which loops to accept, by the views, the odometry, and the support of other loops."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.scanner.localization import features
from tsfusion.scanner.localization.loop_closure.dense_alignment import (
    Agreement,
    agreement,
    openness,
    refine,
)
from tsfusion.scanner.localization.loop_closure.place_index import PlaceView
from tsfusion.scanner.localization.loop_closure.pose_graph import PoseGraphEdge, information

GATE = 6.0  # most standard deviations between a loop and the known poses
AMBIGUITY_GATE = 12.0  # standard deviations; up to this, another explanation is not ruled out
MIN_SUPPORT = 3  # keyframes whose loops must agree before the first loop is accepted;
EXPECTED_GATE = 3.0  # one less is enough within so many standard deviations of the known poses
SUPPORT_WINDOW = 15  # keyframes for which a loop waits for support
MAX_TWINS = 4  # similar other places remembered for each place
ROTATION_SIGMA = 0.005  # radians, standard deviation of a loop
MAX_RATIO = 0.9  # best descriptor distance divided by the second best
MAX_DIFFERENT_BITS = 64  # of 256, in a match
PIXEL_TOLERANCE = 3.0  # pixels at width 640
MIN_INLIERS = 20
MIN_SPREAD = 0.05  # share of the image inside the convex hull of the matches that agree
MAX_DISTANCE, MAX_DEGREES = 0.06, 4.0  # between the poses of both directions; 0.06 of the scene's depth
# Shares of the pixels with depth in both views; first for measured depth, second for depth from stereo. The
# first line is for pixels that agree, the second for pixels where a camera sees through the other's surface.
# Measured with a Kinect: true loops in a kitchen have >= 0.92 and <= 0.007, false loops in a corridor with a
# tiled floor <= 0.90 and >= 0.065.
MIN_AGREEMENT = (0.85, 0.6)
MAX_THROUGH = (0.04, 0.12)
MIN_OVERLAP = 0.2  # share of the pixels with depth
# By depth alone: shares, and metres that the depths may leave open
MIN_AGREEMENT_ALONE, MIN_OVERLAP_ALONE, MAX_OPEN = 0.95, 0.5, 0.004


@dataclass(frozen=True, kw_only=True)
class OdometryDrift:
    """Standard deviations of odometry over a way. One radian of turning counts as one metre of way."""

    translation: float = 0.02  # metres after one metre; grows with the square root of the way
    rotation: float = 0.01  # radians after one metre; grows likewise
    translation_bias: float = 0.01  # systematic error, metres for each metre
    rotation_bias: float = 0.002  # systematic error, radians for each metre
    floor: float = 0.002  # metres (and a third of it in radians) for each single step


class OdometryChain:
    """Tracking keyframes in order: odometry's poses, and the motion between any two with its covariance.

    The covariance of a stretch is the difference of two sums in the world's axes. So it costs the same over
    ten keyframes and over ten thousand.
    """

    def __init__(self, drift: OdometryDrift) -> None:
        self._drift = drift
        self.poses: dict[int, se3.Transform] = {}  # keyframe → (4, 4) T_world_camera by odometry
        self.edges: list[PoseGraphEdge] = []  # from each keyframe to the next, for the pose graph
        self.ways: dict[int, float] = {}  # keyframe → metres plus radians along the path since the first
        self._sums: dict[int, se3.Matrix6] = {}  # keyframe → (6, 6) sum of covariances, world axes

    def add(self, number: int, T_world_camera: se3.Transform) -> None:
        """Append a keyframe with its (4, 4) pose by odometry."""
        last = next(reversed(self.poses), None)
        if last is None:
            self.ways[number], self._sums[number] = 0.0, np.zeros((6, 6))
        else:
            step = se3.inverse(self.poses[last]) @ T_world_camera
            way = se3.distance(step) + se3.angle(step)
            d = self._drift
            variances = [d.translation**2 * way + d.floor**2] * 3 + [d.rotation**2 * way + d.floor**2 / 9] * 3
            A = se3.adjoint(T_world_camera)
            self.edges.append(PoseGraphEdge(last, number, step, np.diag(1 / np.array(variances))))
            self.ways[number] = self.ways[last] + way
            self._sums[number] = self._sums[last] + (A * variances) @ A.T
        self.poses[number] = T_world_camera

    def between(self, start: int, end: int) -> tuple[se3.Transform, se3.Matrix6]:
        """Return `T_start_end` by odometry, and its (6, 6) covariance as a twist in the axes of `end`."""
        T = se3.inverse(self.poses[start]) @ self.poses[end]
        A = se3.adjoint(se3.inverse(self.poses[end]))
        way, d = abs(self.ways[end] - self.ways[start]), self._drift
        forward = 1.0 if self.ways[end] >= self.ways[start] else -1.0
        walk = forward * A @ (self._sums[end] - self._sums[start]) @ A.T
        bias = [(d.translation_bias * way) ** 2] * 3 + [(d.rotation_bias * way) ** 2] * 3
        return T, walk + np.diag(bias)


@dataclass(frozen=True, eq=False)
class Loop:
    """Claim that keyframe `new` is at `T_old_new` in the axes of `old`, with `sigma` metres of deviation."""

    old: int
    new: int
    T_old_new: se3.Transform
    sigma: float

    @property
    def edge(self) -> PoseGraphEdge:
        """The loop as an edge of the pose graph."""
        return PoseGraphEdge(
            self.old, self.new, self.T_old_new, information(self.sigma, ROTATION_SIGMA), robust=True
        )

    @property
    def covariance(self) -> se3.Matrix6:
        """Covariance (6, 6) of the loop, as a twist in the axes of `new`."""
        return np.diag([self.sigma**2] * 3 + [ROTATION_SIGMA**2] * 3)


class LoopConsensus:
    """Decide which loops to accept. Each loop was verified before, by comparing its two views.

    1. The loop must not contradict the odometry. This is checked over the shortest way: from the start of the
       loop to its end, or through a loop accepted before.
    2. No other explanation may remain. A view may fit two places, or its place may look like another one (a
       *twin*). Then the loop is accepted only if odometry rules the other place out.
    3. Loops of three keyframes near each other must agree pairwise before any is accepted (Mangelson et al.,
       "Pairwise Consistent Measurement Set Maximization", 2018). Two are enough if odometry expects the loop.
       Later loops nearby need only agree with one accepted loop.
    """

    def __init__(self, chain: OdometryChain) -> None:
        self._chain = chain
        self.accepted: list[Loop] = []
        self._ends = np.empty((0, 2))  # (way at `old`, way at `new`) of each accepted loop
        self._waiting: list[Loop] = []
        self._twins: dict[
            int, list[tuple[int, se3.Transform]]
        ] = {}  # place → (another, T_another_place) by looks
        self.refused: dict[str, int] = {}

    def add(self, loops: list[Loop]) -> list[Loop]:
        """Add one keyframe's loops. Return the loops to accept now; some of them may have waited."""
        if not loops:
            return []
        deviations = [self.deviation(loop.old, loop.new, loop.T_old_new, loop.covariance) for loop in loops]
        allowed = [loop for loop, d in zip(loops, deviations, strict=True) if d <= GATE]
        for loop, d in zip(loops, deviations, strict=True):
            if d > GATE:
                self._count("contradicts the odometry")
                self._remember_twin(loop, allowed)
        if not allowed:
            return []
        if (
            self._ambiguous(allowed)
            or min((d for d in deviations if d > GATE), default=np.inf) < AMBIGUITY_GATE
        ):
            self._count("fits another place too")
            return []
        return [found for loop in allowed for found in self._supported(loop)]

    def deviation(self, old: int, new: int, T_old_new: se3.Transform, covariance: se3.Matrix6) -> float:
        """Return the standard deviations (the square root of χ²) between a claim and the known poses."""
        T, known = self._known(old, new)
        error = se3.log(se3.inverse(T_old_new) @ T)
        return float(np.sqrt(error @ np.linalg.solve(known + covariance, error)))

    def unique(self, place: int) -> bool:
        """Return True if no other place looks like this one."""
        return place not in self._twins

    def withdraw(self, loop: Loop) -> None:
        """Withdraw a loop that the pose graph found wrong."""
        self.accepted.remove(loop)
        self._count_ends()
        self._count("contradicts other loops")

    def _known(self, old: int, new: int) -> tuple[se3.Transform, se3.Matrix6]:
        """Return `T_old_new` and its covariance over the shortest way."""
        ways = self._chain.ways
        direct = abs(ways[new] - ways[old])
        if self.accepted:
            over = np.abs(self._ends - (ways[old], ways[new])).sum(axis=1)
            best = int(over.argmin())
            if over[best] < direct:
                return self._through(self.accepted[best], old, new)
        return self._chain.between(old, new)

    def _through(self, loop: Loop, old: int, new: int) -> tuple[se3.Transform, se3.Matrix6]:
        """Return `T_old_new` and its covariance by odometry to a loop, the loop, and odometry again."""
        first, first_covariance = self._chain.between(old, loop.old)
        last, covariance = self._chain.between(loop.new, new)
        for behind, known in ((last, loop.covariance), (loop.T_old_new @ last, first_covariance)):
            A = se3.adjoint(se3.inverse(behind))
            covariance = covariance + A @ known @ A.T
        return first @ loop.T_old_new @ last, covariance

    def _supported(self, loop: Loop) -> list[Loop]:
        """Accept the loop, and waiting loops that agree, if they are enough. Return the accepted loops."""
        if any(
            self._age(other, loop) <= SUPPORT_WINDOW and self._agree(other, loop) for other in self.accepted
        ):
            self._accept([loop])
            return [loop]
        self._waiting = [w for w in self._waiting if self._age(w, loop) <= SUPPORT_WINDOW]
        friends: list[Loop] = []
        for other in reversed(self._waiting):
            if all(self._agree(other, friend) for friend in [loop, *friends]):
                friends.insert(0, other)
        expected = self.deviation(loop.old, loop.new, loop.T_old_new, loop.covariance) <= EXPECTED_GATE
        if len({loop.new, *(friend.new for friend in friends)}) < MIN_SUPPORT - expected:
            self._waiting.append(loop)
            return []
        self._waiting = [w for w in self._waiting if w not in friends]
        self._accept([*friends, loop])
        return [*friends, loop]

    def _accept(self, loops: list[Loop]) -> None:
        self.accepted += loops
        self._count_ends()

    def _count_ends(self) -> None:
        ways = self._chain.ways
        self._ends = np.array([(ways[loop.old], ways[loop.new]) for loop in self.accepted]).reshape(-1, 2)

    def _age(self, earlier: Loop, later: Loop) -> int:
        return abs(later.new - earlier.new)

    def _agree(self, one: Loop, two: Loop) -> bool:
        T, known = self._through(one, two.old, two.new)
        error = se3.log(se3.inverse(two.T_old_new) @ T)
        return bool(error @ np.linalg.solve(known + two.covariance, error) <= GATE**2)

    def _remember_twin(self, wrong: Loop, right: Iterable[Loop]) -> None:
        """Remember that `wrong.old` looks like `wrong.new` and like the old places of the loops `right`."""
        self._add_twin(wrong.new, wrong.old, wrong.T_old_new)
        for loop in right:
            self._add_twin(loop.old, wrong.old, wrong.T_old_new @ se3.inverse(loop.T_old_new))

    def _add_twin(self, place: int, other: int, T_other_place: se3.Transform) -> None:
        for a, b, T in ((place, other, T_other_place), (other, place, se3.inverse(T_other_place))):
            twins = self._twins.setdefault(a, [])
            twins.append((b, T))
            del twins[:-MAX_TWINS]

    def _ambiguous(self, loops: list[Loop]) -> bool:
        """Return True if one keyframe's loops leave its pose ambiguous."""
        for one, two in itertools.combinations(loops, 2):
            if not self._agree(one, two):
                self._remember_twin(two, [one])
                return True
        return any(self._has_twin(loop) for loop in loops)

    def _has_twin(self, loop: Loop) -> bool:
        """Return True if the loop's place looks like another place where the keyframe could be as well."""
        for other, T_other_old in self._twins.get(loop.old, []):
            claim = T_other_old @ loop.T_old_new
            if (
                other != loop.new
                and self.deviation(other, loop.new, claim, 2 * loop.covariance) < AMBIGUITY_GATE
            ):
                return True
        return False

    def _count(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopCheck:
    """Result of comparing two views."""

    # (4, 4) pose of the new camera in the old camera's axes; None if none was found
    T_old_new: se3.Transform | None = None
    refused: str | None = None  # reason why the views are not of one place; None if they are
    inliers: int = 0  # matches that agree with the pose
    sigma: float = 0.0  # standard deviation of the pose, metres


def check_loop(old: PlaceView, new: PlaceView, expected: se3.Transform | None = None) -> LoopCheck:
    """Compare two views, of one camera or of two.

    Without colour they are compared by measured depth alone, near the (4, 4) `expected` T_old_new.

    Repeated structure is refused if the depth of either view contradicts the other. Two places that look the
    same in every pixel pass; only the trajectory can tell such places apart.
    """
    first, second = matches(old.descriptors, new.descriptors)
    if expected is not None and not len(old.descriptors) and not len(new.descriptors):
        return _check_depth(old, new, expected)
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
    sigma = _sigma(old, new, float(np.nanpercentile(old.points[first][:, 2], 25)))
    return LoopCheck(T_old_new=T, refused=refused, inliers=count, sigma=sigma)


def _sigma(old: PlaceView, new: PlaceView, near: float) -> float:
    return max(0.01, 0.01 * near, 0.3 * max(old.noise, new.noise) * near**2)


def _check_depth(old: PlaceView, new: PlaceView, T_old_new: se3.Transform) -> LoopCheck:
    """Compare two views by their depth alone."""
    if not (old.measured and new.measured and old.depth_mm.any() and new.depth_mm.any()):
        return LoopCheck(refused="no measured depth")
    none = np.empty(0, np.int64)
    T = refine(old, new, T_old_new, none, none)
    apart = T @ refine(new, old, se3.inverse(T_old_new), none, none)
    near = float(np.percentile(old.depth_mm[old.depth_mm > 0], 25)) / 1000
    if se3.distance(apart) > MAX_DISTANCE * near or np.degrees(se3.angle(apart)) > MAX_DEGREES:
        return LoopCheck(T_old_new=T, refused="the poses found both ways differ")
    T = T @ se3.exp(-0.5 * se3.log(apart))
    depths, left_open = agreement(old, new, T), openness(old, new, T)
    refused = _contradiction(depths, measured=True)
    if depths.overlap < MIN_OVERLAP_ALONE or depths.agree < MIN_AGREEMENT_ALONE or left_open > MAX_OPEN:
        refused = refused or f"depth alone leaves the pose open by {left_open:.3f} m"
    return LoopCheck(T_old_new=T, refused=refused, sigma=_sigma(old, new, near))


def matches(old: NDArray[np.uint8], new: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Match (n, 32) and (m, 32) descriptors. Return the rows that are clearly each other's nearest."""
    if min(len(old), len(new)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    # The product of ±1 vectors is 256 minus twice the Hamming distance; one product serves both directions.
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
    """Find T_points_camera by RANSAC over three points (P3P) and refinement; also return (n,) inliers."""
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
