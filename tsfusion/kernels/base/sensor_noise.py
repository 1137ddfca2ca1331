# SPDX-License-Identifier: MIT
"""The sensor model inside kernels: the noise of a sample, and from it the weight and the band of its ray.

`model` is one float64 array of `MODEL_FIELDS` numbers, made by `ray_buffers.model_parameters` from a
`config.SensorModel` and the map's settings.
"""

import taichi as ti

from tsfusion.kernels.base.kernel_functions import product
from tsfusion.kernels.base.voxel_traversal import VOXEL_LIMIT, vec3i

MODEL_FIELDS = 13
# σ(z) = SIGMA_FLOOR + SIGMA_SLOPE · (z − SIGMA_Z0)², metres
SIGMA_FLOOR, SIGMA_SLOPE, SIGMA_Z0 = 0, 1, 2
LEAST_SUPPORT, MOST_SUPPORT = 3, 4  # how far a ray begins before its end, voxels
VOXEL_SIZE = 5  # metres
FULL_WEIGHT_SIGMA = 6  # metres: a sample with less noise has its full weight
MIN_RANGE, MAX_RANGE = 7, 8  # metres
DROPS_LONE_SAMPLES = 9  # 1 or 0
SUPPORT_PER_SIGMA = 10  # for σ = 1 m, 2⁻⁸ voxel: three σ
CARVES_SPACE = 11  # 1 or 0
LEAST_BEHIND = 12  # how far a ray reaches behind its end, voxels

WEIGHT_ONE = 16  # a full-confidence sample
MAX_BUNDLE_WEIGHT = 255  # more samples of one cell are not independent evidence
LEAST_SHARE = 1.0 / WEIGHT_ONE  # of a sample's weight stays, however noisy it is
LAYER_SIGMAS = 4.0  # samples this many σ (and a voxel) apart are not one surface
MAX_CARVED = 2048.0  # voxels
NEVER_CARVED = 16.0  # voxels in front of the sensor, where all rays meet: their lanes would soon be full

vec3 = ti.types.vector(3, ti.f64)
vec3f = ti.types.vector(3, ti.f32)


@ti.func
def noise_sigma(model: ti.template(), z):
    """Standard deviation of a sample at depth (or range) z, metres."""
    away = z - model[SIGMA_Z0]
    return model[SIGMA_FLOOR] + product(model[SIGMA_SLOPE] * away, away)


@ti.func
def bundle_weight(model: ti.template(), sigma, trust):
    """Weight of samples whose confidences (0 … 255) sum to `trust`."""
    w = product(ti.cast(trust, ti.f64), WEIGHT_ONE / 255.0)
    if sigma > model[FULL_WEIGHT_SIGMA]:
        ratio = model[FULL_WEIGHT_SIGMA] / sigma
        w = product(w, ti.max(ratio * ratio, LEAST_SHARE))
    return ti.min(ti.max(ti.cast(w + 0.5, ti.i32), 1), MAX_BUNDLE_WEIGHT)


@ti.func
def support_width(model: ti.template(), sigma):
    """Support of a ray, 2⁻⁸ voxel: three sigma, held between the preset's bounds."""
    width = ti.min(
        ti.max(sigma * model[SUPPORT_PER_SIGMA], model[LEAST_SUPPORT] * 256.0), model[MOST_SUPPORT] * 256.0
    )
    return ti.cast(width, ti.i32)


@ti.func
def behind_width(model: ti.template(), sigma, support):
    """Half-width of a ray's band, 2⁻⁸ voxel: three sigma, at least the preset's, at most the support. A wider
    band hides the other face of a thin thing; a band that ends within the noise moves the surface."""
    width = ti.max(sigma * model[SUPPORT_PER_SIGMA], model[LEAST_BEHIND] * 256.0)
    return ti.cast(ti.min(width, ti.cast(support, ti.f64)), ti.i32)


@ti.func
def before_width(model: ti.template(), support, length):
    """Distance before its end at which the ray of a point, of `length` voxels, begins, 2⁻⁸ voxel: its
    support, or with space carving its whole length but the part next to the sensor."""
    before = support
    if model[CARVES_SPACE] > 0.0:
        carved = ti.min(length, MAX_CARVED) - NEVER_CARVED
        before = ti.max(support, ti.cast(carved * 256.0, ti.i32))
    return before


@ti.func
def layer_depth(model: ti.template(), z):
    """Greatest depth step between samples of one surface, metres."""
    return model[VOXEL_SIZE] + LAYER_SIGMAS * noise_sigma(model, z)


@ti.func
def in_reach(p):
    """True if the voxels around p (voxels) have keys."""
    limit = ti.cast(VOXEL_LIMIT - 64, ti.f64)
    return ti.abs(p[0]) < limit and ti.abs(p[1]) < limit and ti.abs(p[2]) < limit


@ti.func
def fixed_point(p):
    """Position in voxels → int32 2⁻¹⁰ voxel."""
    q = vec3i(0)
    for a in ti.static(range(3)):
        q[a] = ti.cast(ti.floor(p[a] * 1024.0), ti.i32)
    return q
