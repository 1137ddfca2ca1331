# SPDX-License-Identifier: MIT
"""Compute horizontal slices of the map between two heights, and update them: occupancy and distances.

A cell is a column of samples between the heights. Its value depends only on the sums at these samples. An
update reads the cells above changed blocks again, and computes distances again within reach of these cells.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.geometry import up_direction
from tsfusion.geometry.map_grids import (
    FREE,
    OCCUPIED,
    UNSEEN,
    DistanceSlice,
    OccupancySlice,
    SliceGrid,
    blocked,
)
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import SensorPosture, Up
from tsfusion.kernels.answers import distance_transform as transform
from tsfusion.kernels.answers import point_sampling as kernels
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.tsdf.answers.distance_fields import Reach, spread
from tsfusion.tsdf.store.block_store import BlockStore, unpack_keys

MOST_CELLS = 1 << 24  # including the margin; a cell takes about 52 bytes
_MOST_SAMPLES = 1 << 12  # in one cell
_PART = 1 << 14  # cells read in one call: their blocks may have to be read from a file
_SEEN_SHARE = 0.5  # share of its samples that must be seen before a cell is free
_FARTHEST = 1 << 20  # voxels from the origin; no map is that large

Rectangle = tuple[int, int, int, int]  # first row, first column, end row, end column


def axes_of(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the slice's axes as rows, (3, 3). The first is the map's x axis seen from above, or its y axis
    if x is up. The second points to the left of the first, the third up."""
    up = up / np.linalg.norm(up)
    ahead = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    axes: NDArray[np.float64] = np.stack([ahead, np.cross(up, ahead), up]) + 0.0  # turns -0.0 into 0.0
    return axes


def level(
    given: Up | str | None, held: SensorPosture, mesh: Callable[[], Mesh], *, above_floor: bool
) -> tuple[tuple[float, float, float], float | None]:
    """Return the up direction, given or estimated, and with `above_floor` the floor's height (metres).

    Args:
        held: how the sensors were held, for the estimate; `mesh` makes the map's raw mesh, if needed.
    """
    if isinstance(given, str):
        given = up_direction.parse(given)
    if given is not None and not above_floor:
        return given.direction, None
    raw = mesh()
    up = given or up_direction.find(raw, held)
    if up is None:
        raise MapError('the up direction of this map cannot be found: give it, such as up="z" or up="-y"')
    if not above_floor:
        return up.direction, None
    floor = up_direction.floor_height(raw, up, held)
    if floor is None:
        raise MapError(
            f"no floor is found in this map: no large surface below the sensors faces up, {up.axis}; "
            "count heights from the map's origin"
        )
    return up.direction, floor


class CurrentSlice:
    """Slice that can follow the map as it changes; `Volume.current_slice` creates it.

    After `update` the slice equals a newly computed slice.
    """

    def __init__(
        self,
        store: BlockStore,
        heights: tuple[float, float],
        box: Sequence[float] | None,
        axes: NDArray[np.float64],
        *,
        resolution: float | None,
        max_distance: float,
        min_weight: float,
        carved: bool,
        floor: float | None = None,
        most_cells: int = MOST_CELLS,
    ) -> None:
        low, high = (one + (floor or 0.0) for one in _checked_heights(heights))
        self._store, self._least = store, max(1, math.ceil(min_weight * WEIGHT_ONE))
        self._carved = carved
        self._shows = store.version  # version of the map in the slice
        edge = _checked_resolution(resolution, store.voxel_size)
        self._reach = Reach(max_distance, edge)
        first, end = _cell_range(_box_around(store, axes) if box is None else box, edge)
        margin = self._reach.margin
        self._first = first - margin  # row and column of the first cell, including the margin
        self._shape = rows, columns = _checked_shape(end - first + 2 * margin, most_cells)
        self.grid = SliceGrid(
            (float(first[1] * edge), float(first[0] * edge)), edge,
            (rows - 2 * margin, columns - 2 * margin), low, high, axes, floor,
        )  # fmt: skip
        self._across = math.ceil(edge / store.voxel_size - 1e-9)
        # samples lie at most one voxel apart in height
        self._heights = max(1, math.ceil((high - low) / store.voxel_size - 1e-9))
        if self._across**2 * self._heights > _MOST_SAMPLES:
            raise InvalidConfig(
                f"a cell would have {self._across**2 * self._heights} samples (at most {_MOST_SAMPLES}): "
                "give a lower `high` or a finer resolution"
            )
        count = rows * columns
        self._values, self._seen = np.full(count, np.nan, np.float32), np.zeros(count, np.int32)
        self._marked, self._spread, self._nearest = (
            (np.empty(count, np.int32), np.full(count, transform.NONE, np.int32)) for _ in range(3)
        )
        for squared in (self._marked[0], self._spread[0], self._nearest[0]):
            squared[:] = transform.FAR
        self._offsets, self._distance = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        self._read(np.arange(count, dtype=np.int32))
        self._count((0, 0, rows, columns))

    @property
    def extent(self) -> tuple[float, float]:
        """Heights of the lowest and highest block, metres; (inf, -inf) for an empty map."""
        axis, block = self.grid.axes[2], 8 * self._store.voxel_size
        centres = (unpack_keys(self._store.keys) + 0.5) * block @ axis
        half = block / 2 * float(np.abs(axis).sum())
        return float(centres.min(initial=np.inf)) - half, float(centres.max(initial=-np.inf)) + half

    def update(self) -> bool:
        """Follow the map. Returns True if the slice changed. After an error, make a new slice."""
        runtime.check_thread()
        cells = self._changed_cells()
        if not len(cells):
            return False
        before = self._values[cells], self._seen[cells]
        self._read(cells)
        same = (self._values[cells] == before[0]) | (np.isnan(self._values[cells]) & np.isnan(before[0]))
        moved = cells[~same]
        if len(moved):
            row, column = np.divmod(moved, self._shape[1])
            self._count((int(row.min()), int(column.min()), int(row.max()) + 1, int(column.max()) + 1))
        return bool(len(moved)) or bool((self._seen[cells] != before[1]).any())

    def _changed_cells(self) -> NDArray[np.int32]:
        """Return the cells in columns with changed blocks, or with blocks that became free or not free."""
        store, version = self._store, self._shows
        self._shows = store.version
        free, removed = store.clear.changed_since(version), store.removed_since(version)
        if free is None or removed is None:  # which blocks changed is not known
            return np.arange(len(self._seen), dtype=np.int32)
        changed = np.concatenate([store.keys[store.changed_since(version)], free, removed])
        return self._cells_above(unpack_keys(changed).astype(np.float64))

    def occupancy(self) -> OccupancySlice:
        return OccupancySlice(self.grid, self._cells(), self._carved or len(self._store.clear) > 0)

    def distances(self, *, unseen_is_free: bool = False) -> DistanceSlice:
        """Return horizontal distances to surfaces. An unseen cell has distance 0 unless `unseen_is_free`."""
        cells, distance = self._cells(), self._inside(self._distance).copy()
        distance = blocked(distance, cells, unseen_is_free=unseen_is_free)
        return DistanceSlice(self.grid, distance, cells, self._reach.metres)

    def _cells(self) -> NDArray[np.int8]:
        values, seen = self._inside(self._values), self._inside(self._seen)
        cells = np.full(values.shape, UNSEEN, np.int8)
        cells[seen >= max(1.0, _SEEN_SHARE * self._heights * self._across**2)] = FREE
        cells[values <= 0.5] = OCCUPIED
        return cells

    def _inside(self, flat: NDArray[Any]) -> NDArray[Any]:
        m = self._reach.margin
        return flat.reshape(self._shape)[m:-m, m:-m]

    def _read(self, cells: NDArray[np.int32]) -> None:
        store, grid, n = self._store, self.grid, self._across
        size = store.voxel_size
        along_column, along_row = (axis * (grid.resolution / n / size) for axis in grid.axes[:2])
        along_height = grid.axes[2] * ((grid.high - grid.low) / self._heights / size)
        corner = grid.axes[2] * (grid.low / size) + (along_column + along_row + along_height) / 2
        for i in range(0, len(cells), _PART):
            part = cells[i : i + _PART]
            kernels.read_columns(
                part, self._shape[1], int(self._first[0]), int(self._first[1]), n, self._heights,
                corner, along_row, along_column, along_height, store.hash_keys, store.hash_slots,
                store.sums, store.correction, int(store.corrected), *store.ray_ends, *store.clear_blocks,
                self._least, self._values, self._seen,
            )  # fmt: skip
            store.rest()
            # the kernel works in voxels, the slice in cells
            self._values[part] *= np.float32(size / grid.resolution)

    def _cells_above(self, blocks: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return the numbers of all cells with a sample in one of the blocks, and some cells more."""
        grid, block = self.grid, 8 * self._store.voxel_size
        centres = (blocks + 0.5) * block @ grid.axes.T
        half = block / 2 * np.abs(grid.axes).sum(axis=1) + 1e-6 * block  # for rounded samples
        near = centres[(centres[:, 2] + half[2] >= grid.low) & (centres[:, 2] - half[2] <= grid.high)]
        inset = 0.5 / self._across  # of the outermost samples from the cell's edge, in cells
        corners = np.ceil((near[:, :2] - half[:2]) / grid.resolution - 1 + inset)[:, ::-1]
        side = np.floor(2 * half[1::-1] / grid.resolution + 1 - 2 * inset).astype(np.int64) + 1
        corners = np.unique(corners.astype(np.int64) - self._first, axis=0)
        corners = corners[((corners + side > 0) & (corners < self._shape)).all(axis=1)]
        reached = np.zeros(self._shape, bool)
        row, column = np.ogrid[: side[0], : side[1]]
        rows = corners[:, 0, None, None] + row
        columns = corners[:, 1, None, None] + column
        rows, columns = np.clip(rows, 0, self._shape[0] - 1), np.clip(columns, 0, self._shape[1] - 1)
        reached[rows, columns] = True
        return np.flatnonzero(reached).astype(np.int32)

    def _count(self, changed: Rectangle) -> None:
        """Compute the distances again in all cells that the changed cells can influence."""
        rows, columns = self._shape
        top, left, bottom, right = changed
        # Neighbours of changed cells can become sites, or their surface can move
        top, bottom = max(top - 1, 0), min(bottom + 1, rows)
        left, right = max(left - 1, 0), min(right + 1, columns)
        reach = self._reach.margin
        sites = self._marked[1].reshape(self._shape)[top:bottom]
        before = sites.copy()
        transform.mark_sites(self._values, rows, columns, 1, top, bottom, 1, *self._marked)
        transform.place_sites(
            self._values, (rows, columns, 1), self._marked[0], (top, bottom), (left, right), self._offsets
        )
        is_other = sites != before
        if is_other.any():  # otherwise the sites, and so the nearest sites, are unchanged
            lines = top + np.flatnonzero(is_other.any(axis=1))
            places = np.flatnonzero(is_other.any(axis=0))
            spread(
                self._marked, self._spread, (columns, 1),
                lines=(int(lines[0]), int(lines[-1]) + 1), places=(0, columns), reach=self._reach,
            )  # fmt: skip
            reached = max(int(places[0]) - reach, 0), min(int(places[-1]) + 1 + reach, columns)
            spread(
                self._spread, self._nearest, (rows, columns),
                lines=reached, places=(0, rows), reach=self._reach,
            )  # fmt: skip
        transform.measure(
            self._values, (rows, columns, 1), (0, 0, 0), (rows, columns, 1), *self._nearest,
            (max(top - reach, 0), min(bottom + reach, rows)),
            (max(left - reach, 0), min(right + reach, columns)), 1, 1, self._offsets,
            self.grid.resolution, self._reach.metres, self._distance,
        )  # fmt: skip


def _checked_heights(heights: tuple[float, float]) -> tuple[float, float]:
    low, high = float(heights[0]), float(heights[1])
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise InvalidConfig(f"a slice's heights must be low ≤ high in metres, got {low:g} and {high:g}")
    return low, high


def _checked_resolution(resolution: float | None, voxel_size: float) -> float:
    edge = voxel_size if resolution is None else float(resolution)
    if not voxel_size * (1 - 1e-9) <= edge < math.inf:
        raise InvalidConfig(f"resolution must be at least the voxel size, {voxel_size:g} m, got {resolution}")
    return edge


def _checked_shape(shape: NDArray[np.int64], most: int) -> tuple[int, int]:
    rows, columns = (int(number) for number in shape)
    if rows * columns > most:
        raise InvalidConfig(
            f"a slice of {rows} × {columns} cells, with a margin of max_distance, is too large (at most "
            f"{most} cells): give a smaller box, a coarser resolution or a smaller max_distance"
        )
    return rows, columns


def _cell_range(box: Sequence[float], edge: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first (row, column) and the end of the cells whose centres lie in a rectangle."""
    corners = np.asarray(box, np.float64)
    if corners.shape != (4,) or not np.isfinite(corners).all() or (corners[:2] >= corners[2:]).any():
        raise InvalidConfig(f"a slice's box must be u0 v0 u1 v1 in metres, u0 < u1 and v0 < v1, got {box}")
    edges = np.ceil(np.clip(corners / edge, -_FARTHEST, _FARTHEST) - 0.5).astype(np.int64)
    first, end = edges[1::-1], edges[:1:-1]
    if (first >= end).any():
        raise InvalidConfig("no cell has its centre in the slice's box: give one at least a cell wide")
    return first, end


def _box_around(store: BlockStore, axes: NDArray[np.float64]) -> list[float]:
    """Return the rectangle around all blocks that hold votes, along the slice's first two axes."""
    used = store.used()
    if not len(used):
        raise MapError("the map is empty, so no box surrounds it: give a box")
    block = 8 * store.voxel_size
    flat = (unpack_keys(store.keys[used]) + 0.5) * block @ axes[:2].T
    half = block / 2 * np.abs(axes[:2]).sum(axis=1)
    return [*(flat.min(axis=0) - half), *(flat.max(axis=0) + half)]
