# SPDX-License-Identifier: MIT
"""Cache values and meshes of a surface in cubes of 8³ blocks until the map changes, for later questions.

The content of a cube depends only on the map, neither on earlier questions nor on the map's history. While
the map changes, the last complete view stays available until a newer view is complete: the old meshes of
changed cubes are kept in addition to the new ones. A second class keeps values block by block while the map
grows.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.mesh import Mesh
from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.tsdf.store.block_store import BlockStore, pack_keys, unpack_keys
from tsfusion.tsdf.store.growing_array import GrowingArray
from tsfusion.tsdf.surface import field_regularizer, mesh_extraction
from tsfusion.tsdf.surface.field_regularizer import SurfaceView, values_of

SIDE = 8  # blocks
AT_ONCE = 16  # cubes that are meshed together
MOST_BYTES = 32 << 20  # for kept values, for meshes, and for meshes before a change

_INSIDE = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
MOST_BLOCKS = 1 << 14  # 32 MB


class SolvedGroups:
    """A `SurfaceView` that solves blocks in fixed groups, and keeps the groups that were read last.

    A group is solved as a whole: a solved value depends on the blocks that it was solved with.

    Args:
        view: reads the surface.
        group_of: returns the number of the group of each block, given by keys (n,).
        keys_of: returns the sorted keys of the blocks in a group.
        is_bounded: keep at most `MOST_BYTES`.
    """

    def __init__(
        self,
        view: SurfaceView,
        group_of: Callable[[NDArray[np.int64]], NDArray[np.int64]],
        keys_of: Callable[[int], NDArray[np.int64]],
        *,
        is_bounded: bool = True,
    ) -> None:
        self._view, self._group_of, self._keys_of = view, group_of, keys_of
        self.kept = _Kept[_Values](is_bounded=is_bounded)

    def __call__(
        self,
        keys: NDArray[np.int64],
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        if out is None:
            out = np.empty((len(keys), CUBE), np.float32)
        order = np.argsort(groups := self._group_of(keys), kind="stable")
        cuts = np.flatnonzero(np.diff(groups[order])) + 1
        for rows in np.split(order, cuts) if len(keys) else ():
            number = int(groups[rows[0]])
            solved = self.kept.get(number)
            if solved is None:
                own = self._keys_of(number)
                solved = self.kept.put(number, _Values(own, self._view(own, store, min_weight)))
            out[rows] = solved.of(keys[rows])
        return out[: len(keys)]


class _ShownState:
    """Map at its last complete view: version, cubes in view, all cubes (`there`), and old meshes."""

    def __init__(self, version: int, shown: list[int], there: NDArray[np.int64]) -> None:
        self.version, self.shown, self.there = version, shown, frozenset(there.tolist())
        self.before: dict[int, _CubeMesh | None] = {}  # cubes changed since, with their meshes if kept
        self.lacking: list[int] | None = None  # cubes to mesh before the next complete state

    @property
    def nbytes(self) -> int:
        return sum(piece.nbytes for piece in self.before.values() if piece is not None)


class SurfaceTiles:
    """Cache of a surface's values and meshes, for cubes of 8³ blocks; `view` reads the values.

    `reach` is the distance, in blocks, within which sums influence a block's values.
    """

    def __init__(self, store: BlockStore, view: SurfaceView, min_weight: float, reach: int) -> None:
        self._store, self._view, self._min_weight, self._reach = store, view, min_weight, reach
        self._values = SolvedGroups(view, _tile_of, lambda number: self._keys([number])[0])
        self._meshes = _Kept[_CubeMesh]()
        self._buffers = mesh_extraction.MeshBuffers()
        self._listed, self._numbers = 0, np.empty(0, np.int64)
        self._drops = store.drops
        self._state: _ShownState | None = None

    @property
    def values(self) -> SurfaceView:
        return values_of if self._view is values_of else self._values

    @property
    def has_color(self) -> bool:
        return self._store.color

    @property
    def side_m(self) -> float:
        return 8 * SIDE * self._store.voxel_size

    @property
    def nbytes(self) -> int:
        before = 0 if self._state is None else self._state.nbytes
        return self._values.kept.nbytes + self._meshes.nbytes + before + self._buffers.nbytes

    @property
    def settled(self) -> int | None:
        """Map version of the last complete view whose meshes are all kept; None if there is none."""
        return None if self._state is None else self._state.version

    def forget(self, changed: NDArray[np.int64]) -> None:
        """Remove cached values and meshes that depend on the changed blocks, given as sorted keys."""
        if self._drops != self._store.drops:  # blocks were removed
            self._drops = self._store.drops
            self._values.kept.clear()
            self._meshes.clear()
            self._listed, self._numbers = 0, self._numbers[:0]
            self._state = None
        elif len(changed):
            reached = field_regularizer.around(changed, self._store, self._reach)
            self._values.kept.forget(_tiles_of(reached).tolist())
            others = _tiles_of(field_regularizer.around(reached, self._store, 1)).tolist()
            self._keep_before(others)
            self._meshes.forget(others)

    def _keep_before(self, numbers: list[int]) -> None:
        if (state := self._state) is None:
            return
        state.before = {number: self._meshes.get(number) for number in numbers} | state.before
        state.lacking = None
        if state.nbytes > MOST_BYTES:
            self._state = None  # too much has changed since the last complete view

    def settle(self, numbers: Sequence[int]) -> None:
        """Record that a view made from the cubes `numbers` is complete for the current map."""
        self._state = _ShownState(self._store.version, list(numbers), self.numbers())

    def settle_some(self, most: int) -> bool:
        """Mesh up to `most` changed cubes of the last view. Returns True if it is complete again."""
        if (state := self._state) is None:
            return False
        if state.lacking is None:  # a mesh that does not fit into the kept ones is made once
            state.lacking = [number for number in state.shown if self._meshes.get(number) is None]
        for _ in self.meshes(state.lacking[:most]):
            pass
        state.lacking = state.lacking[most:]
        if is_done := not state.lacking:
            self.settle(state.shown)
        return is_done

    def settled_meshes(self, numbers: Sequence[int]) -> list[Mesh] | None:
        """Return meshes of some cubes at the last complete view, or None if one is no longer kept."""
        if (state := self._state) is None:
            return None
        there = sorted(state.there.intersection(numbers))
        old = [state.before[number] for number in there if number in state.before]
        kept = [piece.mesh for piece in old if piece is not None]
        if len(kept) < len(old):
            return None
        return [*kept, *self.meshes([number for number in there if number not in state.before])]

    def numbers(self) -> NDArray[np.int64]:
        """Return the (n,) sorted numbers of the cubes that contain a block of the map."""
        if self._listed < self._store.count:  # new blocks have the last slots
            new = _tiles_of(self._store.keys[self._listed :])
            self._numbers = distinct(np.append(self._numbers, new))
            self._listed = self._store.count
        return self._numbers

    def meshes(self, numbers: Sequence[int]) -> Iterator[Mesh]:
        """Yield the meshes of some cubes, from the cache or made now, several at a time."""
        for i in range(0, len(numbers), AT_ONCE):
            some = numbers[i : i + AT_ONCE]
            pieces = {number: self._meshes.get(number) for number in some}
            made = self._made([number for number, piece in pieces.items() if piece is None])
            for number in some:
                yield (pieces[number] or made[number]).mesh

    def _made(self, numbers: list[int]) -> dict[int, "_CubeMesh"]:
        """Make and cache the meshes of cubes, each as if alone; one launch for all costs as much as one."""
        if not numbers:
            return {}
        keys, cube_of = self._keys(numbers)
        order = np.argsort(keys)
        whole, first_face = mesh_extraction.extract_cells(
            keys[order], self._store, self._min_weight, self._buffers, self.values
        )
        cube_of = np.repeat(cube_of[order], np.diff(first_face))
        faces = np.argsort(cube_of, kind="stable")
        parts = np.split(faces, np.searchsorted(cube_of[faces], np.arange(1, len(numbers))))
        return {
            number: self._meshes.put(number, _CubeMesh(whole.of_faces(part)))
            for number, part in zip(numbers, parts, strict=True)
        }

    def _keys(self, numbers: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the keys of the map's blocks in some cubes, sorted in each cube, and each key's cube."""
        corners = SIDE * unpack_keys(np.array(numbers))
        keys = pack_keys((corners[:, None] + _INSIDE).reshape(-1, 3))
        there = np.flatnonzero(self._store.slots_of(keys) >= 0)
        return keys[there], there // len(_INSIDE)


class _Sized(Protocol):
    nbytes: int


class _Values:
    def __init__(self, keys: NDArray[np.int64], values: NDArray[np.float32]) -> None:
        self.keys, self.values = keys, values
        self.nbytes = keys.nbytes + values.nbytes

    def of(self, keys: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the cached rows of some blocks; NaN for an absent block."""
        if not len(self.keys):
            return np.full((len(keys), CUBE), np.nan, np.float32)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        rows = self.values[at]
        rows[self.keys[at] != keys] = np.nan
        return rows


class _CubeMesh:
    def __init__(self, mesh: Mesh) -> None:
        self.mesh, self.nbytes = mesh, mesh.nbytes


Item = TypeVar("Item", bound=_Sized)


class _Kept(Generic[Item]):
    """Cache of items by number; the least recently used items are removed above a limit of bytes."""

    def __init__(self, *, is_bounded: bool = True) -> None:
        self._items: OrderedDict[int, Item] = OrderedDict()
        self._is_bounded = is_bounded
        self.nbytes = 0

    def __iter__(self) -> Iterator[int]:
        return iter(self._items)

    def get(self, number: int) -> Item | None:
        if number in self._items:
            self._items.move_to_end(number)
        return self._items.get(number)

    def put(self, number: int, item: Item) -> Item:
        self._items[number] = item
        self.nbytes += item.nbytes
        while self._is_bounded and self.nbytes > MOST_BYTES and len(self._items) > 1:
            self.nbytes -= self._items.popitem(last=False)[1].nbytes
        return item

    def forget(self, numbers: Iterable[int]) -> None:
        for number in self._items.keys() & set(numbers):
            self.nbytes -= self._items.pop(number).nbytes

    def clear(self) -> None:
        self._items.clear()
        self.nbytes = 0


def _tile_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    return pack_keys(unpack_keys(keys) >> 3)


def _tiles_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    return distinct(_tile_of(keys))


class KeptValues:
    """A `SurfaceView` that solves each block once, until `forget` releases it.

    A neighbour of a changed block keeps its old values if they are right to 0.01 voxel;
    `MapSurface.values_reached` lists the other neighbours. `view` reads the surface.
    """

    def __init__(self, store: BlockStore, view: SurfaceView) -> None:
        self._store, self._view = store, view
        self._values = GrowingArray((CUBE,), np.float32, 0)
        self.clear()

    def clear(self) -> None:
        self._drops = self._store.drops
        self._rows = np.zeros(0, np.int32)  # row for each slot of the map
        self._free = np.arange(MOST_BLOCKS, dtype=np.int32)[::-1]
        self._values = GrowingArray((CUBE,), np.float32, 0)

    def forget(self, keys: NDArray[np.int64]) -> None:
        """Remove the cached values of these blocks; the next call solves them again."""
        if self._drops != self._store.drops:  # blocks have moved to other slots
            self.clear()
        slots = self._store.slots_of(keys)
        slots = slots[(slots >= 0) & (slots < len(self._rows))]
        rows = self._rows[slots]
        self._rows[slots] = -1
        self._free = np.concatenate([self._free, rows[rows >= 0]])

    def __call__(
        self,
        keys: NDArray[np.int64],
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        out = np.empty((len(keys), CUBE), np.float32) if out is None else out[: len(keys)]
        self.forget(keys[:0])
        slots = store.slots_of(keys)
        more = store.count - len(self._rows)
        self._rows = np.concatenate([self._rows, np.full(max(more, 0), -1, np.int32)])
        rows = np.where(slots >= 0, self._rows[slots], -1)
        lacking = rows < 0
        if not lacking.all():
            np.take(self._values.array, rows, axis=0, out=out, mode="clip")
        if lacking.any():
            solved = self._view(keys[lacking], store, min_weight)
            out[lacking] = solved
            self._keep(slots[lacking], solved)
        return out

    def _keep(self, slots: NDArray[np.int32], solved: NDArray[np.float32]) -> None:
        """Cache values of blocks; if the cache is full, remove all earlier values first."""
        count = len(slots)
        if (slots < 0).any() or count > MOST_BLOCKS:
            return
        if count > len(self._free):
            known = len(self._rows)
            self.clear()
            self._rows = np.full(known, -1, np.int32)
        self._free, taken = self._free[: len(self._free) - count], self._free[len(self._free) - count :]
        self._values.reserve(int(taken.max(initial=-1)) + 1)
        self._values.array[taken] = solved
        self._rows[slots] = taken
