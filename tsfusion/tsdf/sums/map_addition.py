# SPDX-License-Identifier: MIT
"""Add the sums of one map to those of another, all or none.

Where the colour of a voxel would get more votes than `COLOR_LIMIT`, both colours are averaged by their votes.
The average has `COLOR_LIMIT` votes. Smoothed values are not sums: a block of both maps falls back to raw
values, as after a retraction. A block of only one map keeps them.
"""

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.core.errors import MapError, MapFull, WeightOverflow
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration.integrate import COLOR_LIMIT, WEIGHT_LIMIT, WEIGHT_MASK
from tsfusion.tsdf.store import clear_blocks
from tsfusion.tsdf.store.block_store import BlockStore

_CHUNK = 256  # blocks per step
_SCRATCH_BYTES = 32 << 20  # scratch memory; a step needs less
LANE, VOTES = (1 << 24) - 1, (1 << 16) - 1  # of Σ R and Σ G in `color_rgn`, and of the votes


def add(store: BlockStore, other: BlockStore, max_blocks: int, *, are_parts: bool = False) -> None:
    """Add the blocks of map `other` to `store`: same voxel size and layers (`other` may lack hits).

    Args:
        max_blocks: limit of blocks in `store`.
        are_parts: both are parts of one map, and hold the same keyframes.

    Raises:
        MapFull: when the sum would have more blocks.
        WeightOverflow: when a voxel would have more votes than its integers hold.
        MemoryError: without room. After each error the map is unchanged.
    """
    theirs = other.used()
    keys = other.keys[theirs]
    slots = store.slots_of(keys)
    missing = slots < 0
    _check_weights(store, other, slots[~missing], theirs[~missing])
    count = store.count + int(missing.sum())
    if count > max_blocks:
        raise MapFull(
            f"the map may hold at most max_blocks = {max_blocks} blocks; together they have {count}"
        )
    both = [store.clear.counts(), other.clear.counts()]
    clear = clear_blocks.summed(both, np.maximum if are_parts else np.add)
    clear_blocks.check_count(len(clear[0]), max_blocks)
    room = np.empty(_SCRATCH_BYTES, np.uint8)  # raises MemoryError before anything is added
    with process.uninterrupted():
        store.insert(keys[missing])
        del room
        store.clear.replace(clear, store.version)
        slots = store.slots_of(keys)
        for i in range(0, len(keys), _CHUNK):
            chunk = slice(i, i + _CHUNK)
            _add_rows(store, other, slots[chunk], theirs[chunk], missing[chunk])
            store.keep_within_memory()
            other.keep_within_memory()


def check_like(store: BlockStore, other: BlockStore) -> None:
    """Raise MapError unless map `other` has the voxel size and layers of `store`; it may lack hits."""
    check_voxels(store, other)
    ours, theirs = set(store.layers()), set(other.layers())
    if ours - theirs - {"hits"} or theirs - ours:
        names = " and ".join(", ".join(sorted(one)) for one in (ours, theirs))
        cure = "add this one to that one" if theirs - ours == {"hits"} else "fuse one anew"
        raise MapError(f"the maps have different layers, {names} (colour, smoothing along rays): {cure}")


def check_voxels(store: BlockStore, other: BlockStore) -> None:
    ours, theirs = store.voxel_size, other.voxel_size
    if ours != theirs:
        raise MapError(f"the maps have voxels of {ours:g} m and {theirs:g} m: fuse one of them again")


def _check_weights(
    store: BlockStore, other: BlockStore, slots: NDArray[np.int32], theirs: NDArray[np.int64]
) -> None:
    """Raise WeightOverflow if a voxel's weight would overflow. Reads only blocks where `bounds` allow it."""
    bounds = store.bounds[slots].astype(np.int64) + other.bounds[theirs]
    full = 0
    near = np.flatnonzero(bounds >= WEIGHT_LIMIT)
    for i in range(0, len(near), _CHUNK):
        chunk = near[i : i + _CHUNK]
        weights = (store.sums[slots[chunk]] & WEIGHT_MASK) + (other.sums[theirs[chunk]] & WEIGHT_MASK)
        full += int((weights >= WEIGHT_LIMIT).any(axis=1).sum())
    if full:
        raise WeightOverflow(
            f"{full} blocks hold voxels that would have more votes than their integers hold "
            f"({WEIGHT_LIMIT / WEIGHT_ONE:.0f} full samples)"
        )


def _add_rows(
    store: BlockStore,
    other: BlockStore,
    slots: NDArray[np.int32],
    theirs: NDArray[np.int64],
    is_new: NDArray[np.bool_],
) -> None:
    """Add the rows `theirs` of the other map's layers to the rows `slots` (distinct) of this map's layers."""
    store.sums[slots] += other.sums[theirs]
    store.bounds[slots] = (store.sums[slots] & WEIGHT_MASK).max(axis=1)
    store.note_changed(slots)
    if store.color:
        _add_colors(store, other, slots, theirs)
    if other.counts_hits:
        store.hits[slots] += other.hits[theirs]
    store.note_written(slots)
    if store.corrected:
        store.correction[slots[is_new]] = other.correction[theirs[is_new]]
        store.correction[slots[~is_new]] = 0


def _add_colors(
    store: BlockStore, other: BlockStore, slots: NDArray[np.int32], theirs: NDArray[np.int64]
) -> None:
    store.color_rgn[slots], store.color_b[slots] = added_colors(
        (store.color_rgn[slots], store.color_b[slots]), (other.color_rgn[theirs], other.color_b[theirs])
    )


Colors = tuple[NDArray[np.int64], NDArray[np.int32]]  # rows of `color_rgn` and `color_b`


def added_colors(here: Colors, there: Colors) -> Colors:
    """Return the sum of the colours of blocks in two maps, (n, 512) each; full colours are averaged."""
    rgn, blue = here[0] + there[0], here[1] + there[1]
    if not ((here[0] | there[0] | rgn) & COLOR_LIMIT).any():  # below the limit, also in the sum
        return rgn, blue
    each = here[0] & VOTES, there[0] & VOTES
    votes = each[0] + each[1]
    full = (votes > COLOR_LIMIT) & (each[0] > 0) & (each[1] > 0)
    rgn = np.where(full, 0, here[0]) + np.where(full, 0, there[0])
    share = COLOR_LIMIT / votes[full]
    red, green = (
        np.rint(((here[0][full] >> shift & LANE) + (there[0][full] >> shift & LANE)) * share).astype(np.int64)
        for shift in (40, 16)
    )
    rgn[full] = (red << 40) + (green << 16) + COLOR_LIMIT
    blue[full] = np.rint(blue[full] * share)
    return rgn, blue
