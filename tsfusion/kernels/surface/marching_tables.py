# SPDX-License-Identifier: MIT
"""Derive the cases of marching cubes, instead of listing them.

The surface crosses a cube's face in segments that depend only on that face's four signs. On an ambiguous
face, inside corners are cut off one by one. So two cells agree on a shared face: no cracks. The segments
close into loops. A loop is triangulated without a diagonal in a cube face, where the neighbouring cell could
have one too: at most two triangles share an edge.

Corner c has offsets (c & 1, c >> 1 & 1, c >> 2 & 1) in x, y, z. Edge e = 4·axis + k runs along `axis` from
the corner `EDGE_CORNER[e]`.
"""

from functools import lru_cache

import numpy as np

CORNERS = [(c & 1, c >> 1 & 1, c >> 2 & 1) for c in range(8)]
EDGES = [(c, c | 1 << axis) for axis in range(3) for c in range(8) if not c >> axis & 1]
EDGE_CORNER = np.array([a for a, _ in EDGES], np.int32)
EDGE_AXIS = np.array([e // 4 for e in range(12)], np.int32)
_EDGE_OF = {frozenset(pair): e for e, pair in enumerate(EDGES)}
MAX_TRIANGLES = 5


def _faces() -> list[list[int]]:
    faces = []
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        ring = [0, 1 << b, 1 << b | 1 << c, 1 << c]
        faces.append([corner | 1 << axis for corner in ring])  # +axis
        faces.append(list(reversed(ring)))  # −axis
    return faces


FACES = _faces()


def _segments(case: int) -> dict[int, int]:
    """Return the segments of a case on all cube faces: cube edge → next edge. Their loops turn
    counter-clockwise seen from outside. Inside corners have their bit set in `case`."""
    following = {}
    for face in FACES:
        inside = [case >> corner & 1 for corner in face]
        for i in range(4):
            if inside[i] and not inside[i - 1]:
                # One segment cuts off the run of inside corners that starts at i; on an ambiguous face both
                # runs have length one
                j = i
                while inside[(j + 1) % 4]:
                    j += 1
                enter = _EDGE_OF[frozenset((face[i - 1], face[i]))]
                leave = _EDGE_OF[frozenset((face[j % 4], face[(j + 1) % 4]))]
                following[enter] = leave
    return following


def _loops(case: int) -> list[list[int]]:
    following = _segments(case)
    loops = []
    while following:
        start = min(following)
        loop, edge = [], start
        while edge in following:
            loop.append(edge)
            edge = following.pop(edge)
        loops.append(loop)
    return loops


def _share_face(a: int, b: int) -> bool:
    return any(set(EDGES[a]) <= set(face) and set(EDGES[b]) <= set(face) for face in FACES)


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Return the triangles of a polygon of cube edges, without a diagonal in a cube face."""

    @lru_cache(maxsize=None)
    def best(i: int, j: int) -> tuple[tuple[int, int, int], ...] | None:
        if j - i < 2:
            return ()
        for k in range(i + 1, j):
            diagonals = [(a, b) for a, b in ((i, k), (k, j)) if b - a > 1]
            if any(_share_face(loop[a], loop[b]) for a, b in diagonals):
                continue
            left, right = best(i, k), best(k, j)
            if left is not None and right is not None:
                return (*left, (loop[i], loop[k], loop[j]), *right)
        return None

    triangles = best(0, len(loop) - 1)
    return None if triangles is None else list(triangles)


def _table() -> tuple[np.ndarray, np.ndarray]:
    counts = np.zeros(256, np.int32)
    edges = np.full((256, MAX_TRIANGLES * 3), -1, np.int32)
    for case in range(256):
        triangles = []
        for loop in _loops(case):
            # A rotation of the loop is the same polygon, but another root for the recursion
            options = (_triangulate(loop[s:] + loop[:s]) for s in range(len(loop)))
            chosen = next((t for t in options if t is not None), None)
            if chosen is None:
                raise RuntimeError(f"case {case} has no triangulation inside its cube")
            triangles += chosen
        counts[case] = len(triangles)
        edges[case, : 3 * len(triangles)] = np.array(triangles, np.int32).ravel()
    return counts, edges


TRIANGLE_COUNT, TRIANGLE_EDGES = _table()
# The same, each edge as 8·axis + the corner it starts from
TRIANGLE_STARTS = np.where(TRIANGLE_EDGES < 0, 0, 8 * EDGE_AXIS[TRIANGLE_EDGES] + EDGE_CORNER[TRIANGLE_EDGES])
