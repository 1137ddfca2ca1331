# SPDX-License-Identifier: MIT
"""Map block keys to slots by a hash, and collect the blocks that a keyframe finds missing in a set.

The set is the phase-concurrent, history-independent table of Shun and Blelloch (SPAA 2014): a larger key
displaces a smaller key to the next entry with `atomic_max`. Hence the table's content, and every slot
assigned from it, does not depend on the order of threads. It needs no locks and no compare-and-swap.
"""

from tsfusion.kernels import I32, I64, ti
from tsfusion.kernels.base.quick_launch import QuickLaunch
from tsfusion.kernels.base.voxel_traversal import hash_key

MAX_PROBES = 256


@ti.func
def set_insert(table: ti.template(), mask, key):
    """Insert block key `key` (> 0) into the set. Returns the keys added (0 or 1), and 1 if it is full.

    If several threads insert one key at the same time, one of them counts it.
    """
    full, grown = 0, 0
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
                grown = ti.cast(before == 0, ti.i32)
                carried = before
        i = (i + 1) & mask
        probes += 1
        if probes > MAX_PROBES:
            full = 1
            carried = ti.i64(0)
    return grown, full


@ti.func
def map_find(keys: ti.template(), slots: ti.template(), mask, key):
    """Return the slot of block `key` in the map, -1 if absent. The table is at most half full."""
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


@QuickLaunch
@ti.kernel
def insert_blocks(keys: I64, first: ti.i32, count: ti.i32, first_slot: ti.i32, map_keys: I64, map_slots: I32):
    """Assign slot `first_slot + i` to `keys[first + i]` in the map's hash table. Runs serially. The caller
    keeps the table half empty, and the keys distinct and new."""
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


@QuickLaunch
@ti.kernel
def find_blocks(keys: I64, map_keys: I64, map_slots: I32, slots: I32):
    """Look up block keys in the map's hash table: write their slots, -1 for absent blocks."""
    mask = map_keys.shape[0] - 1
    for i in range(keys.shape[0]):
        slots[i] = map_find(map_keys, map_slots, mask, keys[i])


@QuickLaunch
@ti.kernel
def find_places(keys: I64, map_keys: I64, places: I32):
    """Write the indices in the hash table at which block keys lie. All keys must be in it. Runs serially."""
    mask = map_keys.shape[0] - 1
    ti.loop_config(serialize=True)
    for n in range(keys.shape[0]):
        i = hash_key(keys[n]) & mask
        probes = 0
        while map_keys[i] != keys[n] and probes <= mask:
            i = (i + 1) & mask
            probes += 1
        places[n] = i
