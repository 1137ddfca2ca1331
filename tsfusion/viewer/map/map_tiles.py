# SPDX-License-Identifier: MIT
"""Store the shown surface of a map in tiles (cubes of blocks), with the newest triangles of each cell."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh, concatenated
from tsfusion.geometry.up_direction import Up
from tsfusion.wire.asking.followed_map import SurfaceUpdate

CELL = 8  # voxels along a cell's edge
# Cells along a tile's edge. A million triangles are 173 tiles, 80 MB of a browser's heap and 0.24 s of CPU;
# with 4 cells 674 tiles, 129 MB and 0.46 s. A small change sends twice as many bytes with 8 as with 4.
EDGE = 8
GREY = 190  # of a surface without a seen colour
CellKey = tuple[int, int, int]
_STEPS = np.array([1 << 42, 1 << 21, 1])  # of a cell's key, along x, y, z


@dataclass(frozen=True, eq=False)
class Tile:
    """Triangles of the cells of one cube. A tile never changes: new triangles make a new tile.

    Attributes:
        mesh: mesh with colours and without guesses.
        cell: (m,) int16 number of each face's cell in the tile.
        changed_s: (EDGE³,) float32 time of each cell's last change.
        client: (EDGE³,) int32 last client that saw each cell, an index of `MapTiles.clients`; −1 = unknown.
    """

    mesh: Mesh
    cell: NDArray[np.int16]
    changed_s: NDArray[np.float32]
    client: NDArray[np.int32]

    @cached_property
    def bounds(self) -> NDArray[np.float32]:
        """Lowest and highest coordinates of the tile's triangles, (2, 3), metres."""
        axes = np.ascontiguousarray(self.mesh.vertices.T)  # three times faster than along rows of three
        return np.stack((axes.min(axis=1), axes.max(axis=1)))

    @cached_property
    def cell_of_vertex(self) -> NDArray[np.int16]:
        """(n,) number of one cell of the tile that uses each vertex."""
        found = np.zeros(len(self.mesh.vertices), np.int16)
        found[self.mesh.faces] = self.cell[:, None]
        return found


class MapTiles:
    """Tiles of a shown map, by their position in the grid of tiles.

    Attributes:
        clients: sessions that saw cells, in order of appearance.
        version: number of changes.
    """

    def __init__(self, edge: int = EDGE) -> None:
        self.edge = edge
        self.tiles: dict[CellKey, Tile] = {}
        self.clients: list[bytes] = []
        self.has_colors = False
        self.version = 0

    @property
    def triangles(self) -> int:
        return sum(len(tile.mesh.faces) for tile in list(self.tiles.values()))

    def clear(self) -> None:
        self.__init__(self.edge)  # type: ignore[misc]

    def apply(self, updates: Sequence[SurfaceUpdate], now_s: float) -> set[CellKey]:
        """Replace cells by the triangles of updates, oldest first; return the positions of changed tiles.

        A scanner at rest changes the same cells with each keyframe: only the newest version is used.
        """
        self.has_colors |= any(update.mesh.colors is not None for update in updates)
        self.version += 1
        clients = [self._numbered(update) for update in updates]
        rows_of = _newest_rows(updates)
        mesh, first_face, counts = _as_one(updates, rows_of)
        cells = np.concatenate([update.cells[rows] for update, rows in zip(updates, rows_of, strict=True)])
        client = np.concatenate([one[rows] for one, rows in zip(clients, rows_of, strict=True)])
        place = cells // self.edge
        local = ((cells - place * self.edge) @ (self.edge**2, self.edge, 1)).astype(np.int16)
        _, first_of, tile_of = np.unique(_keys_of(place), return_index=True, return_inverse=True)
        places = place[first_of]
        order = np.argsort(tile_of, kind="stable")
        ends = np.searchsorted(tile_of[order], np.arange(len(places) + 1))
        changed = set()
        for number, at in enumerate(places.tolist()):
            rows = order[ends[number] : ends[number + 1]]
            faces = _ranges(first_face[rows], counts[rows])
            part = _TileUpdate(local[rows], client[rows], np.repeat(local[rows], counts[rows]), mesh, faces)
            self._put((at[0], at[1], at[2]), part, now_s)
            changed.add((at[0], at[1], at[2]))
        return changed

    def _put(self, key: CellKey, part: "_TileUpdate", now_s: float) -> None:
        old = self.tiles.get(key)
        if old is None:
            changed_s = np.zeros(self.edge**3, np.float32)
            client = np.full(self.edge**3, -1, np.int32)
        else:
            changed_s, client = old.changed_s.copy(), old.client.copy()
        changed_s[part.cells], client[part.cells] = now_s, part.client
        mesh, cell = part.mesh(), part.cell
        if old is not None:
            replaced = np.zeros(self.edge**3, bool)
            replaced[part.cells] = True
            kept = ~replaced[old.cell]
            if kept.any():
                mesh = concatenated((old.mesh if kept.all() else old.mesh.of_faces(kept), mesh))
                cell = np.concatenate((old.cell[kept], cell))
        if len(cell):
            self.tiles[key] = Tile(mesh, cell, changed_s, client)
        elif old is not None:
            del self.tiles[key]

    def _numbered(self, update: SurfaceUpdate) -> NDArray[np.int32]:
        """Return for each cell of an update the client that saw it last, (n,) indices of `clients`."""
        if update.client is None:
            return np.full(len(update.cells), -1, np.int32)
        for session in update.clients:
            if session not in self.clients:
                self.clients.append(session)
        numbers = np.array([*map(self.clients.index, update.clients), -1], np.int32)
        return numbers[update.client]


@dataclass(frozen=True, eq=False)
class _TileUpdate:
    """New triangles for one tile: its cells, their clients, each face's cell, and faces' rows in `whole`."""

    cells: NDArray[np.int16]
    client: NDArray[np.int32]
    cell: NDArray[np.int16]
    whole: Mesh
    faces: NDArray[np.int64]

    def mesh(self) -> Mesh:
        return self.whole.of_faces(self.faces)


def _newest_rows(updates: Sequence[SurfaceUpdate]) -> list[NDArray[np.int64]]:
    """Return for each update the rows of its cells that no later update replaces."""
    keys = np.concatenate([_keys_of(update.cells) for update in updates])
    if len(updates) == 1:
        return [np.arange(len(keys))]
    _, last = np.unique(keys[::-1], return_index=True)
    newest = np.sort(len(keys) - 1 - last)
    begins = np.cumsum([0, *(len(update.cells) for update in updates)])
    ends = np.searchsorted(newest, begins)
    return [newest[ends[i] : ends[i + 1]] - begins[i] for i in range(len(updates))]


def _as_one(
    updates: Sequence[SurfaceUpdate], rows_of: Sequence[NDArray[np.int64]]
) -> tuple[Mesh, NDArray[np.int64], NDArray[np.int64]]:
    """Return one mesh of chosen cells of several updates, and each cell's first face and number of faces.

    `rows_of`: ascending rows of the chosen cells of each update.
    """
    meshes, counts = [], []
    for update, rows in zip(updates, rows_of, strict=True):
        each = np.diff(update.first_face)[rows]
        counts.append(each)
        if len(rows) == len(update.cells):
            meshes.append(_colored(update.mesh))
        elif len(rows):
            meshes.append(_colored(update.mesh.of_faces(_ranges(update.first_face[rows], each))))
    count = np.concatenate(counts)
    return concatenated(meshes), np.cumsum(count) - count, count


def _colored(mesh: Mesh) -> Mesh:
    if mesh.colors is not None:
        return mesh
    return dataclasses.replace(mesh, colors=np.full(mesh.vertices.shape, GREY, np.uint8))


def whole(meshes: list[Mesh], up: Up | None) -> Mesh:
    """Join meshes to one; at the seams, vertices of equal position and colour are merged."""
    if not meshes:
        return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    one = _colored(concatenated(meshes))
    assert one.colors is not None
    rows = np.empty(len(one.vertices), [("place", "f4", 3), ("color", "u1", 3)])
    rows["place"], rows["color"] = one.vertices, one.colors
    _, first, number = np.unique(rows.view("V15"), return_index=True, return_inverse=True)
    faces = number.reshape(-1)[one.faces].astype(np.int32)
    return Mesh(one.vertices[first], faces, one.normals[first], one.colors[first], known_up=up)


def _ranges(starts: NDArray[np.integer], counts: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the numbers start, start + 1, … of each range with these starts and counts, joined."""
    before = np.cumsum(counts) - counts
    found: NDArray[np.int64] = np.arange(int(counts.sum())) + np.repeat(starts - before, counts)
    return found


def _keys_of(cells: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return (n,) int64 keys of (n, 3) cells; keys sort by x, then y, then z."""
    keys: NDArray[np.int64] = cells.astype(np.int64) @ _STEPS
    return keys
