# SPDX-License-Identifier: MIT
"""Make rays of images and points on a GPU, one thread per pixel or point. They equal the rays of
`rays_from_images` and `rays_from_points` bit by bit.

Rays have fixed indices, so a strip's rays are not consecutive: an index without a ray has weight 0. The
kernels also add the rays (`device_integration`): one launch takes half of the time of two.
"""

from tsfusion.kernels import F64, I32, I64, U8, ANYx2, F32x2, F64x2, I32x2, I64x2, U8x2, ti
from tsfusion.kernels.base.kernel_functions import dot
from tsfusion.kernels.base.quick_launch import QuickLaunch
from tsfusion.kernels.base.sensor_noise import (
    DROPS_LONE_SAMPLES,
    MAX_RANGE,
    MIN_RANGE,
    VOXEL_SIZE,
    vec3,
    vec3f,
)
from tsfusion.kernels.base.voxel_traversal import COST, COUNT, SAMPLES, WEIGHT, WEIGHT_COLOR
from tsfusion.kernels.device.device_copies import BEGINNERS, STRIPS, begin_keyframe, strip_field
from tsfusion.kernels.device.device_integration import (
    COSTS,
    CROSSED,
    GROUP,
    add_and_admit,
    begin_groups,
    begin_list,
    crossed,
    whole_groups,
)
from tsfusion.kernels.integration.integrate import COLOR_VOTE
from tsfusion.kernels.integration.rays_from_images import (
    TILE,
    TILE_SAMPLES,
    Cell,
    Plane,
    camera_of,
    cell_shape,
    depth_at,
    is_supported,
    pixel_width,
    reading_of,
    samples_of,
    take_nearest,
    tile_plane,
    write_layer_ray,
)
from tsfusion.kernels.integration.rays_from_points import (
    Bundle,
    add_point,
    confidence_at,
    row,
    write_bundle_ray,
)

# A tile: width and height of its cells, flag for a flat tile, slopes of its plane (float32's bits), and
# counters of its rays: fields of a strip.
TILE_FIELDS = 16
WIDE, HIGH, FLAT, SLOPE_X, SLOPE_Y, COUNTED = 0, 1, 2, 3, 4, 8
COUNTS = (COUNT, SAMPLES, WEIGHT, COST)


@ti.func
def image_rays(
    image: ti.template(), is_disparity, scale, color: ti.template(), has_color, confidence: ti.template(),
    has_confidence, camera_rows: ti.template(), model: ti.template(), bundle, depths: ti.template(),
    tiles: ti.template(), rays: ti.template(), told: ti.template(), groups: ti.template(),
    totals: ti.template(), listed: ti.template(), marks: ti.template(), claims: ti.template(),
):  # fmt: skip
    """Clear the last keyframe's counters, and fill `rays` from an image as `rays_from_images.rays_from_image`
    does. Each image tile has `TILE_SAMPLES` ray indices. Each loop is one task of the GPU."""
    tiles_x = (image.shape[1] + TILE - 1) // TILE
    tile_count = tiles_x * ((image.shape[0] + TILE - 1) // TILE)
    for i in range(BEGINNERS + tile_count * TILE_SAMPLES):
        begin_keyframe(i, told, claims)
        begin_groups(i, groups, totals)
        if i >= BEGINNERS:
            tile, place = (i - BEGINNERS) // TILE_SAMPLES, (i - BEGINNERS) % TILE_SAMPLES
            v, u = tile // tiles_x * TILE + place // TILE, tile % tiles_x * TILE + place % TILE
            depth = 0
            if v < image.shape[0] and u < image.shape[1]:
                reading = reading_of(model, is_disparity, scale, has_confidence)
                depth = depth_at(image, confidence, reading, v, u)
            depths[i - BEGINNERS] = depth
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
        for field in ti.static(COUNTS):
            tiles[tile, COUNTED + field] = 0
    for i in range(tile_count * TILE_SAMPLES):
        tile, c = i % tile_count, i // tile_count  # neighbouring threads: similar tiles, with work or none
        wide, high = tiles[tile, WIDE], tiles[tile, HIGH]
        across = TILE // wide
        if c < across * (TILE // high):
            unit = model[VOXEL_SIZE] / 1024.0
            camera, reading = camera_of(camera_rows), reading_of(model, is_disparity, scale, has_confidence)
            slope_x = ti.bit_cast(tiles[tile, SLOPE_X], ti.f32)
            plane = Plane(tiles[tile, FLAT], slope_x, ti.bit_cast(tiles[tile, SLOPE_Y], ti.f32))
            left, top, base = tile % tiles_x * TILE, tile // tiles_x * TILE, tile * TILE_SAMPLES
            cell = Cell(left, top, c % across * wide, c // across * high, wide, high, base)
            out = base + c * wide * high
            end = out + wide * high
            samples, total_weight, total_cost, total_crossed = 0, 0, 0, 0
            rest = samples_of(depths, None, cell)
            while rest.n > 0:
                layer = take_nearest(model, unit, depths, cell, rest)
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
                        marks[out] = total_crossed
                        total_crossed += crossed(rays, out)
                        out += 1
            if samples > 0:
                before = ti.atomic_add(groups[tile, CROSSED], total_crossed)
                for r in range(end - wide * high, out):
                    marks[r] += before
                ti.atomic_add(tiles[tile, COUNTED + COUNT], out - (end - wide * high))
                ti.atomic_add(tiles[tile, COUNTED + SAMPLES], samples)
                ti.atomic_add(tiles[tile, COUNTED + WEIGHT], total_weight)
                ti.atomic_add(tiles[tile, COUNTED + COST], total_cost)
            for r in range(out, end):
                rays[r, WEIGHT_COLOR] = 0
    for tile in range(tile_count):
        strip = ti.cast((ti.cast(tile, ti.i64) * STRIPS + STRIPS - 1) // tile_count, ti.i32)
        for field in ti.static(COUNTS):
            ti.atomic_add(told[strip_field(strip, field)], tiles[tile, COUNTED + field])
        ti.atomic_add(totals[COSTS], ti.cast(tiles[tile, COUNTED + COST], ti.i64))
        begin_list(tile, groups, totals, listed)


@ti.func
def point_rays(
    points: ti.template(), starts: ti.template(), color: ti.template(), has_color, confidence: ti.template(),
    has_confidence, pose: ti.template(), model: ti.template(), bundle, trusts: ti.template(),
    rays: ti.template(), told: ti.template(), groups: ti.template(), totals: ti.template(),
    listed: ti.template(), marks: ti.template(), claims: ti.template(),
):  # fmt: skip
    """Clear the last keyframe's counters, and fill `rays` from points as `rays_from_points.rays_from_points`
    does. A ray has the index of its first point."""
    count = points.shape[0]
    for k in range(BEGINNERS + count):
        begin_keyframe(k, told, claims)
        begin_groups(k, groups, totals)
        i = k - BEGINNERS
        if i >= 0:
            nearest = ti.cast(model[MIN_RANGE] * model[MIN_RANGE], ti.f32)
            farthest = ti.cast(model[MAX_RANGE] * model[MAX_RANGE], ti.f32)
            o = row(starts, ti.select(starts.shape[0] == 1, 0, i))
            trusts[i] = confidence_at(row(points, i), o, nearest, farthest, confidence, has_confidence, i)
    for strip in range(STRIPS):
        spread = ti.cast(model[VOXEL_SIZE] * model[VOXEL_SIZE], ti.f32)
        begin = ti.cast(ti.cast(strip, ti.i64) * count // STRIPS, ti.i32)
        end = ti.cast(ti.cast(strip + 1, ti.i64) * count // STRIPS, ti.i32)
        anchor, has_anchor = vec3f(0.0), 0
        for i in range(begin, end):
            if trusts[i] > 0:
                q = row(points, i)
                if has_anchor == 0 or bundle == 0 or dot(q - anchor, q - anchor) > spread:
                    anchor, has_anchor = q, 1
                    trusts[i] = -trusts[i]
    for i in range(count):
        rays[i, WEIGHT_COLOR] = 0
        if trusts[i] < 0:
            strip = ti.cast((ti.cast(i, ti.i64) * STRIPS + STRIPS - 1) // count, ti.i32)
            end = ti.cast(ti.cast(strip + 1, ti.i64) * count // STRIPS, ti.i32)
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
                ti.atomic_add(told[strip_field(strip, COUNT)], 1)
                ti.atomic_add(told[strip_field(strip, SAMPLES)], one.n)
                ti.atomic_add(told[strip_field(strip, WEIGHT)], weight)
                ti.atomic_add(told[strip_field(strip, COST)], cost)
                marks[i] = ti.atomic_add(groups[i // GROUP, CROSSED], crossed(rays, i))
    for g in range((count + GROUP - 1) // GROUP + STRIPS):
        if g < STRIPS:
            ti.atomic_add(totals[COSTS], ti.cast(told[strip_field(g, COST)], ti.i64))
        else:
            begin_list(g - STRIPS, groups, totals, listed)


@QuickLaunch
@ti.kernel
def fuse_image(
    image: ANYx2, is_disparity: ti.i32, scale: ti.f64, color: U8x2, has_color: ti.i32, confidence: U8x2,
    has_confidence: ti.i32, camera_rows: F64x2, model: F64, bundle: ti.i32,
    depths: I32,  # of each tile's pixels, one tile after the other
    tiles: I32x2, rays: I32x2, count: ti.i32,
    kind: ti.i32,  # of votes
    sign_: ti.i32, version: ti.i32, first_slot: ti.i32, room: I64, hash_keys: I64, hash_slots: I32,
    winners: I32, missing: I64, places: I32x2, claims: I32, versions: I32, told: I32, groups: I32x2,
    totals: I64, listed: I32x2, marks: I32, sums: I64x2, color_rgn: I64x2, color_b: I32x2,
):  # fmt: skip
    """Make an image's rays, and add the first `count` to the map: none if the list of updates is full."""
    # Computed here, because a loop end that is computed later is a separate task
    rays_end, places_end, votes_end = count, whole_groups(count), 1 + ti.min(kind, COLOR_VOTE) * count
    image_rays(
        image, is_disparity, scale, color, has_color, confidence, has_confidence, camera_rows, model, bundle,
        depths, tiles, rays, told, groups, totals, listed, marks, claims,
    )  # fmt: skip
    add_and_admit(
        rays, rays_end, places_end, votes_end, kind, sign_, version, first_slot, room, hash_keys, hash_slots,
        winners, missing, places, claims, versions, told, groups, totals, listed, marks, sums, color_rgn,
        color_b,
    )  # fmt: skip


@QuickLaunch
@ti.kernel
def fuse_points(
    points: F32x2, starts: F32x2, color: U8x2, has_color: ti.i32, confidence: U8, has_confidence: ti.i32,
    pose: F64x2, model: F64, bundle: ti.i32,
    trusts: I32,  # confidence in each point, 0 = none; < 0: begins a ray
    rays: I32x2, count: ti.i32,
    kind: ti.i32,  # of votes
    sign_: ti.i32, version: ti.i32, first_slot: ti.i32, room: I64, hash_keys: I64, hash_slots: I32,
    winners: I32, missing: I64, places: I32x2, claims: I32, versions: I32, told: I32, groups: I32x2,
    totals: I64, listed: I32x2, marks: I32, sums: I64x2, color_rgn: I64x2, color_b: I32x2,
):  # fmt: skip
    """Make rays of points, and add the first `count` to the map: none if the list of updates is full."""
    rays_end, places_end, votes_end = count, whole_groups(count), 1 + ti.min(kind, COLOR_VOTE) * count
    point_rays(
        points, starts, color, has_color, confidence, has_confidence, pose, model, bundle, trusts, rays,
        told, groups, totals, listed, marks, claims,
    )  # fmt: skip
    add_and_admit(
        rays, rays_end, places_end, votes_end, kind, sign_, version, first_slot, room, hash_keys, hash_slots,
        winners, missing, places, claims, versions, told, groups, totals, listed, marks, sums, color_rgn,
        color_b,
    )  # fmt: skip
