# SPDX-License-Identifier: MIT
"""Cells of a map that a viewer holds: which cells of a new answer or update are newer."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh

_STEPS = np.array([1 << 42, 1 << 21, 1])  # of a cell's key, along x, y, z
_ROW = np.dtype([("key", "i8"), ("made", "i4"), ("changed", "i4"), ("is_refined", "?"), ("has_faces", "?")])


@dataclass(frozen=True, eq=False)
class SurfacePart:
    """The triangles of some cells at one state of the map. More attributes: `map_events.SurfaceUpdate`.

    Attributes:
        version: version of the newest keyframe in the map at that state.
        changed: (n,) int32: version of the last change to the cell's raw surface, or a later version.
    """

    cells: NDArray[np.int32]
    first_face: NDArray[np.int32]
    mesh: Mesh
    is_refined: bool
    clients: tuple[bytes, ...]
    client: NDArray[np.int32]
    version: int
    changed: NDArray[np.int32]

    def only(self, chosen: NDArray[np.bool_]) -> "SurfacePart":
        """Return the chosen cells alone, with their triangles. `chosen`: (n,) bool."""
        if chosen.all():
            return self
        counts = np.diff(self.first_face)
        faces = self.mesh.faces[np.repeat(chosen, counts)]
        used, places = np.unique(faces, return_inverse=True)
        colors = None if self.mesh.colors is None else self.mesh.colors[used]
        corners = places.reshape(faces.shape).astype(np.int32)
        return replace(
            self,
            cells=self.cells[chosen],
            first_face=np.append(np.int32(0), np.cumsum(counts[chosen], dtype=np.int32)),
            mesh=Mesh(self.mesh.vertices[used], corners, self.mesh.normals[used], colors),
            client=self.client[chosen],
            changed=self.changed[chosen],
        )


class HeldCells:
    """Cells that a follower holds, each with the state of the map that it comes from."""

    def __init__(self) -> None:
        self._rows = np.zeros(0, _ROW)

    def __len__(self) -> int:
        return len(self._rows)

    def take(self, part: SurfacePart) -> NDArray[np.bool_]:
        """Hold the cells of a part that are newer than the held ones. Return (n,) bool: True for these.

        A refined cell stays until its raw surface changes; until then it wins over a raw cell.
        """
        new = np.zeros(len(part.cells), _ROW)
        new["key"], new["made"], new["changed"] = keys_of(part.cells), part.version, part.changed
        new["is_refined"], new["has_faces"] = part.is_refined, np.diff(part.first_face) > 0
        at = np.searchsorted(self._rows["key"], new["key"])
        is_known = at < len(self._rows)
        is_known[is_known] = self._rows["key"][at[is_known]] == new["key"][is_known]
        is_newer = np.ones(len(new), bool)
        is_newer[is_known] = _is_newer(new[is_known], self._rows[at[is_known]])
        self._rows[at[is_known & is_newer]] = new[is_known & is_newer]
        order = np.argsort(new["key"][~is_known])
        self._rows = np.insert(self._rows, at[~is_known][order], new[~is_known][order])
        return is_newer

    def take_absent(
        self, first: NDArray[np.int32] | None, end: NDArray[np.int32] | None, part: SurfacePart
    ) -> NDArray[np.int32]:
        """Return the held cells with triangles, (n, 3), that a complete part from `first` to `end` lacks.

        These cells count as empty from now on.
        """
        keys = self._rows["key"]
        low = 0 if first is None else np.searchsorted(keys, keys_of(first[None])[0])
        high = len(keys) if end is None else np.searchsorted(keys, keys_of(end[None])[0])
        rows = self._rows[low:high]
        is_listed = np.isin(rows["key"], keys_of(part.cells))
        is_gone = rows["has_faces"] & (rows["made"] <= part.version) & ~is_listed
        rows["made"][is_gone] = rows["changed"][is_gone] = part.version
        rows["is_refined"][is_gone] = rows["has_faces"][is_gone] = False
        return _cells_of(rows["key"][is_gone])


def _is_newer(new: NDArray[np.void], held: NDArray[np.void]) -> NDArray[np.bool_]:
    same_kind = new["is_refined"] == held["is_refined"]
    other = np.where(new["is_refined"], new["made"] >= held["changed"], new["changed"] > held["made"])
    newer: NDArray[np.bool_] = np.where(same_kind, new["made"] > held["made"], other)
    return newer


def keys_of(cells: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return (n,) int64 keys of (n, 3) cells; keys sort by x, then y, then z."""
    keys: NDArray[np.int64] = cells.astype(np.int64) @ _STEPS
    return keys


def _cells_of(keys: NDArray[np.int64]) -> NDArray[np.int32]:
    half, mask = 1 << 20, (1 << 21) - 1
    biased = keys + half * int(_STEPS.sum())
    cells: NDArray[np.int64] = (np.stack([biased >> 42, biased >> 21, biased], 1) & mask) - half
    return cells.astype(np.int32)
