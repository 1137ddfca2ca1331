# SPDX-License-Identifier: MIT
"""Cut a mesh along a plane or the sides of a box; triangles across them are cut exactly."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.mesh_arrays import AnyMesh


def checked_box(box: Sequence[float]) -> NDArray[np.float64]:
    """Return x0, y0, z0, x1, y1, z1 in metres as (2, 3); raise InvalidConfig for anything else."""
    corners = np.asarray(box, np.float64)
    if corners.shape != (6,) or not np.isfinite(corners).all() or (corners[3:] <= corners[:3]).any():
        raise InvalidConfig(f"a box is x0 y0 z0 x1 y1 z1 in metres, the lower corner first, got {list(box)}")
    return corners.reshape(2, 3)


def cropped(mesh: AnyMesh, box: Sequence[float]) -> AnyMesh:
    """Return the part of a mesh inside a box, as `Mesh.cropped` does."""
    low, high = checked_box(box)
    for axis in range(3):
        for side, sign in ((np.float32(low[axis]), 1), (np.float32(high[axis]), -1)):
            mesh = _cut(mesh, sign * (mesh.vertices[:, axis] - side), (axis, side))
    return mesh


def cut(mesh: AnyMesh, normal: NDArray[np.float64], offset: float) -> AnyMesh:
    """Return the part of a mesh where `normal · p ≤ offset`, metres; triangles across that plane are cut."""
    return _cut(mesh, np.float32(offset) - mesh.vertices @ normal.astype(np.float32))


def _cut(mesh: AnyMesh, height: NDArray[np.float32], plane: tuple[int, np.float32] | None = None) -> AnyMesh:
    """Return the part of a mesh above a plane. `height`: (n,) signed distances of the vertices; cut below 0.

    `plane`: its axis and its coordinate on this axis; cut vertices get this coordinate to the last bit.
    """
    kept = height >= 0
    count = kept[mesh.faces].sum(axis=1)
    if (count == 3).all():
        return mesh
    crossed = np.flatnonzero((count == 1) | (count == 2))
    # Turned so that corner 0 is the only corner on its side
    faces = mesh.faces[crossed]
    alone = kept[faces] == (count[crossed] == 1)[:, None]
    turn = (np.argmax(alone, axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, turn, axis=1).T
    edges = np.concatenate((np.stack((a, b), axis=1), np.stack((a, c), axis=1)))
    mesh, on = _with_cuts(mesh, edges, height, plane)
    ab, ac = on[: len(a)], on[len(a) :]
    one = count[crossed] == 1
    tip = np.stack((a, ab, ac), axis=1)[one]
    base = np.concatenate((np.stack((ab, b, c), axis=1)[~one], np.stack((ab, c, ac), axis=1)[~one]))
    whole = np.flatnonzero(count == 3)
    origin = np.concatenate((whole, crossed[one], crossed[~one], crossed[~one]))
    pieces = np.concatenate((mesh.faces[whole], tip, base)).astype(np.int32)
    result = dataclasses.replace(
        mesh, faces=pieces, guessed=None if mesh.guessed is None else mesh.guessed[origin]
    )
    return result.of_faces((pieces != pieces[:, [1, 2, 0]]).all(axis=1))  # drop empty triangles


def _with_cuts(
    mesh: AnyMesh,
    edges: NDArray[np.int32],
    height: NDArray[np.float32],
    plane: tuple[int, np.float32] | None,
) -> tuple[AnyMesh, NDArray[np.int64]]:
    """Return the mesh with a vertex where each edge (n, 2) meets the plane; and these vertices' numbers."""
    edges, which = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    p, q = edges.T
    share = (height[p] / (height[p] - height[q]))[:, None]
    vertices = mesh.vertices[p] + share * (mesh.vertices[q] - mesh.vertices[p])
    if plane is not None:
        vertices[:, plane[0]] = plane[1]
    normals = (1 - share) * mesh.normals[p] + share * mesh.normals[q]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), mesh.normals[p])
    colors = mesh.colors
    if colors is not None:
        mixed = np.round((1 - share) * colors[p] + share * colors[q]).astype(np.uint8)
        colors = np.concatenate((colors, mixed))
    grown = dataclasses.replace(
        mesh,
        vertices=np.concatenate((mesh.vertices, vertices.astype(np.float32))),
        normals=np.concatenate((mesh.normals, normals.astype(np.float32))),
        colors=colors,
    )
    on = np.where(height[p] == 0, p, np.where(height[q] == 0, q, len(mesh.vertices) + np.arange(len(edges))))
    return grown, on[which.reshape(-1)]
