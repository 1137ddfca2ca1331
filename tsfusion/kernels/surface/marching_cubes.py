# SPDX-License-Identifier: MIT
"""Make vertices and triangles by marching cubes, for the cells that `surface_cells.py` found. Each vertex
belongs to one voxel edge and exists once for the cells of all blocks: no cracks, no duplicates.

The 256 cases are derived, not listed. The surface crosses a cube's face in segments that depend only on that
face's four signs. On an ambiguous face, inside corners are cut off one by one. So two cells agree on a shared
face: no cracks. The segments close into loops. A loop is triangulated without a diagonal in a cube face,
where the neighbouring cell could have one too: at most two triangles share an edge.

Corner c has offsets (c & 1, c >> 1 & 1, c >> 2 & 1) in x, y, z. Edge e = 4·axis + k runs along `axis` from
the corner `EDGE_CORNER[e]`.

Vertices are numbered by block, x, axis of their edge, y, z. A set bit in one of a block's 24 bit planes (8 x,
3 axes) is a vertex; its number is the start of its plane plus the number of set bits before its own.
"""

from functools import lru_cache

import numpy as np

from tsfusion.kernels import I32, I64, F32x2, I32x2, I64x2, U8x2, U64x2, ti
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.voxel_traversal import unpack, vec3i
from tsfusion.kernels.surface.surface_cells import STRIPS, case_of, corner_planes, lowest

PAD = 11  # a block with a border of one voxel before and two behind
PADDED = PAD * PAD * PAD
GREY = 160

vec3f = ti.types.vector(3, ti.f32)

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


@ti.func
def neighbour_of(p):
    """Return the index, among the 27 blocks around (13 = itself), of the block with relative voxel p."""
    return ((p[0] >> 3) + 1) * 9 + ((p[1] >> 3) + 1) * 3 + (p[2] >> 3) + 1


@ti.func
def gather(r, count, first, last, around: ti.template(), values: ti.template(), padded: ti.template(), strip):
    """Copy a block's values with a border of one voxel to `padded[strip]`, first ≤ x < last; NaN: unseen."""
    for x in range(first, last):
        for y in range(-1, 10):
            to = ((x + 1) * PAD + y + 1) * PAD + 1
            o = ((x & 7) << 6) | ((y & 7) << 3)
            k = ((x >> 3) + 1) * 9 + ((y >> 3) + 1) * 3 + 1
            below = around[r, k - 1]
            middle = around[r, k]
            above = around[r, k + 1]
            padded[strip, to - 1] = ti.math.nan
            if below < count:
                padded[strip, to - 1] = values[below, o + 7]
            run = ti.Vector([ti.math.nan] * 8)
            if middle < count:
                for z in ti.static(range(8)):
                    run[z] = values[middle, o + z]
            for z in ti.static(range(8)):
                padded[strip, to + z] = run[z]
            padded[strip, to + 8] = ti.math.nan
            padded[strip, to + 9] = ti.math.nan
            if above < count:
                padded[strip, to + 8] = values[above, o]
                padded[strip, to + 9] = values[above, o + 1]


@ti.func
def slope(padded: ti.template(), strip, i, step):
    """Return the central difference of the values at i, one-sided beside unseen voxels."""
    before = padded[strip, i - step]
    here = padded[strip, i]
    after = padded[strip, i + step]
    result = ti.f32(0.0)
    if before == before and after == after:
        result = 0.5 * (after - before)
    elif after == after:
        result = after - here
    elif before == before:
        result = here - before
    return result


@ti.func
def normal_at(padded: ti.template(), strip, i, axis, t):
    """Return the unit gradient of the distance at share t (0 … 1) of the voxel edge that starts at i."""
    step = axis_step(axis)
    normal = vec3f(0.0)
    for a in ti.static(range(3)):
        s = axis_step(a)
        one = padded[strip, i + s] - padded[strip, i - s]
        other = padded[strip, i + step + s] - padded[strip, i + step - s]
        normal[a] = (1.0 - t) * one + t * other
    length = normal.norm()
    if not (length == length):  # a neighbour is unseen
        for a in ti.static(range(3)):
            s = axis_step(a)
            normal[a] = (1.0 - t) * slope(padded, strip, i, s) + t * slope(padded, strip, i + step, s)
        length = normal.norm()
    if not (length > 0.0):
        length = 1.0
        rising = padded[strip, i + step] > padded[strip, i]
        for a in ti.static(range(3)):
            normal[a] = ti.select(a == axis, ti.select(rising, 1.0, -1.0), 0.0)
    return normal * (1.0 / length)


@ti.func
def axis_step(axis):
    """Return the index distance in `padded` between neighbours along an axis."""
    return ti.select(axis == 0, PAD * PAD, ti.select(axis == 1, PAD, 1))


@ti.func
def add_color(
    slots: ti.template(), around: ti.template(), r, p, share, rgn: ti.template(), b: ti.template(), total
):
    """Add to `total` the mean colour at voxel p times `share`; its fourth element sums the shares."""
    row = r
    if ((p[0] | p[1] | p[2]) & ~7) != 0:
        row = around[r, neighbour_of(p)]
    slot = slots[row]
    result = total
    if slot >= 0:
        o = ((p[0] & 7) << 6) | ((p[1] & 7) << 3) | (p[2] & 7)
        packed = rgn[slot, o]
        n = ti.cast(packed & 65535, ti.f32)
        if n > 0.0:
            red = ti.cast((packed >> 40) & 16777215, ti.f32)
            green = ti.cast((packed >> 16) & 16777215, ti.f32)
            blue = ti.cast(b[slot, o], ti.f32)
            result += share * ti.Vector([red / n, green / n, blue / n, 1.0])
    return result


@ti.func
def color_at(
    slots: ti.template(), around: ti.template(), r, p, axis, t, rgn: ti.template(), b: ti.template()
):
    """Return the rounded RGB colour at share t (0 … 1) of the edge of voxel p along `axis`."""
    q = p
    for a in ti.static(range(3)):
        q[a] += ti.cast(a == axis, ti.i32)
    total = ti.Vector([0.0, 0.0, 0.0, 0.0])
    total = add_color(slots, around, r, p, 1.0 - t, rgn, b, total)
    total = add_color(slots, around, r, q, t, rgn, b, total)
    if total[3] == 0.0:  # the surface is not in the voxels where rays ended
        for n in range(27):
            near = p + vec3i(n // 9 - 1, n // 3 % 3 - 1, n % 3 - 1)
            total = add_color(slots, around, r, near, 1.0, rgn, b, total)
    shade = vec3f(GREY)
    if total[3] > 0.0:
        for a in ti.static(range(3)):
            shade[a] = total[a] / total[3]
    return shade + 0.5


@QuickLaunch
@ti.kernel
def emit_vertices(
    count: ti.i32, keys: I64, around: I32x2, values: F32x2, edges: U64x2, first: I32x2, padded: F32x2,
    voxel_size: ti.f64, slots: I32, color_rgn: I64x2, color_b: I32x2, has_color: ti.i32, positions: F32x2,
    normals: F32x2, colors: U8x2,
):  # fmt: skip
    """Write position, unit normal and colour of every vertex: the zero crossing of the value on its edge."""
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                if first[r, 0] < first[r + 1, 0]:
                    low = 8
                    high = 0
                    for x in range(8):
                        if (edges[r, 3 * x] | edges[r, 3 * x + 1] | edges[r, 3 * x + 2]) != 0:
                            low = ti.min(low, x)
                            high = x
                    gather(r, count, low - 1, high + 3, around, values, padded, strip)
                    corner = unpack(keys[r]) * 8
                    vertex = first[r, 0]
                    for plane in range(3 * low, 3 * high + 3):
                        left = edges[r, plane]
                        axis = plane % 3
                        while left != 0:
                            j = lowest(left)
                            left &= left - ti.u64(1)
                            p = vec3i(plane // 3, j >> 3, j & 7)
                            i = ((p[0] + 1) * PAD + p[1] + 1) * PAD + p[2] + 1
                            here = padded[strip, i]
                            there = padded[strip, i + axis_step(axis)]
                            # Away from voxel centres, where vertices of several edges would coincide
                            t = ti.min(ti.max(here / (here - there), 0.001), 0.999)
                            normal = normal_at(padded, strip, i, axis, t)
                            for a in ti.static(range(3)):
                                along = ti.select(a == axis, ti.cast(t, ti.f64), ti.f64(0.0))
                                position = ti.cast(corner[a] + p[a], ti.f64) + 0.5 + along
                                positions[vertex, a] = ti.cast(position * voxel_size, ti.f32)
                                normals[vertex, a] = normal[a]
                            if has_color == 1:
                                color = color_at(slots, around, r, p, axis, t, color_rgn, color_b)
                                for a in ti.static(range(3)):
                                    colors[vertex, a] = ti.cast(color[a], ti.u8)
                            vertex += 1


@ti.func
def vertex_on(edges: ti.template(), starts: ti.template(), first: ti.template(), row, plane, j):
    """Return the number of the vertex on the edge of voxel j in bit plane `plane` of a block's edges."""
    before = edges[row, plane] & ((ti.u64(1) << ti.cast(j, ti.u64)) - ti.u64(1))
    return first[row, 0] + starts[row, plane] + ti.cast(ti.math.popcnt(before), ti.i32)


@QuickLaunch
@ti.kernel
def emit_faces(
    count: ti.i32, around: I32x2, inside: U64x2, active: U64x2, edges: U64x2, starts: I32x2, first: I32x2,
    triangle_count: I32, triangle_starts: I32x2, faces: I32x2,
):  # fmt: skip
    """Write the triangles of each cell, as the numbers of the vertices on its edges."""
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                face = first[r, 1]
                if face < first[r + 1, 1]:
                    low = corner_planes(inside, around, r, 0)
                    for x in range(8):
                        high = corner_planes(inside, around, r, x + 1)
                        left = active[r, x]
                        while left != 0:
                            j = lowest(left)
                            left &= left - ti.u64(1)
                            case = case_of(low, high, j)
                            for n in range(triangle_count[case]):
                                corners = vec3i(0)
                                for k in ti.static(range(3)):
                                    e = triangle_starts[case, 3 * n + k]
                                    q = vec3i(x + (e & 1), (j >> 3) + (e >> 1 & 1), (j & 7) + (e >> 2 & 1))
                                    owner = r
                                    if ((q[0] | q[1] | q[2]) & 8) != 0:
                                        owner = around[r, neighbour_of(q)]
                                    plane = 3 * (q[0] & 7) + (e >> 3)
                                    voxel = ((q[1] & 7) << 3) | (q[2] & 7)
                                    corners[k] = vertex_on(edges, starts, first, owner, plane, voxel)
                                for k in ti.static(range(3)):
                                    faces[face, k] = corners[k]
                                face += 1
                        low = high
