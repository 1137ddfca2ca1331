# SPDX-License-Identifier: MIT
"""Islands of a mesh that is too large for memory, found part by part.

A number for each vertex waits in a file; memory holds a part, and a box for each piece of one. A part's
triangles may name vertices of parts that came before: there pieces of both are one.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import mesh_islands


@dataclass(frozen=True)
class Islands:
    """Pieces of parts that are islands.

    Attributes:
        small: (k,) bool by the numbers that the vertices have.
        count: of islands in the whole mesh.
    """

    small: NDArray[np.bool_]
    count: int


def find(parts: Iterable[Any], number: NDArray[np.int32], min_extent: float) -> Islands:
    """Number the vertices by piece, and find the pieces smaller than `min_extent` metres.

    Args:
        parts: `MeshPart`s, the last of the mesh first.
        number: (vertices + 1,) to fill, by the vertices' numbers from the end of the mesh.
    """
    mesh_islands.checked_extent(min_extent)
    done, pieces = 0, 0
    links, boxes = [np.zeros((0, 2), np.int32)], [np.zeros((0, 6), np.float32)]
    for part in parts:
        count = len(part.vertices)
        own = done + count - np.arange(count)  # its vertices' numbers
        ids = np.union1d(part.faces, own)  # ascending: those of parts before come first
        label = mesh_islands.pieces(np.searchsorted(ids, part.faces).astype(np.int32), len(ids))
        _, piece = np.unique(label, return_inverse=True)
        piece = piece.astype(np.int32) + np.int32(pieces)
        before = ids[ids <= done]
        links.append(np.unique(np.stack((piece[: len(before)], number[before]), axis=1), axis=0))
        number[done + 1 : done + count + 1] = piece[len(before) :]
        boxes.append(
            _boxes(
                part.vertices, piece[len(before) :][::-1] - pieces, int(piece.max(initial=-1)) + 1 - pieces
            )
        )
        pieces += len(boxes[-1])
        done += count
    a, b = np.concatenate(links).T
    whole = mesh_islands.linked(a, b, pieces)
    box = np.concatenate(boxes)
    low, high = np.full((pieces, 3), np.inf), np.full((pieces, 3), -np.inf)
    np.minimum.at(low, whole, box[:, :3])
    np.maximum.at(high, whole, box[:, 3:])
    small = np.linalg.norm(high - low, axis=1) < min_extent
    return Islands(small[whole], int(small[np.unique(whole)].sum()))


def _boxes(vertices: NDArray[np.float32], piece: NDArray[np.int32], pieces: int) -> NDArray[np.float32]:
    """(pieces, 6): lowest and highest corner of each piece's vertices; turned inside out without any."""
    boxes = np.tile(np.repeat(np.array((np.inf, -np.inf), np.float32), 3), (pieces, 1))
    order = np.argsort(piece, kind="stable")
    found, first = np.unique(piece[order], return_index=True)
    if len(found):
        boxes[found, :3] = np.minimum.reduceat(vertices[order], first, axis=0)
        boxes[found, 3:] = np.maximum.reduceat(vertices[order], first, axis=0)
    return boxes


def without(parts: Iterable[Any], number: NDArray[np.int32], islands: Islands) -> Iterator[Any]:
    """The parts without the islands; `number` becomes the new numbers of the vertices, 0 where left out."""
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
