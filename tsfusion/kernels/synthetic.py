# SPDX-License-Identifier: MIT
"""Ray casting into worlds of analytic solids, with procedural colour.

A world is a table of solids (`datasets/worlds.py` names the columns). Every ray is independent and in
float64, so images do not depend on the thread count.
"""

import taichi as ti
import taichi.math as tm

# Kinds of solid, column 0. Centre: columns 1-3, half sizes: 4-6, yaw cosine and sine: 7-8,
# material: 9, variant: 10.
ROOM, BOX, SPHERE, CYLINDER, GROUND = 0, 1, 2, 3, 4
# Materials
INTERIOR, WOOD, MARBLE, STRIPES, ROAD, PAVEMENT, FACADE, PAINT, METAL, BARK, LEAVES, GLASS = range(12)

vec3 = ti.types.vector(3, ti.f64)


@ti.func
def box_ray(o, d, half):
    """(entry, exit) of a ray through an origin-centred box; entry > exit = missed."""
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
    """(entry, exit) where a t² + 2 b t + c < 0."""
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
def to_local(p, cosine, sine):
    return vec3(cosine * p[0] + sine * p[1], cosine * p[1] - sine * p[0], p[2])


@ti.func
def may_meet(solids: ti.template(), s, o, d):
    """Whether the line passes the ball around a solid: cheaper than `solid_ray`, never wrong about a miss."""
    kind = ti.i32(solids[s, 0])
    to_center = vec3(solids[s, 1], solids[s, 2], solids[s, 3]) - o
    half = vec3(solids[s, 4], solids[s, 5], solids[s, 6])
    along, length2 = to_center.dot(d), d.dot(d)
    miss2 = to_center.dot(to_center) * length2 - along * along
    return kind == ROOM or kind == GROUND or miss2 <= half.dot(half) * length2 * 1.001


@ti.func
def solid_ray(solids: ti.template(), s, o_world, d_world):
    """Where the ray first meets solid `s` from outside, in units of `d_world`'s length; 1e9 = never."""
    kind = ti.i32(solids[s, 0])
    cosine, sine = solids[s, 7], solids[s, 8]
    o = to_local(o_world - vec3(solids[s, 1], solids[s, 2], solids[s, 3]), cosine, sine)
    d = to_local(d_world, cosine, sine)
    half = vec3(solids[s, 4], solids[s, 5], solids[s, 6])
    near, far = ti.f64(1e9), ti.f64(-1e9)
    if kind == BOX:
        near, far = box_ray(o, d, half)
    elif kind == ROOM:
        inner, outer = box_ray(o, d, half)
        near, far = outer, outer
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
    elif d[2] < 0:
        near = -o[2] / d[2]
        far = near
    result = ti.f64(1e9)
    if near <= far and near > 0:
        result = near
    return result


@ti.func
def solid_distance(solids: ti.template(), s, p_world):
    """Signed distance to solid `s`, metres, negative inside."""
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
    return result


@ti.func
def solid_normal(solids: ti.template(), s, p_local):
    """Outward normal at a point of the surface, in the solid's own axes."""
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
    return normal


@ti.func
def lattice(x, y, z, salt):
    """A number in [0, 1) for each integer cell."""
    h = ti.cast(x, ti.u32) * ti.u32(0x8DA6B343) ^ ti.cast(y, ti.u32) * ti.u32(0xD8163841)
    h ^= ti.cast(z, ti.u32) * ti.u32(0xCB1AB31F) ^ ti.cast(salt, ti.u32) * ti.u32(0x9E3779B1)
    h ^= h >> 15
    h *= ti.u32(0x2C1B3C6D)
    h ^= h >> 12
    h *= ti.u32(0x297A2D39)
    h ^= h >> 15
    return ti.cast(h, ti.f64) / 4294967296.0


@ti.func
def noise(p, scale, salt):
    """Value noise in [0, 1] with cells of `scale` metres."""
    q = p / scale
    cell = ti.floor(q)
    f = q - cell
    f = f * f * (3.0 - 2.0 * f)
    i, j, k = ti.cast(cell[0], ti.i32), ti.cast(cell[1], ti.i32), ti.cast(cell[2], ti.i32)
    total = ti.f64(0.0)
    for a, b, c in ti.static(ti.ndrange(2, 2, 2)):
        weight = (f[0] if a else 1 - f[0]) * (f[1] if b else 1 - f[1]) * (f[2] if c else 1 - f[2])
        total += weight * lattice(i + a, j + b, k + c, salt)
    return total


@ti.func
def fract(x):
    return x - ti.floor(x)


@ti.func
def mix(a, b, share):
    return a + (b - a) * tm.clamp(share, 0.0, 1.0)


@ti.func
def palette(x):
    """A saturated RGB colour for x in [0, 1)."""
    return vec3(
        0.5 + 0.42 * ti.cos(6.2832 * x),
        0.5 + 0.42 * ti.cos(6.2832 * (x + 0.33)),
        0.5 + 0.42 * ti.cos(6.2832 * (x + 0.67)),
    )


@ti.func
def tile_joint(u, v, width):
    """1 in the joints between unit tiles, else 0."""
    a, b = fract(u), fract(v)
    return ti.cast(a < width or b < width, ti.f64)


@ti.func
def interior_color(p, normal, half):
    """Checker floor, painted walls with a wainscot, a rail and a picture each, pale ceiling."""
    rgb = vec3(0.92, 0.91, 0.87)
    if normal[2] > 0.5:
        u, v = p[0] / 0.4, p[1] / 0.4
        odd = (ti.cast(ti.floor(u), ti.i32) + ti.cast(ti.floor(v), ti.i32)) & 1
        veins = noise(p, 0.09, 3) * 0.6 + noise(p, 0.03, 4) * 0.4
        rgb = vec3(0.86, 0.82, 0.74) * (0.86 + 0.2 * veins)
        if odd == 1:
            rgb = vec3(0.30, 0.36, 0.42) * (0.75 + 0.45 * veins)
        rgb = mix(rgb, vec3(0.55, 0.53, 0.5), tile_joint(u, v, 0.025))
    elif normal[2] > -0.5:
        side = ti.i32(0)
        along = p[1]
        if ti.abs(normal[1]) > 0.5:
            side = 2
            along = p[0]
        if normal[0] + normal[1] > 0:
            side += 1
        height = p[2] + half[2]
        paint = vec3(0.78, 0.52, 0.42)
        if side == 1:
            paint = vec3(0.47, 0.63, 0.66)
        elif side == 2:
            paint = vec3(0.80, 0.70, 0.45)
        elif side == 3:
            paint = vec3(0.56, 0.62, 0.47)
        rgb = paint * (0.94 + 0.1 * noise(p, 0.05, 7))
        if height < 0.9:
            board = fract(along / 0.2)
            rgb = vec3(0.83, 0.80, 0.75) * (0.93 + 0.1 * noise(p, 0.04, 8))
            if board < 0.06:
                rgb *= 0.7
        if ti.abs(height - 0.9) < 0.03 or height < 0.09:
            rgb = vec3(0.42, 0.29, 0.19)
        a, b = ti.abs(along - 0.3), ti.abs(height - 1.55)
        if a < 0.6 and b < 0.4:
            rings = noise(vec3(along, height, side), 0.22, 11 + side)
            rgb = palette(0.9 * rings + 0.23 * side)
            if a > 0.54 or b > 0.34:
                rgb = vec3(0.24, 0.17, 0.11)
    return rgb


@ti.func
def facade_color(p, normal, half, variant):
    """Brick or plaster with rows of windows and a ground floor of another colour."""
    height = p[2] + half[2]
    along = p[0] * ti.abs(normal[1]) + p[1] * ti.abs(normal[0])
    wall = mix(vec3(0.62, 0.33, 0.24), vec3(0.82, 0.74, 0.6), lattice(ti.i32(variant), 1, 0, 21))
    wall = mix(wall, vec3(0.6, 0.66, 0.7), 0.8 * ti.cast(lattice(ti.i32(variant), 2, 0, 21) > 0.7, ti.f64))
    row = ti.floor(height / 0.12)
    brick = tile_joint(along / 0.3 + 0.5 * (row - 2 * ti.floor(row / 2)), height / 0.12, 0.1)
    rgb = wall * (0.78 + 0.3 * noise(p, 0.06, 22) + 0.12 * noise(p, 0.9, 23) - 0.22 * brick)
    if height < 3.0:
        rgb = mix(rgb, vec3(0.7, 0.68, 0.63), 0.75)
    u, v = fract(along / 2.2), fract((height - 0.4) / 2.9)
    if ti.abs(u - 0.5) < 0.27 and ti.abs(v - 0.52) < 0.29:
        rgb = vec3(0.17, 0.22, 0.28) * (0.7 + 0.7 * noise(p, 0.35, 24))
        if ti.abs(u - 0.5) > 0.235 or ti.abs(v - 0.52) > 0.26 or ti.abs(u - 0.5) < 0.015:
            rgb = vec3(0.88, 0.87, 0.84)
    if ti.abs(normal[2]) > 0.5:
        rgb = vec3(0.4, 0.37, 0.36) * (0.8 + 0.3 * noise(p, 0.2, 25))
    return rgb


@ti.func
def road_color(p):
    """Asphalt with a broken centre line and edge lines; the road runs along x."""
    rgb = vec3(0.31, 0.31, 0.33) * (0.65 + 0.45 * noise(p, 0.05, 31) + 0.3 * noise(p, 0.7, 32))
    y = ti.abs(p[1])
    worn = 0.75 * noise(p, 0.08, 33) + 0.35
    if (y < 0.08 and fract(p[0] / 6.0) < 0.5) or ti.abs(y - 2.3) < 0.06:
        rgb = mix(rgb, vec3(0.88, 0.88, 0.84), worn)
    return rgb


@ti.func
def wood_color(p, normal):
    """Planks with grain."""
    grain = noise(vec3(p[0] * 0.25, p[1], p[2]), 0.022, 41)
    board = ti.floor(p[2] / 0.13)
    rgb = vec3(0.66, 0.43, 0.24) * (0.62 + 0.45 * grain + 0.2 * lattice(ti.cast(board, ti.i32), 0, 0, 42))
    if fract(p[2] / 0.13) < 0.07 and ti.abs(normal[2]) < 0.5:
        rgb *= 0.5
    return rgb


@ti.func
def paint_color(p, half, variant):
    """A car's paint; dark glass above the belt line is a solid of its own, tyres are drawn."""
    rgb = palette(lattice(ti.i32(variant), 3, 0, 51)) * 0.7 + 0.18
    if lattice(ti.i32(variant), 4, 0, 51) > 0.6:
        rgb = vec3(1, 1, 1) * (0.25 + 0.6 * lattice(ti.i32(variant), 5, 0, 51))
    wheel = ti.min(ti.abs(p[0] - 0.62 * half[0]), ti.abs(p[0] + 0.62 * half[0]))
    low = p[2] + half[2]
    if wheel * wheel + low * low < 0.1 and ti.abs(p[1]) > 0.9 * half[1]:
        rgb = vec3(0.09, 0.09, 0.1)
    if ti.abs(fract(p[0] / 1.35 + 0.5) - 0.5) < 0.008:
        rgb *= 0.55
    return rgb * (0.93 + 0.1 * noise(p, 0.12, 52))


@ti.func
def solid_color(solids: ti.template(), s, p, normal):
    """RGB in [0, 1] at a point of solid `s`, in the solid's own axes."""
    material = ti.i32(solids[s, 9])
    variant = solids[s, 10]
    half = vec3(solids[s, 4], solids[s, 5], solids[s, 6])
    rgb = vec3(0.6, 0.6, 0.6)
    if material == INTERIOR:
        rgb = interior_color(p, normal, half)
    elif material == WOOD:
        rgb = wood_color(p, normal)
    elif material == MARBLE:
        veins = ti.abs(ti.sin(9.0 * p[0] + 6.0 * p[2] + 9.0 * noise(p, 0.2, 61)))
        rgb = mix(vec3(0.12, 0.3, 0.36), vec3(0.8, 0.88, 0.86), 0.25 + 0.75 * veins)
    elif material == STRIPES:
        turn = ti.atan2(p[1], p[0]) / 6.283185307179586
        rgb = vec3(0.9, 0.88, 0.84)
        if fract(turn + p[2] / 0.4) < 0.5:
            rgb = vec3(0.72, 0.16, 0.14)
        rgb *= 0.9 + 0.12 * noise(p, 0.04, 62)
    elif material == ROAD:
        rgb = road_color(p)
    elif material == PAVEMENT:
        shade = 0.75 + 0.25 * lattice(
            ti.cast(ti.floor(p[0] / 0.5), ti.i32), ti.cast(ti.floor(p[1] / 0.5), ti.i32), 0, 71
        )
        rgb = vec3(0.66, 0.64, 0.6) * (
            shade + 0.15 * noise(p, 0.04, 72) - 0.3 * tile_joint(p[0] / 0.5, p[1] / 0.5, 0.04)
        )
    elif material == FACADE:
        rgb = facade_color(p, normal, half, variant)
    elif material == PAINT:
        rgb = paint_color(p, half, variant)
    elif material == METAL:
        rgb = vec3(0.5, 0.53, 0.56) * (0.75 + 0.3 * noise(p, 0.15, 73))
    elif material == BARK:
        rgb = vec3(0.4, 0.29, 0.2) * (0.6 + 0.7 * noise(vec3(p[0], p[1], p[2] * 0.3), 0.05, 74))
    elif material == LEAVES:
        rgb = vec3(0.26, 0.46, 0.17) * (0.45 + 0.8 * noise(p, 0.12, 75) + 0.3 * noise(p, 0.5, 76))
    elif material == GLASS:
        rgb = vec3(0.13, 0.17, 0.21) * (0.7 + 0.6 * noise(p, 0.3, 77))
    return rgb


@ti.func
def daylight(solids: ti.template(), p, normal):
    """Soft light from above and the side, dimmed in corners; the same from every view."""
    nearest = vec3(1, 1, 1)  # open space at three heights above the surface, as a share of the height
    for s in range(solids.shape[0]):
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
    T_world_sensor: ti.types.ndarray(dtype=ti.f64, ndim=2),
    directions: ti.types.ndarray(dtype=ti.f64, ndim=2),
    solids: ti.types.ndarray(dtype=ti.f64, ndim=2),
    distance: ti.types.ndarray(dtype=ti.f64, ndim=1),
    incidence: ti.types.ndarray(dtype=ti.f64, ndim=1),
    color: ti.types.ndarray(dtype=ti.u8, ndim=2),
):
    """Cast every ray to the nearest solid.

    Args:
        T_world_sensor: (4, 4) float64.
        directions: (n, 3) float64, sensor frame; with z = 1 the distance is a depth.
        solids: (m, 11) float64.
        distance: (n,) float64, out: in units of the direction's length; 0 = nothing met.
        incidence: (n,) float64, out: |cosine| between ray and surface normal.
        color: (n, 3) uint8 BGR, out; of no rows = no colour wanted.
    """
    for i in range(directions.shape[0]):
        o = vec3(T_world_sensor[0, 3], T_world_sensor[1, 3], T_world_sensor[2, 3])
        d = vec3(0, 0, 0)
        for r, c in ti.static(ti.ndrange(3, 3)):
            d[r] += T_world_sensor[r, c] * directions[i, c]
        best, hit = ti.f64(1e9), -1
        for s in range(solids.shape[0]):
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
                rgb = solid_color(solids, hit, p_local, n_local) * daylight(solids, p, normal)
                for k in ti.static(range(3)):
                    color[i, k] = ti.cast(tm.clamp(rgb[2 - k], 0.0, 1.0) * 255.0 + 0.5, ti.u8)
        elif color.shape[0] > 0:
            for k in ti.static(range(3)):
                color[i, k] = ti.cast(235 - 12 * k, ti.u8)
