# SPDX-License-Identifier: MIT
"""Mesh blocks of a map, and say which triangles are those of each cell."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import VolumeConfig
from tsfusion.geometry.mesh import Mesh
from tsfusion.kernels.base.block_hash import insert_blocks
from tsfusion.kernels.integration.integrate import CUBE, QUANTA_PER_VOXEL
from tsfusion.kernels.surface import marching_cubes, surface_cells
from tsfusion.kernels.surface.surface_cells import STRIPS
from tsfusion.tsdf.store.block_store import BlockStore
from tsfusion.tsdf.store.growing_array import GrowingArray
from tsfusion.tsdf.surface.field_regularizer import SurfaceView, around, values_of

_BEHIND, _CLEAR = 2 / 3, 0.97  # shares of a band's half-width, and of the support
KEPT_BLOCKS = 1 << 14  # working memory for this many blocks is kept for the next mesh: 45 MB


class MeshBuffers:
    """Working memory of marching cubes: a row for each block, and one for absent blocks.

    `kernels/surface/surface_cells.py` explains the arrays.
    """

    def __init__(self) -> None:
        self.padded = np.empty((STRIPS, marching_cubes.PADDED), np.float32)
        self._forget()

    def _forget(self) -> None:
        self._table = np.zeros(0, np.int64)
        self._table_rows = np.zeros(0, np.int32)
        self.values = GrowingArray((CUBE,), np.float32, 0)
        self.around = GrowingArray((surface_cells.AROUND,), np.int32, 0)
        self.seen = GrowingArray((8,), np.uint64, 0)
        self.inside = GrowingArray((8,), np.uint64, 0)
        self.active = GrowingArray((8,), np.uint64, 0)
        self.edges = GrowingArray((surface_cells.PLANES,), np.uint64, 0)
        self.starts = GrowingArray((surface_cells.PLANES,), np.int32, 0)
        self.state = GrowingArray((4,), np.int32, 0)
        self.first = GrowingArray((2,), np.int32, 0)

    def _arrays(self) -> list[GrowingArray]:
        return [value for value in vars(self).values() if isinstance(value, GrowingArray)]

    def reserve(self, rows: int) -> None:
        for array in self._arrays():
            array.reserve(rows + 1)

    def release(self) -> None:
        """Free the memory if the last mesh was large."""
        if self.values.capacity > KEPT_BLOCKS:
            self._forget()

    def table(self, keys: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        size = 1 << max(4, (2 * keys).bit_length())
        if len(self._table) < size:
            self._table, self._table_rows = np.zeros(size, np.int64), np.zeros(size, np.int32)
        self._table[:size] = 0
        return self._table[:size], self._table_rows[:size]

    def keys_around(self, wanted: NDArray[np.int64], store: BlockStore) -> NDArray[np.int64]:
        """Return the sorted keys of the wanted blocks and of their neighbours in the map."""
        if len(wanted) == store.count:
            return wanted
        return around(wanted, store)

    @property
    def nbytes(self) -> int:
        return self.padded.nbytes + self._table.nbytes + self._table_rows.nbytes + sum(
            array.array.nbytes for array in self._arrays()
        )  # fmt: skip


def back_limits(config: VolumeConfig) -> tuple[float, float]:
    """Return two distances (quanta) that prevent a surface between front and back of a wall: a voxel beyond
    the first is far behind a surface, one beyond the second clear.

    A voxel that every ray looks through has at least the support. Without carving, or with varying bands, no
    voxel is far behind or clear: at a grazing angle, neighbouring voxels of a distant street have very
    different distances where noise widens the bands (stereo pairs), and where no planes are known (points,
    whose noise does not grow with distance).
    """
    model = config.model()
    away = model.max_range / 2 - model.sigma_z0
    noise = 3 * (model.sigma_floor + model.sigma_slope * away**2) / config.voxel_size
    if not config.space_carving or model.sigma_slope == 0 or noise > model.min_support:
        return surface_cells.NO_LIMITS
    band = min(model.min_behind, model.min_support)
    return -_BEHIND * band * QUANTA_PER_VOXEL, _CLEAR * model.min_support * QUANTA_PER_VOXEL


def extract(
    wanted: NDArray[np.int64],
    store: BlockStore,
    min_weight: float,
    buffers: MeshBuffers | None = None,
    view: SurfaceView = values_of,
) -> Mesh:
    """Return the mesh of the cells that belong to the map's blocks `wanted` (sorted distinct keys)."""
    return extract_cells(wanted, store, min_weight, buffers, view)[0]


def extract_cells(
    wanted: NDArray[np.int64],
    store: BlockStore,
    min_weight: float,
    buffers: MeshBuffers | None = None,
    view: SurfaceView = values_of,
) -> tuple[Mesh, NDArray[np.int32]]:
    """Return the mesh of `extract`, and (n + 1,) indices of the first face of each block's cells."""
    buffers = buffers or MeshBuffers()
    try:
        mesh, keys = extract_rows(wanted, store, min_weight, buffers, view)
        first = buffers.first.array[np.searchsorted(keys, wanted), 1]
        return mesh, np.append(first, np.int32(len(mesh.faces)))
    finally:
        buffers.release()  # even if memory ran out


def extract_rows(
    wanted: NDArray[np.int64],
    store: BlockStore,
    min_weight: float,
    buffers: MeshBuffers,
    view: SurfaceView,
    *,
    keys: NDArray[np.int64] | None = None,
) -> tuple[Mesh, NDArray[np.int64]]:
    """Return the mesh of `extract`, and the (n,) keys of the blocks in the rows of `buffers`.

    `keys` are the wanted blocks and their neighbours. `view` may have values for more blocks than the map.
    """
    keys = buffers.keys_around(wanted, store) if keys is None else keys
    count = len(keys)
    buffers.reserve(count)
    values = view(keys, store, min_weight, buffers.values.array)
    table, table_rows = buffers.table(count)
    insert_blocks(keys, 0, count, 0, table, table_rows)
    around, inside, active = buffers.around.array, buffers.inside.array, buffers.active.array
    edges, starts, first = buffers.edges.array, buffers.starts.array, buffers.first.array
    surface_cells.find_cells(
        count, keys, len(wanted), wanted, table, table_rows, values, *store.back_limits,
        marching_cubes.TRIANGLE_COUNT, around, buffers.seen.array, inside, active, edges, starts,
        buffers.state.array, first,
    )  # fmt: skip
    store.pause()
    vertices, triangles = first[count]
    positions, normals = np.empty((vertices, 3), np.float32), np.empty((vertices, 3), np.float32)
    colors = np.empty((vertices if store.color else 0, 3), np.uint8)
    slots = np.append(store.slots_of(keys), np.int32(-1))  # the last entry means an absent block
    marching_cubes.emit_vertices(
        count, keys, around, values, edges, first, buffers.padded, store.voxel_size, slots,
        store.color_rgn, store.color_b, int(store.color),
        positions, normals, colors,
    )  # fmt: skip
    store.rest()
    faces = np.empty((triangles, 3), np.int32)
    marching_cubes.emit_faces(
        count, around, inside, active, edges, starts, first,
        marching_cubes.TRIANGLE_COUNT, marching_cubes.TRIANGLE_STARTS, faces,
    )  # fmt: skip
    return Mesh(positions, faces, normals, colors if store.color else None), keys


@dataclass(frozen=True, eq=False)
class CellMeshes:
    """Triangles of some cells (blocks as viewers count them).

    Attributes:
        cells: (n, 3) int32 block coordinates, in key order.
        first_face: (n + 1,) int32: the cell in row i has the faces `first_face[i]` to `first_face[i + 1]`.
        mesh: mesh of these cells.
    """

    cells: NDArray[np.int32]
    first_face: NDArray[np.int32]
    mesh: Mesh
