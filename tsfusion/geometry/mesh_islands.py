# SPDX-License-Identifier: MIT
"""Islands: small pieces of a mesh that are connected with nothing else, mostly noise.

Islands of a mesh that is too large for memory are found part by part: a number for each vertex waits in a
file; memory holds a part, and a box for each piece of one. A part's triangles may name vertices of earlier
parts: pieces that meet there are one.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig

ISLAND = 50  # vertices that a piece needs to be none: marching cubes makes about one on each voxel's face


def find(faces: NDArray[np.int32], vertices: int) -> NDArray[np.bool_]:
    """(n,) bool of `vertices` vertices: those in pieces of fewer than `ISLAND` vertices.

    Such a piece has as much surface as 7 × 7 voxels, 14 cm across at 2 cm. None if most triangles would be on
    islands: then they are the scene.
    """
    label = pieces(faces, vertices)
    small = (np.bincount(label, minlength=1) < ISLAND)[label]
    return small if 2 * small[faces[:, 0]].sum() <= len(faces) else np.zeros(vertices, bool)


def find_smaller(
    faces: NDArray[np.int32], vertices: NDArray[np.float32], min_extent: float
) -> NDArray[np.bool_]:
    """Vertices of pieces whose box is less than `min_extent` metres across its corners: (n,)."""
    checked_extent(min_extent)
    label = pieces(faces, len(vertices))
    order = np.argsort(label, kind="stable")
    _, first, which = np.unique(label[order], return_index=True, return_inverse=True)
    if not len(first):
        return np.zeros(0, bool)
    low, high = (of.reduceat(vertices[order], first, axis=0) for of in (np.minimum, np.maximum))
    small = np.empty(len(vertices), bool)
    small[order] = (np.linalg.norm(high.astype(np.float64) - low, axis=1) < min_extent)[which]
    return small


def checked_extent(min_extent: float) -> float:
    """Least extent of pieces; raises InvalidConfig for an impossible one."""
    if not 0 <= min_extent < np.inf:
        raise InvalidConfig(f"the least extent of a piece must be 0 metres or more, got {min_extent}")
    return min_extent


def count(faces: NDArray[np.int32], islands: NDArray[np.bool_]) -> int:
    """Number of pieces with triangles among the vertices that `find` found."""
    inside = faces[islands[faces[:, 0]]]
    return len(np.unique(pieces(inside, len(islands))[inside[:, 0]]))


def pieces(faces: NDArray[np.int32], vertices: int) -> NDArray[np.int32]:
    """For each of `vertices` vertices, the lowest number of a vertex that triangles connect it with: (n,)."""
    a, b = np.concatenate((faces[:, :2], faces[:, 1:])).T
    return linked(a, b, vertices)


def linked(a: NDArray[np.int32], b: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """For each of `count` items, the lowest number of an item that links a[i]–b[i] connect it with: (n,).

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
    """Pieces of parts that are islands.

    Attributes:
        small: (k,) bool by the numbers that the vertices have.
        count: of islands in the whole mesh.
    """

    small: NDArray[np.bool_]
    count: int


def find_in_parts(parts: Iterable[Any], number: NDArray[np.int32], min_extent: float) -> Islands:
    """Number the vertices by piece, and find the pieces smaller than `min_extent` metres.

    Args:
        parts: `MeshPart`s, the last of the mesh first.
        number: (vertices + 1,) to fill, by the vertices' numbers from the end of the mesh.
    """
    checked_extent(min_extent)
    done, total = 0, 0
    links, boxes = [np.zeros((0, 2), np.int32)], [np.zeros((0, 6), np.float32)]
    for part in parts:
        count = len(part.vertices)
        own = done + count - np.arange(count)  # its vertices' numbers
        ids = np.union1d(part.faces, own)  # ascending: those of parts before come first
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
    """(total, 6): lowest and highest corner of each piece's vertices; inverted for a piece without any."""
    boxes = np.tile(np.repeat(np.array((np.inf, -np.inf), np.float32), 3), (total, 1))
    order = np.argsort(piece, kind="stable")
    found, first = np.unique(piece[order], return_index=True)
    if len(found):
        boxes[found, :3] = np.minimum.reduceat(vertices[order], first, axis=0)
        boxes[found, 3:] = np.maximum.reduceat(vertices[order], first, axis=0)
    return boxes


def without(parts: Iterable[Any], number: NDArray[np.int32], islands: Islands) -> Iterator[Any]:
    """Parts without the islands; `number` becomes the new numbers of the vertices, 0 for a removed one."""
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
