# SPDX-License-Identifier: MIT
"""The cells of a map in the order of their keys, with the triangles of each: for those who follow the map."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh
from tsfusion.tsdf.store.block_store import CELL_STEPS, BlockStore

_X = 42  # bits of a key below x: keys of one x are a layer


@dataclass(frozen=True, eq=False)
class CellMeshes:
    """The triangles of some cells.

    Attributes:
        cells: (n, 3) int32 block coordinates, in the order of their keys.
        first_face: (n + 1,) int32: the cell in row i has the faces `first_face[i]` to `first_face[i + 1]`.
        mesh: of these cells.
    """

    cells: NDArray[np.int32]
    first_face: NDArray[np.int32]
    mesh: Mesh


def listed(store: BlockStore, first: int, most: int) -> tuple[NDArray[np.int64], int | None]:
    """The sorted keys of the map's blocks from `first` on, at most so many; where the others begin."""
    keys = store.keys[store.keys >= first]
    if len(keys) <= most:
        return np.sort(keys), None
    keys = np.sort(np.partition(keys, most)[: most + 1])
    return keys[:most], int(keys[most])


def listed_since(
    store: BlockStore,
    first: int,
    most: int,
    since: int,
    *,
    to_cells: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    reach: int,
) -> tuple[NDArray[np.int64], int | None]:
    """List cells as `listed`, only those that changes after the stamp `since` reach.

    Looked through layer by layer, so that an answer costs what lies in a few layers, not in the map.

    Args:
        to_cells: gives the keys of the cells that changes of blocks reach.
        reach: that they lie away from these, blocks; towards −x one more.
    """
    changed = store.keys[store.stamps[: store.count] > since]
    layer, low = changed >> _X, first >> _X
    is_near = layer >= low - reach
    changed, layer = changed[is_near], layer[is_near]
    if not len(changed):
        return changed, None
    place = min(most, len(layer)) - 1
    last = max(int(np.partition(layer, place)[place]), low) + reach
    cells = to_cells(changed[layer <= last + 1 + reach])
    cells = cells[(cells >= first) & (cells >> _X <= last)]
    cells = cells[store.slots_of(cells) >= 0]
    if len(cells) > most:
        return cells[:most], int(cells[most])
    return cells, (last + 1) << _X if (layer > last - reach).any() else None


def stamps_of(store: BlockStore, keys: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The stamps of the last changes to cells: of all blocks that a cell reads, and of its own block.

    Two (n,) arrays; 0 = none since the map was opened.
    """
    slots = store.slots_of((keys[:, None] + CELL_STEPS).ravel())
    stamps = np.where(slots >= 0, store.stamps[slots], 0).reshape(-1, len(CELL_STEPS))
    return stamps.max(axis=1, initial=0), stamps[:, 0]
