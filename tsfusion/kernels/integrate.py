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
from tsfusion.kernels.voxel_traversal import (
    ADDED,
    COUNT,
    DEFERRED,
    END,
    LENGTH,
    RUN,
    START,
    UPDATES,
    WEIGHT_COLOR,
    advance,
    begin_walk,
    block_key,
    next_step,
    offset_in_block,
    ray_weight,
    vec3i,
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
    held = ti.min(ti.max(distance, -(18 << 16)), 18 << 16)
    return ti.min(ti.max((held * QUANTA_PER_VOXEL + 32768) >> 16, -MAX_DISTANCE), MAX_DISTANCE)


@ti.func
def touch(
    slot, stamp, stamps: ti.template(), places: ti.template(), dirty: ti.template(), touched: ti.template()
):
    """List the block, once a keyframe."""
    if stamps[slot] != stamp:
        if ti.atomic_max(stamps[slot], stamp) != stamp:
            place = ti.atomic_add(touched[TOUCHED_COUNT], 1)
            touched[TOUCHED_HEADER + place] = slot
            places[slot] = place
            dirty[slot] = ti.u8(CHANGED)


@ti.func
def vote_color(
    slot, o, sign_, packed, color_rgn: ti.template(), color_b: ti.template(), touched: ti.template()
):
    """One vote for the colour in the low 24 bits of `packed`.

    A count just below 2¹⁶ has gone below none. A settled colour stays, whatever is added or taken away: it is
    no longer a sum.
    """
    votes = ti.cast(color_rgn[slot, o] & 65535, ti.i32)
    if votes < COLOR_LIMIT or votes >= COLOR_LIMIT + (COLOR_LIMIT >> 1):
        red = ti.cast((packed >> 16) & 255, ti.i64)
        green = ti.cast((packed >> 8) & 255, ti.i64)
        before = ti.atomic_add(color_rgn[slot, o], sign_ * ((red << 40) + (green << 16) + 1))
        ti.atomic_add(color_b[slot, o], sign_ * (packed & 255))
        if sign_ < 0 and (before & 65535) == 0:
            touched[TOUCHED_MISMATCH] = 1


@ti.func
def enter_block(
    key, hash_keys: ti.template(), hash_slots: ti.template(), missing: ti.template(), most_missing, stamp,
    stamps: ti.template(), places: ti.template(), dirty: ti.template(), touched: ti.template(),
):  # fmt: skip
    """Slot of a block, which is listed in `touched`; −1, and its key in `missing`, if the map lacks it."""
    slot = map_find(hash_keys, hash_slots, hash_keys.shape[0] - 1, key)
    if slot < 0:
        if touched[TOUCHED_OVERFLOW] == 0:
            grown, full = set_insert(missing, missing.shape[0] - 1, key)
            if grown == 1:
                full |= ti.cast(ti.atomic_add(touched[TOUCHED_MISSING], 1) >= most_missing, ti.i32)
            if full == 1:
                touched[TOUCHED_OVERFLOW] = 1
    else:
        touch(slot, stamp, stamps, places, dirty, touched)
    return slot


@ti.func
def add_ray(
    rays: ti.template(), r, sign_, oldest, last: ti.template(), slot: ti.template(), hash_keys: ti.template(),
    hash_slots: ti.template(), missing: ti.template(), most_missing, stamp, stamps: ti.template(),
    places: ti.template(), dirty: ti.template(), touched: ti.template(), sums: ti.template(), has_color,
    color_rgn: ti.template(), color_b: ti.template(),
):  # fmt: skip
    """Add a ray to every voxel it crosses. `last` and its `slot`: the block entered last, by any ray.

    Returns how many voxels it was added to, and whether it crosses blocks that the map does not have.
    """
    weight = ray_weight(rays, r)
    length = rays[r, LENGTH]
    end = rays[r, END] & ~7
    reach = length - end
    updates, incomplete, colored = 0, 0, 1 - has_color
    walk = begin_walk(rays, r)
    inside = ti.cast(weight > 0, ti.i32)
    while inside == 1:
        block = walk.voxel >> 3
        if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
            last = block
            slot = enter_block(
                block_key(walk.voxel), hash_keys, hash_slots, missing, most_missing, stamp, stamps, places,
                dirty, touched,
            )  # fmt: skip
        step, leaves = next_step(walk.crossing)
        if slot >= oldest:
            o = offset_in_block(walk.voxel)
            m, w = quantize(walk.distance), sign_ * weight
            if leaves < end - reach:  # in free space before the band
                m, w = quantize(reach), sign_ * ti.max(weight >> FREE_SHIFT, 1)
            # both sums in one addition; their quotient minimises Σ w (x − m)²: paper eq. 2
            ti.atomic_add(sums[slot, o], (ti.cast(m * w, ti.i64) << WEIGHT_BITS) + w)
            updates += 1
            if colored == 0 and leaves > end:
                vote_color(slot, o, sign_, rays[r, WEIGHT_COLOR], color_rgn, color_b, touched)
        if slot < 0:
            incomplete = 1
        if leaves > end:
            colored = 1
        if leaves >= length:
            inside = 0
        advance(walk, step)
    return updates, incomplete


@ti.kernel
def add_rays(
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
    deferred: ti.types.ndarray(dtype=ti.i32, ndim=1),
    which: ti.i32,
    first_band: ti.i32,
    last_band: ti.i32,
    sign_: ti.i32,
    oldest: ti.i32,
    hash_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    hash_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    missing: ti.types.ndarray(dtype=ti.i64, ndim=1),
    most_missing: ti.i32,
    stamp: ti.i32,
    stamps: ti.types.ndarray(dtype=ti.i32, ndim=1),
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),
    dirty: ti.types.ndarray(dtype=ti.u8, ndim=1),
    touched: ti.types.ndarray(dtype=ti.i32, ndim=1),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    has_color: ti.i32,
    color_rgn: ti.types.ndarray(dtype=ti.i64, ndim=2),
    color_b: ti.types.ndarray(dtype=ti.i32, ndim=2),
):
    """Add to every voxel that each ray crosses in its band, in blocks of slot ≥ `oldest`.

    Rays that cross blocks the map does not have are listed in `deferred`, the keys in `missing`; when those
    blocks exist, a second call with `ONLY_DEFERRED` and `oldest` = the first new slot adds the rest. With
    more than `most_missing` of them every band ends after the ray that it is at: `ONLY_ADDED` are those.
    """
    for run in range((last_band - first_band) * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            band = first_band + run // RUN
            start = bands[band, START]
            count = bands[band, COUNT]
            updates = 0
            if which == ONLY_DEFERRED:
                count = bands[band, DEFERRED]
                updates = bands[band, UPDATES]
            if which == ONLY_ADDED:
                count = bands[band, ADDED]
            last, slot = vec3i(2147483647), -1
            postponed, n = 0, 0
            while n < count:
                r = start + n
                if which == ONLY_DEFERRED:
                    r = deferred[start + n]
                added, incomplete = add_ray(
                    rays, r, sign_, oldest, last, slot, hash_keys, hash_slots, missing, most_missing, stamp,
                    stamps, places, dirty, touched, sums, has_color, color_rgn, color_b,
                )  # fmt: skip
                updates += added
                if incomplete == 1:
                    deferred[start + postponed] = r
                    postponed += 1
                    if which == ALL and touched[TOUCHED_OVERFLOW] == 1:
                        count = n
                n += 1
            bands[band, UPDATES] = updates
            if which == ALL:
                bands[band, DEFERRED] = postponed
                bands[band, ADDED] = n


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
