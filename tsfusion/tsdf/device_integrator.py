# SPDX-License-Identifier: MIT
"""Rays and integration where the map's blocks are on a device: the transaction is `Integrator`'s."""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import VolumeConfig
from tsfusion.kernels.integrate import (
    ALL,
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    TOUCHED_MISSING,
    TOUCHED_OVERFLOW,
)
from tsfusion.kernels.sensor_noise import WEIGHT_ONE
from tsfusion.tsdf.block_store import BlockStore
from tsfusion.tsdf.device_blocks import DeviceBlocks
from tsfusion.tsdf.integrator import BLOCK_COST, NO_LIMIT, PART_WEIGHT, Integrator, Part
from tsfusion.tsdf.ray_buffers import RayBuffers


class DeviceRayBuffers(RayBuffers):
    """The rays stay on the device; here are their bands, and what a launch says about blocks."""

    def __init__(self, *, color: bool) -> None:
        super().__init__(color=color, regularised=False)
        self._missing_keys = np.empty(0, np.int64)
        self.asked: tuple[Any, ...] = ()  # for which rays: a kernel's name and its arguments
        self.is_light = False  # whether no lane can overflow that has reserve for a part

    def note_touched(self, found: NDArray[np.int32]) -> NDArray[np.int32]:
        """Take over the header of the touched blocks, and more of them; returns the slots of these."""
        new, end = found[TOUCHED_HEADER:], TOUCHED_HEADER + int(found[TOUCHED_COUNT])
        self._touched.reserve(end)
        self.touched[:TOUCHED_HEADER] = found[:TOUCHED_HEADER]
        self.touched[TOUCHED_OVERFLOW] = 0  # which on the CPU is said of `missing`
        self.touched[end - len(new) : end] = new
        return new

    def share_out(self, units: int) -> None:
        """Nothing: each ray has a thread of its own."""

    def note_missing(self, keys: NDArray[np.int64]) -> None:
        """Take over the keys of missing blocks, in order."""
        self._missing_keys = keys
        self.touched[TOUCHED_MISSING] = len(keys)

    @property
    def most_missing(self) -> int:
        return NO_LIMIT

    def take_missing(self) -> NDArray[np.int64]:
        keys = self._missing_keys
        self.forget_missing()
        return keys

    def forget_missing(self) -> None:
        self._missing_keys = np.empty(0, np.int64)
        self.touched[TOUCHED_MISSING] = 0

    @staticmethod
    def as_read(image: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(image)  # half of the bytes, where it is uint16

    def _rays_of_points(self, points: NDArray[Any], *rest: Any) -> None:
        self._ask("rays_from_points", points, *rest)

    def _rays_of_image(self, image: NDArray[Any], *rest: Any) -> None:
        self._ask("rays_from_image", image, *rest)

    def _ask(self, kind: str, measured: NDArray[Any], *rest: Any) -> None:
        """Note which rays are to be made: that and what is to be done with them is one call."""
        self.asked = kind, measured, *rest
        samples = len(measured) if kind == "rays_from_points" else measured.size
        self.is_light = samples * WEIGHT_ONE < PART_WEIGHT


class DeviceIntegrator(Integrator):
    """The one writer of a map's sums on a device."""

    _buffers: DeviceRayBuffers

    def __init__(
        self, store: BlockStore, device: DeviceBlocks, buffers: DeviceRayBuffers, config: VolumeConfig
    ) -> None:
        super().__init__(store, buffers, config)
        self._device = device
        self._ahead: list[NDArray[Any]] | None = None  # what the first launch found, when it was made
        self._has_inserted = False  # it has inserted the missing blocks, too

    def _begin(self, sign: int) -> None:
        """Make the rays, and add them in the same call: nearly always all of them are one part."""
        super()._begin(sign)
        store, buffers, config = self._store, self._buffers, self._config
        store.send()
        kind, *arguments = buffers.asked
        job = (ALL, 0, len(buffers.bands), sign, 0, store.stamp, int(buffers.colored))
        new = min(self._most_missing(), store.spare) if sign > 0 else 0
        room = new, config.max_blocks_per_keyframe, self._most_cost, BLOCK_COST
        self._ahead, self._has_inserted = None, False
        found = self._device.call("make_rays", kind, job if buffers.is_light else None, room, *arguments)
        if buffers.is_light:
            self._ahead = [one.copy() for one in found]
        buffers.bands = self._ahead[0] if self._ahead else found[0].copy()

    def _take_back(self, added: list[Part], sign: int, before: int) -> None:
        if self._ahead is not None:  # refused before it was looked at
            self._ahead, added = None, [(0, len(self._buffers.bands))]
        super()._take_back(added, sign, before)

    def _admit(self, part: Part, sign: int) -> None:
        if self._has_inserted:
            self._note_admitted(self._store.count - self._admitted)
        else:
            super()._admit(part, sign)

    def _insert(self, keys: NDArray[np.int64]) -> None:
        self._insert_when("later", keys)

    def _insert_when(self, when: Literal["later", "never"], keys: NDArray[np.int64]) -> None:
        self._device.sends_blocks = when
        try:
            self._store.insert(keys)
        finally:
            self._device.sends_blocks = "now"

    def _launch(
        self, part: Part, sign: int, *, which: int = ALL, oldest: int = 0, most_missing: int = NO_LIMIT
    ) -> None:
        store, buffers = self._store, self._buffers
        found, self._ahead = self._ahead, None
        if found is None:
            job = which, *part, sign, oldest, store.stamp, int(buffers.colored)
            found = [*(one.copy() for one in self._device.call("add", job)), np.array(False)]
        buffers.bands, touched, missing, self._has_inserted = *found[:3], bool(found[3])
        if self._has_inserted:
            self._insert_when("never", missing)
        else:
            buffers.note_missing(missing)
        store.note_touched(buffers.note_touched(touched))

    def _measure_touched(self) -> None:
        (bounds,) = self._device.call("largest_weights")
        self._store.bounds[self._buffers.touched_slots] = bounds
