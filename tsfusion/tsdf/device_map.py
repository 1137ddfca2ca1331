# SPDX-License-Identifier: MIT
"""A map's blocks in the memory of a device: all that integration reads and writes (`ti.ndarray`).

`device_process` has one for each map of its parent's, whose `BlockStore` gives out slots and keeps what
nobody adds to. A call brings in a keyframe, or takes out what it touched; nothing else is copied.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels import device_integration as kernels
from tsfusion.kernels import device_rays, integrate, rays_from_images
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
        self._winners, self._missing = _zeros(ti.i32, kernels.WINNERS), _zeros(ti.i32, 3)
        self._rays, self._bands = _zeros(ti.i32, 1, RAY_FIELDS), _zeros(ti.i32, BANDS, BAND_FIELDS)
        self._depths, self._tiles = _zeros(ti.i32, 1), _zeros(ti.i32, 1, device_rays.TILE_FIELDS)
        self._deferred = _zeros(ti.i32, 1)
        self._begins = np.zeros(BANDS + 1, np.int64)  # first places of bands, and the last one's end
        self._list_counts = _zeros(ti.i64, kernels.COUNTS)
        self._color_votes = _zeros(ti.i32, 1, kernels.VOTE_FIELDS)
        self._listed = _zeros(ti.i32, 1, kernels.LISTED_FIELDS)
        self._reserve(_FIRST_BLOCKS)
        self._reserve_list(_LISTED)

    def make_rays(
        self, kind: str, job: tuple[int, ...] | None, *arguments: Any
    ) -> tuple[NDArray[np.int32], ...]:
        """Make a keyframe's rays, as the kernel of this name in `kernels.device_rays` of these arguments, and
        add them, if there is a job; returns what `add` does, or the bands alone."""
        rooms = self._room_for_image if kind == "rays_from_image" else self._room_for_points
        scratch = rooms(*arguments[0].shape)
        arrays = [i for i, one in enumerate(arguments) if isinstance(one, np.ndarray)]
        handed = list(arguments)
        for i, one in zip(arrays, self._copies.given(*(arguments[i] for i in arrays)), strict=True):
            handed[i] = one
        getattr(device_rays, kind)(*handed, *scratch, self._rays, self._bands)
        if job is not None:
            return self.add(job, begins=True)
        return tuple(self._copies.read((self._bands, BANDS)))

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

    def add(self, given: tuple[int, ...], *, begins: bool = False) -> tuple[NDArray[np.int32], ...]:
        """Add rays to the map's blocks; returns the bands, the touched blocks behind their header, and (n, 3)
        coordinates of missing blocks, of which some may be there twice.

        Args:
            given: a `Job`.
            begins: whether they are the first of their keyframe, so that no block is touched before.
        """
        job = Job(*given)
        self._launch(job, job.first_band, job.end_band, begins)
        bands, touched, missing = self._read_results(_FEW_TOUCHED, _FEW_MISSING)
        if not touched[TOUCHED_OVERFLOW]:
            return bands, touched, missing
        found = []
        for first, end in self._runs(bands, job.first_band, job.end_band):
            self._launch(job, first, end, begins and first == job.first_band)
            found.append(self._read_results(0, _FEW_MISSING)[2].copy())
        bands, touched, _ = self._read_results(_FEW_TOUCHED, 0)
        return bands, touched, np.concatenate(found)

    def _launch(self, job: Job, first: int, end: int, begins: bool) -> None:
        at, first_ray, end_ray = self._layers, int(self._begins[first]), int(self._begins[end])
        self._color_votes = _at_least(self._color_votes, ti.i32, end_ray - first_ray, kernels.VOTE_FIELDS)
        kernels.add_rays(
            self._rays, self._bands, self._deferred, first_ray, end_ray, job.which, first, end, *job[3:],
            int(begins), self._hash_keys, self._hash_slots, self._winners, self._missing, self._stamps,
            self._touched, self._list_counts, self._listed, self._color_votes, at["sums"], at["color_rgn"],
            at["color_b"],
        )  # fmt: skip

    def _read_results(self, few_touched: int, few_missing: int) -> tuple[NDArray[np.int32], ...]:
        """Bands, touched blocks behind their header, and coordinates of missing blocks: as many of the latter
        two as there are, or more than a few of them are expected."""
        end = TOUCHED_HEADER + min(few_touched, self._stamps.shape[0])
        bands, touched, missing = self._copies.read(
            (self._bands, BANDS * BAND_FIELDS), (self._touched, end), (self._missing, 3 * few_missing)
        )
        touched_end, found = TOUCHED_HEADER + int(touched[TOUCHED_COUNT]), int(touched[TOUCHED_MISSING])
        if touched_end > end or found > few_missing:
            bands, touched, missing = self._copies.read(
                (self._bands, BANDS * BAND_FIELDS), (self._touched, touched_end), (self._missing, 3 * found)
            )
        return bands.reshape(BANDS, BAND_FIELDS), touched[:touched_end], missing[: 3 * found].reshape(-1, 3)

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
        self._missing = _at_least(self._missing, ti.i32, 3 * updates)

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
        found: NDArray[np.int32] = bounds.to_numpy()
        _, touched, _ = self._read_results(_FEW_TOUCHED, 0)
        return found[touched[TOUCHED_HEADER:]]

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
