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

from tsfusion.kernels.block_hash import map_find
from tsfusion.kernels.integrate import (
    CUBE,
    QUANTA_PER_VOXEL,
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    lane_distance,
    lane_weight,
)
from tsfusion.kernels.voxel_traversal import (
    COUNT,
    LENGTH,
    MAX_CROSSED,
    RUN,
    START,
    advance,
    begin_walk,
    block_key,
    next_step,
    offset_in_block,
    ray_weight,
    vec3i,
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


@ti.func
def read_signal(
    signal: ti.template(),
    band,
    i,
    distance,
    slot,
    o,
    feedback,
    sums: ti.template(),
    correction: ti.template(),
):
    """Read t, y − t and W of a crossed voxel, element i of a ray's signal. Returns W."""
    packed = sums[slot, o]
    w = ti.cast(lane_weight(packed), ti.f32)
    s = ti.cast(lane_distance(packed), ti.f32)
    if feedback == 1:
        s += correction[slot, o]
    t = ti.cast(distance, ti.f32) * (QUANTA_PER_VOXEL / 65536.0)
    signal[band, i, 0] = t
    signal[band, i, 1] = s / w - t
    signal[band, i, 2] = w
    return w


@ti.kernel
def smooth_rays(
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
    hash_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    hash_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),
    smoothness: ti.f32,
    weighted: ti.i32,  # A = diag(W) or I
    feedback: ti.i32,  # y from the stored regularised values, or from the raw sums
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    correction: ti.types.ndarray(dtype=ti.f32, ndim=2),
    signal: ti.types.ndarray(dtype=ti.f32, ndim=3),
    crossed: ti.types.ndarray(dtype=ti.i32, ndim=3),
    votes: ti.types.ndarray(dtype=ti.i64, ndim=2),
):
    """Gather y along each ray, solve, and add x̂ to `votes` as (Σ x̂ · 16) · 2²⁴ + n."""
    hash_mask = hash_keys.shape[0] - 1
    for run in range(bands.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            band = run // RUN
            last = vec3i(2147483647)
            slot = -1
            for r in range(bands[band, START], bands[band, START] + bands[band, COUNT]):
                if ray_weight(rays, r) > 0:
                    walk = begin_walk(rays, r)
                    n = 0
                    total = ti.f32(0.0)
                    inside = 1
                    while inside == 1 and n < MAX_CROSSED:
                        block = walk.voxel >> 3
                        if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                            last = block
                            slot = map_find(hash_keys, hash_slots, hash_mask, block_key(walk.voxel))
                        o = offset_in_block(walk.voxel)
                        total += read_signal(
                            signal, band, n, walk.distance, slot, o, feedback, sums, correction
                        )
                        crossed[band, n, 0] = places[slot]
                        crossed[band, n, 1] = o
                        n += 1
                        step, next_crossing = next_step(walk.crossing)
                        if next_crossing >= rays[r, LENGTH]:
                            inside = 0
                        advance(walk, step)
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
def commit_votes(
    touched: ti.types.ndarray(dtype=ti.i32, ndim=1),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    votes: ti.types.ndarray(dtype=ti.i64, ndim=2),
    correction: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    """A voxel's value (Σ w·m + correction) / Σ w becomes the mean that its rays propose; clears `votes`."""
    count = touched[TOUCHED_COUNT]
    for run in range(count * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            i = run // RUN
            slot = touched[TOUCHED_HEADER + i]
            for v in range(CUBE):
                vote = votes[i, v]
                if vote != 0:
                    packed = sums[slot, v]
                    n = ti.cast(vote & ((1 << VOTE_BITS) - 1), ti.f64)
                    x = ti.cast(vote >> VOTE_BITS, ti.f64) / (n * VOTE_SCALE)
                    moved = x * lane_weight(packed) - ti.cast(lane_distance(packed), ti.f64)
                    correction[slot, v] = ti.cast(moved, ti.f32)
                    votes[i, v] = 0
