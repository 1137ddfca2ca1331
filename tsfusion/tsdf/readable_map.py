# SPDX-License-Identifier: MIT
"""What is read from a map: surfaces, distances, hashes, files of voxels. Nothing here changes it."""

import hashlib
import math
import os
import struct
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsfusion.core.config import Surface, VolumeConfig
from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.geometry import up_direction
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_answers import PointCloud, Samples, View, checked_camera, checked_points
from tsfusion.geometry.map_grids import DistanceField, DistanceSlice, OccupancySlice
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.mesh_parts import MeshParts, joined
from tsfusion.geometry.provenance import Provenance
from tsfusion.geometry.up_direction import HeldSensor, Up
from tsfusion.kernels import integrate
from tsfusion.kernels.sensor_noise import WEIGHT_ONE
from tsfusion.tsdf import (
    camera_views,
    distance_fields,
    field_regularizer,
    hole_filling,
    map_blocks,
    map_difference,
    map_history,
    map_slices,
    point_samples,
    voxel_arrays,
)
from tsfusion.tsdf.block_store import ASKED, BlockStore, cells_of, pack_keys, unpack_keys
from tsfusion.tsdf.distance_fields import FieldBlocks
from tsfusion.tsdf.map_blocks import Blocks
from tsfusion.tsdf.map_difference import MapDifference
from tsfusion.tsdf.map_slices import CurrentSlice
from tsfusion.tsdf.mesh_extraction import MeshBuffers, extract
from tsfusion.tsdf.mesh_tiles import tiles
from tsfusion.tsdf.surface_tiles import SurfaceTiles
from tsfusion.tsdf.surface_values import SurfaceView, values_of
from tsfusion.tsdf.texture_images import Keyframes

MOST_SURFACES = 2  # that answers are kept of


class ReadableMap:
    """A map as one reads it: `Volume` without the ways to change it.

    Attributes:
        config: its settings; `model`: those of its sensor.
        keyframes: number of those in it with a usable sample.
        held: their sensors.
        meta: anything JSON-like that is saved with it.
    """

    def __init__(self, config: VolumeConfig, store: BlockStore) -> None:
        self.config = config
        self.model = config.checked_model()
        self.meta: dict[str, Any] = {}
        self.keyframes = 0
        self.held = HeldSensor()
        self._store = store
        self._mesh_buffers = MeshBuffers()
        self._tiles = OrderedDict[tuple[Surface, float], SurfaceTiles]()

    def extract_mesh(
        self,
        min_weight: float | None = None,
        blocks: NDArray[np.int32] | None = None,
        surface: Surface | None = None,
        *,
        fill_holes: int | None = None,
        texture: Keyframes | None = None,
    ) -> Mesh:
        """The surface, by marching cubes over the whole map or over the cells of some blocks.

        Args:
            min_weight: full-confidence samples a voxel needs to count as seen; default the sensor's.
            blocks: (n, 3) int32 block coordinates. A mesh of `cells_to_mesh(take_dirty())` replaces what
                changed.
            surface: what to mesh instead of what the settings say; for `raw`, `cells_of(take_dirty())` do.
            fill_holes: close holes and gaps up to so many voxels wide with a guess that continues the field
                (`tsdf/hole_filling.py`); the mesh's `guessed` says which triangles these are. Of a whole map
                only, and all of its field has to fit into memory.
            texture: the map's keyframes at their poses, a list or anything that can be read again and again:
                the mesh is a `TexturedMesh` with colours as sharp as their images (`texturing.textured`).

        Raises:
            InvalidConfig: for a value out of range, or `fill_holes` with `blocks`.
            MapError, MissingDependency: as `texturing.textured`.
        """
        if texture is not None:
            from tsfusion.tsdf import texturing

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
            chosen = np.unique(pack_keys(blocks[reachable]))
            chosen = chosen[store.slots_of(chosen) >= 0]
        buffers, self._mesh_buffers = self._mesh_buffers, MeshBuffers()  # who asks in a pause has others
        try:
            mesh = extract(np.sort(chosen), self._store, min_weight, buffers, self._view(surface))
        finally:
            self._mesh_buffers = buffers
        return mesh if blocks is not None else replace(mesh, held=self.held)

    def mesh_parts(
        self, folder: str | os.PathLike[str], min_weight: float | None = None, *, up: Up | None = None
    ) -> MeshParts:
        """The mesh of the whole map, made tile by tile in bounded memory, to be saved: `extract_mesh`'s.

        Args:
            folder: where it waits in files without names.
            up: away from the ground; None = it is found.

        Raises:
            OutputError: when the folder's disk has no room.
        """
        least = self._checked_min_weight(min_weight)
        parts = tiles(self._store, least, self._view(None))
        return MeshParts(parts, Path(folder), held=self.held, known_up=up)

    def provenance(self, source: str | None = None) -> Provenance:
        """What a file of its surface says about the map; its hash is taken anew.

        Args:
            source: file or folder that the map came from; its name is told, not where it lies.
        """
        worlds = {one.world for one in map_history.of_clients(map_history.sessions(self.meta)) if one.world}
        return Provenance(
            source=None if source is None else Path(source).resolve().name,
            keyframes=self.keyframes,
            map_hash=self.map_hash(),
            world=" ".join(sorted(worlds)),
            voxel_size=self.config.voxel_size,
        )

    def cells_to_mesh(self, dirty: NDArray[np.int32]) -> NDArray[np.int32]:
        """The blocks whose mesh the changes to these blocks reach: (m, 3) int32.

        They and their neighbours towards −x, −y, −z; the field carries a change into the blocks around first.
        Of what is meshed raw, normals at the rim may be a keyframe behind.
        """
        if self.model.surface == "normal":
            dirty = unpack_keys(field_regularizer.around(pack_keys(dirty), self._store, 1))
        if self.model.surface == "field":
            dirty = unpack_keys(field_regularizer.spread(pack_keys(dirty), self._store, self._field))
        return cells_of(dirty)

    def signed_distance(
        self, points: NDArray[np.floating], min_weight: float | None = None
    ) -> NDArray[np.float32]:
        """Signed distances that the map holds at points of the world: positive in the free space it saw.

        Args:
            points: (n, 3) metres; each takes the value of the voxel that it lies in.
            min_weight: as for `extract_mesh`.

        Returns:
            (n,) metres; NaN where the map saw nothing, which is all but a band around its surfaces.
        """
        centres = np.floor(checked_points(points) / self.config.voxel_size) + 0.5
        return self.sample(centres * self.config.voxel_size, min_weight=min_weight, surface="raw").distance

    def sample(
        self, points: ArrayLike, *, min_weight: float | None = None, surface: Surface | None = None
    ) -> Samples:
        """The signed distance, its weight and its gradient at points, between voxel centres interpolated.

        Args:
            points: (n, 3) float32 or float64 metres.
            min_weight, surface: as for `extract_mesh`.
        """
        least = self._checked_min_weight(min_weight)
        return point_samples.sample(
            checked_points(points), self._store, least, self._tiles_of(surface, least).values
        )

    def raycast(
        self,
        intrinsics: Intrinsics | ArrayLike,
        T_world_camera: ArrayLike,
        shape: tuple[int, int],
        *,
        min_weight: float | None = None,
        surface: Surface | None = None,
    ) -> View:
        """What a pinhole camera sees of the surface: depth, normals, and colours if the map has them.

        A surface is seen from its front alone, which is where the sensors were.

        Args:
            intrinsics: `Intrinsics`, a (3, 3) camera matrix, or fx, fy, cx, cy; pixels.
            T_world_camera: (4, 4) pose, camera axes x right, y down, z forward.
            shape: (height, width), pixels.
            min_weight, surface: as for `extract_mesh`.
        """
        camera = checked_camera(intrinsics, T_world_camera, shape)
        return camera_views.cast(self._tiles_of(surface, self._checked_min_weight(min_weight)), *camera)

    def point_cloud(self, *, min_weight: float | None = None, surface: Surface | None = None) -> PointCloud:
        """Points of the surface, a vertex of its mesh each: at most three a voxel.

        Args:
            min_weight, surface: as for `extract_mesh`.
        """
        mesh = self.extract_mesh(min_weight, surface=surface)
        weights = self.sample(mesh.vertices, min_weight=min_weight, surface="raw").weight
        return PointCloud(mesh.vertices, mesh.normals, weights, mesh.colors)

    def blocks(self) -> Blocks:
        """The blocks of voxels as NumPy arrays: the stored sums without copying, and decoded on request."""
        return Blocks(self._store)

    def to_open3d(self) -> Any:
        """Make an `open3d.t.geometry.VoxelBlockGrid` of the map as it was fused.

        Open3D's meshes and points of it lie half a voxel too low along x, y and z, since Open3D takes a
        voxel's value for that of its lowest corner: `translate` them. A distance of 8 voxels is 1 there
        (`trunc_voxel_multiplier=8`, the default). `extract_mesh().to_open3d()` and
        `point_cloud().to_open3d()` need no such care.

        Raises:
            MissingDependency: without Open3D.
        """
        return map_blocks.to_voxel_block_grid(self._store)

    def distance_field(
        self,
        box: Sequence[float] | None = None,
        *,
        max_distance: float = 2.0,
        subvoxel: bool = True,
        min_weight: float | None = None,
    ) -> DistanceField:
        """Euclidean distance to the nearest surface, of every voxel in a box.

        Surfaces around the box count, too: a voxel has the same distance in whatever box.

        Args:
            box: x0, y0, z0, x1, y1, z1 in metres, one voxel thick for a plane; None = around the whole map.
            max_distance: metres; what is farther has this distance.
            subvoxel: distances to the surface where it lies in the voxels; else between voxels' centres, as
                SciPy's `distance_transform_edt`.
            min_weight: as for `extract_mesh`.

        Raises:
            InvalidConfig: for another box, or one of too many voxels; MapError: no box, and an empty map.
        """
        weight = self._checked_min_weight(min_weight)
        return distance_fields.in_box(self._store, box, max_distance, weight, subvoxel=subvoxel)

    def distance_blocks(
        self, *, max_distance: float = 0.5, min_weight: float | None = None
    ) -> Iterator[FieldBlocks]:
        """The distance field of the whole map, blocks of 8³ voxels nearer than `max_distance` to a surface.

        Memory holds one tile of 16³ blocks and what lies around it, however large the map is. The values are
        those of `distance_field`.

        Raises:
            InvalidConfig: for a `max_distance` of too many voxels.
        """
        weight = self._checked_min_weight(min_weight)
        return distance_fields.in_blocks(self._store, max_distance, weight)

    def current_slice(
        self,
        low: float,
        high: float,
        *,
        box: Sequence[float] | None = None,
        up: Up | str | None = None,
        resolution: float | None = None,
        max_distance: float = 2.0,
        min_weight: float | None = None,
        most_cells: int = map_slices.MOST_CELLS,
    ) -> CurrentSlice:
        """Occupancy and horizontal distances between two heights, which can follow the map.

        Args:
            low, high: metres along `up` in the map's frame.
            box: u0, v0, u1, v1 in metres along the slice's own axes (`SliceGrid`; they are x and y where z is
                up); None = around the whole map.
            up: away from the ground, such as `"z"`, `"-y"` or `"0,-0.9,0.1"`; None = it is found, for which
                the map is meshed.
            resolution: metres, edge of a cell; None = the voxel size. A cell holds the least of its voxels.
            max_distance, min_weight: as for `distance_field`.
            most_cells: with those around the box from which distances come; for more there is an error.

        Raises:
            InvalidConfig: for another box, or too many cells; MapError: for an empty map and no box, or when
                nobody can tell which way is up.
        """
        return CurrentSlice(
            self._store,
            (low, high),
            box,
            map_slices.axes_of(np.array(self._up(up).direction)),
            resolution=resolution,
            max_distance=max_distance,
            min_weight=self._checked_min_weight(min_weight),
            knows_free_space=self.config.space_carving,
            most_cells=most_cells,
        )

    def occupancy_slice(
        self, low: float, high: float, *, need_free: bool = False, **options: Any
    ) -> OccupancySlice:
        """A costmap: free, occupied or unseen between two heights; `save` writes it for ROS's map_server.

        A cell is occupied where a surface, or what lies behind one, was seen between the heights; free where
        half of its samples or more were seen, and no surface. Made without `space_carving`, a map knows free
        space in a band before surfaces alone.

        Args:
            low, high, options: as for `current_slice`.
            need_free: refuse a map that was made without `space_carving`.

        Raises:
            MapError: for such a map, or as `current_slice` does.
        """
        if need_free and not self.config.space_carving:
            raise MapError(
                "the map was made without space_carving: it knows free space near surfaces alone; fuse it "
                "anew with space_carving=True (--space-carving)"
            )
        options = {"max_distance": self.config.voxel_size, **options}  # nobody asks for distances
        return self.current_slice(low, high, **options).occupancy()

    def distance_slice(self, low: float, high: float, **options: Any) -> DistanceSlice:
        """Horizontal distance of each cell to what stands between two heights.

        Args:
            low, high, options: as for `current_slice`.
        """
        return self.current_slice(low, high, **options).distances()

    def _up(self, given: Up | str | None) -> Up:
        """Up as given, or found."""
        if isinstance(given, str):
            given = up_direction.parse(given)
        up = given or up_direction.find(self.extract_mesh(surface="raw"), self.held)
        if up is None:
            raise MapError('nobody can tell which way is up in this map: give it, such as up="z" or up="-y"')
        return up

    def diff(self, later: "ReadableMap", *, tolerance: float | None = None) -> MapDifference:
        """What is different in a later map of the same frame, in numbers and as a coloured mesh.

        Args:
            tolerance: metres between two surfaces that count as the same; default two voxels.

        Raises:
            MapError: when the maps have voxels of different sizes.
            InvalidConfig: for a tolerance that is none.
        """
        self._check_voxels(later)
        metres = 2 * self.config.voxel_size if tolerance is None else tolerance
        if not 0 <= metres < math.inf:
            raise InvalidConfig(f"tolerance must be 0 metres or more, got {tolerance}")
        blocks, voxels = map_difference.count(self._store, later._store)
        earlier, other = (
            map_difference.Side(one.extract_mesh().without_islands(), one._store, one.model.min_weight)
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
        watch: voxel_arrays.Watch = lambda _done, _all: None,
    ) -> Path:
        """Write voxels for NumPy (.npz), zarr (.zarr, a folder) or OpenVDB (.vdb): complete or not at all.

        `tsdf/voxel_arrays.py` describes the arrays.

        Args:
            dense: one array around the whole map, instead of its blocks; not of OpenVDB.
            field: `tsdf`, signed distances as fused with weights and colours, or `distance`, the Euclidean
                distance field.
            max_distance, min_weight: of the distance field, as for `distance_blocks`.
            watch: told the bytes of the arrays that are written, and all of them (not of OpenVDB).

        Raises:
            InvalidConfig: for another suffix or field; OutputError: for an empty map, a box that is too
                large, or a path that cannot be written; MissingDependency: zarr is not installed.
        """
        voxel_arrays.write(
            self._store, Path(path), dense=dense, field=field, max_distance=max_distance,
            min_weight=self._checked_min_weight(min_weight), watch=watch,
        )  # fmt: skip
        return Path(path)

    def map_hash(self) -> str:
        """Hex digest of the exact sums: equal for the same keyframes in any order, on any number of threads.

        Colour and smoothed values are not part of it (colour may travel lossily; smoothing has an order).
        """
        digest = self._begin_hash()
        for keys, sums in self._store.in_order("sums"):
            digest.update(keys.data)
            digest.update(sums.data)
        return digest.hexdigest()

    def color_hash(self) -> str:
        """Hex digest of the exact colour sums."""
        digest = hashlib.blake2b(digest_size=16)
        if self.config.color:
            for layer in ("color_rgn", "color_b"):
                for keys, sums in self._store.in_order(layer):
                    digest.update(keys.data)
                    digest.update(sums.data)
        return digest.hexdigest()

    def _begin_hash(self) -> "hashlib.blake2b":
        """A digest that is to take the keys and then the sums of the used blocks, 1024 at a time."""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(struct.pack("<di", self.config.voxel_size, integrate.QUANTA_PER_VOXEL))
        return digest

    def _check_voxels(self, other: "ReadableMap") -> None:
        ours, theirs = self.config.voxel_size, other.config.voxel_size
        if ours != theirs:
            raise MapError(f"the maps have voxels of {ours:g} m and {theirs:g} m: fuse one anew")

    def _checked_min_weight(self, min_weight: float | None) -> float:
        """As given, or the sensor's."""
        if min_weight is None:
            min_weight = self.model.min_weight
        most = integrate.WEIGHT_LIMIT / WEIGHT_ONE
        if not 0 <= min_weight <= most:
            raise InvalidConfig(f"min_weight must be from 0 to {most:.0f}, got {min_weight}")
        return min_weight

    @property
    def _field(self) -> field_regularizer.FieldSettings:
        model = self.model
        return field_regularizer.FieldSettings(
            model.field_smoothness, model.field_edge, model.field_reweightings
        )

    @property
    def _reading_bytes(self) -> int:
        """Memory for meshes, and of what is kept of answers."""
        return self._mesh_buffers.nbytes + sum(kept.nbytes for kept in self._tiles.values())

    def _tiles_of(self, surface: Surface | None, min_weight: float) -> SurfaceTiles:
        """What is kept of a surface for the next question, without what has changed since the last one."""
        view, which = self._view(surface), (surface or self.model.surface, min_weight)
        try:
            changed = np.sort(self._store.keys[self._store.take_dirty(ASKED)])
            for kept in self._tiles.values():
                kept.forget(changed)
        except BaseException:  # Ctrl-C, too: nobody may be answered from before a change
            self._tiles.clear()
            raise
        if which not in self._tiles:
            reach = {"raw": 0, "normal": 1, "field": self._field.halo}[which[0]]
            self._tiles[which] = SurfaceTiles(self._store, view, min_weight, reach)
        self._tiles.move_to_end(which)
        while len(self._tiles) > MOST_SURFACES:
            self._tiles.popitem(last=False)
        return self._tiles[which]

    def _view(self, surface: Surface | None) -> SurfaceView:
        """The function that reads a surface's signed distances from the map."""
        surface = surface or self.model.surface
        if surface not in get_args(Surface):
            raise InvalidConfig(f"surface must be one of {', '.join(get_args(Surface))}, got {surface!r}")
        if surface == "field":
            return partial(field_regularizer.solve, settings=self._field)
        if surface == "normal":
            return partial(field_regularizer.along_normals, smoothness=self.model.smoothness)
        return values_of
