# SPDX-License-Identifier: MIT
"""Figures of surface error from arrays of distances and directions."""

import msgspec
import numpy as np
from numpy.typing import NDArray

_CHUNK = 1 << 21  # point-segment pairs measured at once


class DistanceSpread(msgspec.Struct, frozen=True):
    """Mean, root mean square and 95th percentile of errors, millimetres; NaN without errors."""

    mean: float
    rmse: float
    p95: float


def spread_mm(error: NDArray[np.floating]) -> DistanceSpread:
    """Mean, root mean square and 95th percentile of |error|: (n,) metres → millimetres."""
    if not len(error):
        return DistanceSpread(np.nan, np.nan, np.nan)
    size = np.abs(error).astype(np.float64) * 1e3
    return DistanceSpread(
        float(size.mean()), float(np.sqrt((size**2).mean())), float(np.percentile(size, 95))
    )


def percent_within(error: NDArray[np.floating], tolerance: float) -> float:
    """Percent of the errors with |error| <= `tolerance`; NaN without errors."""
    return 100.0 * float((np.abs(error) <= tolerance).mean()) if len(error) else np.nan


def f_score(precision: float, completeness: float) -> float:
    """Harmonic mean of precision and completeness; 0 when both are 0."""
    total = precision + completeness
    return 2 * precision * completeness / total if total else 0.0


def angles(normals: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Degrees between the rows of two (n, 3) arrays of directions; 90 where one has no length."""
    a, b = np.asarray(normals, np.float64), np.asarray(truth, np.float64)
    # atan2 of sine and cosine is exact near 0, where the arc cosine is not
    sine, cosine = np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)
    return np.where((sine == 0) & (cosine == 0), 90.0, np.degrees(np.arctan2(sine, cosine)))


def segment_distance(points: NDArray[np.floating], segments: NDArray[np.floating]) -> NDArray[np.float64]:
    """Distance of each of `points` (n, 3) from the nearest of `segments` (m, 2, 3); infinite without any."""
    points = np.asarray(points, np.float64)
    result = np.full(len(points), np.inf)
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length2 = np.maximum((along**2).sum(axis=1), 1e-30)
    step = max(1, _CHUNK // max(1, len(segments)))
    for first in range(0, len(points) if len(segments) else 0, step):
        offset = points[first : first + step, None] - start  # (k, m, 3)
        share = np.clip((offset * along).sum(axis=2) / length2, 0, 1)
        gap = np.linalg.norm(offset - share[..., None] * along, axis=2)
        result[first : first + step] = gap.min(axis=1)
    return result


def one_per_cell(points: NDArray[np.floating], size: float, *, at_least: int = 1) -> NDArray[np.float64]:
    """The first of `points` (n, 3) in each cube of `size` metres that holds `at_least` so many.

    Dense and sparse parts then count alike.
    """
    cell = np.floor(points / size).astype(np.int64) + (1 << 20)
    key = cell[:, 0] << 42 | cell[:, 1] << 21 | cell[:, 2]
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    return np.asarray(points[np.sort(first[count >= at_least])], np.float64)
