# SPDX-License-Identifier: MIT
"""Fuse keyframes into the map: a sum of integers in sparse blocks of 8³ voxels.

A voxel holds Σ w·m and Σ w over all rays that crossed it: m is the signed distance to the surface along the
ray, as an integer, w the ray's weight. A keyframe is a list of such additions. Hence the order of keyframes
does not matter, and subtraction removes a keyframe to the last bit. Smoothed values and meshes are read from
the sums and never change them.
"""

import copy
import logging
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsfusion.core import process
from tsfusion.core.config import (
    OTHER_NAMES_OF_SETTINGS,
    OTHER_NAMES_OF_VOLUME,
    Arch,
    CacheConfig,
    Surface,
    VolumeConfig,
    instead,
    make_settings,
    override,
)
from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.core.readable_numbers import OnProgress, count_of
from tsfusion.geometry import object_cards
from tsfusion.geometry.keyframe import Intrinsics, Keyframe, keyframe_of
from tsfusion.geometry.map_answers import PointCloud, Samples, View, checked_camera, checked_points
from tsfusion.geometry.map_grids import DistanceField, DistanceSlice, OccupancySlice, blocked
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.mesh_arrays import Provenance
from tsfusion.geometry.mesh_parts import MeshParts
from tsfusion.geometry.sample_ranges import why_no_samples
from tsfusion.geometry.up_direction import SensorPosture, Up
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.voxel_traversal import COUNT, VOXEL_LIMIT
from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.tsdf.answers import camera_views, distance_fields, map_slices, point_samples
from tsfusion.tsdf.answers.distance_fields import FieldBlocks
from tsfusion.tsdf.answers.map_slices import CurrentSlice
from tsfusion.tsdf.device.device_blocks import DeviceBlocks
from tsfusion.tsdf.device.device_integrator import DeviceIntegrator, DeviceRayBuffers, device_for
from tsfusion.tsdf.files import checkpoint, map_history, saved_map, voxel_arrays
from tsfusion.tsdf.files.map_history import HELD
from tsfusion.tsdf.files.voxel_arrays import Blocks
from tsfusion.tsdf.integration.integrator import Integrator, KeyframeQuota
from tsfusion.tsdf.integration.ray_buffers import RayBuffers, keyframes_of_every_kind
from tsfusion.tsdf.store.block_store import BlockStore, cells_of, unpack_keys
from tsfusion.tsdf.store.residency import checked_cache
from tsfusion.tsdf.sums import map_addition, map_crop, map_difference
from tsfusion.tsdf.sums.map_difference import MapDifference
from tsfusion.tsdf.surface import mesh_extraction, mesh_tiles
from tsfusion.tsdf.surface.map_surface import MapSurface
from tsfusion.tsdf.texture.texture_fitting import PosedImages

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from tsfusion.core.config import LoadSettings, VolumeSettings
    from tsfusion.geometry.keyframe import KeyframeFields
    from tsfusion.geometry.map_questions import DistanceFieldSettings, OwnSliceSettings, ViewSettings

log = logging.getLogger(__name__)
_OF_SERVERS = {  # names that completion omits
    "blocks_within", "load_blocks", "most_blocks", "quota", "set_pause", "version",
    "surface", "warming_up", "why_no_samples",
}  # fmt: skip
_MOST_SHOWN = 50_000  # blocks; a larger map has no picture, because a picture needs a mesh


class IntegrateStats(msgspec.Struct, frozen=True):
    """Counts from adding or retracting one keyframe: samples, rays, voxel updates, blocks."""

    samples: int  # pixels or points with a usable return
    invalid: int  # without a return, out of range, or untrusted
    rays: int
    blocks: int  # touched
    new_blocks: int
    updates: int  # additions of rays to voxels


class VolumeStats(msgspec.Struct, frozen=True):
    """Size of the map. `bytes` counts the blocks and their hash, without `scratch_bytes` (working memory)."""

    keyframes: int
    blocks: int
    voxels: int
    bytes: int
    bytes_per_block: int
    scratch_bytes: int  # working memory of rays and meshes
    resident_bytes: int  # share of `bytes` in memory: all, unless the map has `memory_bytes`


class Volume(object_cards.Shown):
    """A sparse volume that keyframes are added to, and exactly removed from.

            integrate, retract                        add a keyframe; remove it again
            extract_mesh, point_cloud, raycast        get the surface
            sample, distance_field, distance_slice    get distances; occupancy_slice: get free space
            save, load, save_voxels                   write and read the map, or write its voxels
            merge, crop, copy, diff                   join maps, cut them, copy them, compare them
            map_hash, stats                           get a hash of the content, and its size

    Give a `VolumeConfig`, or the edge of a voxel in metres and other fields by name: `Volume(0.02,
    sensor="kinect", regularizer="ray")`. A volume belongs to the first thread of a process that makes one,
    because Taichi runs in that thread. Calls from another thread, or in a forked process, raise MapError.
    `threads` counts for the first volume of a process. With `arch="cuda"` or another device, a process that
    all volumes share fuses keyframes on the device. Without the device, a warning gives the reason, and the
    CPU fuses them.

    Args:
        config: a `VolumeConfig`, or the edge of a voxel in metres.
        others: none; other libraries' positional arguments raise an error that says what to write.
        memory_bytes: bytes of memory for the blocks. Blocks unchanged for longest move to unnamed files, and
            return when they are touched (Linux). None = all blocks stay in memory.
        cache: folder of these files, on a disk, or a `CacheConfig`; default: `TMPDIR`, or /var/tmp.
        settings: fields of `VolumeConfig` by name.

    Attributes:
        config, model: settings of the map, and of its sensor.
        keyframes: number of fused keyframes with a usable sample.
        held: how their sensors were held.
        meta: JSON-like content that is saved with the map.

    Raises:
        InvalidConfig: for an unknown setting or a value out of range.

    Examples:
        >>> volume = tsfusion.Volume(voxel_size=0.05, sensor="kinect")
        >>> room = tsfusion.open_dataset("synthetic:room", count=2)
        >>> volume.integrate(room[0]).samples
        76800
        >>> before = volume.map_hash()
        >>> added, taken = volume.integrate(room[1]), volume.retract(room[1])
        >>> volume.map_hash() == before  # to the last bit
        True
        >>> volume.extract_mesh().save("room.ply").name
        'room.ply'
    """

    quota: KeyframeQuota | None = None  # limits of the keyframes integrated from now on
    _has_warned = False  # True after a warning about a keyframe without samples
    _has_retracted = False  # since `release_empty`

    def __init__(
        self,
        config: VolumeConfig | float | None = None,
        *others: object,
        memory_bytes: int | None = None,
        cache: str | os.PathLike[str] | CacheConfig | None = None,
        **settings: "Unpack[VolumeSettings]",
    ) -> None:
        if others:  # VDBFusion's: sdf_trunc, space_carving
            hint = instead("sdf_trunc", OTHER_NAMES_OF_SETTINGS, ())
            raise InvalidConfig(
                f"settings are given by name, such as space_carving=True; for sdf_trunc{hint}"
            )
        if not isinstance(config, VolumeConfig):
            edge = {} if config is None else {"voxel_size": _number(config)}
            config = make_settings(VolumeConfig, {**edge, **settings})
        elif settings:
            config = override(config, **settings)
        runtime.start(config.threads)
        smooths = config.checked_model().regularizer != "off"
        device = device_for(config.arch, color=config.color, hits=config.counts_hits, smooths=smooths)
        store = BlockStore(
            voxel_size=config.voxel_size,
            color=config.color,
            corrected=smooths,
            hits=config.counts_hits,
            back_limits=mesh_extraction.back_limits(config),
            cache=None if memory_bytes is None else checked_cache(memory_bytes, cache),
            device=device,
        )
        self.config, self.model = config, config.checked_model()
        self.meta: dict[str, Any] = {}
        self.keyframes, self.held = 0, SensorPosture()
        self._surface = MapSurface(store, self.model)
        self._cache = memory_bytes, cache  # for `copy`
        if memory_bytes is not None:
            self.limit_memory(memory_bytes)
        self._device = device
        self._ray_buffers, self._integrator = _writers(store, device, config)

    def __dir__(self) -> list[str]:
        return sorted(set(super().__dir__()) - _OF_SERVERS)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raise AttributeError; for a name of another library, with its counterpart here."""
            hint = instead(name, OTHER_NAMES_OF_VOLUME, dir(type(self)))
            raise AttributeError(f"Volume has no {name}{hint}")

    def _facts(self) -> dict[str, str]:
        store = self._surface.store  # readable from any thread, such as a debugger's
        size = object_cards.extent(unpack_keys(store.keys) * (8 * self.config.voxel_size))
        return {
            "keyframes": count_of(self.keyframes, "keyframe"),
            "blocks": f"{store.count} blocks of 8³ voxels of {1000 * self.config.voxel_size:g} mm",
            "sensor": f"sensor {self.config.sensor}",
            "size": size,
        }

    def _pictures(self) -> list[object_cards.Picture | None]:
        return self.extract_mesh(surface="raw")._pictures() if self._store.count <= _MOST_SHOWN else []

    @property
    def surface(self) -> MapSurface:
        """Values and meshes of the map's surface. Raises MapError in a thread other than the map's own."""
        runtime.check_thread()
        return self._surface

    @property
    def _store(self) -> BlockStore:
        return self.surface.store

    def integrate(
        self, keyframe: Keyframe | None = None, *others: object, **fields: "Unpack[KeyframeFields]"
    ) -> IntegrateStats:
        """Add a keyframe. On an error the map is unchanged.

        A keyframe without a usable sample changes nothing and is not counted; only the first is logged.

        Args:
            keyframe: a `Keyframe`, a dict of its fields, or an object with such attributes.
            others: none; other libraries' positional arguments raise an error that says what to write.
            fields: a keyframe's fields instead: `integrate(points=…, T_world_camera=…)`.

        Raises:
            InvalidKeyframe: the arguments are no keyframe.
            MapFull: the keyframe or the map would exceed its limit of blocks, or the keyframe its `quota`.
            WeightOverflow: a voxel already has as many votes as its integers hold.
        """
        given = _keyframe(keyframe, others, fields)
        stats = self._apply(given, +1)
        if not stats.samples and not self._has_warned:
            self._has_warned = True
            log.warning("%s (later keyframes without samples are not logged)", self.why_no_samples(given))
        return stats

    def why_no_samples(self, keyframe: Keyframe) -> str:
        """Return a text for people: why `keyframe` has no usable sample, and what to change."""
        model = self.config.model(keyframe.sensor)
        reach = VOXEL_LIMIT * self.config.voxel_size
        return why_no_samples(keyframe, model.min_range, model.max_range, reach)

    def retract(
        self, keyframe: Keyframe | None = None, *others: object, **fields: "Unpack[KeyframeFields]"
    ) -> IntegrateStats:
        """Remove a keyframe, given as to `integrate`: the sums get the same bytes as without it.

        In the blocks that the keyframe touched, smoothed values fall back to raw values.

        Args:
            keyframe, others, fields: as for `integrate`.

        Raises:
            MapError: a voxel has fewer votes than the keyframe added. A keyframe that was never integrated is
                not detected where other keyframes left enough votes.
        """
        return self._apply(_keyframe(keyframe, others, fields), -1)

    def merge(self, other: "Volume", *, same_frame: bool = False) -> None:
        """Add another map of the same coordinate frame: the result equals the map of all keyframes, to the
        last bit.

        Settled colours (32768 votes) are averaged. Smoothed values fall back to raw values in blocks of both
        maps. Each journal keeps its own keyframes: a server with the merged map can add keyframes, but cannot
        move or remove those already in it. `retract` removes a keyframe of `other` exactly only if both maps
        have the same settings.

        Args:
            other: a map of the same voxel size and layers; it does not change.
            same_frame: the maps share a frame, although each scan found its poses itself.

        Raises:
            MapError: when voxels, layers or worlds differ, when both are the same map, or when they hold the
                same keyframes, as far as a server listed them. Parts of one map that share no voxel (`crop`)
                may be merged.
            MapFull, WeightOverflow, MemoryError: without room. After each error the map is unchanged.
        """
        if other is self:
            raise MapError("a map cannot be merged with itself: each keyframe would count twice")
        map_addition.check_like(self._store, other._store)
        parts = map_crop.parts_beside((self.meta, self.map_hash), (other.meta, other.map_hash))
        if parts is not None:
            map_addition.add(self._store, other._store, self.config.max_blocks, are_parts=True)
            self.keyframes = max(self.keyframes, other.keyframes)
            self.meta = map_crop.joined(self.meta, *parts, own=self.map_hash())
            return
        if self.keyframes and other.keyframes:
            map_history.check_addable(self.meta, other.meta, same_frame=same_frame)
        is_like = self._store.count and self.keyframes == other.keyframes
        if is_like and saved_map.have_same_content(self._store, other._store):
            raise MapError("the two maps are the same one: each keyframe would count twice")
        map_addition.add(self._store, other._store, self.config.max_blocks)
        self.keyframes += other.keyframes
        self.held.merge(other.held)
        self.meta = map_history.added(self.meta, other.meta)

    def copy(self) -> "Volume":
        """Copy the map, its keyframes, settings and counts; later changes to one do not affect the other.

        Raises MemoryError or MapFull without room for both.
        """
        memory_bytes, cache = self._cache
        made = Volume(self.config, memory_bytes=memory_bytes, cache=cache)
        made._store.copy_from(self._store)
        made.keyframes, made.meta = self.keyframes, copy.deepcopy(self.meta)
        made.held, made.quota = SensorPosture(self.held.numbers), self.quota
        made._has_warned, made._has_retracted = self._has_warned, self._has_retracted
        return made

    __copy__ = copy

    def __deepcopy__(self, _known: dict[int, Any]) -> "Volume":
        return self.copy()

    def __reduce__(self) -> NoReturn:
        raise MapError("a Volume cannot be pickled: use save, and Volume.load where it is needed")

    def crop(self, box: Sequence[float], *, most_bytes: int | None = None) -> "Volume":
        """Return a new map of the voxels whose centres lie in a box, with sums, colours and smoothed values.

        The part can be merged, meshed and saved, and accepts keyframes anywhere. A keyframe that was cut can
        no longer be retracted; `keyframes` counts all keyframes of the original map.

        Args:
            box: x0, y0, z0, x1, y1, z1 in metres; a centre on the upper side is outside, so that maps of
                adjacent boxes add up to that of both boxes.
            most_bytes: limit of the part's memory; the part does not record which map it was cut from.

        Raises:
            InvalidConfig: for an invalid box; MemoryError: when there is no room for both maps.
        """
        first, end = map_crop.voxel_range(box, self.config.voxel_size)
        cropped = Volume(self.config)
        if most_bytes is not None:
            cropped.limit_memory(most_bytes)
        map_crop.copy(self._store, cropped._store, first, end)
        cropped.keyframes = self.keyframes if cropped._store.count else 0
        cropped.held = SensorPosture(self.held.numbers)
        cropped.meta = map_history.without_journal(self.meta)
        if most_bytes is None:  # else the part is temporary, and hashing the whole map would take longer
            part = map_crop.cut(self.meta, self.map_hash(), first, end, cropped.map_hash())
            cropped.meta[map_crop.PART_OF] = msgspec.to_builtins(part)
        return cropped

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
        mesh = self.surface.extract(min_weight, blocks, surface, fill_holes)
        return mesh if blocks is not None else replace(mesh, held=self.held)

    def sample(
        self, points: ArrayLike, *, min_weight: float | None = None, surface: Surface | None = None
    ) -> Samples:
        """Sample signed distance, weight and gradient at points, interpolated between voxel centres.

        NaN beyond `reach` does not mean free: planners ask `distance_field`.

        Args:
            points: (n, 3) float32 or float64 metres.
            min_weight, surface: as for `extract_mesh`.
        """
        cubes, least = self.surface.cubes(surface, min_weight), self.surface.min_weight(min_weight)
        found = point_samples.sample(checked_points(points), self._store, least, cubes.values)
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
        **how: "Unpack[ViewSettings]",
    ) -> View:
        """Render the surface as a pinhole camera sees it: depth, normals, and colours if the map has them.

        Only the front of a surface is visible: the side that the sensors saw.

        Args:
            intrinsics: `Intrinsics`, a (3, 3) camera matrix, or fx, fy, cx, cy; pixels.
            T_world_camera: (4, 4) pose, camera axes x right, y down, z forward.
            shape: (height, width), pixels.
            how: `min_weight`, `surface`: as for `extract_mesh`; `normals`, `colors`: images to render in
                addition to depth (True), depth alone is faster.
        """
        camera = checked_camera(intrinsics, T_world_camera, shape)
        cubes = self.surface.cubes(how.pop("surface", None), how.pop("min_weight", None))
        return camera_views.cast(cubes, *camera, **how)

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
        unseen_is_free: bool = False,
        **how: "Unpack[DistanceFieldSettings]",
    ) -> DistanceField:
        """Return the Euclidean distance to the nearest surface, for every voxel in a box.

        Surfaces outside the box count too: a voxel has the same distance in any box.

        Args:
            box: x0, y0, z0, x1, y1, z1 in metres, one voxel thick for a plane; None = around the whole map.
            unseen_is_free: give an unseen voxel the distance to the nearest seen surface; False = 0.
            how: `max_distance`: metres (2), farther voxels get this distance; `min_weight`: as for
                `extract_mesh`; `subvoxel`: measure to the surface within its voxel (True), or between voxel
                centres, as SciPy's `distance_transform_edt`.

        Raises:
            InvalidConfig: for an invalid box, or a box of too many voxels.
            MapError: for an empty map without a box.
        """
        options: dict[str, Any] = {**how, "min_weight": self.surface.min_weight(how.get("min_weight"))}
        found = distance_fields.in_box(self._store, box, **options)
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
        weight = self.surface.min_weight(min_weight)
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
            low, high, box, up, resolution, max_distance, min_weight, above_floor: as for `distance_slice`.
            most_cells: limit, including the cells around the box that distances depend on.

        Raises:
            InvalidConfig, MapError: as `distance_slice`.
        """
        mesh = partial(self.extract_mesh, surface="raw")
        direction, floor = map_slices.level(up, self.held, mesh, above_floor=above_floor)
        return CurrentSlice(
            self._store,
            (low, high),
            box,
            map_slices.axes_of(np.array(direction)),
            floor=floor,
            resolution=resolution,
            max_distance=max_distance,
            min_weight=self.surface.min_weight(min_weight),
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
            options: `box`: u0, v0, u1, v1 in metres along the slice's own axes (`SliceGrid`; x and y if z is
                up; None = around the whole map); `up`: direction away from the ground, such as `"z"`,
                `"-y"` or `"0,-0.9,0.1"` (None = find it, which meshes the map); `resolution`: edge of a cell,
                metres (None = the voxel size), a cell takes the minimum of its voxels; `max_distance`:
                metres (2); `min_weight`: as for `extract_mesh`; `above_floor`: count the heights from the
                floor, which `up_direction.floor_height` finds, `grid.floor` of the slice is its height.

        Raises:
            InvalidConfig: for an invalid box, or too many cells.
            MapError: for an empty map without a box, or if the up direction or the floor cannot be found.
        """
        return self.current_slice(low, high, **options).distances(unseen_is_free=unseen_is_free)

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
        parts = mesh_tiles.tiles(self._store, self.surface.min_weight(min_weight), self.surface.view())
        return MeshParts(parts, Path(folder), held=self.held, known_up=up)

    def provenance(self, source: str | None = None) -> Provenance:
        """Return facts about the map for a file of its surface, with a newly computed hash.

        `source` is the file or folder of the map's input; the result has its name, not its path.
        """
        return saved_map.provenance(self.meta, self.keyframes, self.map_hash(), self.config, source)

    def cells_to_mesh(self, dirty: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the blocks whose mesh depends on the changed blocks: (m, 3) int32.

        These are the changed blocks, the blocks into which the field carries the change, and their neighbours
        towards −x, −y, −z. In a raw mesh, normals at the rim can lack the newest keyframe.
        """
        return cells_of(unpack_keys(self.surface.values_reached(dirty)))

    def diff(self, later: "Volume", *, tolerance: float | None = None) -> MapDifference:
        """Compare with a later map of the same frame, in numbers and as a coloured mesh.

        Args:
            later: the other map.
            tolerance: distance in metres up to which two surfaces count as the same; default two voxels.

        Raises:
            MapError: when the maps have voxels of different sizes.
            InvalidConfig: for a negative or infinite tolerance.
        """
        map_addition.check_voxels(self._store, later._store)
        metres = 2 * self.config.voxel_size if tolerance is None else tolerance
        if not 0 <= metres < math.inf:
            raise InvalidConfig(f"tolerance must be 0 metres or more, got {tolerance}")
        earlier, other = (
            map_difference.MapSide(one.extract_mesh().without_islands(), one._store, one.model.min_weight)
            for one in (self, later)
        )
        blocks, voxels = map_difference.count(self._store, later._store)
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
            min_weight=self.surface.min_weight(min_weight), watch=watch,
        )  # fmt: skip
        return Path(path)

    def map_hash(self) -> str:
        """Return a hex digest of the exact sums: equal for the same keyframes in any order, on any threads.

        Colours, which compression may change, and smoothed values, which depend on order, are left out.
        """
        return saved_map.sums_hash(self._store)

    def color_hash(self) -> str:
        """Return a hex digest of the exact colour sums."""
        return saved_map.color_hash(self._store)

    @property
    def version(self) -> int:
        """Number of changes, such as keyframes added or retracted, since the map was made or opened."""
        return self._store.version

    def take_dirty(self) -> NDArray[np.int32]:
        """Return the blocks changed or removed since the last call: (n, 3) int32, in units of 8 voxels.

        Call it once before changes of an opened map that remove many blocks: else these are not returned.
        """
        store, taken = self._store, self._store.taken or 0
        blocks, removed = store.keys[store.changed_since(taken)], store.removed_since(taken)
        store.taken = store.version
        return unpack_keys(blocks if removed is None else np.append(blocks, removed))

    def release_empty(self) -> int:
        """Remove the blocks that `retract` has left without votes. Returns their number.

        The content of the map stays the same, as after saving and loading. Later blocks reuse the memory.
        """
        if not self._has_retracted:
            return 0
        store = self._store
        empty = np.setdiff1d(np.arange(store.count), store.used(), assume_unique=True)
        if len(empty):
            store.release(empty)
        self._has_retracted = False
        return len(empty)

    def clear(self) -> None:
        """Remove all keyframes and blocks."""
        store = self._store
        store.release(np.arange(store.count))
        store.clear.replace((np.zeros(0, np.int64), np.zeros(0, np.int32)), store.version - 1)
        self.keyframes, self.held, self.meta, self._has_retracted = 0, SensorPosture(), {}, False

    @property
    def size(self) -> tuple[int, int]:
        """Number of blocks, and the bytes of the blocks and their hash."""
        return self._store.count, self._store.nbytes

    def stats(self) -> VolumeStats:
        """Return the counts of the map, and its exact size in bytes."""
        store = self._store
        return VolumeStats(
            keyframes=self.keyframes,
            blocks=store.count,
            voxels=store.count * CUBE,
            bytes=store.nbytes,
            bytes_per_block=store.bytes_per_block,
            scratch_bytes=self._ray_buffers.nbytes + self._surface.nbytes,
            resident_bytes=store.resident_bytes,
        )

    def warm_up(self) -> None:
        """Compile every kernel, so that the first keyframe is not slower than the rest."""
        for _ in self.warming_up():
            pass

    def warming_up(self) -> Iterator[None]:
        """Compile every kernel, in steps. The first step covers keyframes and their raw mesh."""
        throwaway = Volume(override(self.config, max_blocks=1 << 14, max_blocks_per_keyframe=1 << 14))
        for keyframe in keyframes_of_every_kind(self.model, self.config.voxel_size):
            throwaway.integrate(keyframe)
            throwaway.retract(keyframe)
            throwaway.integrate(keyframe)
        throwaway.extract_mesh(min_weight=0, surface="raw")
        throwaway.extract_mesh(min_weight=0, surface="raw", blocks=throwaway.take_dirty()[:1])
        yield
        throwaway.sample(np.zeros((1, 3), np.float32), surface="raw", min_weight=0)
        throwaway.raycast((1, 1, 0, 0), np.eye(4), (1, 1), surface="raw")
        yield
        edge = self.config.voxel_size
        throwaway.distance_field([0.0, 0, 0, edge, edge, edge], max_distance=edge)
        current = throwaway.current_slice(0.0, edge, up="z", box=(0.0, 0, edge, edge), max_distance=edge)
        throwaway.integrate(keyframe)
        current.update()
        yield
        throwaway.extract_mesh(min_weight=0)
        throwaway.extract_mesh(min_weight=0, blocks=np.zeros((1, 3), np.int32))
        throwaway.sample(np.zeros((1, 3), np.float32), min_weight=0)

    def save(self, path: str | os.PathLike[str], meta: dict[str, Any] | None = None) -> Path:
        """Write a checkpoint, completely and durably on disk, or not at all.

        Args:
            path: the file, by convention `*.tsf`.
            meta: JSON-like content to save with the map; `load` returns it as `.meta`.

        Raises:
            OutputError: for a file name of a mesh or of voxels.
            CheckpointError: when the file cannot be written.
        """
        own = {**(self.meta if meta is None else meta), HELD: self.held.numbers}
        return saved_map.write(Path(path), self._store, self.config, self.keyframes, own)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        threads: int | None = None,
        *,
        memory_bytes: int | None = None,
        cache: str | os.PathLike[str] | CacheConfig | None = None,
        **changed: "Unpack[LoadSettings]",
    ) -> "Volume":
        """Read a checkpoint, and verify it by its own hash.

        Args:
            path: a `.tsf` file that `save` wrote.
            threads: as for a new map; None = as many as the machine has cores.
            memory_bytes, cache: as for a new map; a map larger than the cache's limit opens, too.
            changed: settings instead of the saved ones: how the surface is read (`config.VIEW_SETTINGS`)
                or how the map may grow (`config.LIMIT_SETTINGS`); None = as saved.

        Raises:
            InvalidConfig: for a setting that the stored sums depend on.
            CheckpointError: when the file is missing, torn, altered or of another version.
        """
        with ExitStack() as opening, checkpoint.reading(Path(path)) as (header, chunks):
            volume = cls(
                saved_map.loaded_config(header, threads, changed), memory_bytes=memory_bytes, cache=cache
            )
            store = volume._store
            opening.enter_context(store.opening(header.blocks))
            saved_map.fill(store, Path(path), header, chunks)
            volume.keyframes = header.keyframes
            volume.held = SensorPosture(header.meta.pop(HELD, None))
            volume.meta = header.meta
        return volume

    @classmethod
    def load_blocks(
        cls,
        path: str | os.PathLike[str],
        low: Sequence[int],
        high: Sequence[int],
        *,
        is_checked: bool = False,
        **changed: "Unpack[LoadSettings]",
    ) -> "Volume":
        """Load a part of a saved map: the blocks in a box, and the surrounding blocks that its mesh depends
        on.

        `extract_mesh(blocks=blocks_within(low, high))` of the part equals that of the whole map, bit by bit.

        Args:
            path, changed: as for `load`.
            low, high: (3,) block coordinates, first and last + 1.
            is_checked: the whole file was just read, so its digest is not compared again.

        Raises:
            InvalidConfig, CheckpointError: as `load`; the map's own hash is not compared.
        """
        with checkpoint.reading(Path(path), is_checked=is_checked) as (header, chunks):
            volume = cls(saved_map.loaded_config(header, None, changed))
            halo = 1 + volume.surface.reach()
            saved_map.fill_box(volume._store, header, chunks, np.array(low) - halo, np.array(high) + halo)
            volume.held = SensorPosture(header.meta.get(HELD))
        return volume

    def blocks_within(self, low: Sequence[int], high: Sequence[int]) -> NDArray[np.int32]:
        """Return the map's blocks in a box: (n, 3) int32 coordinates, `low` ≤ (x, y, z) < `high`, (3,) block
        coordinates."""
        blocks = unpack_keys(self._store.keys)
        return blocks[((blocks >= np.array(low)) & (blocks < np.array(high))).all(axis=1)]

    def limit_memory(self, nbytes: int) -> None:
        """Limit memory: from now on a keyframe that would need more than `nbytes` fails with MemoryError.

        The map stays unchanged, even if it is already larger. Working memory is not counted. In a map with
        `memory_bytes` no keyframe fails: the coldest blocks leave memory instead.
        """
        self._store.limit(nbytes)

    def set_pause(self, pause: Callable[[], None]) -> None:
        """Set a function that long calls (meshes, hashes, saving, a keyframe before its rays are added) run
        between their steps. `pause` may ask the map anything, but must not change the map."""
        self._store.pause = pause

    @property
    def arch(self) -> Arch:
        """Device that fuses keyframes: as in the settings, or `cpu` if that device cannot be used."""
        return "cpu" if self._device is None else self._device.arch

    @property
    def most_blocks(self) -> int:
        """Largest number of blocks that the settings and `limit_memory` allow."""
        return min(self.config.max_blocks, self._store.most_blocks)

    def _apply(self, keyframe: Keyframe, sign: int) -> IntegrateStats:
        if sign < 0 and self.keyframes == 0:
            raise MapError("cannot retract a keyframe from a map that holds none")
        blocks_before = self._store.count
        self._ray_buffers.make_rays(keyframe, self.config)  # paper eq. 1
        if sign > 0:  # a moved keyframe is in the map twice until it is retracted: no pause then
            self._store.pause()
        self._has_retracted |= sign < 0
        with process.uninterrupted():
            updates = self._integrator.apply(sign, self.quota)  # paper eq. 2 and 3
            samples = self._ray_buffers.samples
            if samples:
                self.keyframes += sign
                self._note_held(keyframe, sign)
        return IntegrateStats(
            samples=samples,
            invalid=int(np.prod(keyframe.shape)) - samples,
            rays=int(self._ray_buffers.strips[:, COUNT].sum()),
            blocks=len(self._ray_buffers.touched_slots),
            new_blocks=self._store.count - blocks_before,
            updates=updates,
        )

    def _note_held(self, keyframe: Keyframe, sign: int) -> None:
        sensor = keyframe.sensor or self.config.sensor
        if keyframe.points is None or sensor == "lidar":  # the sensor's axes are unknown for other points
            self.held.add(keyframe.T_world_camera, sensor, times=sign)


def _writers(
    store: BlockStore, device: DeviceBlocks | None, config: VolumeConfig
) -> tuple[RayBuffers, Integrator]:
    """Return the two objects that make a keyframe's rays and add them to a map, on the CPU or a device."""
    if device is None:
        buffers = RayBuffers(color=config.color, regularised=store.corrected)
        return buffers, Integrator(store, buffers, config)
    on_device = DeviceRayBuffers(color=config.color)
    return on_device, DeviceIntegrator(store, device, on_device, config)


def _number(value: Any) -> Any:
    """Convert a NumPy number to a Python number: 0.05 in float32 becomes 0.05."""
    return float(str(value)) if isinstance(value, np.floating) else value


def _keyframe(keyframe: Any, others: tuple[object, ...], fields: Mapping[str, Any]) -> Keyframe:
    """Return the keyframe of a call's arguments; `others` are positional ones, as in other libraries."""
    if others:
        return keyframe_of((keyframe, *others))
    return keyframe_of(fields if keyframe is None and fields else keyframe)
