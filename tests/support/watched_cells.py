# SPDX-License-Identifier: MIT
"""What somebody who watches a map holds of it: the newest triangles of every cell."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh
from tsfusion.wire.map_events import Cleared, LinkSeen, MapEvent, PathsFound, ScannerSeen, SurfaceUpdate


class WatchedCells:
    """Takes events; holds what they leave."""

    def __init__(self) -> None:
        self.clear("")

    def clear(self, name: str) -> None:
        self.map, self.problems, self.paths = name, list[str](), dict[bytes, object]()
        self.cells: dict[tuple[int, ...], NDArray[np.float32]] = {}
        self.refined: dict[tuple[int, ...], bool] = {}
        self.clients: dict[tuple[int, ...], bytes | None] = {}
        self.scanners: list[ScannerSeen] = []
        self.updates = 0

    def take(self, events: Iterable[MapEvent]) -> None:
        for event in events:
            if isinstance(event, Cleared):
                self.clear(event.map)
            elif isinstance(event, SurfaceUpdate):
                self._take_cells(event)
            elif isinstance(event, PathsFound):
                self.paths = dict(event.paths)
            elif isinstance(event, ScannerSeen):
                self.scanners.append(event)
            elif isinstance(event, LinkSeen):
                self.problems.append(event.problem)

    def _take_cells(self, update: SurfaceUpdate) -> None:
        self.updates += 1
        soup = corners(update.mesh)
        assert update.first_face[0] == 0
        assert update.first_face[-1] == len(soup)
        for row, cell in enumerate(map(tuple, update.cells.tolist())):
            self.cells[cell] = soup[update.first_face[row] : update.first_face[row + 1]]
            self.refined[cell] = update.is_refined
            at = -1 if update.client is None else int(update.client[row])
            self.clients[cell] = update.clients[at] if at >= 0 else None

    def triangles(self) -> NDArray[np.float32]:
        """(n, 9) corners of all triangles, in an order that depends on them alone."""
        return ordered(np.concatenate([np.empty((0, 9), np.float32), *self.cells.values()]))


def corners(mesh: Mesh) -> NDArray[np.float32]:
    """(n, 9) corners of a mesh's triangles."""
    return mesh.vertices[mesh.faces].reshape(-1, 9)


def ordered(soup: NDArray[np.float32]) -> NDArray[np.float32]:
    return soup[np.lexsort(soup.T)]
