# SPDX-License-Identifier: MIT
"""Read the surface of a map: its values as fused or smoothed, and meshes of the map or of some cells."""

from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import SensorModel, Surface
from tsfusion.core.errors import InvalidConfig
from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.mesh_parts import joined
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration import integrate
from tsfusion.tsdf.store.block_store import BlockStore, pack_keys, unpack_keys
from tsfusion.tsdf.surface import field_regularizer, hole_filling, mesh_tiles
from tsfusion.tsdf.surface.field_regularizer import SurfaceView, values_of
from tsfusion.tsdf.surface.mesh_extraction import CellMeshes, MeshBuffers, extract, extract_cells
from tsfusion.tsdf.surface.surface_layers import SurfaceCubes

MOST_SURFACES = 2  # surfaces whose values are kept for later answers


class MapSurface:
    """Values and meshes of one map's surface. An argument `surface` of None means the map's own setting."""

    def __init__(self, store: BlockStore, model: SensorModel) -> None:
        self.store, self._model = store, model
        self._field = field_regularizer.FieldSettings(
            model.field_smoothness, model.field_edge, model.field_reweightings
        )
        self._buffers = MeshBuffers()
        self._cubes = OrderedDict[tuple[Surface, float], SurfaceCubes]()

    @property
    def nbytes(self) -> int:
        return self._buffers.nbytes + sum(cubes.nbytes for cubes in self._cubes.values())

    def min_weight(self, given: float | None) -> float:
        """Return the weight from which a voxel counts as seen. Raises InvalidConfig for an impossible one."""
        least = self._model.min_weight if given is None else given
        most = integrate.WEIGHT_LIMIT / WEIGHT_ONE
        if not 0 <= least <= most:
            raise InvalidConfig(f"min_weight must be from 0 to {most:.0f}, got {least}")
        return least

    def reach(self, surface: Surface | None = None) -> int:
        """Return the distance in blocks up to which a change of the sums changes a block's values."""
        return {"raw": 0, "normal": 1, "field": self._field.halo}[surface or self._model.surface]

    def view(self, surface: Surface | None = None) -> SurfaceView:
        """Return the function that reads a surface's signed distances from the map."""
        surface = surface or self._model.surface
        if surface not in get_args(Surface):
            raise InvalidConfig(f"surface must be one of {', '.join(get_args(Surface))}, got {surface!r}")
        if surface == "field":
            return partial(field_regularizer.solve, settings=self._field)
        if surface == "normal":
            return partial(field_regularizer.along_normals, smoothness=self._model.smoothness)
        return values_of

    def cubes(self, surface: Surface | None, min_weight: float | None) -> SurfaceCubes:
        """Return the layers of a surface, whose values and meshes follow the map."""
        least = self.min_weight(min_weight)
        view, which = self.view(surface), (surface or self._model.surface, least)
        if which not in self._cubes:
            self._cubes[which] = SurfaceCubes(self.store, view, least, self.reach(surface))
        self._cubes.move_to_end(which)
        while len(self._cubes) > MOST_SURFACES:
            self._cubes.popitem(last=False)
        return self._cubes[which]

    def extract(
        self,
        min_weight: float | None,
        blocks: NDArray[np.int32] | None,
        surface: Surface | None,
        fill_holes: int | None,
    ) -> Mesh:
        """Return the mesh of `Volume.extract_mesh`."""
        least, view, store = self.min_weight(min_weight), self.view(surface), self.store
        if fill_holes is not None:
            if blocks is not None:
                raise InvalidConfig("holes are filled in the mesh of a whole map, not of some blocks")
            return hole_filling.extract_filled(store, least, view, hole_filling.checked(fill_holes))
        if blocks is None and store.is_in_files and store.count:
            return joined(list(mesh_tiles.tiles(store, least, view)))
        chosen = store.keys
        if blocks is not None:
            if np.shape(blocks)[1:] != (3,) or np.asarray(blocks).dtype.kind != "i":
                raise InvalidConfig(f"blocks must be (n, 3) integers, got {np.asarray(blocks)!r}")
            reachable = (np.abs(np.asarray(blocks, np.int64)) < 1 << 18).all(axis=1)  # others have no key
            chosen = distinct(pack_keys(blocks[reachable]))
            chosen = chosen[store.slots_of(chosen) >= 0]
        with self._own_buffers() as buffers:
            return extract(np.sort(chosen), store, least, buffers, view)

    @contextmanager
    def _own_buffers(self) -> Iterator[MeshBuffers]:
        """Yield working memory for a mesh, separate if another mesh is just being made."""
        buffers, self._buffers = self._buffers, MeshBuffers()
        try:
            yield buffers
        finally:
            self._buffers = buffers

    def mesh_cells(
        self,
        cells: NDArray[np.int32],
        surface: Surface | None = None,
        *,
        values: SurfaceView | None = None,
    ) -> CellMeshes:
        """Return the mesh of `Volume.extract_mesh(blocks=cells)`, and the range of faces of each cell.

        Args:
            cells: (n, 3) int32 block coordinates; a block that the map does not have adds no faces.
            values: source of the surface's values, such as `KeptValues`.
        """
        keys, view = distinct(pack_keys(cells)), values or self.view(surface)
        is_there = self.store.slots_of(keys) >= 0
        with self._own_buffers() as buffers:
            mesh, first = extract_cells(keys[is_there], self.store, self.min_weight(None), buffers, view)
        faces = np.zeros(len(keys) + 1, np.int32)
        faces[1:][is_there] = np.diff(first)
        return CellMeshes(unpack_keys(keys), np.cumsum(faces, dtype=np.int32), mesh)

    def cell_versions(self, cells: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the (n,) versions of the last change to the blocks (n, 3); 0 = none since the opening."""
        slots = self.store.slots_of(pack_keys(cells))
        return np.where(slots >= 0, self.store.versions[slots], 0)

    def values_reached(self, dirty: NDArray[np.int32], surface: Surface | None = None) -> NDArray[np.int64]:
        """Return keys of blocks whose values depend on the blocks `dirty` (n, 3), to forget them."""
        rings = {"raw": 0, "normal": 1, "field": self._field.rings}[surface or self._model.surface]
        return field_regularizer.around(pack_keys(dirty), self.store, rings)

    def mesh_run(self, keys: NDArray[np.int64], which: range) -> mesh_tiles.MeshRun:
        """Return some tiles of a larger map's mesh. This map has the blocks of `mesh_tiles.blocks_of_run` and
        their surroundings.

        Args:
            keys: sorted keys of all blocks of the larger map.
            which: numbers of the tiles, below `mesh_tiles.tile_count`.
        """
        return mesh_tiles.run(keys, which, self.store, self.min_weight(None), self.view())
