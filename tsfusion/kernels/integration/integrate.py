# SPDX-License-Identifier: MIT
"""Add rays to the map's integer sums.

A voxel's sum is one int64, (Σ w·m) · 2²⁷ + Σ w: m is the signed distance along the ray in sixtieths of a
voxel (quanta), w the weight. |m| ≤ 1023, which is beyond the widest possible band. Voxels before the band,
where the sensor looks through, get half the weight, and at most the support for m.

Colour is (Σ R) · 2⁴⁰ + (Σ G) · 2¹⁶ + n in an int64 and Σ B in an int32, one vote per ray, in the voxel where
it ends. Maps that count hits count a ray without a colour in this voxel instead, in an int32.

Addition modulo 2⁶⁴ is a group: any order gives the same bytes, and subtraction restores them.
"""

from tsfusion.kernels import I32, I64, I32x2, I64x2, ti
from tsfusion.kernels.base.block_hash import map_find, set_insert
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.voxel_traversal import (
    ADDED,
    COUNT,
    DEFERRED,
    NEVER,
    SHARED,
    START,
    UNIT,
    UPDATES,
    WEIGHT_COLOR,
    pack,
    parts_of,
    ray_weight,
    voxel_of,
)
from tsfusion.kernels.integration.rays_abreast import (
    ABREAST,
    BAND,
    BLOCK_AT,
    COLORED,
    DISTANCE_AT,
    FREE,
    LIST,
    MET,
    NOBODY,
    ODD,
    RAY,
    RAY_LENGTH,
    STRETCH,
    UNCOLORED,
    UNKNOWN,
    VOXELS,
    WALKS,
    WINDOW_AT,
    WINDOW_BITS,
    WINDOW_BLOCKS,
    WINDOW_SCRATCH,
    WINDOWS,
    begin,
    measure,
    open_window,
    walk,
    window_of,
)

WEIGHT_BITS = 27
WEIGHT_MASK = (1 << WEIGHT_BITS) - 1
WEIGHT_LIMIT = 1 << 26  # half of the lane's range: an overflow, also below zero, shows before it can carry
QUANTA_PER_VOXEL = 60
MAX_DISTANCE = 1023  # quanta: the widest half-width, 16 voxels, and one to spare
FREE_SHIFT = 1  # shift that halves the weight of a vote for free space before the band
COLOR_LIMIT = 1 << 15  # votes after which a voxel's colour is full and does not change
CUBE = 512

# `touched`: number of blocks, flag for too many missing blocks, flag for a removed colour that the map
# lacked, number of missing blocks, and then the slots of the touched blocks
TOUCHED_COUNT, TOUCHED_OVERFLOW, TOUCHED_MISMATCH, TOUCHED_MISSING, TOUCHED_HEADER = 0, 1, 2, 3, 4

# Rays of a strip to add: all of them; those that cross blocks which were missing; or those that were added
# before too many missing blocks were found (to subtract them again).
ALL, ONLY_DEFERRED, ONLY_ADDED = 0, 1, 2
LATER, OTHERS = 0, 1  # lists of rays in `again`: for missing blocks, for blocks of other units

# Reasons why nothing is added to a block: the map lacks it, another unit adds to it, another call adds to it;
# and `UNKNOWN`. All are negative. Each has its own bit, which is 0 in the index of a block's first voxel.
ABSENT, OF_ANOTHER, LEFT_OUT = (bit - (1 << 31) for bit in (1, 2, 4))
BITS = 15

COLORS_AT = WINDOW_SCRATCH
LISTED_COLORS = 512  # votes, one int64: the voxel's index above the colour
LISTED_UPDATES = 2 * STRETCH  # in an array of the function; one of 512 numbers takes 0.2 s to compile
UNIT_SCRATCH = COLORS_AT + LISTED_COLORS  # int64 of a unit: its windows, votes for colours

# A launch, `job`: which rays, of which strips, on how many units, sign, first slot, how many blocks may be
# missing, number of the keyframe, vote of a ray in the voxel of its end (`NO_VOTE` …)
WHICH, FIRST_STRIP, LAST_STRIP, UNITS, SIGN, OLDEST, MOST_MISSING, VERSION, VOTE = range(9)
NO_VOTE, COLOR_VOTE, HIT_VOTE = 0, 1, 2  # hits are counted in the layer that is passed instead of Σ B


@ti.func
def lane_weight(packed):
    """Return Σ w, the total weight, from a voxel's packed sum."""
    return ti.cast(packed & WEIGHT_MASK, ti.i32)


@ti.func
def lane_distance(packed):
    """Return Σ w·m, the weighted distances, from a voxel's packed sum."""
    return packed >> WEIGHT_BITS


@ti.func
def quantize(distance):
    """Convert a distance in 2⁻¹⁶ voxel to sixtieths of a voxel (quanta)."""
    return ti.min((distance * QUANTA_PER_VOXEL + 32768) >> 16, MAX_DISTANCE)


@ti.func
def free_bounds(half, support):
    """Return the smallest and largest distance, quanta, that a ray writes to voxels in free space before its
    band of this half-width. They are equal if the band is as wide as the support."""
    most = quantize(support)
    return ti.select(half < support, 0, most), most


@ti.func
def claim(
    slot, mark, version, owners: ti.template(), versions: ti.template(), places: ti.template(),
    touched: ti.template(),
):  # fmt: skip
    """Return True if a block belongs to the unit of this `mark`. The first unit of parallel work to reach a
    block owns and lists it. A unit only asks for its own mark, which no other unit writes."""
    is_own = ti.cast(owners[slot] == mark, ti.i32)
    if is_own == 0 and versions[slot] != version:
        if ti.atomic_max(versions[slot], version) != version:
            is_own = 1
            owners[slot] = mark
            place = ti.atomic_add(touched[TOUCHED_COUNT], 1)
            touched[TOUCHED_HEADER + place] = slot
            places[slot] = place
    return is_own


@ti.func
def note_missing(key, missing: ti.template(), most_missing, touched: ti.template()):
    """Add the key of a block that the map lacks to the set `missing`, unless the set has too many."""
    if touched[TOUCHED_OVERFLOW] == 0:
        grown, full = set_insert(missing, missing.shape[0] - 1, key)
        if grown == 1:
            full |= ti.cast(ti.atomic_add(touched[TOUCHED_MISSING], 1) >= most_missing, ti.i32)
        if full == 1:
            touched[TOUCHED_OVERFLOW] = 1


@ti.func
def enter_block(
    key, oldest, mark, version, most_missing, hash_keys: ti.template(), hash_slots: ti.template(),
    missing: ti.template(), owners: ti.template(), versions: ti.template(), places: ti.template(),
    touched: ti.template(), of_others: ti.template(),
):  # fmt: skip
    """Return the index of a block's first voxel in the layers, or the reason (< 0) to add nothing to it."""
    slot = map_find(hash_keys, hash_slots, hash_keys.shape[0] - 1, key)
    first = ABSENT
    if slot < 0:
        if ti.static(not of_others):
            note_missing(key, missing, most_missing, touched)
    elif slot < oldest:
        first = LEFT_OUT
    elif ti.static(of_others):
        first = ti.select(owners[slot] == mark, LEFT_OUT, slot * CUBE)
    elif claim(slot, mark, version, owners, versions, places, touched) == 1:
        first = slot * CUBE
    else:
        first = OF_ANOTHER
    return first


@ti.func
def add(lanes: ti.template(), at, amount, atomically: ti.template()):
    """Add `amount` to entry `at` of a layer, atomically if several units may. Returns the former value."""
    before = lanes[at]
    if ti.static(atomically):
        before = ti.atomic_add(lanes[at], amount)
    else:
        lanes[at] = before + amount
    return before


@ti.func
def vote_color(
    listed, kind, sign_, color_rgn: ti.template(), color_b: ti.template(), touched: ti.template(),
    atomically: ti.template(),
):  # fmt: skip
    """Add a listed vote to a voxel's colour, or a hit to its count. A colour count just below 2¹⁶ has gone
    below zero. A full colour does not change by any addition or removal, because it is no longer a sum. Hits
    may go below zero, because a map of an earlier version did not count its hits."""
    at, packed = ti.cast(listed >> 32, ti.i32), ti.cast(listed, ti.i32)
    votes = COLOR_LIMIT
    if kind == HIT_VOTE:
        add(color_b, at, sign_, atomically)
    else:
        votes = ti.cast(color_rgn[at] & 65535, ti.i32)
    if votes < COLOR_LIMIT or votes >= COLOR_LIMIT + (COLOR_LIMIT >> 1):
        red = ti.cast((packed >> 16) & 255, ti.i64)
        green = ti.cast((packed >> 8) & 255, ti.i64)
        before = add(color_rgn, at, sign_ * ((red << 40) + (green << 16) + 1), atomically)
        add(color_b, at, sign_ * (packed & 255), atomically)
        if sign_ < 0 and (before & 65535) == 0:
            touched[TOUCHED_MISMATCH] = 1


@ti.func
def add_votes(
    scratch: ti.template(), base, colors: ti.template(), kind, sign_, color_rgn: ti.template(),
    color_b: ti.template(), touched: ti.template(), atomically: ti.template(),
):  # fmt: skip
    """Add the colour votes listed in a unit's scratch, up to `colors`, to the map, and empty the list."""
    for i in range(base + COLORS_AT, colors):
        vote_color(scratch[i], kind, sign_, color_rgn, color_b, touched, atomically)
    colors = base + COLORS_AT


@ti.func
def list_updates(
    walks: ti.template(), k, listed: ti.template(), weight_color, support, sign_, scratch: ti.template(),
    base, colors: ti.template(), voxels: ti.template(), amounts: ti.template(), count: ti.template(), oldest,
    mark, version, most_missing, hash_keys: ti.template(), hash_slots: ti.template(), missing: ti.template(),
    owners: ti.template(), versions: ti.template(), places: ti.template(),
    touched: ti.template(), of_others: ti.template(),
):  # fmt: skip
    """List the next voxels of the ray in lane `k`, with the amount to add to each, after `count` others.

    The ray's vote for a colour is listed, too. Returns the reason bits of its blocks (`ABSENT` …).
    """
    weight = (weight_color >> 24) & 255
    vote, free_vote = sign_ * weight, sign_ * ti.max(weight >> FREE_SHIFT, 1)
    half = walks[RAY_LENGTH + k] - ((walks[RAY_LENGTH + k] + walks[BAND + k]) >> 1)
    least, most = free_bounds(half, support)
    before, uncolored = walks[FREE + k], walks[UNCOLORED + k]
    number = walks[ODD + k]
    window = window_of(walks, k, number)
    blocks = open_window(window, scratch, base)
    met = 0
    n = ti.min(walks[VOXELS + k], STRETCH)
    i = 0
    while i < n:
        place = listed[i * ABREAST + k]
        if ((place >> WINDOW_AT) & 7) != number:
            number = (place >> WINDOW_AT) & 7
            window = window_of(walks, k, number)
            blocks = open_window(window, scratch, base)
        b = (place >> BLOCK_AT) & (WINDOW_BLOCKS - 1)
        first = ti.cast(scratch[blocks + b], ti.i32)
        if first < 0:
            if first == UNKNOWN:
                block = (window << (WINDOW_BITS - 3)) + voxel_of(b)
                first = enter_block(
                    pack(block[0], block[1], block[2]), oldest, mark, version, most_missing, hash_keys,
                    hash_slots, missing, owners, versions, places, touched, of_others,
                )  # fmt: skip
                scratch[blocks + b] = first
            met |= ti.select(first < 0, first, 0)
        if first >= 0:
            at = first + (place & (CUBE - 1))
            m, w = place >> DISTANCE_AT, vote
            if i < before:
                m, w = ti.min(ti.max(m, least), most), free_vote
            # Both sums in one addition; their quotient minimises Σ w (x − m)²: paper eq. 2
            voxels[count], amounts[count] = at, (ti.cast(m * w, ti.i64) << WEIGHT_BITS) + w
            count += 1
            if i == uncolored:
                scratch[colors] = (ti.cast(at, ti.i64) << 32) | (weight_color & 0xFFFFFF)
                colors += 1
        i += 1
    return met


@ti.func
def add_updates(
    voxels: ti.template(), amounts: ti.template(), count: ti.template(), sums: ti.template(),
    atomically: ti.template(),
):  # fmt: skip
    """Add the listed amounts to the voxels' sums, and empty the list.

    In such a short loop a processor waits for dozens of voxels' memory at once, not for ten. This takes a
    third of the time for a LiDAR's rays, whose voxels are in no cache.
    """
    for i in range(count):
        add(sums, voxels[i], amounts[i], atomically)
    count = 0


@ti.func
def add_bands(
    unit, rays: ti.template(), strips: ti.template(), again: ti.template(), job: ti.template(),
    hash_keys: ti.template(), hash_slots: ti.template(), missing: ti.template(), scratch: ti.template(),
    owners: ti.template(), versions: ti.template(), places: ti.template(),
    touched: ti.template(), sums: ti.template(), color_rgn: ti.template(), color_b: ti.template(),
    of_others: ti.template(),
):  # fmt: skip
    """Add the rays of one unit of parallel work. A block belongs to the unit that reaches it first. With
    `of_others`, add instead an equal share of all rays that cross other units' blocks."""
    which, version = job[WHICH], job[VERSION]
    sign_, oldest, most_missing, kind = job[SIGN], job[OLDEST], job[MOST_MISSING], job[VOTE]
    has_color = ti.min(kind, COLOR_VOTE)
    base, owner = unit * UNIT_SCRATCH, -1
    mark = (ti.cast(version, ti.i64) << 32) | unit
    walks, listed = ti.Vector([0] * WALKS), ti.Vector([0] * LIST)
    voxels, amounts = ti.Vector([0] * LISTED_UPDATES), ti.Vector([0] * LISTED_UPDATES, dt=ti.i64)
    for k in range(ABREAST):
        walks[RAY + k], walks[FREE + k], walks[UNCOLORED + k] = NOBODY, 0, NEVER
    colors, updates, carves = base + COLORS_AT, 0, 0
    for strip in range(job[FIRST_STRIP], job[LAST_STRIP]):
        if ti.static(of_others) or strips[strip, UNIT] == unit:
            start, count, added = strips[strip, START], strips[strip, COUNT], 0
            n = 0
            if which == ONLY_DEFERRED:
                count, added = strips[strip, DEFERRED], strips[strip, UPDATES]
            if which == ONLY_ADDED:
                count = strips[strip, ADDED]
            if ti.static(of_others):
                n = unit * strips[strip, SHARED] // job[UNITS]
                count, added = (unit + 1) * strips[strip, SHARED] // job[UNITS], 0
            if strips[strip, UNIT] != owner:
                owner = strips[strip, UNIT]
                mark = (ti.cast(version, ti.i64) << 32) | owner
                for i in range(WINDOWS):
                    scratch[base + i] = 0
            deferred, shared, walking = 0, 0, 0
            while n < count or walking > 0:
                for k in range(ABREAST):
                    while walks[RAY + k] == NOBODY and n < count:
                        r = start + n
                        n += 1
                        if ti.static(of_others):
                            r = again[OTHERS, r]
                        elif which == ONLY_DEFERRED:
                            r = again[LATER, r]
                        if ray_weight(rays, r) > 0:
                            begin(rays, r, QUANTA_PER_VOXEL, has_color, walks, k)
                            walking += 1
                            carves |= ti.cast(walks[BAND + k] > 0, ti.i32)
                longest = measure(walks, carves, has_color)
                walk(walks, ti.min(longest, STRETCH), listed, listed, False)
                if colors > base + UNIT_SCRATCH - ABREAST:
                    add_votes(scratch, base, colors, kind, sign_, color_rgn, color_b, touched, of_others)
                for k in range(ABREAST):
                    r = walks[RAY + k]
                    if r != NOBODY:
                        added -= updates
                        walks[MET + k] |= list_updates(
                            walks, k, listed, rays[r, WEIGHT_COLOR], parts_of(rays, r)[2], sign_,
                            scratch, base, colors, voxels, amounts, updates, oldest, mark, version,
                            most_missing, hash_keys, hash_slots, missing, owners, versions, places,
                            touched, of_others,
                        )  # fmt: skip
                        added += updates
                        if updates > LISTED_UPDATES - STRETCH:
                            add_updates(voxels, amounts, updates, sums, of_others)
                        if walks[UNCOLORED + k] < STRETCH:
                            walks[COLORED + k] = NEVER
                        if walks[VOXELS + k] <= STRETCH:
                            walks[RAY + k] = NOBODY
                            walking -= 1
                            if ti.static(not of_others):
                                if (walks[MET + k] & BITS & OF_ANOTHER) != 0:
                                    again[OTHERS, start + shared] = r
                                    shared += 1
                                if (walks[MET + k] & BITS & ABSENT) != 0:
                                    again[LATER, start + deferred] = r
                                    deferred += 1
                                    if which == ALL and touched[TOUCHED_OVERFLOW] == 1:
                                        count = n
            if ti.static(of_others):
                ti.atomic_add(strips[strip, UPDATES], added)
            else:
                strips[strip, UPDATES], strips[strip, SHARED] = added, shared
                if which == ALL:
                    strips[strip, DEFERRED], strips[strip, ADDED] = deferred, n
    add_updates(voxels, amounts, updates, sums, of_others)
    add_votes(scratch, base, colors, kind, sign_, color_rgn, color_b, touched, of_others)


@QuickLaunch
@ti.kernel
def add_rays(
    rays: I32x2, strips: I32x2, again: I32x2, job: I32, hash_keys: I64, hash_slots: I32, missing: I64,
    scratch: I64, owners: I64, versions: I32, places: I32, touched: I32, sums: I64, color_rgn: I64,
    color_b: I32,
):  # fmt: skip
    """Add each ray to the sums of every voxel that it crosses in its band, in blocks of slot ≥ `OLDEST`.

    Rays that cross missing blocks are listed in `again`, the keys in `missing`. After these blocks are
    inserted, a second call with `ONLY_DEFERRED` and `OLDEST` = the first new slot adds the rest. With more
    than `MOST_MISSING` missing blocks every unit ends after its current ray: `ONLY_ADDED` are those rays.

    Units run in parallel, each through its own strips of rays. A block belongs to the unit reaching it first.
    Only this unit adds to it, without atomics. Rays that cross blocks of other units are listed, too, for
    `add_shared_rays`. The layers are arrays of one dimension, with index slot · 512 + voxel number.
    """
    for run in range(runs(job[UNITS])):  # run loop: kernels/base/quick_launch.py
        unit = unit_of(run, job[UNITS])
        if unit < job[UNITS]:
            add_bands(
                unit, rays, strips, again, job, hash_keys, hash_slots, missing, scratch, owners, versions,
                places, touched, sums, color_rgn, color_b, False,
            )  # fmt: skip


@QuickLaunch
@ti.kernel
def add_shared_rays(
    rays: I32x2, strips: I32x2, again: I32x2, job: I32, hash_keys: I64, hash_slots: I32, missing: I64,
    scratch: I64, owners: I64, versions: I32, places: I32, touched: I32, sums: I64, color_rgn: I64,
    color_b: I32,
):  # fmt: skip
    """Add rays, with atomics, to the blocks of other units that they cross. Call it after `add_rays`, with
    the same arguments. As a separate kernel, it is not compiled for a single thread, which never needs it."""
    for run in range(runs(job[UNITS])):  # run loop: kernels/base/quick_launch.py
        unit = unit_of(run, job[UNITS])
        if unit < job[UNITS]:
            add_bands(
                unit, rays, strips, again, job, hash_keys, hash_slots, missing, scratch, owners, versions,
                places, touched, sums, color_rgn, color_b, True,
            )  # fmt: skip


@QuickLaunch
@ti.kernel
def largest_weights(sums: I64x2, touched: I32, bounds: I32):
    """Write the largest weight of any voxel in each touched block to `bounds[slot]`."""
    count = touched[TOUCHED_COUNT]
    for run in range(runs(count)):  # run loop: kernels/base/quick_launch.py
        n = unit_of(run, count)
        if n < count:
            slot = touched[TOUCHED_HEADER + n]
            most = 0
            for v in range(CUBE):
                most = ti.max(most, lane_weight(sums[slot, v]))
            bounds[slot] = most
