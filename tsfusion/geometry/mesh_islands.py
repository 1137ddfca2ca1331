# SPDX-License-Identifier: MIT
"""Find islands: small pieces of a mesh without connection to the rest, mostly noise.

A mesh that is too large for memory is searched part by part. A file holds a number for each vertex; memory
holds one part, and a box for each piece. Triangles may use vertices of earlier parts, which joins pieces.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig

ISLAND = 50  # vertices; a smaller piece is an island: marching cubes makes about one vertex per voxel face


def find(faces: NDArray[np.int32], vertices: int) -> NDArray[np.bool_]:
    """Return an (n,) bool mask of the vertices in pieces of fewer than `ISLAND` vertices.

    Such a piece has as much surface as 7 × 7 voxels, 14 cm across at 2 cm. If most triangles would be on
    islands, these are the scene, and the mask is False.
    """
    label = pieces(faces, vertices)
    small = (np.bincount(label, minlength=1) < ISLAND)[label]
    return small if 2 * small[faces[:, 0]].sum() <= len(faces) else np.zeros(vertices, bool)


def find_smaller(
    faces: NDArray[np.int32], vertices: NDArray[np.float32], min_extent: float
) -> NDArray[np.bool_]:
    """Return an (n,) mask of the vertices of pieces whose box has a diagonal below `min_extent` metres."""
    checked_extent(min_extent)
    label = pieces(faces, len(vertices))
    low, high = np.split(_boxes(vertices, label, len(vertices)), 2, axis=1)
    small: NDArray[np.bool_] = np.linalg.norm(high.astype(np.float64) - low, axis=1) < min_extent
    return small[label]


def checked_extent(min_extent: float) -> float:
    """Return the least extent of pieces; raise InvalidConfig for an impossible one."""
    if not 0 <= min_extent < np.inf:
        raise InvalidConfig(f"the least extent of a piece must be 0 metres or more, got {min_extent}")
    return min_extent


def count(faces: NDArray[np.int32], islands: NDArray[np.bool_]) -> int:
    """Return the number of separate pieces with triangles under a mask that `find` returned."""
    inside = faces[islands[faces[:, 0]]]
    return len(np.unique(pieces(inside, len(islands))[inside[:, 0]]))


def pieces(faces: NDArray[np.int32], vertices: int) -> NDArray[np.int32]:
    """Return the lowest vertex number in the connected piece of each of `vertices` vertices: (n,)."""
    a, b = np.concatenate((faces[:, :2], faces[:, 1:])).T
    return linked(a, b, vertices)


def linked(a: NDArray[np.int32], b: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """Return the lowest item number in the connected group of each of `count` items; a[i]–b[i] are links:
    (n,).

    Labels go down along every link, and each item jumps to its label's label, until nothing changes.
    """
    label = np.arange(count, dtype=np.int32)
    while len(a):
        low = np.minimum(label[a], label[b])
        np.minimum.at(label, label[a], low)
        np.minimum.at(label, label[b], low)
        while not np.array_equal(label, jumped := label[label]):
            label = jumped
        apart = label[a] != label[b]
        a, b = a[apart], b[apart]
    return label


@dataclass(frozen=True)
class Islands:
    """The islands among the pieces of mesh parts.

    Attributes:
        small: (k,) bool for each piece number of the vertices.
        count: number of islands in the whole mesh.
    """

    small: NDArray[np.bool_]
    count: int


def find_in_parts(parts: Iterable[Any], number: NDArray[np.int32], min_extent: float) -> Islands:
    """Number the vertices by piece, and find the pieces smaller than `min_extent` metres.

    Args:
        parts: `MeshPart`s, the last part of the mesh first.
        number: (vertices + 1,) array to fill; its index is the vertex number counted from the mesh's end.
    """
    checked_extent(min_extent)
    done, total = 0, 0
    links, boxes = [np.zeros((0, 2), np.int32)], [np.zeros((0, 6), np.float32)]
    for part in parts:
        count = len(part.vertices)
        own = done + count - np.arange(count)  # its vertices' numbers
        ids = np.union1d(part.faces, own)  # ascending: vertices of earlier parts come first
        label = pieces(np.searchsorted(ids, part.faces).astype(np.int32), len(ids))
        _, piece = np.unique(label, return_inverse=True)
        piece = piece.astype(np.int32) + np.int32(total)
        before = ids[ids <= done]
        links.append(np.unique(np.stack((piece[: len(before)], number[before]), axis=1), axis=0))
        number[done + 1 : done + count + 1] = piece[len(before) :]
        boxes.append(
            _boxes(part.vertices, piece[len(before) :][::-1] - total, int(piece.max(initial=-1)) + 1 - total)
        )
        total += len(boxes[-1])
        done += count
    a, b = np.concatenate(links).T
    whole = linked(a, b, total)
    box = np.concatenate(boxes)
    low, high = np.full((total, 3), np.inf), np.full((total, 3), -np.inf)
    np.minimum.at(low, whole, box[:, :3])
    np.maximum.at(high, whole, box[:, 3:])
    small = np.linalg.norm(high - low, axis=1) < min_extent
    return Islands(small[whole], int(small[np.unique(whole)].sum()))


def _boxes(vertices: NDArray[np.float32], piece: NDArray[np.int32], total: int) -> NDArray[np.float32]:
    """Return (total, 6): lowest and highest corner of each piece; `piece`: the piece of each vertex."""
    boxes = np.tile(np.repeat(np.array((np.inf, -np.inf), np.float32), 3), (total, 1))
    order = np.argsort(piece, kind="stable")
    found, first = np.unique(piece[order], return_index=True)
    if len(found):
        boxes[found, :3] = np.minimum.reduceat(vertices[order], first, axis=0)
        boxes[found, 3:] = np.maximum.reduceat(vertices[order], first, axis=0)
    return boxes


def without(parts: Iterable[Any], number: NDArray[np.int32], islands: Islands) -> Iterator[Any]:
    """Yield the parts without islands; set `number` to the new vertex numbers, 0 for a removed vertex."""
    done = kept_before = 0
    for part in parts:
        count = len(part.vertices)
        kept = ~islands.small[number[done + 1 : done + count + 1]]
        number[done + 1 : done + count + 1] = np.where(kept, kept_before + np.cumsum(kept), 0)
        faces = number[part.faces]
        rows = kept[::-1]
        yield part._replace(
            vertices=part.vertices[rows],
            faces=faces[(faces > 0).all(axis=1)],
            normals=part.normals[rows],
            colors=None if part.colors is None else part.colors[rows],
        )
        done += count
        kept_before += int(kept.sum())
