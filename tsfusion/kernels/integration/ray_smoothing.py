# SPDX-License-Identifier: MIT
"""Smooth the map along each ray: least squares with a second-difference penalty (paper eq. 2–3).

    x̂ = argmin (x − y)ᵀ A (x − y) + λ ‖D2 (x − t)‖²

y are the stored values along the voxels that the ray crosses, after the measurement is fused. t are those
voxels' own distances to the end point. With evenly spaced voxels D2 t = 0, and this is eq. 3. Here every
crossed voxel is in the signal, so the spacing is uneven. Without t the penalty would bend a perfect ramp.
A = I is the paper's choice. A = diag(W), scaled to mean 1, moves voxels of large weight little.

Two passes, never in place: first each ray solves with the unchanged values and adds x̂ as integers. Then each
voxel with votes gets the mean of its x̂.
"""

from tsfusion.kernels import F32, I32, I64, I32x2, ti
from tsfusion.kernels.base.block_hash import map_find
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.voxel_traversal import (
    COUNT,
    MAX_CROSSED,
    START,
    UNIT,
    pack,
    ray_weight,
    voxel_of,
)
from tsfusion.kernels.integration.integrate import (
    CUBE,
    QUANTA_PER_VOXEL,
    TOUCHED_HEADER,
    UNIT_SCRATCH,
    lane_distance,
    lane_weight,
)
from tsfusion.kernels.integration.rays_abreast import (
    ABREAST,
    BAND,
    BLOCK_AT,
    FREE,
    HALF_A_QUANTUM,
    LIST,
    NOBODY,
    ODD,
    RAY,
    STRETCH,
    UNKNOWN,
    VOXELS,
    WALKS,
    WINDOW_AT,
    WINDOW_BITS,
    WINDOW_BLOCKS,
    WINDOWS,
    begin,
    measure,
    open_window,
    walk,
    window_of,
)

LANES = ABREAST  # rays solved together, in vectors: a step of a single ray waits for three divisions
# Element i of lane k of a unit's field has the index (unit · FIELDS + field) · SIGNAL + i · LANES + k.
SIGNAL = MAX_CROSSED * LANES
SIGNAL_FIELDS = 4  # Σ w·m and then z, W, and the two off-diagonals of L
STORED, WEIGHT, LEFT, FAR_LEFT = 0, SIGNAL, 2 * SIGNAL, 3 * SIGNAL
CROSSED_FIELDS = 2  # t, later the vote; index of the voxel in `votes`
DISTANCE, PLACE = 0, SIGNAL
QUANTA = 2.0**-16  # a unit of t
VOTE_SCALE = 16.0  # x̂ is averaged in sixteenths of a quantum
VOTE_BITS = 24
CHUNK = 512  # entries of the list of voted voxels that a unit reserves per step
NO_VOXEL = -1  # marks an unused entry


@ti.func
def factorise(
    signal: ti.template(), crossed: ti.template(), at_signal, at_crossed, n: ti.template(),
    total: ti.template(), longest, weighted, smoothness,
):  # fmt: skip
    """Factorise and solve forwards, for eight signals of `n` elements each: L D z = A (y − t), where L D Lᵀ
    is A + λ D2ᵀD2 with natural ends. The weights of a signal sum to `total`; z is y − t where n < 3.

    Reads and writes use local arrays, which no store to an argument can change: so lanes become vectors.
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
    """Solve backwards for each of eight signals, Lᵀ (x̂ − t) = z, and write ⌊16 x̂ + ½⌋ in place of t.

    Elements after a signal's end are ignored.
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


@ti.func
def list_voxels(
    walks: ti.template(), k, listed: ti.template(), distances: ti.template(), hash_keys: ti.template(),
    hash_slots: ti.template(), scratch: ti.template(), base, places: ti.template(), voxels: ti.template(),
    crossed: ti.template(), at_crossed, counts: ti.template(),
):  # fmt: skip
    """Append the next voxels of the ray in lane `k` to `crossed`, the list of all voxels in its band."""
    number = walks[ODD + k]
    window = window_of(walks, k, number)
    blocks = open_window(window, scratch, base)
    n = counts[k]
    end = ti.min(walks[VOXELS + k], STRETCH)
    i = walks[FREE + k]
    while i < end and n < MAX_CROSSED:
        place = listed[i * ABREAST + k]
        if ((place >> WINDOW_AT) & 7) != number:
            number = (place >> WINDOW_AT) & 7
            window = window_of(walks, k, number)
            blocks = open_window(window, scratch, base)
        b = (place >> BLOCK_AT) & (WINDOW_BLOCKS - 1)
        corners = scratch[blocks + b]  # index of the block in `votes`, above its index in the map's layers
        if corners == UNKNOWN:
            block = (window << (WINDOW_BITS - 3)) + voxel_of(b)
            key = pack(block[0], block[1], block[2])
            slot = map_find(hash_keys, hash_slots, hash_keys.shape[0] - 1, key)
            corners = (ti.cast(places[slot] * CUBE, ti.i64) << 32) | (slot * CUBE)
            scratch[blocks + b] = corners
        o = place & (CUBE - 1)
        voxels[n * LANES + k] = ti.cast(corners, ti.i32) + o
        crossed[at_crossed + DISTANCE + n * LANES + k] = distances[i * ABREAST + k] - HALF_A_QUANTUM
        crossed[at_crossed + PLACE + n * LANES + k] = ti.cast(corners >> 32, ti.i32) + o
        n += 1
        i += 1
    counts[k] = n


@ti.func
def gather(
    voxels: ti.template(), counts: ti.template(), totals: ti.template(), feedback, sums: ti.template(),
    correction: ti.template(), signal: ti.template(), at_signal,
):  # fmt: skip
    """Copy the map's values at the voxels that each ray crosses into the ray's signal y.

    A separate pass lets a processor wait for more values at once (`integrate.add_updates`).
    """
    for k in range(LANES):
        total = 0.0
        for i in range(counts[k]):
            at = voxels[i * LANES + k]
            packed = sums[at]
            weight = ti.cast(lane_weight(packed), ti.f32)
            stored = ti.cast(lane_distance(packed), ti.f32)
            if feedback == 1:
                stored += correction[at]
            signal[at_signal + STORED + i * LANES + k] = stored
            signal[at_signal + WEIGHT + i * LANES + k] = weight
            total += weight
        totals[k] = total


@QuickLaunch
@ti.kernel
def smooth_rays(
    rays: I32x2, strips: I32x2, units: ti.i32, hash_keys: I64, hash_slots: I32, scratch: I64, places: I32,
    smoothness: ti.f32,
    weighted: ti.i32,  # A = diag(W), scaled to mean 1, or I
    feedback: ti.i32,  # y from the stored regularised values, or from the raw sums
    sums: I64, correction: F32, signal: F32, crossed: I32, votes: I64, voted: I32,
):  # fmt: skip
    """Smooth the values y along each ray's band (first pass): add the solutions x̂ per voxel to `votes`, as
    (Σ x̂ · 16) · 2²⁴ + n, for `commit_votes`.

    `units` run in parallel, each through its own strips of rays. Layers are flat, as for `add_rays`. `voted`
    has the length of the list of voxels with votes, then their indices in `votes`, or `NO_VOXEL`; each unit
    reserves `CHUNK` entries per step.
    """
    for run in range(runs(units)):  # run loop: kernels/base/quick_launch.py
        unit = unit_of(run, units)
        if unit < units:
            base, at_signal = unit * UNIT_SCRATCH, unit * SIGNAL_FIELDS * SIGNAL
            at_crossed = unit * CROSSED_FIELDS * SIGNAL
            for i in range(WINDOWS):
                scratch[base + i] = 0
            walks = ti.Vector([0] * WALKS)
            listed, distances = ti.Vector([0] * LIST), ti.Vector([0] * LIST)
            voxels = ti.Vector([0] * SIGNAL)  # in the layers; later, in `votes`, voxels with a first vote
            counts, totals = ti.Vector([0] * LANES), ti.Vector([0.0] * LANES)
            carves, here, chunk_end = 0, 0, 0
            for strip in range(strips.shape[0]):
                r, end = strips[strip, START], strips[strip, START] + strips[strip, COUNT]
                if strips[strip, UNIT] != unit:
                    r = end
                while r < end:
                    for k in range(LANES):
                        walks[RAY + k], counts[k] = NOBODY, 0
                    walking, longest = 0, 0
                    while walking < LANES and r < end:
                        if ray_weight(rays, r) > 0:
                            begin(rays, r, QUANTA_PER_VOXEL, 0, walks, walking)
                            walks[FREE + walking] = 0
                            carves |= ti.cast(walks[BAND + walking] > 0, ti.i32)
                            walking += 1
                        r += 1
                    while walking > 0:
                        count = ti.min(measure(walks, carves, 0), STRETCH)
                        walk(walks, count, listed, distances, True)
                        for k in range(LANES):
                            if walks[RAY + k] != NOBODY:
                                list_voxels(
                                    walks, k, listed, distances, hash_keys, hash_slots, scratch, base,
                                    places, voxels, crossed, at_crossed, counts,
                                )  # fmt: skip
                                longest = ti.max(longest, counts[k])
                                if walks[VOXELS + k] <= STRETCH or counts[k] == MAX_CROSSED:
                                    walks[RAY + k] = NOBODY
                                    walking -= 1
                    gather(voxels, counts, totals, feedback, sums, correction, signal, at_signal)
                    factorise(
                        signal, crossed, at_signal, at_crossed, counts, totals, longest, weighted, smoothness
                    )
                    substitute_back(signal, crossed, at_signal, at_crossed, counts, longest)
                    first_votes = 0
                    for k in range(LANES):
                        for i in range(counts[k]):
                            at = at_crossed + i * LANES + k
                            vote = (ti.cast(crossed[at + DISTANCE], ti.i64) << VOTE_BITS) + 1
                            voxel = crossed[at + PLACE]
                            before = votes[voxel]
                            if units == 1:  # an atomic addition would wait for the memory
                                votes[voxel] = before + vote
                            else:
                                before = ti.atomic_add(votes[voxel], vote)
                            voxels[first_votes] = voxel
                            first_votes += ti.cast(before == 0, ti.i32)  # a branch would wait for memory
                    for i in range(first_votes):
                        if here == chunk_end:
                            here = 1 + ti.atomic_add(voted[0], CHUNK)
                            chunk_end = here + CHUNK
                        voted[here] = voxels[i]
                        here += 1
            for i in range(here, chunk_end):
                voted[i] = NO_VOXEL


@QuickLaunch
@ti.kernel
def commit_votes(touched: I32, sums: I64, votes: I64, voted: I32, correction: F32):
    """Set each voxel's value (Σ w·m + correction) / Σ w to the mean of its `votes`, and clear the votes."""
    for i in range(voted[0]):
        place = voted[1 + i]
        if place != NO_VOXEL:
            vote = votes[place]
            votes[place] = 0
            at = touched[TOUCHED_HEADER + place // CUBE] * CUBE + place % CUBE
            packed = sums[at]
            n = ti.cast(vote & ((1 << VOTE_BITS) - 1), ti.f64)
            x = ti.cast(vote >> VOTE_BITS, ti.f64) / (n * VOTE_SCALE)
            moved = x * lane_weight(packed) - ti.cast(lane_distance(packed), ti.f64)
            correction[at] = ti.cast(moved, ti.f32)
