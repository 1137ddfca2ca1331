# SPDX-License-Identifier: MIT
"""Additive integration on a device of many threads: a thread a ray, additions by atomics.

Every voxel gets what `integrate.add_rays` gives it: the additions are the same integers, and their order
shows nowhere. Arrays are a device's (`ti.ndarray`); those of the map have a row of 512 voxels a slot.
"""

import taichi as ti

from tsfusion.kernels.block_hash import map_find
from tsfusion.kernels.integrate import (
    ALL,
    COLOR_LIMIT,
    CUBE,
    FREE_SHIFT,
    MAX_DISTANCE,
    ONLY_DEFERRED,
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    TOUCHED_MISMATCH,
    TOUCHED_MISSING,
    TOUCHED_OVERFLOW,
    WEIGHT_BITS,
    quantize,
)
from tsfusion.kernels.quick_launch import QuickLaunch
from tsfusion.kernels.voxel_traversal import (
    COST,
    COUNT,
    CROSSING,
    DEFERRED,
    END,
    INTERVAL,
    SAMPLES,
    START,
    UPDATES,
    WEIGHT,
    WEIGHT_COLOR,
    advance,
    begin_walk,
    hash_key,
    next_step,
    offset_in_block,
    pack,
    ray_length,
    ray_weight,
    vec3i,
)

# A listed update: place of the voxel in the layers, w·m and w; of a missing block: its coordinates. A vote
# for a colour: place and 0xRRGGBB.
LISTED_FIELDS, VOTE_FIELDS = 4, 2
PLACE, PRODUCT, VOTE, LAST = 0, 1, 2, 3
BLOCK, COLOR = 1, 1
COUNTS = 2  # of a keyframe's launches: nearly always there are two
WINNERS = 1 << 16
MISSING, SKIPPED = -1, -2  # instead of a place: what is listed is a missing block, or nothing


@ti.func
def band_of(bands: ti.template(), r):
    """The last band that begins at place `r` or before it; those without places begin where the next does."""
    low, high = 0, bands.shape[0]
    while high - low > 1:
        middle = (low + high) >> 1
        if bands[middle, START] <= r:
            low = middle
        else:
            high = middle
    return low


@ti.func
def list_block(slot, stamp, stamps: ti.template(), touched: ti.template()):
    """List a block among those that the keyframe touches, once."""
    if stamps[slot] != stamp:
        if ti.atomic_max(stamps[slot], stamp) != stamp:
            place = ti.atomic_add(touched[TOUCHED_COUNT], 1)
            touched[TOUCHED_HEADER + place] = slot


@ti.func
def missing_key(listed: ti.template(), i):
    """Key of the missing block that is listed at place i."""
    return pack(listed[i, BLOCK], listed[i, BLOCK + 1], listed[i, BLOCK + 2])


@ti.func
def missing_place(listed: ti.template(), i):
    """Where it is in the table of `WINNERS` places."""
    return hash_key(missing_key(listed, i)) & (WINNERS - 1)


@ti.func
def crossed(rays: ti.template(), r):
    """How many voxels ray `r` crosses."""
    n, length = 1, ray_length(rays, r)[0]
    for a in ti.static(range(3)):
        if rays[r, CROSSING + a] < length:
            n += 1 + (length - 1 - rays[r, CROSSING + a]) // rays[r, INTERVAL + a]
    return n


@ti.func
def listed_count(count, listed: ti.template()):
    """How many updates are listed; none where they are more than there is room for."""
    return ti.cast(ti.select(count <= listed.shape[0], count, 0), ti.i32)


@ti.func
def vote_count(has_color, count, listed: ti.template(), rays):
    """How many votes for colours are cast; none where no updates are made."""
    return ti.select(has_color == 1, ti.select(count <= listed.shape[0], rays, 0), 0)


@ti.func
def list_updates(
    rays: ti.template(), r, base, most, sign_, oldest, hash_keys: ti.template(), hash_slots: ti.template(),
    listed: ti.template(),
):  # fmt: skip
    """List the update of every voxel that ray `r` crosses in blocks of slot ≥ `oldest`, and missing blocks,
    from place `base` on, `most` in all; returns the number of updates, whether a block is missing, and the
    place of the voxel that takes the colour, or −1."""
    walk, weight = begin_walk(rays, r), ray_weight(rays, r)
    ends = rays[r, END]
    length, fourfold = ray_length(rays, r)
    end = ends & ~7
    band_begins = end - (length - end)  # before it is free space
    free_weight, free_distance = ti.max(weight >> FREE_SHIFT, 1), quantize(length - end)
    last, slot = vec3i(2147483647), -1
    added, lacks, colored, n = 0, 0, SKIPPED, 0
    is_colored = ti.select(end + 1 == length, 1, 0)  # or is to have none
    while n < most:
        block = walk.voxel >> 3
        is_new = (block[0] != last[0]) | (block[1] != last[1]) | (block[2] != last[2])
        at = SKIPPED
        if is_new:
            last = block
            key = pack(block[0], block[1], block[2])
            slot = map_find(hash_keys, hash_slots, hash_keys.shape[0] - 1, key)
            lacks |= ti.select(slot < 0, 1, 0)
            at = ti.select(slot < 0, MISSING, SKIPPED)
            slot = ti.select(slot < oldest, -1, slot)
        step, leaves = next_step(walk.crossing)
        is_free = leaves < band_begins
        w = ti.select(is_free, ti.select(leaves < fourfold, free_weight << 2, free_weight), weight)
        m = ti.select(is_free, free_distance, ti.max(quantize(walk.distance), -MAX_DISTANCE))
        at = ti.select(slot >= 0, slot * CUBE + offset_in_block(walk.voxel), at)
        listed[base + n, PLACE] = at
        listed[base + n, PRODUCT] = ti.select(at == MISSING, block[0], sign_ * w * m)
        listed[base + n, VOTE] = ti.select(at == MISSING, block[1], sign_ * w)
        listed[base + n, LAST] = block[2]
        added += ti.select(at >= 0, 1, 0)
        takes_color = (is_colored == 0) & (leaves > end)
        colored = ti.select(takes_color, at, colored)
        is_colored = ti.select(takes_color, 1, is_colored)
        advance(walk, step)
        n += 1
    return added, lacks, colored


@ti.func
def begin_keyframe(bands: ti.template(), band, count: ti.template(), touched: ti.template()):
    """Nothing is counted of a band of the next keyframe, and with the first band nothing at all."""
    for field in ti.static((COUNT, SAMPLES, WEIGHT, COST, DEFERRED, UPDATES)):
        bands[band, field] = 0
    if band == 0:
        for i in ti.static(range(COUNTS)):
            count[i] = 0
        for i in ti.static(range(TOUCHED_HEADER)):
            touched[i] = 0


@QuickLaunch
@ti.kernel
def add_rays(
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
    deferred: ti.types.ndarray(dtype=ti.i32, ndim=1),
    first_ray: ti.i32,
    end_ray: ti.i32,
    which: ti.i32,
    sign_: ti.i32,
    oldest: ti.i32,
    stamp: ti.i32,
    has_color: ti.i32,
    hash_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    hash_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    winners: ti.types.ndarray(dtype=ti.i32, ndim=1),
    missing: ti.types.ndarray(dtype=ti.i64, ndim=1),
    stamps: ti.types.ndarray(dtype=ti.i32, ndim=1),
    touched: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.types.ndarray(dtype=ti.i64, ndim=1),
    turn: ti.i32,
    listed: ti.types.ndarray(dtype=ti.i32, ndim=2),
    votes: ti.types.ndarray(dtype=ti.i32, ndim=2),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    color_rgn: ti.types.ndarray(dtype=ti.i64, ndim=2),
    color_b: ti.types.ndarray(dtype=ti.i32, ndim=2),
):
    """Add rays as `integrate.add_rays` does, a thread a ray, those of places `first_ray` … `end_ray` − 1.

    Updates are listed, then added, a thread each: so those of one ray do not wait for each other. Nothing is
    added inside a loop within a thread: after that, Mesa's software device (22.3) forgets which threads run.
    Rays that cross missing blocks are marked in `deferred` instead of listed, and the blocks' keys are in
    `missing`, some of them twice: of those that share a place in `winners`, one is left out for every
    other one that is the same block. No band ends early: what was added is all of its rays. `count[turn]` is
    zero, and then how many updates were to be listed; where they are more than `listed` has room for, none
    is made, and `touched` says so. A settled colour stays, as in `integrate.vote_color`.

    Each loop is two tasks of a device, of which the first finds out where the second ends: fewer are faster.
    """
    for r in range(first_ray, end_ray):
        is_wanted = ti.cast(ray_weight(rays, r) > 0, ti.i32)
        if which == ONLY_DEFERRED:
            is_wanted &= deferred[r]
        votes[r - first_ray, PLACE] = SKIPPED
        if is_wanted == 1:
            most = crossed(rays, r)
            base = ti.atomic_add(count[turn], ti.cast(most, ti.i64))
            if base + most <= listed.shape[0]:
                added, lacks, colored = list_updates(
                    rays, r, ti.cast(base, ti.i32), most, sign_, oldest, hash_keys, hash_slots, listed
                )
                votes[r - first_ray, PLACE] = colored
                votes[r - first_ray, COLOR] = rays[r, WEIGHT_COLOR] & 0xFFFFFF
                band = band_of(bands, r)
                ti.atomic_add(bands[band, UPDATES], added)
                if which == ALL:
                    deferred[r] = lacks
                    ti.atomic_add(bands[band, DEFERRED], lacks)
    for i in range(listed_count(count[turn], listed)):
        at = listed[i, PLACE]
        if at >= 0:
            # both sums in one addition; their quotient minimises Σ w (x − m)²: paper eq. 2
            product = ti.cast(listed[i, PRODUCT], ti.i64)
            ti.atomic_add(sums[at // CUBE, at % CUBE], (product << WEIGHT_BITS) + listed[i, VOTE])
            list_block(at // CUBE, stamp, stamps, touched)
        if at == MISSING and which == ALL:
            winners[missing_place(listed, i)] = i
    # the missing blocks; then the votes for colours; at last what did not fit
    for i in range(
        ti.select(which == ALL, listed_count(count[turn], listed), 0)
        + vote_count(has_color, count[turn], listed, end_ray - first_ray)
        + 1
    ):
        ends = ti.select(which == ALL, listed_count(count[turn], listed), 0)
        k = ti.min(i, ti.max(ends - 1, 0))
        if (i < ends) & (listed[k, PLACE] == MISSING):
            winner = winners[missing_place(listed, k)]
            is_another = ti.cast(missing_key(listed, winner) != missing_key(listed, k), ti.i32)
            if winner == k or is_another == 1:
                missing[ti.atomic_add(touched[TOUCHED_MISSING], 1)] = missing_key(listed, k)
        v = i - ends
        if v == vote_count(has_color, count[turn], listed, end_ray - first_ray):
            touched[TOUCHED_OVERFLOW] = ti.cast(count[turn] > listed.shape[0], ti.i32)
            v = -1
        at, packed = SKIPPED, 0
        if v >= 0:
            at, packed = votes[v, PLACE], votes[v, COLOR]
        if at >= 0:
            slot, o = at // CUBE, at % CUBE
            taken = ti.cast(color_rgn[slot, o] & 65535, ti.i32)
            if taken < COLOR_LIMIT or taken >= COLOR_LIMIT + (COLOR_LIMIT >> 1):
                red, green = ti.cast((packed >> 16) & 255, ti.i64), ti.cast((packed >> 8) & 255, ti.i64)
                before = ti.atomic_add(color_rgn[slot, o], sign_ * ((red << 40) + (green << 16) + 1))
                ti.atomic_add(color_b[slot, o], sign_ * (packed & 255))
                if sign_ < 0 and (before & 65535) == 0:
                    touched[TOUCHED_MISMATCH] = 1


@ti.kernel
def begin_turn(
    touched: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.types.ndarray(dtype=ti.i64, ndim=1),
    turn: ti.i32,
):
    """Let rays be added once more: nothing is listed, and no block missing."""
    for _ in range(1):
        count[turn] = 0
        touched[TOUCHED_MISSING] = 0


@ti.kernel
def restore_counts(
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2), counts: ti.types.ndarray(dtype=ti.i32, ndim=2)
):
    """Let the bands have counted no more updates and deferred rays than `counts`, earlier bands, says."""
    for band in range(bands.shape[0]):
        for field in ti.static((DEFERRED, UPDATES)):
            bands[band, field] = counts[band, field]


@QuickLaunch
@ti.kernel
def write_hash(
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),
    keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    hash_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    hash_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Write keys and slots to places of the hash from block to slot."""
    for i in range(places.shape[0]):
        hash_keys[places[i]] = keys[i]
        hash_slots[places[i]] = slots[i]


@ti.kernel
def read_rows(
    layer: ti.types.ndarray(ndim=2),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    rows: ti.types.ndarray(ndim=2),
):
    """`rows[i]` = row `slots[i]` of a layer."""
    for i in range(slots.shape[0] * CUBE):
        rows[i // CUBE, i % CUBE] = layer[slots[i // CUBE], i % CUBE]


@ti.kernel
def write_rows(
    layer: ti.types.ndarray(ndim=2),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    rows: ti.types.ndarray(ndim=2),
):
    """Row `slots[i]` of a layer = `rows[i]`."""
    for i in range(slots.shape[0] * CUBE):
        layer[slots[i // CUBE], i % CUBE] = rows[i // CUBE, i % CUBE]


@ti.kernel
def move_rows(layer: ti.types.ndarray(ndim=2), count: ti.i32, larger: ti.types.ndarray(ndim=2)):
    """Copy the first `count` rows of a layer into a larger one."""
    for i in range(count * CUBE):
        larger[i // CUBE, i % CUBE] = layer[i // CUBE, i % CUBE]


@ti.kernel
def move_list(listed: ti.types.ndarray(ndim=1), larger: ti.types.ndarray(ndim=1)):
    """Copy a list into a larger one."""
    for i in range(listed.shape[0]):
        larger[i] = listed[i]
