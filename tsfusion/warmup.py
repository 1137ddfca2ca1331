# SPDX-License-Identifier: MIT
"""Tiny keyframes of every kind, to compile every kernel with."""

import numpy as np

from tsfusion.config import SensorModel
from tsfusion.keyframe import Intrinsics, Keyframe


def warm_up_keyframes(model: SensorModel, voxel_size: float) -> list[Keyframe]:
    """One of each kind and depth type, 16×16, all within the sensor's range."""
    near = max(model.min_range * 1.5, 4 * voxel_size)
    pose, camera = np.eye(4), Intrinsics(20.0, 20.0, 8.0, 8.0)
    color = np.zeros((16, 16, 3), np.uint8)
    metres = np.full((16, 16), near, np.float32)
    units = np.full((16, 16), 1000, np.uint16)
    rays = np.dstack(
        [*np.meshgrid(np.linspace(-0.4, 0.4, 16), np.linspace(-0.4, 0.4, 16)), np.ones((16, 16))]
    )
    points = (rays * near).reshape(-1, 3).astype(np.float32)
    return [
        Keyframe(depth=metres, intrinsics=camera, T_world_camera=pose, color=color),
        Keyframe(depth=units, depth_scale=near / 1000, intrinsics=camera, T_world_camera=pose),
        Keyframe(disparity=units, disparity_scale=1 / 16, baseline_fx=near * 1000 / 16,
                 intrinsics=camera, T_world_camera=pose),
        Keyframe(points=points, T_world_camera=pose, color=color.reshape(-1, 3)),
    ]  # fmt: skip
