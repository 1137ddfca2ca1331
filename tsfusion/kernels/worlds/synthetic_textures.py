# SPDX-License-Identifier: MIT
"""Compute procedural colours of the solids in synthetic worlds: textured, and the same from every view."""

from tsfusion.kernels import ti, tm

# Materials, column 9 of a solid
INTERIOR, WOOD, MARBLE, STRIPES, ROAD, PAVEMENT, FACADE, PAINT, METAL, BARK, LEAVES, GLASS, PLAIN = range(13)

vec3 = ti.types.vector(3, ti.f64)


@ti.func
def lattice(x, y, z, salt):
    """Return a pseudo-random number in [0, 1) for each integer cell."""
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
    """Return smooth pseudo-random noise (value noise) in [0, 1) at point p, with cells of `scale` metres."""
    q = p / scale
    cell = ti.floor(q)
    f = q - cell
    f = f * f * (3.0 - 2.0 * f)
    i, j, k = ti.cast(cell[0], ti.i32), ti.cast(cell[1], ti.i32), ti.cast(cell[2], ti.i32)
    total = ti.f64(0.0)
    for corner in range(8):  # not unrolled: the kernel compiles in half the time
        a, b, c = corner & 1, corner >> 1 & 1, corner >> 2
        weight = ti.abs(1 - a - f[0]) * ti.abs(1 - b - f[1]) * ti.abs(1 - c - f[2])
        total += weight * lattice(i + a, j + b, k + c, salt)
    return total


@ti.func
def fract(x):
    """Return the fractional part of x, in [0, 1)."""
    return x - ti.floor(x)


@ti.func
def mix(a, b, share):
    """Interpolate between a (share 0) and b (share 1)."""
    return a + (b - a) * tm.clamp(share, 0.0, 1.0)


@ti.func
def palette(x):
    """Return a saturated RGB colour for x in [0, 1)."""
    return vec3(
        0.5 + 0.42 * ti.cos(6.2832 * x),
        0.5 + 0.42 * ti.cos(6.2832 * (x + 0.33)),
        0.5 + 0.42 * ti.cos(6.2832 * (x + 0.67)),
    )


@ti.func
def tile_joint(u, v, width):
    """Return 1 in the joints between unit tiles, else 0."""
    a, b = fract(u), fract(v)
    return ti.cast(a < width or b < width, ti.f64)


@ti.func
def interior_color(p, normal, half, grain):
    """Return the colour at p of a room: checker floor, walls with wainscot, rail and picture, ceiling."""
    rgb = vec3(0.92, 0.91, 0.87)
    if normal[2] > 0.5:
        u, v = p[0] / 0.4, p[1] / 0.4
        odd = (ti.cast(ti.floor(u), ti.i32) + ti.cast(ti.floor(v), ti.i32)) & 1
        veins = 0.5 * grain[0] + 0.5 * grain[1]
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
        rgb = paint * (0.94 + 0.1 * grain[0])
        if height < 0.9:
            board = fract(along / 0.2)
            rgb = vec3(0.83, 0.80, 0.75) * (0.93 + 0.1 * grain[0])
            if board < 0.06:
                rgb *= 0.7
        if ti.abs(height - 0.9) < 0.03 or height < 0.09:
            rgb = vec3(0.42, 0.29, 0.19)
        a, b = ti.abs(along - 0.3), ti.abs(height - 1.55)
        if a < 0.6 and b < 0.4:
            rgb = palette(0.9 * grain[1] + 0.23 * side)
            if a > 0.54 or b > 0.34:
                rgb = vec3(0.24, 0.17, 0.11)
    return rgb


@ti.func
def facade_color(p, normal, half, variant, grain):
    """Return the colour at p of a house front: brick or plaster, rows of windows, another ground floor."""
    height = p[2] + half[2]
    along = p[0] * ti.abs(normal[1]) + p[1] * ti.abs(normal[0])
    wall = mix(vec3(0.62, 0.33, 0.24), vec3(0.82, 0.74, 0.6), lattice(ti.i32(variant), 1, 0, 21))
    wall = mix(wall, vec3(0.6, 0.66, 0.7), 0.8 * ti.cast(lattice(ti.i32(variant), 2, 0, 21) > 0.7, ti.f64))
    row = ti.floor(height / 0.12)
    brick = tile_joint(along / 0.3 + 0.5 * (row - 2 * ti.floor(row / 2)), height / 0.12, 0.1)
    rgb = wall * (0.78 + 0.3 * grain[0] + 0.12 * grain[2] - 0.22 * brick)
    if height < 3.0:
        rgb = mix(rgb, vec3(0.7, 0.68, 0.63), 0.75)
    u, v = fract(along / 2.2), fract((height - 0.4) / 2.9)
    if ti.abs(u - 0.5) < 0.27 and ti.abs(v - 0.52) < 0.29:
        rgb = vec3(0.17, 0.22, 0.28) * (0.7 + 0.7 * grain[1])
        if ti.abs(u - 0.5) > 0.235 or ti.abs(v - 0.52) > 0.26 or ti.abs(u - 0.5) < 0.015:
            rgb = vec3(0.88, 0.87, 0.84)
    if ti.abs(normal[2]) > 0.5:
        rgb = vec3(0.4, 0.37, 0.36) * (0.8 + 0.3 * grain[1])
    return rgb


@ti.func
def road_color(p, grain):
    """Return the colour of asphalt with a broken centre line and edge lines; the road runs along x."""
    rgb = vec3(0.31, 0.31, 0.33) * (0.65 + 0.45 * grain[0] + 0.3 * grain[2])
    y = ti.abs(p[1])
    worn = 0.75 * grain[0] + 0.35
    if (y < 0.08 and fract(p[0] / 6.0) < 0.5) or ti.abs(y - 2.3) < 0.06:
        rgb = mix(rgb, vec3(0.88, 0.88, 0.84), worn)
    return rgb


@ti.func
def wood_color(p, normal, grain):
    """Return the colour of planks with grain."""
    board = ti.floor(p[2] / 0.13)
    rgb = vec3(0.66, 0.43, 0.24) * (0.62 + 0.45 * grain[0] + 0.2 * lattice(ti.cast(board, ti.i32), 0, 0, 42))
    if fract(p[2] / 0.13) < 0.07 and ti.abs(normal[2]) < 0.5:
        rgb *= 0.5
    return rgb


@ti.func
def paint_color(p, half, variant, grain):
    """Return the colour of a car's paint and tyres; glass above the belt line is a separate solid."""
    rgb = palette(lattice(ti.i32(variant), 3, 0, 51)) * 0.7 + 0.18
    if lattice(ti.i32(variant), 4, 0, 51) > 0.6:
        rgb = vec3(1, 1, 1) * (0.25 + 0.6 * lattice(ti.i32(variant), 5, 0, 51))
    wheel = ti.min(ti.abs(p[0] - 0.62 * half[0]), ti.abs(p[0] + 0.62 * half[0]))
    low = p[2] + half[2]
    if wheel * wheel + low * low < 0.1 and ti.abs(p[1]) > 0.9 * half[1]:
        rgb = vec3(0.09, 0.09, 0.1)
    if ti.abs(fract(p[0] / 1.35 + 0.5) - 0.5) < 0.008:
        rgb *= 0.55
    return rgb * (0.93 + 0.1 * grain[1])


@ti.func
def solid_color(solids: ti.template(), s, p, normal):
    """Return RGB in [0, 1] at a point of solid `s`, in the solid's own axes."""
    material = ti.i32(solids[s, 9])
    variant = solids[s, 10]
    half = vec3(solids[s, 4], solids[s, 5], solids[s, 6])
    stretch = vec3(1, 1, 1)
    if material == WOOD:
        stretch = vec3(0.4, 2, 2)
    elif material == BARK:
        stretch = vec3(1, 1, 0.3)
    # Fine, middle and coarse noise once for all materials: every call is inlined and costs compile time.
    grain = vec3(noise(stretch * p, 0.045, 1), noise(stretch * p, 0.17, 2), noise(stretch * p, 0.7, 3))
    rgb = vec3(0.6, 0.6, 0.6)  # PLAIN
    if material == INTERIOR:
        rgb = interior_color(p, normal, half, grain)
    elif material == WOOD:
        rgb = wood_color(p, normal, grain)
    elif material == MARBLE:
        veins = ti.abs(ti.sin(9.0 * p[0] + 6.0 * p[2] + 9.0 * grain[1]))
        rgb = mix(vec3(0.12, 0.3, 0.36), vec3(0.8, 0.88, 0.86), 0.25 + 0.75 * veins)
    elif material == STRIPES:
        turn = ti.atan2(p[1], p[0]) / 6.283185307179586
        rgb = vec3(0.9, 0.88, 0.84)
        if fract(turn + p[2] / 0.4) < 0.5:
            rgb = vec3(0.72, 0.16, 0.14)
        rgb *= 0.9 + 0.12 * grain[0]
    elif material == ROAD:
        rgb = road_color(p, grain)
    elif material == PAVEMENT:
        shade = 0.75 + 0.25 * lattice(
            ti.cast(ti.floor(p[0] / 0.5), ti.i32), ti.cast(ti.floor(p[1] / 0.5), ti.i32), 0, 71
        )
        rgb = vec3(0.66, 0.64, 0.6) * (
            shade + 0.15 * grain[0] - 0.3 * tile_joint(p[0] / 0.5, p[1] / 0.5, 0.04)
        )
    elif material == FACADE:
        rgb = facade_color(p, normal, half, variant, grain)
    elif material == PAINT:
        rgb = paint_color(p, half, variant, grain)
    elif material == METAL:
        rgb = vec3(0.5, 0.53, 0.56) * (0.75 + 0.3 * grain[1])
    elif material == BARK:
        rgb = vec3(0.4, 0.29, 0.2) * (0.6 + 0.7 * grain[0])
    elif material == LEAVES:
        rgb = vec3(0.26, 0.46, 0.17) * (0.45 + 0.5 * grain[0] + 0.4 * grain[1] + 0.3 * grain[2])
    elif material == GLASS:
        rgb = vec3(0.13, 0.17, 0.21) * (0.7 + 0.6 * grain[1])
    return rgb
