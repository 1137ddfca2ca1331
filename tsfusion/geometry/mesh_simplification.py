# SPDX-License-Identifier: MIT
"""Simplify a mesh by collapsing edges in the order of their quadric error (`fast-simplification`).

The method is Garland and Heckbert's (1997). Borders stay unchanged; a merged vertex gets the mean colour and
normal. No edge has more than two triangles afterwards.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, needing
from tsfusion.geometry.mesh_arrays import AnyMesh

_INSTALL = "to simplify a mesh: pip install fast-simplification (or '.[mesh]')"
_RISE = 5.0  # growth of the allowed error if a number of triangles is wanted
_ALLOWED = 1e-9  # the library's first allowed error, squared units: lengths are scaled to it
_CHUNK = 1 << 18  # vertices whose deviation is measured at once


def simplified(
    mesh: AnyMesh, *, ratio: float | None, triangles: int | None, max_error: float | None
) -> AnyMesh:
    """Return a mesh with fewer triangles, as `Mesh.simplified` does."""
    if [ratio, triangles, max_error].count(None) != 2:
        raise InvalidConfig("a mesh is simplified to a ratio, a number of triangles or a max_error: give one")
    if ratio is not None and not 0 < ratio <= 1:
        raise InvalidConfig(f"ratio must be > 0 and ≤ 1, got {ratio}")
    if triangles is not None and triangles < 1:
        raise InvalidConfig(f"triangles must be ≥ 1, got {triangles}")
    if max_error is not None and not 0 < max_error < np.inf:
        raise InvalidConfig(f"max_error must be > 0 m, got {max_error}")
    total = len(mesh.faces)
    if triangles is not None:
        ratio = min(triangles / max(total, 1), 1.0)
    if not total or ratio == 1:
        return mesh
    guessed = np.zeros(total, bool) if mesh.guessed is None else mesh.guessed
    parts = [mesh.of_faces(which) for which in (~guessed, guessed) if which.any()]
    return _unfolded(_joined([_reduced(part, ratio, max_error) for part in parts], mesh))


def library() -> Any:
    """Return the module `fast_simplification`; raise MissingDependency if it is not installed."""
    with needing(_INSTALL):
        import fast_simplification
    return fast_simplification


def _reduced(mesh: AnyMesh, ratio: float | None, max_error: float | None) -> AnyMesh:
    """Return the seen or the guessed part of a mesh simplified, with its border unchanged."""
    fast_simplification = library()
    points = mesh.vertices.astype(np.float64)
    wanted: dict[str, Any] = {"target_count": 0, "agg": 0.0}
    if max_error is not None:
        points *= _ALLOWED**0.5 / max_error
    elif ratio is not None:
        # A mesh with its border kept has at least this many triangles; near this number they get long
        least = 2 * len(border_edges(mesh.faces))
        wanted = {"target_count": max(int(ratio * len(mesh.faces)), least), "agg": _RISE}
        if wanted["target_count"] >= len(mesh.faces):
            return mesh
    *_, collapses = fast_simplification.simplify(
        points, mesh.faces, preserve_border=True, return_collapses=True, **wanted
    )
    vertices, faces, became = fast_simplification.replay_simplification(points, mesh.faces, collapses)
    if max_error is not None:
        vertices = vertices * (max_error / _ALLOWED**0.5)
    return _with_means(mesh, vertices.astype(np.float32), faces.astype(np.int32), became)


def _with_means(
    full: AnyMesh, vertices: NDArray[np.float32], faces: NDArray[np.int32], became: NDArray[np.int64]
) -> AnyMesh:
    """Return the simplified mesh; each vertex has the mean colour and normal of those that `became` it."""
    used = became >= 0
    count = np.bincount(became[used], minlength=len(vertices))

    def mean(of: NDArray[Any]) -> NDArray[np.float64]:
        sums = [np.bincount(became[used], column[used], len(vertices)) for column in of.T.astype(np.float64)]
        return np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]

    normals = mean(full.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), (0.0, 0.0, 1.0))
    colors = None if full.colors is None else np.round(mean(full.colors)).astype(np.uint8)
    guessed = None if full.guessed is None else np.full(len(faces), full.guessed[0])
    result = dataclasses.replace(
        full, vertices=vertices, faces=faces, normals=normals.astype(np.float32), colors=colors,
        guessed=guessed, known_up=full.known_up,
    )  # fmt: skip
    return result.of_faces(np.ones(len(faces), bool))


def _joined(parts: list[AnyMesh], like: AnyMesh) -> AnyMesh:
    """Join seen and guessed triangles to one mesh, and merge their vertices at the same position."""
    if len(parts) == 1:
        return parts[0]
    vertices = np.concatenate([part.vertices for part in parts])
    _, first, same = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    number = np.empty(len(first), np.int64)
    order = np.argsort(first)
    number[order] = np.arange(len(first))
    kept, same = first[order], number[same.reshape(-1)]
    offset = len(parts[0].vertices)
    faces = np.concatenate([parts[0].faces, parts[1].faces + offset])
    colors = [part.colors for part in parts if part.colors is not None]
    return dataclasses.replace(
        like,
        vertices=vertices[kept],
        faces=same[faces].astype(np.int32),
        normals=np.concatenate([part.normals for part in parts])[kept],
        colors=np.concatenate(colors)[kept] if colors else None,
        guessed=np.concatenate([part.guessed for part in parts if part.guessed is not None]),
        known_up=like.known_up,
    )


def _unfolded(mesh: AnyMesh) -> AnyMesh:
    """Return the mesh with at most two triangles at each edge, and no triangle twice.

    Collapsed edges can fold a surface onto itself. Two opposite triangles on the same corners are removed. At
    an edge of more than two, each sheet gets vertices of its own (Guéziec et al., 2001).
    """
    rising = (mesh.faces < np.roll(mesh.faces, -1, axis=1)).sum(axis=1)
    facing = np.where(rising == 2, 1, -1)  # 1 for an even order of the corners, else −1
    _, group = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    left = np.flatnonzero(facing == np.sign(np.bincount(group, facing))[group])
    mesh = mesh.of_faces(np.sort(left[np.unique(group[left], return_index=True)[1]]))

    vertex = mesh.faces.reshape(-1)
    corner = np.arange(len(vertex))
    ahead = corner - corner % 3 + (corner + 1) % 3  # the corner at the other end of the edge that begins here
    ends = np.sort(np.stack([vertex, vertex[ahead]], axis=1), axis=1)
    _, edge, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    is_crowded = np.zeros(len(mesh.vertices), bool)
    is_crowded[ends[count[edge] > 2]] = True
    order = np.argsort(edge, kind="stable")
    a, b = order[count[edge[order]] == 2].reshape(-1, 2).T
    turned = vertex[a] != vertex[b]
    links = np.concatenate(
        [(a, np.where(turned, ahead[b], b)), (ahead[a], np.where(turned, b, ahead[b]))], axis=1
    )
    links = links[:, is_crowded[vertex[links[0]]]]
    sheet, before = np.where(is_crowded[vertex], corner, 0), None
    while before is None or (sheet != before).any():  # as often as triangles meet at one vertex, at most
        before = sheet.copy()
        np.minimum.at(sheet, links, before[links[::-1]])
    _, first, faces = np.unique(
        np.stack([vertex, sheet], axis=1), axis=0, return_index=True, return_inverse=True
    )
    source = vertex[first]
    return dataclasses.replace(
        mesh, vertices=mesh.vertices[source], normals=mesh.normals[source],
        colors=None if mesh.colors is None else mesh.colors[source],
        faces=faces.reshape(-1, 3).astype(np.int32), known_up=mesh.known_up,
    )  # fmt: skip


def border_edges(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the (n, 2) edges that belong to only one triangle."""
    edges = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    key = edges.min(axis=1).astype(np.int64) << 32 | edges.max(axis=1)
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    alone: NDArray[np.int32] = edges[first[count == 1]]
    return alone
