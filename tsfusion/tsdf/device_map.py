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
from tsfusion.kernels import integrate, rays_from_images, rays_from_points
from tsfusion.kernels import taichi as ti
from tsfusion.kernels.integrate import CUBE, TOUCHED_COUNT, TOUCHED_HEADER
from tsfusion.kernels.voxel_traversal import BAND_FIELDS, COST, RAY_FIELDS, START
from tsfusion.tsdf.checkpoint import LAYER_DTYPES

POINT_BANDS = 64  # of points, at whose ends bundles end: those of a map on the CPU
_FIRST_BLOCKS = 1024
_LISTED = 1 << 22  # updates, 16 bytes each, that a launch lists
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

    def __init__(self, layers: tuple[str, ...]) -> None:
        self._layer_names = layers
        self._count = 0
        self._layers = {name: _zeros(dtype, 1, CUBE) for name, dtype in _DTYPES.items()}
        self._stamps = _zeros(ti.i32, 1)
        self._hash_keys, self._hash_slots = _zeros(ti.i64, 4), _zeros(ti.i32, 4)
        self._touched = _zeros(ti.i32, TOUCHED_HEADER)
        self._winners, self._missing = _zeros(ti.i32, kernels.WINNERS), _zeros(ti.i32, 1, 3)
        self._rays, self._bands = _zeros(ti.i32, 1, RAY_FIELDS), _zeros(ti.i32, 1, BAND_FIELDS)
        self._deferred = _zeros(ti.i32, 1)
        self._begins, self._costs = [0, 0], np.zeros(2, np.int64)  # of bands: first rays, Σ what they cost
        self._list_counts = _zeros(ti.i32, kernels.COUNTS)
        self._color_votes = _zeros(ti.i32, 1, kernels.VOTE_FIELDS)
        self._listed = _zeros(ti.i32, 1, kernels.LISTED_FIELDS)
        self._reserve(_FIRST_BLOCKS)

    def rays_of_image(self, image: NDArray[Any], *rest: Any) -> NDArray[np.int32]:
        """Make a keyframe's rays, as `rays_from_images.rays_from_image` of these arguments, a band a tile;
        returns the bands."""
        places = rays_from_images.most_rays(*image.shape)
        self._reserve_rays(places, rays_from_images.tiles_of(*image.shape))
        rays_from_images.rays_from_image(image, *rest, self._rays, self._bands)
        return self._note_bands(places)

    def rays_of_points(self, points: NDArray[np.float32], *rest: Any) -> NDArray[np.int32]:
        """Likewise as `rays_from_points.rays_from_points`."""
        self._reserve_rays(len(points), POINT_BANDS)
        rays_from_points.rays_from_points(points, *rest, self._rays, self._bands)
        return self._note_bands(len(points))

    def begin(self) -> None:
        """Empty the list of touched blocks."""
        kernels.write_list(np.zeros(TOUCHED_HEADER, np.int32), self._touched)

    def add(self, given: tuple[int, ...]) -> tuple[NDArray[np.int32], ...]:
        """Add rays to the map's blocks; returns the bands, the touched blocks behind their header, and (n, 3)
        coordinates of missing blocks, of which some may be there twice."""
        found = []
        job, at = Job(*given), self._layers
        for first, end in self._runs(job.first_band, job.end_band):
            first_ray, end_ray = self._begins[first], self._begins[end]
            self._color_votes = _at_least(self._color_votes, ti.i32, end_ray - first_ray, kernels.VOTE_FIELDS)
            kernels.add_rays(
                self._rays, self._bands, self._deferred, first_ray, end_ray, job.which, first, end,
                *job[3:], self._hash_keys, self._hash_slots, self._winners, self._missing, self._stamps,
                self._touched, self._list_counts, self._listed, self._color_votes, at["sums"],
                at["color_rgn"], at["color_b"],
            )  # fmt: skip
            if job.which == integrate.ALL:
                found.append(self._read_missing())
        missing = np.concatenate(found) if found else np.empty((0, 3), np.int32)
        return self._read_bands(), self._read_touched(), missing

    def _runs(self, first: int, end: int) -> Iterator[tuple[int, int]]:
        """Runs of the bands whose updates fit into the list; it grows for a band that does not."""
        while first < end:
            fits = int(np.searchsorted(self._costs, self._costs[first] + _LISTED, side="right")) - 1
            last = min(max(fits, first + 1), end)
            most = int(self._costs[last] - self._costs[first])
            self._listed = _at_least(self._listed, ti.i32, most, kernels.LISTED_FIELDS)
            self._missing = _at_least(self._missing, ti.i32, most, 3)
            yield first, last
            first = last

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
            kernels.write_hash(places, keys, slots, self._hash_keys, self._hash_slots)

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
        return found[self._read_touched()[TOUCHED_HEADER:]]

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

    def _reserve_rays(self, count: int, bands: int) -> None:
        self._rays = _at_least(self._rays, ti.i32, count, RAY_FIELDS)
        self._deferred = _at_least(self._deferred, ti.i32, count)
        if self._bands.shape[0] != bands:
            self._bands = _zeros(ti.i32, bands, BAND_FIELDS)

    def _note_bands(self, places: int) -> NDArray[np.int32]:
        bands = self._read_bands()
        self._begins = [*bands[:, START].tolist(), places]
        # what a ray costs is no less than the voxels and blocks that it crosses
        self._costs = np.concatenate([[0], np.cumsum(2 * bands[:, COST].astype(np.int64))])
        return bands

    def _read_bands(self) -> NDArray[np.int32]:
        found: NDArray[np.int32] = self._bands.to_numpy()
        return found

    def _read_header(self) -> NDArray[np.int32]:
        header = np.empty(TOUCHED_HEADER, np.int32)
        kernels.read_list(self._touched, TOUCHED_HEADER, header)
        return header

    def _read_missing(self) -> NDArray[np.int32]:
        counts = np.empty(kernels.COUNTS, np.int32)
        kernels.read_list(self._list_counts, kernels.COUNTS, counts)
        found = np.empty((int(counts[kernels.FOUND]), 3), np.int32)
        if len(found):
            kernels.read_table(self._missing, found)
        return found

    def _read_touched(self) -> NDArray[np.int32]:
        end = TOUCHED_HEADER + int(self._read_header()[TOUCHED_COUNT])
        found = np.empty(end, np.int32)
        kernels.read_list(self._touched, end, found)
        return found


def _zeros(dtype: Any, *shape: int) -> Any:
    array = ti.ndarray(dtype, shape)
    array.fill(0)
    return array


def _at_least(array: Any, dtype: Any, *shape: int) -> Any:
    """The array, or a larger one of zeros."""
    return array if array.shape[0] >= shape[0] else _zeros(dtype, *shape)
