# SPDX-License-Identifier: MIT
"""Check the rectification of a stereo pair from its own images, without a calibration target.

Two errors of a wrong or an old calibration are found. Rows: a corner of the left image and its match in the
right image must lie in the same row. Disparity: an error that is the same everywhere bends space, which shows
when the camera moves (see `reprojection`). The tracker's disparities are corrected by it.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tsfusion.scanner.localization.features import Pixels

_log = logging.getLogger(__name__)

ROWS_LIMIT = 0.8  # pixels; 0.6 in KITTI 06
DISPARITY_LIMIT = 0.4  # pixels; 0.1 in KITTI 06
SAMPLES = 8  # pairs until the verdict on rows, and motions until that on disparity
MIN_MATCHES = 30  # in one pair
MAX_OFFSET_SIGMA = 0.3  # pixels; a motion with a larger deviation was too small
PAIR_SIGMA = 0.1  # pixels, deviation of the offset from pair to pair, before anything is measured
MOTION_SIGMA = 0.15  # pixels, deviation of one motion's offset, beside its own sigma
FIT_ROUNDS = 3
MIN_SWAP, MIN_SWAPPED_SHARE = 2.0, 0.7  # pixels to the wrong side, share of such matches


@dataclass(frozen=True, kw_only=True)
class RectificationCheck:
    """Rectification errors found in the first pairs."""

    pairs: int  # number of pairs compared
    matches: int  # number of corners compared
    rows_px: float  # rows at the image's centre by which the right image's points lie lower than the left's
    roll_deg: float  # clockwise rotation of the right image against the left, seen along the view
    stretch: float  # right image's height divided by the left's
    worst_rows_px: float  # the largest row error of these three within the image
    # Pixels by which every disparity is too high; None = not known yet (too little motion)
    disparity_px: float | None
    problems: tuple[str, ...]  # texts for the user, each with a remedy; empty if no error was found

    @property
    def ok(self) -> bool:
        return not self.problems


class RectificationMonitor:
    """Collect the errors of pairs and motions, and warn once of each problem."""

    def __init__(self) -> None:
        self.check: RectificationCheck | None = None  # result so far; None before enough pairs
        self.offset = 0.0  # pixels to add to every disparity: most likely value by the motions so far
        self._certainty = PAIR_SIGMA**-2  # of the offset, 1/px²
        self._left: list[Pixels] = []
        self._right: list[Pixels] = []
        self._motions = 0

    @property
    def wants_pair(self) -> bool:
        return len(self._left) < SAMPLES

    @property
    def wants_motion(self) -> bool:
        return self._motions < SAMPLES

    def add_pair(self, left: Pixels, right: Pixels, shape: tuple[int, ...]) -> None:
        """Add the (n, 2) pixels of the same corners in the left and the right image of one pair."""
        if len(left) < MIN_MATCHES:
            return
        self._left.append(left)
        self._right.append(right)
        if not self.wants_pair:
            self.check = _check_rows(self._left, self._right, shape)
            for problem in self.check.problems:
                _log.warning(problem)
            self._check_disparity()

    def add_motion(self, offset: float, sigma: float) -> None:
        """Add the offset of all disparities that was estimated from one motion, pixels."""
        if not (np.isfinite([offset, sigma]).all() and sigma < MAX_OFFSET_SIGMA):
            return
        certainty = 1 / (sigma**2 + MOTION_SIGMA**2)
        self._certainty += certainty
        self.offset += (offset - self.offset) * certainty / self._certainty
        self._motions += 1
        self._check_disparity()

    def _check_disparity(self) -> None:
        if self.check is None or self.wants_motion or self.check.disparity_px is not None:
            return
        too_high = -self.offset * self._certainty / (self._certainty - PAIR_SIGMA**-2)
        problems = self.check.problems
        if abs(too_high) > DISPARITY_LIMIT:
            problems += (_disparity_problem(too_high),)
            _log.warning(problems[-1])
        self.check = replace(self.check, disparity_px=too_high, problems=problems)


def _check_rows(left: list[Pixels], right: list[Pixels], shape: tuple[int, ...]) -> RectificationCheck:
    height, width = shape[:2]
    first, second = np.concatenate(left), np.concatenate(right)
    centred = first - np.array([(width - 1) / 2, (height - 1) / 2])
    shift, by_column, by_row = map(float, _plane(centred, second[:, 1] - first[:, 1]))
    worst = abs(shift) + abs(by_column) * width / 2 + abs(by_row) * height / 2
    roll = float(np.degrees(by_column))
    problems: tuple[str, ...] = ()
    if worst > ROWS_LIMIT:
        problems = (
            f"rows of the stereo pair differ by up to {worst:.1f} px (shift {shift:+.2f} px, roll "
            f"{roll:+.2f}°, height ×{1 + by_row:.4f}): the pair is not rectified; calibrate the two cameras "
            "again, or rectify the images",
        )
    if np.mean(second[:, 0] > first[:, 0] + MIN_SWAP) > MIN_SWAPPED_SHARE:
        problems += ("points lie farther right in the right image: left and right are swapped",)
    return RectificationCheck(
        pairs=len(left), matches=len(first), rows_px=shift, roll_deg=roll, stretch=1 + by_row,
        worst_rows_px=worst, disparity_px=None, problems=problems,
    )  # fmt: skip


def _disparity_problem(too_high: float) -> str:
    return (
        f"disparities are about {abs(too_high):.1f} px too {'high' if too_high > 0 else 'low'}: depth is "
        "wrong, the more the farther, and lengths with it; calibrate the stereo pair again (the principal "
        "points, or the angle between the cameras)"
    )


def _plane(centred: NDArray[np.floating], rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """Fit (shift, slope by column, slope by row) to row differences by least squares, without mismatches."""
    A = np.column_stack([np.ones(len(centred)), centred]).astype(np.float64)
    kept = np.abs(rows - np.median(rows)) < 4.0
    solution = np.zeros(3)
    for _ in range(FIT_ROUNDS):
        solution = np.linalg.lstsq(A[kept], rows[kept], rcond=None)[0]
        residual = np.abs(rows - A @ solution)
        kept = residual < max(3 * 1.4826 * float(np.median(residual)), 0.1)
    return solution
