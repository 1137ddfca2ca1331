# SPDX-License-Identifier: MIT
"""Marching cubes on a list of blocks. Every vertex belongs to one voxel edge and exists once, whichever
block's cells use it: no cracks, no duplicates.

Each block's values are first gathered with a border of one voxel below and two above (11³, NaN where
unseen), so that everything after reads one dense array.
"""

import taichi as ti

from tsfusion.kernels.integrate import CUBE, lane_distance, lane_weight
from tsfusion.kernels.traversal import RUN, unpack, vec3i

PAD = 11
PADDED = PAD * PAD * PAD
GREY = 160

vec3f = ti.types.vector(3, ti.f32)


@ti.func
def at(x, y, z):
    """Index in the padded block of voxel (x, y, z), −1 ≤ x ≤ 9."""
    return ((x + 1) * PAD + y + 1) * PAD + z + 1


@ti.func
def voxel_of(o):
    return vec3i(o >> 6, (o >> 3) & 7, o & 7)


@ti.func
def neighbour_of(p):
    """Which of the 27 blocks around (13 = itself) holds the voxel with block-relative coordinates p."""
    return ((p[0] >> 3) + 1) * 9 + ((p[1] >> 3) + 1) * 3 + (p[2] >> 3) + 1


@ti.kernel
def gather_values(
    count: ti.i32,
    neighbours: ti.types.ndarray(dtype=ti.i32, ndim=2),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    regularised: ti.types.ndarray(dtype=ti.f32, ndim=2),
    use_regularised: ti.i32,
    min_weight: ti.i32,
    padded: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    """Fill `padded` (blocks, 11³) with smoothed or raw values in quanta; NaN below `min_weight`."""
    for run in range(count * RUN):
        if run % RUN == 0:
            b = run // RUN
            for x in range(-1, 10):
                for y in range(-1, 10):
                    for z in range(-1, 10):
                        p = vec3i(x, y, z)
                        slot = neighbours[b, neighbour_of(p)]
                        value = ti.math.nan
                        if slot >= 0:
                            o = ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)
                            packed = sums[slot, o]
                            w = lane_weight(packed)
                            if w >= min_weight:
                                if use_regularised == 1:
                                    value = (
                                        ti.cast(lane_distance(packed), ti.f32) + regularised[slot, o]
                                    ) / ti.cast(w, ti.f32)
                                else:
                                    value = ti.cast(lane_distance(packed), ti.f32) / ti.cast(w, ti.f32)
                        padded[b, at(x, y, z)] = value


@ti.func
def cell_case(padded: ti.template(), b, p):
    """Which corners of the cell at p are inside (value < 0); −1 if any is unseen."""
    case = 0
    for c in ti.static(range(8)):
        value = padded[b, at(p[0] + (c & 1), p[1] + (c >> 1 & 1), p[2] + (c >> 2 & 1))]
        if not (value == value):
            case = -1
        elif case >= 0 and value < 0.0:
            case |= 1 << c
    return case


@ti.func
def crosses(a, b):
    return a == a and b == b and (a < 0.0) != (b < 0.0)


@ti.kernel
def count_elements(
    count: ti.i32,
    meshed: ti.types.ndarray(dtype=ti.u8, ndim=2),  # are the cells of each of the 27 blocks wanted?
    padded: ti.types.ndarray(dtype=ti.f32, ndim=2),
    triangle_count: ti.types.ndarray(dtype=ti.i32, ndim=1),
    first: ti.i32,  # of this batch, in the arrays below
    cases: ti.types.ndarray(dtype=ti.u8, ndim=2),
    edges: ti.types.ndarray(dtype=ti.i32, ndim=2),  # per voxel: vertices before it in its block << 3 | axes
    vertices: ti.types.ndarray(dtype=ti.i32, ndim=1),
    triangles: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Per block: each cell's case, and which voxel edges carry a vertex (crossed, in a wanted whole cell)."""
    for run in range(count * RUN):
        if run % RUN == 0:
            b = run // RUN
            vertex_total = 0
            triangle_total = 0
            for o in range(CUBE):
                p = voxel_of(o)
                here = padded[b, at(p[0], p[1], p[2])]
                axes = 0
                case = 0
                if here == here:
                    if meshed[b, 13] == 1:
                        case = ti.max(cell_case(padded, b, p), 0)
                    for axis in ti.static(range(3)):
                        end = p
                        end[axis] += 1
                        if crosses(here, padded[b, at(end[0], end[1], end[2])]):
                            used = 0
                            for k in ti.static(range(4)):
                                cell = p
                                cell[(axis + 1) % 3] -= k & 1
                                cell[(axis + 2) % 3] -= k >> 1
                                if meshed[b, neighbour_of(cell)] == 1 and cell_case(padded, b, cell) >= 0:
                                    used = 1
                            axes |= used << axis
                cases[first + b, o] = ti.cast(case, ti.u8)
                triangle_total += triangle_count[case]
                edges[first + b, o] = (vertex_total << 3) | axes
                vertex_total += (axes & 1) + (axes >> 1 & 1) + (axes >> 2 & 1)
            vertices[first + b] = vertex_total
            triangles[first + b] = triangle_total


@ti.func
def slope(padded: ti.template(), b, p, axis):
    """Central difference along an axis, one-sided at the edge of what was seen."""
    low = p
    high = p
    low[axis] -= 1
    high[axis] += 1
    before = padded[b, at(low[0], low[1], low[2])]
    here = padded[b, at(p[0], p[1], p[2])]
    after = padded[b, at(high[0], high[1], high[2])]
    result = ti.f32(0.0)
    if before == before and after == after:
        result = 0.5 * (after - before)
    elif after == after:
        result = after - here
    elif before == before:
        result = here - before
    return result


@ti.func
def add_color(
    neighbours: ti.template(), b, p, share, color_rgn: ti.template(), color_b: ti.template(), total
):
    """Add the mean colour at voxel p, weighted; the fourth element counts the weight."""
    slot = neighbours[b, neighbour_of(p)]
    result = total
    if slot >= 0:
        o = ((p[0] & 7) << 6) | ((p[1] & 7) << 3) | (p[2] & 7)
        packed = color_rgn[slot, o]
        n = ti.cast(packed & 65535, ti.f32)
        if n > 0.0:
            red = ti.cast((packed >> 40) & 16777215, ti.f32)
            green = ti.cast((packed >> 16) & 16777215, ti.f32)
            blue = ti.cast(color_b[slot, o], ti.f32)
            result += share * ti.Vector([red / n, green / n, blue / n, 1.0])
    return result


@ti.kernel
def emit_vertices(
    count: ti.i32,
    keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    neighbours: ti.types.ndarray(dtype=ti.i32, ndim=2),
    padded: ti.types.ndarray(dtype=ti.f32, ndim=2),
    first: ti.i32,
    edges: ti.types.ndarray(dtype=ti.i32, ndim=2),
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),  # first vertex of each block, from the batch's own
    voxel_size: ti.f64,
    color_rgn: ti.types.ndarray(dtype=ti.i64, ndim=2),
    color_b: ti.types.ndarray(dtype=ti.i32, ndim=2),
    has_color: ti.i32,
    positions: ti.types.ndarray(dtype=ti.f32, ndim=2),
    normals: ti.types.ndarray(dtype=ti.f32, ndim=2),
    colors: ti.types.ndarray(dtype=ti.u8, ndim=2),
):
    """Position, unit normal and colour of every vertex: where the value crosses zero along its edge."""
    for run in range(count * RUN):
        if run % RUN == 0:
            b = run // RUN
            corner = unpack(keys[b]) * 8
            for o in range(CUBE):
                axes = edges[first + b, o] & 7
                vertex = starts[b] + (edges[first + b, o] >> 3)
                p = voxel_of(o)
                for axis in ti.static(range(3)):
                    if axes >> axis & 1 == 1:
                        q = p
                        q[axis] += 1
                        here = padded[b, at(p[0], p[1], p[2])]
                        there = padded[b, at(q[0], q[1], q[2])]
                        # kept off the voxel centres, where the vertices of several edges would fall together
                        t = ti.min(ti.max(here / (here - there), 0.001), 0.999)
                        normal = vec3f(0.0)
                        for a in ti.static(range(3)):
                            position = ti.cast(corner[a] + p[a], ti.f64) + 0.5
                            if ti.static(a == axis):
                                position += ti.cast(t, ti.f64)
                            positions[vertex, a] = ti.cast(position * voxel_size, ti.f32)
                            normal[a] = (1.0 - t) * slope(padded, b, p, a) + t * slope(padded, b, q, a)
                        length = normal.norm()
                        if not (length > 0.0):
                            normal = vec3f(0.0)
                            normal[axis] = ti.select(there > here, 1.0, -1.0)
                            length = 1.0
                        for a in ti.static(range(3)):
                            normals[vertex, a] = normal[a] / length
                        if has_color == 1:
                            total = ti.Vector([0.0, 0.0, 0.0, 0.0])
                            total = add_color(neighbours, b, p, 1.0 - t, color_rgn, color_b, total)
                            total = add_color(neighbours, b, q, t, color_rgn, color_b, total)
                            if total[3] == 0.0:  # the surface moved off the voxels that rays ended in
                                for n in range(27):
                                    r = p + vec3i(n // 9 - 1, n // 3 % 3 - 1, n % 3 - 1)
                                    total = add_color(neighbours, b, r, 1.0, color_rgn, color_b, total)
                            for a in ti.static(range(3)):
                                shade = ti.cast(GREY, ti.f32)
                                if total[3] > 0.0:
                                    shade = total[a] / total[3]
                                colors[vertex, a] = ti.cast(shade + 0.5, ti.u8)
                        vertex += 1


@ti.kernel
def emit_faces(
    cases: ti.types.ndarray(dtype=ti.u8, ndim=2),
    edges: ti.types.ndarray(dtype=ti.i32, ndim=2),
    forward: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (blocks, 8): index of the block at +x, +y, +z
    first_vertex: ti.types.ndarray(dtype=ti.i32, ndim=1),
    first_triangle: ti.types.ndarray(dtype=ti.i32, ndim=1),
    triangle_count: ti.types.ndarray(dtype=ti.i32, ndim=1),
    triangle_edges: ti.types.ndarray(dtype=ti.i32, ndim=2),
    edge_corner: ti.types.ndarray(dtype=ti.i32, ndim=1),
    faces: ti.types.ndarray(dtype=ti.i32, ndim=2),
):
    """Each cell's triangles, as the numbers of the vertices on its edges."""
    for run in range(cases.shape[0] * RUN):
        if run % RUN == 0:
            b = run // RUN
            face = first_triangle[b]
            for o in range(CUBE):
                case = ti.cast(cases[b, o], ti.i32)
                p = voxel_of(o)
                for n in range(triangle_count[case]):
                    for k in range(3):
                        e = triangle_edges[case, 3 * n + k]
                        corner = edge_corner[e]
                        q = p + vec3i(corner & 1, corner >> 1 & 1, corner >> 2 & 1)
                        owner = forward[b, (q[0] >> 3) | (q[1] >> 3) << 1 | (q[2] >> 3) << 2]
                        entry = edges[owner, ((q[0] & 7) << 6) | ((q[1] & 7) << 3) | (q[2] & 7)]
                        axis = e >> 2
                        before = 0
                        if axis > 0:
                            before += entry & 1
                        if axis > 1:
                            before += entry >> 1 & 1
                        faces[face, k] = first_vertex[owner] + (entry >> 3) + before
                    face += 1
