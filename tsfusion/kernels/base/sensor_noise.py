# SPDX-License-Identifier: MIT
"""Model sensor noise inside kernels: from a sample's noise follow the weight and the band of its ray.

`model` is one float64 array of `MODEL_FIELDS` numbers, from `ray_buffers.model_parameters`. Its inputs are a
`config.SensorModel` and the map's settings.
"""

from tsfusion.kernels import ti
from tsfusion.kernels.base.kernel_functions import product
from tsfusion.kernels.base.voxel_traversal import VOXEL_LIMIT, vec3i

MODEL_FIELDS = 13
# σ(z) = SIGMA_FLOOR + SIGMA_SLOPE · (z − SIGMA_Z0)², metres
SIGMA_FLOOR, SIGMA_SLOPE, SIGMA_Z0 = 0, 1, 2
LEAST_SUPPORT, MOST_SUPPORT = 3, 4  # limits of the distance before its end at which a ray begins, voxels
VOXEL_SIZE = 5  # metres
FULL_WEIGHT_SIGMA = 6  # metres: a sample with less noise has full weight
MIN_RANGE, MAX_RANGE = 7, 8  # metres
DROPS_LONE_SAMPLES = 9  # 1 or 0
SUPPORT_PER_SIGMA = 10  # for σ = 1 m, 2⁻⁸ voxel: three σ
CARVES_SPACE = 11  # 1 or 0
LEAST_BEHIND = 12  # smallest distance to which a ray reaches behind its end, voxels

WEIGHT_ONE = 16  # a full-confidence sample
MAX_BUNDLE_WEIGHT = 255  # more samples in one cell are not independent evidence
LEAST_SHARE = 1.0 / WEIGHT_ONE  # share of a sample's weight that noise cannot remove
LAYER_SIGMAS = 4.0  # samples farther apart than this many σ (and a voxel) are on different surfaces
MAX_CARVED = 2048.0  # voxels
NEVER_CARVED = 16.0  # voxels ahead of the sensor, where all rays meet: their lanes would soon be full

vec3 = ti.types.vector(3, ti.f64)
vec3f = ti.types.vector(3, ti.f32)


@ti.func
def noise_sigma(model: ti.template(), z):
    """Return the standard deviation of a sample at depth (or range) z, metres."""
    away = z - model[SIGMA_Z0]
    return model[SIGMA_FLOOR] + product(model[SIGMA_SLOPE] * away, away)


@ti.func
def bundle_weight(model: ti.template(), sigma, trust):
    """Return the weight of samples whose confidences (0 … 255) sum to `trust`."""
    w = product(ti.cast(trust, ti.f64), WEIGHT_ONE / 255.0)
    if sigma > model[FULL_WEIGHT_SIGMA]:
        ratio = model[FULL_WEIGHT_SIGMA] / sigma
        w = product(w, ti.max(ratio * ratio, LEAST_SHARE))
    return ti.min(ti.max(ti.cast(w + 0.5, ti.i32), 1), MAX_BUNDLE_WEIGHT)


@ti.func
def support_width(model: ti.template(), sigma):
    """Return the support of a ray (how far before its end it begins), 2⁻⁸ voxel: three sigma, bounded."""
    width = ti.min(
        ti.max(sigma * model[SUPPORT_PER_SIGMA], model[LEAST_SUPPORT] * 256.0), model[MOST_SUPPORT] * 256.0
    )
    return ti.cast(width, ti.i32)


@ti.func
def behind_width(model: ti.template(), sigma, support):
    """Return the half-width of a ray's band, 2⁻⁸ voxel: three sigma, but at least the preset's and at most
    the support. A wider band hides backs of thin objects. A band that ends in noise moves the surface."""
    width = ti.max(sigma * model[SUPPORT_PER_SIGMA], model[LEAST_BEHIND] * 256.0)
    return ti.cast(ti.min(width, ti.cast(support, ti.f64)), ti.i32)


@ti.func
def before_width(model: ti.template(), support, length):
    """Return the distance before its end at which a point's ray of `length` voxels begins, 2⁻⁸ voxel. It is
    the support, or with space carving the whole length except the part next to the sensor."""
    before = support
    if model[CARVES_SPACE] > 0.0:
        carved = ti.min(length, MAX_CARVED) - NEVER_CARVED
        before = ti.max(support, ti.cast(carved * 256.0, ti.i32))
    return before


@ti.func
def layer_depth(model: ti.template(), z):
    """Return the largest depth step, metres, between neighbouring samples of one surface at depth z."""
    return model[VOXEL_SIZE] + LAYER_SIGMAS * noise_sigma(model, z)


@ti.func
def in_reach(p):
    """Return True if the voxels around p (voxels) have keys: coordinates within ±2²⁰."""
    limit = ti.cast(VOXEL_LIMIT - 64, ti.f64)
    return ti.abs(p[0]) < limit and ti.abs(p[1]) < limit and ti.abs(p[2]) < limit


@ti.func
def fixed_point(p):
    """Convert a position in voxels to int32 2⁻¹⁰ voxel."""
    q = vec3i(0)
    for a in ti.static(range(3)):
        q[a] = ti.cast(ti.floor(p[a] * 1024.0), ti.i32)
    return q
