# SPDX-License-Identifier: MIT
"""The map's signed distance between voxel centres: trilinear interpolation, and its gradient.

A point is rounded to 2⁻¹⁶ voxel. It lies between eight voxel centres, of which those count that have a share
in it: at a voxel's centre that voxel alone.
"""

import taichi as ti

from tsfusion.kernels.block_hash import map_find
from tsfusion.kernels.integrate import QUANTA_PER_VOXEL, lane_weight
from tsfusion.kernels.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.voxel_traversal import RUN, VOXEL_LIMIT, pack, vec3i
from tsfusion.kernels.voxel_values import distance_as_float

ONE = 65536.0  # of a voxel
UNKNOWN = -2  # slot of a block that was not looked up
BAND = 512  # points that one thread takes at a time

vec3f = ti.types.vector(3, ti.f32)
vec3l = ti.types.vector(3, ti.i64)
corners_i = ti.types.vector(8, ti.i32)
corners_f = ti.types.vector(8, ti.f32)


@ti.func
def place_of(points: ti.template(), n, per_metre):
    """Point n in 2⁻¹⁶ voxel from the centre of voxel (0, 0, 0), and whether a map can reach so far."""
    place = vec3l(0)
    inside = True
    for a in ti.static(range(3)):
        scaled = ti.cast(points[n, a], ti.f64) * per_metre
        inside = inside and ti.abs(scaled) < VOXEL_LIMIT - 64
        place[a] = ti.cast(ti.floor(ti.select(inside, scaled, 0.0) * ONE + 0.5), ti.i64) - 32768
    return place, inside


@ti.func
def find_near(near: ti.template(), voxel, k, map_keys: ti.template(), map_slots: ti.template()):
    """Slot of the block k away (bits: one on along x, y, z) from that of a voxel; kept in `near`."""
    if near[k] == UNKNOWN:
        key = pack((voxel[0] >> 3) + (k & 1), (voxel[1] >> 3) + (k >> 1 & 1), (voxel[2] >> 3) + (k >> 2))
        near[k] = map_find(map_keys, map_slots, map_keys.shape[0] - 1, key)
    return near[k]


@ti.func
def crossing(voxel):
    """Along which axes (bits) the voxels one on lie in the next block."""
    return (
        ti.cast((voxel[0] & 7) == 7, ti.i32)
        | ti.cast((voxel[1] & 7) == 7, ti.i32) << 1
        | ti.cast((voxel[2] & 7) == 7, ti.i32) << 2
    )


@ti.func
def corner_offset(voxel, c: ti.template()):
    """Number, in its block, of corner c (bits: one on along x, y, z) of the cell that begins at a voxel."""
    return (
        (((voxel[0] + (c & 1)) & 7) << 6)
        | (((voxel[1] + (c >> 1 & 1)) & 7) << 3)
        | ((voxel[2] + (c >> 2)) & 7)
    )


@ti.kernel
def list_blocks(
    points: ti.types.ndarray(ndim=2),
    per_metre: ti.f64,
    map_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    map_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    is_needed: ti.types.ndarray(dtype=ti.u8, ndim=1),
):
    """Mark the slots of the blocks whose voxels `interpolate` reads."""
    count = points.shape[0]
    for run in range((count + BAND - 1) // BAND * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            first = run // RUN * BAND
            last = vec3i(2147483647)
            near = corners_i(UNKNOWN)
            for n in range(first, ti.min(first + BAND, count)):
                place, inside = place_of(points, n, per_metre)
                if inside:
                    voxel = ti.cast(place >> 16, ti.i32)
                    block = voxel >> 3
                    if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                        last = block
                        near = corners_i(UNKNOWN)
                    across = crossing(voxel)
                    for k in range(8):
                        if (k & ~across) == 0:
                            slot = find_near(near, voxel, k, map_keys, map_slots)
                            if slot >= 0:
                                is_needed[slot] = ti.u8(1)


@ti.kernel
def interpolate(
    points: ti.types.ndarray(ndim=2),
    per_metre: ti.f64,
    map_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    map_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    correction: ti.types.ndarray(dtype=ti.f32, ndim=2),
    corrected: ti.i32,
    solved: ti.types.ndarray(dtype=ti.f32, ndim=2),
    row_of: ti.types.ndarray(dtype=ti.i32, ndim=1),  # of a slot; of length 0: values are those of the sums
    min_weight: ti.i32,
    distance: ti.types.ndarray(dtype=ti.f32, ndim=1),
    weight: ti.types.ndarray(dtype=ti.f32, ndim=1),
    gradient: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    """Distance in metres, weight in full samples, and gradient at every point."""
    count = points.shape[0]
    metres = ti.cast(1.0 / (per_metre * QUANTA_PER_VOXEL), ti.f32)
    for run in range((count + BAND - 1) // BAND * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            first = run // RUN * BAND
            last = vec3i(2147483647)
            near = corners_i(UNKNOWN)
            for n in range(first, ti.min(first + BAND, count)):
                place, inside = place_of(points, n, per_metre)
                voxel = ti.cast(place >> 16, ti.i32)
                block = voxel >> 3
                if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                    last = block
                    near = corners_i(UNKNOWN)
                across = crossing(voxel)
                values = corners_f(ti.math.nan)
                weights = corners_f(0.0)
                for c in ti.static(range(8)):
                    slot = -1
                    if inside:
                        slot = find_near(near, voxel, c & across, map_keys, map_slots)
                    if slot >= 0:
                        o = corner_offset(voxel, c)
                        packed = sums[slot, o]
                        w = lane_weight(packed)
                        weights[c] = ti.cast(w, ti.f32)
                        if w >= min_weight:
                            if row_of.shape[0] > 0:
                                values[c] = solved[row_of[slot], o]
                            else:
                                total = distance_as_float(packed)
                                if corrected == 1:
                                    total += correction[slot, o]
                                values[c] = total / weights[c]
                f = vec3f(0.0)
                for a in ti.static(range(3)):
                    f[a] = ti.cast(place[a] & 65535, ti.f32) * (1.0 / ONE)
                total = ti.f32(0.0)
                votes = ti.f32(0.0)
                slope = vec3f(0.0)
                for c in ti.static(range(8)):
                    x = f[0] if ti.static(c & 1) else 1.0 - f[0]
                    y = f[1] if ti.static(c >> 1 & 1) else 1.0 - f[1]
                    z = f[2] if ti.static(c >> 2) else 1.0 - f[2]
                    share = x * y * z
                    total += ti.select(share > 0.0, share * values[c], 0.0)
                    votes += share * weights[c]
                    slope[0] += ti.static(2 * (c & 1) - 1) * (y * z) * values[c]
                    slope[1] += ti.static(2 * (c >> 1 & 1) - 1) * (x * z) * values[c]
                    slope[2] += ti.static(2 * (c >> 2) - 1) * (x * y) * values[c]
                distance[n] = total * metres
                weight[n] = votes * ti.static(1.0 / WEIGHT_ONE)
                for a in ti.static(range(3)):
                    gradient[n, a] = slope[a] * ti.static(1.0 / QUANTA_PER_VOXEL)
