# SPDX-License-Identifier: MIT
"""Draw a mesh for a report: from four sides, by error, from above, and as data of a 3-D view."""

import base64
import dataclasses
import math
import zlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import OutputError
from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines.maps import mesh_preview
from tsfusion.viewer.map.vertex_colors import color_ramp, rounded_up

SIZE = (840, 560)  # pixels
SIDES = 4
_QUALITY = 88  # of JPEG
_ERROR_SHARE = 98  # percent of the vertices have a colour short of the scale's end
_CELLS = 360  # of a plan's longer side
MOST_TRIANGLES = 150_000
_ROUNDS = 6


class ErrorScale(NamedTuple):
    """Colour scale of a map's error.

    Attributes:
        end_mm: the error of the last colour, a round number.
        level: (n,) uint8 of each vertex, 255 = `end_mm` or more.
    """

    end_mm: float
    level: NDArray[np.uint8]

    def colors(self) -> NDArray[np.uint8]:
        """Return the (n, 3) uint8 RGB of the vertices on this scale."""
        return color_ramp()[self.level]


class Sides:
    """Pictures of a mesh from the side that shows most of it, and from the three other sides."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._up, self._aspect = mesh_preview.up_of(mesh), SIZE[0] / SIZE[1]
        self.angles = mesh_preview.choose_angles(mesh, self._up, aspect=self._aspect)

    def picture(self, side: int, colors: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Return the (height, width, 3) uint8 RGB picture from one of `SIDES` sides.

        Args:
            colors: (n, 3) uint8 RGB of the vertices, instead of the mesh's own.
        """
        azimuth, elevation = self.angles
        azimuth += side * 2 * math.pi / SIDES
        places = mesh_preview.core(self._mesh)
        camera = mesh_preview.orbit(places, self._up, azimuth, elevation, self._aspect)
        mesh = self._mesh if colors is None else dataclasses.replace(self._mesh, colors=colors)
        return mesh_preview.picture(mesh, camera, *SIZE, up=self._up)


def error_scale(error_mm: NDArray[np.float64]) -> ErrorScale:
    """Return a colour scale for (n,) errors in millimetres. Nearly all of them lie within the scale."""
    end = rounded_up(float(np.percentile(np.abs(error_mm), _ERROR_SHARE)))
    level = np.minimum(np.abs(error_mm) / end, 1.0)
    return ErrorScale(end, np.round(255 * level).astype(np.uint8))


def plan(places: NDArray[np.float64]) -> tuple[str, NDArray[np.float64]]:
    """Draw the density of (n, 2) points; return the picture's URL and its (2, 2) corners, metres."""
    low, high = np.percentile(places, (0.2, 99.8), axis=0)
    cell = max(float((high - low).max()), 1e-3) / _CELLS
    bins = np.maximum(np.ceil((high - low) / cell), 1).astype(int)
    corners = np.stack((low, low + bins * cell))
    cells = np.floor((places - low) / cell).astype(np.int64)
    inside = ((cells >= 0) & (cells < bins)).all(axis=1)
    numbers = cells[inside, 0] * bins[1] + cells[inside, 1]
    counts = np.bincount(numbers, minlength=int(bins.prod())).reshape(bins)
    dense = np.percentile(counts[counts > 0], 97) if counts.any() else 1.0
    alpha = np.round(210 * np.minimum(counts / dense, 1.0) ** 0.6).astype(np.uint8)
    picture = np.full((*alpha.T.shape, 4), 128, np.uint8)
    picture[..., 3] = alpha.T[::-1]
    return "data:image/png;base64," + base64.b64encode(_encoded(".png", picture)).decode(), corners


def jpeg_url(rgb: NDArray[np.uint8]) -> str:
    """Return a picture as a `data:` URL of a JPEG."""
    import cv2

    content = _encoded(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(content).decode("ascii")


def _encoded(suffix: str, picture: NDArray[np.uint8], options: list[int] | None = None) -> bytes:
    import cv2

    done, content = cv2.imencode(suffix, picture, options or [])
    if not done:
        raise OutputError("cannot encode a picture for the report")
    return bytes(content.tobytes())


@dataclass(frozen=True, eq=False)
class Scene:
    """Contents of the 3-D view in a report.

    Attributes:
        mesh: with at most `MOST_TRIANGLES` triangles.
        level: (n,) uint8 error of its vertices on the colour scale; None if no error is known.
        full: number of triangles before it was simplified.
    """

    mesh: Mesh
    level: NDArray[np.uint8] | None
    full: int

    def header(self, up: NDArray[np.float64]) -> dict[str, object]:
        """Return the layout of `packed` as JSON values: the script of the page needs it to unpack."""
        low, size = _box(self.mesh.vertices)
        return {
            "vertices": len(self.mesh.vertices),
            "triangles": len(self.mesh.faces),
            "low": low.tolist(),
            "size": size.tolist(),
            "up": [round(float(x), 6) for x in up],
            "colors": self.mesh.colors is not None,
            "error": self.level is not None,
        }

    def packed(self) -> str:
        """Return base64 of zlib of uint16 positions, uint32 faces, int8 normals, uint8 colours, uint8 levels.

        Arrays are stored axis by axis. Positions are in 65535ths of the bounding box. Positions and faces are
        differences from the number before, and faces are split into byte planes: so they compress better.
        """
        low, size = _box(self.mesh.vertices)
        position = np.round((self.mesh.vertices - low) / size * 65535).astype(np.int64)
        normal = np.round(self.mesh.normals * 127).astype(np.int8)
        corners = np.diff(self.mesh.faces.astype(np.int64).ravel(), prepend=0).astype(np.uint32)
        parts = [
            np.diff(position, axis=0, prepend=0).astype("<u2").T.tobytes(),
            np.ascontiguousarray(corners.astype("<u4")).view(np.uint8).reshape(-1, 4).T.tobytes(),
            np.ascontiguousarray(normal.T).tobytes(),
        ]
        if self.mesh.colors is not None:
            parts.append(np.ascontiguousarray(self.mesh.colors.T).tobytes())
        if self.level is not None:
            parts.append(self.level.tobytes())
        return base64.b64encode(zlib.compress(b"".join(parts), 6)).decode("ascii")


def make_scene(mesh: Mesh, level: NDArray[np.uint8] | None = None, most: int = MOST_TRIANGLES) -> Scene:
    """Return a 3-D view of a mesh. A grid merges vertices until at most `most` triangles are left."""
    small, small_level = mesh, level
    if len(mesh.faces) > most:
        edges = mesh.vertices[mesh.faces[::97, 0]] - mesh.vertices[mesh.faces[::97, 1]]
        size = float(np.linalg.norm(edges, axis=1).mean()) or 1e-6
        for _ in range(_ROUNDS):
            size *= max(1.1, math.sqrt(len(small.faces) / most))
            small, small_level = _clustered(mesh, level, size)
            if len(small.faces) <= most:
                break
    return Scene(small, small_level, len(mesh.faces))


def _clustered(
    mesh: Mesh, level: NDArray[np.uint8] | None, size: float
) -> tuple[Mesh, NDArray[np.uint8] | None]:
    """Merge the vertices in each cell of `size` metres into their mean (Rossignac, Borrel 1993)."""
    cell = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / size).astype(np.int64)
    extent = cell.max(axis=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    _, number, count = np.unique(key, return_inverse=True, return_counts=True)
    number = number.ravel()

    def mean(values: NDArray[np.generic]) -> NDArray[np.float64]:
        columns = np.asarray(values, np.float64).reshape(len(values), -1).T
        sums = [np.bincount(number, column, len(count)) for column in columns]
        return np.stack(sums, axis=1) / count[:, None]

    faces = number[mesh.faces].astype(np.int32)
    a, b, c = faces.T
    normals = mean(mesh.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return Mesh(
        mean(mesh.vertices).astype(np.float32),
        faces[(a != b) & (b != c) & (c != a)],
        normals.astype(np.float32),
        None if mesh.colors is None else np.round(mean(mesh.colors)).astype(np.uint8),
        known_up=mesh.up,
    ), None if level is None else np.round(mean(level)).ravel().astype(np.uint8)


def _box(vertices: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low = vertices.min(axis=0).astype(np.float64)
    return low, np.maximum(vertices.max(axis=0) - low, 1e-6)
