# SPDX-License-Identifier: MIT
"""A mesh for the page's 3-D view: fewer triangles, packed into a text that the page unpacks."""

import base64
import math
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh

MOST_TRIANGLES = 150_000
_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Scene:
    """Contents of a 3-D view.

    Attributes:
        mesh: with at most `MOST_TRIANGLES` triangles.
        level: (n,) uint8 of its vertices, a colour of the error's scale; None = no error is known.
        full: triangles before.
    """

    mesh: Mesh
    level: NDArray[np.uint8] | None
    full: int

    def header(self, up: NDArray[np.float64]) -> dict[str, object]:
        """Layout that the page needs to unpack `packed`, as JSON can hold it."""
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
        """Base64 of zlib: uint16 positions, uint32 faces, int8 normals, uint8 colours, uint8 levels.

        Axis by axis. Positions are in 65535ths of the box; they and the faces are differences from the number
        before, and faces are planes of bytes: that packs small.
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


def make(mesh: Mesh, level: NDArray[np.uint8] | None = None, most: int = MOST_TRIANGLES) -> Scene:
    """A scene of a mesh: vertices in one cell of a grid become one, as fine as leaves `most` triangles."""
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
    """The mesh with one vertex a cell of `size` metres, the mean of those in it (Rossignac, Borrel 1993)."""
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
