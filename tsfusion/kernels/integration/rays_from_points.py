# SPDX-License-Identifier: MIT
"""Make rays from points, for instance of a LiDAR.

Consecutive points within a voxel of the first become one ray through their mean. With `bundle = 0` every
point is a ray. One unit of parallel work is a strip, a run of points with its own region of the ray buffer.
"""

from tsfusion.kernels import F64, U8, F32x2, F64x2, I32x2, U8x2, ti
from tsfusion.kernels.base.kernel_functions import dot, norm
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.sensor_noise import (
    MAX_RANGE,
    MIN_RANGE,
    VOXEL_SIZE,
    before_width,
    behind_width,
    bundle_weight,
    fixed_point,
    in_reach,
    noise_sigma,
    support_width,
    vec3,
    vec3f,
)
from tsfusion.kernels.base.voxel_traversal import write_ray, write_strip


@ti.func
def row(array: ti.template(), n):
    """Return row n of an array as a vector."""
    return vec3f(array[n, 0], array[n, 1], array[n, 2])


@ti.func
def transform(pose: ti.template(), q):
    """Transform point q (sensor frame, metres) by `pose` to the map's frame, in voxels."""
    p = vec3(0.0)
    for a in ti.static(range(3)):
        p[a] = dot(vec3(pose[a, 0], pose[a, 1], pose[a, 2]), q) + pose[a, 3]
    return p


# Consecutive points that become one ray: their number, Σ confidence, Σ colour, Σ position, Σ start.
Bundle = ti.types.struct(
    n=ti.i32, trust=ti.i32, red=ti.i32, green=ti.i32, blue=ti.i32, sum_q=vec3, sum_o=vec3
)


@ti.func
def confidence_at(q, o, nearest, farthest, confidence: ti.template(), has_confidence, i):
    """Return the confidence in point i at q, measured from o; 0 out of range. Ranges are squared metres."""
    found = 0
    span = dot(q - o, q - o)
    # False also for NaN
    if span > 0.0 and span >= nearest and span <= farthest:
        found = 255
        if has_confidence == 1:
            found = ti.cast(confidence[i], ti.i32)
    return found


@ti.func
def add_point(bundle: ti.template(), q, o, confident, color: ti.template(), has_color, i):
    """Add point i at q, measured from o, to a bundle: the points whose mean becomes one ray."""
    bundle.n += 1
    bundle.trust += confident
    bundle.sum_q += q
    bundle.sum_o += o
    if has_color == 1:
        bundle.blue += ti.cast(color[i, 0], ti.i32)
        bundle.green += ti.cast(color[i, 1], ti.i32)
        bundle.red += ti.cast(color[i, 2], ti.i32)


@ti.func
def write_bundle_ray(rays: ti.template(), r, first, model: ti.template(), pose: ti.template(), bundle, start):
    """Write ray `r` from `start` through the mean of a bundle of points. Returns its weight (0 if out of
    range), and the cost of its addition."""
    n = bundle.n
    mean = bundle.sum_q * (1.0 / n)
    origin, end = transform(pose, start), transform(pose, mean)
    weight, cost = 0, 0
    if in_reach(end) and in_reach(origin):
        sigma = noise_sigma(model, norm(mean - start))
        weight = bundle_weight(model, sigma, bundle.trust)
        support = support_width(model, sigma)
        behind = behind_width(model, sigma, support)
        rgb = ((bundle.red // n) << 16) | ((bundle.green // n) << 8) | (bundle.blue // n)
        direction, across = end - origin, vec3(0.0)
        before = before_width(model, support, norm(direction))
        cost = write_ray(
            rays, r, first, fixed_point(end), direction, across, before, support, behind, weight, rgb
        )
    return weight, cost


@QuickLaunch
@ti.kernel
def rays_from_points(
    points: F32x2,
    starts: F32x2,  # of the rays, sensor frame: (1, 3) or (N, 3)
    color: U8x2, has_color: ti.i32, confidence: U8, has_confidence: ti.i32,
    pose: F64x2,  # (3, 4), metres → voxels
    model: F64, bundle: ti.i32, rays: I32x2, strips: I32x2,
):  # fmt: skip
    """Fill `rays`: each run of points within a voxel of its first becomes one ray. Range is along the ray."""
    count = points.shape[0]
    own_starts = ti.select(starts.shape[0] == 1, 0, 1)
    nearest = ti.cast(model[MIN_RANGE] * model[MIN_RANGE], ti.f32)
    farthest = ti.cast(model[MAX_RANGE] * model[MAX_RANGE], ti.f32)
    spread = ti.cast(model[VOXEL_SIZE] * model[VOXEL_SIZE], ti.f32)
    for run in range(runs(strips.shape[0])):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, strips.shape[0])
        if strip < strips.shape[0]:
            first_point = ti.cast(ti.cast(strip, ti.i64) * count // strips.shape[0], ti.i32)
            last_point = ti.cast(ti.cast(strip + 1, ti.i64) * count // strips.shape[0], ti.i32)
            out, samples, total_weight, total_cost = first_point, 0, 0, ti.i64(0)
            anchor = vec3f(0.0)
            common_start = ti.cast(row(starts, 0), ti.f64)
            points_of_ray = Bundle(0, 0, 0, 0, 0, vec3(0.0), vec3(0.0))
            for i in range(first_point, last_point + 1):
                q, o, confident = vec3f(0.0), vec3f(0.0), 0
                if i < last_point:
                    q, o = row(points, i), row(starts, i * own_starts)
                    confident = confidence_at(q, o, nearest, farthest, confidence, has_confidence, i)
                n = points_of_ray.n
                ends = i == last_point
                if confident > 0 and n > 0:
                    ends = bundle == 0 or dot(q - anchor, q - anchor) > spread
                if ends and n > 0:
                    start = common_start
                    if own_starts == 1:
                        start = points_of_ray.sum_o * (1.0 / n)
                    weight, cost = write_bundle_ray(rays, out, first_point, model, pose, points_of_ray, start)
                    if weight > 0:
                        total_weight += weight
                        total_cost += cost
                        samples += n
                        out += 1
                    points_of_ray = Bundle(0, 0, 0, 0, 0, vec3(0.0), vec3(0.0))
                if confident > 0:
                    if points_of_ray.n == 0:
                        anchor = q
                    add_point(points_of_ray, q, o, confident, color, has_color, i)
            write_strip(strips, strip, first_point, out, samples, total_weight, total_cost)
