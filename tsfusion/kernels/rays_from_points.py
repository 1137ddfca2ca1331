# SPDX-License-Identifier: MIT
"""Rays from points, for instance of a LiDAR: consecutive points within a voxel of the first become one ray
through their mean. With `bundle = 0` every point is a ray.

One unit of parallel work is a band, a contiguous run of points with a region of the ray buffer to itself.
"""

import taichi as ti

from tsfusion.kernels.sensor_noise import (
    MAX_RANGE,
    MIN_RANGE,
    VOXEL_SIZE,
    before_width,
    bundle_weight,
    fixed_point,
    half_width,
    in_reach,
    noise_sigma,
    vec3,
    vec3f,
)
from tsfusion.kernels.voxel_traversal import RUN, write_band, write_ray


@ti.func
def row(array: ti.template(), n):
    """Row n of an array as a vector."""
    return vec3f(array[n, 0], array[n, 1], array[n, 2])


@ti.func
def transform(pose: ti.template(), q):
    """The point q (sensor frame, metres) in the map's frame, voxels."""
    p = vec3(0.0)
    for a in ti.static(range(3)):
        p[a] = pose[a, 0] * q[0] + pose[a, 1] * q[1] + pose[a, 2] * q[2] + pose[a, 3]
    return p


@ti.kernel
def rays_from_points(
    points: ti.types.ndarray(dtype=ti.f32, ndim=2),
    starts: ti.types.ndarray(dtype=ti.f32, ndim=2),  # of the rays, sensor frame: (1, 3) or (N, 3)
    color: ti.types.ndarray(dtype=ti.u8, ndim=2),
    has_color: ti.i32,
    confidence: ti.types.ndarray(dtype=ti.u8, ndim=1),
    has_confidence: ti.i32,
    pose: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (3, 4), metres → voxels
    model: ti.types.ndarray(dtype=ti.f64, ndim=1),
    bundle: ti.i32,
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
):
    """Consecutive points within a voxel of the first become one ray; range is measured along the ray."""
    count = points.shape[0]
    own_starts = ti.select(starts.shape[0] == 1, 0, 1)
    nearest = ti.cast(model[MIN_RANGE] * model[MIN_RANGE], ti.f32)
    farthest = ti.cast(model[MAX_RANGE] * model[MAX_RANGE], ti.f32)
    spread = ti.cast(model[VOXEL_SIZE] * model[VOXEL_SIZE], ti.f32)
    for run in range(bands.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            band = run // RUN
            first_point = ti.cast(ti.cast(band, ti.i64) * count // bands.shape[0], ti.i32)
            last_point = ti.cast(ti.cast(band + 1, ti.i64) * count // bands.shape[0], ti.i32)
            out = first_point
            samples = 0
            total_weight = 0
            n, trust, red, green, blue = 0, 0, 0, 0, 0
            anchor = vec3f(0.0)
            common_start = ti.cast(row(starts, 0), ti.f64)
            origin = transform(pose, common_start)
            sum_q, sum_o = vec3(0.0), vec3(0.0)
            for i in range(first_point, last_point + 1):
                q, o = vec3f(0.0), vec3f(0.0)
                confident = 255
                usable = 0
                if i < last_point:
                    q = row(points, i)
                    o = row(starts, i * own_starts)
                    span = (q - o).norm_sqr()
                    if has_confidence == 1:
                        confident = ti.cast(confidence[i], ti.i32)
                    # False for NaN as well
                    if span > 0.0 and span >= nearest and span <= farthest and confident > 0:
                        usable = 1
                ends = i == last_point
                if usable == 1 and n > 0:
                    ends = bundle == 0 or (q - anchor).norm_sqr() > spread
                if ends and n > 0:
                    share = 1.0 / n
                    mean = sum_q * share
                    start = common_start
                    if own_starts == 1:
                        start = sum_o * share
                        origin = transform(pose, start)
                    end = transform(pose, mean)
                    if in_reach(end) and in_reach(origin):
                        sigma = noise_sigma(model, (mean - start).norm())
                        weight = bundle_weight(model, sigma, trust)
                        half = half_width(model, sigma)
                        rgb = 0
                        if has_color == 1:
                            rgb = ((red // n) << 16) | ((green // n) << 8) | (blue // n)
                        ray, across = end - origin, vec3(0.0)
                        before = before_width(model, half, ray.norm())
                        write_ray(rays, out, fixed_point(end), ray, across, before, half, weight, rgb)
                        total_weight += weight
                        samples += n
                        out += 1
                    n, trust, red, green, blue = 0, 0, 0, 0, 0
                    sum_q, sum_o = vec3(0.0), vec3(0.0)
                if usable == 1:
                    if n == 0:
                        anchor = q
                    n += 1
                    trust += confident
                    sum_q += q
                    if own_starts == 1:
                        sum_o += o
                    if has_color == 1:
                        blue += ti.cast(color[i, 0], ti.i32)
                        green += ti.cast(color[i, 1], ti.i32)
                        red += ti.cast(color[i, 2], ti.i32)
            write_band(bands, band, first_point, out, samples, total_weight)
