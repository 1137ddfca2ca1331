# SPDX-License-Identifier: MIT
"""Additive integer integration: rays → this keyframe's sums → the map's sums.

A voxel's sum is one int64, (Σ w·m) · 2²⁷ + Σ w: m = signed distance along the ray in sixtieths of a voxel,
|m| ≤ 1023, which is beyond the widest band there can be.
Colour is (Σ R) · 2⁴⁰ + (Σ G) · 2¹⁶ + n in an int64 and Σ B in an int32, one vote a keyframe.
Addition modulo 2⁶⁴ is a group: any order gives the same bytes, and subtracting restores them.
"""

import taichi as ti

from tsfusion.kernels.blocks import touched_index
from tsfusion.kernels.traversal import (
    MAX_CROSSED,
    RUN,
    next_axis,
    offset_in_block,
    ray_length,
    ray_start,
    ray_weight,
    sign,
    vec3i,
)

WEIGHT_BITS = 27
WEIGHT_MASK = (1 << WEIGHT_BITS) - 1
WEIGHT_LIMIT = 1 << 26  # leaves room for one keyframe, so that a lane cannot carry unnoticed
QUANTA_PER_VOXEL = 60
MAX_DISTANCE = 1023  # quanta: the widest half-width, 16 voxels, and one to spare
COLOR_LIMIT = 1 << 15  # keyframes that may colour one voxel
CUBE = 512


@ti.func
def lane_weight(packed):
    return ti.cast(packed & WEIGHT_MASK, ti.i32)


@ti.func
def lane_distance(packed):
    return packed >> WEIGHT_BITS


@ti.func
def quantize(distance):
    q = (ti.cast(distance, ti.i64) * QUANTA_PER_VOXEL + 32768) >> 16
    return ti.cast(ti.min(ti.max(q, -MAX_DISTANCE), MAX_DISTANCE), ti.i32)


@ti.kernel
def integrate_rays(
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    band_start: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_count: ti.types.ndarray(dtype=ti.i32, ndim=1),
    table: ti.types.ndarray(dtype=ti.i64, ndim=1),
    table_index: ti.types.ndarray(dtype=ti.i32, ndim=1),
    has_color: ti.i32,
    frame: ti.types.ndarray(dtype=ti.i64, ndim=2),
    frame_color: ti.types.ndarray(dtype=ti.i64, ndim=3),
):
    """Add every voxel each ray crosses in its band to the keyframe's sums."""
    for run in range(band_count.shape[0] * RUN):
        if run % RUN == 0:
            band = run // RUN
            last = vec3i(2147483647)
            index = -1
            for r in range(band_start[band], band_start[band] + band_count[band]):
                weight = ray_weight(rays, r)
                if weight > 0:
                    voxel, crossing, interval, direction, distance = ray_start(rays, r)
                    end = ray_length(rays, r)
                    inside = 1
                    steps = 0
                    while inside == 1 and steps < MAX_CROSSED:
                        block = voxel >> 3
                        if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                            last = block
                            index = touched_index(table, table_index, voxel)
                        if index >= 0:
                            m = quantize(distance)
                            value = (ti.cast(m * weight, ti.i64) << WEIGHT_BITS) + weight
                            ti.atomic_add(frame[index, offset_in_block(voxel)], value)
                        axis = next_axis(crossing)
                        for a in ti.static(range(3)):
                            if axis == a:
                                if crossing[a] >= end:
                                    inside = 0
                                crossing[a] += interval[a]
                                voxel[a] += sign(direction[a])
                                distance -= abs(direction[a])
                        steps += 1
                    if has_color == 1:
                        hit = vec3i(rays[r, 0] >> 10, rays[r, 1] >> 10, rays[r, 2] >> 10)
                        at = touched_index(table, table_index, hit)
                        if at >= 0:
                            rgb = rays[r, 7]
                            red = ti.cast((rgb >> 16) & 255, ti.i64)
                            green = ti.cast((rgb >> 8) & 255, ti.i64)
                            blue = ti.cast(rgb & 255, ti.i64)
                            o = offset_in_block(hit)
                            ti.atomic_add(frame_color[at, o, 0], (red << 32) + green)
                            ti.atomic_add(frame_color[at, o, 1], (blue << 32) + 1)


@ti.kernel
def refuse_blocks(
    touched_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.i32,
    sign_: ti.i32,
    frame: ti.types.ndarray(dtype=ti.i64, ndim=2),
    frame_color: ti.types.ndarray(dtype=ti.i64, ndim=3),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    color_rgn: ti.types.ndarray(dtype=ti.i64, ndim=2),
    has_color: ti.i32,
) -> ti.i32:
    """How many touched blocks would leave their lanes' range: too many votes, or fewer than none."""
    refused = 0
    for run in range(count * RUN):
        if run % RUN == 0:
            i = run // RUN
            slot = touched_slots[i]
            bad = 0
            for v in range(CUBE):
                weight = sign_ * lane_weight(frame[i, v])
                votes = 0
                if has_color == 1:
                    votes = sign_ * ti.min(ti.cast(frame_color[i, v, 1] & ti.i64(4294967295), ti.i32), 1)
                colored = votes
                if slot >= 0:
                    weight += lane_weight(sums[slot, v])
                    if votes != 0:
                        colored += ti.cast(color_rgn[slot, v] & 65535, ti.i32)
                if weight < 0 or weight >= WEIGHT_LIMIT or colored < 0 or colored >= COLOR_LIMIT:
                    bad = 1
            refused += bad
    return refused


@ti.kernel
def commit_blocks(
    touched_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.i32,
    sign_: ti.i32,
    frame: ti.types.ndarray(dtype=ti.i64, ndim=2),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    dirty: ti.types.ndarray(dtype=ti.u8, ndim=1),
) -> ti.i32:
    """Add (or subtract) the keyframe's sums to the map's, one owner a block. Returns the voxels changed."""
    voxels = 0
    for run in range(count * RUN):
        if run % RUN == 0:
            i = run // RUN
            slot = touched_slots[i]
            changed = 0
            for v in range(CUBE):
                value = frame[i, v]
                if value != 0:
                    sums[slot, v] = sums[slot, v] + sign_ * value
                    changed += 1
            if changed > 0:
                dirty[slot] = ti.u8(1)
            voxels += changed
    return voxels


@ti.kernel
def commit_color(
    touched_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.i32,
    sign_: ti.i32,
    frame_color: ti.types.ndarray(dtype=ti.i64, ndim=3),
    color_rgn: ti.types.ndarray(dtype=ti.i64, ndim=2),
    color_b: ti.types.ndarray(dtype=ti.i32, ndim=2),
):
    """One vote a voxel and keyframe: the mean colour of the rays that ended in it."""
    for run in range(count * RUN):
        if run % RUN == 0:
            i = run // RUN
            slot = touched_slots[i]
            for v in range(CUBE):
                blue_n = frame_color[i, v, 1]
                n = blue_n & ti.i64(4294967295)
                if n > 0:
                    red_green = frame_color[i, v, 0]
                    red = (red_green >> 32) // n
                    green = (red_green & ti.i64(4294967295)) // n
                    blue = (blue_n >> 32) // n
                    color_rgn[slot, v] = color_rgn[slot, v] + sign_ * ((red << 40) + (green << 16) + 1)
                    color_b[slot, v] = color_b[slot, v] + sign_ * ti.cast(blue, ti.i32)
