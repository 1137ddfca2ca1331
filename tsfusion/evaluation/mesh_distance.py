# SPDX-License-Identifier: MIT
"""Distance of points from the triangles of a mesh.

Triangles are cut into pieces of like size, whose centres are in a k-d tree. A piece is no nearer than its
centre less its radius: only those are measured that can be the nearest.
"""

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import MissingDependency

MOST_CANDIDATES = 256  # pieces a point
_FIRST_CANDIDATES = 16
SLACK = 0.02  # of the distance: what it may be too long
_PIECES = 200_000  # that a mesh is cut into, about; it has one a triangle at the least
_MOST_PIECES = 4_000_000

Triangles = NDArray[np.float64]  # (n, 3, 3)


class MeshDistance:
    """Unsigned distance from a mesh: exact nearby, elsewhere at most `SLACK` of itself too long.

    Where more than `MOST_CANDIDATES` pieces may be the nearest, as from the centre of a sphere, at most a
    `piece` too long.

    Args:
        vertices: (n, 3) metres.
        faces: (m, 3) integers, one at least.

    Attributes:
        piece: radius of the largest piece, metres.

    Raises:
        MissingDependency: without scipy.
    """

    def __init__(self, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> None:
        self._pieces = _cut(np.asarray(vertices, np.float64)[faces])
        centres = self._pieces.mean(axis=1)
        self._radii = np.linalg.norm(self._pieces - centres[:, None], axis=2).max(axis=1)
        self.piece = float(self._radii.max())
        self._tree = tree_of(centres)

    def __call__(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(n,) metres from (n, 3) points."""
        where: NDArray[np.float64] = np.asarray(points, np.float64)
        nearest = np.full(len(points), np.inf)
        left, count = np.arange(len(points)), _FIRST_CANDIDATES
        while len(left):
            count = min(count, len(self._pieces))
            nearest[left], is_sure = self._among(where[left], count)
            if count in (MOST_CANDIDATES, len(self._pieces)):
                break
            left, count = left[~is_sure], min(4 * count, MOST_CANDIDATES)
        return nearest

    def _among(
        self, points: NDArray[np.float64], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Distances from the pieces with the nearest centres, and whether no other can be much nearer."""
        to_centre, index = self._tree.query(points, k=count)
        to_centre, index = to_centre.reshape(len(points), -1), index.reshape(len(points), -1)
        best = self._measure(points, index[:, 0])
        row, column = np.nonzero(to_centre - self._radii[index] < best[:, None])
        other = column > 0
        row, column = row[other], column[other]
        np.minimum.at(best, row, self._measure(points[row], index[row, column]))
        return best, (1 - SLACK) * best <= to_centre[:, -1] - self.piece

    def _measure(self, points: NDArray[np.float64], piece: NDArray[np.int64]) -> NDArray[np.float64]:
        from trimesh.triangles import closest_point

        if not len(points):
            return np.zeros(0)
        on_piece = closest_point(self._pieces[piece], points)
        distance: NDArray[np.float64] = np.linalg.norm(points - on_piece, axis=1)
        return distance


def tree_of(points: NDArray[np.float64]) -> "cKDTree":  # type: ignore[name-defined]  # noqa: F821
    """A k-d tree of (n, 3) points; raises MissingDependency without scipy."""
    try:
        from scipy.spatial import cKDTree
    except ImportError as error:
        raise MissingDependency(
            "measuring distances needs scipy: pip install '.[slam]' in your clone of tsfusion"
        ) from error
    return cKDTree(points)


def _cut(triangles: Triangles) -> Triangles:
    """Halve triangles across their longest edges until none is much larger than a share of the surface."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    longest = 2 * np.sqrt(np.linalg.norm(cross, axis=1).sum() / 2 / _PIECES)
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)  # a vertex and the next
        is_large = edges.max(axis=1) > longest
        done.append(triangles[~is_large])
        large, from_ = triangles[is_large], edges[is_large].argmax(axis=1)
        if 2 * len(large) + sum(map(len, done)) > _MOST_PIECES:
            done.append(large)
            break
        rows = np.arange(len(large))
        middle = (large[rows, from_] + large[rows, (from_ + 1) % 3]) / 2
        first, second = large.copy(), large.copy()
        first[rows, from_], second[rows, (from_ + 1) % 3] = middle, middle
        triangles = np.concatenate([first, second])
    return np.concatenate(done)
