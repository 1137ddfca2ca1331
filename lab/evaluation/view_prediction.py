# SPDX-License-Identifier: MIT
"""Depth that a mesh predicts for a camera, and its difference from the measured depth."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Intrinsics, Keyframe, depth_metres
from tsfusion.geometry.mesh import Mesh


def predicted_depth(
    mesh: Mesh, T_world_camera: NDArray[np.float64], intrinsics: Intrinsics, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """(H, W) float32 metres along the optical axis to the first front side; 0 = none."""
    from tsfusion.kernels.base import runtime

    runtime.start()
    from tsfusion.tsdf.answers import camera_views

    return camera_views.look_at(mesh, intrinsics, T_world_camera, shape).depth


def compare_views(
    mesh: Mesh, keyframes: list[Keyframe], *, max_range: float, voxel_size: float
) -> dict[str, Any]:
    """Predicted against measured depth, over every pixel measured nearer than `max_range` metres.

    Returns:
        `median_mm` and `p90_mm` of the difference where a depth is predicted, which flatters a mesh with
        holes in the difficult places; `all_p90_mm`: with what is not predicted as infinitely off (infinite
        with fewer than 90 % predicted); `within_voxel`: percent of the pixels measured that are predicted
        to a voxel; `predicted`: percent predicted at all.
    """
    errors = [np.empty(0)]
    for keyframe in keyframes:
        z, K = depth_metres(keyframe), keyframe.intrinsics
        assert K is not None  # checked by Keyframe
        guess = predicted_depth(mesh, keyframe.T_world_camera, K, (z.shape[0], z.shape[1]))
        valid = (z > 0) & (z < max_range)
        errors.append(np.where(guess > 0, np.abs(guess - z), np.inf)[valid])
    error = np.sort(np.concatenate(errors))
    count = int(np.isfinite(error).sum())
    median, p90 = np.percentile(error[:count], (50, 90)) * 1e3 if count else (np.nan, np.nan)
    share = 100 / max(len(error), 1)
    return {
        "median_mm": float(median), "p90_mm": float(p90),
        "all_p90_mm": float(error[int(0.9 * len(error))]) * 1e3 if len(error) else np.nan,
        "within_voxel": float((error <= voxel_size).sum() * share), "predicted": count * share,
    }  # fmt: skip
