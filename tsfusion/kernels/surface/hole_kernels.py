# SPDX-License-Identifier: MIT
"""Extend the field into unseen voxels, near the end of a seen surface (`hole_filling.py`).

Unseen voxels near a rim and the seen voxels beside them are numbered into one list, as for the field
regulariser. Its `weigh` and `relax` then solve the list: eq. 3 of the paper with no weight where unseen.
"""

from tsfusion.kernels import F32, I32, I64, U8, F32x2, I32x2, U8x2, U64x2, ti
from tsfusion.kernels.base.quick_launch import runs, unit_of
from tsfusion.kernels.base.voxel_traversal import offset_in_block, vec3i, voxel_of
from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.kernels.surface.field_smoothing import count_bits, link, without_lowest
from tsfusion.kernels.surface.normal_smoothing import block_at, value_at
from tsfusion.kernels.surface.surface_cells import STRIPS, case_of, corner_planes, lowest

UNSEEN = 1  # voxels to solve
BESIDE = 2  # seen voxels beside voxels to solve
RING = 4  # number of seen voxels that count, before or behind an unseen voxel
SEEN_WEIGHT = 0.2  # weight of a seen value against smoothness: noise at the rim must not steer the guess
EARLY = 1 << 20  # layer of a voxel without a value

vec3f = ti.types.vector(3, ti.f32)


@ti.kernel
def find_rims(
    around: I32x2,  # (blocks, 27): rows of the blocks around, −1 = none
    values: F32x2, rims: U8x2,
):  # fmt: skip
    """Set 1 for each seen voxel at a rim: the surface passes it, and one of its 26 neighbours is unseen."""
    for run in range(runs(values.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, values.shape[0])
        if b < values.shape[0]:
            for o in range(CUBE):
                here = values[b, o]
                is_rim = 0
                if here == here:
                    p = voxel_of(o)
                    crossed = 0
                    for side in ti.static(range(6)):
                        q = p
                        q[side // 2] += 2 * (side % 2) - 1
                        there = value_at(values, around, b, q)
                        crossed |= ti.cast(
                            (there < 0.0 and here >= 0.0) or (there >= 0.0 and here < 0.0), ti.i32
                        )
                    if crossed == 1:
                        for n in range(27):
                            q = p + vec3i(n // 9 - 1, n // 3 % 3 - 1, n % 3 - 1)
                            there = value_at(values, around, b, q)
                            if not (there == there):
                                is_rim = 1
                rims[b, o] = ti.cast(is_rim, ti.u8)


@ti.func
def row_of(keys: ti.template(), count, key):
    """Return the index of a block key among the first `count` sorted keys, −1 if absent."""
    low = 0
    high = count
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    found = -1
    if low < count and keys[ti.min(low, count - 1)] == key:
        found = low
    return found


@ti.func
def normal_at(values: ti.template(), around: ti.template(), b, p):
    """Return the unit gradient of the distance at a seen voxel, from its seen neighbours; 0 without any."""
    here = value_at(values, around, b, p)
    normal = vec3f(0.0)
    for a in ti.static(range(3)):
        step = vec3i(0)
        step[a] = 1
        before = value_at(values, around, b, p - step)
        after = value_at(values, around, b, p + step)
        if before == before and after == after:
            normal[a] = 0.5 * (after - before)
        elif after == after:
            normal[a] = after - here
        elif before == before:
            normal[a] = here - before
    length = normal.norm()
    return normal * ti.select(length > 0.0, 1.0 / ti.max(length, 1e-6), 0.0)


@ti.kernel
def mark_unseen(
    keys: I64,  # sorted
    around: I32x2, values: F32x2, rims: U8x2,
    columns: I32x2,  # (n, 3) of a ball: x, y, and how far it reaches in z
    slab: ti.f32,  # voxels from the plane of the rim, and how that grows with the distance from it
    slope: ti.f32, marks: U8x2,
):  # fmt: skip
    """Mark the unseen voxels in a ball around each rim voxel that are near the continued surface.

    Threads at the same voxel write the same value.
    """
    count = values.shape[0]
    for run in range(runs(count)):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, count)
        if b < count:
            for o in range(CUBE):
                if rims[b, o] == 1:
                    p = voxel_of(o)
                    normal = normal_at(values, around, b, p)
                    for c in range(columns.shape[0]):
                        x = p[0] + columns[c, 0]
                        y = p[1] + columns[c, 1]
                        column = keys[b] + (ti.cast(x >> 3, ti.i64) << 42) + (ti.cast(y >> 3, ti.i64) << 21)
                        block = -1
                        last = 1 << 20
                        for z in range(p[2] - columns[c, 2], p[2] + columns[c, 2] + 1):
                            q = vec3i(x, y, z)
                            d = ti.cast(q - p, ti.f32)
                            if abs(normal.dot(d)) <= slab + slope * d.norm():
                                if z >> 3 != last:
                                    last = z >> 3
                                    block = row_of(keys, count, column + last)
                                if block >= 0:
                                    i = offset_in_block(q)
                                    there = values[block, i]
                                    if not (there == there):
                                        marks[block, i] = ti.u8(UNSEEN)


@ti.kernel
def take_marked(around: I32x2, values: F32x2, marks: U8x2, planes: U64x2, counts: I32x2):
    """Add to the list to solve all marked voxels, and the seen voxels up to `RING` before or behind them."""
    for run in range(runs(values.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, values.shape[0])
        if b < values.shape[0]:
            for word in range(planes.shape[1]):
                plane = ti.u64(0)
                for j in range(64):
                    o = 64 * word + j
                    taken = ti.cast(marks[b, o], ti.i32)
                    if taken == 0 and values[b, o] == values[b, o]:
                        for k in range(6 * RING):
                            q = voxel_of(o)
                            q[k // (2 * RING)] += k % RING + 1 if k // RING % 2 == 0 else -(k % RING + 1)
                            row = block_at(around, b, q)
                            if row >= 0:
                                if marks[row, offset_in_block(q)] == UNSEEN:
                                    taken = BESIDE
                    plane |= ti.cast(taken > 0, ti.u64) << ti.cast(j, ti.u64)
                planes[b, word] = plane
                counts[b, word] = count_bits(plane)


@ti.kernel
def list_marked(
    sides: I32x2,  # (blocks, 6): −x, +x, −y, +y, −z, +z; −1 = none
    values: F32x2, marks: U8x2, planes: U64x2, places: I32x2, links: I32x2, y: F32, weight: F32, x: F32,
    layer: I32,
):  # fmt: skip
    """Fill the solver's list for the marked voxels: values and weights of seen voxels, neighbours of all."""
    for run in range(runs(values.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, values.shape[0])
        if b < values.shape[0]:
            for word in range(planes.shape[1]):
                left = planes[b, word]
                i = places[b, word]
                while left != 0:
                    o = 64 * word + lowest(left)
                    seen = marks[b, o] != UNSEEN
                    value = ti.select(seen, values[b, o], 0.0)
                    y[i] = value
                    x[i] = value
                    weight[i] = ti.select(seen, ti.f32(SEEN_WEIGHT), 0.0)
                    layer[i] = ti.select(seen, 0, EARLY)
                    link(planes, places, sides, 3, b, o, i, links)
                    i += 1
                    left = without_lowest(left)


@ti.kernel
def extend(
    sweep: ti.i32, links: I32x2,
    layer: I32,  # the last of it, as of `x`, stands for none
    x: F32,
) -> ti.i32:  # fmt: skip
    """Give a start value to unseen voxels next to voxels with a value: the mean of the predictions of ramps
    and neighbours. Returns the number of new values."""
    given = 0
    for i in range(links.shape[1]):
        if layer[i] == EARLY:
            total = ti.f32(0.0)
            count = ti.f32(0.0)
            for side in ti.static(range(6)):
                m = links[side, i]
                if layer[m] < sweep:
                    value = x[m]
                    far = links[side, ti.min(m, links.shape[1] - 1)]
                    if layer[far] < sweep:
                        value += x[m] - x[far]
                    total += value
                    count += 1.0
            if count > 0.0:
                x[i] = total / count
                layer[i] = sweep
                given += 1
    return given


@ti.kernel
def mark_guessed_faces(
    count: ti.i32, around: I32x2,
    unseen: U64x2,  # (row, 8): planes, as in `surface_cells`
    inside: U64x2, active: U64x2, first: I32x2, triangle_count: I32, guessed: U8,
):  # fmt: skip
    """Set `guessed` to 1 for each mesh triangle, in `emit_faces`' order, of a cell with an unseen corner."""
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                face = first[r, 1]
                if face < first[r + 1, 1]:
                    low = corner_planes(inside, around, r, 0)
                    guess_low = corner_planes(unseen, around, r, 0)
                    for x in range(8):
                        high = corner_planes(inside, around, r, x + 1)
                        guess_high = corner_planes(unseen, around, r, x + 1)
                        any_guess = ti.u64(0)
                        for c in ti.static(range(4)):
                            any_guess |= guess_low[c] | guess_high[c]
                        left = active[r, x]
                        while left != 0:
                            j = lowest(left)
                            left &= left - ti.u64(1)
                            is_guess = (any_guess >> ti.cast(j, ti.u64)) & ti.u64(1)
                            for _ in range(triangle_count[case_of(low, high, j)]):
                                guessed[face] = ti.cast(is_guess, ti.u8)
                                face += 1
                        low = high
                        guess_low = guess_high
