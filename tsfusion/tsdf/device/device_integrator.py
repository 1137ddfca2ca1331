# SPDX-License-Identifier: MIT
"""Add keyframes to a map whose blocks are on a GPU; `Integrator` controls the transaction.

Before a map uses a GPU, a trial checks that it fuses exactly as the CPU does, because drivers have errors.
"""

import logging
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import Arch, VolumeConfig
from tsfusion.geometry.keyframe import Intrinsics, Keyframe
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.base.voxel_traversal import DEFERRED, STRIP_FIELDS, UPDATES
from tsfusion.kernels.device.device_copies import FRESH_AT, LACKING, NEW, STRIPS_AT
from tsfusion.kernels.integration.integrate import (
    ALL,
    ONLY_ADDED,
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    TOUCHED_MISSING,
    TOUCHED_OVERFLOW,
)
from tsfusion.tsdf.device.device_blocks import DeviceBlocks
from tsfusion.tsdf.device.device_link import DeviceLink, link_to, refuse
from tsfusion.tsdf.integration.integrator import BLOCK_COST, NO_LIMIT, PART_WEIGHT, Integrator, RayShare
from tsfusion.tsdf.integration.ray_buffers import RayBuffers
from tsfusion.tsdf.store.block_store import BlockStore

log = logging.getLogger(__name__)
_CONFIG = VolumeConfig(voxel_size=0.05, regularizer="off", space_carving=True)
_LAYERS = ("sums", "color_rgn", "color_b", "hits")


class DeviceRayBuffers(RayBuffers):
    """Rays of the current keyframe that stay on the GPU, and the report of a launch on the blocks touched."""

    def __init__(self, *, color: bool) -> None:
        super().__init__(color=color, regularised=False)
        self._missing_keys = np.empty(0, np.int64)
        self.asked: tuple[Any, ...] = ()  # requested rays: a kernel's name and its arguments
        self.is_light = False  # True if the samples are too few to use up a lane's reserve

    def note_told(self, told: NDArray[np.int32]) -> NDArray[np.int32]:
        """Take over a launch's report. Returns the slots of blocks touched for the first time."""
        new = told[FRESH_AT + 2 * told[NEW] :]
        self._touched.reserve(TOUCHED_HEADER)
        self.touched[:TOUCHED_HEADER] = told[:TOUCHED_HEADER]
        self.touched[TOUCHED_OVERFLOW] = 0  # on the CPU this field reports on `missing`
        self.touched[TOUCHED_COUNT] -= len(new)
        self.note_touched(new)
        return new

    def note_touched(self, slots: NDArray[np.int32]) -> None:
        first = TOUCHED_HEADER + int(self.touched[TOUCHED_COUNT])
        self._touched.reserve(first + len(slots))
        self.touched[first : first + len(slots)] = slots
        self.touched[TOUCHED_COUNT] += len(slots)

    def share_out(self, units: int) -> None:
        """Do nothing: on a GPU each ray has its own thread, so strips are not assigned to units."""

    def note_missing(self, keys: NDArray[np.int64]) -> None:
        """Store the keys of the blocks that the map lacks, in ascending order."""
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
        return np.ascontiguousarray(image)  # uint16 has half of the bytes of float32

    def _rays_of_points(self, points: NDArray[Any], *rest: Any) -> None:
        self._ask("point_rays", points, *rest)

    def _rays_of_image(self, image: NDArray[Any], *rest: Any) -> None:
        self._ask("image_rays", image, *rest)

    def _ask(self, kind: str, measured: NDArray[Any], *rest: Any) -> None:
        """Store the measurement; one later call to the GPU makes its rays and adds them."""
        self.asked = kind, measured, *rest
        samples = len(measured) if kind == "point_rays" else measured.size
        self.is_light = samples * WEIGHT_ONE < PART_WEIGHT


class DeviceIntegrator(Integrator):
    """Writer of a map's sums on a GPU: adds and subtracts keyframes. No other code changes these sums."""

    _buffers: DeviceRayBuffers

    def __init__(
        self, store: BlockStore, device: DeviceBlocks, buffers: DeviceRayBuffers, config: VolumeConfig
    ) -> None:
        super().__init__(store, buffers, config)
        self._device = device
        # Report of the first launch, and keys of missing blocks
        self._ahead: tuple[NDArray[np.int32], NDArray[np.int64]] | None = None
        self._has_inserted = False  # True if the launch also inserted the missing blocks

    def _begin(self, sign: int) -> None:
        """Make the keyframe's rays and add them in one call to the GPU: nearly always one part is enough."""
        super()._begin(sign)
        store, buffers, config = self._store, self._buffers, self._config
        store.send()
        kind, *arguments = buffers.asked
        job = (ALL, 0, len(buffers.strips), sign, 0, store.version, self._vote)
        new = min(self._most_missing(), store.spare) if sign > 0 else 0
        room = new, config.max_blocks_per_keyframe, self._most_cost, BLOCK_COST
        self._ahead, self._has_inserted = None, False
        found = self._device.call("fuse", kind, job if buffers.is_light else None, room, *arguments)
        told = found[0].copy()
        buffers.strips = _strips(told).copy()
        buffers.strips[:, UPDATES] = buffers.strips[:, DEFERRED] = 0
        if buffers.is_light:
            self._ahead = told, keys_told(told, found)

    def _take_back(self, added: list[RayShare], sign: int, before: int) -> None:
        if self._ahead is not None:  # refused before the report was read
            self._ahead, added = None, [(0, len(self._buffers.strips))]
        super()._take_back(added, sign, before)

    def _admit(self, part: RayShare, sign: int) -> None:
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
        self, part: RayShare, sign: int, *, which: int = ALL, oldest: int = 0, most_missing: int = NO_LIMIT
    ) -> None:
        store, buffers = self._store, self._buffers
        ahead, self._ahead = self._ahead, None
        if ahead is None:
            job = which, *part, sign, oldest, store.version, self._vote
            found = self._device.call("add", job)
            told = found[0].copy()
            missing = keys_told(told, found)
        else:
            told, missing = ahead
        self._has_inserted = bool(told[NEW])
        touched = buffers.note_told(told)
        if self._has_inserted:
            self._insert_when("never", missing)
        else:
            buffers.note_missing(missing)
        store.note_touched(touched)
        if which != ONLY_ADDED:
            made = _strips(told)[:, UPDATES].sum()
            if self._has_inserted:
                made += _strips(told)[:, LACKING].sum()
            buffers.strips[part[0], UPDATES] += made
            buffers.strips[part[0], DEFERRED] = len(missing)

    def _add_free(self, slots: NDArray[np.int32], sign: int) -> None:
        store, carved = self._store, self._buffers.carved
        self._device.call("add_free", slots, carved.amounts, carved.masks, sign)
        self._buffers.note_touched(slots[store.versions[slots] != store.version])
        store.note_touched(slots)

    def _measure_touched(self) -> None:
        slots = self._buffers.touched_slots
        if len(slots):
            (self._store.bounds[slots],) = self._device.call("largest_weights", slots)


def keys_told(told: NDArray[np.int32], found: Sequence[NDArray[Any]]) -> NDArray[np.int64]:
    """Return the keys of the blocks that a launch inserted, or else found missing."""
    if new := int(told[NEW]):
        return told[FRESH_AT : FRESH_AT + 2 * new].view(np.int64)
    return found[1].copy() if len(found) > 1 else np.empty(0, np.int64)


def _strips(told: NDArray[np.int32]) -> NDArray[np.int32]:
    return told[STRIPS_AT:FRESH_AT].reshape(-1, STRIP_FIELDS)


def device_for(arch: Arch, *, color: bool, hits: bool, smooths: bool) -> DeviceBlocks | None:
    """Return the blocks of a new map on the GPU, or None if the map must use the CPU.

    The CPU is used if `arch` says so. Other reasons are logged as warnings: smoothing along rays, no device,
    or a device that computes another map. Raises MemoryError if the device has no memory for another map.
    """
    if smooths and arch != "cpu":
        log.warning("smoothing along rays (regularizer) needs the CPU: no device fuses the keyframes")
        return None
    link = link_to(arch)
    if link is not None and not link.is_trusted:
        link.is_trusted = agrees(link)
        if not link.is_trusted:
            refuse(link, "it does not compute the map that the CPU does: update its driver")
            return None
    if link is None:
        return None
    names = {"sums": True, "color_rgn": color, "color_b": color, "hits": hits}
    return DeviceBlocks(link, tuple(name for name, there in names.items() if there))


def agrees(link: DeviceLink) -> bool:
    """Return True if the device and the CPU make the same map from test keyframes, added and retracted."""
    runtime.start(None)
    on_cpu = _store(None)
    buffers = RayBuffers(color=True, regularised=False)
    expected = _fused(on_cpu, buffers, Integrator(on_cpu, buffers, _CONFIG))
    device = DeviceBlocks(link, _LAYERS)
    on_device = _store(device)
    rays = DeviceRayBuffers(color=True)
    found = _fused(on_device, rays, DeviceIntegrator(on_device, device, rays, _CONFIG))
    return all((here == there).all() for here, there in zip(found, expected, strict=True))


def _store(device: DeviceBlocks | None) -> BlockStore:
    return BlockStore(voxel_size=_CONFIG.voxel_size, color=True, corrected=False, hits=True, device=device)


def _fused(store: BlockStore, buffers: RayBuffers, integrator: Integrator) -> list[NDArray[Any]]:
    """Fuse the test keyframes (an image is added twice and retracted once). Return keys, bounds and layers of
    the map, in key order, to compare."""
    for keyframe, sign in zip(_keyframes(), (1, 1, 1, -1), strict=True):
        buffers.make_rays(keyframe, _CONFIG)
        integrator.apply(sign)
    order = np.argsort(store.keys)
    return [
        store.keys[order],
        store.bounds[order],
        *(layer[: store.count][order] for layer in store.layers().values()),
    ]


def _keyframes() -> list[Keyframe]:
    """Return test keyframes: noisy surfaces, seen obliquely, with no coordinate on a voxel's border."""
    random = np.random.default_rng(0)
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
    pose[:3, 3] = random.normal(size=3)
    depth = 1.5 + 0.3 * random.random((48, 64)).astype(np.float32)
    color = random.integers(0, 256, (48, 64, 3), np.uint8)
    image = Keyframe(
        depth=depth, intrinsics=Intrinsics(60.0, 60.0, 31.5, 23.5), T_world_camera=pose, color=color
    )
    points = Keyframe(points=random.normal(size=(400, 3)).astype(np.float32), T_world_camera=pose)
    return [image, points, image, image]
