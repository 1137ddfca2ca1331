# SPDX-License-Identifier: MIT
"""Fit a factor on translations, a factor on the focal length, and a time shift, so that frames fit best."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.dataset import Dataset, pose_of
from tsfusion.evaluation.frame_pairs import MIN_FIT, Fits, FramePair, fits_of, mean_gain, scaled_motion
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

WIDEST_SCALE = np.log(12)  # logarithm of the largest factor tried besides the usual factors
SCALE_STEPS = 61
WIDEST_FOCAL = np.log(2.5)
FOCAL_STEPS = 37
FINE_STEPS = 21
AS_GOOD = 0.02  # two fits with a smaller difference count as equal
MIN_PAIRS = 3
MIN_SCALE_ERROR = 0.05  # smaller errors are a matter of the sensors' calibration
MIN_FOCAL_ERROR = 0.03
MIN_FOCAL_SIGMA = 0.005  # of the focal length: pixels and sensors allow no better
MIN_SIGMAS = 3.0  # standard errors by which a factor must differ from 1
MIN_SURE_GAIN = 0.004
MIN_EXPLAINED = 0.08  # share of the misfit that a factor must explain
MIN_GAIN_SIGMAS = 2.0

Logs = NDArray[np.float64]
FitsAt = Callable[[float], Fits]  # the fits of all pairs with a factor
MAX_SHIFT = 8  # frames, in both directions
MIN_SHIFT_PAIRS = 2
MIN_SHIFT_GAIN = 0.05
MIN_SHIFT_SHARE = 0.7  # share of the gain that small corrections give


@dataclass(frozen=True, eq=False)
class FittedFactor:
    """Factor on translations, or on the focal length, with which pairs of frames fit best.

    Attributes:
        factor: factor with the highest mean fit of the pairs.
        sigma: standard error of the factor, relative; infinite if the pairs do not show it.
        fits: fits of the pairs with the factor.
        gain: mean gain over the given fits; 0 unless it is sure.
    """

    factor: float
    sigma: float
    fits: Fits
    gain: float


def fitted_scale(
    pairs: Sequence[FramePair], motions: Sequence[Transform], given: Fits, *, usual: Sequence[float]
) -> FittedFactor:
    """Return the factor on translations that fits best, preferably a usual one.

    If poses without translations fit as well, the pairs do not show the scale: the gain is 0.
    """

    def fits_at(factor: float) -> Fits:
        return fits_of(pairs, [scaled_motion(motion, factor) for motion in motions])

    best_usual = max(((factor, fits_at(factor)) for factor in usual), key=lambda each: float(each[1].mean()))
    found = _fitted(fits_at, WIDEST_SCALE, SCALE_STEPS, given, least=MIN_SCALE_ERROR)
    if best_usual[1].mean() > found.fits.mean() - AS_GOOD:
        found = FittedFactor(*best_usual[:1], 0.0, best_usual[1], mean_gain(best_usual[1], given))
    if found.gain > MIN_SURE_GAIN and found.fits.mean() < fits_at(0.0).mean() + min(AS_GOOD, found.gain):
        return FittedFactor(1.0, 0.0, given, 0.0)
    return found


def fitted_focal_length(
    pairs: Sequence[FramePair], motions: Sequence[Transform], given: Fits
) -> FittedFactor | None:
    """Return the factor on `fx` and `fy` that fits best; None for a scan, or stereo (it scales depth)."""
    view = pairs[0].first_view
    K = view.camera
    if K is None or view.stereo:
        return None
    return _fitted(
        lambda factor: fits_of([pair.seen_by(zoomed(K, factor)) for pair in pairs], motions),
        WIDEST_FOCAL,
        FOCAL_STEPS,
        given,
        least=MIN_FOCAL_ERROR,
    )


def zoomed(K: Intrinsics, factor: float) -> Intrinsics:
    return Intrinsics(K.fx * factor, K.fy * factor, K.cx, K.cy)


def sure_gain(fits: Fits, given: Fits) -> float:
    """Return the mean gain of `fits` over the given fits; 0 unless it is large, or clearly no accident."""
    evidence = (np.maximum(fits, given) >= MIN_FIT) & (np.minimum(fits, given) > 0)
    if evidence.sum() < MIN_PAIRS or fits[evidence].mean() < MIN_FIT:
        return mean_gain(fits, given)
    gains = (fits - given)[evidence]
    gain, error = float(gains.mean()), float(gains.std() / np.sqrt(len(gains)))
    # If the sensor moves little, most pairs show nothing: few pairs gain, but none loses.
    one_sided = (gains > AS_GOOD).sum() >= MIN_PAIRS and gains.min() > -AS_GOOD / 2
    no_accident = gain > MIN_GAIN_SIGMAS * error or (gains > 0).all() or one_sided
    enough = gain > max(MIN_SURE_GAIN, MIN_EXPLAINED * float(1 - given[evidence].mean()))
    return gain if no_accident and enough else mean_gain(fits, given)


def _fitted(fits_at: FitsAt, widest: float, steps: int, given: Fits, *, least: float) -> FittedFactor:
    coarse = np.linspace(-widest, widest, steps)
    peak = coarse[int(np.argmax([fits_at(float(np.exp(log))).mean() for log in coarse]))]
    logs = peak + np.linspace(-2, 2, FINE_STEPS) * (coarse[1] - coarse[0])
    curves = np.array([fits_at(float(np.exp(log))) for log in logs])  # (steps, pairs)
    # A pair may overlap too little with some factors only: it would make the curve jump.
    smooth = (curves.min(axis=0) > 0) & (curves.max(axis=0) >= MIN_FIT)
    log, sigma = _peak_and_error(logs, curves[:, smooth] if smooth.any() else curves)
    if smooth.sum() < MIN_PAIRS or not logs[0] < log < logs[-1]:
        sigma = float("inf")
    fits = fits_at(float(np.exp(log)))
    off = abs(log) > max(least, MIN_SIGMAS * sigma)
    return FittedFactor(
        float(np.exp(log)), sigma, fits, sure_gain(fits, given) if off else mean_gain(fits, given)
    )


def _peak_and_error(logs: Logs, curves: NDArray[np.float64]) -> tuple[float, float]:
    """Return the peak of the sum of the pairs' curves, and its standard error (jackknife over the pairs)."""
    total, count = curves.sum(axis=1), curves.shape[1]
    left_out = np.array([_peak(logs, total - curve) for curve in curves.T])
    error = np.sqrt((count - 1) / count * ((left_out - left_out.mean()) ** 2).sum())
    return _peak(logs, total), float(error)


def _peak(at: Logs, values: NDArray[np.float64]) -> float:
    """Return the position of a curve's peak, interpolated between the samples by a parabola."""
    top = int(np.argmax(values))
    if not 0 < top < len(at) - 1:
        return float(at[top])
    before, here, after = values[top - 1 : top + 2]
    bend = before - 2 * here + after
    return float(at[top] + (at[1] - at[0]) * (0.5 * (before - after) / bend if bend < 0 else 0.0))


def time_shift(dataset: Dataset, pairs: Sequence[FramePair], best: Fits) -> int | None:
    """Return by how many frames the poses are late (negative = early), or None without a clear shift.

    A shift is clear if poses of frames so much later fit better than the poses as given, by most of the gain
    that small corrections of the poses give (`best`: fits of the pairs after these corrections).
    """
    gap = next((gap for gap in (4, 1) if any(p.second - p.first == gap for p in pairs)), None)
    indices = [index for index, pair in enumerate(pairs) if pair.second - pair.first == gap][::2]
    chosen, reachable = [pairs[index] for index in indices], best[indices]
    poses: dict[int, Transform | None] = {}

    def pose(index: int) -> Transform | None:
        if index not in poses:
            poses[index] = pose_of(dataset, index) if 0 <= index < len(dataset) else None
        return poses[index]

    def fits(late: int) -> Fits:
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
        if known.sum() < MIN_SHIFT_PAIRS or moved[known].mean() < MIN_FIT:
            continue
        if (moved > given)[known].all():
            gain, missing = (float((each - given)[known].mean()) for each in (moved, reachable))
            if gain > max(MIN_SHIFT_GAIN, MIN_SHIFT_SHARE * missing):
                found = max(found, (gain, late))
    return found[1] or None


def time_text(dataset: Dataset, late: int) -> str:
    """Return the mistake and its remedy for poses that are `late` frames late."""
    shift = f"{abs(late)} frame{'s' if abs(late) > 1 else ''}"
    stamps = dataset.timestamps_ns
    if stamps is not None and len(stamps) > 1:
        shift += f" ({abs(late) * float(np.median(np.diff(stamps))) / 1e6:.0f} ms)"
    way = (
        "late: each frame fits the pose of a later one"
        if late > 0
        else "early: each frame fits an earlier pose"
    )
    return f"the poses' times are about {shift} {way}; shift their time stamps"
