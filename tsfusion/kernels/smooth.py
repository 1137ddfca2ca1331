# SPDX-License-Identifier: MIT
"""Regularised integration (paper eq. 2–3): least squares along each ray with a second-difference penalty.

    x̂ = argmin (x − y)ᵀ A (x − y) + λ ‖D2 (x − t)‖²

y: the stored values after fusing the measurement, along the voxels the ray crosses; t: those voxels'
own distances to the end point. With evenly spaced voxels D2 t = 0 and this is eq. 3; with every crossed
voxel in the signal, spacing is uneven, and without t the penalty would bend a perfect ramp.
A = I is the paper's; A = diag(W), scaled to mean 1, keeps settled voxels settled.

Two passes, never in place: each ray solves against the frozen state and adds x̂ as integers; afterwards
one owner a block writes the mean of its voxels' x̂.
"""

import taichi as ti

from tsfusion.kernels.blocks import touched_index
from tsfusion.kernels.integrate import CUBE, QUANTA_PER_VOXEL, lane_distance, lane_weight
from tsfusion.kernels.traversal import (
    MAX_CROSSED,
    RUN,
    next_axis,
    offset_in_block,
    ray_length,
    ray_start,
    ray_weight,
    sign,
)

SIGNAL_FIELDS = 5  # t, y − t and then x̂ − t, A, and the two off-diagonals of L
VOTE_SCALE = 16.0  # x̂ is averaged in sixteenths of a quantum
VOTE_BITS = 24


@ti.func
def solve_signal(signal: ti.template(), band, n, smoothness):
    """Solve (A + λ D2ᵀD2) x = A y in place by LDLᵀ: O(n), natural ends, identity for n < 3."""
    d1 = ti.f32(1.0)
    d2 = ti.f32(1.0)
    l1_1 = ti.f32(0.0)  # L[i, i−1]
    l2_1 = ti.f32(0.0)  # L[i+1, i−1]
    l2_2 = ti.f32(0.0)  # L[i, i−2]
    z1 = ti.f32(0.0)
    z2 = ti.f32(0.0)
    for i in range(n):
        starts = ti.select(i <= n - 3, 1.0, 0.0)  # rows of D2 that hold i first, second, third
        middles = ti.select(i >= 1 and i <= n - 2, 1.0, 0.0)
        ends = ti.select(i >= 2, 1.0, 0.0)
        a = signal[band, i, 2]
        diagonal = a + smoothness * (starts + 4.0 * middles + ends)
        d = diagonal - l1_1 * l1_1 * d1 - l2_2 * l2_2 * d2
        z = a * signal[band, i, 1] - l1_1 * z1 - l2_2 * z2
        l1 = (-2.0 * smoothness * (starts + middles) - l1_1 * d1 * l2_1) / d
        l2 = smoothness * starts / d
        signal[band, i, 1] = z / d
        signal[band, i, 3] = l1
        signal[band, i, 4] = l2
        d2, d1 = d1, d
        z2, z1 = z1, z
        l1_1 = l1
        l2_2, l2_1 = l2_1, l2
    x1 = ti.f32(0.0)
    x2 = ti.f32(0.0)
    for k in range(n):
        i = n - 1 - k
        x = signal[band, i, 1] - signal[band, i, 3] * x1 - signal[band, i, 4] * x2
        signal[band, i, 1] = x
        x2, x1 = x1, x


@ti.kernel
def smooth_rays(
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    band_start: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_count: ti.types.ndarray(dtype=ti.i32, ndim=1),
    table: ti.types.ndarray(dtype=ti.i64, ndim=1),
    table_index: ti.types.ndarray(dtype=ti.i32, ndim=1),
    touched_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    smoothness: ti.f32,
    weighted: ti.i32,  # A = diag(W) or I
    feedback: ti.i32,  # y from the stored regularised values, or from the raw sums
    frame: ti.types.ndarray(dtype=ti.i64, ndim=2),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    regularised: ti.types.ndarray(dtype=ti.f32, ndim=2),
    signal: ti.types.ndarray(dtype=ti.f32, ndim=3),
    crossed: ti.types.ndarray(dtype=ti.i32, ndim=3),
    votes: ti.types.ndarray(dtype=ti.i64, ndim=2),
):
    """Gather y along each ray from the map (slot ≥ 0: before this keyframe) and the keyframe's sums, solve,
    and add x̂ to `votes` as (Σ x̂ · 16) · 2²⁴ + n."""
    for run in range(band_count.shape[0] * RUN):
        if run % RUN == 0:
            band = run // RUN
            for r in range(band_start[band], band_start[band] + band_count[band]):
                if ray_weight(rays, r) > 0:
                    voxel, crossing, interval, direction, distance = ray_start(rays, r)
                    end = ray_length(rays, r)
                    n = 0
                    total = ti.f32(0.0)
                    index = -1
                    block = voxel >> 3
                    fresh = 1
                    inside = 1
                    while inside == 1 and n < MAX_CROSSED:
                        here = voxel >> 3
                        if fresh == 1 or here[0] != block[0] or here[1] != block[1] or here[2] != block[2]:
                            block = here
                            fresh = 0
                            index = touched_index(table, table_index, voxel)
                        o = offset_in_block(voxel)
                        added = frame[index, o]
                        slot = touched_slots[index]
                        w_old = ti.f32(0.0)
                        old = ti.f32(0.0)
                        if slot >= 0:
                            w_old = ti.cast(lane_weight(sums[slot, o]), ti.f32)
                            old = ti.cast(lane_distance(sums[slot, o]), ti.f32)
                            if feedback == 1:
                                old = w_old * regularised[slot, o]
                        w = w_old + ti.cast(lane_weight(added), ti.f32)
                        t = ti.cast(distance, ti.f32) * (QUANTA_PER_VOXEL / 65536.0)
                        signal[band, n, 0] = t
                        signal[band, n, 1] = (old + ti.cast(lane_distance(added), ti.f32)) / w - t
                        signal[band, n, 2] = w
                        crossed[band, n, 0] = index
                        crossed[band, n, 1] = o
                        total += w
                        n += 1
                        axis = next_axis(crossing)
                        for a in ti.static(range(3)):
                            if axis == a:
                                if crossing[a] >= end:
                                    inside = 0
                                crossing[a] += interval[a]
                                voxel[a] += sign(direction[a])
                                distance -= abs(direction[a])
                    for i in range(n):
                        signal[band, i, 2] = ti.select(weighted == 1, signal[band, i, 2] * n / total, 1.0)
                    if n >= 3:
                        solve_signal(signal, band, n, smoothness)
                    for i in range(n):
                        x = signal[band, i, 0] + signal[band, i, 1]
                        vote = ti.cast(ti.floor(x * VOTE_SCALE + 0.5), ti.i64)
                        ti.atomic_add(
                            votes[crossed[band, i, 0], crossed[band, i, 1]], (vote << VOTE_BITS) + 1
                        )


@ti.kernel
def commit_regularised(
    touched_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.i32,
    votes: ti.types.ndarray(dtype=ti.i64, ndim=2),
    regularised: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    """A voxel's value becomes the mean of what its rays propose."""
    for run in range(count * RUN):
        if run % RUN == 0:
            i = run // RUN
            for v in range(CUBE):
                packed = votes[i, v]
                if packed != 0:
                    n = ti.cast(packed & ((1 << VOTE_BITS) - 1), ti.f32)
                    regularised[touched_slots[i], v] = ti.cast(packed >> VOTE_BITS, ti.f32) / (n * VOTE_SCALE)


@ti.kernel
def reset_regularised(
    touched_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.i32,
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    regularised: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    """Fall back to the raw values Σ w·m / Σ w, where a retraction has left no smoothed ones."""
    for run in range(count * RUN):
        if run % RUN == 0:
            i = run // RUN
            slot = touched_slots[i]
            for v in range(CUBE):
                w = lane_weight(sums[slot, v])
                value = ti.f32(0.0)
                if w > 0:
                    value = ti.cast(lane_distance(sums[slot, v]), ti.f32) / ti.cast(w, ti.f32)
                regularised[slot, v] = value
