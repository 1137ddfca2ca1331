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
from tsfusion.kernels.quick_launch import QuickLaunch
from tsfusion.kernels.voxel_traversal import (
    COUNT,
    MAX_CROSSED,
    RUN,
    START,
    advance,
    begin_walk,
    block_key,
    next_step,
    offset_in_block,
    ray_length,
    ray_weight,
    vec3i,
)

LANES = 8  # rays that are solved side by side, in vectors: a step of one waits for three divisions
# Element i of lane k of a band's field stands at (band · FIELDS + field) · SIGNAL + i · LANES + k.
SIGNAL = MAX_CROSSED * LANES
SIGNAL_FIELDS = 4  # Σ w·m and then z, W, and the two off-diagonals of L
STORED, WEIGHT, LEFT, FAR_LEFT = 0, SIGNAL, 2 * SIGNAL, 3 * SIGNAL
CROSSED_FIELDS = 3  # t and then the vote, place of the block, voxel in it
DISTANCE, PLACE, OFFSET = 0, SIGNAL, 2 * SIGNAL
QUANTA = QUANTA_PER_VOXEL / 65536.0  # a unit of distance
VOTE_SCALE = 16.0  # x̂ is averaged in sixteenths of a quantum
VOTE_BITS = 24


@ti.func
def factorise(
    signal: ti.template(), crossed: ti.template(), at_signal, at_crossed, n: ti.template(),
    total: ti.template(), longest, weighted, smoothness,
):  # fmt: skip
    """Solve L D z = A (y − t) of A + λ D2ᵀD2 = L D Lᵀ, with natural ends, for signals of n elements a lane
    with weights that sum to `total`; z is y − t where n < 3.

    What is read and written goes through arrays of the function, which no store to an argument may change:
    so the lanes become vectors.
    """
    d1, d2 = ti.Vector([1.0] * LANES), ti.Vector([1.0] * LANES)
    l1_1, l2_1, l2_2 = ti.Vector([0.0] * LANES), ti.Vector([0.0] * LANES), ti.Vector([0.0] * LANES)
    z1, z2, z = ti.Vector([0.0] * LANES), ti.Vector([0.0] * LANES), ti.Vector([0.0] * LANES)
    t, y, w = ti.Vector([0] * LANES), ti.Vector([0.0] * LANES), ti.Vector([0.0] * LANES)
    for i in range(longest):
        at = at_signal + i * LANES
        for k in range(LANES):
            w[k], y[k] = signal[at + WEIGHT + k], signal[at + STORED + k]
            t[k] = crossed[at_crossed + DISTANCE + i * LANES + k]
        for k in range(LANES):
            starts = ti.select(i <= n[k] - 3, 1.0, 0.0)  # rows of D2 that hold i first, second, third
            middles = ti.select((i >= 1) & (i <= n[k] - 2), 1.0, 0.0)
            ends = ti.select(i >= 2, 1.0, 0.0)
            off = y[k] / w[k] - ti.cast(t[k], ti.f32) * QUANTA
            a = ti.select(weighted == 1, w[k] * n[k] / total[k], 1.0)
            diagonal = a + smoothness * (starts + 4.0 * middles + ends)
            d = diagonal - l1_1[k] * l1_1[k] * d1[k] - l2_2[k] * l2_2[k] * d2[k]
            here = a * off - l1_1[k] * z1[k] - l2_2[k] * z2[k]
            left = (-2.0 * smoothness * (starts + middles) - l1_1[k] * d1[k] * l2_1[k]) / d
            z[k] = ti.select(n[k] >= 3, here / d, off)
            d2[k] = d1[k]
            d1[k] = d
            z2[k] = z1[k]
            z1[k] = here
            l1_1[k] = left  # L[i, i−1]
            l2_2[k] = l2_1[k]  # L[i, i−2]
            l2_1[k] = smoothness * starts / d  # L[i+1, i−1]
        for k in range(LANES):
            signal[at + STORED + k] = z[k]
            signal[at + LEFT + k] = l1_1[k]
            signal[at + FAR_LEFT + k] = l2_1[k]


@ti.func
def substitute_back(
    signal: ti.template(), crossed: ti.template(), at_signal, at_crossed, n: ti.template(), longest
):
    """Solve Lᵀ (x̂ − t) = z, a lane each, and put ⌊16 x̂ + ½⌋ in the place of t.

    What stands behind a lane's end counts for nothing.
    """
    x1, x2, votes = ti.Vector([0.0] * LANES), ti.Vector([0.0] * LANES), ti.Vector([0] * LANES)
    for back in range(longest):
        i = longest - 1 - back
        at = at_signal + i * LANES
        for k in range(LANES):
            x = signal[at + STORED + k] - signal[at + LEFT + k] * x1[k] - signal[at + FAR_LEFT + k] * x2[k]
            x = ti.select(i < n[k], x, 0.0)
            t = ti.cast(crossed[at_crossed + DISTANCE + i * LANES + k], ti.f32) * QUANTA
            vote = (t + x) * VOTE_SCALE + 0.5
            low = ti.cast(vote, ti.i32)
            votes[k] = low - ti.cast(ti.cast(low, ti.f32) > vote, ti.i32)
            x2[k] = x1[k]
            x1[k] = x
        for k in range(LANES):
            crossed[at_crossed + DISTANCE + i * LANES + k] = votes[k]


@QuickLaunch
@ti.kernel
def smooth_rays(
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
    hash_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    hash_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),
    smoothness: ti.f32,
    weighted: ti.i32,  # A = diag(W), scaled to mean 1, or I
    feedback: ti.i32,  # y from the stored regularised values, or from the raw sums
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    correction: ti.types.ndarray(dtype=ti.f32, ndim=2),
    signal: ti.types.ndarray(dtype=ti.f32, ndim=1),
    crossed: ti.types.ndarray(dtype=ti.i32, ndim=1),
    votes: ti.types.ndarray(dtype=ti.i64, ndim=2),
):
    """Gather y along each ray, solve, and add x̂ to `votes` as (Σ x̂ · 16) · 2²⁴ + n."""
    hash_mask = hash_keys.shape[0] - 1
    for run in range(bands.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            band = run // RUN
            last, slot, place = vec3i(2147483647), -1, -1
            first, end = bands[band, START], bands[band, START] + bands[band, COUNT]
            at_signal, at_crossed = band * SIGNAL_FIELDS * SIGNAL, band * CROSSED_FIELDS * SIGNAL
            counts, totals = ti.Vector([0] * LANES), ti.Vector([0.0] * LANES)
            while first < end:
                longest = 0
                for k in range(LANES):
                    r, n, total = first + k, 0, ti.f32(0.0)
                    inside = 0
                    if r < end:
                        inside = ti.cast(ray_weight(rays, r) > 0, ti.i32)
                    if inside == 1:
                        walk = begin_walk(rays, r)
                        length = ray_length(rays, r)[0]
                        while inside == 1 and n < MAX_CROSSED:
                            block = walk.voxel >> 3
                            if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                                last = block
                                slot = map_find(hash_keys, hash_slots, hash_mask, block_key(walk.voxel))
                                place = places[slot]
                            o = offset_in_block(walk.voxel)
                            packed = sums[slot, o]
                            weight = ti.cast(lane_weight(packed), ti.f32)
                            stored = ti.cast(lane_distance(packed), ti.f32)
                            if feedback == 1:
                                stored += correction[slot, o]
                            signal[at_signal + STORED + n * LANES + k] = stored
                            signal[at_signal + WEIGHT + n * LANES + k] = weight
                            crossed[at_crossed + DISTANCE + n * LANES + k] = walk.distance
                            crossed[at_crossed + PLACE + n * LANES + k] = place
                            crossed[at_crossed + OFFSET + n * LANES + k] = o
                            total += weight
                            n += 1
                            step, next_crossing = next_step(walk.crossing)
                            if next_crossing >= length:
                                inside = 0
                            advance(walk, step)
                    counts[k], totals[k] = n, total
                    longest = ti.max(longest, n)
                factorise(
                    signal, crossed, at_signal, at_crossed, counts, totals, longest, weighted, smoothness
                )
                substitute_back(signal, crossed, at_signal, at_crossed, counts, longest)
                for k in range(LANES):
                    for i in range(counts[k]):
                        at = at_crossed + i * LANES + k
                        vote = (ti.cast(crossed[at + DISTANCE], ti.i64) << VOTE_BITS) + 1
                        ti.atomic_add(votes[crossed[at + PLACE], crossed[at + OFFSET]], vote)
                first += LANES


@QuickLaunch
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
