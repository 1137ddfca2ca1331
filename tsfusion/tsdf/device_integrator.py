# SPDX-License-Identifier: MIT
"""Rays and integration where the map's blocks are on a device: the transaction is `Integrator`'s."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import VolumeConfig
from tsfusion.kernels.integrate import ALL, TOUCHED_MISSING
from tsfusion.tsdf.block_store import BlockStore, pack_keys
from tsfusion.tsdf.device_blocks import DeviceBlocks
from tsfusion.tsdf.integrator import NO_LIMIT, Integrator, Part
from tsfusion.tsdf.ray_buffers import RayBuffers


class DeviceRayBuffers(RayBuffers):
    """The rays stay on the device; here are their bands, and what a launch says about blocks."""

    def __init__(self, device: DeviceBlocks, *, color: bool) -> None:
        super().__init__(color=color, regularised=False)
        self._device = device
        self._missing_keys = np.empty(0, np.int64)

    def note_touched(self, found: NDArray[np.int32]) -> None:
        """Take over the touched blocks, behind their header."""
        self._touched.reserve(len(found))
        self.touched[: len(found)] = found

    def share_out(self, units: int) -> None:
        """Nothing: each ray has a thread of its own."""

    def note_missing(self, blocks: NDArray[np.int32]) -> None:
        """Take over the coordinates of missing blocks, (n, 3), some of them twice."""
        self._missing_keys = np.unique(pack_keys(blocks))
        self.touched[TOUCHED_MISSING] = len(self._missing_keys)

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

    def _rays_of_points(self, *arguments: Any) -> None:
        (bands,) = self._device.call("rays_of_points", *arguments)
        self.bands = bands.copy()

    def _rays_of_image(self, *arguments: Any) -> None:
        (bands,) = self._device.call("rays_of_image", *arguments)
        self.bands = bands.copy()


class DeviceIntegrator(Integrator):
    """The one writer of a map's sums on a device."""

    _buffers: DeviceRayBuffers

    def __init__(
        self, store: BlockStore, device: DeviceBlocks, buffers: DeviceRayBuffers, config: VolumeConfig
    ) -> None:
        super().__init__(store, buffers, config)
        self._device = device

    def _begin(self) -> None:
        super()._begin()
        self._store.send()
        self._device.call("begin")

    def _launch(
        self, part: Part, sign: int, *, which: int = ALL, oldest: int = 0, most_missing: int = NO_LIMIT
    ) -> None:
        store, buffers = self._store, self._buffers
        job = which, *part, sign, oldest, store.stamp, int(buffers.colored)
        buffers.bands, touched, missing = (one.copy() for one in self._device.call("add", job))
        buffers.note_touched(touched)
        buffers.note_missing(missing)
        store.note_touched(buffers.touched_slots)

    def _measure_touched(self) -> None:
        (bounds,) = self._device.call("largest_weights")
        self._store.bounds[self._buffers.touched_slots] = bounds
