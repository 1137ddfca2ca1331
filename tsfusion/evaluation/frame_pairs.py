# SPDX-License-Identifier: MIT
"""Pair frames of a dataset, and measure how well points of the first fit the surface of the second."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.color_placement import Outlines, outlines
from tsfusion.datasets.dataset import Dataset, frame_of, readable
from tsfusion.evaluation.depth_views import (
    DepthView,
    UnitEvidence,
    depth_view,
    unit_evidence,
)
from tsfusion.geometry import se3
from tsfusion.geometry.frame import FrameKind
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

Fits = NDArray[np.float64]  # (pairs,), each 0 to 1

FIRST_FRAMES = 5  # first frames of pairs, spread over the recording
PAIR_GAPS = (1, 4, 16)  # difference between the frame indices of a pair
MIN_COMPARED = 0.1  # share of the points; if fewer fall on a measurement, the fit is 0
MIN_FIT = 0.5  # with a smaller fit, a pair is no evidence for a pose
MIN_GAIN = 0.1  # mean increase of the fit that a correction must give
MIN_BETTER = 0.7  # share of the pairs that must fit better
FIRST_STEP = 0.03  # radians, and metres for each metre of depth
STEP_ROUNDS = 8
STRAY_PRICE = 0.5  # fit that a correction must gain for each radian, or for a shift as long as the depth


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """Parts of a frame that the pose check keeps after it has read the frame.

    Attributes:
        kind: what the sensor measures.
        depth: evidence about the unit of depth.
        view: the measured surface; None if too little was measured.
        outlines: edges of depth and image; None without both.
        skewed: the surface without correction of the motion during the sweep; None if there is no correction.
    """

    kind: FrameKind
    depth: UnitEvidence
    T_world_camera: Transform | None
    view: DepthView | None
    outlines: Outlines | None
    skewed: DepthView | None


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames with a pose and a measured surface each; `first` and `second` are the frames' indices."""

    first: int
    second: int
    poses: tuple[Transform, Transform]
    first_view: DepthView
    second_view: DepthView

    def motion(self, intended: Callable[[Transform], Transform] = np.asarray) -> Transform:
        """Return the (4, 4) transform from the first frame's axes to the second's. `intended` corrects a
        pose."""
        first, second = (intended(T) for T in self.poses)
        return np.asarray(np.linalg.inv(second) @ first, np.float64)

    def fit(self, motion: Transform, tolerance: float = 1.0) -> float:
        """Return how well the first frame's points fit the second's surface, 0 to 1; 0 with too few points.

        Args:
            tolerance: factor on the tolerance of the sensors.
        """
        return self.fit_of_shared(motion, tolerance) or 0.0

    def fit_of_shared(self, motion: Transform, tolerance: float = 1.0) -> float | None:
        """Return the same as `fit`, but None if too few points can be compared."""
        points = motion[:3, :3] @ self.first_view.points
        points += motion[:3, 3:]
        deviation = self.second_view.deviation(points)
        compared = np.count_nonzero(np.isfinite(deviation))
        if compared < MIN_COMPARED * len(deviation):
            return None
        fits = 1 - (deviation / tolerance) ** 2
        return float(np.maximum(fits, 0, out=fits).sum()) / compared

    def shift(self, motion: Transform, other: Transform) -> float:
        """Return the median distance between the first frame's points after two motions, metres."""
        points = self.first_view.points
        difference = (motion - other)[:3]
        return float(np.median(np.linalg.norm(difference[:, :3] @ points + difference[:, 3:], axis=0)))

    def seen_by(self, camera: Intrinsics, *, along_ray: bool = False) -> "FramePair":
        """Return the pair as if measured by another camera, or along each pixel's ray."""
        views = self.first_view, self.second_view
        first, second = (view.seen_by(camera, along_ray=along_ray) for view in views)
        return replace(self, first_view=first, second_view=second)


def wanted_pairs(count: int) -> list[tuple[int, int]]:
    """Return the frame indices of each pair to compare, for a dataset of `count` frames."""
    last = max(0, count - 1 - min(PAIR_GAPS[-1], count // 2))
    anchors = sorted({round(index) for index in np.linspace(0, last, FIRST_FRAMES)})
    return [(first, first + gap) for first in anchors for gap in PAIR_GAPS if first + gap < count]


def seen_frames(dataset: Dataset, wanted: Sequence[tuple[int, ...]]) -> dict[int, SeenFrame]:
    """Read the frames of some pairs, each once. Return index → frame, without unreadable frames.

    Raises:
        DatasetError: a frame cannot be read.
    """
    indices = sorted({index for pair in wanted for index in pair} or {0})
    return dict(readable(partial(_seen, dataset), indices))


def _seen(dataset: Dataset, index: int) -> SeenFrame:
    frame = frame_of(dataset, index)
    view = depth_view(frame)
    skewed = None if frame.motion is None else depth_view(replace(frame, motion=None))
    unit = unit_evidence(frame, view)
    return SeenFrame(frame.kind, unit, frame.T_world_camera, view, outlines(frame), skewed)


def pairs_of(frames: dict[int, SeenFrame], wanted: Sequence[tuple[int, int]]) -> list[FramePair]:
    """Return the pairs whose frames both have a pose and a measured surface."""
    pairs = []
    for i, j in wanted:
        first, second = frames.get(i), frames.get(j)
        if first is None or second is None or first.view is None or second.view is None:
            continue
        if first.T_world_camera is not None and second.T_world_camera is not None:
            poses = first.T_world_camera, second.T_world_camera
            pairs.append(FramePair(i, j, poses, first.view, second.view))
    return pairs


def fits_of(pairs: Sequence[FramePair], motions: Sequence[Transform]) -> Fits:
    return np.array([pair.fit(motion) for pair, motion in zip(pairs, motions, strict=True)])


def mean_gain(fits: Fits, given: Fits) -> float:
    """Return by how much fits are better than the given fits, on average; 0 if it may be an accident."""
    evidence = np.maximum(fits, given) >= MIN_FIT
    if not evidence.any() or fits[evidence].mean() < MIN_FIT or (fits > given)[evidence].mean() < MIN_BETTER:
        return 0.0
    gain = float((fits - given)[evidence].mean())
    return gain if gain > MIN_GAIN else 0.0


def mean_where(values: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    """Return the mean of the values where a mask is True, to three decimals; 0 without any."""
    return round(float(values[where].mean()), 3) if where.any() else 0.0


def scaled_motion(motion: Transform, factor: float) -> Transform:
    stretched: Transform = np.array(motion)
    stretched[:3, 3] *= factor
    return stretched


def best_fits_near(pairs: Sequence[FramePair], motions: Sequence[Transform]) -> Fits:
    """Return the best fit of each pair after small corrections of its motion."""
    return np.array([best_near(pair, motion)[0] for pair, motion in zip(pairs, motions, strict=True)])


def best_near(pair: FramePair, motion: Transform, *, coarse: Sequence[float] = ()) -> tuple[float, Transform]:
    """Return the best fit after small corrections of a motion (hill climbing), and the corrected motion.

    If the fit is 0 at the start, it stays 0.

    Args:
        coarse: larger tolerances, as factors on the sensors', to climb with first from far away. Then a
            correction must gain in proportion to its size: otherwise it would slide along a wall, which does
            not show such a motion.
    """
    given, price = motion, STRAY_PRICE if coarse else 0.0

    def worth(motion: Transform, tolerance: float) -> float:
        fit = pair.fit(motion, tolerance)
        if not price or not fit:
            return fit
        stray = motion - given
        size = np.linalg.norm(stray[:3, 3]) / pair.second_view.range_m + np.linalg.norm(stray[:3, :3])
        return max(1e-9, fit - price * float(size))

    for tolerance in (*coarse, 1.0):
        motion = _climb(pair, motion, partial(worth, tolerance=tolerance))
    return pair.fit(motion), motion


def _climb(pair: FramePair, motion: Transform, worth: Callable[[Transform], float]) -> Transform:
    best = worth(motion)
    if best == 0:
        return motion
    steps = np.array([FIRST_STEP * pair.second_view.range_m] * 3 + [FIRST_STEP] * 3)
    for _ in range(STEP_ROUNDS):
        before = best
        corrections = se3.exp(np.stack([np.diag(steps), -np.diag(steps)], axis=1))  # (6 axes, 2 ways, 4, 4)
        for of_axis in corrections:
            for correction in of_axis:
                moved = correction @ motion
                if (fit := worth(moved)) > best:
                    motion, best = moved, fit
                    break
        if best == before:
            steps /= 2
    return motion


def share_of_best(given: Fits, best: Fits) -> float:
    """Return how much of the best fit the given fit reaches, 0 to 1, over pairs that fit at best; or 1."""
    evidence = best >= MIN_FIT
    return float(given[evidence].sum() / best[evidence].sum()) if evidence.any() else 1.0
