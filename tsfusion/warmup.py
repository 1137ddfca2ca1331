# SPDX-License-Identifier: MIT
"""Compile every kernel by running each once on something tiny."""

from itertools import product

import numpy as np

from tsfusion.config import VolumeConfig, override
from tsfusion.keyframe import Intrinsics, Keyframe


def warm_up(config: VolumeConfig) -> None:
    """Integrate, retract and mesh one small keyframe of each kind in a map thrown away."""
    from tsfusion.volume import Volume

    volume = Volume(override(config, max_blocks_per_keyframe=1 << 14))
    near = max(volume.model.min_range * 1.5, 4 * config.voxel_size)
    pose, camera = np.eye(4), Intrinsics(20.0, 20.0, 8.0, 8.0)
    color = np.zeros((16, 16, 3), np.uint8)
    metres = np.full((16, 16), near, np.float32)
    units = np.full((16, 16), 1000, np.uint16)
    rays = np.dstack(
        [*np.meshgrid(np.linspace(-0.4, 0.4, 16), np.linspace(-0.4, 0.4, 16)), np.ones((16, 16))]
    )
    points = (rays * near).reshape(-1, 3).astype(np.float32)
    keyframes = [
        Keyframe(depth=metres, intrinsics=camera, T_world_camera=pose, color=color),
        Keyframe(depth=units, depth_scale=near / 1000, intrinsics=camera, T_world_camera=pose),
        Keyframe(disparity=units, disparity_scale=1 / 16, baseline_fx=near * 1000 / 16,
                 intrinsics=camera, T_world_camera=pose),
        Keyframe(points=points, T_world_camera=pose, color=color.reshape(-1, 3)),
    ]  # fmt: skip
    for keyframe, apply in product(keyframes, (volume.integrate, volume.retract, volume.integrate)):
        apply(keyframe)
    volume.extract_mesh(min_weight=0)
