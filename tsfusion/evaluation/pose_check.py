# SPDX-License-Identifier: MIT
"""Do poses and depth agree? Project frames into their neighbours and see how well they fit.

Where they do not fit, the poses are corrected for each usual mistake (poses inverted, OpenGL axes, wrong
units, …); a mistake whose correction fits clearly better is named. Without such a mistake, small corrections
of the poses show whether the measurements could fit better. Where the sensor hardly moves, or the frames
share no surface, the verdict is `cannot tell`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.dataset import Dataset, frame_of, pose_of
from tsfusion.evaluation.depth_views import DepthView, depth_view
from tsfusion.evaluation.pose_mistakes import (
    MISTAKES,
    SCALES,
    alternatives_text,
    not_ruled_out_text,
    scale_text,
)
from tsfusion.geometry import se3
from tsfusion.geometry.se3 import Transform

Verdict = Literal["agree", "disagree", "cannot tell"]
Motion = NDArray[np.float64]  # (4, 4), from the first frame of a pair to the second

FIRST_FRAMES = 5  # spread over the recording, each the first of some pairs
PAIR_GAPS = (1, 4, 16)  # frames between the two of a pair
MIN_COMPARED = 0.1  # share of the points that must fall on a measurement, or the fit is 0
MIN_FIT = 0.5  # below this a pair is no evidence for a pose
MIN_GAIN = 0.1  # by which a correction must fit better, on average
MIN_BETTER = 0.7  # share of the pairs that must fit better
MIN_LEAD = 0.05  # by which the poses must fit better than the median mistake, or nobody can tell
MIN_SHARE_OF_BEST = 0.8  # fit over the best fit near it: less is a disagreement
TIME_SHIFT_BELOW = 0.97  # share of the best fit below which shifted times are tried
MAX_SHIFT = 8  # frames, early or late
MIN_SHIFT_PAIRS = 2
MIN_SHIFT_GAIN = 0.05
MIN_SHIFT_SHARE = 0.7  # of the gain by small corrections
WIDEST_SCALE = np.log(12)  # logarithm of the largest factor tried beside the usual ones
SCALE_STEPS = 61
AS_GOOD = 0.02  # difference of two fits that counts as none
FIRST_STEP = 0.03  # radians, and metres per metre of depth
STEP_ROUNDS = 8
_UNEXPLAINED = (
    "poses and depth disagree, and none of the usual mistakes explains it: small corrections make frames fit "
    "much better than the poses do; the poses may be wrong, of another sensor or body, or badly timed"
)


@dataclass(frozen=True)
class PoseCheckReport:
    """Result of `check`."""

    verdict: Verdict  # `disagree` only when it is sure
    text: str  # one or two sentences: what is wrong and what to do
    # What is wrong: a name in `MISTAKES`, `scale`, `time`, `unexplained`; None when they agree
    mistake: str | None = None
    alternatives: tuple[str, ...] = ()  # other mistakes whose correction fits as well
    factor: float | None = None  # for `scale`, what translations must be multiplied by
    shift: float | None = None  # for `time`, frames later whose pose each frame should have
    pairs: int = 0  # number of pairs of frames compared
    fit: float | None = None  # 0 to 1, how well the pairs fit as given; 1 = far within the sensors' tolerance
    best_fit: float | None = None  # the fit after small corrections
    # The fit after the correction of each mistake, by its name
    tried: dict[str, float] = field(default_factory=dict)


def check(dataset: Dataset) -> PoseCheckReport:
    """Compare neighbouring frames of a dataset with its poses as given, and corrected for usual mistakes.

    Takes about a second, of a LiDAR two; reads about 20 frames.

    Raises:
        DatasetError: a frame cannot be read.
    """
    pairs = _pairs(dataset)
    if not pairs:
        return PoseCheckReport("cannot tell", "no two frames with a pose and a measurement")
    motions = [pair.motion() for pair in pairs]
    given = _fits_of(pairs, motions)
    best = _best_fits_near(pairs, motions)
    corrected = {mistake.name: [pair.motion(mistake.intended) for pair in pairs] for mistake in MISTAKES}
    tried = {name: _fits_of(pairs, moved) for name, moved in corrected.items()}
    report = partial(
        PoseCheckReport,
        pairs=len(pairs),
        fit=_mean(given, best >= MIN_FIT),
        best_fit=_mean(best, best >= MIN_FIT),
        tried={name: _mean(fits, np.maximum(fits, given) >= MIN_FIT) for name, fits in tried.items()},
    )
    factor, scaled = _best_scale(pairs, motions)
    scale_gain = _mean_gain(scaled, given)
    gains = {name: _mean_gain(fits, given) for name, fits in tried.items()}
    gain = max(gains.values())
    likely = [mistake for mistake in MISTAKES if gains[mistake.name] > gain - AS_GOOD]
    if gain > 0 and gain >= scale_gain and _fit_cannot_improve(pairs, corrected[likely[0].name]):
        alternatives = tuple(mistake.name for mistake in likely[1:])
        return report(
            verdict="disagree",
            text=f"poses and depth disagree: {likely[0].text}" + alternatives_text(alternatives),
            mistake=likely[0].name,
            alternatives=alternatives,
        )
    if scale_gain > 0 and _fit_cannot_improve(pairs, [_scaled_motion(motion, factor) for motion in motions]):
        return report(verdict="disagree", text=scale_text(factor), mistake="scale", factor=round(factor, 4))
    share = _share_of_best(given, best)
    if share < TIME_SHIFT_BELOW and (late := _time_shift(dataset, pairs, best)) is not None:
        return report(verdict="disagree", text=_time_text(dataset, late), mistake="time", shift=late)
    if share < MIN_SHARE_OF_BEST:
        return report(verdict="disagree", text=_UNEXPLAINED, mistake="unexplained")
    if not (given >= MIN_FIT).any():
        return report(verdict="cannot tell", text="the frames looked at share too little to tell")
    if np.mean(given) - np.median([np.mean(fits) for fits in tried.values()]) < MIN_LEAD:
        return report(verdict="cannot tell", text="the sensor hardly moves between the frames looked at")
    equally_good = _equally_good(given, tried)
    text = "poses and depth agree" + not_ruled_out_text(equally_good)
    return report(verdict="agree", text=text, alternatives=equally_good)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two frames with a pose each; `first` and `second` are their indices."""

    first: int
    second: int
    poses: tuple[Transform, Transform]
    first_view: DepthView
    second_view: DepthView

    def motion(self, intended: Callable[[Transform], Motion] = np.asarray) -> Motion:
        """(4, 4) from the first frame's axes to the second's, by the intended poses."""
        first, second = (intended(T) for T in self.poses)
        return np.asarray(np.linalg.inv(second) @ first, np.float64)

    def fit(self, motion: Motion) -> float:
        """Fit of the first frame's points to the second's surface, 0 to 1; 0 if too few can be compared."""
        deviation = self.second_view.deviation(se3.apply(motion, self.first_view.points))
        compared = np.isfinite(deviation)
        if compared.mean() < MIN_COMPARED:
            return 0.0
        return float(np.maximum(0, 1 - deviation[compared] ** 2).mean())


def _pairs(dataset: Dataset) -> list[_Pair]:
    count = len(dataset)
    last = max(0, count - 1 - min(PAIR_GAPS[-1], count // 2))
    anchors = sorted({round(index) for index in np.linspace(0, last, FIRST_FRAMES)})
    wanted = [(first, first + gap) for first in anchors for gap in PAIR_GAPS if first + gap < count]
    frames = {index: _pose_and_view(dataset, index) for index in sorted({i for pair in wanted for i in pair})}
    pairs = []
    for i, j in wanted:
        first, second = frames[i], frames[j]
        if first is not None and second is not None:
            pairs.append(_Pair(i, j, (first[0], second[0]), first[1], second[1]))
    return pairs


def _pose_and_view(dataset: Dataset, index: int) -> tuple[Transform, DepthView] | None:
    frame = frame_of(dataset, index)
    view = None if frame.T_world_camera is None else depth_view(frame)
    return None if view is None or frame.T_world_camera is None else (frame.T_world_camera, view)


def _fits_of(pairs: list[_Pair], motions: list[Motion]) -> NDArray[np.float64]:
    return np.array([pair.fit(motion) for pair, motion in zip(pairs, motions, strict=True)])


def _mean_gain(fits: NDArray[np.float64], given: NDArray[np.float64]) -> float:
    """Mean by which other poses fit better than those given; 0 unless that is beyond doubt."""
    evidence = np.maximum(fits, given) >= MIN_FIT
    if not evidence.any() or fits[evidence].mean() < MIN_FIT or (fits > given)[evidence].mean() < MIN_BETTER:
        return 0.0
    gain = float((fits - given)[evidence].mean())
    return gain if gain > MIN_GAIN else 0.0


def _best_scale(pairs: list[_Pair], motions: list[Motion]) -> tuple[float, NDArray[np.float64]]:
    """The factor on translations that fits best (a usual one if it is as good), and its fits.

    If poses without translations fit as well, nothing shows the scale: 1, and fits of 0.
    """

    def best_of(factors: list[float]) -> tuple[float, float, NDArray[np.float64]]:
        fits = [_fits_of(pairs, [_scaled_motion(motion, factor) for motion in motions]) for factor in factors]
        best = max(range(len(factors)), key=lambda index: fits[index].mean())
        return float(fits[best].mean()), factors[best], fits[best]

    usual = best_of([factor for factor, _ in SCALES])
    coarse = np.linspace(-WIDEST_SCALE, WIDEST_SCALE, SCALE_STEPS)
    other = best_of(np.exp(coarse).tolist())
    other = best_of(
        (other[1] * np.exp(np.linspace(coarse[0] - coarse[1], coarse[1] - coarse[0], 9))).tolist()
    )
    score, factor, fits = usual if usual[0] > other[0] - AS_GOOD else other
    if score < best_of([0.0])[0] + AS_GOOD:
        return 1.0, np.zeros(len(pairs))
    return factor, fits


def _scaled_motion(motion: Motion, factor: float) -> Motion:
    stretched: Motion = np.array(motion)
    stretched[:3, 3] *= factor
    return stretched


def _best_fits_near(pairs: list[_Pair], motions: list[Motion]) -> NDArray[np.float64]:
    return np.array([_best_fit_near(pair, motion) for pair, motion in zip(pairs, motions, strict=True)])


def _best_fit_near(pair: _Pair, motion: Motion) -> float:
    """The best fit that small corrections of a motion reach (hill climbing); 0 where it starts from 0."""
    best = pair.fit(motion)
    if best == 0:
        return 0.0
    steps = np.array([FIRST_STEP * pair.second_view.range_m] * 3 + [FIRST_STEP] * 3)
    for _ in range(STEP_ROUNDS):
        before = best
        for axis in range(6):
            for way in (1.0, -1.0):
                moved = se3.exp(way * steps[axis] * np.eye(6)[axis]) @ motion
                if (fit := pair.fit(moved)) > best:
                    motion, best = moved, fit
                    break
        if best == before:
            steps /= 2
    return best


def _fit_cannot_improve(pairs: list[_Pair], motions: list[Motion]) -> bool:
    """Whether small corrections make motions fit hardly better."""
    return _share_of_best(_fits_of(pairs, motions), _best_fits_near(pairs, motions)) >= MIN_SHARE_OF_BEST


def _share_of_best(given: NDArray[np.float64], best: NDArray[np.float64]) -> float:
    """Fit as given over the best fit near it, over the pairs that are evidence; 1 without any."""
    evidence = best >= MIN_FIT
    return float(given[evidence].sum() / best[evidence].sum()) if evidence.any() else 1.0


def _time_shift(dataset: Dataset, pairs: list[_Pair], best: NDArray[np.float64]) -> int | None:
    """How many frames later the poses fit clearly better; None where no shift does."""
    gap = next((gap for gap in (4, 1) if any(p.second - p.first == gap for p in pairs)), None)
    indices = [index for index, pair in enumerate(pairs) if pair.second - pair.first == gap][::2]
    chosen, reachable = [pairs[index] for index in indices], best[indices]
    poses: dict[int, Transform | None] = {}

    def pose(index: int) -> Transform | None:
        if index not in poses:
            poses[index] = pose_of(dataset, index) if 0 <= index < len(dataset) else None
        return poses[index]

    def fits(late: int) -> NDArray[np.float64]:
        moved = [(pose(pair.first + late), pose(pair.second + late)) for pair in chosen]
        return np.array(
            [
                np.nan if first is None or second is None else pair.fit(np.linalg.inv(second) @ first)
                for pair, (first, second) in zip(chosen, moved, strict=True)
            ]
        )

    given, found = fits(0), (0.0, 0)
    for late in sorted(range(-MAX_SHIFT, MAX_SHIFT + 1), key=abs):
        moved = fits(late)
        known = np.isfinite(moved)
        if known.sum() >= MIN_SHIFT_PAIRS and (moved > given)[known].all():
            gain, missing = (float((each - given)[known].mean()) for each in (moved, reachable))
            if gain > max(MIN_SHIFT_GAIN, MIN_SHIFT_SHARE * missing):
                found = max(found, (gain, late))
    return found[1] or None


def _equally_good(given: NDArray[np.float64], tried: dict[str, NDArray[np.float64]]) -> tuple[str, ...]:
    """The mistakes whose correction fits as well as the poses given."""
    gains = {name: _mean(fits - given, np.maximum(fits, given) >= MIN_FIT) for name, fits in tried.items()}
    return tuple(name for name, gain in gains.items() if gain > -AS_GOOD)


def _mean(values: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    return round(float(values[where].mean()), 3) if where.any() else 0.0


def _time_text(dataset: Dataset, late: int) -> str:
    shift = f"{abs(late)} frame{'s' if abs(late) > 1 else ''}"
    stamps = dataset.timestamps_ns
    if stamps is not None and len(stamps) > 1:
        shift += f" ({abs(late) * float(np.median(np.diff(stamps))) / 1e6:.0f} ms)"
    way = (
        "late: each frame fits the pose of a later one"
        if late > 0
        else "early: each frame fits an earlier pose"
    )
    return f"poses and depth disagree: the poses' times are about {shift} {way}; shift their time stamps"
