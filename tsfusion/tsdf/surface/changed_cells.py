# SPDX-License-Identifier: MIT
"""Give followers of a growing map the cells whose triangles changed, in the order of the changes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.mesh import concatenated
from tsfusion.tsdf.store.block_store import cells_of, pack_keys, unpack_keys
from tsfusion.tsdf.surface.field_regularizer import around, values_of
from tsfusion.tsdf.surface.map_surface import MapSurface
from tsfusion.tsdf.surface.mesh_extraction import CellMeshes

MOST_REMOVED = 1 << 16  # removed cells that are remembered
_CUBE_BITS = 3  # neighbours of a cube of 8³ cells follow each other: viewers get its triangles at once
_REFINED_SHARE = 4  # a quarter as many cells in an answer if some are refined: their values may be lost
_ROW = np.dtype(
    [("key", "i8"), ("number", "i8"), ("is_refined", "?"), ("is_changed", "?"), ("is_waiting", "?")],
    align=True,
)


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
        self._rows = np.zeros(0, _ROW)  # by slot
        self._removed = np.zeros((2, 0), np.int64)  # keys and numbers of removed cells
        self._drops, self._version = self._store.drops, self._store.version
        self._values = surface.kept_values()
        self._is_raw = surface.reach() == 0  # nothing is to be refined
        self._waiting = 0  # rows that wait for `refine`
        self._is_noted = False  # blocks have changed since rows were told to wait
        self._told = 0  # newest number that some follower has
        self.follow()

    def note(self) -> None:
        """Take the blocks that have changed: the cells that read them are raw from now on."""
        self.follow()
        slots = self._store.changed_since(self._version)
        self._mark(slots)
        self._renew(pack_keys(cells_of(unpack_keys(self._store.keys[slots]))), is_refined=self._is_raw)
        self._version = self._store.version

    def _mark(self, slots: NDArray[np.integer]) -> None:
        self._rows["is_changed"][slots] = True
        self._is_noted |= len(slots) > 0 and not self._is_raw

    def refine_waits(self) -> bool:
        """True if some cells do not show the surface of the map's settings."""
        return self._is_noted or self._waiting > 0

    def refine(self, most: int) -> None:
        """Solve the surface of the map's settings in at most so many cells. Raises MemoryError."""
        self.follow()
        self._note_waiting()
        slots = self._first(np.flatnonzero(self._rows["is_waiting"]), most)
        self._solve(slots)
        in_order = slots[np.argsort(self._rows["number"][slots])]
        self._renew(self._rows["key"][in_order], is_refined=True)

    def _note_waiting(self) -> None:
        if not self._is_noted:
            return
        changed = self._rows["key"][self._rows["is_changed"]]
        reached = self._surface.values_reached(unpack_keys(changed))
        self._values.forget(reached)
        slots = self._store.slots_of(pack_keys(cells_of(unpack_keys(reached))))
        self._rows["is_waiting"][slots[slots >= 0]] = True
        self._rows["is_changed"] = self._is_noted = False
        self._count_waiting()

    def _count_waiting(self) -> None:
        self._waiting = int(np.count_nonzero(self._rows["is_waiting"]))

    def _solve(self, slots: NDArray[np.int64]) -> None:
        if len(slots):
            keys = np.sort(self._rows["key"][slots])
            self._values(around(keys, self._store), self._store, self._surface.min_weight(None))
            self._rows["is_waiting"][slots] = False
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
        chosen, more = self._next_rows(number, most)
        rows = self._rows[chosen]
        until = int(rows["number"].max()) if more else self.newest
        keys, numbers = self._removed
        removed = keys[(numbers > number) & (numbers <= until)] if number else keys[:0]
        removed = distinct(removed[self._store.slots_of(removed) < 0])
        raw, refined = (np.sort(rows["key"][rows["is_refined"] == which]) for which in (False, True))
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
        later = np.flatnonzero(self._rows["number"] > number)
        slots = self._first(later, max(most // _REFINED_SHARE, 1))
        slots = slots[self._rows["is_waiting"][slots] & (self._rows["number"][slots] > self._told)]
        self._solve(slots)
        self._rows["is_refined"][slots] = True

    def _next_rows(self, number: int, most: int) -> tuple[NDArray[np.int64], bool]:
        """Return the slots of the first cells after a number, and True if there are more."""
        numbers = self._rows["number"]
        later = np.flatnonzero(numbers > number)
        chosen = self._first(later, most)
        if not self._is_raw and self._rows["is_refined"][chosen].any():
            chosen = self._first(chosen, max(most // _REFINED_SHARE, 1))
        return chosen, len(chosen) < len(later)

    def _first(self, slots: NDArray[np.int64], most: int) -> NDArray[np.int64]:
        """Return at most so many of some slots: those of the lowest numbers."""
        if len(slots) <= most:
            return slots
        return slots[np.argpartition(self._rows["number"][slots], most)[:most]]

    def _renew(self, keys: NDArray[np.int64], *, is_refined: bool) -> None:
        slots = self._store.slots_of(keys)
        slots = slots[slots >= 0]
        self._rows["number"][slots] = np.arange(self.newest + 1, self.newest + 1 + len(slots))
        self._rows["is_refined"][slots] = is_refined
        self.newest += len(slots)

    def follow(self) -> None:
        """Follow the map's blocks to their slots. Call it before you read `newest` and `first`."""
        if self._drops == self._store.drops and len(self._rows) == self._store.count:
            return
        try:
            self._follow()
        except BaseException:  # such as MemoryError: half of the rows may be right, so that all begin anew
            self._rows, self._removed = self._rows[:0], self._removed[:, :0]
            self.first = self.newest = self.newest + 1
            raise

    def _follow(self) -> None:
        store, rows = self._store, self._rows
        self._rows = np.zeros(store.count, _ROW)
        if self._drops == store.drops:
            self._rows[: len(rows)] = rows
        else:
            self._drops = store.drops
            slots = store.slots_of(np.ascontiguousarray(rows["key"]))
            self._rows[slots[slots >= 0]] = rows[slots >= 0]
            self._note_removed(removed := rows["key"][slots < 0])
            self._mark(store.slots_of(around(removed, store)))
            self._renew(pack_keys(cells_of(unpack_keys(removed))), is_refined=self._is_raw)
        self._rows["key"] = store.keys
        self._count_waiting()
        self._mark(new := np.flatnonzero(self._rows["number"] == 0))
        self._renew(_in_cubes(store.keys[new]), is_refined=self._is_raw)

    def _note_removed(self, keys: NDArray[np.int64]) -> None:
        numbers = np.arange(self.newest + 1, self.newest + 1 + len(keys))
        self.newest += len(keys)
        self._removed = np.concatenate([self._removed, np.stack([keys, numbers])], axis=1)
        if self._removed.shape[1] > MOST_REMOVED:
            self._begin_anew()

    def _begin_anew(self) -> None:
        """Forget the removed cells, and give all others newer numbers, in the same order."""
        numbers = self._rows["number"]
        order = np.argsort(numbers)[np.count_nonzero(numbers == 0) :]
        self.first = self.newest + 1
        self._removed = self._removed[:, :0]
        self._rows["number"][order] = np.arange(self.first + 1, self.first + 1 + len(order))
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
