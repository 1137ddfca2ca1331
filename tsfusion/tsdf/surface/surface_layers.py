# SPDX-License-Identifier: MIT
"""Keep what is made of a map's blocks until a block that it depends on changes: values, meshes.

An item of a layer depends only on the map, neither on earlier questions nor on the map's history. Values and
meshes of a surface are kept in cubes of 8³ blocks. A further class keeps values block by block while the map
grows.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.mesh import Mesh
from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.tsdf.store.block_store import BlockStore, pack_keys, unpack_keys
from tsfusion.tsdf.store.growing_array import GrowingArray
from tsfusion.tsdf.surface import mesh_extraction
from tsfusion.tsdf.surface.field_regularizer import SurfaceView, around, index_of, values_of

SIDE = 8  # blocks
AT_ONCE = 16  # items that are made together: one launch for all meshes costs as much as one
MOST_BYTES = 32 << 20  # of a layer

_INSIDE = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
MOST_BLOCKS = 1 << 14  # 32 MB

Keys = NDArray[np.int64]


class _Sized(Protocol):
    @property
    def nbytes(self) -> int: ...


Item = TypeVar("Item", bound=_Sized)


class Layer(Generic[Item]):
    """Items made of a map's blocks, by number, each kept until a block changes that it depends on.

    The least recently used items are removed above a bound of bytes.

    Args:
        make: makes the items of some numbers.
        reached: returns the numbers of the items that depend on blocks, given by sorted keys, that changed or
            were removed.
    """

    def __init__(
        self,
        store: BlockStore,
        make: Callable[[Sequence[int]], Iterable[Item]],
        reached: Callable[[Keys], Keys],
        *,
        is_bounded: bool = True,
    ) -> None:
        self._store, self._make, self._reached, self._is_bounded = store, make, reached, is_bounded
        self._items: OrderedDict[int, Item] = OrderedDict()  # `~number`: the item as it was at `settle`
        self._version = store.version
        self._settled: int | None = None  # version of the map at `settle`
        self._changed: set[int] = set()  # numbers, since then
        self.nbytes = 0

    def __iter__(self) -> Iterator[int]:
        return iter(self._items)

    def of(self, numbers: Sequence[int]) -> Iterator[Item]:
        """Yield items, kept or made now, several at a time."""
        self._follow()
        for i in range(0, len(numbers), AT_ONCE):
            some = numbers[i : i + AT_ONCE]
            found = {number: self._items[number] for number in some if number in self._items}
            for number in found:
                self._items.move_to_end(number)
            lacking = [number for number in some if number not in found]
            for number, item in zip(lacking, self._make(lacking) if lacking else (), strict=True):
                found[number] = item
                self._put(number, item)
            yield from (found[number] for number in some)

    def lacking(self, numbers: Sequence[int]) -> list[int]:
        """Return the numbers of which no item is kept."""
        self._follow()
        return [number for number in numbers if number not in self._items]

    def settle(self) -> None:
        """Keep the items as they are now, also once they have become old, until the next call."""
        self._follow()
        self.forget([number for number in self._items if number < 0])
        self._settled = self._version
        self._changed.clear()

    def of_version(self, version: int, numbers: Sequence[int]) -> list[Item] | None:
        """Return items as they were in the settled `version` of the map, or None if one is no longer kept."""
        self._follow()
        old = [self._items.get(~number) for number in numbers if number in self._changed]
        kept = [item for item in old if item is not None]
        if self._settled != version or len(kept) < len(old):
            return None
        return [*kept, *self.of([number for number in numbers if number not in self._changed])]

    def forget(self, numbers: Iterable[int]) -> None:
        for number in self._items.keys() & set(numbers):
            self.nbytes -= self._items.pop(number).nbytes

    def _follow(self) -> None:
        """Remove the items that have become old; those of the settled state go first when room is needed."""
        store = self._store
        if self._version == store.version:
            return
        removed = store.removed_since(self._version)
        if removed is None:
            self.forget(list(self._items))
            self._settled = None
        else:
            changed = distinct(np.append(store.keys[store.changed_since(self._version)], removed))
            numbers = self._reached(changed).tolist()
            if self._settled is not None:
                for number in self._items.keys() & (set(numbers) - self._changed):
                    item = self._items[number]
                    self.forget([number])
                    self._put(~number, item)
                    self._items.move_to_end(~number, last=False)
                self._changed.update(numbers)
            self.forget(numbers)
        self._version = store.version

    def _put(self, number: int, item: Item) -> None:
        self._items[number] = item
        self.nbytes += item.nbytes
        while self._is_bounded and self.nbytes > MOST_BYTES and len(self._items) > 1:
            self.nbytes -= self._items.popitem(last=False)[1].nbytes


class SolvedBlocks(NamedTuple):
    """Values (n, 512) of the blocks with sorted `keys` (n,)."""

    keys: Keys
    values: NDArray[np.float32]

    @property
    def nbytes(self) -> int:
        return self.keys.nbytes + self.values.nbytes

    def of(self, keys: Keys) -> NDArray[np.float32]:
        """Return the rows of some blocks; NaN for an absent block."""
        if not len(self.keys):
            return np.full((len(keys), CUBE), np.nan, np.float32)
        at = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        rows = self.values[at]
        rows[self.keys[at] != keys] = np.nan
        return rows


class SolvedGroups:
    """A `SurfaceView` that solves blocks in fixed groups, the items of a layer.

    A group is solved as a whole: a solved value depends on the blocks that it was solved with.

    Args:
        group_of: returns the number of the group of each block, given by keys (n,).
    """

    def __init__(self, group_of: Callable[[Keys], Keys], layer: Layer[SolvedBlocks]) -> None:
        self._group_of, self.layer = group_of, layer

    def __call__(
        self,
        keys: Keys,
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        if out is None:
            out = np.empty((len(keys), CUBE), np.float32)
        order = np.argsort(groups := self._group_of(keys), kind="stable")
        cuts = np.flatnonzero(np.diff(groups[order])) + 1
        for rows in np.split(order, cuts) if len(keys) else ():
            (solved,) = self.layer.of([int(groups[rows[0]])])
            out[rows] = solved.of(keys[rows])
        return out[: len(keys)]


class SurfaceCubes:
    """Values and meshes of a surface, layers of cubes of 8³ blocks; `view` reads the values.

    `reach` is the distance, in blocks, within which sums influence a block's values.
    """

    def __init__(self, store: BlockStore, view: SurfaceView, min_weight: float, reach: int) -> None:
        self._store, self._view, self._min_weight = store, view, min_weight
        solved = Layer(store, self._solved, lambda changed: _reached(changed, store, reach))
        self._solved_groups = SolvedGroups(_cube_of, solved)
        self.values: SurfaceView = values_of if view is values_of else self._solved_groups
        self.meshes = Layer(store, self._made, lambda changed: _reached(changed, store, reach + 1))
        self._buffers = mesh_extraction.MeshBuffers()
        self._listed, self._numbers = -1, np.empty(0, np.int64)  # version of the map, numbers of its cubes

    @property
    def has_color(self) -> bool:
        return self._store.color

    @property
    def side_m(self) -> float:
        return 8 * SIDE * self._store.voxel_size

    @property
    def nbytes(self) -> int:
        return self._solved_groups.layer.nbytes + self.meshes.nbytes + self._buffers.nbytes

    def numbers(self) -> Keys:
        """Return the (n,) sorted numbers of the cubes that contain a block of the map."""
        store, removed = self._store, self._store.removed_since(self._listed)
        if removed is None or len(removed):
            self._listed, self._numbers = -1, self._numbers[:0]
        if self._listed < store.version:
            changed = store.keys[store.changed_since(self._listed)]
            self._numbers = distinct(np.append(self._numbers, _cubes_of(changed)))
        self._listed = store.version
        return self._numbers

    def _solved(self, numbers: Sequence[int]) -> Iterator[SolvedBlocks]:
        for number in numbers:
            keys = self._keys([number])[0]
            yield SolvedBlocks(keys, self._view(keys, self._store, self._min_weight))

    def _made(self, numbers: Sequence[int]) -> Iterator[Mesh]:
        """Yield the meshes of cubes, each as if made alone."""
        keys, cube_of = self._keys(numbers)
        order = np.argsort(keys)
        whole, first_face = mesh_extraction.extract_cells(
            keys[order], self._store, self._min_weight, self._buffers, self.values
        )
        cube_of = np.repeat(cube_of[order], np.diff(first_face))
        faces = np.argsort(cube_of, kind="stable")
        parts = np.split(faces, np.searchsorted(cube_of[faces], np.arange(1, len(numbers))))
        return (whole.of_faces(part) for part in parts)

    def _keys(self, numbers: Sequence[int]) -> tuple[Keys, Keys]:
        """Return the keys of the map's blocks in some cubes, sorted in each cube, and each key's cube."""
        corners = SIDE * unpack_keys(np.array(numbers))
        keys = pack_keys((corners[:, None] + _INSIDE).reshape(-1, 3))
        there = np.flatnonzero(self._store.slots_of(keys) >= 0)
        return keys[there], there // len(_INSIDE)


def _cube_of(keys: Keys) -> Keys:
    return pack_keys(unpack_keys(keys) >> 3)


def _cubes_of(keys: Keys) -> Keys:
    return distinct(_cube_of(keys))


def _reached(changed: Keys, store: BlockStore, rings: int) -> Keys:
    """Return the cubes that hold changed or removed blocks, or blocks within `rings` blocks of these."""
    return _cubes_of(np.append(changed, around(changed, store, rings)))


class KeptValues:
    """A `SurfaceView` that solves each block once, until `forget` releases it; the last ones are kept.

    A neighbour of a changed block keeps its old values if they are right to 0.01 voxel;
    `MapSurface.values_reached` lists the other neighbours. `view` reads the surface.
    """

    def __init__(self, view: SurfaceView) -> None:
        self._view = view
        self._keys, self._rows = np.zeros(0, np.int64), np.zeros(0, np.int64)  # sorted, and rows of values
        self._values = GrowingArray((CUBE,), np.float32, 0)
        self._next = 0  # row; the oldest rows are used again

    def forget(self, keys: Keys) -> None:
        """Remove the cached values of blocks, given by sorted keys; the next call solves them again."""
        self._keep_only(index_of(keys, self._keys) < 0)

    def __call__(
        self,
        keys: Keys,
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        out = np.empty((len(keys), CUBE), np.float32) if out is None else out[: len(keys)]
        at = index_of(self._keys, keys)
        lacking = at < 0
        if not lacking.all():
            np.take(self._values.array, self._rows[at], axis=0, out=out, mode="clip")
        if lacking.any():
            out[lacking] = solved = self._view(keys[lacking], store, min_weight)
            self._keep(keys[lacking], solved)
        return out

    def _keep(self, keys: Keys, solved: NDArray[np.float32]) -> None:
        if len(keys) > MOST_BLOCKS:
            return
        rows = (self._next + np.arange(len(keys))) % MOST_BLOCKS
        self._next = (self._next + len(keys)) % MOST_BLOCKS
        self._keep_only((self._rows - rows[0]) % MOST_BLOCKS >= len(keys))
        self._values.reserve(int(rows.max()) + 1)
        self._values.array[rows] = solved
        keys, rows = np.append(self._keys, keys), np.append(self._rows, rows)
        order = np.argsort(keys)
        self._keys, self._rows = keys[order], rows[order]

    def _keep_only(self, chosen: NDArray[np.bool_]) -> None:
        self._keys, self._rows = self._keys[chosen], self._rows[chosen]
