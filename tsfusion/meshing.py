# SPDX-License-Identifier: MIT
"""Mesh extraction: plans the batches and the numbering; the work is in `kernels/marching.py`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels import marching, mc_tables
from tsfusion.kernels.blocks import find_blocks
from tsfusion.kernels.integrate import CUBE
from tsfusion.kernels.samples import WEIGHT_ONE
from tsfusion.mesh import Mesh

BATCH = 4096  # blocks; 22 MB of gathered values

_KEY_STEP = np.array([1 << 42, 1 << 21, 1], np.int64)  # one block along x, y, z in a packed key
_AROUND = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]) @ _KEY_STEP
_FORWARD = np.array([(c & 1, c >> 1 & 1, c >> 2 & 1) for c in range(8)]) @ _KEY_STEP


@dataclass(frozen=True)
class Layers:
    """What a mesh is read from: the map's arrays (slot, 512) and its hash."""

    sums: NDArray[np.int64]
    color_rgn: NDArray[np.int64] | None
    color_b: NDArray[np.int32]
    correction: NDArray[np.float32] | None
    hash_keys: NDArray[np.int64]
    hash_slots: NDArray[np.int32]
    voxel_size: float


def extract(wanted: NDArray[np.int64], layers: Layers, min_weight: float) -> Mesh:
    """Mesh of the cells of the blocks `wanted` (sorted distinct keys)."""
    # a cell's edges may belong to the next block along x, y, z
    keys = np.unique((wanted[:, None] + _FORWARD).ravel())
    keys = keys[_slots(keys, layers) >= 0]
    blocks = len(keys)
    cases = np.zeros((blocks, CUBE), np.uint8)
    edges = np.zeros((blocks, CUBE), np.int32)
    vertex_counts = np.zeros(blocks, np.int32)
    triangle_counts = np.zeros(blocks, np.int32)
    parts = []
    for first in range(0, blocks, BATCH):
        part = _Batch(keys[first : first + BATCH], first, wanted, layers, min_weight)
        part.count(cases, edges, vertex_counts, triangle_counts)
        parts.append(part.emit(edges, vertex_counts))
    faces = np.empty((int(triangle_counts.sum()), 3), np.int32)
    forward = _index(keys, keys[:, None] + _FORWARD)
    marching.emit_faces(
        cases, edges, forward, _starts(vertex_counts), _starts(triangle_counts),
        mc_tables.TRIANGLE_COUNT, mc_tables.TRIANGLE_EDGES, mc_tables.EDGE_CORNER, faces,
    )  # fmt: skip
    positions, normals, colors = (
        np.concatenate(column) if column else np.empty((0, 3), dtype)
        for column, dtype in zip(
            zip(*parts, strict=True) if parts else ((), (), ()),
            (np.float32, np.float32, np.uint8),
            strict=True,
        )
    )
    return Mesh(positions, faces, normals, colors if layers.color_rgn is not None else None)


class _Batch:
    """Some blocks, their values gathered with a border."""

    def __init__(
        self,
        keys: NDArray[np.int64],
        first: int,
        wanted: NDArray[np.int64],
        layers: Layers,
        min_weight: float,
    ) -> None:
        self.keys, self.first, self.layers = keys, first, layers
        around = keys[:, None] + _AROUND
        self.neighbours = _slots(around.ravel(), layers).reshape(around.shape)
        self.meshed = (_index(wanted, around) >= 0).astype(np.uint8)
        self.padded = np.empty((len(keys), marching.PADDED), np.float32)
        smoothed = layers.correction
        marching.gather_values(
            len(keys), self.neighbours, layers.sums,
            np.zeros((1, CUBE), np.float32) if smoothed is None else smoothed, int(smoothed is not None),
            max(1, int(np.ceil(min_weight * WEIGHT_ONE))), self.padded,
        )  # fmt: skip

    def count(self, cases: Any, edges: Any, vertex_counts: Any, triangle_counts: Any) -> None:
        marching.count_elements(
            len(self.keys), self.meshed, self.padded, mc_tables.TRIANGLE_COUNT, self.first,
            cases, edges, vertex_counts, triangle_counts,
        )  # fmt: skip

    def emit(
        self, edges: NDArray[np.int32], vertex_counts: NDArray[np.int32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
        counts = vertex_counts[self.first : self.first + len(self.keys)]
        total = int(counts.sum())
        positions = np.empty((total, 3), np.float32)
        normals = np.empty((total, 3), np.float32)
        has_color = self.layers.color_rgn is not None
        colors = np.empty((total, 3), np.uint8) if has_color else np.empty((0, 3), np.uint8)
        rgn = self.layers.color_rgn if self.layers.color_rgn is not None else np.zeros((1, CUBE), np.int64)
        marching.emit_vertices(
            len(self.keys), self.keys, self.neighbours, self.padded, self.first, edges, _starts(counts),
            self.layers.voxel_size, rgn, self.layers.color_b, int(has_color), positions, normals, colors,
        )  # fmt: skip
        return positions, normals, colors


def _starts(counts: NDArray[np.int32]) -> NDArray[np.int32]:
    return (np.cumsum(counts) - counts).astype(np.int32)


def _index(keys: NDArray[np.int64], queries: NDArray[np.int64]) -> NDArray[np.int32]:
    """Position of each query in the sorted `keys`, −1 where absent."""
    if not len(keys):
        return np.full(queries.shape, -1, np.int32)
    at = np.minimum(np.searchsorted(keys, queries), len(keys) - 1)
    return np.where(keys[at] == queries, at, -1).astype(np.int32)


def _slots(keys: NDArray[np.int64], layers: Layers) -> NDArray[np.int32]:
    slots = np.empty(len(keys), np.int32)
    find_blocks(keys, layers.hash_keys, layers.hash_slots, slots)
    return slots
