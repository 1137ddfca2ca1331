# SPDX-License-Identifier: MIT
"""Questions to a map: distances at points, views, free space, distance fields, points and voxels."""

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

MOST_SURFACES = 2  # that answers are kept of
MOST_NEW_CUBES = 2  # of a surface that is not kept, in an answer about cells


class AskableMap(ReadableMap):
    """Map that answers questions, and keeps solved values and meshes for the next question."""

    def __init__(self, config: VolumeConfig, store: BlockStore) -> None:
        super().__init__(config, store)
        self._tiles = OrderedDict[tuple[Surface, float], SurfaceTiles]()

    def sample(
        self, points: ArrayLike, *, min_weight: float | None = None, surface: Surface | None = None
    ) -> Samples:
        """Signed distance, its weight and its gradient at points, interpolated between voxel centres.

        NaN beyond the band around surfaces (`reach`) does not mean free: planners ask `distance_field`.

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
        """Distance before a surface up to which `sample` knows values, metres: least half-width of a band."""
        return self.model.min_support * self.config.voxel_size

    def signed_distance(
        self, points: NDArray[np.floating], min_weight: float | None = None
    ) -> NDArray[np.float32]:
        """Signed distances in the map at points, without interpolation: positive in the free space it saw.

        Args:
            points: (n, 3) metres; each takes the value of the voxel that it lies in.
            min_weight: as for `extract_mesh`.

        Returns:
            (n,) metres; NaN where the map saw nothing, which is everywhere but a band around its surfaces.
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
        """View of the surface by a pinhole camera: depth, normals, and colours if the map has them.

        A surface is seen from its front alone, where the sensors were.

        Args:
            intrinsics: `Intrinsics`, a (3, 3) camera matrix, or fx, fy, cx, cy; pixels.
            T_world_camera: (4, 4) pose, camera axes x right, y down, z forward.
            shape: (height, width), pixels.
            min_weight, surface: as for `extract_mesh`.
            normals, colors: images beside depth; depth alone is quicker.
        """
        camera = checked_camera(intrinsics, T_world_camera, shape)
        tiles = self._tiles_of(surface, self._checked_min_weight(min_weight))
        return camera_views.cast(tiles, *camera, normals=normals, colors=colors)

    def settled_stamp(self, min_weight: float | None = None, surface: Surface | None = None) -> int | None:
        """`stamp` of the last state that `raycast` or `settle` meshed as a whole; None = no longer kept."""
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
        """As `raycast`, of the state of `settled_stamp`. Returns None where some of it is no longer kept."""
        camera = checked_camera(intrinsics, T_world_camera, shape)
        least = self._checked_min_weight(min_weight)
        tiles = self._tiles_of(surface, least)
        return camera_views.cast_settled(tiles, *camera, normals=normals, colors=colors)

    def settle(self, most: int, *, min_weight: float | None = None, surface: Surface | None = None) -> bool:
        """Mesh again the changed part of the last `raycast`, at most `most` cubes, as of `min_weight` and
        `surface`.

        Returns True if `raycast_settled` now shows the current map.
        """
        tiles = self._tiles_of(surface, self._checked_min_weight(min_weight))
        return tiles.settled is not None and tiles.settle_some(most)

    def point_cloud(self, *, min_weight: float | None = None, surface: Surface | None = None) -> PointCloud:
        """Points of the surface, the vertices of its mesh: at most three a voxel.

        Args:
            min_weight, surface: as for `extract_mesh`.
        """
        mesh = self.extract_mesh(min_weight, surface=surface)
        weights = self.sample(mesh.vertices, min_weight=min_weight, surface="raw").weight
        return PointCloud(mesh.vertices, mesh.normals, weights, mesh.colors)

    def blocks(self) -> Blocks:
        """Blocks of voxels as NumPy arrays: the stored sums without copying, decoded values on request."""
        return Blocks(self._store)

    def to_open3d(self) -> Any:
        """Make an `open3d.t.geometry.VoxelBlockGrid` of the map as it was fused.

        Open3D takes a voxel's value for that of its lowest corner: `translate` its meshes and points by half
        a voxel along x, y and z. A distance of 8 voxels is 1 there (`trunc_voxel_multiplier=8`, the default).
        `extract_mesh().to_open3d()` and `point_cloud().to_open3d()` need no such care.

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
        """Euclidean distance to the nearest surface, for every voxel in a box.

        Surfaces around the box count, too: a voxel has the same distance in any box.

        Args:
            box: x0, y0, z0, x1, y1, z1 in metres, one voxel thick for a plane; None = around the whole map.
            max_distance: metres; farther voxels have this distance.
            subvoxel: distances to the surface within its voxel; else between voxel centres, as SciPy's
                `distance_transform_edt`.
            min_weight: as for `extract_mesh`.
            unseen_is_free: an unseen voxel has the distance to the nearest seen surface; else 0.

        Raises:
            InvalidConfig: for another box, or one of too many voxels; MapError: no box, and an empty map.
        """
        weight = self._checked_min_weight(min_weight)
        found = distance_fields.in_box(self._store, box, max_distance, weight, subvoxel=subvoxel)
        distance = blocked(found.distance, found.occupancy, unseen_is_free=unseen_is_free)
        return replace(found, distance=distance)

    def distance_blocks(
        self, *, max_distance: float = 0.5, min_weight: float | None = None
    ) -> Iterator[FieldBlocks]:
        """Distance field of the whole map: blocks of 8³ voxels nearer than `max_distance` to a surface.

        Memory holds one tile of 16³ blocks and its surroundings, for a map of any size. The values equal
        those of `distance_field`.

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
        """Occupancy and horizontal distances between two heights, which can follow the map.

        Args:
            low, high: metres along `up` from the map's origin.
            box: u0, v0, u1, v1 in metres along the slice's own axes (`SliceGrid`; they are x and y where z is
                up); None = around the whole map.
            up: away from the ground, such as `"z"`, `"-y"` or `"0,-0.9,0.1"`; None = it is found, for which
                the map is meshed.
            resolution: metres, edge of a cell; None = the voxel size. A cell holds the least of its voxels.
            max_distance, min_weight: as for `distance_field`.
            above_floor: count `low` and `high` from the floor, which is found (`up_direction.floor_height`);
                `grid.floor` of the slice says where it lies.
            most_cells: with those around the box from which distances come; for more there is an error.

        Raises:
            InvalidConfig: for another box, or too many cells; MapError: for an empty map and no box, or when
                nobody can tell which way is up, or where the floor is.
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
        """A costmap: free, occupied or unseen between two heights; `save` writes it for ROS's map_server.

        A cell is occupied where a surface, or what lies behind one, was seen between the heights; free where
        half of its samples or more were seen, and no surface. Made without `space_carving`, a map knows free
        space in a band before surfaces, and blocks of 8³ voxels that a keyframe looks through as a whole.

        Args:
            low, high, options: as for `distance_slice`.
            need_free: refuse a map that knows free space near surfaces alone: one of an earlier version,
                made without `space_carving`.

        Raises:
            InvalidConfig, MapError: as `distance_slice`; MapError also for such a map.
        """
        if need_free and not self.knows_free_space:
            raise MapError(
                "no keyframe of the map looks through a whole block, so it knows free space near surfaces "
                "alone: fuse it anew with space_carving=True (--space-carving)"
            )
        options.setdefault("max_distance", self.config.voxel_size)  # nobody asks for distances
        return self.current_slice(low, high, **options).occupancy()

    def distance_slice(
        self, low: float, high: float, *, unseen_is_free: bool = False, **options: "Unpack[OwnSliceSettings]"
    ) -> DistanceSlice:
        """Horizontal distance of each cell to what stands between two heights.

        Args:
            low, high: metres along up from the map's origin.
            unseen_is_free: where nothing was seen the distance is that to what was; else 0.
            options: `box`: u0, v0, u1, v1 in metres along the slice's own axes (x and y where z is up; None =
                around the whole map); `up`: away from the ground, such as "z" or "-y" (None = it is found);
                `resolution`: metres, edge of a cell (None = the voxel size); `max_distance`: metres (2);
                `min_weight`: as for `extract_mesh`; `above_floor`: count the heights from the floor.

        Raises:
            InvalidConfig: for another box, or too many cells.
            MapError: for an empty map without a box, or where up or the floor cannot be found.
        """
        return self.current_slice(low, high, **options).distances(unseen_is_free=unseen_is_free)

    def mesh_cells(
        self,
        cells: NDArray[np.int32],
        surface: Surface | None = None,
        *,
        values: SurfaceView | None = None,
    ) -> CellMeshes:
        """Mesh of `extract_mesh(blocks=cells)`, and the faces of each cell.

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
        """Some of the map's cells in key order, and the first of the remaining ones; None = no more.

        Their meshes depend on the map alone, for every surface; `extract_mesh` of some blocks may differ by a
        hundredth of a voxel.

        Args:
            first: block coordinates of the first cell; None = the map's first cell.
            since: only cells that changes after this `stamp` reach. Cells of blocks removed since are
                missing: `drops` tells that there are some.
            most: cells in one answer.
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
        """Stamps of the last changes to (n, 3) cells as fused, and to their own blocks: (n,) each."""
        return mesh_extraction.stamps_of(self._store, pack_keys(cells))

    @property
    def stamp(self) -> int:
        """Number of the last keyframe that was added or taken away; a map that is opened begins at 0."""
        return self._store.stamp

    @property
    def drops(self) -> int:
        """Number of times that blocks were removed; cells that read them have changed without a new stamp."""
        return self._store.drops

    def _level(
        self, given: Up | str | None, *, above_floor: bool
    ) -> tuple[tuple[float, float, float], float | None]:
        """Up as given, or found; with `above_floor` also the floor's height."""
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
        """Kept values of a surface, without those that have changed since the last question."""
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
