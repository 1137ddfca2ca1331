# SPDX-License-Identifier: MIT
"""Read a map without changing it: surfaces, hashes, files of voxels."""

import hashlib
import math
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import Surface, VolumeConfig
from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.core.number_ranges import distinct
from tsfusion.core.readable_numbers import OnProgress, count_of
from tsfusion.geometry import object_cards
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.mesh_arrays import Provenance
from tsfusion.geometry.mesh_parts import MeshParts, joined
from tsfusion.geometry.up_direction import HeldSensor, Up
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration import integrate
from tsfusion.tsdf.files import map_history, voxel_arrays
from tsfusion.tsdf.files.checkpoint import CheckpointHeader
from tsfusion.tsdf.store.block_store import BlockStore, cells_of, pack_keys, unpack_keys
from tsfusion.tsdf.sums import map_difference
from tsfusion.tsdf.sums.map_difference import MapDifference
from tsfusion.tsdf.surface import field_regularizer, hole_filling, mesh_tiles
from tsfusion.tsdf.surface.field_regularizer import SurfaceView, values_of
from tsfusion.tsdf.surface.mesh_extraction import MeshBuffers, extract
from tsfusion.tsdf.surface.mesh_tiles import WholeMapValues, tiles
from tsfusion.tsdf.surface.surface_tiles import KeptValues
from tsfusion.tsdf.texture.texture_fitting import PosedImages

_MOST_SHOWN = 50_000  # blocks; a larger map has no picture, because a picture needs a mesh


def begin_hash(voxel_size: float) -> "hashlib.blake2b":
    """Return a digest for the keys and then the sums of a map's used blocks, 1024 blocks per step."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(struct.pack("<di", voxel_size, integrate.QUANTA_PER_VOXEL))
    return digest


class ReadableMap(object_cards.Shown):
    """Map with the methods of `Volume` that do not change it.

    Attributes:
        config, model: settings of the map, and of its sensor.
        keyframes: number of fused keyframes with a usable sample.
        held: how their sensors were held.
        meta: JSON-like content that is saved with the map.
    """

    def __init__(self, config: VolumeConfig, store: BlockStore) -> None:
        self.config = config
        self.model = config.checked_model()
        self.meta: dict[str, Any] = {}
        self.keyframes = 0
        self.held = HeldSensor()
        self._blocks = store
        self._mesh_buffers = MeshBuffers()

    def _facts(self) -> dict[str, str]:
        count = self._blocks.count  # readable from any thread, such as a debugger's
        size = object_cards.extent(unpack_keys(self._blocks.keys) * (8 * self.config.voxel_size))
        return {
            "keyframes": count_of(self.keyframes, "keyframe"),
            "blocks": f"{count} blocks of 8³ voxels of {1000 * self.config.voxel_size:g} mm",
            "sensor": f"sensor {self.config.sensor}",
            "size": size,
        }

    def _pictures(self) -> list[object_cards.Picture | None]:
        return self.extract_mesh(surface="raw")._pictures() if self._store.count <= _MOST_SHOWN else []

    @property
    def _store(self) -> BlockStore:
        """Blocks of the map. Raises MapError in a thread other than the map's own."""
        runtime.check_thread()
        return self._blocks

    def extract_mesh(
        self,
        min_weight: float | None = None,
        blocks: NDArray[np.int32] | None = None,
        surface: Surface | None = None,
        *,
        fill_holes: int | None = None,
        texture: PosedImages | None = None,
    ) -> Mesh:
        """Return the surface by marching cubes over the whole map, or over the cells of some blocks.

        Args:
            min_weight: full-confidence samples that a voxel needs to count as seen; default: the sensor's
                value.
            blocks: (n, 3) int32 block coordinates. The mesh of `cells_to_mesh(take_dirty())` replaces the
                changed parts of a mesh.
            surface: surface instead of that of the settings; for `raw`, `cells_of(take_dirty())` suffice.
            fill_holes: close holes and gaps up to this many voxels wide with a guess that continues the field
                (`surface/hole_filling.py`); `guessed` of the mesh marks these triangles. Only for a whole
                map, whose field must fit into memory.
            texture: the map's keyframes at their poses, in a list or another collection to read several
                times: the mesh is a `TexturedMesh` with colours as sharp as the images
                (`texturing.textured`).

        Raises:
            InvalidConfig: for a value out of range, or `fill_holes` with `blocks`.
            MapError, MissingDependency: as `texturing.textured`.
        """
        if texture is not None:
            from tsfusion.tsdf.texture import texturing

            plain = self.extract_mesh(min_weight, blocks, surface, fill_holes=fill_holes)
            return texturing.textured(plain, texture, self.config.voxel_size)
        min_weight = self._checked_min_weight(min_weight)
        store = self._store
        if fill_holes is not None:
            if blocks is not None:
                raise InvalidConfig("holes are filled in the mesh of a whole map, not of some blocks")
            voxels = hole_filling.checked(fill_holes)
            filled = hole_filling.extract_filled(store, min_weight, self._view(surface), voxels)
            return replace(filled, held=self.held)
        if blocks is None and store.is_in_files and store.count:
            whole = joined(list(tiles(store, min_weight, self._view(surface))))
            return replace(whole, held=self.held)
        chosen = store.keys
        if blocks is not None:
            if np.shape(blocks)[1:] != (3,) or np.asarray(blocks).dtype.kind != "i":
                raise InvalidConfig(f"blocks must be (n, 3) integers, got {np.asarray(blocks)!r}")
            reachable = (np.abs(np.asarray(blocks, np.int64)) < 1 << 18).all(axis=1)  # others have no key
            chosen = distinct(pack_keys(blocks[reachable]))
            chosen = chosen[store.slots_of(chosen) >= 0]
        with self._own_buffers() as buffers:
            mesh = extract(np.sort(chosen), self._store, min_weight, buffers, self._view(surface))
        return mesh if blocks is not None else replace(mesh, held=self.held)

    @contextmanager
    def _own_buffers(self) -> Iterator[MeshBuffers]:
        """Yield working memory for a mesh. A mesh that is made during a pause gets separate memory."""
        buffers, self._mesh_buffers = self._mesh_buffers, MeshBuffers()
        try:
            yield buffers
        finally:
            self._mesh_buffers = buffers

    def whole_values(self, surface: Surface | None = None) -> WholeMapValues:
        """Return the values that `extract_mesh` of the whole map meshes, for `mesh_cells`; valid until the
        map changes."""
        return WholeMapValues(np.sort(self._store.keys), self._view(surface), field_regularizer.BATCH)

    def kept_values(self) -> KeptValues:
        """Return the values of the map's surface for `mesh_cells`, kept between calls while the map grows."""
        return KeptValues(self._store, self._view(None))

    def mesh_parts(
        self, folder: str | os.PathLike[str], min_weight: float | None = None, *, up: Up | None = None
    ) -> MeshParts:
        """Return the mesh of the whole map, made tile by tile in bounded memory, for saving.

        Args:
            folder: folder for unnamed files that hold the mesh until then.
            min_weight: as for `extract_mesh`.
            up: direction away from the ground; None = find it.

        Raises:
            OutputError: when the folder's disk has no room.
        """
        least = self._checked_min_weight(min_weight)
        parts = tiles(self._store, least, self._view(None))
        return MeshParts(parts, Path(folder), held=self.held, known_up=up)

    def mesh_run(self, keys: NDArray[np.int64], which: range) -> mesh_tiles.MeshRun:
        """Return some tiles of a larger map's mesh. This map has the blocks of `mesh_tiles.blocks_of_run` and
        their surroundings.

        Args:
            keys: sorted keys of all blocks of the larger map.
            which: numbers of the tiles, below `mesh_tiles.tile_count`.
        """
        least = self._checked_min_weight(None)
        return mesh_tiles.run(keys, which, self._store, least, self._view(None))

    def provenance(self, source: str | None = None) -> Provenance:
        """Return facts about the map for a file of its surface, with a newly computed hash.

        `source` is the file or folder of the map's input; the result has its name, not its path.
        """
        return _provenance(self.meta, self.keyframes, self.map_hash(), self.config, source)

    def cells_to_mesh(self, dirty: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the blocks whose mesh depends on the changed blocks: (m, 3) int32.

        These are the changed blocks, the blocks into which the field carries the change, and their neighbours
        towards −x, −y, −z. In a raw mesh, normals at the rim can lack the newest keyframe.
        """
        return self._cells_reached(dirty, self.model.surface)

    def _cells_reached(self, dirty: NDArray[np.int32], surface: Surface) -> NDArray[np.int32]:
        """Return the cells to mesh again, as `cells_to_mesh`, for a given surface."""
        return cells_of(unpack_keys(self.values_reached(dirty, surface)))

    def values_reached(self, dirty: NDArray[np.int32], surface: Surface | None = None) -> NDArray[np.int64]:
        """Return keys of the blocks whose values depend on the changed blocks (n, 3), for `KeptValues`."""
        keys, surface = pack_keys(dirty), surface or self.model.surface
        if surface == "normal":
            return field_regularizer.around(keys, self._store, 1)
        return field_regularizer.spread(keys, self._store, self._field) if surface == "field" else keys

    def diff(self, later: "ReadableMap", *, tolerance: float | None = None) -> MapDifference:
        """Compare with a later map of the same frame, in numbers and as a coloured mesh.

        Args:
            later: the other map.
            tolerance: distance in metres up to which two surfaces count as the same; default two voxels.

        Raises:
            MapError: when the maps have voxels of different sizes.
            InvalidConfig: for a negative or infinite tolerance.
        """
        self._check_voxels(later)
        metres = 2 * self.config.voxel_size if tolerance is None else tolerance
        if not 0 <= metres < math.inf:
            raise InvalidConfig(f"tolerance must be 0 metres or more, got {tolerance}")
        blocks, voxels = map_difference.count(self._store, later._store)
        earlier, other = (
            map_difference.MapSide(one.extract_mesh().without_islands(), one._store, one.model.min_weight)
            for one in (self, later)
        )
        return MapDifference(blocks, voxels, *map_difference.surfaces(earlier, other, metres))

    def save_voxels(
        self,
        path: str | os.PathLike[str],
        *,
        dense: bool = False,
        field: voxel_arrays.FieldName = "tsdf",
        max_distance: float = 0.5,
        min_weight: float | None = None,
        watch: OnProgress = lambda _done, _all: None,
    ) -> Path:
        """Write voxels for NumPy (.npz), zarr (.zarr, a folder) or OpenVDB (.vdb), completely or not at all.

        `tsdf/files/voxel_arrays.py` describes the arrays.

        Args:
            path: the file; `.npz`, `.zarr` or `.vdb`.
            dense: one array around the whole map, instead of its blocks; not for OpenVDB.
            field: `tsdf`, signed distances as fused with weights and colours, or `distance`, the Euclidean
                distance field.
            max_distance, min_weight: settings of the distance field, as for `distance_blocks`.
            watch: called with the written bytes and the total bytes (not for OpenVDB).

        Raises:
            InvalidConfig: for another suffix or field.
            OutputError: for an empty map, a too large box, or a path that cannot be written.
            MissingDependency: zarr is not installed.
        """
        voxel_arrays.write(
            self._store, Path(path), dense=dense, field=field, max_distance=max_distance,
            min_weight=self._checked_min_weight(min_weight), watch=watch,
        )  # fmt: skip
        return Path(path)

    def map_hash(self) -> str:
        """Return a hex digest of the exact sums: equal for the same keyframes in any order, on any threads.

        Colours, which compression may change, and smoothed values, which depend on order, are left out.
        """
        digest = begin_hash(self.config.voxel_size)
        for keys, sums in self._store.in_order("sums"):
            digest.update(keys.data)
            digest.update(sums.data)
        return digest.hexdigest()

    def color_hash(self) -> str:
        """Return a hex digest of the exact colour sums."""
        digest = hashlib.blake2b(digest_size=16)
        if self.config.color:
            for layer in ("color_rgn", "color_b"):
                for keys, sums in self._store.in_order(layer):
                    digest.update(keys.data)
                    digest.update(sums.data)
        return digest.hexdigest()

    def _check_voxels(self, other: "ReadableMap") -> None:
        ours, theirs = self.config.voxel_size, other.config.voxel_size
        if ours != theirs:
            raise MapError(f"the maps have voxels of {ours:g} m and {theirs:g} m: fuse one of them again")

    def _checked_min_weight(self, min_weight: float | None) -> float:
        if min_weight is None:
            min_weight = self.model.min_weight
        most = integrate.WEIGHT_LIMIT / WEIGHT_ONE
        if not 0 <= min_weight <= most:
            raise InvalidConfig(f"min_weight must be from 0 to {most:.0f}, got {min_weight}")
        return min_weight

    @property
    def _halo(self) -> int:
        """Width of the halo of blocks, on each side, that a block's surface depends on."""
        return {"raw": 0, "normal": 1, "field": self._field.halo}[self.model.surface]

    @property
    def _field(self) -> field_regularizer.FieldSettings:
        model = self.model
        return field_regularizer.FieldSettings(
            model.field_smoothness, model.field_edge, model.field_reweightings
        )

    def _view(self, surface: Surface | None) -> SurfaceView:
        """Return the function that reads a surface's signed distances from the map."""
        surface = surface or self.model.surface
        if surface not in get_args(Surface):
            raise InvalidConfig(f"surface must be one of {', '.join(get_args(Surface))}, got {surface!r}")
        if surface == "field":
            return partial(field_regularizer.solve, settings=self._field)
        if surface == "normal":
            return partial(field_regularizer.along_normals, smoothness=self.model.smoothness)
        return values_of


def map_provenance(header: CheckpointHeader) -> Provenance:
    """Return the provenance of a saved map's surface, from the map's header."""
    return _provenance(header.meta, header.keyframes, header.map_hash, header.config, None)


def _provenance(
    meta: dict[str, Any],
    keyframes: int,
    map_hash: str,
    config: VolumeConfig,
    source: str | None,
) -> Provenance:
    return Provenance(
        source=None if source is None else Path(source).resolve().name,
        keyframes=keyframes,
        map_hash=map_hash,
        world=" ".join(sorted(filter(None, map_history.worlds(meta)))),
        voxel_size=config.voxel_size,
    )
