# SPDX-License-Identifier: MIT
"""Patches of guessed triangles, joined edge by edge: which of them close a hole, and their colours."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import mesh_islands
from tsfusion.geometry.mesh import Mesh

_SWEEPS = 256  # of colours, at most: across the widest hole


def closing(mesh: Mesh) -> Mesh:
    """The mesh without the guessed patches that close nothing.

    None of a patch's edges may be free: at the border of a scan and in a hole that is too wide they are. And
    it may not have more triangles than the seen pieces that it hangs on: a crumb would grow to a bubble.
    """
    assert mesh.guessed is not None
    guess = np.flatnonzero(mesh.guessed)
    edges = _edges(mesh.faces[guess])
    owner = np.tile(np.arange(len(guess), dtype=np.int32), 3)
    key = _keys(edges)
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    patch = mesh_islands.linked(owner[order][1:][same], owner[order][:-1][same], len(guess))
    alone = np.ones(len(key), bool)
    alone[1:] &= ~same
    alone[:-1] &= ~same
    rim = order[alone]  # edges that one guessed triangle has
    of, at = patch[owner[rim]], edges[rim]
    seen = mesh.faces[~mesh.guessed]
    touched = np.zeros(len(mesh.vertices), bool)
    touched[at] = True
    is_attached = np.isin(key[rim], _keys(_edges(seen[touched[seen].any(axis=1)])))
    size = np.bincount(patch, minlength=len(guess))
    keeps = _size_around(seen, of[is_attached], at[is_attached, 0], mesh) >= np.maximum(size, 1)
    keeps[of[~is_attached]] = False
    kept = ~mesh.guessed
    kept[guess] = keeps[patch]
    closed = mesh.of_faces(kept)
    return closed if keeps[patch].any() else replace(closed, guessed=None)


def _size_around(
    seen: NDArray[np.int32], patch: NDArray[np.int32], vertex: NDArray[np.int32], mesh: Mesh
) -> NDArray[np.int64]:
    """Number of triangles of the seen pieces that each patch hangs on, by the vertices where it does."""
    assert mesh.guessed is not None
    label = mesh_islands.pieces(seen, len(mesh.vertices))
    faces = np.bincount(label[seen[:, 0]], minlength=len(label))
    pairs = np.unique(np.stack((patch, label[vertex]), axis=1), axis=0)
    total = np.bincount(pairs[:, 0], faces[pairs[:, 1]], minlength=int(mesh.guessed.sum()))
    return total.astype(np.int64)


def _edges(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    return np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))


def _keys(edges: NDArray[np.int32]) -> NDArray[np.int64]:
    keys: NDArray[np.int64] = edges.min(axis=1).astype(np.int64) << 32 | edges.max(axis=1)
    return keys


def with_rim_colors(mesh: Mesh) -> Mesh:
    """Colours of the guessed surface: those of its rim, diffused inward."""
    if mesh.guessed is None or mesh.colors is None:
        return mesh
    known = np.zeros(len(mesh.vertices), bool)
    known[mesh.faces[~mesh.guessed]] = True
    faces = mesh.faces[mesh.guessed]
    edges = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    a, b = np.unique(np.concatenate((edges, edges[:, ::-1])), axis=0).T
    a, b = a[~known[a]], b[~known[a]]
    colors = mesh.colors.astype(np.float64)
    has = known.copy()
    for _ in range(_SWEEPS):
        use = has[b]
        count = np.bincount(a[use], minlength=len(known))
        sums = [np.bincount(a[use], colors[b[use], channel], len(known)) for channel in range(3)]
        reached = count > 0
        change = np.stack(sums, axis=1)[reached] / count[reached, None] - colors[reached]
        colors[reached] += change
        if (reached <= has).all() and (not len(change) or np.abs(change).max() < 0.5):
            break
        has |= reached
    return replace(mesh, colors=np.round(colors).astype(np.uint8))
