# SPDX-License-Identifier: MIT
"""Up direction of a map that grows: as it is told, or found again as more of it is seen."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import up_direction
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import HeldSensor, Up
from tsfusion.viewer.map.map_tiles import MapTiles
from tsfusion.wire.asking.map_events import PathsFound, ScannerSeen

_FIRST = 2000  # triangles from which on it is looked for
_LESS = 0.985  # cosine of 10°: a new direction counts that is further from the old one


class MapUp:
    """The up direction of a map."""

    def __init__(self) -> None:
        self.up: Up | None = None
        self._is_given = False
        self._held = HeldSensor()
        self._looked_at = 0  # triangles

    @property
    def direction(self) -> NDArray[np.float64]:
        """(3,) unit length; +z where nobody knows."""
        return np.array((0.0, 0.0, 1.0) if self.up is None else self.up.direction)

    def note_scanner(self, event: ScannerSeen) -> None:
        """Take into account how a sensor was held."""
        if not self._held.is_known:
            self._looked_at = 0  # what was found before was found without
        self._held.add(event.T_world_camera, "lidar" if event.intrinsics is None else "camera")

    def note_paths(self, event: PathsFound) -> None:
        """Take into account how the sensors of the whole map were held."""
        if event.held is not None and event.held.is_known:
            self._held = HeldSensor(event.held.numbers)
            self._looked_at = 0  # what was found before was found without

    def note_given(self, up: Up | None) -> None:
        """Take a direction that comes with the map."""
        if up is not None:
            self.up, self._is_given = up, True

    def look(self, tiles: MapTiles) -> None:
        """Look for it again, each time that there is twice as much of the map."""
        if self._is_given or (count := tiles.triangles) < max(_FIRST, 2 * self._looked_at):
            return
        self._looked_at = count
        found = up_direction.find(_some_triangles(tiles, count), self._held)
        if found is not None and (self.up is None or self.direction @ found.direction < _LESS):
            self.up = found


def _some_triangles(tiles: MapTiles, count: int) -> Mesh:
    """A mesh of some triangles from everywhere, each with corners of its own."""
    step = max(1, count // up_direction.SAMPLE)
    corners, normals = [], []
    for tile in tiles.tiles.values():
        faces = tile.mesh.faces[::step].ravel()
        corners.append(tile.mesh.vertices[faces])
        normals.append(tile.mesh.normals[faces])
    vertices = np.concatenate(corners)
    return Mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), np.concatenate(normals))
