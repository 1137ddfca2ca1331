# SPDX-License-Identifier: MIT
"""Rays of images and points on a device of many threads: those that `rays_from_images` and `rays_from_points`
make, to the bit, a thread a pixel or point.

Rays have fixed places, so a band's rays do not follow each other: a place without a ray has weight 0.
"""

import taichi as ti

from tsfusion.kernels.device_integration import begin_keyframe
from tsfusion.kernels.quick_launch import QuickLaunch
from tsfusion.kernels.rays_from_images import (
    TILE,
    TILE_SAMPLES,
    Cell,
    Plane,
    camera_of,
    cell_shape,
    depth_at,
    is_supported,
    nearest_layer,
    pixel_width,
    reading_of,
    tile_plane,
    write_layer_ray,
)
from tsfusion.kernels.rays_from_points import (
    Bundle,
    add_point,
    confidence_at,
    row,
    write_bundle_ray,
)
from tsfusion.kernels.sensor_noise import DROPS_LONE_SAMPLES, MAX_RANGE, MIN_RANGE, VOXEL_SIZE, vec3, vec3f
from tsfusion.kernels.unfused import dot
from tsfusion.kernels.voxel_traversal import COST, COUNT, SAMPLES, START, WEIGHT, WEIGHT_COLOR

# A tile: width and height of its cells, whether it is flat, and the slopes of its plane (float32's bits).
TILE_FIELDS = 8
WIDE, HIGH, FLAT, SLOPE_X, SLOPE_Y = 0, 1, 2, 3, 4


@ti.func
def note_rays(bands: ti.template(), band, count, samples, weight, cost):
    """Count rays of a band: not inside a loop within a thread (`device_integration.add_rays`)."""
    ti.atomic_add(bands[band, COUNT], count)
    ti.atomic_add(bands[band, SAMPLES], samples)
    ti.atomic_add(bands[band, WEIGHT], weight)
    ti.atomic_add(bands[band, COST], cost)


@QuickLaunch
@ti.kernel
def rays_from_image(
    image: ti.types.ndarray(ndim=2),
    is_disparity: ti.i32,
    scale: ti.f64,
    color: ti.types.ndarray(dtype=ti.u8, ndim=2),
    has_color: ti.i32,
    confidence: ti.types.ndarray(dtype=ti.u8, ndim=2),
    has_confidence: ti.i32,
    camera_rows: ti.types.ndarray(dtype=ti.f64, ndim=2),
    model: ti.types.ndarray(dtype=ti.f64, ndim=1),
    bundle: ti.i32,
    depths: ti.types.ndarray(dtype=ti.i32, ndim=1),  # of each tile's pixels, one tile after the other
    tiles: ti.types.ndarray(dtype=ti.i32, ndim=2),
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
    launch_counts: ti.types.ndarray(dtype=ti.i64, ndim=1),
    touched: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Fill `rays` as `rays_from_images.rays_from_image` does, and begin a keyframe; a tile has `TILE_SAMPLES`
    places."""
    tiles_x = (image.shape[1] + TILE - 1) // TILE
    tile_count = tiles_x * ((image.shape[0] + TILE - 1) // TILE)
    count = bands.shape[0]
    for i in range(tile_count * TILE_SAMPLES):
        tile, place = i // TILE_SAMPLES, i % TILE_SAMPLES
        v, u = tile // tiles_x * TILE + place // TILE, tile % tiles_x * TILE + place % TILE
        depth = 0
        if v < image.shape[0] and u < image.shape[1]:
            reading = reading_of(model, is_disparity, scale, has_confidence)
            depth = depth_at(image, confidence, reading, v, u)
        depths[i] = depth
        if i < count:
            begin_keyframe(bands, i, launch_counts, touched)
            first_tile = ti.cast(ti.cast(i, ti.i64) * tile_count // count, ti.i32)
            bands[i, START] = first_tile * TILE_SAMPLES
    for tile in range(tile_count):
        unit = model[VOXEL_SIZE] / 1024.0  # metres
        valid, total = 0, ti.i64(0)
        for k in range(TILE_SAMPLES):
            depth = depths[tile * TILE_SAMPLES + k]
            valid += ti.cast(depth > 0, ti.i32)
            total += depth
        wide, high, plane = 1, 1, Plane(0, 0.0, 0.0)
        if valid > 0 and bundle == 1:
            mean = ti.cast(total, ti.f64) / valid * unit
            wide, high = cell_shape(mean * pixel_width(camera_of(camera_rows)))
            plane = tile_plane(model, unit, mean, depths, tile * TILE_SAMPLES)
        tiles[tile, WIDE], tiles[tile, HIGH], tiles[tile, FLAT] = wide, high, plane.is_flat
        tiles[tile, SLOPE_X] = ti.bit_cast(plane.slope_x, ti.i32)
        tiles[tile, SLOPE_Y] = ti.bit_cast(plane.slope_y, ti.i32)
    for i in range(tile_count * TILE_SAMPLES):
        tile, c = i // TILE_SAMPLES, i % TILE_SAMPLES
        wide, high = tiles[tile, WIDE], tiles[tile, HIGH]
        across = TILE // wide
        if c < across * (TILE // high):
            unit = model[VOXEL_SIZE] / 1024.0
            camera, reading = camera_of(camera_rows), reading_of(model, is_disparity, scale, has_confidence)
            slope_x = ti.bit_cast(tiles[tile, SLOPE_X], ti.f32)
            plane = Plane(tiles[tile, FLAT], slope_x, ti.bit_cast(tiles[tile, SLOPE_Y], ti.f32))
            left, top, base = tile % tiles_x * TILE, tile // tiles_x * TILE, tile * TILE_SAMPLES
            cell = Cell(left, top, c % across * wide, c // across * high, wide, high, base)
            band = ti.cast((ti.cast(tile, ti.i64) * count + count - 1) // tile_count, ti.i32)
            out = base + c * wide * high
            end, above = out + wide * high, 0
            samples, total_weight, total_cost = 0, 0, 0
            while above >= 0:
                layer, more = nearest_layer(model, unit, depths, None, cell, above)
                keep = layer.n > 0
                if layer.n == 1 and model[DROPS_LONE_SAMPLES] > 0.0:
                    keep = 1 == is_supported(image, confidence, reading, cell, layer)
                if keep:
                    weight, cost = write_layer_ray(
                        rays, out, out, model, camera, plane, unit, color, has_color, confidence,
                        has_confidence, depths, None, cell, layer,
                    )  # fmt: skip
                    if weight > 0:
                        samples += layer.n
                        total_weight += weight
                        total_cost += cost
                        out += 1
                above = ti.select(more, layer.up_to, -1)
            note_rays(bands, band, out - (end - wide * high), samples, total_weight, total_cost)
            for r in range(out, end):
                rays[r, WEIGHT_COLOR] = 0


@QuickLaunch
@ti.kernel
def rays_from_points(
    points: ti.types.ndarray(dtype=ti.f32, ndim=2),
    starts: ti.types.ndarray(dtype=ti.f32, ndim=2),
    color: ti.types.ndarray(dtype=ti.u8, ndim=2),
    has_color: ti.i32,
    confidence: ti.types.ndarray(dtype=ti.u8, ndim=1),
    has_confidence: ti.i32,
    pose: ti.types.ndarray(dtype=ti.f64, ndim=2),
    model: ti.types.ndarray(dtype=ti.f64, ndim=1),
    bundle: ti.i32,
    trusts: ti.types.ndarray(dtype=ti.i32, ndim=1),  # confidence in each point, 0 = none; < 0: begins a ray
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
    launch_counts: ti.types.ndarray(dtype=ti.i64, ndim=1),
    touched: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Fill `rays` as `rays_from_points.rays_from_points` does, and begin a keyframe; a ray's place is that of
    its first point."""
    count = points.shape[0]
    for i in range(ti.max(count, bands.shape[0])):
        if i < bands.shape[0]:
            begin_keyframe(bands, i, launch_counts, touched)
            bands[i, START] = ti.cast(ti.cast(i, ti.i64) * count // bands.shape[0], ti.i32)
        nearest = ti.cast(model[MIN_RANGE] * model[MIN_RANGE], ti.f32)
        farthest = ti.cast(model[MAX_RANGE] * model[MAX_RANGE], ti.f32)
        if i < count:
            o = row(starts, ti.select(starts.shape[0] == 1, 0, i))
            trusts[i] = confidence_at(row(points, i), o, nearest, farthest, confidence, has_confidence, i)
    for band in range(bands.shape[0]):
        spread = ti.cast(model[VOXEL_SIZE] * model[VOXEL_SIZE], ti.f32)
        end = ti.cast(ti.cast(band + 1, ti.i64) * count // bands.shape[0], ti.i32)
        anchor, has_anchor = vec3f(0.0), 0
        for i in range(bands[band, START], end):
            if trusts[i] > 0:
                q = row(points, i)
                if has_anchor == 0 or bundle == 0 or dot(q - anchor, q - anchor) > spread:
                    anchor, has_anchor = q, 1
                    trusts[i] = -trusts[i]
    for i in range(count):
        rays[i, WEIGHT_COLOR] = 0
        if trusts[i] < 0:
            band = ti.cast((ti.cast(i, ti.i64) * bands.shape[0] + bands.shape[0] - 1) // count, ti.i32)
            end = ti.cast(ti.cast(band + 1, ti.i64) * count // bands.shape[0], ti.i32)
            one = Bundle(0, 0, 0, 0, 0, vec3(0.0), vec3(0.0))
            k, is_within = i, 1
            while is_within == 1:
                trust = ti.abs(trusts[k])
                if trust > 0:
                    o = row(starts, ti.select(starts.shape[0] == 1, 0, k))
                    add_point(one, row(points, k), o, trust, color, has_color, k)
                k += 1
                is_within = ti.cast(k < end, ti.i32)
                if is_within == 1:
                    is_within = ti.cast(trusts[k] >= 0, ti.i32)
            start = ti.cast(row(starts, 0), ti.f64)
            if starts.shape[0] != 1:
                start = one.sum_o * (1.0 / one.n)
            weight, cost = write_bundle_ray(rays, i, i, model, pose, one, start)
            if weight > 0:
                note_rays(bands, band, 1, one.n, weight, cost)
