# SPDX-License-Identifier: MIT
"""Additive integer integration: rays → the map's sums.

A voxel's sum is one int64, (Σ w·m) · 2²⁷ + Σ w: m = signed distance along the ray in sixtieths of a voxel,
|m| ≤ 1023, which is beyond the widest band there can be. Voxels before the band, where the sensor looks
through (space carving), get the band's half-width for m.
Colour is (Σ R) · 2⁴⁰ + (Σ G) · 2¹⁶ + n in an int64 and Σ B in an int32, one vote a ray.
Addition modulo 2⁶⁴ is a group: any order gives the same bytes, and subtracting restores them.
"""

import taichi as ti

from tsfusion.kernels.block_hash import map_find, set_insert
from tsfusion.kernels.block_windows import (
    LEFT_WINDOW,
    MOST_IN_WINDOW,
    STEPS,
    UNKNOWN,
    WINDOW_BITS,
    WINDOW_SCRATCH,
    WINDOWS,
    gather_bits,
    open_window,
)
from tsfusion.kernels.voxel_traversal import (
    ADDED,
    COUNT,
    CROSSING,
    DEFERRED,
    DISTANCE,
    END,
    INTERVAL,
    LENGTH,
    LOSS,
    RUN,
    SHARED,
    START,
    UNIT,
    UPDATES,
    VOXEL,
    WEIGHT_COLOR,
    pack,
    ray_vector,
    ray_weight,
    steps,
    vec3i,
    voxel_of,
)

WEIGHT_BITS = 27
WEIGHT_MASK = (1 << WEIGHT_BITS) - 1
WEIGHT_LIMIT = 1 << 26  # half of what the lane holds: going over, or below none, shows before it can carry
QUANTA_PER_VOXEL = 60
MAX_DISTANCE = 1023  # quanta: the widest half-width, 16 voxels, and one to spare
FREE_SHIFT = 1  # a vote for free space before the band is half of one for a surface
COLOR_LIMIT = 1 << 15  # votes after which a voxel's colour is settled and takes no more
CUBE = 512
CHANGED = 255  # a block is dirty for all that follow its changes: a bit each

# `touched`: how many blocks, whether more are missing than may be, whether a colour was taken away that was
# not there, how many blocks are missing, and then the slots of the touched ones
TOUCHED_COUNT, TOUCHED_OVERFLOW, TOUCHED_MISMATCH, TOUCHED_MISSING, TOUCHED_HEADER = 0, 1, 2, 3, 4

# Which rays of a band are added: all of them, those that cross blocks which were missing, or those that were
# added before it showed that too many blocks are missing (to take them away again).
ALL, ONLY_DEFERRED, ONLY_ADDED = 0, 1, 2
LATER, OTHERS = 0, 1  # rays that are added `again`: to blocks that are missing, to blocks of other units

# Why nothing is added to a block: the map lacks it, another unit adds to it, its turn is in another call; or
# it is not known yet. All are negative, and have a bit each among those that are zero in places of blocks.
ABSENT, OF_ANOTHER, LEFT_OUT = (bit - (1 << 31) for bit in (1, 2, 4))
BITS = 15

# A listed update, one int64: the voxel's place in the layers; in the low half, never negative, w·m above nine
# bits of w. What w·m and w, which may be negative, are greater by there:
LEAST_PRODUCT, LEAST_VOTE = 1 << 18, 1 << 8
LISTED = 2048  # updates that wait for each other

COLORS_AT = WINDOW_SCRATCH + LISTED
LISTED_COLORS = 512  # votes, one int64: the voxel's place above the colour
UNIT_SCRATCH = COLORS_AT + LISTED_COLORS  # int64 of a unit: its windows, its updates, its votes for colours

# What a launch does, `job`: which rays of which bands, on how many units, sign, slots from which on, how many
# blocks may be missing, number of the keyframe, whether colours count
WHICH, FIRST_BAND, LAST_BAND, UNITS, SIGN, OLDEST, MOST_MISSING, STAMP, HAS_COLOR = range(9)


@ti.func
def lane_weight(packed):
    """Σ w of a voxel's sum."""
    return ti.cast(packed & WEIGHT_MASK, ti.i32)


@ti.func
def lane_distance(packed):
    """Σ w·m of a voxel's sum."""
    return packed >> WEIGHT_BITS


@ti.func
def quantize(distance):
    """Distance in 2⁻¹⁶ voxel → quanta."""
    return ti.min((distance * QUANTA_PER_VOXEL + 32768) >> 16, MAX_DISTANCE)


@ti.func
def claim(
    slot, mark, stamp, owners: ti.template(), stamps: ti.template(), places: ti.template(),
    dirty: ti.template(), touched: ti.template(),
):  # fmt: skip
    """Whether a block is the unit's whose `mark` this is: the one that comes to it first, and lists it.

    A unit asks for its own mark alone, which nobody else writes.
    """
    is_own = ti.cast(owners[slot] == mark, ti.i32)
    if is_own == 0 and stamps[slot] != stamp:
        if ti.atomic_max(stamps[slot], stamp) != stamp:
            is_own = 1
            owners[slot] = mark
            place = ti.atomic_add(touched[TOUCHED_COUNT], 1)
            touched[TOUCHED_HEADER + place] = slot
            places[slot] = place
            dirty[slot] = ti.u8(CHANGED)
    return is_own


@ti.func
def note_missing(key, missing: ti.template(), most_missing, touched: ti.template()):
    """Put the key of a block that the map does not have into the set, while there are not too many."""
    if touched[TOUCHED_OVERFLOW] == 0:
        grown, full = set_insert(missing, missing.shape[0] - 1, key)
        if grown == 1:
            full |= ti.cast(ti.atomic_add(touched[TOUCHED_MISSING], 1) >= most_missing, ti.i32)
        if full == 1:
            touched[TOUCHED_OVERFLOW] = 1


@ti.func
def enter_block(
    key, oldest, mark, stamp, most_missing, hash_keys: ti.template(), hash_slots: ti.template(),
    missing: ti.template(), owners: ti.template(), stamps: ti.template(), places: ti.template(),
    dirty: ti.template(), touched: ti.template(), of_others: ti.template(),
):  # fmt: skip
    """Place of a block's first voxel in the layers; or why nothing is added to it."""
    slot = map_find(hash_keys, hash_slots, hash_keys.shape[0] - 1, key)
    first = ABSENT
    if slot < 0:
        if ti.static(not of_others):
            note_missing(key, missing, most_missing, touched)
    elif slot < oldest:
        first = LEFT_OUT
    elif ti.static(of_others):
        first = ti.select(owners[slot] == mark, LEFT_OUT, slot * CUBE)
    elif claim(slot, mark, stamp, owners, stamps, places, dirty, touched) == 1:
        first = slot * CUBE
    else:
        first = OF_ANOTHER
    return first


@ti.func
def add(lanes: ti.template(), at, amount, atomically: ti.template()):
    """Add to a lane; returns what it was."""
    before = lanes[at]
    if ti.static(atomically):
        before = ti.atomic_add(lanes[at], amount)
    else:
        lanes[at] = before + amount
    return before


@ti.func
def vote_color(
    listed, sign_, color_rgn: ti.template(), color_b: ti.template(), touched: ti.template(),
    atomically: ti.template(),
):  # fmt: skip
    """Add a listed vote for a colour.

    A count just below 2¹⁶ has gone below none. A settled colour stays, whatever is added or taken away: it is
    no longer a sum.
    """
    at, packed = ti.cast(listed >> 32, ti.i32), ti.cast(listed, ti.i32)
    votes = ti.cast(color_rgn[at] & 65535, ti.i32)
    if votes < COLOR_LIMIT or votes >= COLOR_LIMIT + (COLOR_LIMIT >> 1):
        red = ti.cast((packed >> 16) & 255, ti.i64)
        green = ti.cast((packed >> 8) & 255, ti.i64)
        before = add(color_rgn, at, sign_ * ((red << 40) + (green << 16) + 1), atomically)
        add(color_b, at, sign_ * (packed & 255), atomically)
        if sign_ < 0 and (before & 65535) == 0:
            touched[TOUCHED_MISMATCH] = 1


@ti.func
def packed_step(rays: ti.template(), r, axis: ti.template(), towards):
    """Change of ray `r`'s place with a step along an axis."""
    turn = ti.cast(-rays[r, LOSS + axis] * QUANTA_PER_VOXEL, ti.i64)
    return (turn << 32) + towards * ti.static(STEPS[axis])


@ti.func
def add_listed(
    scratch: ti.template(), base, tail: ti.template(), colors: ti.template(), added: ti.template(), sign_,
    sums: ti.template(), color_rgn: ti.template(), color_b: ti.template(), touched: ti.template(),
    atomically: ti.template(),
):  # fmt: skip
    """Add the listed updates: one after the other without a branch, so that misses of the cache overlap.

    `tail` and `colors`: ends of the lists, which are empty then; `added` counts updates.
    """
    for i in range(base + WINDOW_SCRATCH, tail):
        update = scratch[i]
        lanes = ti.cast(ti.cast(update, ti.i32), ti.i64)
        product, vote = (lanes >> 9) - LEAST_PRODUCT, (lanes & 511) - LEAST_VOTE
        # both sums in one addition; their quotient minimises Σ w (x − m)²: paper eq. 2
        add(sums, ti.cast(update >> 32, ti.i32), (product << WEIGHT_BITS) + vote, atomically)
    for i in range(base + COLORS_AT, colors):
        vote_color(scratch[i], sign_, color_rgn, color_b, touched, atomically)
    added += tail - (base + WINDOW_SCRATCH)
    tail, colors = base + WINDOW_SCRATCH, base + COLORS_AT


@ti.func
def add_ray(
    rays: ti.template(), r, sign_, scratch: ti.template(), base, tail: ti.template(), colors: ti.template(),
    added: ti.template(), last: ti.template(), blocks: ti.template(), oldest, mark, stamp, most_missing,
    hash_keys: ti.template(), hash_slots: ti.template(), missing: ti.template(), owners: ti.template(),
    stamps: ti.template(), places: ti.template(), dirty: ti.template(), touched: ti.template(),
    sums: ti.template(), has_color, color_rgn: ti.template(), color_b: ti.template(),
    of_others: ti.template(),
):  # fmt: skip
    """List a ray's update of every voxel it crosses, and its vote for a colour (`add_listed`).

    `last` and its `blocks`: the window entered last, by any ray. Returns the bits of what it crosses.
    """
    # The loop works on scalars and reads no ray: for all the compiler knows, what it stores is what it reads.
    weight, ends, length = ray_weight(rays, r), rays[r, END], rays[r, LENGTH]
    end = ends & ~7
    band_begins = end - (length - end)  # before it is free space
    voxel, towards = ray_vector(rays, r, VOXEL), steps(ends)
    next_x, next_y, next_z = rays[r, CROSSING], rays[r, CROSSING + 1], rays[r, CROSSING + 2]
    every_x, every_y, every_z = rays[r, INTERVAL], rays[r, INTERVAL + 1], rays[r, INTERVAL + 2]
    step_x, step_y = packed_step(rays, r, 0, towards[0]), packed_step(rays, r, 1, towards[1])
    step_z = packed_step(rays, r, 2, towards[2])
    at = ti.cast(rays[r, DISTANCE] * QUANTA_PER_VOXEL + 32768, ti.i64) << 32
    window = voxel >> WINDOW_BITS
    voxel &= (1 << WINDOW_BITS) - 1
    for a in ti.static(range(3)):
        at += voxel[a] * STEPS[a]
    vote, free_vote = sign_ * weight, sign_ * ti.max(weight >> FREE_SHIFT, 1)
    none = (LEAST_PRODUCT << 9) + LEAST_VOTE
    band, free = none + vote, none + free_vote + (quantize(length - end) * free_vote << 9)
    vote = vote << 9
    crossed = 0
    until = ti.select(
        has_color == 1, end + 1, length
    )  # stop behind the end point: its voxel takes the colour
    inside = ti.cast(weight > 0, ti.i32)
    while inside == 1:
        if tail > base + COLORS_AT - MOST_IN_WINDOW or colors == base + UNIT_SCRATCH:
            add_listed(
                scratch, base, tail, colors, added, sign_, sums, color_rgn, color_b, touched, of_others
            )  # fmt: skip
        if window[0] != last[0] or window[1] != last[1] or window[2] != last[2]:
            last = window
            blocks = open_window(window, scratch, base)
        leaves, first, is_x, is_y, is_z, left, stays = 0, 0, 0, 0, 0, 0, 1
        while stays == 1:
            first = ti.cast(scratch[blocks + gather_bits(ti.cast(at >> 3, ti.i32))], ti.i32)
            if first == UNKNOWN:
                break
            crossed |= first
            # Masks, all bits or none, of the axis that is crossed next, the first of equals. By arithmetic: a
            # comparison may become a branch, and this one is what processors predict worst.
            leaves = ti.min(next_x, next_y, next_z)
            is_x = ((next_x - next_y - 1) & (next_x - next_z - 1)) >> 31
            is_y = ((next_y - next_z - 1) >> 31) & ~is_x
            is_z = ~(is_x | is_y)
            voxel_at = first + gather_bits(ti.cast(at, ti.i32))
            m = ti.min(ti.max(ti.cast(at >> 48, ti.i32), -MAX_DISTANCE), MAX_DISTANCE)
            lanes = ti.select(leaves < band_begins, free, m * vote + band)
            scratch[tail] = (ti.cast(voxel_at, ti.i64) << 32) + lanes
            tail += 1 + (first >> 31)
            next_x += every_x & is_x
            next_y += every_y & is_y
            next_z += every_z & is_z
            at += (step_x & is_x) + (step_y & is_y) + (step_z & is_z)
            left = ti.cast(at, ti.i32) & LEFT_WINDOW
            stays = ti.cast(leaves < until, ti.i32) & ti.cast(left == 0, ti.i32)
        if first == UNKNOWN:
            b = gather_bits(ti.cast(at >> 3, ti.i32))
            block = (window << (WINDOW_BITS - 3)) + voxel_of(b)
            scratch[blocks + b] = enter_block(
                pack(block[0], block[1], block[2]), oldest, mark, stamp, most_missing, hash_keys, hash_slots,
                missing, owners, stamps, places, dirty, touched, of_others,
            )  # fmt: skip
        else:
            inside = ti.cast(leaves < length, ti.i32)
            if has_color == 1 and until != length and leaves >= until:
                until = length
                if first >= 0:
                    scratch[colors] = (scratch[tail - 1] >> 32 << 32) | (rays[r, WEIGHT_COLOR] & 0xFFFFFF)
                    colors += 1
            if left != 0:  # into the window beside it, at the other side
                step = vec3i(towards[0] & is_x, towards[1] & is_y, towards[2] & is_z)
                window += step
                for a in ti.static(range(3)):
                    at -= step[a] * (STEPS[a] << WINDOW_BITS)
    return crossed


@ti.func
def add_bands(
    unit, rays: ti.template(), bands: ti.template(), again: ti.template(), job: ti.template(),
    hash_keys: ti.template(), hash_slots: ti.template(), missing: ti.template(), scratch: ti.template(),
    owners: ti.template(), stamps: ti.template(), places: ti.template(), dirty: ti.template(),
    touched: ti.template(), sums: ti.template(), color_rgn: ti.template(), color_b: ti.template(),
    of_others: ti.template(),
):  # fmt: skip
    """Add the rays of a unit's bands to its own blocks; or those that cross blocks `of_others` to these."""
    which, stamp = job[WHICH], job[STAMP]
    sign_, oldest, most_missing, has_color = job[SIGN], job[OLDEST], job[MOST_MISSING], job[HAS_COLOR]
    mark = (ti.cast(stamp, ti.i64) << 32) | unit
    base = unit * UNIT_SCRATCH
    for i in range(WINDOWS):
        scratch[base + i] = 0
    last, blocks = vec3i(2147483647), 0
    tail, colors, added = base + WINDOW_SCRATCH, base + COLORS_AT, 0
    for band in range(job[FIRST_BAND], job[LAST_BAND]):
        if bands[band, UNIT] == unit:
            start, count, updates = bands[band, START], bands[band, COUNT], 0
            if which == ONLY_DEFERRED:
                count, updates = bands[band, DEFERRED], bands[band, UPDATES]
            if which == ONLY_ADDED:
                count = bands[band, ADDED]
            if ti.static(of_others):
                count, updates = bands[band, SHARED], bands[band, UPDATES]
            updates -= added + tail  # of the bands before
            deferred, shared, n = 0, 0, 0
            while n < count:
                r = start + n
                if ti.static(of_others):
                    r = again[OTHERS, r]
                elif which == ONLY_DEFERRED:
                    r = again[LATER, r]
                crossed = add_ray(
                    rays, r, sign_, scratch, base, tail, colors, added, last, blocks, oldest, mark,
                    stamp, most_missing, hash_keys, hash_slots, missing, owners, stamps, places,
                    dirty, touched, sums, has_color, color_rgn, color_b, of_others,
                )  # fmt: skip
                if ti.static(not of_others):
                    if (crossed & BITS & OF_ANOTHER) != 0:
                        again[OTHERS, start + shared] = r
                        shared += 1
                    if (crossed & BITS & ABSENT) != 0:
                        again[LATER, start + deferred] = r
                        deferred += 1
                        if which == ALL and touched[TOUCHED_OVERFLOW] == 1:
                            count = n
                n += 1
            bands[band, UPDATES] = updates + added + tail
            if ti.static(not of_others):
                bands[band, SHARED] = shared
                if which == ALL:
                    bands[band, DEFERRED], bands[band, ADDED] = deferred, n
    add_listed(scratch, base, tail, colors, added, sign_, sums, color_rgn, color_b, touched, of_others)


@ti.kernel
def add_rays(
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
    again: ti.types.ndarray(dtype=ti.i32, ndim=2),
    job: ti.types.ndarray(dtype=ti.i32, ndim=1),
    hash_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    hash_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    missing: ti.types.ndarray(dtype=ti.i64, ndim=1),
    scratch: ti.types.ndarray(dtype=ti.i64, ndim=1),
    owners: ti.types.ndarray(dtype=ti.i64, ndim=1),
    stamps: ti.types.ndarray(dtype=ti.i32, ndim=1),
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),
    dirty: ti.types.ndarray(dtype=ti.u8, ndim=1),
    touched: ti.types.ndarray(dtype=ti.i32, ndim=1),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=1),
    color_rgn: ti.types.ndarray(dtype=ti.i64, ndim=1),
    color_b: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Add to every voxel that each ray crosses in its band, in blocks of slot ≥ `OLDEST`.

    Rays that cross blocks the map does not have are listed in `again`, the keys in `missing`; when those
    blocks exist, a second call with `ONLY_DEFERRED` and `OLDEST` = the first new slot adds the rest. With
    more than `MOST_MISSING` of them every band ends after the ray that it is at: `ONLY_ADDED` are those.

    Units run at the same time, each through its own bands. A block is of the unit that comes to it first and
    adds to it alone, without atomics. Rays that cross blocks of other units are listed, too, and added to
    these when all units are through, with atomics. The layers are flat: slot · 512 + offset.
    """
    for run in range(job[UNITS] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            add_bands(
                run // RUN, rays, bands, again, job, hash_keys, hash_slots, missing, scratch, owners, stamps,
                places, dirty, touched, sums, color_rgn, color_b, False,
            )  # fmt: skip
    for run in range(job[UNITS] * RUN):
        if run % RUN == 0:
            add_bands(
                run // RUN, rays, bands, again, job, hash_keys, hash_slots, missing, scratch, owners, stamps,
                places, dirty, touched, sums, color_rgn, color_b, True,
            )  # fmt: skip


@ti.kernel
def largest_weights(
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    touched: ti.types.ndarray(dtype=ti.i32, ndim=1),
    bounds: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """`bounds[slot]` = the largest weight lane in each touched block."""
    count = touched[TOUCHED_COUNT]
    for run in range(count * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            slot = touched[TOUCHED_HEADER + run // RUN]
            most = 0
            for v in range(CUBE):
                most = ti.max(most, lane_weight(sums[slot, v]))
            bounds[slot] = most
