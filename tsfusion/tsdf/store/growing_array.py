# SPDX-License-Identifier: MIT
"""Grow arrays without copying, in anonymous memory or in a file whose pages can leave memory."""

import ctypes
import mmap
import os
import sys
import tempfile
import weakref
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import InvalidConfig, MapFull

_MOVES_PAGES = sys.platform == "linux"
_HUGE_PAGE = 1 << 21  # bytes
_STEP = 4096  # largest number of items reserved ahead, because reserved memory counts against a memory limit
LAYER_DTYPES = {
    "sums": np.int64, "color_rgn": np.int64, "color_b": np.int32, "correction": np.float32, "hits": np.int32,
}  # fmt: skip
MAX_ITEMS = (1 << 22) - 1  # × 512 voxels stays below the 2³¹ elements that a Taichi kernel can index


class GrowingArray:
    """A zero-initialised array (capacity, *item) whose capacity can grow.

    On Linux, growth moves page-table entries, not bytes (`mremap`), and untouched pages take no memory. Other
    systems copy. Read `array` again after every `reserve`: an older array, or a view of it, points to freed
    memory.
    """

    def __init__(self, item: tuple[int, ...], dtype: DTypeLike, capacity: int) -> None:
        self._item = item
        self._dtype = np.dtype(dtype)
        self._map: mmap.mmap | None = None
        self.array: NDArray[Any] = np.zeros((0, *item), dtype)
        self.reserve(capacity)

    @property
    def capacity(self) -> int:
        return len(self.array)

    @property
    def item_bytes(self) -> int:
        return int(np.prod(self._item, dtype=np.int64)) * self._dtype.itemsize

    def shown(self, count: int) -> NDArray[Any]:
        """Return a read-only view of the first `count` items. It stays valid when the array grows.

        After growth, an earlier result may be a copy of the old state.
        """
        items = self.array[:count]
        if self._map is not None:  # a buffer of the map, which blocks `resize`
            of_map = np.asarray(memoryview(self._map)[: count * self.item_bytes])
            items = of_map.view(self._dtype).reshape(count, *self._item)
        items.flags.writeable = False
        return items

    def reserve(self, capacity: int) -> None:
        """Grow to `capacity` items; new items are zero. Raises MemoryError; the array then is unchanged."""
        if capacity <= self.capacity:
            return
        ahead = min(2 * self.capacity, self.capacity + _STEP if _MOVES_PAGES else MAX_ITEMS, MAX_ITEMS)
        try:
            self._grow(self._whole_pages(max(capacity, ahead)))
        except (MemoryError, MapFull):
            self._grow(capacity)  # near the limit, only the needed capacity

    def _whole_pages(self, capacity: int) -> int:
        """Return the capacity rounded up to whole huge pages: only these move without splitting."""
        size = capacity * self.item_bytes
        if size < _HUGE_PAGE or _HUGE_PAGE % self.item_bytes:
            return capacity
        return -(-size // _HUGE_PAGE) * (_HUGE_PAGE // self.item_bytes)

    def _grow(self, capacity: int) -> None:
        if not _MOVES_PAGES:
            grown = np.zeros((capacity, *self._item), self._dtype)
            grown[: self.capacity] = self.array
            self.array = grown
            return
        size = capacity * self.item_bytes
        try:
            self._map = self._resized(size)
        except OSError as error:
            raise MemoryError(f"no memory for {size >> 20} MB: {error.strerror}") from error
        if size >= _HUGE_PAGE:  # first touches and TLB misses cost more than the sums themselves
            with suppress(OSError):  # the system may have no huge pages
                self._map.madvise(mmap.MADV_HUGEPAGE)
        # By address, not as a buffer of the map: Taichi's launches leave reference cycles around their
        # arguments, and a map with a buffer still exported refuses to be resized.
        address = ctypes.addressof(ctypes.c_char.from_buffer(self._map))
        interface = {
            "version": 3,
            "data": (address, False),
            "typestr": self._dtype.str,
            "shape": (capacity, *self._item),
        }
        self.array = np.asarray(SimpleNamespace(__array_interface__=interface))

    def _resized(self, size: int) -> mmap.mmap:
        if self._map is not None:
            try:
                self._map.resize(size)
                return self._map
            except BufferError:  # a result of `shown` keeps the old map
                pass
        grown = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        if self._map is not None:
            grown[: len(self._map)] = memoryview(self._map)
        return grown


class FileArray(GrowingArray):
    """A growing array in an unnamed file, in a folder on a disk (Linux).

    Address space for the largest size is reserved once. Growth only asks the disk for room, and `array` keeps
    its address. The system does not count its pages as allocations of this process, and only temporarily as
    its resident memory (`let_go`).

    `min_free_bytes` is the disk space that growth beyond `capacity` leaves free; None = none. Raises
    InvalidConfig if the folder cannot hold such a file.
    """

    def __init__(
        self,
        item: tuple[int, ...],
        dtype: DTypeLike,
        capacity: int,
        folder: Path,
        min_free_bytes: int | None = None,
    ) -> None:
        self._folder = folder
        self.min_free_bytes: int | None = None
        size = (MAX_ITEMS + 1) * int(np.prod(item, dtype=np.int64)) * np.dtype(dtype).itemsize
        try:
            with tempfile.TemporaryFile(dir=folder) as file:
                os.ftruncate(file.fileno(), size)
                self._pages = mmap.mmap(file.fileno(), size)
                self._file = os.dup(file.fileno())
        except OSError as error:
            raise InvalidConfig(
                f"the folder {folder} cannot hold blocks that are not in memory: {error.strerror}; choose "
                "another one for `cache`, on a disk of this machine"
            ) from error
        weakref.finalize(self, os.close, self._file)
        super().__init__(item, dtype, capacity)
        self.min_free_bytes = min_free_bytes

    def _grow(self, capacity: int) -> None:
        held, size = self.capacity * self.item_bytes, capacity * self.item_bytes
        try:
            if self.min_free_bytes is not None:
                durable_files.require_room(self._folder, size - held + self.min_free_bytes)
            # Without room on the disk, a later write to the page would end the process.
            os.posix_fallocate(self._file, held, size - held)
        except OSError as error:
            raise MapFull(
                f"no room for {(size - held) >> 20} MB more of the map in {self._folder}: {error.strerror}; "
                "make room on that disk, or begin another map"
            ) from error
        self.array = np.ndarray((capacity, *self._item), self._dtype, buffer=self._pages)

    @property
    def address(self) -> int:
        """Memory address of the first item; it never changes."""
        return int(self.array.ctypes.data)

    def let_go(self, first: int, end: int) -> None:
        """Remove items first … end-1, whole pages, from this process's memory; a touch brings them back.

        The system writes the pages to disk, and keeps a copy while no one else needs the memory.
        (posix_fadvise would drop the copy; reading the disk takes 1.6 times the CPU in a room of four times
        its memory.)
        """
        size = self.item_bytes
        self._pages.madvise(mmap.MADV_DONTNEED, first * size, (end - first) * size)
