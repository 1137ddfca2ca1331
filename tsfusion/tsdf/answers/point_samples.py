# SPDX-License-Identifier: MIT
"""Sample signed distances at points: choose the blocks, and call `kernels/answers/point_sampling.py`."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.map_answers import Samples
from tsfusion.kernels.answers import point_sampling
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.tsdf.store.block_store import BlockStore, unpack_keys
from tsfusion.tsdf.surface.field_regularizer import SurfaceView, values_of

_PART = 1 << 14  # points in one call, if their blocks may have to be read from a file
_POINTS_A_BLOCK = 16  # from this many points per block of the map, a table of its blocks is faster
_MOST_SOLVED = 1 << 14  # blocks whose values are computed in one call: 32 MB


def sample(
    points: NDArray[np.floating], store: BlockStore, min_weight: float, view: SurfaceView = values_of
) -> Samples:
    """Return the signed distance, weight and gradient of a surface at points (n, 3), metres."""
    count = len(points)
    whole = Samples(
        np.empty(count, np.float32), np.empty(count, np.float32), np.empty((count, 3), np.float32)
    )
    length = _PART if store.is_in_files else max(count, 1)
    for first in range(0, count, length):
        part = slice(first, first + length)
        _fill(_part(whole, part), points[part], store, min_weight, view)
        store.keep_within_memory()
    return whole


def _fill(
    found: Samples, points: NDArray[np.floating], store: BlockStore, min_weight: float, view: SurfaceView
) -> None:
    kind, sums, slots = point_sampling.FUSED, store.sums, None
    if view is not values_of:
        slots = _needed(points, store)
        if len(slots) > _MOST_SOLVED and len(points) > 1:
            half = len(points) // 2
            for part in (slice(0, half), slice(half, None)):
                _fill(_part(found, part), points[part], store, min_weight, view)
            return
        kind, values = point_sampling.SOLVED, view(store.keys[slots], store, min_weight)
        sums = np.empty(values.shape, np.int64)
        point_sampling.pair(slots.astype(np.int32), store.sums, values, sums)
    elif store.corrected:
        kind = point_sampling.CORRECTED
    least = max(1, int(np.ceil(min_weight * WEIGHT_ONE)))
    answer = found.distance, found.weight, found.gradient
    keys = store.keys if slots is None else store.keys[slots]
    table = _table(keys, len(points)) if len(points) >= _POINTS_A_BLOCK * len(keys) > 0 else None
    if table is not None:
        point_sampling.interpolate_within(
            points, 1 / store.voxel_size, *table, sums, least, kind, store.correction, *answer
        )
        return
    row_of = np.empty(0, np.int32)
    if slots is not None:
        row_of = np.zeros(store.count, np.int32)
        row_of[slots] = np.arange(len(slots))
    point_sampling.interpolate(
        points, 1 / store.voxel_size, store.hash_keys, store.hash_slots, sums, least, kind, store.correction,
        row_of, *answer,
    )  # fmt: skip


def _table(
    keys: NDArray[np.int64], most: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]] | None:
    """Return a dense table of all blocks around, for `interpolate_within`; None above `most` entries."""
    blocks = unpack_keys(keys)
    begin = blocks.min(axis=0) - 2
    size = blocks.max(axis=0) + 2 - begin
    if np.prod(size, dtype=np.float64) > most:
        return None
    rows = np.full(size, -1, np.int32)
    rows[tuple((blocks - begin).T)] = np.arange(len(keys))
    return rows.ravel(), begin, size


def _needed(points: NDArray[np.floating], store: BlockStore) -> NDArray[np.intp]:
    """Return the slots of the blocks that a sampling of the points reads, ordered by key."""
    is_needed = np.zeros(store.count, np.uint8)
    point_sampling.list_blocks(points, 1 / store.voxel_size, store.hash_keys, store.hash_slots, is_needed)
    slots = np.flatnonzero(is_needed)
    return slots[np.argsort(store.keys[slots])]


def _part(found: Samples, part: slice) -> Samples:
    return Samples(found.distance[part], found.weight[part], found.gradient[part])
