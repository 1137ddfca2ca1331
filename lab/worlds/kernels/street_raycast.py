# SPDX-License-Identifier: MIT
"""Ray casting into a long street: solids by the tile of the image that they may show in, and its ground.

The ground is a smooth height with kerbs: farther than `kerb` metres from the course it lies a step higher.
Everything is in float64 and every ray is independent: images do not depend on the thread count.
"""

from tsfusion.kernels import F64, I32, F32x2, F64x2, ti, tm
from tsfusion.kernels.worlds.synthetic_raycast import may_meet, solid_ray, vec3

# What a ray meets, beside the number of a solid
SKY, ROAD, PAVED, KERB = -1, -2, -3, -4
MAX_MARCH = 160  # steps of a ray to the ground
_HALVINGS = 24
_SECANTS = 7


@ti.func
def sample(grid: ti.template(), x, y):
    """Bilinear value of a grid at (x, y) in its cells; the border's beyond it."""
    rows, columns = grid.shape[0], grid.shape[1]
    x, y = tm.clamp(x, 0.0, ti.cast(columns - 1, ti.f64)), tm.clamp(y, 0.0, ti.cast(rows - 1, ti.f64))
    i = ti.min(ti.cast(ti.floor(x), ti.i32), columns - 2)
    j = ti.min(ti.cast(ti.floor(y), ti.i32), rows - 2)
    a, b = x - i, y - j
    low = ti.cast(grid[j, i], ti.f64) * (1 - a) + ti.cast(grid[j, i + 1], ti.f64) * a
    high = ti.cast(grid[j + 1, i], ti.f64) * (1 - a) + ti.cast(grid[j + 1, i + 1], ti.f64) * a
    return low * (1 - b) + high * b


@ti.func
def height_at(heights: ti.template(), layout: ti.template(), p):
    """Height of the road at p, metres; the pavement lies `layout[6]` above."""
    return sample(heights, (p[0] - layout[0]) / layout[2], (p[1] - layout[1]) / layout[2])


@ti.func
def apart_at(apart: ti.template(), layout: ti.template(), p):
    """Distance of p from the course, metres."""
    return sample(apart, (p[0] - layout[0]) / layout[3], (p[1] - layout[1]) / layout[3])


@ti.func
def above_road(heights: ti.template(), layout: ti.template(), o, d, t):
    """Height of a ray's point above the road, metres."""
    p = o + t * d
    return p[2] - height_at(heights, layout, p)


@ti.func
def meet_height(heights: ti.template(), layout: ti.template(), o, d, start, reach, lift):
    """Distance at which a ray from above comes down to `lift` above the road; 1e9 = not within reach."""
    flat = ti.sqrt(d[0] * d[0] + d[1] * d[1])
    t, before = start, start
    above = above_road(heights, layout, o, d, t) - lift
    high, result = above, ti.f64(1e9)
    if above > 0 and d[2] < layout[7] * flat:
        for _ in range(MAX_MARCH):
            before, high = t, above
            t += ti.max(above / (layout[7] * flat - d[2]), 0.1 + 0.01 * t)
            above = above_road(heights, layout, o, d, t) - lift
            if above <= 0 or t > reach:
                break
        if above <= 0:
            for _ in range(_SECANTS):  # regula falsi, after Illinois
                middle = before + (t - before) * high / (high - above)
                found = above_road(heights, layout, o, d, middle) - lift
                result = middle
                if ti.abs(found) < 1e-9:
                    break
                if found > 0:
                    before, high = middle, found
                    above *= 0.5
                else:
                    t, above = middle, found
                    high *= 0.5
    elif above <= 0:
        result = start
    return result


@ti.func
def meet_ground(heights: ti.template(), apart: ti.template(), layout: ti.template(), o, d, reach):
    """(distance, what) where a ray meets the ground first; 1e9 = not within reach."""
    kerb, step = layout[5], layout[6]
    t, what = meet_height(heights, layout, o, d, ti.f64(0.0), reach, step), PAVED
    if t < 1e8 and apart_at(apart, layout, o + t * d) < kerb:
        low = t
        t, what = meet_height(heights, layout, o, d, low, low + 60.0, ti.f64(0.0)), ROAD
        if t < 1e8 and apart_at(apart, layout, o + t * d) > kerb:
            what = KERB
            high = t
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                if apart_at(apart, layout, o + middle * d) < kerb:
                    low = middle
                else:
                    high = middle
            t = 0.5 * (low + high)
    return t, what


@ti.kernel
def cast_view(
    T_world_sensor: F64x2, directions: F64x2, tile: I32, starts: I32, listed: I32, nearest: F64,
    solids: F64x2, heights: F64x2, apart: F32x2, layout: F64, reach: ti.f64, distance: F64, hit: I32,
):  # fmt: skip
    """Cast every ray to the nearest of the solids listed for its tile, and to the ground.

    Args:
        T_world_sensor: (4, 4) float64.
        directions: (n, 3) float64, sensor frame; with z = 1 the distance is a depth.
        tile: (n,) int32, the ray's tile.
        starts: (tiles + 1,) int32, where a tile's solids begin in `listed`; sorted by `nearest` there.
        listed: (k,) int32, rows of `solids`.
        nearest: (m,) float64, no ray meets the solid at a smaller distance.
        solids: (m, 12) float64, in the world.
        heights: (a, b) float64, metres, nodes `layout[2]` metres apart.
        apart: (c, d) float32, metres from the course, nodes `layout[3]` metres apart.
        layout: (8,) float64: x and y of the first nodes, three spacings, kerb, its height, steepest slope.
        reach: farthest ground, in units of the direction's length.
        distance: (n,) float64, out; 0 = nothing met.
        hit: (n,) int32, out: a row of `solids`, or SKY, ROAD, PAVED, KERB.
    """
    for i in range(directions.shape[0]):
        o = vec3(T_world_sensor[0, 3], T_world_sensor[1, 3], T_world_sensor[2, 3])
        d = vec3(0, 0, 0)
        for r, c in ti.static(ti.ndrange(3, 3)):
            d[r] += T_world_sensor[r, c] * directions[i, c]
        best, met = ti.f64(1e9), SKY
        for k in range(starts[tile[i]], starts[tile[i] + 1]):
            s = listed[k]
            if nearest[s] > best:
                break
            if may_meet(solids, s, o, d):
                t = solid_ray(solids, s, o, d)
                if t < best:
                    best, met = t, s
        t, what = meet_ground(heights, apart, layout, o, d, ti.min(best, reach))
        if t < best:
            best, met = t, what
        distance[i], hit[i] = 0.0, met
        if met != SKY:
            distance[i] = best
