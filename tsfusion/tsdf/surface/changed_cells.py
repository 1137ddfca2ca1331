# SPDX-License-Identifier: MIT
"""Give followers of a growing map the cells whose triangles changed, in the order of the changes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.mesh import concatenated
from tsfusion.tsdf.store.block_store import MOST_REMOVED, cells_of, pack_keys, unpack_keys
from tsfusion.tsdf.surface.field_regularizer import around, values_of
from tsfusion.tsdf.surface.map_surface import MapSurface
from tsfusion.tsdf.surface.mesh_extraction import CellMeshes
from tsfusion.tsdf.surface.surface_layers import KeptValues

_CUBE_BITS = 3  # neighbours of a cube of 8³ cells follow each other: viewers get its triangles at once
_REFINED_SHARE = 4  # a quarter as many cells in an answer if some are refined: their values may be lost
# Bits of a cell's state. A changed block has been changed since cells were told to wait for `refine`
_REFINED, _CHANGED, _WAITING = 1, 2, 4


@dataclass(frozen=True, eq=False)
class CellChanges(CellMeshes):
    """Triangles of the cells that changed up to some number. More attributes: `CellMeshes`.

    Attributes:
        is_refined: (n,) bool: True for the surface of the map's settings, False for the raw surface.
        until: number up to which the changes are complete.
        more: True if further cells have changed since.
    """

    is_refined: NDArray[np.bool_]
    until: int
    more: bool


class ChangedCells:
    """Numbers of a map's cells: a cell gets the next number whenever its triangles change.

    No two cells have the same number. So whoever holds all cells up to one needs only the cells after it.
    A changed cell is raw until the surface of the map's settings is solved there. `refine` gives such a cell
    a number again; `since` needs not, where no follower has the raw cell.

    Attributes:
        newest: the newest number, 1 for an empty map.
        first: followers that hold an older number begin anew, with number 0.
    """

    def __init__(self, surface: MapSurface) -> None:
        self._surface, self._store = surface, surface.store
        self.newest = self.first = 1
        self._numbers = self._store.column(np.int64)
        self._states = self._store.column(np.uint8)
        self._removed = np.zeros((2, 0), np.int64)  # keys and numbers of removed cells
        self._version = -1  # of the map, up to which changes have numbers
        self._values = KeptValues(surface.view())
        self._is_raw = surface.reach() == 0  # nothing is to be refined
        self._waiting = 0  # cells that wait for `refine`
        self._is_noted = False  # some blocks are `_CHANGED`
        self._told = 0  # newest number that some follower has
        self.follow()

    def follow(self) -> None:
        """Take the blocks that have changed: the cells that read them are raw from now on.

        Call it before you read `newest` and `first`. Raises MemoryError.
        """
        store = self._store
        if self._version == store.version:
            return
        slots, removed = store.changed_since(self._version), store.removed_since(max(self._version, 0))
        if removed is None:
            self._begin_anew()
            slots, removed = np.arange(store.count), np.zeros(0, np.int64)
        keys, changed = np.append(store.keys[slots], removed), slots
        is_whole = len(slots) == store.count
        cells = _in_cubes(keys) if is_whole else pack_keys(cells_of(unpack_keys(keys)))
        if len(removed):
            changed = np.append(slots, self._slots_of(around(removed, store)))
            self._note_removed(removed)
        self._waiting = len(self._slots_in(_WAITING))  # less where such cells were removed
        self._renew(cells, is_refined=self._is_raw)
        if not self._is_raw:
            self._states.array[changed] |= _CHANGED
            self._is_noted |= len(changed) > 0
        self._version = store.version

    def _slots_of(self, keys: NDArray[np.int64]) -> NDArray[np.int32]:
        slots = self._store.slots_of(keys)
        return slots[slots >= 0]

    def _slots_in(self, state: int) -> NDArray[np.int64]:
        return np.flatnonzero(self._states.array[: self._store.count] & state)

    def refine_waits(self) -> bool:
        """True if some cells do not show the surface of the map's settings."""
        return self._is_noted or self._waiting > 0

    def refine(self, most: int) -> None:
        """Solve the surface of the map's settings in at most so many cells. Raises MemoryError."""
        self.follow()
        self._note_waiting()
        slots = self._first(self._slots_in(_WAITING), most)
        self._solve(slots)
        in_order = slots[np.argsort(self._numbers.array[slots])]
        self._renew(self._store.keys[in_order], is_refined=True)

    def _note_waiting(self) -> None:
        if not self._is_noted:
            return
        changed = self._slots_in(_CHANGED)
        reached = self._surface.values_reached(unpack_keys(self._store.keys[changed]))
        self._values.forget(reached)
        self._states.array[self._slots_of(pack_keys(cells_of(unpack_keys(reached))))] |= _WAITING
        self._states.array[changed] &= _REFINED | _WAITING
        self._is_noted = False
        self._waiting = len(self._slots_in(_WAITING))

    def _solve(self, slots: NDArray[np.int64]) -> None:
        if len(slots):
            keys = np.sort(self._store.keys[slots])
            self._values(around(keys, self._store), self._store, self._surface.min_weight(None))
            self._states.array[slots] &= _REFINED | _CHANGED
            self._waiting -= len(slots)

    def since(self, number: int, most: int, *, refine: bool = False) -> CellChanges:
        """Return the first of the cells with a later number, with their triangles now.

        Args:
            number: what the follower holds; 0 = nothing.
            most: maximum number of cells with triangles.
            refine: solve the surface of the map's settings first, in the cells that no follower has yet.
        """
        self.follow()
        if refine and self._told < self.newest:
            self._refine_untold(number, most)
        chosen, more = self._next_slots(number, most)
        is_done = self._states.array[chosen] & _REFINED != 0
        until = int(self._numbers.array[chosen].max()) if more else self.newest
        keys, numbers = self._removed
        removed = keys[(numbers > number) & (numbers <= until)] if number else keys[:0]
        removed = distinct(removed[self._store.slots_of(removed) < 0])
        raw, refined = (np.sort(self._store.keys[chosen[is_done == which]]) for which in (False, True))
        found = self._surface.mesh_cells(unpack_keys(np.append(raw, removed)), values=values_of)
        is_refined = np.zeros(len(found.cells), bool)
        if len(refined):
            values = values_of if self._is_raw else self._values
            found = _joined(found, self._surface.mesh_cells(unpack_keys(refined), values=values))
            is_refined = np.append(is_refined, np.ones(len(refined), bool))
        self._told = max(self._told, until)
        return CellChanges(found.cells, found.first_face, found.mesh, is_refined, until, more)

    def _refine_untold(self, number: int, most: int) -> None:
        self._note_waiting()
        slots = self._first(self._later(number), max(most // _REFINED_SHARE, 1))
        is_untold = self._numbers.array[slots] > self._told
        slots = slots[is_untold & (self._states.array[slots] & _WAITING != 0)]
        self._solve(slots)
        self._states.array[slots] |= _REFINED

    def _later(self, number: int) -> NDArray[np.int64]:
        return np.flatnonzero(self._numbers.array[: self._store.count] > number)

    def _next_slots(self, number: int, most: int) -> tuple[NDArray[np.int64], bool]:
        """Return the slots of the first cells after a number, and True if there are more."""
        later = self._later(number)
        chosen = self._first(later, most)
        if not self._is_raw and (self._states.array[chosen] & _REFINED).any():
            chosen = self._first(chosen, max(most // _REFINED_SHARE, 1))
        return chosen, len(chosen) < len(later)

    def _first(self, slots: NDArray[np.int64], most: int) -> NDArray[np.int64]:
        """Return at most so many of some slots: those of the lowest numbers."""
        if len(slots) <= most:
            return slots
        return slots[np.argpartition(self._numbers.array[slots], most)[:most]]

    def _renew(self, keys: NDArray[np.int64], *, is_refined: bool) -> None:
        slots = self._slots_of(keys)
        self._numbers.array[slots] = np.arange(self.newest + 1, self.newest + 1 + len(slots))
        self._states.array[slots] = self._states.array[slots] & (_CHANGED | _WAITING) | is_refined
        self.newest += len(slots)

    def _note_removed(self, keys: NDArray[np.int64]) -> None:
        numbers = np.arange(self.newest + 1, self.newest + 1 + len(keys))
        self.newest += len(keys)
        self._removed = np.concatenate([self._removed, np.stack([keys, numbers])], axis=1)
        if self._removed.shape[1] > MOST_REMOVED:
            self._begin_anew()

    def _begin_anew(self) -> None:
        """Forget the removed cells, and give all others newer numbers, in the same order."""
        numbers = self._numbers.array[: self._store.count]
        order = np.argsort(numbers)[np.count_nonzero(numbers == 0) :]
        self.first = self.newest + 1
        self._removed = self._removed[:, :0]
        numbers[order] = np.arange(self.first + 1, self.first + 1 + len(order))
        self.newest = self.first + len(order)


def _in_cubes(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return keys sorted by their cubes of cells, and by their own value in a cube."""
    return keys[np.lexsort((keys, pack_keys(unpack_keys(keys) >> _CUBE_BITS)))]


def _joined(one: CellMeshes, other: CellMeshes) -> CellMeshes:
    """Return two sets of cells, one after the other."""
    if not len(one.cells):
        return other
    first_face = np.append(one.first_face, other.first_face[1:] + one.first_face[-1])
    return CellMeshes(
        np.concatenate([one.cells, other.cells]), first_face, concatenated([one.mesh, other.mesh])
    )
