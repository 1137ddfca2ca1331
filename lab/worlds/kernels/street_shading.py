# SPDX-License-Identifier: MIT
"""Light that comes along rays from a street: the ground's colours, the sky, the sun and haze."""

from lab.worlds.kernels.street_raycast import KERB, ROAD, SKY, sample
from lab.worlds.kernels.street_textures import cell_at, fract, inside, octave, rgb3
from lab.worlds.kernels.street_things import bounded_color
from tsfusion.kernels import F64, I32, F32x2, F64x2, I32x2, U8x2, ti, tm
from tsfusion.kernels.worlds.synthetic_raycast import solid_normal, to_local, vec3

SUN = (0.42, 0.56, 0.714)  # direction to it
LANE = 1.75  # metres from the course to the line on its left
EDGE = 0.35  # metres from the kerb to the edge line
PAVEMENT_WIDTH = 2.4  # metres behind the kerb
HAZE = 450.0  # metres


@ti.func
def along_course(course: ti.template(), near, p):
    """(arc length, metres to its left) of the foot of p on the course, near its node `near`."""
    best, arc, left = ti.f64(1e9), ti.f64(0.0), ti.f64(0.0)
    for k in range(ti.max(near - 2, 0), ti.min(near + 2, course.shape[0] - 1)):
        dx, dy = course[k + 1, 0] - course[k, 0], course[k + 1, 1] - course[k, 1]
        px, py = p[0] - course[k, 0], p[1] - course[k, 1]
        length2 = dx * dx + dy * dy
        share = tm.clamp((px * dx + py * dy) / length2, 0.0, 1.0)
        ex, ey = px - share * dx, py - share * dy
        away = ex * ex + ey * ey
        if away < best:
            best = away
            arc = course[k, 2] + share * ti.sqrt(length2)
            left = (dx * py - dy * px) / ti.sqrt(length2)
    return ti.cast(arc, ti.f32), ti.cast(left, ti.f32)


@ti.func
def asphalt_color(x, y, behind, arc, left, g, foot):
    """RGB reflectance of asphalt: repairs, cracks, tracks of tyres, lines, lids and the gutter."""
    rgb = rgb3(0.19, 0.19, 0.195) * (1 + 0.9 * g[0] + 0.45 * g[1] + 0.25 * g[2] + 0.3 * g[3] + 0.3 * g[4])
    field = arc / 6.3 + 0.37 * ti.floor(left / 2.1)
    repaired = cell_at(field, left / 2.1, 83)
    if repaired > 0.72 and fract(field) < 0.3 + 2 * (repaired - 0.72):
        rgb *= 0.62 + 0.5 * cell_at(field, left / 2.1, 84)
    crack = ti.abs(octave(arc, left, 1.3, foot, 85) + 0.4 * octave(arc, left, 0.3, foot, 86))
    rgb *= 1 - 0.55 * tm.clamp((0.012 - crack) / 0.012, 0.0, 1.0) * ti.cast(g[4] > 0.0, ti.f32)
    rgb *= 1 - 0.18 * inside(ti.abs(ti.abs(left) - 0.75), 0.25, foot)
    worn = tm.clamp(0.85 + 0.9 * g[1] + 0.9 * g[2] + 0.5 * g[3], 0.25, 1.0)
    dash = inside(fract(arc / 9.0) * 9 - 2.0, 2.0, foot) * inside(left - LANE, 0.065, foot)
    rgb = tm.mix(rgb, rgb3(0.66, 0.66, 0.64), worn * ti.max(dash, 0.8 * inside(behind + EDGE, 0.06, foot)))
    along, across = fract(arc / 31.0) * 31 - 7, left - 0.9 + 1.4 * cell_at(arc / 31.0, 0, 87)
    if along * along + across * across < 0.13:  # a lid
        ribs = ti.sin(60 * x) * ti.sin(60 * y) * tm.clamp(0.1 / foot - 0.5, 0.0, 1.0)
        rgb = rgb3(0.1, 0.1, 0.1) * (1 + 0.8 * ribs)
    gutter = rgb3(0.3, 0.29, 0.28) * (1 + 0.5 * g[1] + 0.4 * g[2])
    rgb = tm.mix(rgb, gutter, inside(behind + 0.12, 0.1, foot))
    return rgb * (1 - 0.5 * inside(behind + 0.01, 0.02, foot))


@ti.func
def ground_color(what, x, y, behind, arc, left, g, foot):
    """RGB reflectance of road, kerb stones, slabs and the grass behind; `behind` the kerb, metres."""
    rgb = rgb3(0, 0, 0)
    if what == ROAD:
        rgb = asphalt_color(x, y, behind, arc, left, g, foot)
    elif what == KERB or behind < 0.16:
        tone = 0.8 + 0.4 * cell_at(arc / 0.9, 1, 88) + 0.4 * g[0] + 0.4 * g[1] + 0.4 * g[2]
        joint = inside(fract(arc / 0.9) * 0.9 - 0.45, 0.44, foot)
        rgb = rgb3(0.42, 0.41, 0.39) * tone * (0.5 + 0.5 * joint)
    elif behind < PAVEMENT_WIDTH:
        m, n = arc / 0.42, behind / 0.4
        slab = (cell_at(m, n, 89) - 0.5) * tm.clamp(0.42 / foot - 0.7, 0.0, 1.0)
        joint = inside(fract(m) * 0.42 - 0.21, 0.2, foot) * inside(fract(n) * 0.4 - 0.2, 0.19, foot)
        light = 1 + 0.5 * slab + 0.5 * g[0] + 0.4 * g[1] + 0.3 * g[2] + 0.3 * g[3] + 0.3 * g[4]
        rgb = rgb3(0.38, 0.37, 0.35) * light * (0.55 + 0.45 * joint)
    else:
        blade = (cell_at(x / 0.03, y / 0.03, 90) - 0.5) * tm.clamp(0.03 / foot - 0.4, 0.0, 1.0)
        light = 1 + 0.8 * blade + 0.9 * g[0] + 0.8 * g[1] + 0.6 * g[2] + 0.6 * g[3] + 0.6 * g[4]
        bare = tm.clamp(4 * (g[3] + g[4] + 0.6 * g[2]) - 0.3, 0.0, 1.0)
        rgb = tm.mix(rgb3(0.17, 0.21, 0.08), rgb3(0.3, 0.26, 0.19), bare) * tm.clamp(light, 0.2, 2.0)
    return rgb


@ti.func
def ground_light(
    what, o, d, t, pixel, heights: ti.template(), apart: ti.template(), nearest_node: ti.template(),
    course: ti.template(), shade: ti.template(), layout: ti.template(),
):  # fmt: skip
    """(RGB reflectance of the ground where a ray meets it, share of the sun's light there)."""
    p = o + t * d
    x, y = (p[0] - layout[0]) / layout[3], (p[1] - layout[1]) / layout[3]
    row = tm.clamp(ti.cast(ti.round(y), ti.i32), 0, apart.shape[0] - 1)
    column = tm.clamp(ti.cast(ti.round(x), ti.i32), 0, apart.shape[1] - 1)
    arc, left = along_course(course, nearest_node[row, column], p)
    facing, u, v = ti.cast(-d[2] / tm.length(d), ti.f32), ti.cast(p[0], ti.f32), ti.cast(p[1], ti.f32)
    if what == KERB:  # its face stands upright
        facing, u, v = 0.5, arc, ti.cast(p[2], ti.f32)
    foot = ti.cast(t * pixel, ti.f32) / ti.sqrt(ti.max(facing, 0.02))
    g = ti.Vector([octave(u, v, 0.022, foot, 101), octave(u, v, 0.07, foot, 102),
                   octave(u, v, 0.25, foot, 103), octave(u, v, 1.1, foot, 104),
                   octave(u, v, 5.3, foot, 105)])  # fmt: skip
    behind = ti.cast(sample(apart, x, y) - layout[5], ti.f32)
    sunny = sample(shade, (p[0] - layout[0]) / layout[4], (p[1] - layout[1]) / layout[4]) / 255
    return ground_color(what, u, v, behind, arc, left, g, foot), ti.cast(sunny, ti.f32)


@ti.func
def sky_color(d):
    """Sky with thin clouds, and hills at the horizon: at no distance."""
    way = tm.normalize(d)
    up, turn = way[2], tm.atan2(way[1], way[0])
    rgb = tm.mix(rgb3(0.86, 0.9, 0.95), rgb3(0.42, 0.6, 0.88), tm.clamp(2.2 * up, 0.0, 1.0))
    x, y = way[0] / (ti.max(up, 0.0) + 0.12), way[1] / (ti.max(up, 0.0) + 0.12)
    cloud = octave(x, y, 1.9, 0.01, 91) + 0.5 * octave(x, y, 0.8, 0.01, 92)
    cloud += 0.25 * octave(x, y, 0.3, 0.01, 93)
    rgb = tm.mix(rgb, rgb3(0.97, 0.97, 0.97), tm.clamp(1.2 * cloud + 0.2, 0.0, 0.8))
    hill = 0.025 + 0.03 * octave(turn, 0.0, 0.3, 0.001, 94) + 0.012 * octave(turn, 0.0, 0.04, 0.001, 95)
    hill += 0.006 * octave(turn, 0.0, 0.008, 0.001, 96)
    if up < hill:
        rgb = rgb3(0.42, 0.47, 0.47) * (1 + 0.3 * octave(turn, up, 0.02, 0.001, 97))
    return rgb


@ti.kernel
def shade_view(
    T_world_sensor: F64x2, directions: F64x2, distance: F64, hit: I32, pixel: ti.f64, solids: F64x2,
    heights: F64x2, apart: F32x2, nearest_node: I32x2, course: F64x2, shade: U8x2, layout: F64, color: F32x2,
):  # fmt: skip
    """Give every ray that `street_raycast.cast_view` has cast its colour.

    Args:
        pixel: width of a pixel at distance 1.
        nearest_node: (c, d) int32, the course's node nearest to each node of `apart`.
        course: (n, 3) float64, metres: x, y, arc length.
        shade: (e, f) uint8, light on the ground, nodes `layout[4]` metres apart.
        color: (n, 3) float32 BGR, out: light that comes along the ray.
    """
    for i in range(directions.shape[0]):
        o = vec3(T_world_sensor[0, 3], T_world_sensor[1, 3], T_world_sensor[2, 3])
        d = vec3(0, 0, 0)
        for r, c in ti.static(ti.ndrange(3, 3)):
            d[r] += T_world_sensor[r, c] * directions[i, c]
        rgb = rgb3(0, 0, 0)
        sun = rgb3(SUN[0], SUN[1], SUN[2])
        t, s = distance[i], hit[i]
        p = o + t * d
        if s == SKY:
            rgb = sky_color(ti.cast(d, ti.f32))
        else:
            normal = rgb3(0, 0, 1)
            light = ti.f32(1.0)
            sunny = ti.f32(1.0)
            if s >= 0:
                cosine, sine = solids[s, 7], solids[s, 8]
                p_local = to_local(p - vec3(solids[s, 1], solids[s, 2], solids[s, 3]), cosine, sine)
                n_local = solid_normal(solids, s, p_local)
                normal = ti.cast(to_local(n_local, cosine, -sine), ti.f32)
                facing = ti.abs(normal.dot(tm.normalize(ti.cast(d, ti.f32))))
                foot = ti.cast(t * pixel, ti.f32) / ti.sqrt(ti.max(facing, 0.04))
                half = rgb3(solids[s, 4], solids[s, 5], solids[s, 6])
                rgb = bounded_color(ti.cast(solids[s, 9], ti.i32), ti.cast(p_local, ti.f32), half,
                                    ti.cast(n_local, ti.f32), ti.cast(solids[s, 0], ti.i32),
                                    ti.cast(solids[s, 10], ti.i32), foot)  # fmt: skip
                base = ti.cast(
                    p[2] - sample(heights, (p[0] - layout[0]) / layout[2], (p[1] - layout[1]) / layout[2]),
                    ti.f32,
                )
                light = 0.6 + 0.4 * tm.clamp(base / 1.2, 0.0, 1.0)
            else:
                rgb, sunny = ground_light(
                    s, o, d, t, pixel, heights, apart, nearest_node, course, shade, layout
                )
                if s == KERB:
                    light = 0.55
            lambert = ti.max(normal.dot(sun), 0.0) * sunny
            rgb *= light * (0.34 + 0.06 * normal[2] + 0.06 * normal[0] + 1.15 * lambert)
            haze = 1 - ti.exp(-ti.cast(t, ti.f32) / HAZE)
            rgb = tm.mix(rgb, rgb3(0.78, 0.83, 0.88), haze)
        for k in ti.static(range(3)):
            color[i, k] = rgb[2 - k]
