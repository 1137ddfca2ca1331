# SPDX-License-Identifier: MIT
"""What the sensor model says of a sample: its noise, and with it the weight and the band of its ray."""

import taichi as ti

from tsfusion.kernels.voxel_traversal import VOXEL_LIMIT, vec3i

WEIGHT_ONE = 16  # a full-confidence sample
MAX_BUNDLE_WEIGHT = 255  # more samples of one cell are not independent evidence
LEAST_SHARE = 1.0 / WEIGHT_ONE  # of a sample's weight stays, however noisy it is
LAYER_SIGMAS = 4.0  # samples this many σ (and a voxel) apart are not one surface

# `model`: σ floor, σ slope, σ z0, least and most half-width (voxels), voxel size, σ below which the weight is
# full, least and most range, whether lone samples are dropped, three σ of 1 m in 2⁻⁸ voxel, whether the space
# before the band is carved. See config.SensorModel.
MAX_CARVED = 2048.0  # voxels
NEVER_CARVED = 16.0  # voxels in front of the sensor, where all rays meet: their lanes would soon be full

vec3 = ti.types.vector(3, ti.f64)
vec3f = ti.types.vector(3, ti.f32)


@ti.func
def noise_sigma(model: ti.template(), z):
    return model[0] + model[1] * (z - model[2]) * (z - model[2])


@ti.func
def bundle_weight(model: ti.template(), sigma, trust):
    """Weight of samples whose confidences (0 … 255) sum to `trust`."""
    w = ti.cast(trust, ti.f64) * (WEIGHT_ONE / 255.0)
    if sigma > model[6]:
        ratio = model[6] / sigma
        w *= ti.max(ratio * ratio, LEAST_SHARE)
    return ti.min(ti.max(ti.cast(w + 0.5, ti.i32), 1), MAX_BUNDLE_WEIGHT)


@ti.func
def half_width(model: ti.template(), sigma):
    """Support half-width, 2⁻⁸ voxel: three sigma, held between the preset's bounds."""
    width = ti.min(ti.max(sigma * model[10], model[3] * 256.0), model[4] * 256.0)
    return ti.cast(width, ti.i32)


@ti.func
def before_width(model: ti.template(), half, length):
    """How far before its end a ray of `length` voxels begins, 2⁻⁸ voxel: its band, or nearly all."""
    before = half
    if model[11] > 0.0:
        before = ti.max(half, ti.cast((ti.min(length, MAX_CARVED) - NEVER_CARVED) * 256.0, ti.i32))
    return before


@ti.func
def layer_depth(model: ti.template(), z):
    """How far apart in depth samples of one surface may be, metres."""
    return model[5] + LAYER_SIGMAS * noise_sigma(model, z)


@ti.func
def in_reach(p):
    limit = ti.cast(VOXEL_LIMIT - 64, ti.f64)
    return ti.abs(p[0]) < limit and ti.abs(p[1]) < limit and ti.abs(p[2]) < limit


@ti.func
def fixed_point(p):
    """Position in voxels → int32 2⁻¹⁰ voxel."""
    q = vec3i(0)
    for a in ti.static(range(3)):
        q[a] = ti.cast(ti.floor(p[a] * 1024.0), ti.i32)
    return q
