# SPDX-License-Identifier: MIT
"""Keep a map's blocks in GPU memory, and add keyframes to them (`ti.ndarray`).

`device_process` has one `DeviceMap` for each map of its parent process. The parent's `BlockStore` assigns the
slots, and keeps the layers that integration does not change. A call copies only a keyframe to the device, and
a report on the touched blocks back.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import distinct
from tsfusion.kernels import ti
from tsfusion.kernels.base.voxel_traversal import COST, RAY_FIELDS, STRIP_FIELDS, UPDATES
from tsfusion.kernels.device import device_copies, device_rays
from tsfusion.kernels.device import device_integration as kernels
from tsfusion.kernels.device.device_copies import (
    CLAIMS,
    FEW_NEW,
    FIRST_BLOCKS,
    FIRST_HASH,
    FRESH_AT,
    LACKING,
    NEW,
    STRIPS,
    STRIPS_AT,
    TOUCHED_AT,
    Copies,
)
from tsfusion.kernels.integration import integrate, rays_from_images
from tsfusion.kernels.integration.integrate import CUBE, TOUCHED_COUNT, TOUCHED_MISSING, TOUCHED_OVERFLOW
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES

_LISTED = 1 << 22  # updates that a launch lists; each takes 16 bytes
_FEW_TOUCHED = 4096  # blocks whose numbers the first copy includes
_DTYPES = {"sums": ti.i64, "color_rgn": ti.i64, "color_b": ti.i32, "hits": ti.i32}


class LaunchJob(NamedTuple):
    """Instructions for one kernel launch: which rays to add to which blocks
    (kernels/integration/integrate.py)."""

    which: int
    first_band: int
    end_band: int
    sign: int
    oldest: int
    version: int
    kind: int  # of votes


class Room(NamedTuple):
    """Limits for one keyframe on the GPU: new blocks that fit into reserved memory, touched blocks, and cost
    of rays and new blocks (`integrator.KeyframeQuota`)."""

    new: int
    touched: int
    cost: int
    block_cost: int


class DeviceMap:
    """Blocks of one map on a GPU, in the slots of its `BlockStore`, and its current keyframe's rays."""

    def __init__(self, layers: tuple[str, ...], copies: Copies) -> None:
        self._layer_names = layers
        self._copies = copies
        self._count = 0
        self._layers = {name: _zeros(dtype, 1, CUBE) for name, dtype in _DTYPES.items()}
        self._versions = _zeros(ti.i32, 1)
        self._hash_keys, self._hash_slots = _zeros(ti.i64, FIRST_HASH), _zeros(ti.i32, FIRST_HASH)
        self._told = _zeros(ti.i32, TOUCHED_AT)
        self._winners, self._missing = _zeros(ti.i32, 2 * kernels.WINNERS), _zeros(ti.i64, 1)
        self._places, self._claims = _zeros(ti.i32, FEW_NEW, 2), _zeros(ti.i32, CLAIMS)
        self._rays, self._marks = _zeros(ti.i32, 1, RAY_FIELDS), _zeros(ti.i32, 1)
        self._depths, self._tiles = _zeros(ti.i32, 1), _zeros(ti.i32, 1, device_rays.TILE_FIELDS)
        self._groups, self._totals = _zeros(ti.i32, 1, kernels.GROUP_FIELDS), _zeros(ti.i64, 2)
        self._shared = 0, 0  # units of work, and ray places per unit
        self._begins = np.zeros(STRIPS + 1, np.int64)  # first ray place of each strip, and the last end
        self._costs = np.zeros(STRIPS, np.int64)  # cost of the rays of each strip
        self._known = 0  # touched blocks that were already reported
        self._listed = _zeros(ti.i32, 1, kernels.LISTED_FIELDS)
        self._reserve(FIRST_BLOCKS)
        self._reserve_list(_LISTED)

    def fuse(
        self, kind: str, job: tuple[int, ...] | None, room: tuple[int, ...], *arguments: Any
    ) -> tuple[NDArray[Any], ...]:
        """Make a keyframe's rays with the function `kind` of `device_rays`. With a `LaunchJob`, also add them
        to the map.

        Missing blocks are then inserted if `Room` allows; `NEW` in the report counts them. Returns as `add`.
        """
        is_image = kind == "image_rays"
        kernel = device_rays.fuse_image if is_image else device_rays.fuse_points
        shape = arguments[0].shape
        scratch = self._room_for_image(*shape) if is_image else self._room_for_points(shape[0])
        limits = Room(*room)
        spare = min(self._versions.shape[0], self._hash_keys.shape[0] // 2) - self._count
        limits = limits._replace(new=min(limits.new, FEW_NEW, spare))
        count, sign, version, votes = (int(self._begins[-1]), *job[3:6:2], job[6]) if job else (0, 0, 0, 0)
        arrays = [i for i, one in enumerate(arguments) if isinstance(one, np.ndarray)]
        *given, limit = self._copies.given(*(arguments[i] for i in arrays), np.array(limits, np.int64))
        handed = list(arguments)
        for i, one in zip(arrays, given, strict=True):
            handed[i] = one
        at = self._layers
        kernel(
            *handed, *scratch, self._rays, count, votes, sign, version, self._count, limit, self._hash_keys,
            self._hash_slots, self._winners, self._missing, self._places, self._claims, self._versions,
            self._told, self._groups, self._totals, self._listed, self._marks, at["sums"], at["color_rgn"],
            at[last_layer(votes)],
        )  # fmt: skip
        self._known = 0
        told, missing = self._read_results()
        self._costs = bands_of(told)[:, COST].astype(np.int64)
        if told[NEW]:
            self._count += int(told[NEW])
        elif told[TOUCHED_OVERFLOW] and job:
            return self.add(job)
        return self._news(told, missing)

    def _room_for_image(self, height: int, width: int) -> tuple[Any, Any]:
        """Allocate memory for the rays of an image. Returns the scratch arrays of its kernel."""
        tiles = rays_from_images.tiles_of(height, width)
        self._share_places(tiles, rays_from_images.TILE_SAMPLES)
        self._depths = _at_least(self._depths, ti.i32, rays_from_images.most_rays(height, width))
        self._tiles = _at_least(self._tiles, ti.i32, tiles, device_rays.TILE_FIELDS)
        return self._depths, self._tiles

    def _room_for_points(self, count: int) -> tuple[Any]:
        self._share_places(count, 1)
        self._depths = _at_least(self._depths, ti.i32, count)
        return (self._depths,)

    def _share_places(self, units: int, places: int) -> None:
        """Assign tiles or points (`units`) to strips, and allocate `places` rays for each."""
        if (units, places) == self._shared:
            return
        self._shared = units, places
        self._begins = np.arange(STRIPS + 1, dtype=np.int64) * units // STRIPS * places
        self._rays = _at_least(self._rays, ti.i32, units * places, RAY_FIELDS)
        self._marks = _at_least(self._marks, ti.i32, units * places)
        self._groups = _at_least(
            self._groups, ti.i32, units * places // kernels.GROUP + 1, kernels.GROUP_FIELDS
        )

    def add(self, given: tuple[int, ...]) -> tuple[NDArray[Any], ...]:
        """Add the current rays to the map's blocks.

        Returns:
            Report of the launch (`device_integration`), with the slots of blocks touched for the first time.
            If blocks are missing, their keys follow in ascending order.
        """
        job = LaunchJob(*given)
        self._launch(job, job.first_band, job.end_band)
        told, missing = self._read_results()
        if told[TOUCHED_OVERFLOW]:
            found, counted = [], np.zeros((STRIPS, STRIP_FIELDS), np.int32)
            for first, end in self._runs(job.first_band, job.end_band):
                self._launch(job, first, end)
                told, missing = self._read_results()
                counted += bands_of(told)
                found.append(missing)
            missing = np.concatenate(found)
            for field in (UPDATES, LACKING):
                bands_of(told)[:, field] = counted[:, field]
        return self._news(told, missing if job.which == integrate.ALL else missing[:0])

    def _news(self, told: NDArray[np.int32], missing: NDArray[np.int64]) -> tuple[NDArray[Any], ...]:
        """Return the part of a launch's report that the host lacks, and the missing keys in order. Slots
        reported before, and unused entries for keys, are left out."""
        known, self._known = self._known, int(told[TOUCHED_COUNT])
        told = np.concatenate([told[: FRESH_AT + 2 * told[NEW]], told[TOUCHED_AT + known :]])
        return (told, distinct(missing)) if len(missing) else (told,)

    def _launch(self, job: LaunchJob, first: int, end: int) -> None:
        at, first_ray, end_ray = self._layers, int(self._begins[first]), int(self._begins[end])
        kernels.add_rays(
            self._rays, first_ray, end_ray, *job[3:], self._hash_keys, self._hash_slots, self._winners,
            self._missing, self._places, self._claims, self._versions, self._told, self._groups, self._totals,
            self._listed, self._marks, at["sums"], at["color_rgn"], at[last_layer(job.kind)],
        )  # fmt: skip

    def _read_results(self) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """Return the last launch's report `told`, and the keys of missing blocks, with duplicates."""
        size = TOUCHED_AT + min(_FEW_TOUCHED, self._versions.shape[0])
        for _ in range(2):  # the second copy is for longer reports
            (told,) = self._copies.read((self._told, size))
            all_ = TOUCHED_AT + int(told[TOUCHED_COUNT] + told[NEW])
            if all_ <= size:
                break
            size = all_
        told = told[:all_].copy()  # the copy's memory is used again
        told[TOUCHED_COUNT] += told[NEW]
        if told[NEW] or not told[TOUCHED_MISSING]:
            return told, np.empty(0, np.int64)
        (found,) = self._copies.read((self._missing, int(told[TOUCHED_MISSING])))
        return told, found.copy()

    def _runs(self, first: int, end: int) -> Iterator[tuple[int, int]]:
        """Yield runs of strips (first, end) whose updates fit into the list, which grows for large ones."""
        # The cost of a ray is at least the number of voxels that it crosses
        costs = np.concatenate([[0], np.cumsum(self._costs)])
        while first < end:
            fits = int(np.searchsorted(costs, costs[first] + _LISTED, side="right")) - 1
            last = min(max(fits, first + 1), end)
            self._reserve_list(int(costs[last] - costs[first]))
            yield first, last
            first = last

    def _reserve_list(self, updates: int) -> None:
        self._listed = _at_least(self._listed, ti.i32, updates, kernels.LISTED_FIELDS)
        self._missing = _at_least(self._missing, ti.i64, updates)

    def add_free(
        self, slots: NDArray[np.int32], amounts: NDArray[np.int64], masks: NDArray[np.int64], sign: int
    ) -> None:
        """Add free-space votes to the voxels (`masks`) that an image looks through."""
        device_copies.add_free_blocks(*self._copies.given(slots, amounts, masks), sign, self._layers["sums"])
        self._copies.finish()

    def insert(
        self,
        count: int,
        size: int,
        places: NDArray[np.int32],
        keys: NDArray[np.int64],
        slots: NDArray[np.int32],
    ) -> None:
        """Grow the map to `count` blocks with zero voxels, and write their keys and slots at `places` of the
        hash. If the hash's `size` changes, empty the hash first."""
        self._reserve(count)
        self._count = count
        if self._hash_keys.shape[0] != size:
            self._hash_keys, self._hash_slots = _zeros(ti.i64, size), _zeros(ti.i32, size)
        if len(places):
            handed = self._copies.given(places, keys, slots)
            device_copies.write_hash(*handed, self._hash_keys, self._hash_slots)
            self._copies.finish()

    def drop(self, count: int) -> None:
        """Keep the first `count` blocks, and set the voxels of other slots to zero. Empties the hash."""
        gone = np.arange(count, self._count, dtype=np.int32)
        for name in self._layer_names:
            if len(gone):
                rows = np.zeros((len(gone), CUBE), LAYER_DTYPES[name])
                device_copies.write_rows(self._layers[name], gone, rows)
        self._count = count
        self._hash_keys.fill(0)

    def largest_weights(self, slots: NDArray[np.int32]) -> NDArray[np.int32]:
        self._marks = _at_least(self._marks, ti.i32, len(slots))
        handed = self._copies.given(slots)
        device_copies.largest_weights(self._layers["sums"], *handed, len(slots), self._marks)
        (found,) = self._copies.read((self._marks, len(slots)))
        return found

    def read(self, name: str, slots: NDArray[np.int32], rows: NDArray[Any]) -> None:
        """Copy a layer's rows for the blocks in `slots` from the GPU into `rows`."""
        device_copies.read_rows(self._layers[name], slots, rows)

    def write(self, name: str, slots: NDArray[np.int32], rows: NDArray[Any]) -> None:
        device_copies.write_rows(self._layers[name], slots, rows)

    def _reserve(self, count: int) -> None:
        """Allocate memory for `count` blocks. Raises RuntimeError without memory; the map is unchanged."""
        capacity = self._versions.shape[0]
        if count > capacity:
            size = max(count, 2 * capacity)
            versions, told = _zeros(ti.i32, size), _zeros(ti.i32, TOUCHED_AT + size)
            layers = {name: _zeros(_DTYPES[name], size, CUBE) for name in self._layer_names}
            for here, there in ((self._versions, versions), (self._told, told)):
                device_copies.move_list(here, there)
            for name, larger in layers.items():
                device_copies.move_rows(self._layers[name], self._count, larger)
            self._versions, self._told = versions, told
            self._layers |= layers


def bands_of(told: NDArray[np.int32]) -> NDArray[np.int32]:
    return told[STRIPS_AT:FRESH_AT].reshape(STRIPS, STRIP_FIELDS)


def last_layer(kind: int) -> str:
    """Return the layer that this kind of votes (colour or hits) changes in addition to `color_rgn`."""
    return "hits" if kind == integrate.HIT_VOTE else "color_b"


def _zeros(dtype: Any, *shape: int) -> Any:
    array = ti.ndarray(dtype, shape)
    array.fill(0)
    return array


def _at_least(array: Any, dtype: Any, *shape: int) -> Any:
    return array if array.shape[0] >= shape[0] else _zeros(dtype, *shape)
