# SPDX-License-Identifier: MIT
"""Memory that a first keyframe asks for: a voxel size far too small is refused before anything starts."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import BLOCK_COST, CARVING_QUOTA, SensorModel, ServerConfig, VolumeConfig
from tsfusion.core.distinct_integers import distinct
from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.measured_points import points_camera

_BLOCK = 8  # voxels, edge of a block
_VOXEL_BYTES = 20  # sums and colour
_SIZES = (0.0001, 0.0002, 0.0003, 0.0005, 0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1)  # metres


def check_fits(keyframe: Keyframe, config: VolumeConfig, server: ServerConfig | None = None) -> None:
    """Raise InvalidConfig when this keyframe alone needs more blocks than a keyframe may touch, or may add.

    Args:
        server: settings of the server; None = the usual ones.
    """
    points, model = _within_range(keyframe, config), config.model(keyframe.sensor)
    cost = (server or ServerConfig()).quota_cost * (CARVING_QUOTA if config.space_carving else 1)
    most = min(config.max_blocks_per_keyframe, cost // BLOCK_COST)
    setting = "max_blocks_per_keyframe" if most == config.max_blocks_per_keyframe else "quota_cost"
    blocks = _blocks(points, config.voxel_size, model)
    if blocks <= most:
        return
    fitting = next(
        (size for size in _SIZES if 2 * _blocks(points, size, model) <= most),
        _SIZES[-1],
    )
    gigabytes = blocks * _BLOCK**3 * _VOXEL_BYTES / 1e9
    raise InvalidConfig(
        f"voxel_size {config.voxel_size:g} m is too small here: the first keyframe alone would need "
        f"some {gigabytes:.1f} GB ({blocks} blocks, and {setting} allows {most}); "
        f"use {fitting:g} or more"
    )


def _within_range(keyframe: Keyframe, config: VolumeConfig) -> NDArray[np.float64]:
    """(n, 3) metres in the sensor's frame."""
    model, points = config.model(keyframe.sensor), points_camera(keyframe)
    points = points[np.isfinite(points).all(axis=1)]
    ranges = np.linalg.norm(points, axis=1) if keyframe.kind == "points" else points[:, 2]
    return points[(ranges >= model.min_range) & (ranges <= model.max_range)]


def _blocks(points: NDArray[np.float64], voxel_size: float, model: SensorModel) -> int:
    """Number of blocks that hold points, times those that a ray's band crosses at the least."""
    if not len(points):
        return 0
    x, y, z = np.floor(points / (_BLOCK * voxel_size)).astype(np.int64).T
    support = min(max(3 * model.sigma_floor / voxel_size, model.min_support), model.max_support)
    return round(len(distinct((x << 42) ^ (y << 21) ^ z)) * (1 + 2 * support / _BLOCK))
