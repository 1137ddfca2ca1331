# SPDX-License-Identifier: MIT
"""Read values from the map's sums, and find the cells that the surface crosses and the edges of vertices.

A block's voxels are eight bit planes, one for each x; bit 8·y + z of a plane is voxel (x, y, z). Shifts and
combinations of bit planes of the block and of its neighbours find the crossed cells. A cell is active if its
eight corners are seen, and a surface was measured between them (`is_between`). An edge has a vertex if its
ends differ in sign and an active cell contains it. That cell then has both signs, so the `active` cells
determine all vertices.

Blocks are rows of arrays. Row `count` stands for every absent block, in which all is unseen.
"""

from tsfusion.kernels import I32, I64, U8, F32x2, I32x2, I64x2, U64x2, ti
from tsfusion.kernels.base.block_hash import map_find
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.voxel_traversal import hash_key
from tsfusion.kernels.integration.integrate import CUBE, QUANTA_PER_VOXEL, WEIGHT_BITS, lane_weight

AROUND = 27
HERE = 13  # index among the 27 blocks around: (x + 1)·9 + (y + 1)·3 + z + 1
PLANES = 24  # of edges: 3·x + axis
NEVER = 1e9  # quanta
NO_LIMITS = 0.0, NEVER  # `behind` and `clear` of a map that is not carved
Z0 = 0x0101010101010101  # the voxels of a plane with z = 0; below, those with z < 7
Z06 = 0x7F7F7F7F7F7F7F7F

planes4 = ti.types.vector(4, ti.u64)
STRIPS = 64  # units of parallel work; fixed, so that no result depends on the thread count
# A loop that stores to an array does not become vector code (LLVM cannot exclude that the store changes the
# array's address); one that stores to a small local vector does: 0.5 µs a block instead of 1.4.
STRIDE = 32
SEVERAL = 3  # rays that end in a voxel, from which it counts as surface, however many others look through it


@ti.func
def next_z(plane, block_z):
    """Shift a bit plane: each voxel gets the bit of its neighbour at z + 1 (`block_z`: next block)."""
    return ((plane >> ti.u64(1)) & ti.u64(Z06)) | ((block_z & ti.u64(Z0)) << ti.u64(7))


@ti.func
def next_y(plane, block_y):
    """Shift a bit plane: each voxel gets the bit of its neighbour at y + 1 (`block_y`: next block)."""
    return (plane >> ti.u64(8)) | (block_y << ti.u64(56))


@ti.func
def previous_z(plane, block_z):
    """Shift a bit plane: each voxel gets the bit of its neighbour at z − 1 (`block_z`: block before)."""
    return ((plane & ti.u64(Z06)) << ti.u64(1)) | ((block_z >> ti.u64(7)) & ti.u64(Z0))


@ti.func
def previous_y(plane, block_y):
    """Shift a bit plane: each voxel gets the bit of its neighbour at y − 1 (`block_y`: block before)."""
    return (plane << ti.u64(8)) | (block_y >> ti.u64(56))


@ti.func
def corner_planes(planes: ti.template(), around: ti.template(), r, x):
    """Return bit planes of the corners (y, z) = (0, 0), (1, 0), (0, 1), (1, 1) of the cells at 0 ≤ x ≤ 8."""
    k = HERE + 9 * (x >> 3)
    i = x & 7
    here = planes[around[r, k], i]
    above = planes[around[r, k + 1], i]
    beside = next_y(here, planes[around[r, k + 3], i])
    diagonal = next_y(above, planes[around[r, k + 4], i])
    return planes4(here, beside, next_z(here, above), next_z(beside, diagonal))


@ti.func
def lowest(plane):
    """Return the index (0 … 63) of the lowest set bit of a non-zero bit plane."""
    return ti.cast(ti.math.popcnt(~plane & (plane - ti.u64(1))), ti.i32)


@ti.func
def case_of(low, high, j):
    """Return the case of cell j between corner planes at x and x + 1: bit c is set if corner c is inside."""
    case = 0
    for c in ti.static(range(4)):
        case |= ti.cast((low[c] >> ti.cast(j, ti.u64)) & ti.u64(1), ti.i32) << (2 * c)
        case |= ti.cast((high[c] >> ti.cast(j, ti.u64)) & ti.u64(1), ti.i32) << (2 * c + 1)
    return case


@ti.func
def shift_column(key, column):
    """Return the key of the block −1, 0 or 1 away along x and y: column = (x + 1)·3 + y + 1."""
    return key + (ti.cast(column // 3 - 1, ti.i64) << 42) + (ti.cast(column % 3 - 1, ti.i64) << 21)


@ti.kernel
def collect_around(
    count: ti.i32, wanted: I64, map_keys: I64, map_slots: I32,
    table: I64,  # empty; never more than half full
    keys: I64,
) -> ti.i32:  # fmt: skip
    """List in `keys` the `wanted` blocks (sorted) and their neighbours in the map. Returns their number."""
    found = 0
    mask = table.shape[0] - 1
    map_mask = map_keys.shape[0] - 1
    ti.loop_config(serialize=True)
    for n in range(count):
        key = wanted[n]
        first = -1
        if n > 0 and wanted[ti.max(n - 1, 0)] == key - 1:
            first = 1  # the block before this one has already listed the others
        for column in range(9):
            for z in range(first, 2):
                k = shift_column(key, column) + z
                i = hash_key(k) & mask
                while table[i] != 0 and table[i] != k:
                    i = (i + 1) & mask
                if table[i] == 0 and map_find(map_keys, map_slots, map_mask, k) >= 0:
                    table[i] = k
                    keys[found] = k
                    found += 1
    return found


@ti.func
def find_signs(r, values: ti.template(), seen: ti.template(), inside: ti.template()):
    """Write a block's bit planes of seen voxels and of voxels inside (value < 0). Returns 1 if the seen ones
    are all inside, 2 all outside, 3 both."""
    any_inside = ti.u64(0)
    any_outside = ti.u64(0)
    for x in range(8):
        seen_plane = ti.u64(0)
        inside_plane = ti.u64(0)
        for j in range(64):  # LLVM vectorises this loop
            value = values[r, 64 * x + j]
            seen_plane |= ti.cast(value == value, ti.u64) << ti.cast(j, ti.u64)
            inside_plane |= ti.cast(value < 0.0, ti.u64) << ti.cast(j, ti.u64)
        seen[r, x] = seen_plane
        inside[r, x] = inside_plane
        any_inside |= inside_plane
        any_outside |= seen_plane & ~inside_plane
    return ti.cast(any_inside != 0, ti.i32) | ti.cast(any_outside != 0, ti.i32) << 1


@ti.func
def find_around(
    r, count, keys: ti.template(), table: ti.template(), table_rows: ti.template(), around: ti.template()
):
    """Write the rows in `keys` of the 27 blocks around the block of row r; `count` for an absent block."""
    mask = table.shape[0] - 1
    for column in range(9):
        key = shift_column(keys[r], column)
        middle = r
        if column != 4:
            middle = map_find(table, table_rows, mask, key)
        below = -1
        above = -1
        if middle >= 0:  # the keys are sorted: neighbours in z are adjacent rows
            if middle > 0 and keys[ti.max(middle - 1, 0)] == key - 1:
                below = middle - 1
            if middle + 1 < count and keys[ti.min(middle + 1, count - 1)] == key + 1:
                above = middle + 1
        else:
            below = map_find(table, table_rows, mask, key - 1)
            above = map_find(table, table_rows, mask, key + 1)
        around[r, 3 * column] = ti.select(below < 0, count, below)
        around[r, 3 * column + 1] = ti.select(middle < 0, count, middle)
        around[r, 3 * column + 2] = ti.select(above < 0, count, above)


@ti.func
def is_between(r, x, j, around: ti.template(), values: ti.template(), behind, clear):
    """Return 1 if cell j has a `clear` voxel and one far `behind` a surface (quanta), hence no surface.

    Sensors looked through the first voxel; the other lies behind a known surface. No surface was measured
    between them, because its voxels would be near it.
    """
    least, most = 0.0, 0.0
    for c in range(8):
        at_x, at_y, at_z = x + (c & 1), (j >> 3) + (c >> 1 & 1), (j & 7) + (c >> 2)
        row = around[r, HERE + 9 * (at_x >> 3) + 3 * (at_y >> 3) + (at_z >> 3)]
        value = values[row, ((at_x & 7) << 6) | ((at_y & 7) << 3) | (at_z & 7)]
        least, most = ti.min(least, value), ti.max(most, value)
    return ti.cast(least < behind, ti.i32) & ti.cast(most > clear, ti.i32)


@ti.func
def find_active(
    r, around: ti.template(), seen: ti.template(), inside: ti.template(), active: ti.template(),
    triangle_count: ti.template(), values: ti.template(), behind, clear,
):  # fmt: skip
    """Write the bit planes of a block's active cells. Returns the number of their triangles."""
    total = 0
    seen_low = corner_planes(seen, around, r, 0)
    low = corner_planes(inside, around, r, 0)
    for x in range(8):
        seen_high = corner_planes(seen, around, r, x + 1)
        high = corner_planes(inside, around, r, x + 1)
        whole = ~ti.u64(0)
        some = ti.u64(0)
        every = ~ti.u64(0)
        for c in ti.static(range(4)):
            whole &= seen_low[c] & seen_high[c]
            some |= low[c] | high[c]
            every &= low[c] & high[c]
        crossed = whole & some & ~every
        kept = crossed
        while crossed != 0:
            j = lowest(crossed)
            if clear < NEVER and is_between(r, x, j, around, values, behind, clear) == 1:
                kept &= ~(ti.u64(1) << ti.cast(j, ti.u64))
            else:
                total += triangle_count[case_of(low, high, j)]
            crossed &= crossed - ti.u64(1)
        active[r, x] = kept
        seen_low = seen_high
        low = high
    return total


@ti.func
def find_edges(
    r, around: ti.template(), inside: ti.template(), active: ti.template(), edges: ti.template(),
    starts: ti.template(),
):  # fmt: skip
    """Write the bit planes of a block's edges with a vertex, and each plane's start. Returns their number."""
    total = 0
    here = around[r, HERE]
    below = around[r, HERE - 1]
    beside = around[r, HERE - 3]
    diagonal = around[r, HERE - 4]
    # Active cells at x − 1 whose (y, z) is a voxel's own, less (1, 0), (0, 1)
    last = active[around[r, HERE - 9], 7]
    last_y = previous_y(last, active[around[r, HERE - 12], 7])
    last_z = previous_z(last, active[around[r, HERE - 10], 7])
    low = corner_planes(inside, around, r, 0)
    for x in range(8):
        high = corner_planes(inside, around, r, x + 1)
        now = active[here, x]
        now_y = previous_y(now, active[beside, x])
        now_z = previous_z(now, active[below, x])
        now_yz = previous_z(now_y, previous_y(active[below, x], active[diagonal, x]))
        carries = ti.Vector([ti.u64(0), ti.u64(0), ti.u64(0)])
        carries[0] = (low[0] ^ high[0]) & (now | now_y | now_z | now_yz)
        carries[1] = (low[0] ^ low[1]) & (now | now_z | last | last_z)
        carries[2] = (low[0] ^ low[2]) & (now | now_y | last | last_y)
        for axis in ti.static(range(3)):
            edges[r, 3 * x + axis] = carries[axis]
            starts[r, 3 * x + axis] = total
            total += ti.cast(ti.math.popcnt(carries[axis]), ti.i32)
        last = now
        last_y = now_y
        last_z = now_z
        low = high
    return total


@ti.func
def clear_planes(planes: ti.template(), r):
    """Set the eight bit planes of a row to zero."""
    for x in range(8):
        planes[r, x] = ti.u64(0)


@ti.func
def signs_around(state: ti.template(), around: ti.template(), r):
    """Return the signs in a block and the blocks that its cells reach into: 1 inside, 2 outside, 3 both."""
    signs = 0
    for c in ti.static(range(8)):
        signs |= state[around[r, HERE + 9 * (c >> 2) + 3 * (c >> 1 & 1) + (c & 1)], 1]
    return signs


@ti.func
def triangles_around(state: ti.template(), around: ti.template(), r):
    """Return a number other than zero if triangles of any block around may need vertices of this block."""
    near = 0
    for c in ti.static(range(7)):
        near |= state[around[r, HERE - 9 * (c >> 2) - 3 * (c >> 1 & 1) - (c & 1)], 2]
    return near


@QuickLaunch
@ti.kernel
def find_cells(
    count: ti.i32,
    keys: I64,  # sorted
    wanted_count: ti.i32,
    wanted: I64,  # some of the keys: whose cells are meshed
    table: I64,  # the keys' hash
    table_rows: I32, values: F32x2,
    behind: ti.f32,  # quanta, as `is_between`
    clear: ti.f32,  # or `NO_LIMITS`
    triangle_count: I32,
    around: I32x2,  # (row, 27): rows of the blocks around
    seen: U64x2,  # (row, 8): planes
    inside: U64x2, active: U64x2,
    edges: U64x2,  # (row, 24): the voxels whose edge carries a vertex
    starts: I32x2,  # (row, 24): vertices of the row before this plane's
    state: I32x2,  # (row, 4): wanted, signs, triangles, vertices
    first: I32x2,  # (row, 2): first vertex and triangle; last the totals
):  # fmt: skip
    """Find each block's crossed cells and edges with vertices. Blocks without vertices keep their `edges`."""
    for r in range(count + 1):
        state[r, 0] = 0
    for n in range(wanted_count):
        state[map_find(table, table_rows, table.shape[0] - 1, wanted[n]), 0] = 1
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                state[r, 1] = find_signs(r, values, seen, inside)
                find_around(r, count, keys, table, table_rows, around)
    for r in range(count, count + 1):  # the row for absent blocks
        clear_planes(seen, r)
        clear_planes(inside, r)
        clear_planes(active, r)
        for k in range(4):
            state[r, k] = 0
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                state[r, 2] = 0
                if state[r, 0] == 1 and signs_around(state, around, r) == 3:
                    state[r, 2] = find_active(
                        r, around, seen, inside, active, triangle_count, values, behind, clear
                    )  # fmt: skip
                else:
                    clear_planes(active, r)
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                state[r, 3] = 0
                if triangles_around(state, around, r) > 0:
                    state[r, 3] = find_edges(r, around, inside, active, edges, starts)
    vertices = 0
    triangles = 0
    ti.loop_config(serialize=True)
    for r in range(count + 1):
        first[r, 0] = vertices
        first[r, 1] = triangles
        vertices += state[r, 3]
        triangles += state[r, 2]


@ti.func
def distance_as_float(packed):
    """Return the float32 nearest to a voxel's Σ w·m (37 bits). AVX2 only converts vectors of int32."""
    high = ti.cast(ti.cast(packed >> (WEIGHT_BITS + 16), ti.i32), ti.f32)
    low = ti.cast(ti.cast(packed >> WEIGHT_BITS, ti.i32) & 65535, ti.f32)
    return high * 65536.0 + low


@ti.func
def cautious(value, slot, o, color_rgn: ti.template(), hits: ti.template(), layers):
    """Return the signed distance of a voxel, in voxels, for a reader that must avoid obstacles.

    In a voxel of a thin object, the mean of rays that end and of rays that pass by is that of free space. So
    a voxel in which `SEVERAL` rays have ended is at the surface. `layers`: 1 = the map counts votes for
    colours, 2 = hits.
    """
    ended = 0
    if layers & 1 != 0:
        ended += ti.cast(color_rgn[slot, o] & 65535, ti.i32)
    if layers & 2 != 0:
        ended += hits[slot, o]
    near = ti.select(value > 1.0, 0.0, ti.min(value, 0.5))
    return ti.select((ended >= SEVERAL) & (value > 0.5), near, value)


@ti.func
def is_clear(
    key, slot, shows_surface: ti.template(), keys: ti.template(), slots: ti.template(), counts: ti.template()
):
    """Return 1 if a block is wholly free: a keyframe looks through it, and its voxels show no surface."""
    found = 0
    if slot < 0 or shows_surface[slot] == 0:
        own = map_find(keys, slots, keys.shape[0] - 1, key)
        if own >= 0:
            found = ti.cast(counts[own] > 0, ti.i32)
    return found


@QuickLaunch
@ti.kernel
def find_surfaces(slots: I32, sums: I64x2, color_rgn: I64x2, hits: I32x2, layers: ti.i32, shows_surface: U8):
    """Mark blocks in which a ray has ended, or a voxel is at or behind a surface."""
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            count = slots.shape[0]
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                slot, found = slots[r], 0
                for o in range(CUBE):
                    packed = sums[slot, o]
                    near = (packed >> WEIGHT_BITS) <= ti.cast(lane_weight(packed), ti.i64) * QUANTA_PER_VOXEL
                    found |= ti.cast((lane_weight(packed) > 0) & near, ti.i32)
                if layers & 1 != 0:
                    for o in range(CUBE):
                        found |= ti.cast((color_rgn[slot, o] & 65535) > 0, ti.i32)
                if layers & 2 != 0:
                    for o in range(CUBE):
                        found |= ti.cast(hits[slot, o] > 0, ti.i32)
                shows_surface[slot] = ti.cast(found, ti.u8)


@ti.kernel
def hold_hits(slots: I32, color_rgn: I64x2, hits: I32x2, layers: ti.i32, values: F32x2):
    """Replace row r of `values`, in voxels, by its block's `cautious` distances (to avoid obstacles)."""
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            count = slots.shape[0]
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                for o in range(CUBE):
                    values[r, o] = cautious(values[r, o], slots[r], o, color_rgn, hits, layers)


@QuickLaunch
@ti.kernel
def read_values(
    count: ti.i32, keys: I64, map_keys: I64, map_slots: I32, sums: I64x2, correction: F32x2,
    corrected: ti.i32, min_weight: ti.i32, values: F32x2,
):  # fmt: skip
    """Write row r of `values`: distances in block `keys[r]`, quanta, smoothed or raw; NaN: too low weight."""
    mask = map_keys.shape[0] - 1
    for run in range(runs(STRIPS)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, STRIPS)
        if strip < STRIPS:
            for r in range(count * strip // STRIPS, count * (strip + 1) // STRIPS):
                slot = map_find(map_keys, map_slots, mask, keys[r])
                for start in range(CUBE // STRIDE):
                    row = ti.Vector([ti.math.nan] * STRIDE)
                    if slot >= 0 and corrected == 1:
                        for i in range(STRIDE):
                            packed = sums[slot, STRIDE * start + i]
                            w = lane_weight(packed)
                            moved = distance_as_float(packed) + correction[slot, STRIDE * start + i]
                            value = moved / ti.cast(w, ti.f32)
                            row[i] = ti.select(w >= min_weight, value, ti.math.nan)
                    elif slot >= 0:
                        for i in range(STRIDE):
                            packed = sums[slot, STRIDE * start + i]
                            w = lane_weight(packed)
                            value = distance_as_float(packed) / ti.cast(w, ti.f32)
                            row[i] = ti.select(w >= min_weight, value, ti.math.nan)
                    for i in ti.static(range(STRIDE)):
                        values[r, STRIDE * start + i] = row[i]
