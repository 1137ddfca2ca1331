# SPDX-License-Identifier: MIT
"""A trajectory as a picture: seen from above, coloured by its error, and the error along the way."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.evaluation.trajectory import Poses, aligned_to

_NARROWEST = 0.4  # of the view's longer side


def draw(estimate: Poses, reference: Poses, path: Path, *, align: bool = True) -> None:
    """Write a .png, .pdf or .svg of (n, 4, 4) poses in pairs.

    It is looked at along the direction in which the reference moves least.
    """
    from matplotlib.figure import Figure

    aligned = aligned_to(estimate, reference) if align else estimate
    positions, truth = aligned[:, :3, 3], reference[:, :3, 3]
    error = np.linalg.norm(positions - truth, axis=1)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth, axis=0), axis=1))])
    center = truth.mean(axis=0)
    axes = np.linalg.svd(truth - center, full_matrices=False)[2][:2]
    a, b = (positions - center) @ axes.T, (truth - center) @ axes.T
    factor, unit = (1000, "mm") if error.max() < 1 else (1, "m")

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    view, course = figure.subplots(1, 2)
    view.plot(*b.T, color="0.75", linewidth=3, label="reference", zorder=1)
    drawn = view.scatter(*a.T, c=error * factor, s=6, cmap="viridis", label="estimate", zorder=2)
    figure.colorbar(drawn, ax=view, label=f"error, {unit}")
    both = np.vstack([a, b])
    (left, low), (right, high) = _limits(both.min(axis=0), both.max(axis=0))
    view.set(aspect="equal", xlim=(left, right), ylim=(low, high), xlabel="m", ylabel="m")
    view.set_title("trajectory, seen across its widest plane")
    view.legend(loc="best")
    course.plot(along, error * factor, linewidth=1)
    rmse = float(np.sqrt(np.mean(error**2)))
    course.axhline(rmse * factor, color="0.5", linestyle="--", label=f"RMSE {rmse * factor:.3g} {unit}")
    course.set(xlabel="way, m", ylabel=f"error, {unit}", title="absolute error along the way", ylim=(0, None))
    course.legend(loc="best")
    figure.savefig(path, dpi=110)


def _limits(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lower and upper limits, (2, 2), with a margin; a straight way is still seen in a window, not a slit."""
    extent = high - low
    wanted = np.maximum(1.1 * extent, _NARROWEST * extent.max() or 1.0)
    middle = (low + high) / 2
    return np.array([middle - wanted / 2, middle + wanted / 2])
