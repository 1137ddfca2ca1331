# SPDX-License-Identifier: MIT
"""Lay out `told`, the report of a launch on a device to its host: (n,) int32."""

import taichi as ti

from tsfusion.kernels.base.voxel_traversal import BAND_FIELDS, DEFERRED
from tsfusion.kernels.integration.integrate import TOUCHED_HEADER, TOUCHED_MISSING

# `told` starts with the header of the touched blocks (`integrate`). Then come: number of new blocks; number
# of missing blocks whose hash index no other block wants; flag, two of these are the same; the bands, the
# k-th of which also counts updates of every 64th ray; keys of new blocks, in the order of their slots, two
# numbers each; slots of touched blocks.
NEW, APART, ARE_SAME = (TOUCHED_HEADER + i for i in range(3))
HEADER = 16
BANDS = 64  # the bands of a map on the CPU: bundles of points end at their ends
FEW_NEW = 4096  # largest number of blocks that a launch inserts itself
BANDS_AT = HEADER
FRESH_AT = BANDS_AT + BANDS * BAND_FIELDS
TOUCHED_AT = FRESH_AT + 2 * FEW_NEW
FIRST_BLOCKS = 8192  # blocks that a new map has room for
FIRST_HASH = 4 * FIRST_BLOCKS
LACKING = DEFERRED  # field of a band: updates of missing blocks

CLAIMS = 1 << 14  # entries of a table that counts the missing blocks for each hash index
BEGINNERS = max(TOUCHED_AT, CLAIMS)


@ti.func
def band_field(band, field: ti.template()):
    """Return the index of a band's field in `told`."""
    return BANDS_AT + band * BAND_FIELDS + field


@ti.func
def begin_keyframe(i, told: ti.template(), claims: ti.template()):
    """Clear the report of the keyframe before, in the i-th of `BEGINNERS` threads."""
    if i < TOUCHED_AT:
        told[i] = 0
    if i < CLAIMS:
        claims[i] = 0


@ti.func
def joined(low, high):
    """Join the two numbers of a key."""
    return (ti.cast(high, ti.i64) << 32) | (ti.cast(low, ti.i64) & ti.i64(4294967295))


@ti.func
def fresh_key(told: ti.template(), rank):
    """Return the key of a new block."""
    return joined(told[FRESH_AT + 2 * rank], told[FRESH_AT + 2 * rank + 1])


@ti.func
def rank_of(told: ti.template(), key):
    """Return the rank of a new block: blocks that share no hash index come first, each group by its keys."""
    rank = rank_within(told, key, 0, told[APART])
    if rank < 0:
        rank = rank_within(told, key, told[APART], told[TOUCHED_MISSING])
    return rank


@ti.func
def rank_within(told: ti.template(), key, first, end):
    """Return the rank of a new block within a run of ranks; else −1."""
    low, high = first, end
    while high - low > 1:
        middle = (low + high) >> 1
        if fresh_key(told, middle) <= key:
            low = middle
        else:
            high = middle
    found = -1
    if first < end:
        found = ti.select(fresh_key(told, low) == key, low, -1)
    return found
