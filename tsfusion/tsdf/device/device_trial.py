# SPDX-License-Identifier: MIT
"""Check that a GPU fuses exactly as the CPU does, before a map uses it, because drivers have errors."""

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import Arch, VolumeConfig
from tsfusion.geometry.keyframe import Intrinsics, Keyframe
from tsfusion.kernels.base import runtime
from tsfusion.tsdf.device.device_blocks import DeviceBlocks
from tsfusion.tsdf.device.device_integrator import DeviceIntegrator, DeviceRayBuffers
from tsfusion.tsdf.device.device_link import DeviceLink, link_to, refuse
from tsfusion.tsdf.integration.integrator import Integrator
from tsfusion.tsdf.integration.ray_buffers import RayBuffers
from tsfusion.tsdf.store.block_store import BlockStore

log = logging.getLogger(__name__)

_CONFIG = VolumeConfig(voxel_size=0.05, regularizer="off", space_carving=True)
_LAYERS = ("sums", "color_rgn", "color_b", "hits")


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
