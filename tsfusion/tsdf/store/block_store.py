# SPDX-License-Identifier: MIT
"""Store the map in memory: blocks of 8³ voxels in slots, found by their packed coordinates."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tsfusion.core import process
from tsfusion.core.config import CacheConfig
from tsfusion.core.errors import MapFull
from tsfusion.core.number_ranges import distinct
from tsfusion.kernels.base import block_hash, runtime
from tsfusion.kernels.integration.integrate import CUBE, WEIGHT_MASK
from tsfusion.kernels.surface import surface_cells
from tsfusion.kernels.surface.surface_cells import NO_LIMITS
from tsfusion.tsdf.store.clear_blocks import ClearBlocks
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES, MAX_ITEMS, FileArray, GrowingArray
from tsfusion.tsdf.store.residency import Residency

_FIRST_CAPACITY = 1024
# Columns of every map: a value for each block
_OWN = {
    "keys": np.int64,
    "shows_surface": np.uint8,
    **dict.fromkeys(("versions", "places", "bounds"), np.int32),
}
MOST_REMOVED = 1 << 16  # removed blocks that are remembered, beyond those since the last `take_dirty`
_CHUNK = 1024  # blocks per step, where a whole layer would otherwise be copied
_HASH_BYTES = 4 * 12  # largest share of a block in the hash, which is at least a quarter full
# Key of a block minus the keys of its neighbours towards −x, −y, −z
CELL_STEPS = np.array([x << 42 | y << 21 | z for x in (0, 1) for y in (0, 1) for z in (0, 1)])


class DeviceRows:
    """Copy of a store's rows on a GPU. This class is for no GPU and does nothing; `DeviceBlocks` has one.

    Attributes:
        first_blocks: number of blocks for which a new store has room.
        sends_blocks: when `insert` tells the device: now, later = with the next call, never = it has them.
    """

    first_blocks = _FIRST_CAPACITY
    is_none = True
    sends_blocks: Literal["now", "later", "never"] = "never"

    def fetch(self, layers: dict[str, GrowingArray]) -> None:
        """Update the store's rows from those that changed on the GPU."""

    def send(self, layers: dict[str, GrowingArray], count: int) -> None:
        """Update the GPU's rows of the first `count` blocks from those that changed in the store."""

    def note_written(self, slots: NDArray[Any]) -> None:
        """Record that the store's rows in `slots` changed, for the next `send`."""

    def note_added(self, slots: NDArray[np.int32], count: int) -> None:
        """Record that the GPU has added to the blocks in `slots`; the map has `count` blocks."""

    def insert(
        self,
        count: int,
        places: NDArray[np.int32],
        hash_keys: NDArray[np.int64],
        hash_slots: NDArray[np.int32],
    ) -> None:
        """Tell the GPU of `count` blocks: the new ones at `places` of the hash, or all if its size changes.

        Raises MemoryError without room, with the next call if blocks are sent later. The device then keeps
        its former blocks.
        """

    def drop(self, count: int, hash_keys: NDArray[np.int64], hash_slots: NDArray[np.int32]) -> None:
        """Keep the first `count` blocks on the GPU, with the given hash, and remove all others."""


class BlockStore:
    """Slots 0 … count-1, each with a key and one row of 512 voxels in every layer.

    Layers, (slot, 512): `sums` int64; with colour `color_rgn` int64 and `color_b` int32; when smoothing
    `correction` float32; when hits are counted `hits` int32 (see kernels/integration/integrate.py and
    kernels/integration/ray_smoothing.py). One int32 per block: `versions` (the last keyframe or merge that
    touched it, for `changed_since`), `places` (index in that keyframe's list), `bounds` (limit of its
    weights). A missing layer is one row of zeros, because kernels need an array.

    With a `cache` the layers are in files, and blocks unchanged for long leave memory. A caller that touches
    rows of many blocks calls `keep_within_memory` repeatedly.

    With a `device` keyframes are added on the device. The store updates its rows before a read. After a
    write to rows, the writer calls `note_written`.
    """

    def __init__(
        self,
        *,
        voxel_size: float,
        color: bool,
        corrected: bool,
        hits: bool = False,
        back_limits: tuple[float, float] = NO_LIMITS,
        cache: CacheConfig | None = None,
        device: DeviceRows | None = None,
    ) -> None:
        self.voxel_size = voxel_size
        self.back_limits = back_limits  # limits for a mesh (`mesh_extraction.back_limits`)
        self.color, self.corrected, self.counts_hits = color, corrected, hits
        self.count = 0
        self.version = 0  # number of the last change, such as a keyframe; 0 when a map is opened
        self.taken: int | None = None  # `version` at the last `Volume.take_dirty`
        self._removed = np.zeros((2, 0), np.int64)  # keys of removed blocks, and the version of each removal
        self._knows_from = 0  # all blocks removed after this version are in `_removed`
        self.most_blocks = MAX_ITEMS
        self.pause: Callable[[], None] = lambda: None  # called in long passes that only read
        self._device = device or DeviceRows()
        self._room = self._device.first_blocks  # blocks that fit into the reserved memory
        self._hash_keys = np.zeros(4 * self._room, np.int64)
        self._hash_slots = np.zeros(4 * self._room, np.int32)
        self._hashed = 0  # blocks in the hash; the others are added when the hash is read
        self._columns = {name: GrowingArray((), dtype, self._room) for name, dtype in _OWN.items()}
        present = {"sums": True, "color_rgn": color, "color_b": color, "correction": corrected, "hits": hits}
        self._present = [name for name, there in present.items() if there]
        self.clear = ClearBlocks()
        self._layers = {name: self._layer(name, cache) for name in present}
        self._residency: Residency | None = None
        self._memory_bytes = 0
        if cache:
            self._residency = Residency(self._files, cache.disk_bytes)
            self.most_blocks = min(MAX_ITEMS, cache.disk_bytes // self._residency.row_bytes)

    def _layer(self, name: str, cache: CacheConfig | None) -> GrowingArray:
        kind = (CUBE,), LAYER_DTYPES[name]
        if name not in self._present:
            return GrowingArray(*kind, 1)
        if cache is None:
            return GrowingArray(*kind, self._room)
        return FileArray(*kind, self._room, Path(cache.folder), cache.min_free_bytes)

    @property
    def _files(self) -> list[FileArray]:
        return [layer for layer in self._layers.values() if isinstance(layer, FileArray)]

    @contextmanager
    def opening(self, blocks: int) -> Iterator[None]:
        """Allow a saved map of `blocks` blocks in the `with` block, even above the limits of growth."""
        limits = self.most_blocks, [file.min_free_bytes for file in self._files]
        self.most_blocks = MAX_ITEMS
        for file in self._files:
            file.min_free_bytes = None
        try:
            self.reserve(blocks)
            yield
        finally:
            self.most_blocks = limits[0]
            for file, least in zip(self._files, limits[1], strict=True):
                file.min_free_bytes = least

    def shown(self, layer: str) -> NDArray[Any] | None:
        """Return a read-only view, (count, 512), of a layer (`GrowingArray.shown`), or None without it."""
        self._fetch()
        return self._layers[layer].shown(self.count) if layer in self._present else None

    @property
    def hash_keys(self) -> NDArray[np.int64]:
        """Keys of the hash table that finds a block's slot (kernels/base/block_hash.py)."""
        self._hash()
        return self._hash_keys

    @property
    def hash_slots(self) -> NDArray[np.int32]:
        """Slots in the hash table, at the indices of their keys in `hash_keys`."""
        self._hash()
        return self._hash_slots

    @property
    def keys(self) -> NDArray[np.int64]:
        return self._columns["keys"].array[: self.count]

    @property
    def sums(self) -> NDArray[np.int64]:
        return self._rows("sums")

    @property
    def color_rgn(self) -> NDArray[np.int64]:
        return self._rows("color_rgn")

    @property
    def color_b(self) -> NDArray[np.int32]:
        return self._rows("color_b")

    @property
    def correction(self) -> NDArray[np.float32]:
        return self._rows("correction")

    @property
    def hits(self) -> NDArray[np.int32]:
        return self._rows("hits")

    @property
    def ray_ends(self) -> tuple[NDArray[np.int64], NDArray[np.int32], int]:
        """Layers that count the rays that end in a voxel (votes for colour, hits), and a code of which of
        them the map has (`surface_cells.cautious`)."""
        return self.color_rgn, self.hits, self.color + 2 * self.counts_hits

    @property
    def clear_blocks(self) -> tuple[NDArray[Any], ...]:
        """Arrays for `surface_cells.is_clear`: a flag by slot, 1 for blocks that show a surface or hits; and
        the table of the blocks that keyframes look through."""
        clear, shows_surface = self.clear, self._columns["shows_surface"].array
        if len(clear):
            with process.uninterrupted():
                slots = self.changed_since(clear.checked).astype(np.int32)
                for i in range(0, len(slots), _CHUNK):
                    chunk = slots[i : i + _CHUNK]
                    surface_cells.find_surfaces(chunk, self.sums, *self.ray_ends, shows_surface)
                    self.keep_within_memory()
                clear.checked = self.version
        return shows_surface, *clear.table

    @property
    def versions(self) -> NDArray[np.int32]:
        return self._columns["versions"].array

    @property
    def places(self) -> NDArray[np.int32]:
        return self._columns["places"].array

    @property
    def bounds(self) -> NDArray[np.int32]:
        return self._columns["bounds"].array

    def layers(self) -> dict[str, NDArray[Any]]:
        self._fetch()
        return {name: self._layers[name].array for name in self._present}

    def _rows(self, layer: str) -> NDArray[Any]:
        self._fetch()
        return self._layers[layer].array

    def _fetch(self) -> None:
        self._device.fetch(self._layers)

    def send(self) -> None:
        self._device.send(self._layers, self.count)

    def note_written(self, slots: NDArray[Any]) -> None:
        """Record that another module has written to the rows in `slots`, for the copy on a GPU."""
        self._device.note_written(slots)

    def note_touched(self, slots: NDArray[np.int32]) -> None:
        """Record that the current keyframe has changed the blocks in `slots` on the GPU."""
        self._device.note_added(slots, self.count)
        self.versions[slots] = self.version

    def note_changed(self, slots: slice | NDArray[np.int32]) -> None:
        """Record a change of the blocks in `slots` that no keyframe has made."""
        self.version += 1
        self.versions[slots] = self.version

    def limit(self, nbytes: int) -> None:
        """Limit the map's memory, bytes, from now on; a map that is already larger stays unchanged.

        The allowed number of blocks depends only on the layers, never on the history of growth. With a cache
        the map may still grow; its coldest blocks leave memory.
        """
        if self._residency is None:
            self.most_blocks = nbytes // (self.bytes_per_block + _HASH_BYTES)
        else:
            self._memory_bytes = nbytes
            self.keep_within_memory()

    @property
    def is_in_files(self) -> bool:
        return self._residency is not None

    def keep_within_memory(self) -> None:
        """Move the coldest blocks to the cache's files if memory has too many. Call it after reading."""
        if self._residency is not None:
            index = self.nbytes - self.count * self._residency.row_bytes
            self._residency.keep_within(max(self._memory_bytes - index, 0), self.versions[: self.count])

    def rest(self) -> None:
        """Give way between two steps of a long read: blocks may leave memory, other work may run.

        Only for a pass that reads, and that allows other readers in between.
        """
        self.keep_within_memory()
        self.pause()

    def reserve(self, count: int) -> None:
        """Allocate memory for `count` blocks in all.

        Raises MemoryError, or MapFull for the disk of the cache, without room; the map is unchanged.
        """
        if count > max(self.most_blocks, self.count) and self._residency is not None:
            raise MapFull(
                f"the map may take disk_bytes = {self._residency.disk_bytes} bytes on the disk, which are "
                f"{self.most_blocks} blocks; it has {self.count}, and {count - self.count} more are needed"
            )
        if count > max(self.most_blocks, self.count):
            raise MemoryError(
                f"the map may have {self.most_blocks} blocks in the memory that is set; "
                f"it has {self.count}, and {count - self.count} more are needed"
            )
        if count <= self._room:
            return
        for array in self._arrays():
            array.reserve(count)
        if 2 * count > len(self._hash_keys):
            size = 1 << (2 * count - 1).bit_length()  # depends on the count alone, not on the history
            self._hash_keys, self._hash_slots = np.zeros(size, np.int64), np.zeros(size, np.int32)
            self._hashed = 0
        self._room = min(len(self._hash_keys) // 2, *(array.capacity for array in self._arrays()))

    @property
    def spare(self) -> int:
        """Number of blocks that `insert` accepts before more memory must be allocated."""
        return max(min(self._room, self.most_blocks) - self.count, 0)

    def insert(self, keys: NDArray[np.int64]) -> None:
        """Append blocks with distinct new keys; their voxels are zero. Raises as `reserve`."""
        first, count = self.count, self.count + len(keys)
        self.reserve(count)
        self._columns["keys"].array[first:count] = keys
        self.count = count
        if self._device.sends_blocks != "never":
            places = np.empty(len(keys), np.int32)
            block_hash.find_places(keys, self.hash_keys, places)
            try:
                self._device.insert(count, places, self.hash_keys, self.hash_slots)
            except MemoryError:
                self.drop(first)
                raise

    def drop(self, count: int) -> None:
        """Remove the newest blocks, until `count` remain; their voxels must be zero."""
        for array in self._columns.values():
            array.array[count : self.count] = 0
        self.count = count
        self._hash_keys[:] = self._hash_slots[:] = 0
        self._hashed = 0
        if not self._device.is_none:
            self._device.drop(count, self.hash_keys, self.hash_slots)

    def release(self, slots: NDArray[np.int64]) -> None:
        """Remove blocks without votes: the last blocks move to their slots. New blocks reuse the room."""
        self._fetch()
        self.version += 1
        noted = np.stack([self.keys[slots], np.full(len(slots), self.version)])
        self._removed = np.concatenate([self._removed, noted], axis=1)
        if self._removed.shape[1] > MOST_REMOVED:
            self._knows_from = self.version if self.taken is None else self.taken
            self._removed = self._removed[:, self._removed[1] > self._knows_from]
        left = self.count - len(slots)
        is_free = np.zeros(self.count, bool)
        is_free[slots] = True
        to, moved = np.flatnonzero(is_free[:left]), left + np.flatnonzero(~is_free[left:])
        for rows in (array.array for array in self._arrays()):
            for i in range(0, len(to), _CHUNK):
                rows[to[i : i + _CHUNK]] = rows[moved[i : i + _CHUNK]]
            rows[left : self.count] = 0
            self.keep_within_memory()
        self.drop(left)
        self.note_written(to)

    def column(self, dtype: DTypeLike) -> GrowingArray:
        """Return a new array with one value for each block, by slot, that stays with its block; first 0."""
        made = self._columns[str(len(self._columns))] = GrowingArray((), dtype, self._room)
        return made

    def slots_of(self, keys: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return the (n,) slots of (n,) keys, −1 for an absent block."""
        slots = np.empty(len(keys), np.int32)
        block_hash.find_blocks(keys, self.hash_keys, self.hash_slots, slots)
        return slots

    def copy_from(self, other: "BlockStore") -> None:
        """Copy another store with the same layers into this empty one. Raises as `reserve`."""
        self.most_blocks, self._memory_bytes = other.most_blocks, other._memory_bytes
        with self.opening(other.count):
            self.insert(other.keys)
        other._fetch()
        own = len(_OWN) + len(self._present)  # without the columns of followers
        for mine, theirs in zip(self._arrays()[:own], other._arrays()[:own], strict=True):
            for i in range(0, self.count, _CHUNK):
                chunk = slice(i, min(i + _CHUNK, self.count))
                mine.array[chunk] = theirs.array[chunk]
                self.keep_within_memory()
                other.keep_within_memory()
        self.clear.replace(other.clear.counts())
        self.version, self.taken = other.version, other.taken
        self._removed, self._knows_from = other._removed, other._knows_from
        self.note_written(np.arange(self.count))

    def measure_bounds(self) -> None:
        for i in range(0, self.count, _CHUNK):
            chunk = slice(i, min(i + _CHUNK, self.count))
            self.bounds[chunk] = (self.sums[chunk] & WEIGHT_MASK).max(axis=1)
            self.keep_within_memory()

    def changed_since(self, version: int) -> NDArray[np.int64]:
        """Return the slots of the blocks that changed after this `version` of the map."""
        return np.flatnonzero(self.versions[: self.count] > version)

    def removed_since(self, version: int) -> NDArray[np.int64] | None:
        """Return the keys of blocks removed after this `version` of the map; None if that is not known."""
        keys, versions = self._removed
        return None if version < self._knows_from else keys[versions > version]

    def used(self) -> NDArray[np.int64]:
        """Return the slots of blocks with votes, in key order."""
        has_votes = np.empty(self.count, bool)
        for i in range(0, self.count, _CHUNK):
            chunk = slice(i, min(i + _CHUNK, self.count))
            self.sums[chunk].any(axis=1, out=has_votes[chunk])
            self.rest()
        order = np.argsort(self.keys)
        return order[has_votes[order]]

    def in_order(self, layer: str) -> Iterator[tuple[NDArray[np.int64], NDArray[Any]]]:
        """Yield keys and a layer's rows of blocks with votes, in key order, up to 1024 blocks per step."""
        used, rows = self.used(), self._rows(layer)
        for i in range(0, len(used), _CHUNK):
            chunk = used[i : i + _CHUNK]
            if (np.diff(chunk) == 1).all():  # consecutive, as in a newly loaded map: no gathering is needed
                yield self.keys[chunk], rows[chunk[0] : chunk[-1] + 1]
            else:
                yield self.keys[chunk], rows[chunk]
            self.rest()

    def _hash(self) -> None:
        """Add new blocks to the hash table. Only for the thread that runs kernels."""
        runtime.check_thread()
        first, self._hashed = self._hashed, self.count
        if first < self.count:
            keys, count = self._columns["keys"].array, self.count - first
            block_hash.insert_blocks(keys, first, count, first, self._hash_keys, self._hash_slots)

    @cached_property
    def bytes_per_block(self) -> int:
        """Memory of one block in all layers and own columns, bytes, without the hash."""
        return sum(array.item_bytes for array in self._arrays()[: len(_OWN) + len(self._present)])

    def _arrays(self) -> tuple[GrowingArray, ...]:
        columns = list(self._columns.values())
        return (*columns[: len(_OWN)], *map(self._layers.__getitem__, self._present), *columns[len(_OWN) :])

    @property
    def nbytes(self) -> int:
        """Bytes that the blocks and their hash table take, in memory and in the cache's files."""
        clear = self.clear.nbytes
        return self.count * self.bytes_per_block + self._hash_keys.nbytes + self._hash_slots.nbytes + clear

    @property
    def resident_bytes(self) -> int:
        """Bytes of the blocks and their hash in memory; blocks in the cache's files are not counted."""
        if self._residency is None:
            return self.nbytes
        return self.nbytes - self.count * self._residency.row_bytes + self._residency.nbytes


def pack_keys(coordinates: NDArray[np.int32]) -> NDArray[np.int64]:
    """Convert (n, 3) block coordinates to (n,) int64 keys, as `kernels.base.voxel_traversal.pack`."""
    x, y, z = (np.asarray(coordinates, np.int64) + (1 << 20)).reshape(-1, 3).T
    return np.ascontiguousarray(x << 42 | y << 21 | z)


def unpack_keys(keys: NDArray[np.int64]) -> NDArray[np.int32]:
    """Convert (n,) keys to (n, 3) int32 block coordinates."""
    mask = (1 << 21) - 1
    return (np.stack([keys >> 42, keys >> 21, keys], axis=1) & mask).astype(np.int32) - (1 << 20)


def distinct_blocks(coordinates: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the distinct block coordinates in key order: (n, 3) → (m, 3) int32."""
    return unpack_keys(distinct(pack_keys(coordinates)))


def cells_of(coordinates: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the blocks whose mesh depends on these blocks: the same and neighbours towards −x, −y, −z."""
    return unpack_keys(distinct(pack_keys(coordinates)[:, None] - CELL_STEPS))
