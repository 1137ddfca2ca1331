# SPDX-License-Identifier: MIT
"""The map's sums as values: what a surface is made from."""

import taichi as ti

from tsfusion.kernels import I32, I64, U8, F32x2, I32x2, I64x2
from tsfusion.kernels.base.block_hash import map_find
from tsfusion.kernels.base.quick_launch import QuickLaunch
from tsfusion.kernels.base.run_loop import runs, unit_of
from tsfusion.kernels.integration.integrate import CUBE, QUANTA_PER_VOXEL, WEIGHT_BITS, lane_weight

BANDS = 64  # units of parallel work; fixed, so that nothing depends on the thread count

# A loop that stores to an array does not become vector code (LLVM cannot know that the array's address is
# not what is stored to); one that stores to a small local vector does: 0.5 µs a block instead of 1.4.
STRIDE = 32

SEVERAL = 3  # rays that end in a voxel: a surface is there, however many others look through it


@ti.func
def distance_as_float(packed):
    """Nearest float32 to a lane of at most 37 bits. AVX2 converts vectors of int32, not of int64."""
    high = ti.cast(ti.cast(packed >> (WEIGHT_BITS + 16), ti.i32), ti.f32)
    low = ti.cast(ti.cast(packed >> WEIGHT_BITS, ti.i32) & 65535, ti.f32)
    return high * 65536.0 + low


@ti.func
def held(value, slot, o, color_rgn: ti.template(), hits: ti.template(), layers):
    """The signed distance of a voxel for who may not run into something, in voxels.

    A mean of rays that end in the voxel and of others that pass a thin thing there is that of free space; so
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
    """True if a block is free as a whole: a keyframe looks through it, and its voxels show no surface."""
    found = 0
    if slot < 0 or shows_surface[slot] == 0:
        own = map_find(keys, slots, keys.shape[0] - 1, key)
        if own >= 0:
            found = ti.cast(counts[own] > 0, ti.i32)
    return found


@QuickLaunch
@ti.kernel
def find_surfaces(slots: I32, sums: I64x2, color_rgn: I64x2, hits: I32x2, layers: ti.i32, shows_surface: U8):
    """Note of blocks whether a ray has ended in a voxel of theirs, or one is at a surface or behind it."""
    for run in range(runs(BANDS)):  # run loop: kernels/base/run_loop.py
        band = unit_of(run, BANDS)
        if band < BANDS:
            count = slots.shape[0]
            for r in range(count * band // BANDS, count * (band + 1) // BANDS):
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
    """Row r of `values`, those of the block in `slots[r]` in voxels, becomes what is `held` there."""
    for run in range(runs(BANDS)):  # run loop: kernels/base/run_loop.py
        band = unit_of(run, BANDS)
        if band < BANDS:
            count = slots.shape[0]
            for r in range(count * band // BANDS, count * (band + 1) // BANDS):
                for o in range(CUBE):
                    values[r, o] = held(values[r, o], slots[r], o, color_rgn, hits, layers)


@QuickLaunch
@ti.kernel
def read_values(
    count: ti.i32, keys: I64, map_keys: I64, map_slots: I32, sums: I64x2, correction: F32x2,
    corrected: ti.i32, min_weight: ti.i32, values: F32x2,
):  # fmt: skip
    """Row r of `values`: smoothed or raw values of block `keys[r]` in quanta; NaN below `min_weight`."""
    mask = map_keys.shape[0] - 1
    for run in range(runs(BANDS)):  # run loop: kernels/base/run_loop.py
        band = unit_of(run, BANDS)
        if band < BANDS:
            for r in range(count * band // BANDS, count * (band + 1) // BANDS):
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
