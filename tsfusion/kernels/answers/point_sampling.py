# SPDX-License-Identifier: MIT
"""Interpolate the map's signed distance between voxel centres (trilinear), with its gradient; compute slices.

A point is rounded to 2⁻¹⁶ voxel. It lies between eight voxel centres. Only those with a share in the point
count: at a voxel's centre that is one voxel.

The map holds distances along rays. Along oblique rays the gradient is steeper than 1. The distance divided by
it is, to first order, the distance to the surface.
"""

from tsfusion.kernels import F32, I32, I64, U8, ANYx2, F32x2, I32x2, I64x2, ti
from tsfusion.kernels.base.block_hash import map_find
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.base.voxel_traversal import VOXEL_LIMIT, block_key, offset_in_block, pack, vec3i
from tsfusion.kernels.integration.integrate import CUBE, QUANTA_PER_VOXEL, lane_distance, lane_weight
from tsfusion.kernels.surface.surface_cells import STRIPS, cautious, distance_as_float, is_clear

ONE = 65536.0  # units per voxel
UNKNOWN = -2  # slot of a block that is not looked up yet
STRIP = 512  # points that one thread takes per unit
BATCH = 64  # points of a strip that wait for memory together

# Kinds of values: Σ w·m / Σ w; the same with `correction` added to Σ w·m; the values that `pair` stores
FUSED, CORRECTED, SOLVED = 0, 1, 2

vec3f = ti.types.vector(3, ti.f32)
vec4f = ti.types.vector(4, ti.f32)
vec3l = ti.types.vector(3, ti.i64)
corners_i = ti.types.vector(8, ti.i32)
corners_l = ti.types.vector(8, ti.i64)
corners_f = ti.types.vector(8, ti.f32)
vec3d = ti.types.vector(3, ti.f64)


@ti.func
def place_of(points: ti.template(), n, per_metre):
    """Return point n in 2⁻¹⁶ voxel from the centre of voxel (0, 0, 0), and True if a map can contain it."""
    place = vec3l(0)
    inside = True
    for a in ti.static(range(3)):
        scaled = ti.cast(points[n, a], ti.f64) * per_metre
        inside = inside and ti.abs(scaled) < VOXEL_LIMIT - 64
        place[a] = ti.cast(ti.floor(ti.select(inside, scaled, 0.0) * ONE + 0.5), ti.i64) - 32768
    return place, inside


@ti.func
def find_near(near: ti.template(), voxel, k, map_keys: ti.template(), map_slots: ti.template()):
    """Return the slot of the block k steps from the voxel's (k: a bit for x, y, z), cached in `near`."""
    if near[k] == UNKNOWN:
        key = pack((voxel[0] >> 3) + (k & 1), (voxel[1] >> 3) + (k >> 1 & 1), (voxel[2] >> 3) + (k >> 2))
        near[k] = map_find(map_keys, map_slots, map_keys.shape[0] - 1, key)
    return near[k]


@ti.func
def crossing(voxel):
    """Return a 3-bit mask of the axes along which the voxel's next neighbour lies in the next block."""
    return (
        ti.cast((voxel[0] & 7) == 7, ti.i32)
        | ti.cast((voxel[1] & 7) == 7, ti.i32) << 1
        | ti.cast((voxel[2] & 7) == 7, ti.i32) << 2
    )


@ti.func
def corner_offset(voxel, c: ti.template()):
    """Return the number in its block (0 … 511) of corner c of a voxel's cell. Bits of c: steps on x, y, z."""
    return (
        (((voxel[0] + (c & 1)) & 7) << 6)
        | (((voxel[1] + (c >> 1 & 1)) & 7) << 3)
        | ((voxel[2] + (c >> 2)) & 7)
    )


@ti.func
def read_voxel(row, o, sums: ti.template(), kind, correction: ti.template()):
    """Return the packed sums of voxel `o` of the block in `row`, and its entry in `correction`."""
    added = ti.f32(0.0)
    if kind == CORRECTED:
        added = correction[row, o]
    return sums[row, o], added


@ti.func
def value_of(packed, added, kind, min_weight):
    """Return the distance of a voxel, sixtieths of a voxel, NaN below `min_weight`, and its weight."""
    w = lane_weight(packed)
    solved = ti.bit_cast(ti.cast(packed >> 32, ti.i32), ti.f32)
    if kind == SOLVED:
        w = ti.cast(packed, ti.i32)
    weight = ti.cast(w, ti.f32)
    value = (ti.cast(lane_distance(packed), ti.f32) + added) / weight
    value = ti.select(kind == SOLVED, solved, value)
    return ti.select(w >= min_weight, value, ti.math.nan), weight


@ti.func
def blend(v, f):
    """Return the trilinear mean of a cell's eight corner values `v` at position `f`, and its gradient."""
    x = vec4f(v[1] - v[0], v[3] - v[2], v[5] - v[4], v[7] - v[6])
    along_x = vec4f(v[0], v[2], v[4], v[6]) + f[0] * x
    y0, y1 = along_x[1] - along_x[0], along_x[3] - along_x[2]
    low, high = along_x[0] + f[1] * y0, along_x[2] + f[1] * y1
    x0, x1 = x[0] + f[1] * (x[1] - x[0]), x[2] + f[1] * (x[3] - x[2])
    z = high - low
    return low + f[2] * z, vec3f(x0 + f[2] * (x1 - x0), y0 + f[2] * (y1 - y0), z)


@ti.func
def blend_shares(v, f):
    """Return the trilinear mean as `blend`; corners whose share is zero may be NaN."""
    total = ti.f32(0.0)
    for c in ti.static(range(8)):
        share = ti.f32(1.0)
        for a in ti.static(range(3)):
            share *= f[a] if ti.static(c >> a & 1) else 1.0 - f[a]
        if share > 0.0:
            total += share * v[c]
    return total


@ti.func
def write_sample(
    n, packed, added, f, kind, min_weight, metres, distance: ti.template(), weight: ti.template(),
    gradient: ti.template(),
):  # fmt: skip
    """Write sample n from the sums of its cell's eight corners, interpolated at position f in the cell."""
    v = corners_f(0.0)
    w = corners_f(0.0)
    for c in ti.static(range(8)):
        v[c], w[c] = value_of(packed[c], added[c], kind, min_weight)
    total, slope = blend(v, f)
    if not (total == total):  # Taichi's != is false for NaN
        total = blend_shares(v, f)
    slope *= ti.static(1.0 / QUANTA_PER_VOXEL)
    # Along oblique rays the distance grows faster than the distance to the surface
    steep = slope.norm()
    shorter = 1.0 / ti.select(steep > 1.0, steep, 1.0)
    distance[n] = total * metres * shorter
    weight[n] = blend(w, f)[0] * ti.static(1.0 / WEIGHT_ONE)
    for a in ti.static(range(3)):
        gradient[n, a] = slope[a] * shorter


@QuickLaunch
@ti.kernel
def list_blocks(points: ANYx2, per_metre: ti.f64, map_keys: I64, map_slots: I32, is_needed: U8):
    """Set `is_needed` for the slots of all blocks whose voxels `interpolate` reads for these points."""
    count = points.shape[0]
    for run in range(runs((count + STRIP - 1) // STRIP)):  # run loop: kernels/base/quick_launch.py
        first = unit_of(run, (count + STRIP - 1) // STRIP) * STRIP
        if first < count:
            last = vec3i(2147483647)
            near = corners_i(UNKNOWN)
            for n in range(first, ti.min(first + STRIP, count)):
                place, inside = place_of(points, n, per_metre)
                if inside:
                    voxel = ti.cast(place >> 16, ti.i32)
                    block = voxel >> 3
                    if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                        last = block
                        near = corners_i(UNKNOWN)
                    across = crossing(voxel)
                    for k in range(8):
                        if (k & ~across) == 0:
                            slot = find_near(near, voxel, k, map_keys, map_slots)
                            if slot >= 0:
                                is_needed[slot] = ti.u8(1)


@QuickLaunch
@ti.kernel
def pair(slots: I32, sums: I64x2, values: F32x2, pairs: I64x2):
    """Write row n of `pairs`: bits of the values (row n of `values`) in the upper halves, Σ w in the lower.

    Value and weight of a voxel are then together: a processor waits for memory once per voxel.
    """
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            count = slots.shape[0]
            for n in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                slot = slots[n]
                for o in range(CUBE):
                    bits = ti.cast(ti.bit_cast(values[n, o], ti.i32), ti.i64)
                    pairs[n, o] = bits << 32 | ti.cast(lane_weight(sums[slot, o]), ti.i64)


@QuickLaunch
@ti.kernel
def interpolate(
    points: ANYx2, per_metre: ti.f64, map_keys: I64, map_slots: I32,
    sums: I64x2,  # SOLVED: pairs
    min_weight: ti.i32, kind: ti.i32, correction: F32x2,
    row_of: I32,  # SOLVED: row of each slot
    distance: F32, weight: F32, gradient: F32x2,
):  # fmt: skip
    """Write distance (metres), weight (full-confidence samples) and gradient of the map at every point."""
    count = points.shape[0]
    metres = ti.cast(1.0 / (per_metre * QUANTA_PER_VOXEL), ti.f32)
    for run in range(runs((count + STRIP - 1) // STRIP)):  # run loop: kernels/base/quick_launch.py
        first = unit_of(run, (count + STRIP - 1) // STRIP) * STRIP
        if first < count:
            last = vec3i(2147483647)
            near = corners_i(UNKNOWN)
            for n in range(first, ti.min(first + STRIP, count)):
                place, inside = place_of(points, n, per_metre)
                voxel = ti.cast(place >> 16, ti.i32)
                block = voxel >> 3
                if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                    last = block
                    near = corners_i(UNKNOWN)
                across = crossing(voxel)
                packed = corners_l(0)
                added = corners_f(0.0)
                if inside and across == 0:  # two of three points: eight corners in one block
                    slot = find_near(near, voxel, 0, map_keys, map_slots)
                    if slot >= 0:
                        o, row = offset_in_block(voxel), slot
                        if kind == SOLVED:
                            row = row_of[slot]
                        for c in ti.static(range(8)):
                            step = ti.static(64 * (c & 1) + 8 * (c >> 1 & 1) + (c >> 2))
                            packed[c], added[c] = read_voxel(row, o + step, sums, kind, correction)
                elif inside:
                    for c in ti.static(range(8)):
                        slot = find_near(near, voxel, c & across, map_keys, map_slots)
                        if slot >= 0:
                            o, row = corner_offset(voxel, c), slot
                            if kind == SOLVED:
                                row = row_of[slot]
                            packed[c], added[c] = read_voxel(row, o, sums, kind, correction)
                f = ti.cast(place & 65535, ti.f32) * ti.static(1.0 / ONE)
                write_sample(n, packed, added, f, kind, min_weight, metres, distance, weight, gradient)


@QuickLaunch
@ti.kernel
def interpolate_within(
    points: ANYx2, per_metre: ti.f64, rows: I32, begin: vec3i, size: vec3i,
    sums: I64x2,  # SOLVED: pairs
    min_weight: ti.i32, kind: ti.i32, correction: F32x2, distance: F32, weight: F32, gradient: F32x2,
):  # fmt: skip
    """Write the same results as `interpolate`, bit by bit, for many points: with a table instead of the hash.

    `rows` maps the blocks of a box (`size` blocks along x, y, z, from block `begin` on) to rows of `sums`; an
    absent block has -1, as all blocks in the first two layers along each axis and in the last.

    Points in random order wait for memory, so the points of a batch wait together: first all positions are
    computed, then all sums are touched, then blended. Meanwhile the outputs hold intermediate numbers as
    bits: `weight` a point's block, `distance` its voxel, `gradient` its position in the cell.
    """
    count = points.shape[0]
    metres = ti.cast(1.0 / (per_metre * QUANTA_PER_VOXEL), ti.f32)
    along = vec3i(size[1] * size[2], size[2], 1)
    for run in range(runs((count + STRIP - 1) // STRIP)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, (count + STRIP - 1) // STRIP)
        if strip * STRIP < count:
            for part in range(STRIP // BATCH):
                first = strip * STRIP + part * BATCH
                end = ti.min(first + BATCH, count)
                for n in range(first, end):
                    place, inside = place_of(points, n, per_metre)
                    voxel = ti.cast(place >> 16, ti.i32)
                    block = (voxel >> 3) - begin
                    for a in ti.static(range(3)):
                        inside = inside and block[a] >= 0 and block[a] < size[a] - 1
                        gradient[n, a] = ti.cast(place[a] & 65535, ti.f32) * ti.static(1.0 / ONE)
                    weight[n] = ti.bit_cast(ti.select(inside, block.dot(along), 0), ti.f32)
                    distance[n] = ti.bit_cast(offset_in_block(voxel), ti.f32)
                for n in range(first, end):
                    block, o = ti.bit_cast(weight[n], ti.i32), ti.bit_cast(distance[n], ti.i32)
                    voxel = vec3i(o >> 6, o >> 3 & 7, o & 7)
                    touched = ti.i64(0)
                    for c in ti.static(range(4)):  # eight voxels along z are one cache line
                        k = c & crossing(voxel)
                        row = rows[block + (k & 1) * along[0] + (k >> 1) * along[1]]
                        if row >= 0:
                            touched ^= sums[row, corner_offset(voxel, c)]
                    distance[n] = ti.bit_cast(
                        o | ti.cast(touched, ti.i32) << 9, ti.f32
                    )  # else it is not read
                for n in range(first, end):
                    block, o = ti.bit_cast(weight[n], ti.i32), ti.bit_cast(distance[n], ti.i32) & 511
                    voxel = vec3i(o >> 6, o >> 3 & 7, o & 7)
                    across = crossing(voxel)
                    packed = corners_l(0)
                    added = corners_f(0.0)
                    if across == 0:
                        row = rows[block]
                        if row >= 0:
                            for c in ti.static(range(8)):
                                step = ti.static(64 * (c & 1) + 8 * (c >> 1 & 1) + (c >> 2))
                                packed[c], added[c] = read_voxel(row, o + step, sums, kind, correction)
                    else:
                        for c in ti.static(range(8)):
                            k = c & across
                            row = rows[block + vec3i(k & 1, k >> 1 & 1, k >> 2).dot(along)]
                            if row >= 0:
                                packed[c], added[c] = read_voxel(
                                    row, corner_offset(voxel, c), sums, kind, correction
                                )
                    f = vec3f(gradient[n, 0], gradient[n, 1], gradient[n, 2])
                    write_sample(n, packed, added, f, kind, min_weight, metres, distance, weight, gradient)


@ti.kernel
def read_columns(
    cells: I32, width: ti.i32, row: ti.i32, column: ti.i32, across: ti.i32, heights: ti.i32, corner: vec3d,
    along_row: vec3d, along_column: vec3d, along_height: vec3d, map_keys: I64, map_slots: I32, sums: I64x2,
    correction: F32x2, corrected: ti.i32, color_rgn: I64x2, hits: I32x2, layers: ti.i32, shows_surface: U8,
    clear_keys: I64, clear_slots: I32, clear_counts: I32, min_weight: ti.i32, values: F32, seen: I32,
):  # fmt: skip
    """Write, for each cell of a slice, `values`: the smallest signed distance (`cautious`), in voxels, of its
    seen samples, NaN without any; and `seen`: the number of samples that were seen, or lie in a wholly free
    block. Cell n of `cells` is (`row` + n // `width`, `column` + n % `width`). It has `across`² columns of
    `heights` samples, `along_row`, `along_column`, `along_height` apart, in voxels, from `corner` on."""
    mask = map_keys.shape[0] - 1
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            count = cells.shape[0]
            last, slot, clear = vec3i(2147483647), -1, 0
            for n in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                cell = cells[n]
                first_row = (row + cell // width) * across
                first_column = (column + cell % width) * across
                least, number = ti.math.nan, 0
                for line in range(across * across):
                    r, c = first_row + line // across, first_column + line % across
                    foot = corner + along_row * ti.cast(r, ti.f64) + along_column * ti.cast(c, ti.f64)
                    for h in range(heights):
                        place = foot + along_height * ti.cast(h, ti.f64)
                        if ti.max(ti.abs(place[0]), ti.abs(place[1]), ti.abs(place[2])) < VOXEL_LIMIT - 1:
                            voxel = ti.floor(place, ti.i32)
                            block = voxel >> 3
                            if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                                last = block
                                key = block_key(voxel)
                                slot = map_find(map_keys, map_slots, mask, key)
                                clear = is_clear(
                                    key, slot, shows_surface, clear_keys, clear_slots, clear_counts
                                )
                            is_seen = 0
                            if slot >= 0:
                                o = offset_in_block(voxel)
                                packed = sums[slot, o]
                                w = lane_weight(packed)
                                if w >= min_weight:
                                    distance = distance_as_float(packed)
                                    if corrected == 1:
                                        distance += correction[slot, o]
                                    value = distance / ti.cast(w, ti.f32) / QUANTA_PER_VOXEL
                                    value = cautious(value, slot, o, color_rgn, hits, layers)
                                    is_seen = 1
                                    if not value >= least:  # also true for NaN: no earlier seen sample
                                        least = value
                            number += is_seen | clear
                values[cell], seen[cell] = least, number
