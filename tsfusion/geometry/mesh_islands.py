# SPDX-License-Identifier: MIT
"""Islands: small pieces of a mesh that hang together with nothing else, mostly noise."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig

ISLAND = 50  # vertices that a piece needs to be none: marching cubes makes about one on each voxel's face


def find(faces: NDArray[np.int32], vertices: int) -> NDArray[np.bool_]:
    """Vertices, of `vertices`, that belong to pieces of fewer than `ISLAND` vertices: (n,) bool.

    That is as much surface as 7 × 7 voxels, 14 cm across at 2 cm. None where most triangles would be on
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
    """A least extent of pieces; raises InvalidConfig for one that is none."""
    if not 0 <= min_extent < np.inf:
        raise InvalidConfig(f"the least extent of a piece must be 0 metres or more, got {min_extent}")
    return min_extent


def count(faces: NDArray[np.int32], islands: NDArray[np.bool_]) -> int:
    """Number of pieces with triangles among the vertices that `find` found."""
    inside = faces[islands[faces[:, 0]]]
    return len(np.unique(pieces(inside, len(islands))[inside[:, 0]]))


def pieces(faces: NDArray[np.int32], vertices: int) -> NDArray[np.int32]:
    """For each of `vertices` vertices the lowest number of a vertex that triangles connect it with: (n,)."""
    a, b = np.concatenate((faces[:, :2], faces[:, 1:])).T
    return linked(a, b, vertices)


def linked(a: NDArray[np.int32], b: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """For each of `count` things the lowest number of one that links a[i]–b[i] connect it with: (n,).

    Labels go down along every link, and each thing jumps to its label's label, until nothing changes.
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
