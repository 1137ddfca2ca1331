# SPDX-License-Identifier: MIT
"""Noise and patterns by hashes of the place, and the fronts of houses: never the same twice.

The colour of a place is the same from every view, but for detail that is finer than a pixel: it fades with
the pixel's footprint `foot` on the surface, metres, as in a camera. Reflectances are RGB in [0, 1]. `g` holds
five octaves of noise at the place, from 2 cm to 3 m.
"""

from tsfusion.kernels import ti, tm

rgb3 = ti.types.vector(3, ti.f32)


@ti.func
def cell(i, j, salt):
    """A number in [0, 1) for each integer cell."""
    h = ti.cast(i, ti.u32) * ti.u32(0x8DA6B343) ^ ti.cast(j, ti.u32) * ti.u32(0xD8163841)
    h ^= ti.cast(salt, ti.u32) * ti.u32(0x9E3779B1)
    h ^= h >> 15
    h *= ti.u32(0x2C1B3C6D)
    h ^= h >> 12
    h *= ti.u32(0x297A2D39)
    h ^= h >> 15
    return ti.cast(h >> 8, ti.f32) * ti.f32(1.0 / 16777216.0)


@ti.func
def cell_at(x, y, salt):
    """The number of the unit cell around (x, y)."""
    return cell(
        ti.cast(ti.floor(ti.cast(x, ti.f32)), ti.i32), ti.cast(ti.floor(ti.cast(y, ti.f32)), ti.i32), salt
    )


@ti.func
def octave(u, v, size, foot, salt):
    """Value noise in [-0.5, 0.5] with cells of `size` metres; none where the footprint is as large."""
    total = ti.f32(0.0)
    seen = tm.clamp(size / foot - 0.7, 0.0, 1.0)
    if seen > 0:
        x, y = u / size, v / size
        i, j = ti.floor(x), ti.floor(y)
        a, b = x - i, y - j
        a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
        c, r = ti.cast(i, ti.i32), ti.cast(j, ti.i32)
        low = tm.mix(cell(c, r, salt), cell(c + 1, r, salt), a)
        high = tm.mix(cell(c, r + 1, salt), cell(c + 1, r + 1, salt), a)
        total = seen * (tm.mix(low, high, b) - 0.5)
    return total


@ti.func
def inside(x, half, foot):
    """Share of a pixel at distance x from a bar's middle that lies on the bar, `half` metres wide a side."""
    return tm.clamp((half - ti.abs(x)) / foot + 0.5, 0.0, 1.0)


@ti.func
def fract(x):
    """The fractional part of x, in [0, 1)."""
    return x - ti.floor(x)


@ti.func
def paint_of(x):
    """RGB of a car's or a sign's paint for x in [0, 1): half of them white, grey or black."""
    grey = rgb3(1, 1, 1) * (0.06 + 0.8 * fract(7.31 * x))
    hue = 6.2832 * fract(13.7 * x)
    colored = rgb3(0.24 + 0.16 * ti.cos(hue), 0.2 + 0.1 * ti.cos(hue + 2.3), 0.22 + 0.14 * ti.cos(hue + 4.2))
    return tm.mix(grey, colored, ti.cast(x > 0.55, ti.f32))


@ti.func
def plaster_of(house):
    """RGB of a house's plaster."""
    tone = cell(house, 1, 3)
    rgb = rgb3(0.74, 0.7, 0.62) * (0.72 + 0.4 * cell(house, 2, 3))
    rgb = tm.mix(rgb, rgb3(0.72, 0.56, 0.36), 0.8 * ti.cast(tone > 0.75, ti.f32))
    return tm.mix(rgb, rgb3(0.47, 0.52, 0.54), 0.8 * ti.cast(tone < 0.15, ti.f32))


@ti.func
def wall_color(u, v, house, salt, g, foot):
    """A house's wall: plaster in pale colours, with stains and streaks, or brick."""
    rgb = plaster_of(house)
    if cell(house, 3, 3) < 0.35:
        row = ti.floor(v / 0.083)
        x = u / 0.25 + 0.5 * cell(ti.cast(row, ti.i32), 7, 5)
        tone = cell_at(x, row + 0.5, salt) - 0.5
        near = tm.clamp(0.1 / foot - 1.5, 0.0, 1.0)
        upright = inside((fract(x) - 0.5) * 0.25 - 0.125, 0.007, foot)
        joint = ti.max(upright, inside(v - 0.083 * row, 0.008, foot))
        rgb = rgb3(0.46, 0.25, 0.17) * (1 + 0.5 * near * tone + 0.25 * g[1] + 0.2 * g[3])
        rgb = tm.mix(rgb, rgb3(0.62, 0.59, 0.54), joint * near)
    else:
        streak = octave(u, 0.12 * v, 0.35, foot, salt + 11)
        rgb *= 1 + 0.1 * g[0] + 0.12 * g[1] + 0.16 * g[2] + 0.22 * g[3] + 0.22 * g[4] + 0.25 * streak
    return rgb


@ti.func
def pane_color(across, up, wide, high, column, storey, salt, g, foot):
    """Inside of a window: dark glass, a curtain, or a blind that is partly down."""
    pane = rgb3(0.05, 0.06, 0.075) * (1 + 1.4 * g[2] + 1.2 * g[3] + 0.8 * cell(column, storey, salt + 1))
    open_ = 0.2 + 0.7 * cell(column, storey, salt + 3)
    if cell(column, storey, salt + 2) > 0.45 and ti.abs(across) > wide * open_:
        pane = rgb3(0.5, 0.48, 0.44) * (1 + 0.5 * ti.sin(40 * across) * tm.clamp(0.1 / foot - 1, 0.0, 1.0))
    blind = cell(column, storey, salt + 4)
    if blind > 0.6 and up > high - 2 * high * (blind - 0.6) * 2.2:
        slat = inside(fract(up / 0.06) * 0.06 - 0.03, 0.02, foot)
        pane = rgb3(0.62, 0.6, 0.55) * (0.6 + 0.4 * slat)
    return pane


@ti.func
def window_color(wall, across, up, wide, high, column, storey, house, salt, g, foot):
    """A window or, of storey -1, a door in a wall: sill, surround, pane, bars, shutters."""
    below_sill = inside(across, wide + 0.16, foot) * inside(up + high + 0.22, 0.1, foot)
    rgb = wall * (1 - 0.45 * below_sill)
    surround = rgb3(0.8, 0.79, 0.75) * (0.9 + 0.2 * cell(house, 10, 3))
    rgb = tm.mix(rgb, surround, inside(across, wide + 0.1, foot) * inside(up, high + 0.1, foot))
    opening = inside(across, wide, foot) * inside(up, high, foot)
    if storey < 0:
        door = paint_of(cell(house, 11, 3)) * 0.6 * (1 + 0.3 * g[1])
        rgb = tm.mix(rgb, door * (1 - 0.5 * inside(ti.abs(across) - 0.5 * wide, 0.02, foot)), opening)
    else:
        rgb = tm.mix(rgb, pane_color(across, up, wide, high, column, storey, salt, g, foot), opening)
        bars = ti.max(inside(across, 0.025, foot), inside(up - 0.35 * high, 0.022, foot))
        rgb = tm.mix(rgb, rgb3(0.82, 0.82, 0.8), bars * opening)
        if cell(house, 12, 3) > 0.6:
            leaf = inside(ti.abs(across) - 1.55 * wide, 0.5 * wide, foot) * inside(up, high + 0.04, foot)
            slats = 0.75 + 0.25 * inside(fract(up / 0.09) * 0.09 - 0.045, 0.03, foot)
            rgb = tm.mix(rgb, paint_of(cell(house, 13, 3)) * slats * (1 + 0.3 * g[1]), leaf)
    return rgb


@ti.func
def house_color(u, v, half_width, height, house, face, g, foot):
    """A facade: a plinth, storeys of windows, a door, bands and a cornice, rain pipes."""
    salt = house * 4 + face
    plinth = 0.6 + 0.5 * cell(house, 5, 3)
    rgb = wall_color(u, v, house, salt, g, foot)
    if v < plinth:
        rgb = rgb3(0.36, 0.35, 0.34) * (1 + 0.3 * g[1] + 0.4 * g[2])
    rise = 2.6 + 0.5 * cell(house, 4, 3)
    columns = ti.max(1.0, ti.floor(2 * half_width / (2.1 + 1.4 * cell(house, 6, 3))))
    pitch = 2 * half_width / columns
    x, y = (u + half_width) / pitch, (v - plinth) / rise
    column, storey = ti.cast(ti.floor(x), ti.i32), ti.cast(ti.floor(y), ti.i32)
    across, up = (fract(x) - 0.5) * pitch, (fract(y) - 0.52) * rise
    wide = ti.min(0.42 + 0.3 * cell(house, 7, 3), 0.42 * pitch)
    high = 0.55 + 0.25 * cell(house, 8, 3)
    own = cell(column, storey, salt + 1)
    if own < 0.12:
        wide *= 0.55
    if storey == 0 and column == ti.cast(columns * cell(house, 9, 3), ti.i32) and face == 0:
        up, high, wide, storey, own = v - 1.05, 1.1, ti.min(0.55, 0.42 * pitch), -1, 1.0
    if v > 0 and (y + 1 - fract(y)) * rise + plinth < height and own > 0.06:
        rgb = window_color(rgb, across, up, wide, high, column, storey, house, salt, g, foot)
    band = inside(fract(y) * rise, 0.05, foot) * ti.cast(cell(house, 14, 3) > 0.5, ti.f32)
    band = ti.max(band, inside(v - height + 0.12, 0.14, foot))
    rgb = tm.mix(rgb, rgb3(0.66, 0.64, 0.6) * (1 + 0.3 * g[1]), band)
    pipe = inside(ti.abs(u) - half_width + 0.25, 0.05, foot)
    return tm.mix(rgb, rgb3(0.25, 0.24, 0.23) * (1 + 0.4 * g[2]), pipe)


@ti.func
def tiles_color(u, v, house, g, foot):
    """Rows of roof tiles, each of its own tone."""
    row = ti.floor(v / 0.3)
    x = u / 0.24 + 0.5 * (row - 2 * ti.floor(row / 2))
    tone = (cell_at(x, row + 0.5, house + 77) - 0.5) * tm.clamp(0.25 / foot - 0.8, 0.0, 1.0)
    rgb = tm.mix(rgb3(0.42, 0.17, 0.1), rgb3(0.22, 0.2, 0.2), ti.cast(cell(house, 15, 3) > 0.6, ti.f32))
    rgb *= 1 + 0.5 * tone + 0.3 * g[2] + 0.4 * g[3] + 0.3 * g[4]
    return rgb * (1 - 0.5 * inside(v - 0.3 * row, 0.03, foot))
