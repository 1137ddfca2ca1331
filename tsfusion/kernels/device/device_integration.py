# SPDX-License-Identifier: MIT
"""Additive integration on a device of many threads: a thread a ray, additions by atomics.

Every voxel gets the same sum as from `integrate.add_rays`: the additions are the same integers, and their
order has no effect. Arrays are a device's (`ti.ndarray`); those of the map have a row of 512 voxels a slot.

Counters are split over many places first: a device makes one addition to a place after the other.
"""

import taichi as ti

from tsfusion.kernels import I32, I64, I32x2, I64x2
from tsfusion.kernels.base.block_hash import map_find
from tsfusion.kernels.base.quick_launch import QuickLaunch
from tsfusion.kernels.base.voxel_traversal import (
    CROSSING,
    INTERVAL,
    UPDATES,
    WEIGHT_COLOR,
    advance,
    begin_walk,
    hash_key,
    next_step,
    offset_in_block,
    pack,
    parts_of,
    ray_weight,
    vec3i,
)
from tsfusion.kernels.device.device_told import (
    APART,
    ARE_SAME,
    BANDS,
    CLAIMS,
    FEW_NEW,
    FRESH_AT,
    LACKING,
    NEW,
    TOUCHED_AT,
    band_field,
    fresh_key,
    joined,
    rank_of,
)
from tsfusion.kernels.integration.integrate import (
    COLOR_LIMIT,
    COLOR_VOTE,
    CUBE,
    FREE_SHIFT,
    HIT_VOTE,
    MAX_DISTANCE,
    TOUCHED_COUNT,
    TOUCHED_MISMATCH,
    TOUCHED_MISSING,
    TOUCHED_OVERFLOW,
    WEIGHT_BITS,
    free_bounds,
    quantize,
)
from tsfusion.kernels.integration.rays_from_images import TILE_SAMPLES

# A listed update: place of the voxel in the layers, w·m << WEIGHT_FIELD | w, and the key of a missing block,
# whose place is −1 − the number of the voxel in it.
LISTED_FIELDS = 4
PLACE, AMOUNT, KEY = 0, 1, 2
WEIGHT_FIELD = 8  # bits
SKIPPED = -1 - CUBE  # instead of a place

# Groups of rays, by their places: voxels that they cross, and the start of their updates in the list.
GROUP, GROUP_FIELDS = TILE_SAMPLES, 2
CROSSED, BASE = 0, 1
LISTED, COSTS = 0, 1  # in `totals`: updates that are listed, and what the rays cost

WINNERS = 1 << 16  # places of a table, of which there are two
HASH_PLACE, RANK = 0, 1  # of a missing block, if there are few

# Limits of a keyframe: new blocks, touched ones, what rays and new blocks cost; and what one of these does
ROOM_NEW, ROOM_TOUCHED, ROOM_COST, BLOCK_COST = 0, 1, 2, 3


@ti.func
def begin_groups(i, groups: ti.template(), totals: ti.template()):
    """Clear a launch's counters in the i-th thread, if there are as many groups."""
    if i == 0:
        totals[LISTED], totals[COSTS] = 0, 0
    if i < groups.shape[0]:
        groups[i, CROSSED] = 0


@ti.func
def begin_list(g, groups: ti.template(), totals: ti.template(), listed: ti.template()):
    """Give a group its part of the list."""
    base = ti.atomic_add(totals[LISTED], ti.cast(groups[g, CROSSED], ti.i64))
    groups[g, BASE] = ti.cast(ti.min(base, ti.i64(listed.shape[0])), ti.i32)


@ti.func
def list_block(slot, stamp, stamps: ti.template(), told: ti.template()):
    """List a block among those that the keyframe touches, once."""
    if stamps[slot] != stamp:
        if ti.atomic_max(stamps[slot], stamp) != stamp:
            place = ti.atomic_add(told[TOUCHED_COUNT], 1)
            told[TOUCHED_AT + place] = slot


@ti.func
def missing_key(listed: ti.template(), i):
    """Key of the missing block that is listed at place i."""
    return joined(listed[i, KEY], listed[i, KEY + 1])


@ti.func
def winner_place(key, table: ti.template()):
    """Place of a block in one of the two tables of `WINNERS` places."""
    return table * WINNERS + ((hash_key(key) >> (15 * table)) & (WINNERS - 1))


@ti.func
def is_winner(i, listed: ti.template(), winners: ti.template()):
    """True if the missing block at place i is to be listed from here: nearly always one place only."""
    key = missing_key(listed, i)
    first, second = winners[winner_place(key, 0)], winners[winner_place(key, 1)]
    found = 1
    if missing_key(listed, first) == key:
        found = ti.cast(first == i, ti.i32)
    elif missing_key(listed, second) == key:
        found = ti.cast(second == i, ti.i32)
    return found


@ti.func
def shares_place(k, places: ti.template(), claims: ti.template()):
    """True if the k-th missing block may share its place in the hash with another one."""
    return ti.cast(claims[places[k, HASH_PLACE] & (CLAIMS - 1)] > 1, ti.i32)


@ti.func
def crossed(rays: ti.template(), r):
    """Number of voxels that ray `r` crosses."""
    n, length = 1, parts_of(rays, r)[0]
    for a in ti.static(range(3)):
        if rays[r, CROSSING + a] < length:
            n += 1 + (length - 1 - rays[r, CROSSING + a]) // rays[r, INTERVAL + a]
    return n


@ti.func
def list_updates(
    rays: ti.template(), r, base, most, oldest, hash_keys: ti.template(), hash_slots: ti.template(),
    listed: ti.template(),
):  # fmt: skip
    """List the update of every voxel that ray `r` crosses in blocks of slot ≥ `oldest` and in missing blocks,
    from place `base` on, `most` in all. Returns the numbers of updates and of those in missing blocks, and
    the place of the update whose voxel takes the colour, or −1."""
    walk, weight = begin_walk(rays, r), ray_weight(rays, r)
    length, end, support = parts_of(rays, r)
    half = length - end
    least, most_free = free_bounds(half, support)
    last, slot, key = vec3i(2147483647), -1, ti.i64(0)
    added, lacking, colored, n = 0, 0, -1, 0
    is_colored = ti.select(end + 1 == length, 1, 0)  # or is to have none
    while n < most:
        block = walk.voxel >> 3
        if (block[0] != last[0]) | (block[1] != last[1]) | (block[2] != last[2]):
            last = block
            key = pack(block[0], block[1], block[2])
            slot = map_find(hash_keys, hash_slots, hash_keys.shape[0] - 1, key)
        step, leaves = next_step(walk.crossing)
        m, w = ti.max(quantize(walk.distance), -MAX_DISTANCE), weight
        if leaves < end - half:  # before the band
            m, w = ti.min(ti.max(m, least), most_free), ti.max(weight >> FREE_SHIFT, 1)
        offset = offset_in_block(walk.voxel)
        at = ti.select(slot >= oldest, slot * CUBE + offset, SKIPPED)
        at = ti.select(slot < 0, -1 - offset, at)
        listed[base + n, PLACE] = at
        listed[base + n, AMOUNT] = ((w * m) << WEIGHT_FIELD) | w
        if slot < 0:
            listed[base + n, KEY] = ti.cast(key, ti.i32)
            listed[base + n, KEY + 1] = ti.cast(key >> 32, ti.i32)
        added += ti.cast(at >= 0, ti.i32)
        lacking += ti.cast(slot < 0, ti.i32)
        takes_color = (is_colored == 0) & (leaves > end)
        colored = ti.select(takes_color, base + n, colored)
        is_colored = ti.select(takes_color, 1, is_colored)
        advance(walk, step)
        n += 1
    return added, lacking, colored


@ti.func
def add_update(listed: ti.template(), i, at, sign_, sums: ti.template()):
    """Make the update that is listed at place i, of the voxel at place `at` of the layers."""
    # Both sums in one addition; their quotient minimises Σ w (x − m)²: paper eq. 2
    packed = listed[i, AMOUNT]
    product, w = ti.cast(packed >> WEIGHT_FIELD, ti.i64), packed & ((1 << WEIGHT_FIELD) - 1)
    ti.atomic_add(sums[at // CUBE, at % CUBE], sign_ * ((product << WEIGHT_BITS) + w))


@ti.func
def vote_color(
    at, packed, kind, sign_, told: ti.template(), color_rgn: ti.template(), color_b: ti.template()
):
    """Add a vote 0xRRGGBB for a voxel's colour, or a hit. A full colour stays, as in
    `integrate.vote_color`."""
    slot, o = at // CUBE, at % CUBE
    taken = COLOR_LIMIT
    if kind == HIT_VOTE:
        ti.atomic_add(color_b[slot, o], sign_)
    else:
        taken = ti.cast(color_rgn[slot, o] & 65535, ti.i32)
    if taken < COLOR_LIMIT or taken >= COLOR_LIMIT + (COLOR_LIMIT >> 1):
        red, green = ti.cast((packed >> 16) & 255, ti.i64), ti.cast((packed >> 8) & 255, ti.i64)
        before = ti.atomic_add(color_rgn[slot, o], sign_ * ((red << 40) + (green << 16) + 1))
        ti.atomic_add(color_b[slot, o], sign_ * (packed & 255))
        if sign_ < 0 and (before & 65535) == 0:
            told[TOUCHED_MISMATCH] = 1


@ti.func
def listed_end(count, totals: ti.template(), listed: ti.template()):
    """Number of listed updates of `count` rays; 0 if there are more than the room for them."""
    is_listed = (count > 0) & (totals[LISTED] <= listed.shape[0])
    return ti.cast(ti.select(is_listed, totals[LISTED], 0), ti.i32)


@ti.func
def whole_groups(count):
    """Places for so many rays in whole groups."""
    return (count + GROUP - 1) // GROUP * GROUP


@ti.func
def place_of(j):
    """Place of the ray that the j-th thread looks at. Of a cell of four pixels only the first place has a
    ray: neighbouring threads look at every fourth place, where all of them have a ray, or none."""
    return j // GROUP * GROUP + j % GROUP % (GROUP // 4) * 4 + j % GROUP // (GROUP // 4)


@ti.func
def list_rays(
    rays: ti.template(), first_ray, count, places_end, oldest, groups: ti.template(), totals: ti.template(),
    listed: ti.template(), marks: ti.template(), hash_keys: ti.template(), hash_slots: ti.template(),
    told: ti.template(),
):  # fmt: skip
    """List the updates of `count` rays, which are in `places_end` places of whole groups. `marks`: for each
    ray, the start of its updates in its group's part of the list, then the place of the update that takes its
    colour. Each loop is a task of a device, in this function and the next ones; so is the first of each end.
    """
    for j in range(places_end):
        i = place_of(j)
        r = first_ray + ti.min(i, count - 1)
        if totals[LISTED] > listed.shape[0]:
            told[TOUCHED_OVERFLOW] = 1
        elif i < count and ray_weight(rays, r) > 0:
            made, lacked, colored = list_updates(
                rays, r, groups[i // GROUP, BASE] + marks[i], crossed(rays, r), oldest, hash_keys, hash_slots,
                listed,
            )  # fmt: skip
            marks[i] = colored
            if made > 0:
                ti.atomic_add(told[band_field(i % BANDS, UPDATES)], made)
            if lacked > 0:
                ti.atomic_add(told[band_field(i % BANDS, LACKING)], lacked)
        elif i < count:
            marks[i] = -1


@ti.func
def add_listed(
    end, sign_, stamp, listed: ti.template(), winners: ti.template(), missing: ti.template(),
    places: ti.template(), claims: ti.template(), hash_keys: ti.template(), stamps: ti.template(),
    told: ti.template(), sums: ti.template(),
):  # fmt: skip
    """Make the first `end` updates of the list, a thread each, so that those of one ray do not wait for each
    other. No addition is inside a loop within a thread: after that, Mesa's software device (22.3) forgets
    which threads run. Keys of missing blocks go to `missing`, hardly any of them twice (`is_winner`)."""
    for i in range(end):
        at = listed[i, PLACE]
        if at >= 0:
            add_update(listed, i, at, sign_, sums)
            list_block(at // CUBE, stamp, stamps, told)
        elif at > SKIPPED:
            key = missing_key(listed, i)
            winners[winner_place(key, 0)] = i
            winners[winner_place(key, 1)] = i
    for i in range(end):
        at = listed[i, PLACE]
        if at < 0 and at > SKIPPED:
            if is_winner(i, listed, winners) == 1:
                k, key = ti.atomic_add(told[TOUCHED_MISSING], 1), missing_key(listed, i)
                missing[k] = key
                if k < FEW_NEW:
                    mask, probes = hash_keys.shape[0] - 1, 0
                    place = hash_key(key) & mask
                    while hash_keys[place] != 0 and probes <= mask:
                        place = (place + 1) & mask
                        probes += 1
                    places[k, HASH_PLACE] = place
                    ti.atomic_add(claims[place & (CLAIMS - 1)], 1)


@ti.func
def vote_colors(
    votes_end, kind, sign_, rays: ti.template(), first_ray, listed: ti.template(), marks: ti.template(),
    told: ti.template(), hash_keys: ti.template(), hash_slots: ti.template(), oldest,
    color_rgn: ti.template(), color_b: ti.template(),
):  # fmt: skip
    """Cast the colour votes of `votes_end` − 1 rays, if their updates were made. New blocks from slot
    `oldest` on that may share a place enter the hash, one after the other."""
    for k in range(votes_end):
        i = k - 1
        if i < 0:
            mask = hash_keys.shape[0] - 1
            for n in range(told[APART], told[NEW]):
                key = fresh_key(told, n)
                place = hash_key(key) & mask
                while hash_keys[place] != 0:
                    place = (place + 1) & mask
                hash_keys[place] = key
                hash_slots[place] = oldest + n
        elif marks[i] >= 0 and told[TOUCHED_OVERFLOW] == 0:
            at = listed[marks[i], PLACE]
            if at >= 0:
                packed = rays[first_ray + i, WEIGHT_COLOR] & 0xFFFFFF
                vote_color(at, packed, kind, sign_, told, color_rgn, color_b)


@ti.func
def order_new(missing: ti.template(), places: ti.template(), claims: ti.template(), told: ti.template()):
    """Put the missing blocks in order, if they are few: those that share no place in the hash first."""
    for k in range(FEW_NEW):
        if k < told[TOUCHED_MISSING] and told[TOUCHED_MISSING] <= FEW_NEW:
            key, shares = missing[k], shares_place(k, places, claims)
            rank, are_same = 0, 0
            for j in range(told[TOUCHED_MISSING]):
                others = shares_place(j, places, claims)
                rank += ti.cast((others < shares) | ((others == shares) & (missing[j] < key)), ti.i32)
                are_same |= ti.cast((missing[j] == key) & (j != k), ti.i32)
            told[FRESH_AT + 2 * rank] = ti.cast(key, ti.i32)
            told[FRESH_AT + 2 * rank + 1] = ti.cast(key >> 32, ti.i32)
            places[k, RANK] = rank
            if shares == 0:
                ti.atomic_add(told[APART], 1)
            if are_same == 1:
                told[ARE_SAME] = 1


@ti.func
def new_blocks(room: ti.template(), totals: ti.template(), told: ti.template()):
    """Number of missing blocks with room: all of them, or none."""
    new = told[TOUCHED_MISSING]
    cost = totals[COSTS] + new * room[BLOCK_COST]
    if (
        new > room[ROOM_NEW]
        or told[ARE_SAME] == 1
        or told[TOUCHED_COUNT] + new > room[ROOM_TOUCHED]
        or cost > room[ROOM_COST]
    ):
        new = 0
    return new


@ti.func
def add_new(
    end, oldest, sign_, stamp, room: ti.template(), totals: ti.template(), listed: ti.template(),
    missing: ti.template(), places: ti.template(), claims: ti.template(), hash_keys: ti.template(),
    hash_slots: ti.template(), stamps: ti.template(), told: ti.template(), sums: ti.template(),
):  # fmt: skip
    """Insert the new blocks from slot `oldest` on, if there is room, and make the updates of the list in
    them. The hash equals that of `block_hash.insert_blocks` with the blocks in the order of their slots.
    Blocks that share no place with others enter it here, the others at last (`vote_colors`)."""
    for i in range(end):
        new = new_blocks(room, totals, told)
        if i == 0:
            told[NEW] = new
        if i < new:
            told[TOUCHED_AT + told[TOUCHED_COUNT] + i] = oldest + i
            stamps[oldest + i] = stamp
            if shares_place(i, places, claims) == 0:
                hash_keys[places[i, HASH_PLACE]] = missing[i]
                hash_slots[places[i, HASH_PLACE]] = oldest + places[i, RANK]
        at = listed[i, PLACE]
        if new > 0 and at < 0 and at > SKIPPED:
            at = (oldest + rank_of(told, missing_key(listed, i))) * CUBE + (-1 - at)
            listed[i, PLACE] = at
            add_update(listed, i, at, sign_, sums)


@ti.func
def add_and_admit(
    rays: ti.template(), count, places_end, votes_end, kind, sign_, stamp, first_slot, room: ti.template(),
    hash_keys: ti.template(), hash_slots: ti.template(), winners: ti.template(), missing: ti.template(),
    places: ti.template(), claims: ti.template(), stamps: ti.template(), told: ti.template(),
    groups: ti.template(), totals: ti.template(), listed: ti.template(), marks: ti.template(),
    sums: ti.template(), color_rgn: ti.template(), color_b: ti.template(),
):  # fmt: skip
    """Add a keyframe's first `count` rays and their colours (`vote_colors`). Missing blocks are inserted from
    `first_slot` on, if they are few and there is `room` for them."""
    list_rays(rays, 0, count, places_end, 0, groups, totals, listed, marks, hash_keys, hash_slots, told)
    end = listed_end(count, totals, listed)
    add_listed(end, sign_, stamp, listed, winners, missing, places, claims, hash_keys, stamps, told, sums)
    order_new(missing, places, claims, told)
    add_new(
        end, first_slot, sign_, stamp, room, totals, listed, missing, places, claims, hash_keys, hash_slots,
        stamps, told, sums,
    )  # fmt: skip
    vote_colors(
        votes_end, kind, sign_, rays, 0, listed, marks, told, hash_keys, hash_slots, first_slot, color_rgn,
        color_b,
    )  # fmt: skip


@QuickLaunch
@ti.kernel
def add_rays(
    rays: I32x2, first_ray: ti.i32, end_ray: ti.i32, sign_: ti.i32, oldest: ti.i32, stamp: ti.i32,
    kind: ti.i32,  # of votes
    hash_keys: I64, hash_slots: I32, winners: I32, missing: I64, places: I32x2, claims: I32, stamps: I32,
    told: I32, groups: I32x2, totals: I64, listed: I32x2, marks: I32, sums: I64x2, color_rgn: I64x2,
    color_b: I32x2,
):  # fmt: skip
    """Add rays of places `first_ray` … `end_ray` − 1 as `integrate.add_rays` does, to blocks of slot ≥
    `oldest`. Missing blocks are reported. If `listed` has no room for all updates, none is made, and `told`
    says so."""
    count = end_ray - first_ray
    for i in range(groups.shape[0] + BANDS):
        if i >= BANDS:
            begin_groups(i - BANDS, groups, totals)
        if i < BANDS:
            told[band_field(i, UPDATES)], told[band_field(i, LACKING)] = 0, 0
        if i == 0:
            for field in ti.static((TOUCHED_OVERFLOW, TOUCHED_MISSING, NEW, APART)):
                told[field] = 0
    for i in range(count):
        if ray_weight(rays, first_ray + i) > 0:
            marks[i] = ti.atomic_add(groups[i // GROUP, CROSSED], crossed(rays, first_ray + i))
    for g in range((count + GROUP - 1) // GROUP):
        begin_list(g, groups, totals, listed)
    list_rays(
        rays, first_ray, count, whole_groups(count), oldest, groups, totals, listed, marks, hash_keys,
        hash_slots, told,
    )  # fmt: skip
    end = listed_end(count, totals, listed)
    add_listed(end, sign_, stamp, listed, winners, missing, places, claims, hash_keys, stamps, told, sums)
    vote_colors(
        1 + ti.min(kind, COLOR_VOTE) * count, kind, sign_, rays, first_ray, listed, marks, told, hash_keys,
        hash_slots, 0, color_rgn, color_b,
    )  # fmt: skip
