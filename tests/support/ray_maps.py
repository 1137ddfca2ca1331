# SPDX-License-Identifier: MIT
"""Rays made from line segments, and maps that they are put into without keyframes."""

import kernel_twins
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import VolumeConfig
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.voxel_traversal import COUNT, RAY_FIELDS, START, WEIGHT
from tsfusion.kernels.integration import integrate, ray_smoothing
from tsfusion.tsdf.integration.integrator import Integrator
from tsfusion.tsdf.integration.ray_buffers import STRIPS, RayBuffers
from tsfusion.tsdf.store.block_store import BlockStore, unpack_keys

QUANTA = integrate.QUANTA_PER_VOXEL
Segment = tuple[NDArray[np.int64], NDArray[np.float64], int]  # end 2⁻¹⁰ voxel, direction, half 2⁻⁸ voxel


def random_segments(seed: int, count: int, spread: float = 40.0) -> list[Segment]:
    random = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        direction = random.normal(size=3) * random.choice([1.0, 0.0, 1e-4], size=3, p=[0.8, 0.1, 0.1])
        direction = direction if np.any(direction) else np.array([0.0, 0.0, 1.0])
        end = kernel_twins.fixed(random.uniform(-spread, spread, 3))
        found.append((end, direction, int(random.integers(256, 4096))))
    return found


def border_segments() -> list[Segment]:
    """Along the axes and diagonals, ending exactly on voxel and block borders."""
    ends = [(0, 0, 0), (8 * 1024, 0, 0), (-8 * 1024, 512, 512), (1023, 1024, -1), (7 * 1024 + 1023,) * 3]
    ways = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 1, 1), (-1, 1, -1), (1, 1, 0)]
    return [(np.array(e), np.array(d, float), 3 * 256) for e in ends for d in ways]


SEGMENTS = {
    "none": [],
    "one": random_segments(1, 1),
    "many": random_segments(2, 300),
    "crowded": random_segments(3, 300, spread=3.0),
    "borders": border_segments(),
}


def rays_along(segments: list[Segment], seed: int = 0) -> NDArray[np.int32]:
    """Rays of random weights and colours."""
    random = np.random.default_rng(seed)
    rays = [
        kernel_twins.make_ray(*segment, int(random.integers(1, 256)), int(random.integers(0, 1 << 24)))
        for segment in segments
    ]
    return np.array(rays, np.int32).reshape(-1, RAY_FIELDS)


def carving_rays(seed: int, count: int) -> NDArray[np.int32]:
    """Rays that begin up to 300 voxels before they end: some before their band, some with it."""
    random = np.random.default_rng(seed)
    rays = [
        kernel_twins.make_ray(
            end, direction, half, int(random.integers(1, 256)), int(random.integers(0, 1 << 24)),
            before=int(random.integers(-20, 300)) << 8,
        )
        for end, direction, half in random_segments(seed, count)
    ]  # fmt: skip
    return np.array(rays, np.int32)


CASES = {name: rays_along(segments) for name, segments in SEGMENTS.items()}
CASES["carving"] = carving_rays(4, 100)


class RayMap:
    """A store and the means to put rays into it, without keyframes.

    Args:
        units: that share the rays, on however many threads.
    """

    def __init__(self, units: int = 3) -> None:
        runtime.start(2)
        self.store = BlockStore(voxel_size=1.0, color=True, corrected=True)
        self.buffers = RayBuffers(color=True, regularised=True)
        self._integrator = Integrator(self.store, self.buffers, VolumeConfig(regularizer="off"))
        self._integrator.units = units

    def apply(self, rays: NDArray[np.int32], sign: int = 1) -> int:
        """Add the rays, spread unevenly over strips."""
        buffers = self.buffers
        buffers.rays = np.vstack([rays, np.zeros((1, RAY_FIELDS), np.int32)])
        buffers.colored = True
        cuts = np.sort(np.random.default_rng(0).integers(0, len(rays) + 1, STRIPS - 1))
        edges = np.array([0, *cuts, len(rays)])
        buffers.strips[:, START], buffers.strips[:, COUNT] = edges[:-1], np.diff(edges)
        buffers.strips[:, WEIGHT] = 255 * np.diff(edges)
        return self._integrator.apply(sign)

    def smooth(self, smoothness: float, *, weighted: bool = True, feedback: bool = True) -> None:
        s, store = self.buffers, self.store
        s.reserve_votes()
        sums, correction, votes, voted = (
            layer.reshape(-1) for layer in (store.sums, store.correction, s.votes, s.voted)
        )
        voted[0] = 0
        ray_smoothing.smooth_rays(
            s.rays, s.strips, self._integrator.units, store.hash_keys, store.hash_slots, s.scratch,
            store.places, smoothness, int(weighted), int(feedback), sums, correction, s.signal, s.crossed,
            votes, voted,
        )  # fmt: skip
        ray_smoothing.commit_votes(s.touched, sums, votes, voted, correction)

    def voxels(self) -> dict[kernel_twins.Voxel, tuple[int, int]]:
        """(slot, offset) of every voxel with votes."""
        found = {}
        for slot, corner in enumerate(unpack_keys(self.store.keys) * 8):
            for o in np.flatnonzero(self.store.sums[slot]):
                x, y, z = (int(c) for c in corner + (o >> 6, o >> 3 & 7, o & 7))
                found[x, y, z] = (slot, int(o))
        return found

    def value(self, at: tuple[int, int]) -> float:
        packed = int(self.store.sums[at])
        return ((packed >> 27) + float(self.store.correction[at])) / (packed & 0x7FFFFFF)


def rays_of(buffers: RayBuffers) -> NDArray[np.int32]:
    return np.vstack([buffers.rays[s : s + n] for s, n in buffers.strips[:, [START, COUNT]]])
