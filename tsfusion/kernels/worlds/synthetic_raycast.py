# SPDX-License-Identifier: MIT
"""Cast rays into synthetic worlds of analytic solids, with procedural colours.

A world is a table of solids (`datasets/worlds/worlds.py` names the columns). Every ray is independent and in
float64, so images do not depend on the thread count.
"""

from tsfusion.kernels import F64, I32, F64x2, U8x2, ti, tm
from tsfusion.kernels.worlds.synthetic_textures import solid_color

# Kinds of solid, column 0. Centre: columns 1-3, half sizes: 4-6, yaw cosine and sine: 7-8,
# material: 9, variant: 10, share of the length at the top (PRISM): 11.
ROOM, BOX, SPHERE, CYLINDER, GROUND, AXLE, PRISM = 0, 1, 2, 3, 4, 5, 6

vec3 = ti.types.vector(3, ti.f64)


@ti.func
def box_ray(o, d, half):
    """Return distances of entry and exit of a ray (o + t d) in a centred box; entry > exit = missed."""
    near, far = ti.f64(-1e9), ti.f64(1e9)
    for k in ti.static(range(3)):
        if d[k] == 0:
            if ti.abs(o[k]) > half[k]:
                near, far = ti.f64(1e9), ti.f64(-1e9)
        else:
            a, b = (-half[k] - o[k]) / d[k], (half[k] - o[k]) / d[k]
            near, far = ti.max(near, ti.min(a, b)), ti.min(far, ti.max(a, b))
    return near, far


@ti.func
def quadric_ray(a, b, c):
    """Return the interval of t (entry, exit) in which a t² + 2 b t + c < 0; entry > exit = none."""
    near, far = ti.f64(1e9), ti.f64(-1e9)
    if a == 0:
        if c < 0:
            near, far = ti.f64(-1e9), ti.f64(1e9)
    else:
        inside = b * b - a * c
        if inside > 0:
            root = ti.sqrt(inside)
            near, far = (-b - root) / a, (-b + root) / a
    return near, far


@ti.func
def prism_slope(half, top):
    """Return (k, c) of the planes |x| + k z = c, the slanted ends of a prism."""
    return half[0] * (1 - top) / (2 * half[2]), half[0] * (1 + top) / 2


@ti.func
def prism_ray(o, d, half, top):
    """Return distances of entry and exit of a ray in a centred prism; entry > exit = missed."""
    near, far = box_ray(o, d, half)
    k, c = prism_slope(half, top)
    for side in ti.static((-1, 1)):
        speed, ahead = side * d[0] + k * d[2], c - side * o[0] - k * o[2]
        if speed > 0:
            far = ti.min(far, ahead / speed)
        elif speed < 0:
            near = ti.max(near, ahead / speed)
        elif ahead < 0:
            near, far = ti.f64(1e9), ti.f64(-1e9)
    return near, far


@ti.func
def to_local(p, cosine, sine):
    """Rotate p about z from world axes into the axes of a solid."""
    return vec3(cosine * p[0] + sine * p[1], cosine * p[1] - sine * p[0], p[2])


@ti.func
def may_meet(solids: ti.template(), s, o, d):
    """Return True if the line meets the bounding ball of a solid: cheaper than `solid_ray`, no false miss."""
    kind = ti.i32(solids[s, 0])
    to_center = vec3(solids[s, 1], solids[s, 2], solids[s, 3]) - o
    half = vec3(solids[s, 4], solids[s, 5], solids[s, 6])
    along, length2 = to_center.dot(d), d.dot(d)
    miss2 = to_center.dot(to_center) * length2 - along * along
    return kind == ROOM or kind == GROUND or miss2 <= half.dot(half) * length2 * 1.001


@ti.func
def solid_ray(solids: ti.template(), s, o_world, d_world):
    """Return the distance at which the ray enters solid `s`, in lengths of `d_world`; 1e9 = never."""
    kind = ti.i32(solids[s, 0])
    cosine, sine = solids[s, 7], solids[s, 8]
    o = to_local(o_world - vec3(solids[s, 1], solids[s, 2], solids[s, 3]), cosine, sine)
    d = to_local(d_world, cosine, sine)
    half = vec3(solids[s, 4], solids[s, 5], solids[s, 6])
    near, far = ti.f64(1e9), ti.f64(-1e9)
    if kind == BOX:
        near, far = box_ray(o, d, half)
    elif kind == ROOM:
        _, far = box_ray(o, d, half)
        near = far
    elif kind == SPHERE:
        near, far = quadric_ray(d.dot(d), o.dot(d), o.dot(o) - half[0] * half[0])
    elif kind == CYLINDER:
        near, far = quadric_ray(
            d[0] * d[0] + d[1] * d[1],
            o[0] * d[0] + o[1] * d[1],
            o[0] * o[0] + o[1] * o[1] - half[0] * half[0],
        )
        bottom, top = box_ray(vec3(0, 0, o[2]), vec3(0, 0, d[2]), vec3(1, 1, half[2]))
        near, far = ti.max(near, bottom), ti.min(far, top)
    elif kind == AXLE:
        near, far = quadric_ray(
            d[0] * d[0] + d[2] * d[2],
            o[0] * d[0] + o[2] * d[2],
            o[0] * o[0] + o[2] * o[2] - half[0] * half[0],
        )
        left, right = box_ray(vec3(0, o[1], 0), vec3(0, d[1], 0), vec3(1, half[1], 1))
        near, far = ti.max(near, left), ti.min(far, right)
    elif kind == PRISM:
        near, far = prism_ray(o, d, half, solids[s, 11])
    elif d[2] < 0:
        near = -o[2] / d[2]
        far = near
    result = ti.f64(1e9)
    if near <= far and near > 0:
        result = near
    return result


@ti.func
def solid_distance(solids: ti.template(), s, p_world):
    """Return the signed distance to solid `s`, metres, negative inside."""
    kind = ti.i32(solids[s, 0])
    p = to_local(p_world - vec3(solids[s, 1], solids[s, 2], solids[s, 3]), solids[s, 7], solids[s, 8])
    half = vec3(solids[s, 4], solids[s, 5], solids[s, 6])
    q = ti.abs(p) - half
    result = p[2]
    if kind == BOX:
        result = tm.length(ti.max(q, 0.0)) + ti.min(ti.max(q[0], q[1], q[2]), 0.0)
    elif kind == ROOM:
        result = -ti.max(q[0], q[1], q[2])
    elif kind == SPHERE:
        result = tm.length(p) - half[0]
    elif kind == CYLINDER:
        radial = ti.sqrt(p[0] * p[0] + p[1] * p[1]) - half[0]
        outside = ti.sqrt(ti.max(radial, 0.0) ** 2 + ti.max(q[2], 0.0) ** 2)
        result = outside + ti.min(ti.max(radial, q[2]), 0.0)
    elif kind == AXLE:
        radial = ti.sqrt(p[0] * p[0] + p[2] * p[2]) - half[0]
        outside = ti.sqrt(ti.max(radial, 0.0) ** 2 + ti.max(q[1], 0.0) ** 2)
        result = outside + ti.min(ti.max(radial, q[1]), 0.0)
    elif kind == PRISM:  # a lower bound near its edges
        k, c = prism_slope(half, solids[s, 11])
        result = ti.max(q[1], q[2], (ti.abs(p[0]) + k * p[2] - c) / ti.sqrt(1 + k * k))
    return result


@ti.func
def solid_normal(solids: ti.template(), s, p_local):
    """Return the outward normal at a surface point, in the solid's own axes."""
    kind = ti.i32(solids[s, 0])
    half = vec3(solids[s, 4], solids[s, 5], solids[s, 6])
    normal = vec3(0, 0, 1)
    if kind == BOX or kind == ROOM:
        q = ti.abs(p_local) - half
        axis = 0
        if q[1] > q[axis]:
            axis = 1
        if q[2] > q[axis]:
            axis = 2
        side = tm.sign(p_local[axis])
        if kind == ROOM:
            side = -side
        normal = vec3(0, 0, 0)
        for k in ti.static(range(3)):
            if axis == k:
                normal[k] = side
    elif kind == SPHERE:
        normal = p_local / half[0]
    elif kind == CYLINDER:
        radial = ti.sqrt(p_local[0] * p_local[0] + p_local[1] * p_local[1])
        if radial - half[0] >= ti.abs(p_local[2]) - half[2]:
            normal = vec3(p_local[0] / radial, p_local[1] / radial, 0)
        else:
            normal = vec3(0, 0, tm.sign(p_local[2]))
    elif kind == AXLE:
        radial = ti.sqrt(p_local[0] * p_local[0] + p_local[2] * p_local[2])
        if radial - half[0] >= ti.abs(p_local[1]) - half[1]:
            normal = vec3(p_local[0] / radial, 0, p_local[2] / radial)
        else:
            normal = vec3(0, tm.sign(p_local[1]), 0)
    elif kind == PRISM:
        q = ti.abs(p_local) - half
        k, c = prism_slope(half, solids[s, 11])
        slanted = (ti.abs(p_local[0]) + k * p_local[2] - c) / ti.sqrt(1 + k * k)
        if slanted >= ti.max(q[1], q[2]):
            normal = tm.normalize(vec3(tm.sign(p_local[0]), 0, k))
        elif q[1] > q[2]:
            normal = vec3(0, tm.sign(p_local[1]), 0)
        else:
            normal = vec3(0, 0, tm.sign(p_local[2]))
    return normal


@ti.func
def daylight(solids: ti.template(), listed: ti.template(), first, last, p, normal):
    """Return the brightness of soft light from above and the side, dimmed in corners, equal in all views."""
    nearest = vec3(1, 1, 1)  # open space at three heights above the surface, as a share of the height
    for place in range(first, last):
        s = listed[place]
        kind = ti.i32(solids[s, 0])
        away = p - vec3(solids[s, 1], solids[s, 2], solids[s, 3])
        radius = tm.length(vec3(solids[s, 4], solids[s, 5], solids[s, 6])) + 0.5
        if kind == ROOM or kind == GROUND or away.dot(away) < radius * radius:
            for step in ti.static(range(3)):
                reach = 0.0625 * 2.0**step
                nearest[step] = ti.min(nearest[step], solid_distance(solids, s, p + reach * normal) / reach)
    dimmed = 0.35 * (1 - nearest[0]) + 0.2 * (1 - nearest[1]) + 0.1 * (1 - nearest[2])
    lambert = 0.80 + 0.14 * normal[2] + 0.08 * normal[0] - 0.06 * normal[1]
    return lambert * tm.clamp(1.0 - dimmed, 0.35, 1.0)


@ti.kernel
def cast(
    T_world_sensor: F64x2, directions: F64x2, solids: F64x2, tile_of: I32, starts: I32, listed: I32,
    distance: F64, incidence: F64, color: U8x2,
):  # fmt: skip
    """Cast every ray to the nearest solid.

    Args:
        T_world_sensor: (4, 4) float64.
        directions: (n, 3) float64, sensor frame; with z = 1 the distance is a depth.
        solids: (m, 12) float64.
        tile_of: (n,) int32, number of each ray's tile.
        starts, listed: int32; the solids of tile t are `listed[starts[t] : starts[t + 1]]`: all that its rays
            may meet, and the adjacent ones, which dim the light.
        distance: (n,) float64, out: in units of the direction's length; 0 = no solid met.
        incidence: (n,) float64, out: |cosine| between ray and surface normal.
        color: (n, 3) uint8 BGR, out; of no rows = no colour wanted.
    """
    for i in range(directions.shape[0]):
        o = vec3(T_world_sensor[0, 3], T_world_sensor[1, 3], T_world_sensor[2, 3])
        d = vec3(0, 0, 0)
        for r, c in ti.static(ti.ndrange(3, 3)):
            d[r] += T_world_sensor[r, c] * directions[i, c]
        best, hit = ti.f64(1e9), -1
        first, last = starts[tile_of[i]], starts[tile_of[i] + 1]
        for place in range(first, last):
            s = listed[place]
            if may_meet(solids, s, o, d):
                t = solid_ray(solids, s, o, d)
                if t < best:
                    best, hit = t, s
        distance[i] = 0.0
        incidence[i] = 0.0
        if hit >= 0:
            p = o + best * d
            cosine, sine = solids[hit, 7], solids[hit, 8]
            p_local = to_local(p - vec3(solids[hit, 1], solids[hit, 2], solids[hit, 3]), cosine, sine)
            n_local = solid_normal(solids, hit, p_local)
            normal = to_local(n_local, cosine, -sine)
            distance[i] = best
            incidence[i] = ti.abs(normal.dot(d)) / tm.length(d)
            if color.shape[0] > 0:
                rgb = solid_color(solids, hit, p_local, n_local) * daylight(
                    solids, listed, first, last, p, normal
                )
                for k in ti.static(range(3)):
                    color[i, k] = ti.cast(tm.clamp(rgb[2 - k], 0.0, 1.0) * 255.0 + 0.5, ti.u8)
        elif color.shape[0] > 0:
            for k in ti.static(range(3)):
                color[i, k] = ti.cast(235 - 12 * k, ti.u8)
