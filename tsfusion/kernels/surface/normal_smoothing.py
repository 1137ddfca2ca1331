# SPDX-License-Identifier: MIT
"""Smooth along normals: the 1-D solution of eq. 3 of the paper on the field sampled along its gradient.

Nothing is kept between keyframes. Each voxel near the surface samples the values before and behind it, and
uses the centre row of (I + λ D2ᵀD2)⁻¹ for the number of seen samples per side.
"""

from tsfusion.kernels import I32, F32x2, I32x2, ti
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.voxel_traversal import offset_in_block, vec3i, voxel_of
from tsfusion.kernels.integration.integrate import CUBE

vec3f = ti.types.vector(3, ti.f32)


@ti.func
def block_at(around: ti.template(), b, p):
    """Return the row of the block that contains voxel p (relative to block b), −1 for an absent block."""
    return around[b, ((p[0] >> 3) + 1) * 9 + ((p[1] >> 3) + 1) * 3 + (p[2] >> 3) + 1]


@ti.func
def value_at(values: ti.template(), around: ti.template(), b, p):
    """Return the value of voxel p, relative to block b; NaN if unseen."""
    row = block_at(around, b, p)
    value = ti.math.nan
    if row >= 0:
        value = values[row, offset_in_block(p)]
    return value


@ti.func
def interpolate(values: ti.template(), around: ti.template(), b, p):
    """Return the trilinear value at p, relative to block b (centres: integers); NaN if a corner is unseen."""
    low = vec3i(0)
    share = vec3f(0.0)
    for a in ti.static(range(3)):
        low[a] = ti.cast(ti.floor(p[a]), ti.i32)
        share[a] = p[a] - ti.cast(low[a], ti.f32)
    total = ti.f32(0.0)
    for c in ti.static(range(8)):
        weight = ti.f32(1.0)
        for a in ti.static(range(3)):
            weight *= ti.select(c >> a & 1 == 1, share[a], 1.0 - share[a])
        total += weight * value_at(values, around, b, low + vec3i(c & 1, c >> 1 & 1, c >> 2 & 1))
    return total


@QuickLaunch
@ti.kernel
def smooth_along_normals(
    rows: I32,  # the blocks to write; −1 = none there
    around: I32x2,  # (rows, 27): rows of `values`, −1 = none
    values: F32x2,
    reach: ti.f32,  # quanta
    centre: F32x2,  # (most + 1, most + 1): centre[n, k], k from the centre
    smoothed: F32x2,
):  # fmt: skip
    """Write `smoothed`: a copy of the values, smoothed along normals within `reach` of the surface."""
    for run in range(runs(rows.shape[0])):  # run loop: kernels/base/quick_launch.py
        r = unit_of(run, rows.shape[0])
        if r < rows.shape[0]:
            for o in range(CUBE):
                here = ti.math.nan
                if rows[r] >= 0:
                    here = values[rows[r], o]
                result = here
                if abs(here) <= reach:
                    p = voxel_of(o)
                    normal = vec3f(0.0)
                    for a in ti.static(range(3)):
                        step = vec3i(0)
                        step[a] = 1
                        normal[a] = value_at(values, around, r, p + step) - value_at(
                            values, around, r, p - step
                        )
                    length = normal.norm()
                    if length > 0.0:  # false for NaN
                        sums = ti.Vector([here, here, here, here])  # with 0 … 3 samples per side
                        for n in ti.static(range(4)):
                            sums[n] = centre[n, 0] * here
                        seen = 0
                        for k in ti.static(range(1, 4)):
                            ahead = ti.cast(p, ti.f32) + (k / length) * normal
                            behind = ti.cast(p, ti.f32) - (k / length) * normal
                            both = interpolate(values, around, r, ahead) + interpolate(
                                values, around, r, behind
                            )
                            if both == both and seen == k - 1:
                                seen = k
                                for n in ti.static(range(k, 4)):
                                    sums[n] += centre[n, k] * both
                        result = sums[0]
                        for n in ti.static(range(1, 4)):
                            if seen == n:
                                result = sums[n]
                smoothed[r, o] = result
