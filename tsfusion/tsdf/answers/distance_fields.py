# SPDX-License-Identifier: MIT
"""Compute Euclidean distances to the map's surface, in a box or block by block.

A site is a voxel whose centre lies within half a voxel of the surface. Where the surface passes between two
neighbours, the nearer of both is a site. Sites come from the fused values, not from smoothed values, so a
distance depends only on the nearby sums. An exact transform finds the nearest site of each voxel. The signed
distance at the site then gives the surface's position within that voxel.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.geometry import point_files
from tsfusion.geometry.map_grids import FREE, OCCUPIED, UNSEEN, DistanceField
from tsfusion.kernels.answers import distance_transform as kernels
from tsfusion.kernels.integration.integrate import QUANTA_PER_VOXEL
from tsfusion.kernels.surface import surface_cells
from tsfusion.tsdf.store.block_store import BlockStore, distinct_blocks, unpack_keys
from tsfusion.tsdf.sums.map_crop import voxel_range
from tsfusion.tsdf.surface.field_regularizer import values_of

MOST_VOXELS = 1 << 27  # in one call; the computation takes 20 bytes for each
_LONGEST = 1 << 14  # voxels along an axis; their square fits the kernel's integers
_TILE = 16  # blocks; edge of the tile computed in one step for a whole map
_PART = 1 << 14  # blocks

Shape = tuple[int, int, int]
Nearest = tuple[NDArray[np.int32], NDArray[np.int32]]  # squared distance to a site, its number


class FieldBlocks(NamedTuple):
    """Blocks of a distance field: coordinates (n, 3) int32, and distances (n, 8, 8, 8) float32, metres."""

    blocks: NDArray[np.int32]
    distance: NDArray[np.float32]


class Reach:
    """Maximum distance in metres and in voxels, and the voxels around a box that its distances need."""

    def __init__(self, max_distance: float, edge: float) -> None:
        if not 0 < max_distance < math.inf:
            raise InvalidConfig(f"max_distance must be > 0 m, got {max_distance}")
        self.metres, self.voxels = float(max_distance), float(max_distance) / edge
        if self.voxels > _LONGEST / 4:
            raise InvalidConfig(
                f"max_distance {max_distance:g} m is more than {_LONGEST // 4} cells of {edge:g} m: give less"
            )
        whole = math.ceil(self.voxels)
        self.most_squared = (whole + 1) ** 2  # the surface is up to a voxel nearer than a site's centre
        self.margin = whole + 2  # its outermost voxels count as no sites, because they lack neighbours


def in_box(
    store: BlockStore,
    box: Sequence[float] | None,
    *,
    min_weight: float,
    max_distance: float = 2.0,
    subvoxel: bool = True,
) -> DistanceField:
    """Return Euclidean distances in a box (None: around the whole map). Unseen voxels get distances too."""
    size = store.voxel_size
    reach = Reach(max_distance, size)
    first, end = _bounds(store) if box is None else voxel_range(box, size)
    begin = (first - reach.margin) // 8 * 8
    shape = _checked_shape(-((end + reach.margin) // -8) * 8 - begin, whole=box is None)
    extent = _checked_shape(end - first, whole=box is None)
    values = _read(store, begin // 8, shape, min_weight)
    low = _three(first - begin)
    squared, nearest = _nearest_sites(values, shape, low, extent, reach)
    distance = np.empty(math.prod(extent), np.float32)
    kernels.measure(
        values, shape, low, extent, squared, nearest, (0, extent[0]), (0, extent[1]), int(subvoxel),
        0, np.empty((1, 3), np.float32), size, reach.metres, distance,
    )  # fmt: skip
    inside = tuple(slice(a, a + n) for a, n in zip(low, extent, strict=True))
    occupancy = occupancy_of(values.reshape(shape)[inside])
    occupancy[(occupancy == UNSEEN) & _clear(store, begin // 8, shape)[inside]] = FREE
    return DistanceField(
        origin=first.astype(np.float64) * size,
        voxel_size=size,
        distance=distance.reshape(extent),
        occupancy=occupancy,
        max_distance=reach.metres,
    )


def in_blocks(store: BlockStore, max_distance: float, min_weight: float) -> Iterator[FieldBlocks]:
    """Yield distances of the whole map, tile by tile to save memory (`Volume.distance_blocks`)."""
    reach = Reach(max_distance, store.voxel_size)
    _checked_shape(np.full(3, 8 * _TILE + 2 * (reach.margin + 8)), whole=True)
    blocks = unpack_keys(store.keys)
    rings = -(-reach.margin // 8)
    around = -(-rings // _TILE)  # tiles
    steps = np.array(list(np.ndindex((2 * around + 1,) * 3)), np.int32) - around
    own = distinct_blocks(blocks // _TILE)
    tiles = distinct_blocks((own[:, None] + steps).reshape(-1, 3))
    for tile in tiles[point_files.order_of(tiles * _TILE)]:
        first, end = tile * _TILE, (tile + 1) * _TILE
        near = blocks[((blocks >= first - rings) & (blocks < end + rings)).all(axis=1)]
        if len(near):
            first = np.maximum(first, near.min(axis=0) - rings)
            end = np.minimum(end, near.max(axis=0) + rings + 1)
            yield from _near(store, first, end, reach, min_weight)


def _near(
    store: BlockStore, first: NDArray[np.int32], end: NDArray[np.int32], reach: Reach, min_weight: float
) -> Iterator[FieldBlocks]:
    """Yield the blocks of a box (`first`, `end` in blocks) with at least one distance below the maximum."""
    edges = 8 * store.voxel_size * np.concatenate([first, end])
    field = in_box(store, edges.tolist(), min_weight=min_weight, max_distance=reach.metres)
    sides = (end - first).tolist()
    cells = field.distance.reshape(sides[0], 8, sides[1], 8, sides[2], 8).transpose(0, 2, 4, 1, 3, 5)
    places = np.argwhere((np.abs(cells) < np.float32(reach.metres)).any(axis=(3, 4, 5)))
    for i in range(0, len(places), _PART):
        part = places[i : i + _PART]
        x, y, z = part.T
        yield FieldBlocks((part + first).astype(np.int32), np.ascontiguousarray(cells[x, y, z]))


def occupancy_of(values: NDArray[np.float32]) -> NDArray[np.int8]:
    """Return the occupancy of cells by distance: occupied behind a surface, and up to half a cell before."""
    states = np.full(values.shape, UNSEEN, np.int8)
    states[values > 0.5] = FREE
    states[values <= 0.5] = OCCUPIED
    return states


def _bounds(store: BlockStore) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return first and end, in voxels, of the box around the blocks that hold votes."""
    used = store.used()
    if not len(used):
        raise MapError("the map is empty, so no box surrounds it: give a box")
    blocks = unpack_keys(store.keys[used]).astype(np.int64)
    return 8 * blocks.min(axis=0), 8 * (blocks.max(axis=0) + 1)


def _three(numbers: NDArray[np.int64]) -> Shape:
    x, y, z = (int(number) for number in numbers)
    return x, y, z


def _checked_shape(shape: NDArray[np.int64], *, whole: bool) -> Shape:
    x, y, z = sides = _three(shape)
    if min(sides) < 1:
        raise InvalidConfig("no voxel has its centre in the box: give one at least a voxel wide")
    if x * y * z > MOST_VOXELS or max(sides) > _LONGEST:
        instead = "give a box, or go through distance_blocks()" if whole else "give a smaller box"
        raise InvalidConfig(
            f"{x} × {y} × {z} voxels, with a margin of max_distance, are too many (at most {MOST_VOXELS}, "
            f"and {_LONGEST} along an axis): {instead}, or a smaller max_distance"
        )
    return sides


def _read(
    store: BlockStore, first: NDArray[np.int64], shape: Shape, min_weight: float
) -> NDArray[np.float32]:
    """Return signed distances along rays, voxels, in a box of whole blocks (flat array); NaN where unseen."""
    coordinates = unpack_keys(store.keys).astype(np.int64) - first
    count = np.array(shape) // 8
    inside = ((coordinates >= 0) & (coordinates < count)).all(axis=1)
    keys, places = store.keys[inside], coordinates[inside]
    order = np.argsort(keys)
    keys, places = keys[order], places[order]
    grid = np.full((count[0], 8, count[1], 8, count[2], 8), np.nan, np.float32)
    for i in range(0, len(keys), _PART):
        x, y, z = places[i : i + _PART].T
        part = values_of(keys[i : i + _PART], store, min_weight) / np.float32(QUANTA_PER_VOXEL)
        surface_cells.hold_hits(store.slots_of(keys[i : i + _PART]), *store.ray_ends, part)
        grid[x, :, y, :, z] = part.reshape(-1, 8, 8, 8)
    return grid.reshape(-1)


def _clear(store: BlockStore, first: NDArray[np.int64], shape: Shape) -> NDArray[np.bool_]:
    """Return a mask of the voxels that lie in wholly free blocks, for a box of whole blocks."""
    keys, counts = store.clear.counts()
    found, places = np.zeros([side // 8 for side in shape], bool), unpack_keys(keys) - first
    inside = ((places >= 0) & (places < found.shape)).all(axis=1) & (counts > 0)
    slots = store.slots_of(keys[inside])
    shown = (slots >= 0) & (store.clear_blocks[0][slots] > 0)
    found[tuple(places[inside][~shown].T)] = True
    return found.repeat(8, axis=0).repeat(8, axis=1).repeat(8, axis=2)


def _nearest_sites(
    values: NDArray[np.float32], shape: Shape, low: Shape, extent: Shape, reach: Reach
) -> Nearest:
    found = np.empty(values.size, np.int32), np.empty(values.size, np.int32)
    kernels.mark_sites(values, *shape, 0, shape[0], 0, *found)
    sides = list(shape)
    # The axis that leaves the fewest lines goes first: for a slice, the axis across the slice
    for axis in sorted(range(3), key=lambda a: extent[a] / shape[a]):
        length, inner = sides[axis], math.prod(sides[axis + 1 :])
        sides[axis] = extent[axis]
        size = math.prod(sides)
        into = np.empty(size, np.int32), np.empty(size, np.int32)
        lines = (0, size // extent[axis])
        places = (low[axis], low[axis] + extent[axis])
        found = spread(found, into, (length, inner), lines=lines, places=places, reach=reach)
    return found


def spread(
    found: Nearest,
    into: Nearest,
    line: tuple[int, int],
    *,
    lines: tuple[int, int],
    places: tuple[int, int],
    reach: Reach,
) -> Nearest:
    """Extend the search for the nearest site along one axis of the grid, for the output range `places`.
    `line` is (length, inner), the grid's layout (…, length, inner). Returns `into`."""
    stack = np.empty((kernels.STRIPS, line[0], 2), np.int32)
    kernels.spread_along_lines(*found, *line, *lines, *places, reach.most_squared, stack, *into)
    return into
