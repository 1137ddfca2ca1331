# SPDX-License-Identifier: MIT
"""Error of an estimated trajectory (Sturm et al., "A benchmark for RGB-D SLAM systems", 2012)."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.errors import DatasetError

Poses = NDArray[np.float64]  # (n, 4, 4) T_world_camera


class TrajectoryError(msgspec.Struct, frozen=True, kw_only=True):
    """Absolute trajectory error, metres, over `count` poses; and how it grows with the way.

    Attributes:
        length: of the reference's path.
        drift_percent: distance between the ends of both paths when their beginnings lie upon each other, in
            percent of `length`; 0 where there is no path.
        rotation_deg: mean angle between the two orientations after the same alignment.
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
    """The rigid motion that brings (n, 3) points nearest to others (Umeyama 1991, eq. 34-43).

    Returns:
        (4, 4) rotation and translation, and the scale (1 without `with_scale`): target ≈ scale·R·source + t.

    Raises:
        DatasetError: for fewer than 2 pairs, or unequal numbers.
    """
    if source.shape != target.shape or len(source) < 2:
        raise DatasetError(
            f"two positions or more are needed of each trajectory to align them, got {len(source)} and "
            f"{len(target)}"
        )
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centered = source - mean_source
    U, S, Vt = np.linalg.svd((target - mean_target).T @ centered / len(source))
    sign = np.array([1.0, 1.0, 1.0 if np.linalg.det(U) * np.linalg.det(Vt) > 0 else -1.0])
    R = U @ np.diag(sign) @ Vt
    variance = float((centered**2).sum() / len(source))
    scale = float((S * sign).sum() / variance) if with_scale and variance > 0 else 1.0
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, mean_target - scale * R @ mean_source
    return T, scale


def absolute_error(estimate: Poses, reference: Poses, *, align: bool = True) -> TrajectoryError:
    """ATE of poses in pairs, after the best rigid motion (`align`): the paper's table, `evo_ape -a`.

    Raises:
        DatasetError: for fewer than 2 pairs, or unequal numbers.
    """
    T, _ = umeyama(estimate[:, :3, 3], reference[:, :3, 3])
    aligned = T @ estimate if align else estimate
    error = np.linalg.norm(aligned[:, :3, 3] - reference[:, :3, 3], axis=1)
    traces = np.einsum("nij,nij->n", aligned[:, :3, :3], reference[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))
    length = float(np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1).sum())
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


def _end_error(estimate: Poses, reference: Poses) -> float:
    """Metres between the last positions, seen from the first poses."""
    ends = [np.linalg.solve(poses[0], poses[-1]) for poses in (estimate, reference)]
    return float(np.linalg.norm(ends[0][:3, 3] - ends[1][:3, 3]))
