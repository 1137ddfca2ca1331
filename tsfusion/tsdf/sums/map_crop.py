# SPDX-License-Identifier: MIT
"""Copy the voxels of a map in a box into a new map (a part), and record which map it was cut from."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig
from tsfusion.tsdf.store.block_store import BlockStore, unpack_keys

PART_OF = "part_of"  # in a map's meta: `Part`
_CHUNK = 1024  # blocks per step
_MOST = 1 << 24  # voxels from the origin; no map is that large


class Part(Struct, frozen=True):
    """Position of a part (a cropped map) in the whole map that it was cut from.

    Attributes:
        whole: hash of the whole map.
        boxes: first x, y, z and last + 1 of the copied voxels; several boxes are disjoint.
    """

    whole: str
    own: str
    boxes: list[list[int]]

    def within(self, first: NDArray[np.int64], end: NDArray[np.int64], own: str) -> "Part":
        """Return the position of a part that is cut from this part by a box; `own` is its hash."""
        cut = [[*np.maximum(box[:3], first), *np.minimum(box[3:], end)] for box in self.boxes]
        return Part(self.whole, own, [list(map(int, box)) for box in cut if _overlap(box, box)])

    def is_beside(self, other: "Part") -> bool:
        """Return True if both parts belong to one whole map and share no voxel: they may be merged."""
        return self.whole == other.whole and not any(_overlap(a, b) for a in self.boxes for b in other.boxes)


Hashed = tuple[Mapping[str, Any], Callable[[], str]]  # meta of a map, and the function that hashes its sums


def parts_beside(one: Hashed, other: Hashed) -> tuple[Part, Part] | None:
    """Return the positions of two parts in their whole map, or None unless they share no voxel."""
    if PART_OF not in one[0] or PART_OF not in other[0]:
        return None
    a, b = (_part_of(meta, map_hash()) for meta, map_hash in (one, other))
    return (a, b) if a is not None and b is not None and a.is_beside(b) else None


def joined(meta: Mapping[str, Any], one: Part, other: Part, *, own: str) -> dict[str, Any]:
    """Return the `meta` of two parts joined to one; `own` is the joined map's hash."""
    part = Part(one.whole, own, one.boxes + other.boxes)
    rest = {name: value for name, value in meta.items() if name != PART_OF}
    return rest if own == one.whole else {**rest, PART_OF: msgspec.to_builtins(part)}


def cut(
    meta: Mapping[str, Any], whole: str, first: NDArray[np.int64], end: NDArray[np.int64], own: str
) -> Part:
    """Return the position of a new part, of hash `own`, in the map with hash `whole` that it is cut from."""
    if (before := _part_of(meta, whole)) is not None:
        return before.within(first, end, own)
    return Part(whole, own, [[*first.tolist(), *end.tolist()]])


def _part_of(meta: Mapping[str, Any], own: str) -> Part | None:
    """Return the position of a map in its whole map, or None if the map is no part or has changed."""
    found = msgspec.convert(meta[PART_OF], Part) if PART_OF in meta else None
    return found if found is not None and found.own == own else None


def _overlap(one: Sequence[int], other: Sequence[int]) -> bool:
    return all(one[a] < other[a + 3] and other[a] < one[a + 3] for a in range(3))


def voxel_range(box: Sequence[float], voxel_size: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the voxels whose centres lie in a box: first (3,), and last + 1 (3,). Adjacent boxes share none.

    `box` is x0, y0, z0, x1, y1, z1 in metres; a centre on the upper side is outside. Raises InvalidConfig for
    an invalid box.
    """
    corners = np.asarray(box, np.float64)
    if corners.shape != (6,) or not np.isfinite(corners).all() or (corners[:3] >= corners[3:]).any():
        raise InvalidConfig(f"a box must be x0 y0 z0 x1 y1 z1 in metres, x0 < x1 and so on, got {box}")
    edges = np.ceil(np.clip(corners / voxel_size, -_MOST, _MOST) - 0.5).astype(np.int64)
    return edges[:3], edges[3:]


def copy(store: BlockStore, into: BlockStore, first: NDArray[np.int64], end: NDArray[np.int64]) -> None:
    """Copy the voxels `first` ≤ (x, y, z) < `end` to an empty store; other voxels of the blocks stay zero.

    Raises MemoryError without room.
    """
    used = store.used()
    corners = 8 * unpack_keys(store.keys[used]).astype(np.int64)
    used = used[((corners < end) & (corners + 8 > first)).all(axis=1)]
    steps = np.arange(8)
    for i in range(0, len(used), _CHUNK):
        slots = used[i : i + _CHUNK]
        along = 8 * unpack_keys(store.keys[slots]).astype(np.int64)[:, :, None] + steps  # (n, 3, 8)
        x, y, z = ((along >= first[:, None]) & (along < end[:, None])).transpose(1, 0, 2)
        inside = (x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]).reshape(-1, 512)
        kept = (np.where(inside, store.sums[slots], 0) != 0).any(axis=1)
        slots, inside = slots[kept], inside[kept]
        here = into.count
        into.insert(store.keys[slots])
        for name, layer in into.layers().items():
            layer[here : into.count] = np.where(inside, store.layers()[name][slots], 0)
        into.note_written(np.arange(here, into.count))
        store.keep_within_memory()
    keys, counts = store.clear.counts()
    corners = 8 * unpack_keys(keys).astype(np.int64)
    whole = ((corners >= first) & (corners + 8 <= end)).all(axis=1)  # a cut block may lack its surface
    into.clear.replace((keys[whole], counts[whole]))
    into.measure_bounds()
    into.note_changed(slice(into.count))
