# SPDX-License-Identifier: MIT
"""The set of blocks one keyframe touches, and the hash from block key to slot of the whole map.

The set is the phase-concurrent, history-independent table of Shun and Blelloch (SPAA 2014): a larger key
displaces a smaller one onward with `atomic_max`, so the table's content, and with it every index taken
from it, does not depend on which thread came first. No locks, no compare-and-swap.
"""

import taichi as ti

from tsfusion.kernels.traversal import (
    RUN,
    block_key,
    hash_key,
    next_axis,
    pack,
    ray_length,
    ray_start,
    ray_weight,
    sign,
    vec3i,
)

MAX_PROBES = 256


@ti.func
def set_insert(table: ti.template(), mask, key, overflow: ti.template()):
    """Insert `key` (> 0) into the set; raises `overflow[0]` when it is too full."""
    carried = key
    i = hash_key(key) & mask
    probes = 0
    while carried != 0:
        if table[i] == carried:
            carried = ti.i64(0)
        else:
            before = ti.atomic_max(table[i], carried)
            if before == carried:
                carried = ti.i64(0)
            elif before < carried:
                carried = before
        i = (i + 1) & mask
        probes += 1
        if probes > MAX_PROBES:
            ti.atomic_max(overflow[0], 1)
            carried = ti.i64(0)


@ti.func
def set_find(table: ti.template(), mask, key):
    """Position of `key` in the set, -1 if absent."""
    i = hash_key(key) & mask
    found = -1
    probes = 0
    while probes <= MAX_PROBES:
        k = table[i]
        if k == key:
            found = i
            probes = MAX_PROBES
        elif k == 0:
            probes = MAX_PROBES
        i = (i + 1) & mask
        probes += 1
    return found


@ti.func
def map_find(keys: ti.template(), slots: ti.template(), mask, key):
    """Slot of block `key` in the map, -1 if absent. The table is never more than half full."""
    i = hash_key(key) & mask
    slot = -1
    probes = 0
    while probes <= mask:
        k = keys[i]
        if k == key:
            slot = slots[i]
            probes = mask
        elif k == 0:
            probes = mask
        i = (i + 1) & mask
        probes += 1
    return slot


@ti.kernel
def touch_blocks(
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    band_start: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_count: ti.types.ndarray(dtype=ti.i32, ndim=1),
    table: ti.types.ndarray(dtype=ti.i64, ndim=1),
    overflow: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Insert every block that a ray's band crosses: the voxel traversal, eight voxels at a time."""
    mask = table.shape[0] - 1
    for run in range(band_count.shape[0] * RUN):
        if run % RUN == 0:
            band = run // RUN
            last = ti.i64(0)
            for r in range(band_start[band], band_start[band] + band_count[band]):
                if ray_weight(rays, r) > 0:
                    voxel, crossing, interval, direction, _ = ray_start(rays, r)
                    end = ray_length(rays, r)
                    block = voxel >> 3
                    step = vec3i(0)
                    for a in ti.static(range(3)):
                        step[a] = sign(direction[a])
                        left = voxel[a] & 7
                        if direction[a] > 0:
                            left = 7 - left
                        crossing[a] += left * interval[a]
                        interval[a] *= 8
                    inside = 1
                    while inside == 1:
                        key = pack(block[0], block[1], block[2])
                        if key != last:
                            set_insert(table, mask, key, overflow)
                            last = key
                        axis = next_axis(crossing)
                        for a in ti.static(range(3)):
                            if axis == a:
                                if crossing[a] >= end:
                                    inside = 0
                                crossing[a] += interval[a]
                                block[a] += step[a]


@ti.kernel
def index_blocks(
    table: ti.types.ndarray(dtype=ti.i64, ndim=1),
    table_index: ti.types.ndarray(dtype=ti.i32, ndim=1),
    map_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    map_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    touched_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    touched_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
) -> ti.i32:
    """Number the touched blocks in table order and look up their slots (-1 = new). Returns their count,
    which may exceed `touched_keys`: then nothing past its end was written."""
    count = 0
    capacity = touched_keys.shape[0]
    mask = map_keys.shape[0] - 1
    ti.loop_config(serialize=True)
    for i in range(table.shape[0]):
        key = table[i]
        if key != 0:
            if count < capacity:
                table_index[i] = count
                touched_keys[count] = key
                touched_slots[count] = map_find(map_keys, map_slots, mask, key)
            count += 1
    return count


@ti.kernel
def insert_blocks(
    keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    first: ti.i32,
    count: ti.i32,
    first_slot: ti.i32,
    map_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    map_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Give `keys[first + i]` the slot `first_slot + i`. Serial; the caller keeps the table half empty and
    the keys distinct and new."""
    mask = map_keys.shape[0] - 1
    ti.loop_config(serialize=True)
    for n in range(count):
        i = hash_key(keys[first + n]) & mask
        probes = 0
        while map_keys[i] != 0 and probes <= mask:
            i = (i + 1) & mask
            probes += 1
        map_keys[i] = keys[first + n]
        map_slots[i] = first_slot + n


@ti.kernel
def find_blocks(
    keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    map_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    map_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Slots of block keys, -1 where absent."""
    mask = map_keys.shape[0] - 1
    for i in range(keys.shape[0]):
        slots[i] = map_find(map_keys, map_slots, mask, keys[i])


@ti.func
def touched_index(table: ti.template(), table_index: ti.template(), voxel):
    """Index of the touched block that holds `voxel`, -1 if it was never inserted."""
    at = set_find(table, table.shape[0] - 1, block_key(voxel))
    index = -1
    if at >= 0:
        index = table_index[at]
    return index
