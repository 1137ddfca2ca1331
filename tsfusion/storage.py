# SPDX-License-Identifier: MIT
"""Arrays that grow without copying: anonymous memory whose pages the operating system adds on first touch."""

import mmap
import sys
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class GrowingArray:
    """A zero-initialised array (capacity, *item) whose capacity can grow.

    On Linux growing moves page-table entries, not bytes (`mremap`), and pages never touched take no
    memory; elsewhere it copies. Views taken from `array` must be dropped before `reserve`.
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
        """Make room for `capacity` items; new items are zero."""
        if capacity <= self.capacity:
            return
        capacity = max(capacity, 2 * self.capacity)
        if sys.platform != "linux":
            grown = np.zeros((capacity, *self._item), self._dtype)
            grown[: self.capacity] = self.array
            self.array = grown
            return
        size = capacity * self.item_bytes
        if self._map is None:
            self._map = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        else:
            self.array = np.zeros((0, *self._item), self._dtype)  # lets go of the mapping
            self._map.resize(size)
        self.array = np.frombuffer(self._map, self._dtype).reshape(capacity, *self._item)
