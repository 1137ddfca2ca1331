# SPDX-License-Identifier: MIT
"""Surface that a viewer of a map has put together from events, and the one that the map would show anew."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tsfusion import Mesh, Volume
from tsfusion.core.config import Surface
from tsfusion.wire.asking.followed_map import (
    Cleared,
    LinkSeen,
    MapEvent,
    PathsFound,
    ScannerSeen,
    SurfaceUpdate,
)

Cell = tuple[int, int, int]
Surfaces = dict[Cell, frozenset[bytes]]  # the triangles of each cell that has some, as bytes of their corners


def triangles_of(cells: NDArray[np.int32], first_face: NDArray[np.int32], mesh: Mesh) -> Surfaces:
    """The triangles of each cell, also of those without."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 9)
    rows = zip(cells.tolist(), first_face[:-1].tolist(), first_face[1:].tolist(), strict=True)
    return {(x, y, z): frozenset(one.tobytes() for one in corners[i:j]) for (x, y, z), i, j in rows}


def ordered(mesh: Mesh) -> NDArray[np.float32]:
    """(n, 9) corners of a mesh's triangles, in an order that depends on them alone."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 9)
    return corners[np.lexsort(corners.T)]


def fresh(volume: Volume, surface: Surface | None = None) -> Surfaces:
    """The cells of a map, meshed now."""
    found = volume.surface.mesh_cells(volume.blocks().coordinates, surface)
    cells = triangles_of(found.cells, found.first_face, found.mesh)
    return {cell: triangles for cell, triangles in cells.items() if triangles}


class Held:
    """What was shown by all events so far."""

    def __init__(self) -> None:
        self.cleared = self.updates = 0
        self.map, self.voxel_size = "", 0.0
        self.surfaces: Surfaces = {}
        self.raw: set[Cell] = set()  # cells that are not refined
        self.client: dict[Cell, bytes] = {}
        self.paths: dict[bytes, dict[int, NDArray[np.float64]]] = {}
        self.seen: list[ScannerSeen] = []
        self.problems: list[str] = []

    def triangles(self) -> NDArray[np.float32]:
        """(n, 9) corners, as of `ordered`."""
        found = b"".join(one for triangles in self.surfaces.values() for one in triangles)
        corners = np.frombuffer(found, np.float32).reshape(-1, 9)
        return corners[np.lexsort(corners.T)]

    def take(self, events: Iterable[MapEvent]) -> None:
        for event in events:
            if isinstance(event, Cleared):
                self.cleared += 1
                self.map, self.voxel_size = event.map, event.voxel_size
                self.surfaces, self.raw, self.client = {}, set(), {}
            elif isinstance(event, SurfaceUpdate):
                self._take_surface(event)
            elif isinstance(event, PathsFound):
                self.paths = {
                    session: dict(zip(seqs.tolist(), poses, strict=True))
                    for session, (seqs, poses) in event.paths.items()
                }
            elif isinstance(event, ScannerSeen):
                self.seen.append(event)
            elif isinstance(event, LinkSeen):
                self.problems.append(event.problem)

    def _take_surface(self, event: SurfaceUpdate) -> None:
        assert event.client is not None
        self.updates += 1
        new = triangles_of(event.cells, event.first_face, event.mesh)
        rows = zip(new.items(), event.client.tolist(), event.is_refined.tolist(), strict=True)
        for (cell, triangles), client, is_refined in rows:
            self.surfaces.pop(cell, None)
            self.raw.discard(cell)
            self.client[cell] = event.clients[client] if client >= 0 else b""
            if triangles:
                self.surfaces[cell] = triangles
                if not is_refined:
                    self.raw.add(cell)


def farthest(one: Surfaces, other: Surfaces) -> float:
    """Metres between two sets of surfaces: of the worst corner in the one to the nearest in the other."""
    from scipy.spatial import cKDTree

    if not one and not other:
        return 0.0

    clouds = [
        np.frombuffer(b"".join(b"".join(cell) for cell in surfaces.values()), np.float32).reshape(-1, 3)
        for surfaces in (one, other)
    ]
    return float(max(cKDTree(a).query(b)[0].max() for a, b in (clouds, clouds[::-1])))
