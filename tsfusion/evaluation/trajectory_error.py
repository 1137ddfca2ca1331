# SPDX-License-Identifier: MIT
"""Compute the error of an estimated trajectory (Sturm et al., "A benchmark for RGB-D SLAM systems", 2012)."""

import logging
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import NOMINAL_NS, Dataset, nearest_in_time, pose_of
from tsfusion.datasets.trajectory_files import read_poses
from tsfusion.geometry import se3
from tsfusion.geometry.se3 import Poses

log = logging.getLogger(__name__)


class TrajectoryError(msgspec.Struct, frozen=True, kw_only=True):
    """Absolute trajectory error over `count` poses, metres, and drift.

    Attributes:
        length: length of the reference's path, metres.
        drift_percent: distance between the ends of both paths in percent of `length`, after their first poses
            were made equal; 0 if `length` is 0.
        rotation_deg: mean angle between the two orientations after the alignment of positions.
    """

    count: int
    min: float
    max: float
    mean: float
    median: float
    std: float
    rmse: float
    length: float
    drift_percent: float
    rotation_deg: float


def umeyama(
    source: NDArray[np.floating], target: NDArray[np.floating], *, with_scale: bool = False
) -> tuple[NDArray[np.float64], float]:
    """Find the rigid motion that best brings (n, 3) points onto others (Umeyama 1991, eq. 34-43).

    Returns:
        (4, 4) rotation and translation, and the scale (1 without `with_scale`): target ≈ scale·R·source + t.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centered = source - mean_source
    U, S, Vt = np.linalg.svd((target - mean_target).T @ centered / len(source))
    sign = np.array([1.0, 1.0, 1.0 if np.linalg.det(U) * np.linalg.det(Vt) > 0 else -1.0])
    R = U @ np.diag(sign) @ Vt
    variance = float((centered**2).sum() / len(source))
    scale = float((S * sign).sum() / variance) if with_scale and variance > 0 else 1.0
    return se3.transform(R, mean_target - scale * R @ mean_source), scale


def absolute_error(estimate: Poses, reference: Poses, *, align: bool = True) -> TrajectoryError:
    """Return the error of paired poses after the best rigid motion (`align`), as `evo_ape -a` does.

    Raises:
        DatasetError: there are fewer than 2 pairs, or unequal numbers of poses.
    """
    if len(estimate) != len(reference) or len(estimate) < 2:
        raise DatasetError(
            f"two positions or more are needed of each trajectory, got {len(estimate)} and {len(reference)}"
        )
    aligned = aligned_to(estimate, reference) if align else estimate
    error = np.linalg.norm(aligned[:, :3, 3] - reference[:, :3, 3], axis=1)
    traces = np.einsum("nij,nij->n", aligned[:, :3, :3], reference[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
    length = float(np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1).sum())
    error = error.round(12)  # picometres: smaller differences are rounding errors
    return TrajectoryError(
        count=len(error),
        min=float(error.min()),
        max=float(error.max()),
        mean=float(error.mean()),
        median=float(np.median(error)),
        std=float(error.std()),
        rmse=float(np.sqrt(np.mean(error**2))),
        length=length,
        drift_percent=100 * _end_error(estimate, reference) / length if length > 0 else 0.0,
        rotation_deg=float(angles.mean()),
    )


def aligned_to(estimate: Poses, reference: Poses) -> Poses:
    """Return the estimate after the rigid motion that brings its positions nearest to the reference's."""
    T, _ = umeyama(estimate[:, :3, 3], reference[:, :3, 3])
    moved: Poses = T @ estimate
    return moved


def _end_error(estimate: Poses, reference: Poses) -> float:
    """Return the metres between the last positions, each relative to the first pose of its trajectory."""
    ends = [np.linalg.solve(poses[0], poses[-1]) for poses in (estimate, reference)]
    return float(np.linalg.norm(ends[0][:3, 3] - ends[1][:3, 3]))


def associate(
    first_ns: NDArray[np.int64], second_ns: NDArray[np.int64], max_difference_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of poses paired by time: each of the shorter list with the nearest of the other.

    Raises:
        DatasetError: no two times are within `max_difference_ns`.
    """
    swapped = len(first_ns) > len(second_ns)
    few, many = (second_ns, first_ns) if swapped else (first_ns, second_ns)
    nearest = nearest_in_time(many, few)
    kept = np.flatnonzero(np.abs(many[nearest] - few) <= max_difference_ns)
    if not len(kept):
        raise DatasetError(
            f"no two poses are within {max_difference_ns / 1e9:g} s of each other: the trajectories cover "
            f"{_span(first_ns)} and {_span(second_ns)}; are they of one recording and clock? "
            "--max-difference allows more"
        )
    return (nearest[kept], kept) if swapped else (kept, nearest[kept])


def _span(stamps_ns: NDArray[np.int64]) -> str:
    return f"{stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s"


def dataset_trajectory(dataset: Dataset) -> tuple[NDArray[np.int64] | None, Poses]:
    """Read the poses that a recording has for its frames.

    Returns:
        (n,) timestamps in nanoseconds, or None without timestamps; and (n, 4, 4) poses, NaN for frames
        without a pose.

    Raises:
        DatasetError: no frame has a pose.
    """
    found = [pose_of(dataset, index) for index in range(len(dataset))]
    if all(T is None for T in found):
        raise DatasetError(f"{dataset.name} has no poses to compare with; give a trajectory file")
    return dataset.timestamps_ns, np.array([np.full((4, 4), np.nan) if T is None else T for T in found])


def paired(
    estimate: Path, reference: Path | Dataset, *, max_difference_s: float = 0.01
) -> tuple[Poses, Poses]:
    """Pair the poses of two files, or of a file and a recording. The log tells which share has a partner.

    Poses are paired by time if both have times. The frames of a recording without times get the times that
    `tsfusion scan` writes for their numbers. Otherwise poses are paired line by line.

    Raises:
        DatasetError: less than half of the shorter trajectory is paired, or the numbers of poses differ and
            there are no times.
    """
    stamps, poses = read_poses(estimate)
    of_reference = read_poses(reference) if isinstance(reference, Path) else dataset_trajectory(reference)
    times, references = of_reference
    if times is None and not isinstance(reference, Path):
        if stamps is not None and not (stamps % NOMINAL_NS).any():
            times = NOMINAL_NS * np.arange(1, len(references) + 1, dtype=np.int64)
        elif len(poses) != len(references):
            references = _known(references)
    if stamps is not None and times is not None:
        ours, theirs = (np.isfinite(each[:, 0, 0]) for each in (poses, references))
        poses, stamps, references, times = poses[ours], stamps[ours], references[theirs], times[theirs]
        a, b = associate(stamps, times, round(min(max_difference_s, 1e9) * 1e9))
        _tell_share(len(a), min(len(poses), len(references)), max_difference_s)
        return poses[a], references[b]
    if len(poses) != len(references):
        name = reference if isinstance(reference, Path) else reference.name
        timeless = " and ".join(str(each) for each, of in ((estimate, stamps), (name, times)) if of is None)
        raise DatasetError(
            f"{estimate} has {len(poses)} poses and {name} {len(references)}, to be paired line by line as "
            f"there are no times in {timeless}: give an estimate with times (TUM's format), and as reference "
            "a file with times or the dataset's folder"
        )
    both = np.isfinite(poses[:, 0, 0]) & np.isfinite(references[:, 0, 0])
    return poses[both], references[both]


def _known(poses: Poses) -> Poses:
    return poses[np.isfinite(poses[:, 0, 0])]


def _tell_share(pairs: int, shorter: int, max_difference_s: float) -> None:
    """Log how many poses have a partner. Raise DatasetError if it is less than half."""
    text = f"{pairs} of {shorter} poses have a partner within {max_difference_s:g} s"
    if 2 * pairs < shorter:
        raise DatasetError(
            f"only {text}, too few for a figure of the whole: are both of one recording and clock? "
            "--max-difference SECONDS allows more between the two"
        )
    if pairs < shorter:
        log.warning("%s; the error is of these", text)


_NARROWEST = 0.4  # of the view's longer side: shorter side, at least


def draw(estimate: Poses, reference: Poses, path: Path, *, align: bool = True) -> None:
    """Write a .png, .pdf or .svg of (n, 4, 4) poses in pairs.

    The view is along the direction in which the reference moves least.
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
    """Return a plot's lower and upper limits, (2, 2), with a margin. A straight path gets no narrow slit."""
    extent = high - low
    wanted = np.maximum(1.1 * extent, _NARROWEST * extent.max() or 1.0)
    middle = (low + high) / 2
    return np.array([middle - wanted / 2, middle + wanted / 2])
