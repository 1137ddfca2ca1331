# SPDX-License-Identifier: MIT
"""A map's blocks in the memory of a device: all that integration reads and writes (`ti.ndarray`).

`device_process` has one for each map of its parent's, whose `BlockStore` gives out slots and keeps what
nobody adds to. A call brings in a keyframe, or takes out what it touched; nothing else is copied.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels import block_hash, device_rays, integrate, rays_from_images
from tsfusion.kernels import device_integration as kernels
from tsfusion.kernels import taichi as ti
from tsfusion.kernels.device_copies import Copies
from tsfusion.kernels.integrate import (
    CUBE,
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    TOUCHED_MISSING,
    TOUCHED_OVERFLOW,
)
from tsfusion.kernels.voxel_traversal import BAND_FIELDS, COST, RAY_FIELDS
from tsfusion.tsdf.checkpoint import LAYER_DTYPES

BANDS = 64  # those of a map on the CPU: at their ends bundles of points end
_FIRST_BLOCKS = 1024
_LISTED = 1 << 22  # updates, 16 bytes each, that a launch lists
_FEW_TOUCHED, _FEW_MISSING = 4096, 1024  # blocks whose numbers are read at once
_FEW_NEW = 256  # blocks that one thread enters into the hash: 0.2 ms on a GPU
_DTYPES = {"sums": ti.i64, "color_rgn": ti.i64, "color_b": ti.i32}


class Job(NamedTuple):
    """Task of a launch (kernels/integrate.py)."""

    which: int
    first_band: int
    end_band: int
    sign: int
    oldest: int
    stamp: int
    has_color: int


class Room(NamedTuple):
    """Limits of a keyframe: new blocks for which all memory is there, blocks touched, and Σ of what its rays
    and its new blocks cost (`integrator.KeyframeQuota`)."""

    new: int
    touched: int
    cost: int
    block_cost: int


class DeviceMap:
    """The blocks of one map, as numbered by its `BlockStore`, and the rays of its current keyframe."""

    def __init__(self, layers: tuple[str, ...], copies: Copies) -> None:
        self._layer_names = layers
        self._copies = copies
        self._count = 0
        self._layers = {name: _zeros(dtype, 1, CUBE) for name, dtype in _DTYPES.items()}
        self._stamps = _zeros(ti.i32, 1)
        self._hash_keys, self._hash_slots = _zeros(ti.i64, 4), _zeros(ti.i32, 4)
        self._touched = _zeros(ti.i32, TOUCHED_HEADER)
        self._winners, self._missing = _zeros(ti.i32, kernels.WINNERS), _zeros(ti.i64, 1)
        self._rays, self._bands = _zeros(ti.i32, 1, RAY_FIELDS), _zeros(ti.i32, BANDS, BAND_FIELDS)
        self._depths, self._tiles = _zeros(ti.i32, 1), _zeros(ti.i32, 1, device_rays.TILE_FIELDS)
        self._deferred = _zeros(ti.i32, 1)
        self._begins = np.zeros(BANDS + 1, np.int64)  # first places of bands, and the last one's end
        self._turns, self._told = 0, 0  # launches of the keyframe; touched blocks that were told of
        self._counted = np.zeros((BANDS, BAND_FIELDS), np.int32)  # the bands after the last launch
        self._list_counts = _zeros(ti.i64, kernels.COUNTS)
        self._color_votes = _zeros(ti.i32, 1, kernels.VOTE_FIELDS)
        self._listed = _zeros(ti.i32, 1, kernels.LISTED_FIELDS)
        self._reserve(_FIRST_BLOCKS)
        self._reserve_list(_LISTED)

    def make_rays(
        self, kind: str, job: tuple[int, ...] | None, room: tuple[int, ...], *arguments: Any
    ) -> tuple[NDArray[Any], ...]:
        """Make a keyframe's rays, as the kernel of this name in `kernels.device_rays` of these arguments, and
        add them, if there is a `Job`.

        Returns:
            The bands alone; or what `add` does, and whether the missing blocks are blocks of the map now, as
            there was `Room` for them, and what belongs to them was added.
        """
        rooms = self._room_for_image if kind == "rays_from_image" else self._room_for_points
        scratch = rooms(*arguments[0].shape)
        arrays = [i for i, one in enumerate(arguments) if isinstance(one, np.ndarray)]
        handed = list(arguments)
        for i, one in zip(arrays, self._copies.given(*(arguments[i] for i in arrays)), strict=True):
            handed[i] = one
        getattr(device_rays, kind)(
            *handed, *scratch, self._rays, self._bands, self._list_counts, self._touched
        )
        self._turns, self._told, self._counted = 0, 0, np.zeros((BANDS, BAND_FIELDS), np.int32)
        if job is None:
            return tuple(self._copies.read((self._bands, BANDS)))
        bands, touched, missing = self.add(job)
        has_room = self._has_room(Room(*room), bands, len(touched) - TOUCHED_HEADER, len(missing))
        if has_room:
            oldest, before = self._count, touched[TOUCHED_HEADER:].copy()
            self._count += len(missing)
            block_hash.insert_blocks(
                *self._copies.given(missing), 0, len(missing), oldest, self._hash_keys, self._hash_slots
            )
            bands, touched, _ = self.add((integrate.ONLY_DEFERRED, *job[1:4], oldest, *job[5:]))
            touched = np.concatenate([touched[:TOUCHED_HEADER], before, touched[TOUCHED_HEADER:]])
        return bands, touched, missing, np.array(has_room)

    def _has_room(self, room: Room, bands: NDArray[np.int32], touched: int, new: int) -> bool:
        """Whether there are new blocks, and they may be added at once."""
        count = self._count + new
        cost = int(bands[:, COST].sum(dtype=np.int64)) + room.block_cost * new
        return (
            0 < new <= min(room.new, _FEW_NEW)
            and count <= min(self._stamps.shape[0], self._hash_keys.shape[0] // 2)
            and touched + new <= room.touched
            and cost <= room.cost
        )

    def _room_for_image(self, height: int, width: int) -> tuple[Any, Any]:
        """Make room for an image's rays; returns the scratch arrays of its kernel."""
        tiles = rays_from_images.tiles_of(height, width)
        self._share_places(tiles, rays_from_images.TILE_SAMPLES)
        self._depths = _at_least(self._depths, ti.i32, rays_from_images.most_rays(height, width))
        self._tiles = _at_least(self._tiles, ti.i32, tiles, device_rays.TILE_FIELDS)
        return self._depths, self._tiles

    def _room_for_points(self, count: int, _: int) -> tuple[Any]:
        """Likewise for points."""
        self._share_places(count, 1)
        self._depths = _at_least(self._depths, ti.i32, count)
        return (self._depths,)

    def _share_places(self, units: int, places: int) -> None:
        """Share out units of work to the bands, each of so many places for rays."""
        self._begins = np.arange(BANDS + 1, dtype=np.int64) * units // BANDS * places
        self._rays = _at_least(self._rays, ti.i32, units * places, RAY_FIELDS)
        self._deferred = _at_least(self._deferred, ti.i32, units * places)

    def add(self, given: tuple[int, ...]) -> tuple[NDArray[Any], ...]:
        """Add rays to the map's blocks.

        Returns:
            The bands, the slots of blocks that the keyframe touches for the first time behind the header of
            all, and the keys of missing blocks, in order.
        """
        job = Job(*given)
        self._launch(job, job.first_band, job.end_band)
        bands, touched, missing = self._read_results()
        if touched[TOUCHED_OVERFLOW]:
            kernels.restore_counts(self._bands, self._counted)
            found = []
            for first, end in self._runs(bands.copy(), job.first_band, job.end_band):
                self._launch(job, first, end)
                bands, touched, missing = self._read_results()
                found.append(missing.copy())
            missing = np.concatenate(found)
        self._counted = bands.copy()
        told, self._told = self._told, int(touched[TOUCHED_COUNT])
        if told:
            touched = np.concatenate([touched[:TOUCHED_HEADER], touched[TOUCHED_HEADER + told :]])
        return bands, touched, np.unique(missing) if job.which == integrate.ALL else missing[:0]

    def _launch(self, job: Job, first: int, end: int) -> None:
        at, first_ray, end_ray = self._layers, int(self._begins[first]), int(self._begins[end])
        self._color_votes = _at_least(self._color_votes, ti.i32, end_ray - first_ray, kernels.VOTE_FIELDS)
        turn, self._turns = min(self._turns, kernels.COUNTS - 1), self._turns + 1
        if self._turns > 1 and (self._turns > kernels.COUNTS or job.which == integrate.ALL):
            kernels.begin_turn(self._touched, self._list_counts, turn)
        kernels.add_rays(
            self._rays, self._bands, self._deferred, first_ray, end_ray, job.which, *job[3:], self._hash_keys,
            self._hash_slots, self._winners, self._missing, self._stamps, self._touched, self._list_counts,
            turn, self._listed, self._color_votes, at["sums"], at["color_rgn"], at["color_b"],
        )  # fmt: skip

    def _read_results(self) -> tuple[NDArray[Any], ...]:
        """Bands, touched blocks behind their header, and keys of missing blocks, of which some may be there
        twice."""
        few = TOUCHED_HEADER + min(_FEW_TOUCHED, self._stamps.shape[0]), _FEW_MISSING
        for _ in range(2):  # the second time, if it was not all
            found = self._copies.read((self._bands, BANDS), (self._touched, few[0]), (self._missing, few[1]))
            bands, touched, missing = found
            all_ = TOUCHED_HEADER + int(touched[TOUCHED_COUNT]), int(touched[TOUCHED_MISSING])
            if all_[0] <= few[0] and all_[1] <= few[1]:
                break
            few = all_
        return bands, touched[: all_[0]], missing[: all_[1]]

    def _runs(self, bands: NDArray[np.int32], first: int, end: int) -> Iterator[tuple[int, int]]:
        """Runs of the bands whose updates fit into the list; it grows for a band that does not."""
        # what a ray costs is no less than the voxels and blocks that it crosses
        costs = np.concatenate([[0], np.cumsum(2 * bands[:, COST].astype(np.int64))])
        while first < end:
            fits = int(np.searchsorted(costs, costs[first] + _LISTED, side="right")) - 1
            last = min(max(fits, first + 1), end)
            self._reserve_list(int(costs[last] - costs[first]))
            yield first, last
            first = last

    def _reserve_list(self, updates: int) -> None:
        self._listed = _at_least(self._listed, ti.i32, updates, kernels.LISTED_FIELDS)
        self._missing = _at_least(self._missing, ti.i64, updates)

    def insert(
        self,
        count: int,
        size: int,
        places: NDArray[np.int32],
        keys: NDArray[np.int64],
        slots: NDArray[np.int32],
    ) -> None:
        """Have `count` blocks, new ones with voxels of zero; their keys and slots are at these places of the
        hash, which has `size` of them. With another size than before it is empty first."""
        self._reserve(count)
        self._count = count
        if self._hash_keys.shape[0] != size:
            self._hash_keys, self._hash_slots = _zeros(ti.i64, size), _zeros(ti.i32, size)
        if len(places):
            handed = self._copies.given(places, keys, slots)
            kernels.write_hash(*handed, self._hash_keys, self._hash_slots)
            self._copies.finish()

    def drop(self, count: int) -> None:
        """Have `count` blocks, and none of them in the hash; voxels of slots beyond become zero."""
        gone = np.arange(count, self._count, dtype=np.int32)
        for name in self._layer_names:
            if len(gone):
                rows = np.zeros((len(gone), CUBE), LAYER_DTYPES[name])
                kernels.write_rows(self._layers[name], gone, rows)
        self._count = count
        self._hash_keys.fill(0)

    def largest_weights(self) -> NDArray[np.int32]:
        """The largest weight in each touched block."""
        bounds = _zeros(ti.i32, max(self._count, 1))
        integrate.largest_weights(self._layers["sums"], self._touched, bounds)
        _, touched, _ = self._read_results()
        found: NDArray[np.int32] = bounds.to_numpy()[touched[TOUCHED_HEADER:]]
        return found

    def read(self, name: str, slots: NDArray[np.int32], rows: NDArray[Any]) -> None:
        """Copy blocks' rows of a layer."""
        kernels.read_rows(self._layers[name], slots, rows)

    def write(self, name: str, slots: NDArray[np.int32], rows: NDArray[Any]) -> None:
        """Set blocks' rows of a layer."""
        kernels.write_rows(self._layers[name], slots, rows)

    def _reserve(self, count: int) -> None:
        """Make room for so many blocks.

        Raises:
            RuntimeError: when the device has none; the map is as it was.
        """
        capacity = self._stamps.shape[0]
        if count > capacity:
            size = max(count, 2 * capacity)
            stamps, touched = _zeros(ti.i32, size), _zeros(ti.i32, TOUCHED_HEADER + size)
            layers = {name: _zeros(_DTYPES[name], size, CUBE) for name in self._layer_names}
            for here, there in ((self._stamps, stamps), (self._touched, touched)):
                kernels.move_list(here, there)
            for name, larger in layers.items():
                kernels.move_rows(self._layers[name], self._count, larger)
            self._stamps, self._touched = stamps, touched
            self._layers |= layers


def _zeros(dtype: Any, *shape: int) -> Any:
    array = ti.ndarray(dtype, shape)
    array.fill(0)
    return array


def _at_least(array: Any, dtype: Any, *shape: int) -> Any:
    """The array, or a larger one of zeros."""
    return array if array.shape[0] >= shape[0] else _zeros(dtype, *shape)
