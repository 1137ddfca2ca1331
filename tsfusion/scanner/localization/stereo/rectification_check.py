# SPDX-License-Identifier: MIT
"""Whether a stereo pair is as well rectified as it claims: seen from its own images, without a target.

Rows: a corner of the left image and its match in the right one must lie in the same row. Disparity: one that
is off by the same amount everywhere bends space, and that shows when the camera moves (see `reprojection`).
Both come from a wrong or an old calibration.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tsfusion.scanner.localization.features import Pixels

_log = logging.getLogger(__name__)

ROWS_LIMIT = 0.8  # pixels; seen: KITTI 06 0.6
DISPARITY_LIMIT = 0.4  # pixels; KITTI 06 shows 0.1
_PAIRS = 8
_FEWEST = 30  # matches of one pair
_SURE = 3.0  # standard deviations
_TRUSTED = 0.3  # pixels of an offset's standard deviation: more says that the sensor did not move enough
_TURNS = 3
_SWAPPED_BY = 2.0  # pixels
_MOST = 0.7  # of the matches


@dataclass(frozen=True, kw_only=True)
class RectificationCheck:
    """What the first pairs say of their rectification.

    Attributes:
        pairs: how many were looked at.
        matches: corners compared.
        rows_px: by how many rows the right image's points lie lower than the left's, at the image's centre.
        roll_deg: clockwise turn of the right image against the left one, seen along the view.
        stretch: factor of the right image's height against the left's.
        worst_rows_px: the largest row error of these three within the image.
        disparity_px: by how much every disparity is too high; None = cannot be told yet (too little motion).
        problems: for a person, each with what to do; empty = nothing was found.
    """

    pairs: int
    matches: int
    rows_px: float
    roll_deg: float
    stretch: float
    worst_rows_px: float
    disparity_px: float | None
    problems: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.problems


class RectificationMonitor:
    """Collects what pairs and motions show, and warns once of each thing that is wrong.

    Attributes:
        check: the verdict; None until enough pairs were seen.
    """

    def __init__(self) -> None:
        self.check: RectificationCheck | None = None
        self._left: list[Pixels] = []
        self._right: list[Pixels] = []
        self._offsets: list[float] = []
        self._sigmas: list[float] = []

    @property
    def wants_pair(self) -> bool:
        """Whether another pair's matches are of use."""
        return len(self._left) < _PAIRS

    @property
    def wants_motion(self) -> bool:
        """Whether another motion's offset is of use."""
        return len(self._offsets) < _PAIRS

    def add_pair(self, left: Pixels, right: Pixels, shape: tuple[int, ...]) -> None:
        """(n, 2) pixels of the same corners in both images of one pair."""
        if len(left) < _FEWEST:
            return
        self._left.append(left)
        self._right.append(right)
        if not self.wants_pair:
            self.check = _check_rows(self._left, self._right, shape)
            for problem in self.check.problems:
                _log.warning(problem)
            self._check_disparity()

    def add_motion(self, offset: float, sigma: float) -> None:
        """What one motion says all disparities lack, pixels."""
        if np.isfinite([offset, sigma]).all() and sigma < _TRUSTED:
            self._offsets.append(offset)
            self._sigmas.append(sigma)
            self._check_disparity()

    def _check_disparity(self) -> None:
        if self.check is None or self.wants_motion or self.check.disparity_px is not None:
            return
        too_high = -_sure_offset(np.array(self._offsets), np.array(self._sigmas))
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
    if np.mean(second[:, 0] > first[:, 0] + _SWAPPED_BY) > _MOST:
        problems += ("points lie farther right in the right image: left and right are swapped",)
    return RectificationCheck(
        pairs=len(left),
        matches=len(first),
        rows_px=shift,
        roll_deg=roll,
        stretch=1 + by_row,
        worst_rows_px=worst,
        disparity_px=None,
        problems=problems,
    )


def _disparity_problem(too_high: float) -> str:
    return (
        f"disparities are about {abs(too_high):.1f} px too {'high' if too_high > 0 else 'low'}: depth is "
        "wrong, the more the farther, and lengths with it; calibrate the stereo pair again (the principal "
        "points, or the angle between the cameras)"
    )


def _sure_offset(offsets: NDArray[np.float64], sigmas: NDArray[np.float64]) -> float:
    """The motions' median, or 0 where that may be chance."""
    middle = float(np.median(offsets))
    spread = 1.4826 * float(np.median(np.abs(offsets - middle)))
    error = max(spread, float(np.median(sigmas))) / np.sqrt(len(offsets))
    return middle if abs(middle) > _SURE * error else 0.0


def _plane(centred: NDArray[np.floating], rows: NDArray[np.floating]) -> NDArray[np.float64]:
    """(shift, by column, by row) of the row differences: least squares, mismatches left out by turns."""
    A = np.column_stack([np.ones(len(centred)), centred]).astype(np.float64)
    kept = np.abs(rows - np.median(rows)) < 4.0
    solution = np.zeros(3)
    for _ in range(_TURNS):
        solution = np.linalg.lstsq(A[kept], rows[kept], rcond=None)[0]
        residual = np.abs(rows - A @ solution)
        kept = residual < max(3 * 1.4826 * float(np.median(residual)), 0.1)
    return solution
