# SPDX-License-Identifier: MIT
"""The blocks of a map on a device, and which of them differ from the rows that its `BlockStore` has."""

import logging
import weakref
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import Arch
from tsfusion.core.distinct_integers import distinct
from tsfusion.kernels.device_told import FIRST_BLOCKS, FIRST_HASH
from tsfusion.tsdf.device_link import DeviceLink, Step, link_to, refuse

log = logging.getLogger(__name__)

_CHUNK = 4096  # blocks copied at a time: 42 MB with colour


class DeviceBlocks:
    """Keyframes are added on the device. The store's rows follow when somebody reads them (`fetch`), and the
    device's when somebody has written to the store's (`send`)."""

    first_blocks = FIRST_BLOCKS

    def __init__(self, link: DeviceLink, layers: tuple[str, ...]) -> None:
        self._link = link
        self._names = layers
        self._number = link.new_map(layers)
        self._behind = np.zeros(0, bool)  # by slot: the store's row is behind the device's
        self._is_behind = False
        self._hash_size = FIRST_HASH  # of the device's copy
        # When `insert` tells the device: later = with the next call; never = it has them.
        self.sends_blocks: Literal["now", "later", "never"] = "now"
        self._unsent: list[NDArray[Any]] = []
        self._first: list[Step] = []  # what goes with the next call
        weakref.finalize(self, link.forget_later, self._number)

    @property
    def arch(self) -> Arch:
        return self._link.arch

    def call(self, verb: str, *arguments: Any) -> Any:
        """Call a method of the `DeviceMap`."""
        first, self._first = self._first, []
        return self._link.call(self._number, verb, *arguments, first=first)

    def insert(
        self,
        count: int,
        places: NDArray[np.int32],
        hash_keys: NDArray[np.int64],
        hash_slots: NDArray[np.int32],
    ) -> None:
        """Let the device have `count` blocks: new are those at these places of the hash, or all of another
        size of it.

        Raises:
            MemoryError: there is no room for them; the device has those that it had. Where they are sent
                later, the next call raises it.
        """
        if len(hash_keys) != self._hash_size:
            places = np.flatnonzero(hash_keys).astype(np.int32)
        arguments = count, len(hash_keys), places, hash_keys[places], hash_slots[places]
        self._hash_size = len(hash_keys)
        if self.sends_blocks == "later":
            self._first.append(("insert", arguments))
        elif self.sends_blocks == "now":
            self.call("insert", *arguments)

    def drop(self, count: int, hash_keys: NDArray[np.int64], hash_slots: NDArray[np.int32]) -> None:
        """Let the device have `count` blocks, as the hash has them, and no others."""
        self._behind[count:] = False
        self.call("drop", count)
        self._hash_size = 0
        self.insert(count, np.empty(0, np.int32), hash_keys, hash_slots)

    def note_added(self, slots: NDArray[np.int32], count: int) -> None:
        """Note that the device has added to blocks, of `count` in all."""
        if len(self._behind) < count:
            self._behind = np.append(self._behind, np.zeros(2 * count - len(self._behind), bool))
        self._behind[slots] = True
        self._is_behind = True

    def note_written(self, slots: NDArray[Any]) -> None:
        """Note that the store's rows have been written to."""
        self._unsent.append(slots)

    def fetch(self, layers: dict[str, NDArray[Any]]) -> None:
        """Bring the store's rows up to date."""
        if not self._is_behind:
            return
        slots = np.flatnonzero(self._behind).astype(np.int32)
        for i in range(0, len(slots), _CHUNK):
            chunk = slots[i : i + _CHUNK]
            for name, rows in zip(self._names, self.call("read", self._names, chunk), strict=True):
                layers[name][chunk] = rows
            self._behind[chunk] = False
        self._is_behind = False

    def send(self, layers: dict[str, NDArray[Any]], count: int) -> None:
        """Bring the device's rows of `count` blocks up to date."""
        if not self._unsent:
            return
        slots = distinct(np.concatenate(self._unsent))
        slots = slots[slots < count].astype(np.int32)
        for i in range(0, len(slots), _CHUNK):
            chunk = slots[i : i + _CHUNK]
            for name in self._names:
                self.call("write", name, chunk, layers[name][chunk])
        self._unsent.clear()


def device_for(arch: Arch, *, color: bool, hits: bool, smooths: bool) -> DeviceBlocks | None:
    """The blocks of a new map on a device; None = it is on the CPU, by its settings or because there is no
    such device, which a warning says.

    Raises:
        MemoryError: the device has no memory for another map.
    """
    if smooths and arch != "cpu":
        log.warning("smoothing along rays (regularizer) needs the CPU; keyframes are fused there")
        return None
    link = link_to(arch)
    if link is not None and not link.is_trusted:
        from tsfusion.tsdf import device_trial

        link.is_trusted = device_trial.agrees(link)
        if not link.is_trusted:
            refuse(link, "it does not compute the map that the CPU does: update its driver")
            return None
    if link is None:
        return None
    names = {"sums": True, "color_rgn": color, "color_b": color, "hits": hits}
    return DeviceBlocks(link, tuple(name for name, there in names.items() if there))
