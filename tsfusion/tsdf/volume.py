# SPDX-License-Identifier: MIT
"""Fuse keyframes into the map: a sum of integers in sparse blocks of 8³ voxels.

A voxel holds Σ w·m and Σ w over all rays that crossed it: m is the signed distance to the surface along the
ray, as an integer, w the ray's weight. A keyframe is a list of such additions. Hence the order of keyframes
does not matter, and subtraction removes a keyframe to the last bit. Smoothed values and meshes are read from
the sums and never change them.
"""

import copy
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.core.config import (
    OTHER_NAMES_OF_SETTINGS,
    OTHER_NAMES_OF_VOLUME,
    Arch,
    CacheConfig,
    VolumeConfig,
    instead,
    make_settings,
    override,
)
from tsfusion.core.errors import InvalidConfig, MapError, OutputError
from tsfusion.geometry.keyframe import Keyframe, keyframe_of
from tsfusion.geometry.mesh import FORMATS as MESHES
from tsfusion.geometry.sample_ranges import why_no_samples
from tsfusion.geometry.up_direction import HeldSensor
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.voxel_traversal import COUNT, VOXEL_LIMIT
from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.tsdf.askable_map import AskableMap
from tsfusion.tsdf.device.device_blocks import DeviceBlocks
from tsfusion.tsdf.device.device_integrator import DeviceIntegrator, DeviceRayBuffers
from tsfusion.tsdf.device.device_trial import device_for
from tsfusion.tsdf.files import checkpoint, map_history, saved_map, voxel_arrays
from tsfusion.tsdf.files.map_history import HELD
from tsfusion.tsdf.integration.integrator import Integrator, KeyframeQuota
from tsfusion.tsdf.integration.ray_buffers import RayBuffers, keyframes_of_every_kind
from tsfusion.tsdf.readable_map import begin_hash
from tsfusion.tsdf.store import clear_blocks
from tsfusion.tsdf.store.block_store import MESHED, BlockStore, unpack_keys
from tsfusion.tsdf.store.residency import checked_cache
from tsfusion.tsdf.sums import map_addition, map_crop
from tsfusion.tsdf.sums.map_crop import Part
from tsfusion.tsdf.surface import mesh_extraction

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from tsfusion.core.config import LoadSettings, VolumeSettings
    from tsfusion.geometry.keyframe import KeyframeFields

log = logging.getLogger(__name__)
_OF_SERVERS = {  # names that completion omits
    "blocks_within", "cell_stamps", "changed_blocks", "drops", "kept_values", "load_blocks", "mesh_cells",
    "mesh_run", "most_blocks", "next_cells", "quota", "raycast_settled", "set_pause", "settle",
    "settled_stamp", "stamp", "values_reached", "warming_up", "whole_values", "why_no_samples",
}  # fmt: skip


class IntegrateStats(msgspec.Struct, frozen=True):
    """Counts of one keyframe's integration or retraction."""

    samples: int  # pixels or points with a usable return
    invalid: int  # without a return, out of range, or untrusted
    rays: int
    blocks: int  # touched
    new_blocks: int
    updates: int  # additions of rays to voxels


class VolumeStats(msgspec.Struct, frozen=True):
    """Size of the map. `bytes` counts the blocks and their hash, without `scratch_bytes`."""

    keyframes: int
    blocks: int
    voxels: int
    bytes: int
    bytes_per_block: int
    scratch_bytes: int  # working memory of rays and meshes
    resident_bytes: int  # share of `bytes` in memory: all, unless the map has `memory_bytes`


class Volume(AskableMap):
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
        super().__init__(config, store)
        self._cache = memory_bytes, cache  # for `copy`
        self.quota: KeyframeQuota | None = None  # limits of the keyframes integrated from now on
        self._has_warned = False  # True after a warning about a keyframe without samples
        self._has_retracted = False  # since `release_empty`
        self._released: list[NDArray[np.int64]] = []  # keys of released blocks whose mesh must be removed
        if memory_bytes is not None:
            self.limit_memory(memory_bytes)
        self._device = device
        self._ray_buffers, self._integrator = _writers(store, device, config)

    def __dir__(self) -> list[str]:
        return sorted(set(super().__dir__()) - _OF_SERVERS)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raise AttributeError, with the counterpart of another library's name."""
            hint = instead(name, OTHER_NAMES_OF_VOLUME, dir(type(self)))
            raise AttributeError(f"Volume has no {name}{hint}")

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
            log.warning("%s (others like it are not named)", self.why_no_samples(given))
        return stats

    def why_no_samples(self, keyframe: Keyframe) -> str:
        """Return the reason why a `keyframe` has no usable sample, and what to change, for a person."""
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
        self._check_like(other)
        if (parts := self._parts_with(other)) is not None:
            self._join(other, *parts)
            return
        if self.keyframes and other.keyframes:
            map_history.check_addable(self.meta, other.meta, same_frame=same_frame)
        if self._store.count and self._has_content_of(other):
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
        made.held, made.quota = HeldSensor(self.held.numbers), self.quota
        made._has_warned, made._has_retracted = self._has_warned, self._has_retracted
        made._released = list(self._released)
        return made

    __copy__ = copy

    def __deepcopy__(self, _known: dict[int, Any]) -> "Volume":
        return self.copy()

    def __reduce__(self) -> NoReturn:
        raise MapError("a Volume cannot be pickled: use save, and Volume.load where it is needed")

    def _parts_with(self, other: "Volume") -> tuple[Part, Part] | None:
        """Return the positions of both maps in a common whole map, or None unless they are disjoint parts of
        one map."""
        if map_crop.PART_OF not in self.meta or map_crop.PART_OF not in other.meta:
            return None
        one, two = (map_crop.part_of(each.meta, each.map_hash()) for each in (self, other))
        return (one, two) if one is not None and two is not None and one.is_beside(two) else None

    def _join(self, other: "Volume", one: Part, two: Part) -> None:
        """Add another part of the same map, with the same keyframes in both."""
        map_addition.add(self._store, other._store, self.config.max_blocks, are_parts=True)
        self.keyframes = max(self.keyframes, other.keyframes)
        own = self.map_hash()
        joined = Part(one.whole, own, one.boxes + two.boxes)
        self.meta = {**self.meta, map_crop.PART_OF: msgspec.to_builtins(joined)}
        if own == one.whole:
            del self.meta[map_crop.PART_OF]

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
        cropped.held = HeldSensor(self.held.numbers)
        cropped.meta = map_history.without_journal(self.meta)
        if most_bytes is None:  # else the part is temporary, and hashing the whole map would take longer
            whole, own = self.map_hash(), cropped.map_hash()
            before = map_crop.part_of(self.meta, whole)
            part = Part(whole, own, [[*first.tolist(), *end.tolist()]])
            part = part if before is None else before.within(first, end, own)
            cropped.meta[map_crop.PART_OF] = msgspec.to_builtins(part)
        return cropped

    def _has_content_of(self, other: "Volume") -> bool:
        """Return True if the other map has the same sums. Compares hashes only if the counts are equal."""
        counts = [(one.keyframes, one._store.count) for one in (self, other)]
        return counts[0] == counts[1] and all(
            hash_of(self) == hash_of(other) for hash_of in (Volume.map_hash, Volume.color_hash)
        )

    def _check_like(self, other: "Volume") -> None:
        """Raise MapError unless another map has these voxels and layers; it may lack counted hits."""
        self._check_voxels(other)
        ours, theirs = (set(one._store.layers()) for one in (self, other))
        if ours - theirs - {"hits"} or theirs - ours:
            names = " and ".join(", ".join(sorted(one)) for one in (ours, theirs))
            cure = "add this one to that one" if theirs - ours == {"hits"} else "fuse one anew"
            raise MapError(f"the maps have different layers, {names} (colour, smoothing along rays): {cure}")

    def take_dirty(self) -> NDArray[np.int32]:
        """Return the blocks changed since the last call: (n, 3) int32 coordinates, in units of 8 voxels."""
        blocks = self.changed_blocks()
        self._store.take_dirty(MESHED)
        self._released.clear()
        return blocks

    def changed_blocks(self) -> NDArray[np.int32]:
        """Return the blocks that the next `take_dirty` returns, without resetting their marks."""
        store = self._store
        changed = np.flatnonzero(store.dirty[: store.count] & MESHED)
        return unpack_keys(np.concatenate([store.keys[changed], *self._released]))

    def release_empty(self) -> int:
        """Remove the blocks that `retract` has left without votes. Returns their number.

        The content of the map stays the same, as after saving and loading. Later blocks reuse the memory.
        """
        if not self._has_retracted:
            return 0
        store = self._store
        empty = np.setdiff1d(np.arange(store.count), store.used(), assume_unique=True)
        self._released.append(store.keys[empty[store.dirty[empty] & MESHED != 0]])
        store.release(empty)
        self._has_retracted = False
        return len(empty)

    def stats(self) -> VolumeStats:
        """Return the counts of the map, and its exact size in bytes."""
        store = self._store
        return VolumeStats(
            keyframes=self.keyframes,
            blocks=store.count,
            voxels=store.count * CUBE,
            bytes=store.nbytes,
            bytes_per_block=store.bytes_per_block,
            scratch_bytes=self._ray_buffers.nbytes + self._reading_bytes,
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
        current.update(np.zeros((1, 3), np.int32))
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
        suffix = Path(path).suffix.lower()
        if suffix in (*MESHES, *voxel_arrays.FORMATS):
            how = "extract_mesh().save" if suffix in MESHES else "save_voxels"
            raise OutputError(f"a map is saved as .tsf, got {os.fspath(path)!r}: use {how}, or another name")
        layers = self._store.layers()
        header = checkpoint.CheckpointHeader(
            config=msgspec.structs.replace(self.config, arch="cpu"),  # the machine decides on the device
            keyframes=self.keyframes,
            map_hash="",
            meta={**(self.meta if meta is None else meta), HELD: self.held.numbers},
            layers=list(layers),
            clear=clear_blocks.encoded(self._store.clear.counts()),
        )
        used = self._store.used()
        keys, rest = self._store.keys[used], self._store.rest
        digest = begin_hash(self.config.voxel_size)
        return checkpoint.write(Path(path), header, keys, used, layers, map_digest=digest, between=rest)

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
            digest = begin_hash(header.config.voxel_size)
            saved_map.fill(store, Path(path), header, chunks, digest)
            store.clear.replace(header.clear_blocks(Path(path)))
            volume.keyframes = header.keyframes
            volume.held = HeldSensor(header.meta.pop(HELD, None))
            volume.meta = header.meta
            checkpoint.verify(Path(path), header, digest.hexdigest())
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
            halo = 1 + volume._halo
            saved_map.fill_box(volume._store, header, chunks, np.array(low) - halo, np.array(high) + halo)
            volume.held = HeldSensor(header.meta.get(HELD))
        return volume

    def blocks_within(self, low: Sequence[int], high: Sequence[int]) -> NDArray[np.int32]:
        """Return the map's blocks in a box: (n, 3) int32 coordinates, `low` ≤ (x, y, z) < `high`, (3,) block
        coordinates."""
        blocks = unpack_keys(self._store.keys)
        return blocks[((blocks >= np.array(low)) & (blocks < np.array(high))).all(axis=1)]

    def limit_memory(self, nbytes: int) -> None:
        """Set a memory limit: from now on a keyframe fails with MemoryError if the map would exceed `nbytes`.

        The map stays unchanged, even if it is already larger. Working memory is not counted. In a map with
        `memory_bytes` no keyframe fails: the coldest blocks leave memory instead.
        """
        self._store.limit(nbytes)

    def set_pause(self, pause: Callable[[], None]) -> None:
        """Call `pause` between steps that do not change the map: of meshes, hashes, saving, and before a
        keyframe's rays are added. The function may ask the map anything, but must not change the map."""
        self._store.pause = pause

    @property
    def arch(self) -> Arch:
        """Device that fuses keyframes: that of the settings, or `cpu` if the device is missing."""
        return "cpu" if self._device is None else self._device.arch

    @property
    def most_blocks(self) -> int:
        """Largest number of blocks, by the settings and by `limit_memory`."""
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
            rays=int(self._ray_buffers.bands[:, COUNT].sum()),
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
    """Return the buffers that make rays of keyframes, and the integrator that adds them to a map."""
    if device is None:
        buffers = RayBuffers(color=config.color, regularised=store.corrected)
        return buffers, Integrator(store, buffers, config)
    on_device = DeviceRayBuffers(color=config.color)
    return on_device, DeviceIntegrator(store, device, on_device, config)


def _number(value: Any) -> Any:
    """Convert a NumPy number to Python: 0.05 in float32 becomes 0.05."""
    return float(str(value)) if isinstance(value, np.floating) else value


def _keyframe(keyframe: Any, others: tuple[object, ...], fields: Mapping[str, Any]) -> Keyframe:
    """Return the keyframe of a call; further positional values are those of another library."""
    if others:
        return keyframe_of((keyframe, *others))
    return keyframe_of(fields if keyframe is None and fields else keyframe)
