# SPDX-License-Identifier: MIT
"""The map: a sum of integers in sparse blocks of 8³ voxels, and the surfaces read from it.

A voxel holds Σ w·m and Σ w over all rays that crossed it: m is the signed distance to the surface along the
ray, as an integer, w the ray's weight. A keyframe is a list of such additions. Hence the order of keyframes
does not matter, and subtraction removes a keyframe to the last bit. Smoothed values and meshes are read from
the sums and never change them.
"""

import hashlib
import logging
import math
import os
import struct
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files, other_names, process
from tsfusion.core.config import (
    LIMIT_SETTINGS,
    VIEW_SETTINGS,
    CacheConfig,
    Surface,
    VolumeConfig,
    make_settings,
    override,
)
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint, InvalidConfig, MapError
from tsfusion.core.side_thread import SideThread
from tsfusion.geometry.keyframe import Keyframe, keyframe_of
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.mesh_parts import MeshParts, joined
from tsfusion.geometry.sample_ranges import why_no_samples
from tsfusion.geometry.up_direction import HeldSensor, Up
from tsfusion.kernels import integrate, runtime
from tsfusion.kernels.integrate import CUBE
from tsfusion.kernels.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.voxel_traversal import COUNT
from tsfusion.tsdf import (
    checkpoint,
    field_regularizer,
    map_addition,
    map_crop,
    map_difference,
    map_history,
    voxel_arrays,
)
from tsfusion.tsdf.block_store import BlockStore, cells_of, pack_keys, unpack_keys
from tsfusion.tsdf.integrator import Integrator, KeyframeQuota
from tsfusion.tsdf.map_difference import MapDifference
from tsfusion.tsdf.mesh_extraction import MeshBuffers, extract
from tsfusion.tsdf.mesh_tiles import tiles
from tsfusion.tsdf.ray_buffers import RayBuffers, keyframes_of_every_kind
from tsfusion.tsdf.surface_values import SurfaceView, values_of

log = logging.getLogger(__name__)

_HELD = "held"  # in a checkpoint's meta, as the fuser wrote it first


class IntegrateStats(msgspec.Struct, frozen=True):
    """Counts of one keyframe's integration or retraction."""

    samples: int  # pixels or points with a usable return
    invalid: int  # without a return, out of range, or untrusted
    rays: int
    blocks: int  # touched
    new_blocks: int
    updates: int  # of voxels by rays


class VolumeStats(msgspec.Struct, frozen=True):
    """Size of the map. `bytes` is that of the blocks and their hash, without `scratch_bytes`."""

    keyframes: int
    blocks: int
    voxels: int
    bytes: int
    bytes_per_block: int
    scratch_bytes: int  # working memory of rays and meshes
    resident_bytes: int  # of `bytes`, those in memory: all, unless the map has `memory_bytes`


class Volume:
    """A sparse volume that keyframes are added to, and exactly removed from.

    Give a `VolumeConfig`, or the edge of a voxel in metres and other fields by name:
    `Volume(0.02, sensor="kinect", regularizer="ray")`.
    Use it from one thread (Taichi's). `threads` counts for the first volume of a process: Taichi starts once.

    Args:
        memory_bytes: that the blocks may take of memory; those that no keyframe has changed for longest wait
            in files without names, and come back when they are touched (Linux). None = all stay in memory.
        cache: folder of these files, on a disk, or all about it; default: `TMPDIR`, or /var/tmp.

    Raises:
        InvalidConfig: for an unknown setting or a value out of range.
    """

    def __init__(
        self,
        config: VolumeConfig | float | None = None,
        *others: object,
        memory_bytes: int | None = None,
        cache: str | os.PathLike[str] | CacheConfig | None = None,
        **settings: Any,
    ) -> None:
        if others:  # VDBFusion's: sdf_trunc, space_carving
            hint = other_names.instead("sdf_trunc", other_names.SETTINGS, ())
            raise InvalidConfig(
                f"settings are given by name, such as space_carving=True; for sdf_trunc{hint}"
            )
        if not isinstance(config, VolumeConfig):
            edge = {} if config is None else {"voxel_size": config}
            config = make_settings(VolumeConfig, {**edge, **settings})
        elif settings:
            config = override(config, **settings)
        self.config = config
        self.model = model = config.checked_model()
        self.meta: dict[str, Any] = {}
        self.keyframes = 0  # with a usable sample
        self.held = HeldSensor()  # their sensors
        self.quota: KeyframeQuota | None = None  # of the keyframes that are integrated from here on
        self._has_warned = False  # of a keyframe without
        self._has_retracted = False  # since `release_empty`
        self._released: list[NDArray[np.int64]] = []  # keys of released blocks whose mesh has to go
        runtime.start(config.threads)
        smooths = model.regularizer != "off"
        self._store = BlockStore(
            voxel_size=config.voxel_size,
            color=config.color,
            corrected=smooths,
            cache=None if memory_bytes is None else _checked_cache(memory_bytes, cache),
        )
        if memory_bytes is not None:
            self.limit_memory(memory_bytes)
        self._ray_buffers = RayBuffers(color=config.color, regularised=smooths)
        self._mesh_buffers = MeshBuffers()
        self._integrator = Integrator(self._store, self._ray_buffers, config)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Say what stands for a name of other libraries."""
            hint = other_names.instead(name, other_names.VOLUME, dir(type(self)))
            raise AttributeError(f"Volume has no {name}{hint}")

    def integrate(self, keyframe: Keyframe | None = None, *others: object, **fields: Any) -> IntegrateStats:
        """Add a keyframe. On an error the map is as it was.

        One without a usable sample changes nothing and is not counted; the first of them is a warning.

        Args:
            keyframe: also a dict of a keyframe's fields, or an object with such attributes.
            fields: a keyframe's fields instead: `integrate(points=…, T_world_camera=…)`.

        Raises:
            InvalidKeyframe: what is given is no keyframe.
            MapFull: the keyframe or the map would exceed its limit of blocks, or the keyframe its `quota`.
            WeightOverflow: a voxel has taken as many votes as its integers hold.
        """
        given = _keyframe(keyframe, others, fields)
        stats = self._apply(given, +1)
        if not stats.samples and not self._has_warned:
            self._has_warned = True
            log.warning("%s (others like it are not named)", self.why_no_samples(given))
        return stats

    def why_no_samples(self, keyframe: Keyframe) -> str:
        """Why `integrate` found no usable sample in a keyframe, and what to do, for a person."""
        model = self.config.model(keyframe.sensor)
        return why_no_samples(keyframe, model.min_range, model.max_range)

    def retract(self, keyframe: Keyframe | None = None, *others: object, **fields: Any) -> IntegrateStats:
        """Remove a keyframe, given as to `integrate`: the sums get back the bytes they had without it.

        Smoothed values cannot be un-smoothed: in the blocks it touched they fall back to the raw ones.

        Raises:
            MapError: the map cannot hold this keyframe: a voxel of it has fewer votes than would be taken
                away. A keyframe never integrated goes unnoticed where others left votes enough.
        """
        return self._apply(_keyframe(keyframe, others, fields), -1)

    def merge(self, other: "Volume", *, same_frame: bool = False) -> None:
        """Add another map of the same coordinate frame: the map of all keyframes of both, to the last bit.

        Settled colours (32768 votes) are averaged. Smoothed values fall back to the raw ones in blocks that
        both have. Each journal keeps its own keyframes: a server that goes on with the merged map can add
        keyframes, and move or remove none of those that are in it.

        Args:
            same_frame: the maps are in one frame, although their scans found their poses each for itself.

        Raises:
            MapError: when the voxels or layers differ, when both are the same map or hold the same keyframes,
                as far as a server wrote down which, or are of different worlds; MapFull, WeightOverflow,
                MemoryError: when the sum has no room. After each of them the map is as it was.
        """
        if other is self:
            raise MapError("a map cannot be merged with itself: each keyframe would count twice")
        self._check_like(other)
        if self.keyframes and other.keyframes:
            map_history.check_addable(self.meta, other.meta, same_frame=same_frame)
        if self._store.count and self._has_content_of(other):
            raise MapError("the two maps are the same one: each keyframe would count twice")
        map_addition.add(self._store, other._store, self.config.max_blocks)
        self.keyframes += other.keyframes
        self.held.merge(other.held)
        self.meta = map_history.added(self.meta, other.meta)

    def crop(self, box: Sequence[float]) -> "Volume":
        """A new map of the voxels whose centres lie in a box, with their sums, colours and smoothed values.

        It can be merged, meshed and saved, and takes keyframes, anywhere. A keyframe that was cut can no
        longer be retracted; `keyframes` counts all that the map was made from.

        Args:
            box: x0, y0, z0, x1, y1, z1 in metres; a centre on the upper side is outside, so that maps of
                boxes side by side add up to that of both.

        Raises:
            InvalidConfig: for another box; MemoryError: when there is no room for both maps.
        """
        first, end = map_crop.voxel_range(box, self.config.voxel_size)
        cropped = Volume(self.config)
        map_crop.copy(self._store, cropped._store, first, end)
        cropped.keyframes = self.keyframes if cropped._store.count else 0
        cropped.held = HeldSensor(self.held.numbers)
        cropped.meta = map_history.without_journal(self.meta)
        return cropped

    def diff(self, later: "Volume", *, tolerance: float | None = None) -> MapDifference:
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
        watch: voxel_arrays.Watch = lambda _done, _all: None,
    ) -> Path:
        """Write an `.npz` file of voxels as `tsdf/voxel_arrays.py` describes; complete or not at all.

        Args:
            dense: one array around the whole map, instead of its blocks.
            watch: told the bytes of the arrays that are written, and all of them.

        Raises:
            OutputError: for an empty map, a box that is too large, or a path that cannot be written.
        """
        voxel_arrays.write(self._store, Path(path), dense=dense, watch=watch)
        return Path(path)

    def _check_voxels(self, other: "Volume") -> None:
        ours, theirs = self.config.voxel_size, other.config.voxel_size
        if ours != theirs:
            raise MapError(f"the maps have voxels of {ours:g} m and {theirs:g} m: fuse one anew")

    def _has_content_of(self, other: "Volume") -> bool:
        """Whether the other map has the same sums; hashed only where the counts do not tell."""
        counts = [(one.keyframes, one._store.count) for one in (self, other)]
        return counts[0] == counts[1] and all(
            hash_of(self) == hash_of(other) for hash_of in (Volume.map_hash, Volume.color_hash)
        )

    def _check_like(self, other: "Volume") -> None:
        """Raise MapError unless voxels and layers are those of another map."""
        self._check_voxels(other)
        ours, theirs = (", ".join(sorted(one._store.layers())) for one in (self, other))
        if ours != theirs:
            raise MapError(
                f"the maps have different layers, {ours} and {theirs} (colour, smoothing along rays): "
                "fuse one anew"
            )

    def take_dirty(self) -> NDArray[np.int32]:
        """Coordinates of the blocks changed since the last call: (n, 3) int32, in units of 8 voxels."""
        keys = np.concatenate([self._store.keys[self._store.take_dirty()], *self._released])
        self._released.clear()
        return unpack_keys(keys)

    def release_empty(self) -> int:
        """Give up the blocks that `retract` has left without votes; returns how many.

        The map stays the same, as if it were saved and loaded. Blocks that come later take their room.
        """
        if not self._has_retracted:
            return 0
        store = self._store
        empty = np.setdiff1d(np.arange(store.count), store.used(), assume_unique=True)
        self._released.append(store.keys[empty[store.dirty[empty] != 0]])
        store.release(empty)
        self._has_retracted = False
        return len(empty)

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

    def extract_mesh(
        self,
        min_weight: float | None = None,
        blocks: NDArray[np.int32] | None = None,
        surface: Surface | None = None,
    ) -> Mesh:
        """The surface, by marching cubes over the whole map or over the cells of some blocks.

        Args:
            min_weight: full-confidence samples a voxel needs to count as seen; default the sensor's.
            blocks: (n, 3) int32 block coordinates. A mesh of `cells_to_mesh(take_dirty())` replaces what
                changed.
            surface: what to mesh instead of what the settings say; for `raw`, `cells_of(take_dirty())` do.
        """
        min_weight = self._checked_min_weight(min_weight)
        store = self._store
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
        mesh = extract(np.sort(chosen), self._store, min_weight, self._mesh_buffers, self._view(surface))
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

    def _checked_min_weight(self, min_weight: float | None) -> float:
        """As given, or the sensor's."""
        if min_weight is None:
            min_weight = self.model.min_weight
        most = integrate.WEIGHT_LIMIT / WEIGHT_ONE
        if not 0 <= min_weight <= most:
            raise InvalidConfig(f"min_weight must be from 0 to {most:.0f}, got {min_weight}")
        return min_weight

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
        voxels = np.floor(np.asarray(points, np.float64) / self.config.voxel_size)
        near = np.asarray((np.abs(voxels) < 1 << 20).all(axis=1))  # others have no key; nor has NaN
        x, y, z = np.where(near[:, np.newaxis], voxels, 0).astype(np.int64).T
        keys, rows = np.unique(pack_keys(np.stack([x, y, z], axis=1) >> 3), return_inverse=True)
        weight = self._checked_min_weight(min_weight)
        values = values_of(keys, self._store, weight)[rows.ravel(), (x & 7) << 6 | (y & 7) << 3 | z & 7]
        metres = values * np.float32(self.config.voxel_size / integrate.QUANTA_PER_VOXEL)
        metres[~near] = np.nan
        return np.asarray(metres, np.float32)

    def map_hash(self) -> str:
        """Hex digest of the exact sums: equal for the same keyframes in any order, on any number of threads.

        Colour and smoothed values are not part of it (colour may travel lossily; smoothing has an order).
        """
        digest = self._begin_hash()
        for keys, sums in self._store.in_order("sums"):
            digest.update(keys.data)
            digest.update(sums.data)
        return digest.hexdigest()

    def _begin_hash(self) -> "hashlib.blake2b":
        """A digest that is to take the keys and then the sums of the used blocks, 1024 at a time."""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(struct.pack("<di", self.config.voxel_size, integrate.QUANTA_PER_VOXEL))
        return digest

    def color_hash(self) -> str:
        """Hex digest of the exact colour sums."""
        digest = hashlib.blake2b(digest_size=16)
        if self.config.color:
            for layer in ("color_rgn", "color_b"):
                for keys, sums in self._store.in_order(layer):
                    digest.update(keys.data)
                    digest.update(sums.data)
        return digest.hexdigest()

    def stats(self) -> VolumeStats:
        """Counts and exact bytes."""
        store = self._store
        return VolumeStats(
            keyframes=self.keyframes,
            blocks=store.count,
            voxels=store.count * CUBE,
            bytes=store.nbytes,
            bytes_per_block=store.bytes_per_block,
            scratch_bytes=self._ray_buffers.nbytes + self._mesh_buffers.nbytes,
            resident_bytes=store.resident_bytes,
        )

    def warm_up(self) -> None:
        """Compile every kernel, so that the first keyframe is not slower than the rest."""
        throwaway = Volume(override(self.config, max_blocks=1 << 14, max_blocks_per_keyframe=1 << 14))
        for keyframe in keyframes_of_every_kind(self.model, self.config.voxel_size):
            throwaway.integrate(keyframe)
            throwaway.retract(keyframe)
            throwaway.integrate(keyframe)
        throwaway.extract_mesh(min_weight=0)
        throwaway.extract_mesh(min_weight=0, blocks=throwaway.take_dirty()[:1])

    def save(self, path: str | os.PathLike[str], meta: dict[str, Any] | None = None) -> Path:
        """Write a checkpoint: complete and on disk, or not at all.

        Args:
            path: the file, by custom `*.tsf`.
            meta: anything JSON-like to keep with it; comes back as `.meta`.

        Raises:
            CheckpointError: when the file cannot be written.
        """
        layers = self._store.layers()
        header = checkpoint.CheckpointHeader(
            config=self.config,
            keyframes=self.keyframes,
            map_hash="",
            meta={**(self.meta if meta is None else meta), _HELD: self.held.numbers},
            layers=list(layers),
        )
        used = self._store.used()
        keys, rest = self._store.keys[used], self._store.keep_within_memory
        digest = self._begin_hash()
        return checkpoint.write(Path(path), header, keys, used, layers, map_digest=digest, between=rest)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        threads: int | None = None,
        *,
        memory_bytes: int | None = None,
        cache: str | os.PathLike[str] | CacheConfig | None = None,
        **changed: Any,
    ) -> "Volume":
        """Read a checkpoint back, verified against its own hash.

        Args:
            memory_bytes, cache: as of a new map; one that is larger than the cache may be opens, too.
            changed: settings instead of the saved ones, of how the surface is read (`config.VIEW_SETTINGS`)
                or of how the map may grow (`config.LIMIT_SETTINGS`); None = as saved.

        Raises:
            InvalidConfig: for a setting that the stored sums depend on.
            CheckpointError: when the file is missing, torn, altered or of another version.
        """
        with ExitStack() as opening, checkpoint.reading(Path(path)) as (header, chunks):
            volume = cls(_loaded_config(header, threads, changed), memory_bytes=memory_bytes, cache=cache)
            store = volume._store
            opening.enter_context(store.opening(header.blocks))
            layers = store.layers()
            if set(header.layers) != set(layers):
                raise CheckpointError(f"{path} is of another version: it has layers {header.layers}")
            digest = volume._begin_hash()
            with SideThread() as side:
                for chunk in chunks:
                    keys = np.empty(chunk.blocks, np.int64)
                    chunk.fill(keys)
                    store.insert(keys)
                    for name in header.layers:
                        chunk.fill(layers[name][chunk.first : store.count])
                    store.keep_within_memory()
                    side.do(partial(_check_in, Path(path), store, slice(chunk.first, store.count), digest))
                side.wait()
            volume.keyframes = header.keyframes
            volume.held = HeldSensor(header.meta.pop(_HELD, None))
            volume.meta = header.meta
            checkpoint.verify(Path(path), header, digest.hexdigest())
        return volume

    def limit_memory(self, nbytes: int) -> None:
        """Let a keyframe fail with MemoryError from now on if the map, with it, would take more bytes.

        The map stays as it is, also where it takes more already. Working memory is not counted. In a map with
        `memory_bytes` no keyframe fails: its coldest blocks leave memory instead.
        """
        self._store.limit(nbytes)

    @property
    def most_blocks(self) -> int:
        """Number of blocks that the map may have, by its settings and by `limit_memory`."""
        return min(self.config.max_blocks, self._store.most_blocks)

    def _apply(self, keyframe: Keyframe, sign: int) -> IntegrateStats:
        if sign < 0 and self.keyframes == 0:
            raise MapError("cannot retract a keyframe from a map that holds none")
        blocks_before = self._store.count
        samples = self._ray_buffers.make_rays(keyframe, self.config)  # paper eq. 1
        self._has_retracted |= sign < 0
        with process.uninterrupted():
            updates = self._integrator.apply(sign, self.quota)  # paper eq. 2 and 3
            if samples:
                self.keyframes += sign
                self._note_held(keyframe, sign)
        return IntegrateStats(
            samples=samples,
            invalid=int(np.prod(keyframe.shape)) - samples,
            rays=int(self._ray_buffers.bands[:, COUNT].sum()),
            blocks=len(self._ray_buffers.touched_slots),
            new_blocks=self._store.count - blocks_before,
            updates=updates,
        )

    def _note_held(self, keyframe: Keyframe, sign: int) -> None:
        sensor = keyframe.sensor or self.config.sensor
        if keyframe.points is None or sensor == "lidar":  # of other points nobody knows the sensor's axes
            self.held.add(keyframe.T_world_camera, sensor, times=sign)

    @property
    def _field(self) -> field_regularizer.FieldSettings:
        model = self.model
        return field_regularizer.FieldSettings(
            model.field_smoothness, model.field_edge, model.field_reweightings
        )

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


def _check_in(path: Path, store: BlockStore, blocks: slice, digest: "hashlib.blake2b") -> None:
    """Hash blocks that were read, and measure their bounds."""
    keys, sums = store.keys[blocks], store.sums[blocks]
    store.bounds[blocks] = (sums & integrate.WEIGHT_MASK).max(axis=1)
    before = store.keys[max(blocks.start - 1, 0) : blocks.stop]
    if (np.diff(before) <= 0).any() or not store.bounds[blocks].all():
        raise DamagedCheckpoint(f"{path} is malformed: its blocks are empty or out of order")
    digest.update(keys.data)
    digest.update(sums.data)


def _loaded_config(
    header: checkpoint.CheckpointHeader, threads: int | None, changed: dict[str, Any]
) -> VolumeConfig:
    """The settings of a saved map, with those that may be others."""
    saved = header.config
    fixed = {name for name in changed if name not in (*VIEW_SETTINGS, *LIMIT_SETTINGS)}
    if saved.model().regularizer != "off" and changed.get("smoothness") not in (None, saved.smoothness):
        fixed.add("smoothness")  # it has smoothed along rays already
    if fixed:
        raise InvalidConfig(f"a saved map cannot change {', '.join(sorted(fixed))}; fuse it anew")
    config = override(msgspec.structs.replace(saved, threads=threads), **changed)
    return override(config, max_blocks=max(config.max_blocks, header.blocks))


def _checked_cache(memory_bytes: int, cache: str | os.PathLike[str] | CacheConfig | None) -> CacheConfig:
    """Where blocks may wait that are not in memory."""
    if memory_bytes < 1:
        raise InvalidConfig(f"memory_bytes must be > 0, got {memory_bytes}")
    if sys.platform != "linux" or not process.shared_rss_bytes():
        raise InvalidConfig("memory_bytes needs Linux and its /proc: elsewhere all blocks stay in memory")
    if not isinstance(cache, CacheConfig):
        cache = CacheConfig(folder=os.fspath(cache or os.environ.get("TMPDIR") or "/var/tmp"))
    if durable_files.is_in_memory(Path(cache.folder)):
        raise InvalidConfig(
            f"the folder {cache.folder} is a RAM disk: what lies there takes memory; choose one on a disk "
            "for `cache`"
        )
    return cache


def _keyframe(keyframe: Any, others: tuple[object, ...], fields: dict[str, Any]) -> Keyframe:
    """The keyframe of a call; other values by position are those of another library."""
    if others:
        return keyframe_of((keyframe, *others))
    return keyframe_of(fields if keyframe is None and fields else keyframe)
