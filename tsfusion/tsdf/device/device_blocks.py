# SPDX-License-Identifier: MIT
"""Keep a map's blocks on a GPU, and track which rows differ from those of its `BlockStore`."""

import weakref
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import Arch
from tsfusion.core.number_ranges import distinct
from tsfusion.kernels.device.device_copies import FIRST_BLOCKS, FIRST_HASH
from tsfusion.tsdf.device.device_link import DeviceLink, Step
from tsfusion.tsdf.store.block_store import DeviceRows
from tsfusion.tsdf.store.growing_array import GrowingArray

_CHUNK = 4096  # blocks per copy: 42 MB with colour


class DeviceBlocks(DeviceRows):
    """Copy of a map's blocks on a GPU, to which keyframes are added there. `fetch` updates the store's rows
    before a read; `send` updates the GPU's rows after a write to the store."""

    first_blocks = FIRST_BLOCKS
    is_none = False

    def __init__(self, link: DeviceLink, layers: tuple[str, ...]) -> None:
        self._link = link
        self._names = layers
        self._number = link.new_map(layers)
        self._behind = np.zeros(0, bool)  # by slot: True if the store's row is older than the device's
        self._is_behind = False
        self._hash_size = FIRST_HASH  # size of the device's copy
        self.sends_blocks: Literal["now", "later", "never"] = "now"
        self._unsent: list[NDArray[Any]] = []
        self._first: list[Step] = []  # calls to make before the next one
        weakref.finalize(self, link.forget_later, self._number)

    @property
    def arch(self) -> Arch:
        return self._link.arch

    def call(self, verb: str, *arguments: Any) -> Any:
        first, self._first = self._first, []
        return self._link.call(self._number, verb, *arguments, first=first)

    def insert(
        self,
        count: int,
        places: NDArray[np.int32],
        hash_keys: NDArray[np.int64],
        hash_slots: NDArray[np.int32],
    ) -> None:
        if len(hash_keys) != self._hash_size:
            places = np.flatnonzero(hash_keys).astype(np.int32)
        arguments = count, len(hash_keys), places, hash_keys[places], hash_slots[places]
        self._hash_size = len(hash_keys)
        if self.sends_blocks == "later":
            self._first.append(("insert", arguments))
        elif self.sends_blocks == "now":
            self.call("insert", *arguments)

    def drop(self, count: int, hash_keys: NDArray[np.int64], hash_slots: NDArray[np.int32]) -> None:
        self._behind[count:] = False
        self.call("drop", count)
        self._hash_size = 0
        self.insert(count, np.empty(0, np.int32), hash_keys, hash_slots)

    def note_added(self, slots: NDArray[np.int32], count: int) -> None:
        if len(self._behind) < count:
            self._behind = np.append(self._behind, np.zeros(2 * count - len(self._behind), bool))
        self._behind[slots] = True
        self._is_behind = True

    def note_written(self, slots: NDArray[Any]) -> None:
        self._unsent.append(slots)

    def fetch(self, layers: dict[str, GrowingArray]) -> None:
        if not self._is_behind:
            return
        slots = np.flatnonzero(self._behind).astype(np.int32)
        for i in range(0, len(slots), _CHUNK):
            chunk = slots[i : i + _CHUNK]
            for name, rows in zip(self._names, self.call("read", self._names, chunk), strict=True):
                layers[name].array[chunk] = rows
            self._behind[chunk] = False
        self._is_behind = False

    def send(self, layers: dict[str, GrowingArray], count: int) -> None:
        if not self._unsent:
            return
        slots = distinct(np.concatenate(self._unsent))
        slots = slots[slots < count].astype(np.int32)
        for i in range(0, len(slots), _CHUNK):
            chunk = slots[i : i + _CHUNK]
            for name in self._names:
                self.call("write", name, chunk, layers[name].array[chunk])
        self._unsent.clear()
