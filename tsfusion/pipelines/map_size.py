# SPDX-License-Identifier: MIT
"""Memory that a first keyframe asks for: a voxel size far too small is refused before anything starts."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import SensorModel, VolumeConfig
from tsfusion.core.distinct_integers import distinct
from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.measured_points import points_camera

_BLOCK = 8  # voxels, edge of a block
_VOXEL_BYTES = 20  # sums and colour
_SIZES = tuple(digit * 10.0**power for power in range(-4, 1) for digit in (1, 2, 3, 5))  # metres


def check_fits(keyframe: Keyframe, config: VolumeConfig) -> None:
    """Raise InvalidConfig when this keyframe alone needs more blocks than a keyframe may touch."""
    points, most = _within_range(keyframe, config), config.max_blocks_per_keyframe
    model = config.model(keyframe.sensor)
    blocks = _blocks(points, config.voxel_size, model)
    if blocks <= most:
        return
    fitting = next(
        (size for size in _SIZES if 4 * _blocks(points, size, model) <= most),
        _SIZES[-1],
    )
    gigabytes = blocks * _BLOCK**3 * _VOXEL_BYTES / 1e9
    raise InvalidConfig(
        f"voxel_size {config.voxel_size:g} m is too small here: the first keyframe alone would need "
        f"some {gigabytes:.1f} GB ({blocks} blocks, and max_blocks_per_keyframe is {most}); "
        f"use {fitting:g} or more"
    )


def _within_range(keyframe: Keyframe, config: VolumeConfig) -> NDArray[np.float64]:
    """(n, 3) metres in the sensor's frame."""
    model, points = config.model(keyframe.sensor), points_camera(keyframe)
    points = points[np.isfinite(points).all(axis=1)]
    ranges = np.linalg.norm(points, axis=1) if keyframe.kind == "points" else points[:, 2]
    return points[(ranges >= model.min_range) & (ranges <= model.max_range)]


def _blocks(points: NDArray[np.float64], voxel_size: float, model: SensorModel) -> int:
    """Number of blocks that hold points, times those that a ray's band crosses: an estimate."""
    if not len(points):
        return 0
    x, y, z = np.floor(points / (_BLOCK * voxel_size)).astype(np.int64).T
    support = min(max(3 * model.sigma_floor / voxel_size, model.min_support), model.max_support)
    return round(len(distinct((x << 42) ^ (y << 21) ^ z)) * (1 + 2 * support / _BLOCK))
