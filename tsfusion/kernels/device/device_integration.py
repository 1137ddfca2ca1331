# SPDX-License-Identifier: MIT
"""Add rays to a map on a device of many threads: one thread per ray, with atomic additions.

Every voxel gets the same sum as from `integrate.add_rays`: the additions are the same integers, and their
order has no effect. Arrays are in device memory (`ti.ndarray`); those of the map have a row of 512 voxels per
slot. Counters are first split over many entries, because a device makes additions to one entry in sequence.
"""

from tsfusion.kernels import I32, I64, I32x2, I64x2, ti
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
from tsfusion.kernels.device.device_copies import (
    APART,
    ARE_SAME,
    CLAIMS,
    FEW_NEW,
    FRESH_AT,
    LACKING,
    NEW,
    STRIPS,
    TOUCHED_AT,
    fresh_key,
    joined,
    rank_of,
    strip_field,
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

# A listed update: index of the voxel in the layers, w·m << WEIGHT_FIELD | w, and the key of a missing block,
# whose index is −1 − the number of the voxel in the block.
LISTED_FIELDS = 4
PLACE, AMOUNT, KEY = 0, 1, 2
WEIGHT_FIELD = 8  # bits
SKIPPED = -1 - CUBE  # index of an update that is not made

# Groups of rays, by their indices: number of crossed voxels, and start of their updates in the list.
GROUP, GROUP_FIELDS = TILE_SAMPLES, 2
CROSSED, BASE = 0, 1
LISTED, COSTS = 0, 1  # in `totals`: number of listed updates, and cost of the rays

WINNERS = 1 << 16  # entries of a table; there are two tables
HASH_PLACE, RANK = 0, 1  # fields of a missing block, if there are few

# Limits of a keyframe: new blocks, touched blocks, cost of rays and new blocks; and the cost of one new block
ROOM_NEW, ROOM_TOUCHED, ROOM_COST, BLOCK_COST = 0, 1, 2, 3


@ti.func
def begin_groups(i, groups: ti.template(), totals: ti.template()):
    """Clear a launch's counters of updates: the i-th thread clears the i-th group of rays."""
    if i == 0:
        totals[LISTED], totals[COSTS] = 0, 0
    if i < groups.shape[0]:
        groups[i, CROSSED] = 0


@ti.func
def begin_list(g, groups: ti.template(), totals: ti.template(), listed: ti.template()):
    """Reserve a contiguous part of the list of updates for the g-th group of rays."""
    base = ti.atomic_add(totals[LISTED], ti.cast(groups[g, CROSSED], ti.i64))
    groups[g, BASE] = ti.cast(ti.min(base, ti.i64(listed.shape[0])), ti.i32)


@ti.func
def list_block(slot, version, versions: ti.template(), told: ti.template()):
    """Append a block to the report of blocks touched by keyframe `version`, unless it is there already."""
    if versions[slot] != version:
        if ti.atomic_max(versions[slot], version) != version:
            place = ti.atomic_add(told[TOUCHED_COUNT], 1)
            told[TOUCHED_AT + place] = slot


@ti.func
def missing_key(listed: ti.template(), i):
    """Return the key of the missing block to which update i of the list belongs."""
    return joined(listed[i, KEY], listed[i, KEY + 1])


@ti.func
def winner_place(key, table: ti.template()):
    """Return the index of a block in hash table `table` (0 or 1) of `WINNERS` entries."""
    return table * WINNERS + ((hash_key(key) >> (15 * table)) & (WINNERS - 1))


@ti.func
def is_winner(i, listed: ti.template(), winners: ti.template()):
    """Return True if update i reports its missing block. Nearly always one update of a block does."""
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
    """Return True if another missing block may want the same hash index as the k-th missing block."""
    return ti.cast(claims[places[k, HASH_PLACE] & (CLAIMS - 1)] > 1, ti.i32)


@ti.func
def crossed(rays: ti.template(), r):
    """Return the number of voxels that ray `r` crosses."""
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
    """Write the updates (voxel, amount) of ray `r` to the list from index `base` on, at most `most`: one for
    each crossed voxel in blocks of slot ≥ `oldest` and in missing blocks. Returns the number of updates, that
    of updates in missing blocks, and the index of the update whose voxel takes the colour, or −1."""
    walk, weight = begin_walk(rays, r), ray_weight(rays, r)
    length, end, support = parts_of(rays, r)
    half = length - end
    least, most_free = free_bounds(half, support)
    last, slot, key = vec3i(2147483647), -1, ti.i64(0)
    added, lacking, colored, n = 0, 0, -1, 0
    is_colored = ti.select(end + 1 == length, 1, 0)  # 1 also for a ray without a colour
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
    """Add update i of the list to the sums of the voxel at index `at` (slot · 512 + number in the block)."""
    # Both sums in one addition; their quotient minimises Σ w (x − m)²: paper eq. 2
    packed = listed[i, AMOUNT]
    product, w = ti.cast(packed >> WEIGHT_FIELD, ti.i64), packed & ((1 << WEIGHT_FIELD) - 1)
    ti.atomic_add(sums[at // CUBE, at % CUBE], sign_ * ((product << WEIGHT_BITS) + w))


@ti.func
def vote_color(
    at, packed, kind, sign_, told: ti.template(), color_rgn: ti.template(), color_b: ti.template()
):
    """Add a colour vote 0xRRGGBB, or a hit, to the voxel at index `at`. A full colour does not change, as in
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
    """Return the number of listed updates of all rays; 0 if they exceed the capacity of the list."""
    is_listed = (count > 0) & (totals[LISTED] <= listed.shape[0])
    return ti.cast(ti.select(is_listed, totals[LISTED], 0), ti.i32)


@ti.func
def whole_groups(count):
    """Return `count` rays rounded up to a multiple of the group size `GROUP`."""
    return (count + GROUP - 1) // GROUP * GROUP


@ti.func
def place_of(j):
    """Return the index of the ray that the j-th thread handles. In a cell of four pixels only the first index
    has a ray. Neighbouring threads handle every fourth index, where all have a ray, or none."""
    return j // GROUP * GROUP + j % GROUP % (GROUP // 4) * 4 + j % GROUP // (GROUP // 4)


@ti.func
def list_rays(
    rays: ti.template(), first_ray, count, places_end, oldest, groups: ti.template(), totals: ti.template(),
    listed: ti.template(), marks: ti.template(), hash_keys: ti.template(), hash_slots: ti.template(),
    told: ti.template(),
):  # fmt: skip
    """List the voxel updates of `count` rays (`list_updates`), in `places_end` threads. Before, `marks` has
    the start of each ray's updates in its group's part of the list; then, the index of the update that takes
    its colour. Each loop of this and the next functions is a task of a device, and so is the first evaluation
    of each loop's end."""
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
                ti.atomic_add(told[strip_field(i % STRIPS, UPDATES)], made)
            if lacked > 0:
                ti.atomic_add(told[strip_field(i % STRIPS, LACKING)], lacked)
        elif i < count:
            marks[i] = -1


@ti.func
def add_listed(
    end, sign_, version, listed: ti.template(), winners: ti.template(), missing: ti.template(),
    places: ti.template(), claims: ti.template(), hash_keys: ti.template(), versions: ti.template(),
    told: ti.template(), sums: ti.template(),
):  # fmt: skip
    """Add the first `end` updates of the list to the map, one thread each: a ray's updates do not wait for
    each other. No addition is inside a loop within a thread: after that, Mesa's software device (22.3) loses
    track of the running threads. Keys of missing blocks go to `missing`, rarely twice (`is_winner`)."""
    for i in range(end):
        at = listed[i, PLACE]
        if at >= 0:
            add_update(listed, i, at, sign_, sums)
            list_block(at // CUBE, version, versions, told)
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
    """Add the colour votes of `votes_end` − 1 rays, if their updates were made. Also insert the new blocks
    (slots from `oldest` on) that may share an index of the hash, one after the other."""
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
    """Sort the missing blocks, if they are few: those that share no index of the hash come first."""
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
    """Return the number of missing blocks to insert: all, or 0 if they exceed the limits in `room`."""
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
    end, oldest, sign_, version, room: ti.template(), totals: ti.template(), listed: ti.template(),
    missing: ti.template(), places: ti.template(), claims: ti.template(), hash_keys: ti.template(),
    hash_slots: ti.template(), versions: ti.template(), told: ti.template(), sums: ti.template(),
):  # fmt: skip
    """Insert the new blocks into the hash (slots from `oldest` on), if the limits in `room` allow it, and add
    the listed updates of their voxels. The hash equals that of `block_hash.insert_blocks` with the blocks in
    the order of their slots. Blocks that share no index come first, the others at the end (`vote_colors`)."""
    for i in range(end):
        new = new_blocks(room, totals, told)
        if i == 0:
            told[NEW] = new
        if i < new:
            told[TOUCHED_AT + told[TOUCHED_COUNT] + i] = oldest + i
            versions[oldest + i] = version
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
    rays: ti.template(), count, places_end, votes_end, kind, sign_, version, first_slot, room: ti.template(),
    hash_keys: ti.template(), hash_slots: ti.template(), winners: ti.template(), missing: ti.template(),
    places: ti.template(), claims: ti.template(), versions: ti.template(), told: ti.template(),
    groups: ti.template(), totals: ti.template(), listed: ti.template(), marks: ti.template(),
    sums: ti.template(), color_rgn: ti.template(), color_b: ti.template(),
):  # fmt: skip
    """Add the first `count` rays and colours of a keyframe to the map on a GPU. Missing blocks are inserted
    from slot `first_slot` on, if they are few and the limits in `room` allow it."""
    list_rays(rays, 0, count, places_end, 0, groups, totals, listed, marks, hash_keys, hash_slots, told)
    end = listed_end(count, totals, listed)
    add_listed(end, sign_, version, listed, winners, missing, places, claims, hash_keys, versions, told, sums)
    order_new(missing, places, claims, told)
    add_new(
        end, first_slot, sign_, version, room, totals, listed, missing, places, claims, hash_keys, hash_slots,
        versions, told, sums,
    )  # fmt: skip
    vote_colors(
        votes_end, kind, sign_, rays, 0, listed, marks, told, hash_keys, hash_slots, first_slot, color_rgn,
        color_b,
    )  # fmt: skip


@QuickLaunch
@ti.kernel
def add_rays(
    rays: I32x2, first_ray: ti.i32, end_ray: ti.i32, sign_: ti.i32, oldest: ti.i32, version: ti.i32,
    kind: ti.i32,  # of votes
    hash_keys: I64, hash_slots: I32, winners: I32, missing: I64, places: I32x2, claims: I32, versions: I32,
    told: I32, groups: I32x2, totals: I64, listed: I32x2, marks: I32, sums: I64x2, color_rgn: I64x2,
    color_b: I32x2,
):  # fmt: skip
    """Add rays `first_ray` … `end_ray` − 1 as `integrate.add_rays` does, to blocks of slot ≥ `oldest`.
    Missing blocks are reported. If `listed` has no capacity for all updates, none is made, and the report
    `told` says so."""
    count = end_ray - first_ray
    for i in range(groups.shape[0] + STRIPS):
        if i >= STRIPS:
            begin_groups(i - STRIPS, groups, totals)
        if i < STRIPS:
            told[strip_field(i, UPDATES)], told[strip_field(i, LACKING)] = 0, 0
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
    add_listed(end, sign_, version, listed, winners, missing, places, claims, hash_keys, versions, told, sums)
    vote_colors(
        1 + ti.min(kind, COLOR_VOTE) * count, kind, sign_, rays, first_ray, listed, marks, told, hash_keys,
        hash_slots, 0, color_rgn, color_b,
    )  # fmt: skip
