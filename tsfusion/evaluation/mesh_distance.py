# SPDX-License-Identifier: MIT
"""Measure the distance of points from the triangles of a mesh.

Balls of similar size cover each triangle. Their centres are in a k-d tree. A triangle is never nearer than a
centre's distance less its radius, so only triangles that can be the nearest are measured.
"""

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import needing

MOST_CANDIDATES = 256  # balls for each point, at most
SLACK = 0.02  # share of the distance by which it may be too long
_FIRST_CANDIDATES = 16
_BALLS = 400_000  # balls for all large triangles, at most

Triangles = NDArray[np.float64]  # (n, 3, 3)


class MeshDistance:
    """Unsigned distance from a mesh: exact near the mesh, elsewhere too long by `SLACK` of itself at most.

    If more than `MOST_CANDIDATES` balls have about the same distance, as from the centre of a sphere, the
    distance is too long by a `radius` at most.

    Args:
        vertices: (n, 3) metres.
        faces: (m, 3) integers, at least one triangle.

    Attributes:
        radius: radius of the largest ball, metres.

    Raises:
        MissingDependency: scipy is not installed.
    """

    def __init__(self, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> None:
        self._triangles = np.asarray(vertices, np.float64)[faces]
        centres, self._of, self._radii = _covered(self._triangles)
        self.radius = float(self._radii.max())
        self._tree = tree_of(centres)

    def __call__(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the distances of (n, 3) points, (n,) metres."""
        where: NDArray[np.float64] = np.asarray(points, np.float64)
        nearest = np.full(len(points), np.inf)
        left, count = np.arange(len(points)), _FIRST_CANDIDATES
        while len(left):
            count = min(count, len(self._of))
            nearest[left], is_sure = self._among(where[left], count)
            if count in (MOST_CANDIDATES, len(self._of)):
                break
            left, count = left[~is_sure], min(4 * count, MOST_CANDIDATES)
        return nearest

    def _among(
        self, points: NDArray[np.float64], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return distances to triangles of the `count` nearest balls; and True if no other is much nearer."""
        to_centre, index = self._tree.query(points, k=count)
        to_centre, index = to_centre.reshape(len(points), -1), index.reshape(len(points), -1)
        best = self._measure(points, index[:, 0])
        row, column = np.nonzero(to_centre - self._radii[index] < best[:, None])
        other = column > 0
        row, column = row[other], column[other]
        np.minimum.at(best, row, self._measure(points[row], index[row, column]))
        return best, (1 - SLACK) * best <= to_centre[:, -1] - self.radius

    def _measure(self, points: NDArray[np.float64], ball: NDArray[np.int64]) -> NDArray[np.float64]:
        from trimesh.triangles import closest_point

        if not len(points):
            return np.zeros(0)
        on_mesh = closest_point(self._triangles[self._of[ball]], points)
        distance: NDArray[np.float64] = np.linalg.norm(points - on_mesh, axis=1)
        return distance


def tree_of(points: NDArray[np.float64]) -> "cKDTree":  # type: ignore[name-defined]  # noqa: F821
    """Return a k-d tree of (n, 3) points. Raise MissingDependency without scipy."""
    with needing("measuring distances needs scipy: pip install '.[slam]' in your clone of tsfusion"):
        from scipy.spatial import cKDTree
    return cKDTree(points)


def _covered(triangles: Triangles) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Cover triangles with balls. Return (n, 3) centres, (n,) triangles that they belong to, (n,) radii."""
    edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)  # a vertex and the next
    longest, base = edges.max(axis=1), edges.argmax(axis=1)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    height = np.linalg.norm(cross, axis=1) / np.maximum(longest, 1e-30)
    step = 2 * np.sqrt((longest * height).sum() / _BALLS) or longest.max() / _BALLS or 1.0
    while True:
        large = np.flatnonzero(longest > step)
        rows, columns = (np.ceil(size[large] / step).astype(np.int64) for size in (height, longest))
        rows, columns = np.maximum(rows, 1), columns + 1
        if not len(large) or (rows * columns).sum() <= _BALLS:
            break
        step *= 1.5
    small = np.flatnonzero(longest <= step)
    centres = triangles[small].mean(axis=1)
    radii = np.linalg.norm(triangles[small] - centres[:, None], axis=2).max(axis=1)
    on_large, of_large = _rows_of_points(triangles[large], base[large], rows, columns)
    reach = np.full(len(of_large), step * np.hypot(1, 0.5))  # to the next row, half a step along the row
    return (
        np.concatenate([centres, on_large]),
        np.concatenate([small, large[of_large]]),
        np.concatenate([radii, reach]),
    )


def _rows_of_points(
    triangles: Triangles, base: NDArray[np.int64], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points in rows parallel to each triangle's longest edge, and the triangle of each point.

    The first row is on that edge. Rows get shorter towards the opposite corner, on both sides. So whatever
    lies above a row is beside points of the row.
    """
    of = np.repeat(np.arange(len(triangles)), rows * columns)
    index = np.arange(len(of)) - np.repeat(np.cumsum(rows * columns) - rows * columns, rows * columns)
    up = (index // columns[of] / rows[of])[:, None]
    along = (index % columns[of] / np.maximum(columns[of] - 1, 1))[:, None]
    start, end, top = (triangles[of, (base[of] + corner) % 3] for corner in range(3))
    left, right = start + up * (top - start), end + up * (top - end)
    points: NDArray[np.float64] = left + along * (right - left)
    return points, of
