# SPDX-License-Identifier: MIT
"""Do poses and depth agree? Frames are projected into their neighbours; if they do not fit, why not?

A usual mistake (poses inverted, OpenGL axes, wrong units, …) is named when the poses it stands for fit
clearly better than those given. Poses that no such mistake explains are moved a little to see whether the
measurements could fit better than they do. Where the sensor hardly moves, or frames share nothing, nobody can
tell, and that is what is said.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.dataset import Dataset, frame_of, pose_of
from tsfusion.evaluation.depth_views import DepthView, view_of
from tsfusion.evaluation.pose_mistakes import MISTAKES, SCALES, or_text, scale_text, untold_text
from tsfusion.geometry import se3
from tsfusion.geometry.se3 import Transform

Verdict = Literal["agree", "disagree", "cannot tell"]
Motion = NDArray[np.float64]  # (4, 4), from the first frame of a pair to the second

_ANCHORS = 5
_GAPS = (1, 4, 16)  # frames between the two of a pair
_COMPARED = 0.1  # share of the points that must fall on something measured
_FITS = 0.5  # a pair that fits less well than this says nothing for a pose
_CLEARLY = 0.1  # what a mistake must fit better by, on average
_MOSTLY = 0.7  # of the pairs must be for it
_SPREAD = 0.05  # if wrong poses fit nearly as well, nobody can tell
_LOST = 0.8  # of what a small correction would reach: less is a disagreement
_SUSPICIOUS = 0.97
_SHIFTS = 8  # frames that poses are tried early or late
_SHIFT_PAIRS = 2
_SHIFT_CLEARLY = 0.05
_SHIFT_SHARE = 0.7  # of what small corrections reach
_WIDEST = np.log(12)  # of the factors tried beside the known ones
_STEPS = 61
_AS_GOOD = 0.02
_STEP = 0.03  # radians, and metres per metre of depth
_ROUNDS = 8
_UNEXPLAINED = (
    "poses and depth disagree, and none of the usual mistakes explains it: small corrections make frames fit "
    "much better than the poses do; the poses may be wrong, of another sensor or body, or badly timed"
)


@dataclass(frozen=True)
class PoseCheckReport:
    """What a check found.

    Attributes:
        verdict: `disagree` only when it is sure.
        text: a sentence or two: what is wrong and what to do.
        mistake: short name of it: one of `MISTAKES`, `scale`, `time`, `unexplained`; None when they agree.
        alternatives: (other) mistakes under which these frames would fit as well.
        factor: for `scale`, what translations must be multiplied by.
        shift: for `time`, frames later whose pose each frame should have.
        pairs: of frames compared.
        fit: 0 to 1, how well the pairs fit as given; 1 = within a small part of what sensors may differ by.
        best_fit: after small corrections.
        tried: the same for the poses that each mistake stands for, by its name.
    """

    verdict: Verdict
    text: str
    mistake: str | None = None
    alternatives: tuple[str, ...] = ()
    factor: float | None = None
    shift: float | None = None
    pairs: int = 0
    fit: float | None = None
    best_fit: float | None = None
    tried: dict[str, float] = field(default_factory=dict)


def check(dataset: Dataset) -> PoseCheckReport:
    """Compare some neighbouring frames of a dataset under its poses and under those of usual mistakes.

    Takes about a second, of a LiDAR two; reads about 20 frames.

    Raises:
        DatasetError: a frame cannot be read.
    """
    pairs = _pairs(dataset)
    if not pairs:
        return PoseCheckReport("cannot tell", "no two frames with a pose and a measurement")
    motions = [pair.motion() for pair in pairs]
    given = _fits(pairs, motions)
    best = _refined(pairs, motions)
    tried = {mistake.name: _fits(pairs, [p.motion(mistake.meant) for p in pairs]) for mistake in MISTAKES}
    report = partial(
        PoseCheckReport,
        pairs=len(pairs),
        fit=_mean(given, best >= _FITS),
        best_fit=_mean(best, best >= _FITS),
        tried={name: _mean(fits, np.maximum(fits, given) >= _FITS) for name, fits in tried.items()},
    )
    factor, scaled = _best_scale(pairs, motions)
    gains, scale_gain = {name: _gain(fits, given) for name, fits in tried.items()}, _gain(scaled, given)
    gain = max(gains.values())
    likely = [mistake for mistake in MISTAKES if gains[mistake.name] > gain - _AS_GOOD]
    if gain > 0 and gain >= scale_gain and _explains(pairs, [p.motion(likely[0].meant) for p in pairs]):
        alternatives = tuple(mistake.name for mistake in likely[1:])
        return report(
            verdict="disagree",
            text=f"poses and depth disagree: {likely[0].text}" + or_text(alternatives),
            mistake=likely[0].name,
            alternatives=alternatives,
        )
    if scale_gain > 0 and _explains(pairs, [_stretched(motion, factor) for motion in motions]):
        return report(verdict="disagree", text=scale_text(factor), mistake="scale", factor=round(factor, 4))
    told = _told(given, best)
    if told < _SUSPICIOUS and (late := _time_shift(dataset, pairs, best)) is not None:
        return report(verdict="disagree", text=_time_text(dataset, late), mistake="time", shift=late)
    if told < _LOST:
        return report(verdict="disagree", text=_UNEXPLAINED, mistake="unexplained")
    if not (given >= _FITS).any():
        return report(verdict="cannot tell", text="the frames looked at share too little to tell")
    if np.mean(given) - np.median([np.mean(fits) for fits in tried.values()]) < _SPREAD:
        return report(verdict="cannot tell", text="the sensor hardly moves between the frames looked at")
    likewise = _likewise(given, tried)
    text = "poses and depth agree" + untold_text(likewise)
    return report(verdict="agree", text=text, alternatives=likewise)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two frames, by index."""

    first: int
    second: int
    poses: tuple[Transform, Transform]
    seen: DepthView
    by: DepthView

    def motion(self, meant: Callable[[Transform], Motion] = np.asarray) -> Motion:
        """From the first sensor's axes to the second's."""
        first, second = (meant(T) for T in self.poses)
        return np.asarray(np.linalg.inv(second) @ first, np.float64)

    def fit(self, motion: Motion) -> float:
        """How well the first frame's points lie on what the second saw, 0 to 1; 0 where too few do."""
        off = self.by.off(se3.apply(motion, self.seen.points))
        compared = np.isfinite(off)
        if compared.mean() < _COMPARED:
            return 0.0
        return float(np.maximum(0, 1 - off[compared] ** 2).mean())


def _pairs(dataset: Dataset) -> list[_Pair]:
    count = len(dataset)
    last = max(0, count - 1 - min(_GAPS[-1], count // 2))
    anchors = sorted({round(index) for index in np.linspace(0, last, _ANCHORS)})
    wanted = [(first, first + gap) for first in anchors for gap in _GAPS if first + gap < count]
    frames = {index: _seen(dataset, index) for index in sorted({i for pair in wanted for i in pair})}
    pairs = []
    for i, j in wanted:
        first, second = frames[i], frames[j]
        if first is not None and second is not None:
            pairs.append(_Pair(i, j, (first[0], second[0]), first[1], second[1]))
    return pairs


def _seen(dataset: Dataset, index: int) -> tuple[Transform, DepthView] | None:
    frame = frame_of(dataset, index)
    view = None if frame.T_world_camera is None else view_of(frame)
    return None if view is None or frame.T_world_camera is None else (frame.T_world_camera, view)


def _fits(pairs: list[_Pair], motions: list[Motion]) -> NDArray[np.float64]:
    return np.array([pair.fit(motion) for pair, motion in zip(pairs, motions, strict=True)])


def _gain(fits: NDArray[np.float64], given: NDArray[np.float64]) -> float:
    """What other poses fit better by than those given, on average; 0 unless that is beyond doubt."""
    telling = np.maximum(fits, given) >= _FITS
    if not telling.any() or fits[telling].mean() < _FITS or (fits > given)[telling].mean() < _MOSTLY:
        return 0.0
    gain = float((fits - given)[telling].mean())
    return gain if gain > _CLEARLY else 0.0


def _best_scale(pairs: list[_Pair], motions: list[Motion]) -> tuple[float, NDArray[np.float64]]:
    """The factor on translations that fits best, a usual one if it is as good, and its fits.

    Translations that fit as well when left out have no scale: 1, and fits of 0.
    """

    def best_of(factors: list[float]) -> tuple[float, float, NDArray[np.float64]]:
        fits = [_fits(pairs, [_stretched(motion, factor) for motion in motions]) for factor in factors]
        best = max(range(len(factors)), key=lambda index: fits[index].mean())
        return float(fits[best].mean()), factors[best], fits[best]

    usual = best_of([factor for factor, _ in SCALES])
    coarse = np.linspace(-_WIDEST, _WIDEST, _STEPS)
    other = best_of(np.exp(coarse).tolist())
    other = best_of(
        (other[1] * np.exp(np.linspace(coarse[0] - coarse[1], coarse[1] - coarse[0], 9))).tolist()
    )
    score, factor, fits = usual if usual[0] > other[0] - _AS_GOOD else other
    if score < best_of([0.0])[0] + _AS_GOOD:
        return 1.0, np.zeros(len(pairs))
    return factor, fits


def _stretched(motion: Motion, factor: float) -> Motion:
    stretched: Motion = np.array(motion)
    stretched[:3, 3] *= factor
    return stretched


def _refined(pairs: list[_Pair], motions: list[Motion]) -> NDArray[np.float64]:
    return np.array([_climbed(pair, motion) for pair, motion in zip(pairs, motions, strict=True)])


def _climbed(pair: _Pair, motion: Motion) -> float:
    """The fit after small corrections of a motion (hill climbing); 0 where there is nothing to correct."""
    best = pair.fit(motion)
    if best == 0:
        return 0.0
    steps = np.array([_STEP * pair.by.range_m] * 3 + [_STEP] * 3)
    for _ in range(_ROUNDS):
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


def _explains(pairs: list[_Pair], motions: list[Motion]) -> bool:
    """Whether motions leave little to be corrected."""
    return _told(_fits(pairs, motions), _refined(pairs, motions)) >= _LOST


def _told(given: NDArray[np.float64], best: NDArray[np.float64]) -> float:
    """Share of what corrections reach that the given poses reach already; 1 where nothing can be told."""
    telling = best >= _FITS
    return float(given[telling].sum() / best[telling].sum()) if telling.any() else 1.0


def _time_shift(dataset: Dataset, pairs: list[_Pair], best: NDArray[np.float64]) -> int | None:
    """Frames later whose poses fit clearly better, None where there are none."""
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
        return np.array([
            np.nan if first is None or second is None else pair.fit(np.linalg.inv(second) @ first)
            for pair, (first, second) in zip(chosen, moved, strict=True)
        ])  # fmt: skip

    given, found = fits(0), (0.0, 0)
    for late in sorted(range(-_SHIFTS, _SHIFTS + 1), key=abs):
        moved = fits(late)
        known = np.isfinite(moved)
        if known.sum() >= _SHIFT_PAIRS and (moved > given)[known].all():
            gain, missing = (float((each - given)[known].mean()) for each in (moved, reachable))
            if gain > max(_SHIFT_CLEARLY, _SHIFT_SHARE * missing):
                found = max(found, (gain, late))
    return found[1] or None


def _likewise(given: NDArray[np.float64], tried: dict[str, NDArray[np.float64]]) -> tuple[str, ...]:
    """The mistakes under which the frames fit as well as under the poses given."""
    gains = {name: _mean(fits - given, np.maximum(fits, given) >= _FITS) for name, fits in tried.items()}
    return tuple(name for name, gain in gains.items() if gain > -_AS_GOOD)


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
