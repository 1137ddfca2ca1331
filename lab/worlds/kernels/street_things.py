# SPDX-License-Identifier: MIT
"""Procedural colours of what stands in a street: houses, cars, trees, hedges, signs, fences, bins."""

from lab.worlds.kernels.street_textures import (
    cell,
    cell_at,
    fract,
    house_color,
    inside,
    octave,
    paint_of,
    plaster_of,
    rgb3,
    tiles_color,
)
from tsfusion.kernels import ti, tm
from tsfusion.kernels.worlds.synthetic_raycast import SPHERE

# Materials, column 9 of a solid, beside those of `synthetic_textures`
HOUSE, TILES, BODY, CABIN, TYRE, POLE, TRUNK, CROWN, HEDGE, SIGN, FENCE, BIN = range(20, 32)
SUNK = 2.0  # metres of a house below the ground


@ti.func
def body_color(p, half, normal, car, g, foot):
    """A car's body: lamps, plates, seams of doors, handles, a darker sill."""
    rgb = paint_of(cell(car, 1, 9)) * (1 + 0.06 * g[2] + 0.1 * g[3])
    up = p[2] / half[2]
    if ti.abs(normal[1]) > 0.5:
        for seam in ti.static((-0.42, 0.06, 0.45)):
            rgb *= 1 - 0.7 * inside(p[0] - seam * half[0], 0.012, foot)
        rgb *= 1 - 0.6 * inside(up + 0.75, 0.2, foot / half[2])
        handle = ti.min(ti.abs(p[0] + 0.02 * half[0]), ti.abs(p[0] - 0.4 * half[0]))
        rgb = tm.mix(
            rgb,
            rgb3(0.7, 0.7, 0.7),
            inside(handle - 0.1, 0.07, foot) * inside(up - 0.45, 0.1, foot / half[2]),
        )
        rgb *= 1 + 0.35 * inside(up - 0.75, 0.06, foot / half[2])
        wheel = ti.min(ti.abs(p[0] - 0.62 * half[0]), ti.abs(p[0] + 0.62 * half[0]))
        arch = tm.sqrt(wheel * wheel + (p[2] + half[2] + 0.05) ** 2)
        rgb *= 1 - 0.85 * inside(arch, 0.37, foot)
    elif ti.abs(normal[0]) > 0.5:
        lamp = inside(ti.abs(p[1]) - 0.76 * half[1], 0.17, foot) * inside(up - 0.35, 0.3, foot / half[2])
        lamps = tm.mix(rgb3(0.85, 0.86, 0.88), rgb3(0.5, 0.03, 0.03), ti.cast(normal[0] < 0, ti.f32))
        rgb = tm.mix(rgb, lamps * (1 + 0.8 * g[1]), lamp)
        plate = inside(p[1], 0.26, foot) * inside(up + 0.35, 0.18, foot / half[2])
        letter = inside(fract(p[1] / 0.07) * 0.07 - 0.035, 0.018 * cell_at(p[1] / 0.07, 3, car), foot)
        rgb = tm.mix(rgb, rgb3(0.85, 0.85, 0.82) * (1 - 0.8 * letter), plate)
        rgb *= 1 - 0.7 * inside(up + 0.8, 0.22, foot / half[2])
        grille = inside(p[1], 0.45, foot) * inside(up - 0.2, 0.2, foot / half[2])
        rgb *= 1 - 0.6 * grille * ti.cast(normal[0] > 0, ti.f32) * inside(
            fract(p[2] / 0.05) * 0.05 - 0.02, 0.016, foot
        )
    return rgb


@ti.func
def cabin_color(p, half, normal, car, g, foot):
    """A car's windows between pillars under a roof; seats and the sky seen in them."""
    paint = paint_of(cell(car, 1, 9)) * (1 + 0.06 * g[2] + 0.1 * g[3])
    up = p[2] / half[2]
    glass = rgb3(0.05, 0.055, 0.06) * (1.6 + 1.6 * up + 2.0 * g[2] + 1.2 * g[3])
    rgb = paint
    if normal[2] < 0.9:
        along, wide = p[1], half[1]
        if ti.abs(normal[1]) > 0.5:
            along, wide = p[0], half[0] * 0.8
        pillar = inside(ti.abs(along) - 0.95 * wide, 0.05 * wide, foot)
        if ti.abs(normal[1]) > 0.5:
            pillar = ti.max(pillar, inside(along, 0.035, foot))
        seat = inside(ti.abs(along) - 0.45 * wide, 0.16, foot) * inside(up + 0.3, 0.55, foot / half[2])
        glass = tm.mix(glass, rgb3(0.02, 0.02, 0.02), 0.8 * seat)
        rgb = tm.mix(glass, paint, ti.max(pillar, inside(up - 0.97, 0.1, foot / half[2])))
    return rgb


@ti.func
def leaves_color(u, v, salt, g, foot):
    """Leaves in bunches, with dark gaps between."""
    bunch = cell_at(u / 0.11 + 2 * g[2], v / 0.09 + 2 * g[1], salt) - 0.5
    leaf = cell_at(u / 0.045 + g[1], v / 0.04 + g[0], salt + 1) - 0.5
    light = 1 + 1.1 * g[3] + 1.0 * g[2] + 0.8 * g[1]
    light += 0.9 * bunch * tm.clamp(0.1 / foot - 0.5, 0.0, 1.0) + 0.9 * leaf * tm.clamp(
        0.042 / foot - 0.5, 0.0, 1.0
    )
    tone = cell(salt, 1, 31)
    rgb = tm.mix(rgb3(0.15, 0.24, 0.07), rgb3(0.2, 0.22, 0.1), tone)
    return rgb * tm.clamp(light, 0.12, 2.2)


@ti.func
def sign_color(p, half, salt, foot):
    """A bold sign: a rim, a field and bars."""
    rgb = rgb3(0.82, 0.82, 0.8)
    paint = tm.mix(rgb3(0.6, 0.05, 0.05), rgb3(0.05, 0.12, 0.5), ti.cast(cell(salt, 1, 41) > 0.5, ti.f32))
    rim = ti.max(ti.abs(p[0]) / half[0], ti.abs(p[2]) / half[2])
    if rim > 0.8:
        rgb = paint
    bar = cell_at(4 * p[0] / half[0], 3 * p[2] / half[2], salt)
    if rim < 0.7 and bar > 0.6:
        rgb = rgb3(0.03, 0.03, 0.03)
    return rgb


@ti.func
def bounded_color(material, p, half, normal, kind, variant, foot):
    """RGB reflectance at a point of a solid, in its own axes."""
    u, v, face = p[0], p[1], 2
    if ti.abs(normal[0]) > ti.max(ti.abs(normal[1]), ti.abs(normal[2])):
        u, v, face = p[1], p[2], 0
    elif ti.abs(normal[1]) >= ti.abs(normal[2]):
        u, v, face = p[0], p[2], 1
    wide = half[0]
    if face == 0:
        wide = half[1]
    salt = variant * 8 + face * 2 + ti.cast(normal[0] + normal[1] > 0, ti.i32)
    if material == TRUNK or material == POLE:
        u = tm.atan2(p[1], p[0]) * half[0]
    g = ti.Vector([octave(u, v, 0.018, foot, salt), octave(u, v, 0.06, foot, salt + 1),
                   octave(u, v, 0.21, foot, salt + 2), octave(u, v, 0.8, foot, salt + 3),
                   octave(u, v, 3.1, foot, salt + 4)])  # fmt: skip
    rgb = rgb3(0.4, 0.4, 0.4) * (1 + 0.3 * g[1] + 0.4 * g[2] + 0.3 * g[3])
    if material == HOUSE:
        if face == 2:
            rgb = rgb3(0.3, 0.29, 0.28) * (1 + 0.5 * g[1] + 0.5 * g[2] + 0.4 * g[3])
        else:
            side = face + 2 * ti.cast(normal[0] + normal[1] > 0, ti.i32)
            above = v + half[2] - SUNK
            rgb = house_color(u, above, wide, 2 * half[2] - SUNK, variant, side, g, foot)
    elif material == TILES:
        if face == 1:
            rgb = plaster_of(variant) * (1 + 0.2 * g[1] + 0.2 * g[2] + 0.3 * g[3])
        else:
            rgb = tiles_color(p[1], p[2] * 1.3, variant, g, foot)
    elif material == BODY:
        rgb = body_color(p, half, normal, variant, g, foot)
    elif material == CABIN:
        rgb = cabin_color(p, half, normal, variant, g, foot)
    elif material == TYRE:
        away = tm.sqrt(p[0] * p[0] + p[2] * p[2]) / half[0]
        rgb = rgb3(0.035, 0.035, 0.037) * (1 + 0.5 * g[1])
        if away < 0.66:
            spoke = ti.sin(5 * tm.atan2(p[2], p[0]) + variant)
            rgb = rgb3(0.5, 0.5, 0.52) * (0.35 + 0.65 * ti.cast(spoke > 0.0 or away < 0.2, ti.f32))
    elif material == POLE:
        rgb = rgb3(0.33, 0.35, 0.36) * (
            0.75 + 0.5 * cell(variant, 2, 61) + 0.3 * g[1] + 0.4 * g[2] + 0.4 * g[3]
        )
    elif material == TRUNK:
        furrow = octave(u, 0.25 * v, 0.05, foot, salt + 6)
        rgb = rgb3(0.2, 0.155, 0.11) * (1 + 1.2 * furrow + 0.5 * g[1] + 0.5 * g[2] + 0.5 * g[3])
    elif material == CROWN or material == HEDGE:
        rgb = leaves_color(u, v, salt, g, foot)
    elif material == SIGN:
        rgb = sign_color(p, half, variant, foot)
    elif material == FENCE:
        board = cell_at(u / 0.11, 1, salt) - 0.5
        gap = inside(fract(u / 0.11) * 0.11 - 0.055, 0.045, foot)
        rgb = rgb3(0.42, 0.33, 0.24) * (1 + 0.6 * board * tm.clamp(0.11 / foot - 0.7, 0.0, 1.0)
                                        + 0.4 * octave(8 * u, v, 0.2, foot, salt) + 0.4 * g[3])  # fmt: skip
        rgb *= 0.35 + 0.65 * gap
    elif material == BIN:
        rgb = paint_of(cell(variant, 1, 71)) * 0.7 * (1 + 0.2 * g[1] + 0.4 * g[2] + 0.4 * g[3])
        if ti.abs(v - 0.55 * half[2]) < 0.03:
            rgb *= 0.4
    if kind == SPHERE:
        rgb *= 0.75 + 0.35 * normal[2]
    return rgb
