# SPDX-License-Identifier: MIT
"""Answer questions about a map: distances at points, views, free space, distance fields, points, voxels."""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsfusion.core.config import Surface, VolumeConfig
from tsfusion.core.errors import MapError
from tsfusion.core.number_ranges import distinct
from tsfusion.geometry import up_direction
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_answers import PointCloud, Samples, View, checked_camera, checked_points
from tsfusion.geometry.map_grids import DistanceField, DistanceSlice, OccupancySlice, blocked
from tsfusion.geometry.up_direction import Up
from tsfusion.tsdf.answers import camera_views, distance_fields, map_slices, point_samples
from tsfusion.tsdf.answers.distance_fields import FieldBlocks
from tsfusion.tsdf.answers.map_slices import CurrentSlice
from tsfusion.tsdf.files import voxel_arrays
from tsfusion.tsdf.files.voxel_arrays import Blocks
from tsfusion.tsdf.readable_map import ReadableMap
from tsfusion.tsdf.store.block_store import ASKED, BlockStore, pack_keys, unpack_keys
from tsfusion.tsdf.surface import mesh_extraction
from tsfusion.tsdf.surface.field_regularizer import SurfaceView
from tsfusion.tsdf.surface.mesh_extraction import CellMeshes, extract_cells
from tsfusion.tsdf.surface.surface_tiles import SurfaceTiles

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from tsfusion.geometry.map_grids import OwnSliceSettings

MOST_SURFACES = 2  # surfaces whose values are kept for later answers
MOST_NEW_CUBES = 2  # new cubes that one answer about cells may solve, if the surface is not kept


class AskableMap(ReadableMap):
    """Map that answers questions, and keeps solved values and meshes for later questions."""

    def __init__(self, config: VolumeConfig, store: BlockStore) -> None:
        super().__init__(config, store)
        self._tiles = OrderedDict[tuple[Surface, float], SurfaceTiles]()

    def sample(
        self, points: ArrayLike, *, min_weight: float | None = None, surface: Surface | None = None
    ) -> Samples:
        """Sample signed distance, weight and gradient at points, interpolated between voxel centres.

        NaN beyond `reach` does not mean free: planners ask `distance_field`.

        Args:
            points: (n, 3) float32 or float64 metres.
            min_weight, surface: as for `extract_mesh`.
        """
        least = self._checked_min_weight(min_weight)
        view = self._tiles_of(surface, least).values
        found = point_samples.sample(checked_points(points), self._store, least, view)
        return replace(found, reach=self.reach)

    @property
    def reach(self) -> float:
        """Distance before a surface up to which `sample` has values, metres: least half-width of a band."""
        return self.model.min_support * self.config.voxel_size

    def signed_distance(
        self, points: NDArray[np.floating], min_weight: float | None = None
    ) -> NDArray[np.float32]:
        """Return the signed distances at points, without interpolation: positive in free space.

        Args:
            points: (n, 3) metres; each point takes the value of the voxel that contains it.
            min_weight: as for `extract_mesh`.

        Returns:
            (n,) metres; NaN in unseen voxels, which are all voxels outside a band around surfaces.
        """
        centres = np.floor(checked_points(points) / self.config.voxel_size) + 0.5
        return self.sample(centres * self.config.voxel_size, min_weight=min_weight, surface="raw").distance

    def raycast(
        self,
        intrinsics: Intrinsics | ArrayLike,
        T_world_camera: ArrayLike,
        shape: tuple[int, int],
        *,
        min_weight: float | None = None,
        surface: Surface | None = None,
        normals: bool = True,
        colors: bool = True,
    ) -> View:
        """Render the surface as a pinhole camera sees it: depth, normals, and colours if the map has them.

        Only the front of a surface is visible: the side that the sensors saw.

        Args:
            intrinsics: `Intrinsics`, a (3, 3) camera matrix, or fx, fy, cx, cy; pixels.
            T_world_camera: (4, 4) pose, camera axes x right, y down, z forward.
            shape: (height, width), pixels.
            min_weight, surface: as for `extract_mesh`.
            normals, colors: images to render in addition to depth; depth alone is faster.
        """
        camera = checked_camera(intrinsics, T_world_camera, shape)
        tiles = self._tiles_of(surface, self._checked_min_weight(min_weight))
        return camera_views.cast(tiles, *camera, normals=normals, colors=colors)

    def settled_stamp(self, min_weight: float | None = None, surface: Surface | None = None) -> int | None:
        """Return the `stamp` of the last state that was meshed completely, or None if it is not kept."""
        return self._tiles_of(surface, self._checked_min_weight(min_weight)).settled

    def raycast_settled(
        self,
        intrinsics: Intrinsics | ArrayLike,
        T_world_camera: ArrayLike,
        shape: tuple[int, int],
        *,
        min_weight: float | None = None,
        surface: Surface | None = None,
        normals: bool = True,
        colors: bool = True,
    ) -> View | None:
        """Return the view of `raycast` in the state of `settled_stamp`, or None if that is no longer kept."""
        camera = checked_camera(intrinsics, T_world_camera, shape)
        least = self._checked_min_weight(min_weight)
        tiles = self._tiles_of(surface, least)
        return camera_views.cast_settled(tiles, *camera, normals=normals, colors=colors)

    def settle(self, most: int, *, min_weight: float | None = None, surface: Surface | None = None) -> bool:
        """Mesh changes since the last `raycast` with this `min_weight` and `surface`, at most `most` cubes.

        Returns True if `raycast_settled` now shows the current map.
        """
        tiles = self._tiles_of(surface, self._checked_min_weight(min_weight))
        return tiles.settled is not None and tiles.settle_some(most)

    def point_cloud(self, *, min_weight: float | None = None, surface: Surface | None = None) -> PointCloud:
        """Return the points of the surface, the vertices of its mesh: at most three per voxel.

        Args:
            min_weight, surface: as for `extract_mesh`.
        """
        mesh = self.extract_mesh(min_weight, surface=surface)
        weights = self.sample(mesh.vertices, min_weight=min_weight, surface="raw").weight
        return PointCloud(mesh.vertices, mesh.normals, weights, mesh.colors)

    def blocks(self) -> Blocks:
        """Return blocks of voxels as NumPy arrays: stored sums without a copy, decoded values on request."""
        return Blocks(self._store)

    def to_open3d(self) -> Any:
        """Make an `open3d.t.geometry.VoxelBlockGrid` of the fused values, without smoothing.

        Open3D puts a voxel's value at its lowest corner: `translate` its meshes and points by half a voxel
        along x, y and z. Our own `to_open3d()` of meshes and point clouds needs no shift. A distance of 8
        voxels becomes 1 in Open3D (`trunc_voxel_multiplier=8`, its default).

        Raises:
            MissingDependency: without Open3D.
        """
        return voxel_arrays.to_voxel_block_grid(self._store)

    def distance_field(
        self,
        box: Sequence[float] | None = None,
        *,
        max_distance: float = 2.0,
        subvoxel: bool = True,
        min_weight: float | None = None,
        unseen_is_free: bool = False,
    ) -> DistanceField:
        """Return the Euclidean distance to the nearest surface, for every voxel in a box.

        Surfaces outside the box count too: a voxel has the same distance in any box.

        Args:
            box: x0, y0, z0, x1, y1, z1 in metres, one voxel thick for a plane; None = around the whole map.
            max_distance: metres; farther voxels get this distance.
            subvoxel: measure to the surface within its voxel; False = between voxel centres, as SciPy's
                `distance_transform_edt`.
            min_weight: as for `extract_mesh`.
            unseen_is_free: give an unseen voxel the distance to the nearest seen surface; False = 0.

        Raises:
            InvalidConfig: for an invalid box, or a box of too many voxels.
            MapError: for an empty map without a box.
        """
        weight = self._checked_min_weight(min_weight)
        found = distance_fields.in_box(self._store, box, max_distance, weight, subvoxel=subvoxel)
        distance = blocked(found.distance, found.occupancy, unseen_is_free=unseen_is_free)
        return replace(found, distance=distance)

    def distance_blocks(
        self, *, max_distance: float = 0.5, min_weight: float | None = None
    ) -> Iterator[FieldBlocks]:
        """Yield the distance field of the whole map: blocks of 8³ voxels within `max_distance` of surfaces.

        Memory holds one tile of 16³ blocks and its surroundings. The values equal those of `distance_field`.

        Args:
            max_distance: metres.
            min_weight: as for `extract_mesh`.

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
        above_floor: bool = False,
        most_cells: int = map_slices.MOST_CELLS,
    ) -> CurrentSlice:
        """Return occupancy and horizontal distances between two heights; the result can follow the map.

        Args:
            low, high: metres along `up` from the map's origin.
            box: u0, v0, u1, v1 in metres along the slice's own axes (`SliceGrid`; x and y if z is up);
                None = around the whole map.
            up: direction away from the ground, such as `"z"`, `"-y"` or `"0,-0.9,0.1"`; None = find the
                direction, which meshes the map.
            resolution: edge of a cell, metres; None = the voxel size. A cell takes the minimum of its voxels.
            max_distance, min_weight: as for `distance_field`.
            above_floor: count `low` and `high` from the floor, which `up_direction.floor_height` finds;
                `grid.floor` of the slice is its height.
            most_cells: limit, including the cells around the box that distances depend on.

        Raises:
            InvalidConfig: for an invalid box, or too many cells.
            MapError: for an empty map without a box, or if the up direction or the floor cannot be found.
        """
        direction, floor = self._level(up, above_floor=above_floor)
        return CurrentSlice(
            self._store,
            (low, high),
            box,
            map_slices.axes_of(np.array(direction)),
            floor=floor,
            resolution=resolution,
            max_distance=max_distance,
            min_weight=self._checked_min_weight(min_weight),
            carved=self.config.space_carving,
            most_cells=most_cells,
        )

    @property
    def knows_free_space(self) -> bool:
        """True if the map knows free space away from surfaces; maps of earlier versions may not."""
        return self.config.space_carving or len(self._store.clear) > 0

    def occupancy_slice(
        self, low: float, high: float, *, need_free: bool = False, **options: "Unpack[OwnSliceSettings]"
    ) -> OccupancySlice:
        """Return a costmap: free, occupied or unseen between two heights; its `save` is for ROS map_server.

        A cell is occupied if a surface, or the space behind one, was seen. It is free if at least half of its
        samples were seen, and no surface. A map without `space_carving` knows free space in a band before
        surfaces, and in blocks of 8³ voxels that a keyframe looks through completely.

        Args:
            low, high, options: as for `distance_slice`.
            need_free: refuse a map of an earlier version without `space_carving`, which knows free space only
                near surfaces.

        Raises:
            InvalidConfig, MapError: as `distance_slice`; MapError also for a map that `need_free` refuses.
        """
        if need_free and not self.knows_free_space:
            raise MapError(
                "no keyframe of the map looks through a whole block, so it knows free space near surfaces "
                "alone: fuse it anew with space_carving=True (--space-carving)"
            )
        options.setdefault("max_distance", self.config.voxel_size)  # distances are not needed
        return self.current_slice(low, high, **options).occupancy()

    def distance_slice(
        self, low: float, high: float, *, unseen_is_free: bool = False, **options: "Unpack[OwnSliceSettings]"
    ) -> DistanceSlice:
        """Return the horizontal distance from each cell to the nearest surface between two heights.

        Args:
            low, high: metres along the up direction from the map's origin.
            unseen_is_free: give an unseen cell the distance to the nearest seen surface; False = 0.
            options: `box`: u0, v0, u1, v1 in metres along the slice's own axes (x and y if z is up; None =
                around the whole map); `up`: direction away from the ground, such as "z" or "-y" (None = find
                it); `resolution`: edge of a cell, metres (None = the voxel size); `max_distance`: metres (2);
                `min_weight`: as for `extract_mesh`; `above_floor`: count the heights from the floor.

        Raises:
            InvalidConfig: for an invalid box, or too many cells.
            MapError: for an empty map without a box, or if the up direction or the floor cannot be found.
        """
        return self.current_slice(low, high, **options).distances(unseen_is_free=unseen_is_free)

    def mesh_cells(
        self,
        cells: NDArray[np.int32],
        surface: Surface | None = None,
        *,
        values: SurfaceView | None = None,
    ) -> CellMeshes:
        """Return the mesh of `extract_mesh(blocks=cells)`, and the faces of each cell.

        Args:
            cells: (n, 3) int32 block coordinates; a block that the map does not have adds no faces.
            values: `whole_values`, for exactly the triangles of the whole map's mesh, or `surface_tiles`.
        """
        keys = distinct(pack_keys(cells))
        return self._mesh_keys(keys, self._checked_min_weight(None), values or self._view(surface))

    def _mesh_keys(self, keys: NDArray[np.int64], min_weight: float, view: SurfaceView) -> CellMeshes:
        is_there = self._store.slots_of(keys) >= 0
        with self._own_buffers() as buffers:
            mesh, first = extract_cells(keys[is_there], self._store, min_weight, buffers, view)
        faces = np.zeros(len(keys) + 1, np.int32)
        faces[1:][is_there] = np.diff(first)
        return CellMeshes(unpack_keys(keys), np.cumsum(faces, dtype=np.int32), mesh)

    def next_cells(
        self,
        first: Sequence[int] | None = None,
        *,
        since: int | None = None,
        surface: Surface | None = None,
        most: int = 256,
    ) -> tuple[CellMeshes, NDArray[np.int32] | None]:
        """Return some of the map's cells in key order, and the first remaining cell, or None at the end.

        Their meshes depend only on the map, for every surface. `extract_mesh` of some blocks can differ by a
        hundredth of a voxel.

        Args:
            first: block coordinates of the first cell; None = the map's first cell.
            since: return only cells that changes after this `stamp` affect. Cells of blocks removed after it
                are missing; `drops` shows that blocks were removed.
            most: maximum number of cells in one answer.
        """
        store, surface = self._store, surface or self.model.surface
        start = 0 if first is None else int(pack_keys(np.array([first], np.int32))[0])
        if since is None:
            keys, rest = mesh_extraction.listed(store, start, most)
        else:
            reach = {"raw": 0, "normal": 1, "field": self._field.coarser + 1}[surface]
            keys, rest = mesh_extraction.listed_since(
                store,
                start,
                most,
                since,
                to_cells=lambda keys: pack_keys(self._cells_reached(unpack_keys(keys), surface)),
                reach=reach,
            )
        least = self._checked_min_weight(None)
        kept = self._tiles_of(surface, least)
        if (count := kept.affordable(keys, MOST_NEW_CUBES)) < len(keys):
            keys, rest = keys[:count], int(keys[count])
        found = self._mesh_keys(keys, least, kept.values)
        return found, None if rest is None else unpack_keys(np.array([rest]))[0]

    def cell_stamps(self, cells: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the stamps of the last changes to (n, 3) fused cells, and to their own blocks: (n,) each."""
        return mesh_extraction.stamps_of(self._store, pack_keys(cells))

    @property
    def stamp(self) -> int:
        """Number of the last added or retracted keyframe; 0 when a map is opened."""
        return self._store.stamp

    @property
    def drops(self) -> int:
        """Number of removals of blocks. A removal changes neighbouring cells without a new stamp."""
        return self._store.drops

    def _level(
        self, given: Up | str | None, *, above_floor: bool
    ) -> tuple[tuple[float, float, float], float | None]:
        """Return the given or the found up direction; with `above_floor` also the floor's height."""
        if isinstance(given, str):
            given = up_direction.parse(given)
        if given is not None and not above_floor:
            return given.direction, None
        mesh = self.extract_mesh(surface="raw")
        up = given or up_direction.find(mesh, self.held)
        if up is None:
            raise MapError('nobody can tell which way is up in this map: give it, such as up="z" or up="-y"')
        if not above_floor:
            return up.direction, None
        floor = up_direction.floor_height(mesh, up, self.held)
        if floor is None:
            raise MapError(
                f"no floor is found in this map: no large surface below the sensors faces up, {up.axis}; "
                "count heights from the map's origin"
            )
        return up.direction, floor

    @property
    def _reading_bytes(self) -> int:
        return self._mesh_buffers.nbytes + sum(kept.nbytes for kept in self._tiles.values())

    def _tiles_of(self, surface: Surface | None, min_weight: float) -> SurfaceTiles:
        """Return the kept values of a surface, without those that have changed since the last question."""
        view, which = self._view(surface), (surface or self.model.surface, min_weight)
        try:
            changed = np.sort(self._store.keys[self._store.take_dirty(ASKED)])
            for kept in self._tiles.values():
                kept.forget(changed)
        except BaseException:  # also Ctrl-C: no answer may use values from before a change
            self._tiles.clear()
            raise
        if which not in self._tiles:
            reach = {"raw": 0, "normal": 1, "field": self._field.halo}[which[0]]
            self._tiles[which] = SurfaceTiles(self._store, view, min_weight, reach)
        self._tiles.move_to_end(which)
        while len(self._tiles) > MOST_SURFACES:
            self._tiles.popitem(last=False)
        return self._tiles[which]
