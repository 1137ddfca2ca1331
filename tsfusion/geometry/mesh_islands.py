# SPDX-License-Identifier: MIT
"""Islands: small pieces of a mesh that hang together with nothing else, mostly noise."""

import numpy as np
from numpy.typing import NDArray

ISLAND = 50  # vertices that a piece needs to be none: marching cubes makes about one on each voxel's face


def find(faces: NDArray[np.int32], vertices: int) -> NDArray[np.bool_]:
    """Which of `vertices` vertices belong to pieces of fewer than `ISLAND` vertices: (n,) bool.

    That is as much surface as 7 × 7 voxels, 14 cm across at 2 cm. None where most triangles would be on
    islands: then they are the scene.
    """
    label = pieces(faces, vertices)
    small = (np.bincount(label, minlength=1) < ISLAND)[label]
    return small if 2 * small[faces[:, 0]].sum() <= len(faces) else np.zeros(vertices, bool)


def count(faces: NDArray[np.int32], islands: NDArray[np.bool_]) -> int:
    """Number of pieces with triangles among the vertices that `find` found."""
    inside = faces[islands[faces[:, 0]]]
    return len(np.unique(pieces(inside, len(islands))[inside[:, 0]]))


def pieces(faces: NDArray[np.int32], vertices: int) -> NDArray[np.int32]:
    """For each of `vertices` vertices the lowest number of a vertex that triangles connect it with: (n,).

    Labels go down along every edge, and each vertex jumps to its label's label, until nothing changes.
    """
    label = np.arange(vertices, dtype=np.int32)
    a, b = np.concatenate((faces[:, :2], faces[:, 1:])).T
    while len(a):
        low = np.minimum(label[a], label[b])
        np.minimum.at(label, label[a], low)
        np.minimum.at(label, label[b], low)
        while not np.array_equal(label, jumped := label[label]):
            label = jumped
        apart = label[a] != label[b]
        a, b = a[apart], b[apart]
    return label
