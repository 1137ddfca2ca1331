# SPDX-License-Identifier: MIT
"""The part of a map in a box, voxel by voxel."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig
from tsfusion.kernels.integrate import CHANGED
from tsfusion.tsdf.block_store import BlockStore, unpack_keys

_CHUNK = 1024  # blocks at a time
_MOST = 1 << 24  # voxels from the origin: beyond any map


def voxel_range(box: Sequence[float], voxel_size: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The voxels whose centres lie in a box: first (3,), and last + 1 (3,). Boxes side by side share none.

    Args:
        box: x0, y0, z0, x1, y1, z1 in metres; a centre on the upper side is outside.

    Raises:
        InvalidConfig: for anything else.
    """
    corners = np.asarray(box, np.float64)
    if corners.shape != (6,) or not np.isfinite(corners).all() or (corners[:3] >= corners[3:]).any():
        raise InvalidConfig(f"a box must be x0 y0 z0 x1 y1 z1 in metres, each 0 less than its 1, got {box}")
    edges = np.ceil(np.clip(corners / voxel_size, -_MOST, _MOST) - 0.5).astype(np.int64)
    return edges[:3], edges[3:]


def copy(store: BlockStore, into: BlockStore, first: NDArray[np.int64], end: NDArray[np.int64]) -> None:
    """Copy the voxels `first` ≤ (x, y, z) < `end` to a store without blocks; those around them stay zero.

    Raises:
        MemoryError: when there is no room.
    """
    used = store.used()
    corners = 8 * unpack_keys(store.keys[used]).astype(np.int64)
    used = used[((corners < end) & (corners + 8 > first)).all(axis=1)]
    steps = np.arange(8)
    for i in range(0, len(used), _CHUNK):
        slots = used[i : i + _CHUNK]
        along = 8 * unpack_keys(store.keys[slots]).astype(np.int64)[:, :, None] + steps  # (n, 3, 8)
        x, y, z = ((along >= first[:, None]) & (along < end[:, None])).transpose(1, 0, 2)
        inside = (x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]).reshape(-1, 512)
        kept = (np.where(inside, store.sums[slots], 0) != 0).any(axis=1)
        slots, inside = slots[kept], inside[kept]
        here = into.count
        into.insert(store.keys[slots])
        for name, layer in into.layers().items():
            layer[here : into.count] = np.where(inside, store.layers()[name][slots], 0)
        into.note_written(np.arange(here, into.count))
        store.keep_within_memory()
    into.measure_bounds()
    into.dirty[: into.count] = CHANGED
