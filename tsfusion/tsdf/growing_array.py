# SPDX-License-Identifier: MIT
"""Arrays that grow without copying: anonymous memory whose pages the operating system adds on first touch."""

import ctypes
import mmap
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

_MOVES_PAGES = sys.platform == "linux"
_STEP = 4096  # items more than are needed, at most: what is reserved counts against a memory limit
MAX_ITEMS = (1 << 22) - 1  # × 512 voxels stays below the 2³¹ elements that a Taichi kernel can index


class GrowingArray:
    """A zero-initialised array (capacity, *item) whose capacity can grow.

    On Linux growing moves page-table entries, not bytes (`mremap`), and pages never touched take no
    memory; elsewhere it copies. Take `array` anew after every `reserve`: an older one, or a view of it,
    points to memory that is gone.
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

    def reserve(self, capacity: int) -> None:
        """Make room for `capacity` items; new items are zero.

        Raises:
            MemoryError: when there is not enough; the array stays as it was.
        """
        if capacity <= self.capacity:
            return
        ahead = min(2 * self.capacity, self.capacity + _STEP if _MOVES_PAGES else MAX_ITEMS, MAX_ITEMS)
        try:
            self._grow(max(capacity, ahead))
        except MemoryError:
            self._grow(capacity)  # near the limit, no more than is needed

    def _grow(self, capacity: int) -> None:
        if not _MOVES_PAGES:
            grown = np.zeros((capacity, *self._item), self._dtype)
            grown[: self.capacity] = self.array
            self.array = grown
            return
        size = capacity * self.item_bytes
        try:
            if self._map is None:
                self._map = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
            else:
                self._map.resize(size)
        except OSError as error:
            raise MemoryError(f"no memory for {size >> 20} MB: {error.strerror}") from error
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
