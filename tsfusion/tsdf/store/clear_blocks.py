# SPDX-License-Identifier: MIT
"""Count the keyframes that look through each block completely: free space that no voxel holds.

The blocks that a keyframe looks through (`carved_blocks`) depend on the keyframe alone. Counts are sums, as
voxels are, so retraction of a keyframe subtracts its counts. A block is free if at least one keyframe looks
through it and its voxels show neither a hit nor a surface.
"""

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import MapFull
from tsfusion.core.number_ranges import distinct
from tsfusion.kernels.base import block_hash
from tsfusion.tsdf.store.growing_array import MAX_ITEMS, GrowingArray

_FIRST = 64  # blocks
_A_BLOCK = 8  # limit per block of a map: at most a tenth of the map's memory

ClearCounts = tuple[NDArray[np.int64], NDArray[np.int32]]  # ascending distinct keys of blocks, counts


class ClearBlocks:
    """Blocks that keyframes look through completely: keys in slots of their own, each with its count.

    A count below one means none: maps of earlier versions may retract a keyframe that was not counted.
    """

    def __init__(self) -> None:
        self._count = 0
        self._keys, self._counts = GrowingArray((), np.int64, _FIRST), GrowingArray((), np.int32, _FIRST)
        self._versions = GrowingArray((), np.int32, _FIRST)  # of the map, of each change to free or not free
        self._knows_from = -1  # all changes after this version of the map are in `_versions`
        self._hash = np.zeros(4 * _FIRST, np.int64), np.zeros(4 * _FIRST, np.int32)
        self.checked = -1  # version of the map up to which its blocks were searched for surfaces

    def __len__(self) -> int:
        return self._count

    @property
    def table(self) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int32]]:
        """Hash keys and slots, and the counts by slot, for kernels (`surface_cells.is_clear`)."""
        return *self._hash, self._counts.array

    def counts(self) -> ClearCounts:
        """Return all blocks with a count other than zero."""
        slots = np.flatnonzero(self._counts.array[: self._count])
        slots = slots[np.argsort(self._keys.array[slots])]
        return self._keys.array[slots], self._counts.array[slots]

    def add(
        self, keys: NDArray[np.int64], amount: int | NDArray[np.int32], most: int, version: int = 0
    ) -> None:
        """Add to the counts of blocks, all or none. Subtraction from blocks without a count has no effect.

        Args:
            keys: distinct keys.
            amount: one amount for all, or one for each key.
            most: limit of the map's blocks with voxels.
            version: version of the map with this change.

        Raises MapFull for too many blocks, MemoryError without room.
        """
        slots = self._slots_of(keys)
        missing = keys[slots < 0]
        if len(missing) and np.max(amount) > 0:
            self._insert(np.sort(missing), most, version)
            slots = self._slots_of(keys)
        slots = slots[slots >= 0]
        before = self._counts.array[slots]
        self._counts.array[slots] = after = before + np.asarray(amount, np.int32)
        self._versions.array[slots[(before > 0) != (after > 0)]] = version

    def replace(self, counts: ClearCounts, version: int = -1) -> None:
        """Replace all blocks and counts by those of a saved map. Raises MemoryError.

        Args:
            version: version of the map, if somebody may follow it: all may have changed.
        """
        for array in (self._keys, self._counts, self._versions):
            array.array[: self._count] = 0
        for table in self._hash:
            table[:] = 0
        self._count, self._knows_from = 0, version
        self.add(*counts, MAX_ITEMS // _A_BLOCK)

    def changed_since(self, version: int) -> NDArray[np.int64] | None:
        """Return keys of blocks that became free or not free after this version; None if not known."""
        changed = self._versions.array[: self._count] > version
        return None if version <= self._knows_from else self._keys.array[: self._count][changed]

    @property
    def nbytes(self) -> int:
        return 16 * self._count + sum(array.nbytes for array in self._hash)

    def _slots_of(self, keys: NDArray[np.int64]) -> NDArray[np.int32]:
        slots = np.empty(len(keys), np.int32)
        block_hash.find_blocks(keys, *self._hash, slots)
        return slots

    def _insert(self, keys: NDArray[np.int64], most: int, version: int) -> None:
        if self._count + len(keys) > min(_A_BLOCK * most, len(self._hash[0]) // 2):
            counts = self.counts()
            if len(counts[0]) <= self._count // 2:  # most keyframes of the others have all been retracted
                self.replace(counts, version - 1)
        first, count = self._count, self._count + len(keys)
        check_count(count, most)
        for array in (self._keys, self._counts, self._versions):
            array.reserve(count)
        if 2 * count > len(self._hash[0]):
            size = 1 << (4 * count - 1).bit_length()
            self._hash = np.zeros(size, np.int64), np.zeros(size, np.int32)
            first = 0
        self._keys.array[self._count : count] = keys
        block_hash.insert_blocks(self._keys.array, first, count - first, first, *self._hash)
        self._count = count


def check_count(blocks: int, most: int) -> None:
    """Raise MapFull if `blocks` of free space are too many for a map of `most` blocks with voxels."""
    if blocks > _A_BLOCK * most:
        raise MapFull(
            f"the map may hold at most {_A_BLOCK * most} blocks of free space, {_A_BLOCK} times max_blocks, "
            f"and would have {blocks}: raise max_blocks or voxel_size"
        )


def summed(several: list[ClearCounts], add: "np.ufunc" = np.add) -> ClearCounts:
    """Return the sum of several maps' counts. Parts of one map share keyframes, and need `np.maximum`."""
    keys = np.concatenate([one[0] for one in several])
    found = distinct(keys)
    counts = np.zeros(len(found), np.int32)
    add.at(counts, np.searchsorted(found, keys), np.concatenate([one[1] for one in several]))
    return found[counts != 0], counts[counts != 0]


def encoded(counts: ClearCounts) -> bytes:
    """Encode counts for saving: keys (int64), then counts (int32), little-endian."""
    return counts[0].astype("<i8").tobytes() + counts[1].astype("<i4").tobytes()


def decoded(saved: bytes, most: int) -> ClearCounts:
    """Decode the bytes of `encoded`. Raises ValueError for other bytes, or more than `most` allows."""
    count = len(saved) // 12
    if len(saved) != 12 * count or count > _A_BLOCK * most:
        raise ValueError("its blocks of free space are not of the size expected")
    keys = np.frombuffer(saved, "<i8", count).astype(np.int64)
    if (np.diff(keys, prepend=0) <= 0).any():
        raise ValueError("its blocks of free space are out of order")
    return keys, np.frombuffer(saved, "<i4", count, 8 * count).astype(np.int32)
