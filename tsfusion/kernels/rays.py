# SPDX-License-Identifier: MIT
"""Rays from depth, disparity or points.

Samples are taken in tiles (16×16 pixels, or 256 consecutive points). In a tile, samples that end in the
same voxel are bundled into one ray through their weighted mean; sums are integers, so the result does not
depend on threads. With `bundle = 0` every sample is a ray of its own.

Tiles are handed out in `bands`, contiguous runs of tiles: one band is one unit of parallel work, with a
hash table and a region of the ray buffer to itself.
"""

import taichi as ti

from tsfusion.kernels.traversal import DIRECTION_ONE, POSITION_BITS, RUN, VOXEL_LIMIT, pack, unpack, vec3i

TILE = 16
TILE_SAMPLES = TILE * TILE
TABLE_SIZE = 512  # twice a tile's samples
SUM_FIELDS = 8  # Σ position·w (3, within the voxel), Σw, Σ half·w, Σ colour·w (3): a tile's fit 31 bits
WEIGHT_ONE = 16  # a full-confidence sample
MAX_BUNDLE_WEIGHT = 255  # more samples of one voxel in one tile are not independent evidence

vec3 = ti.types.vector(3, ti.f64)
vec3l = ti.types.vector(3, ti.i64)
vec8i = ti.types.vector(SUM_FIELDS, ti.i32)

# `model`: σ floor, σ slope, σ z0, least and most half-width (voxels), voxel size, σ below which the weight is
# full, least and most range. See config.SensorModel.
MODEL_FIELDS = 9


@ti.func
def noise_sigma(model: ti.template(), z):
    return model[0] + model[1] * (z - model[2]) * (z - model[2])


@ti.func
def sample_weight(model: ti.template(), sigma, confidence):
    ratio = ti.min(1.0, model[6] / sigma)
    w = ti.cast(ti.floor(WEIGHT_ONE * ratio * ratio * confidence / 255.0 + 0.5), ti.i32)
    return ti.max(w, 1)


@ti.func
def half_width(model: ti.template(), sigma):
    """Support half-width, 2⁻⁸ voxel: three sigma, held between the preset's bounds."""
    voxels = ti.min(ti.max(3.0 * sigma / model[5], model[3]), model[4])
    return ti.cast(voxels * 256.0, ti.i32)


@ti.func
def in_reach(p):
    limit = ti.cast(VOXEL_LIMIT - 64, ti.f64)
    return ti.abs(p[0]) < limit and ti.abs(p[1]) < limit and ti.abs(p[2]) < limit


@ti.func
def write_ray(rays: ti.template(), r, end, direction, half, weight, color):
    """`end` int32 2⁻¹⁰ voxel; direction any length, float64."""
    length = direction.norm()
    usable = weight
    if length <= 0.0:
        usable = 0
        length = 1.0
    for a in ti.static(range(3)):
        rays[r, a] = end[a]
        rays[r, 3 + a] = ti.cast(ti.floor(direction[a] / length * DIRECTION_ONE + 0.5), ti.i32)
    rays[r, 6] = (half << 16) | usable
    rays[r, 7] = color


@ti.func
def fixed_point(p):
    """Position in voxels → int32 2⁻¹⁰ voxel."""
    q = vec3i(0)
    for a in ti.static(range(3)):
        q[a] = ti.cast(ti.floor(p[a] * 1024.0), ti.i32)
    return q


@ti.func
def sample_sums(q, weight, half, color):
    """What one sample adds to its bundle: `SUM_FIELDS`."""
    return vec8i(
        (q[0] & 1023) * weight,
        (q[1] & 1023) * weight,
        (q[2] & 1023) * weight,
        weight,
        half * weight,
        ((color >> 16) & 255) * weight,
        ((color >> 8) & 255) * weight,
        (color & 255) * weight,
    )


@ti.func
def add_run(
    keys: ti.template(), sums: ti.template(), origins: ti.template(), listed: ti.template(), band, entries,
    voxel, run, origin, has_origin,
):  # fmt: skip
    """Add a run of consecutive samples of one voxel to the tile's table; returns the number of entries."""
    key = pack(voxel[0], voxel[1], voxel[2])
    i = ((voxel[0] * 73856093) ^ (voxel[1] * 19349663) ^ (voxel[2] * 83492791)) & (TABLE_SIZE - 1)
    count = entries
    while keys[band, i] != key and keys[band, i] != 0:  # never full: a tile has half its size
        i = (i + 1) & (TABLE_SIZE - 1)
    if keys[band, i] == 0:
        keys[band, i] = key
        listed[band, count] = i
        count += 1
    # not `+=`: Taichi makes that atomic, and a band has its table to itself
    for f in ti.static(range(SUM_FIELDS)):
        sums[band, i, f] = sums[band, i, f] + run[f]
    if has_origin == 1:
        for a in ti.static(range(3)):
            origins[band, i, a] = origins[band, i, a] + origin[a]
    return count


@ti.func
def flush_tile(
    keys: ti.template(), sums: ti.template(), origins: ti.template(), listed: ti.template(), band, entries,
    rays: ti.template(), first, common_origin, has_origin,
):  # fmt: skip
    """Turn the tile's entries into rays `first …` and clear them."""
    for n in range(entries):
        i = listed[band, n]
        w = sums[band, i, 3]
        mean = vec8i(0)
        for f in ti.static(range(SUM_FIELDS)):
            mean[f] = ti.raw_div(sums[band, i, f], w)
            sums[band, i, f] = 0
        end = unpack(keys[band, i]) * 1024 + vec3i(mean[0], mean[1], mean[2])
        keys[band, i] = 0
        origin = common_origin
        direction = vec3(0.0)
        for a in ti.static(range(3)):
            if has_origin == 1:
                origin[a] = ti.cast(origins[band, i, a], ti.f64) / w / 1024.0
                origins[band, i, a] = 0
            direction[a] = (ti.cast(end[a], ti.f64) + 0.5) / 1024.0 - origin[a]
        color = (mean[5] << 16) | (mean[6] << 8) | mean[7]
        write_ray(rays, first + n, end, direction, mean[4], ti.min(w, MAX_BUNDLE_WEIGHT), color)


@ti.func
def take_sample(
    keys: ti.template(), sums: ti.template(), origins: ti.template(), listed: ti.template(),
    rays: ti.template(), band, out, entries, voxel, run, origin_sum, p, origin, has_origin, weight, half,
    color, bundle,
):  # fmt: skip
    """Take one sample into the current run, or (exact) write it as a ray.

    Returns `out` (next ray), `entries` (of the tile's table), and the run: its voxel, sums and Σ origin·w.
    """
    end = fixed_point(p)
    if bundle == 0:
        write_ray(rays, out, end, p - origin, half, weight, color)
        out += 1
    else:
        here = end >> POSITION_BITS
        if run[3] > 0 and any(here != voxel):
            entries = add_run(keys, sums, origins, listed, band, entries, voxel, run, origin_sum, has_origin)
            run = vec8i(0)
            origin_sum = vec3l(0)
        voxel = here
        run += sample_sums(end, weight, half, color)
        if has_origin == 1:
            for a in ti.static(range(3)):
                origin_sum[a] += ti.cast(ti.floor(origin[a] * 1024.0), ti.i64) * weight
    return out, entries, voxel, run, origin_sum


@ti.func
def end_tile(
    keys: ti.template(), sums: ti.template(), origins: ti.template(), listed: ti.template(),
    rays: ti.template(), band, out, entries, voxel, run, origin_sum, origin, has_origin,
):  # fmt: skip
    """Add the last run and write the tile's rays; returns the next ray's place."""
    if run[3] > 0:
        entries = add_run(keys, sums, origins, listed, band, entries, voxel, run, origin_sum, has_origin)
    flush_tile(keys, sums, origins, listed, band, entries, rays, out, origin, has_origin)
    return out + entries


@ti.func
def bgr(blue, green, red):
    return (ti.cast(red, ti.i32) << 16) | (ti.cast(green, ti.i32) << 8) | ti.cast(blue, ti.i32)


@ti.kernel
def rays_from_image(
    image: ti.types.ndarray(ndim=2),
    is_disparity: ti.i32,
    scale: ti.f64,  # depth = image · scale, or scale / image
    color: ti.types.ndarray(dtype=ti.u8, ndim=3),
    has_color: ti.i32,
    confidence: ti.types.ndarray(dtype=ti.u8, ndim=2),
    has_confidence: ti.i32,
    camera: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (4, 3) voxels: du, dv, corner direction, origin
    model: ti.types.ndarray(dtype=ti.f64, ndim=1),
    bundle: ti.i32,
    keys: ti.types.ndarray(dtype=ti.i64, ndim=2),
    sums: ti.types.ndarray(dtype=ti.i32, ndim=3),
    origins: ti.types.ndarray(dtype=ti.i64, ndim=3),
    listed: ti.types.ndarray(dtype=ti.i32, ndim=2),
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    band_start: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_count: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_samples: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """paper eq. 1 (with u = column, v = row), in voxel units: point = origin + z (u·du + v·dv + corner)."""
    height, width = image.shape[0], image.shape[1]
    tiles_x = (width + TILE - 1) // TILE
    tiles = tiles_x * ((height + TILE - 1) // TILE)
    bands = band_count.shape[0]
    origin = vec3(camera[3, 0], camera[3, 1], camera[3, 2])
    du = vec3(camera[0, 0], camera[0, 1], camera[0, 2])
    for unit in range(bands * RUN):
        if unit % RUN == 0:
            band = unit // RUN
            first_tile = ti.cast(ti.cast(band, ti.i64) * tiles // bands, ti.i32)
            last_tile = ti.cast(ti.cast(band + 1, ti.i64) * tiles // bands, ti.i32)
            out = first_tile * TILE_SAMPLES
            samples = 0
            for tile in range(first_tile, last_tile):
                top = tile // tiles_x * TILE
                left = tile % tiles_x * TILE
                entries, voxel, run, none = 0, vec3i(0), vec8i(0), vec3l(0)
                for v in range(top, ti.min(top + TILE, height)):
                    row = vec3(0.0)
                    for a in ti.static(range(3)):
                        row[a] = camera[1, a] * v + camera[2, a]
                    for u in range(left, ti.min(left + TILE, width)):
                        raw = ti.cast(image[v, u], ti.f64)
                        z = raw * scale
                        if is_disparity == 1:
                            z = scale / ti.max(raw, 1e-9)
                        trust = 255.0
                        if has_confidence == 1:
                            trust = ti.cast(confidence[v, u], ti.f64)
                        # False for NaN as well
                        if raw > 0.0 and z >= model[7] and z <= model[8] and trust > 0.0:
                            p = origin + (row + du * ti.cast(u, ti.f64)) * z
                            if in_reach(p):
                                sigma = noise_sigma(model, z)
                                rgb = 0
                                if has_color == 1:
                                    rgb = bgr(color[v, u, 0], color[v, u, 1], color[v, u, 2])
                                samples += 1
                                out, entries, voxel, run, none = take_sample(
                                    keys, sums, origins, listed, rays, band, out, entries, voxel, run, none,
                                    p, origin, 0, sample_weight(model, sigma, trust),
                                    half_width(model, sigma), rgb, bundle,
                                )  # fmt: skip
                out = end_tile(
                    keys, sums, origins, listed, rays, band, out, entries, voxel, run, none, origin, 0
                )
            band_start[band] = first_tile * TILE_SAMPLES
            band_count[band] = out - first_tile * TILE_SAMPLES
            band_samples[band] = samples


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
    keys: ti.types.ndarray(dtype=ti.i64, ndim=2),
    sums: ti.types.ndarray(dtype=ti.i32, ndim=3),
    origins: ti.types.ndarray(dtype=ti.i64, ndim=3),
    listed: ti.types.ndarray(dtype=ti.i32, ndim=2),
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    band_start: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_count: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_samples: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """As `rays_from_image`, for points in any order; range is measured along the ray."""
    count = points.shape[0]
    tiles = (count + TILE_SAMPLES - 1) // TILE_SAMPLES
    bands = band_count.shape[0]
    own_starts = ti.select(starts.shape[0] == 1, 0, 1)
    for unit in range(bands * RUN):
        if unit % RUN == 0:
            band = unit // RUN
            first_tile = ti.cast(ti.cast(band, ti.i64) * tiles // bands, ti.i32)
            last_tile = ti.cast(ti.cast(band + 1, ti.i64) * tiles // bands, ti.i32)
            out = first_tile * TILE_SAMPLES
            samples = 0
            for tile in range(first_tile, last_tile):
                entries, voxel, run, origin_sum = 0, vec3i(0), vec8i(0), vec3l(0)
                origin = vec3(0.0)
                for n in range(tile * TILE_SAMPLES, ti.min((tile + 1) * TILE_SAMPLES, count)):
                    o = vec3(0.0)
                    q = vec3(0.0)
                    for a in ti.static(range(3)):
                        o[a] = ti.cast(starts[n * own_starts, a], ti.f64)
                        q[a] = ti.cast(points[n, a], ti.f64)
                    span = (q - o).norm()
                    trust = 255.0
                    if has_confidence == 1:
                        trust = ti.cast(confidence[n], ti.f64)
                    if span > 0.0 and span >= model[7] and span <= model[8] and trust > 0.0:
                        p = vec3(0.0)
                        for a in ti.static(range(3)):
                            p[a] = pose[a, 0] * q[0] + pose[a, 1] * q[1] + pose[a, 2] * q[2] + pose[a, 3]
                            origin[a] = pose[a, 0] * o[0] + pose[a, 1] * o[1] + pose[a, 2] * o[2] + pose[a, 3]
                        if in_reach(p) and in_reach(origin):
                            sigma = noise_sigma(model, span)
                            rgb = 0
                            if has_color == 1:
                                rgb = bgr(color[n, 0], color[n, 1], color[n, 2])
                            samples += 1
                            out, entries, voxel, run, origin_sum = take_sample(
                                keys, sums, origins, listed, rays, band, out, entries, voxel, run, origin_sum,
                                p, origin, own_starts, sample_weight(model, sigma, trust),
                                half_width(model, sigma), rgb, bundle,
                            )  # fmt: skip
                out = end_tile(
                    keys, sums, origins, listed, rays, band, out, entries, voxel, run, origin_sum, origin,
                    own_starts,
                )  # fmt: skip
            band_start[band] = first_tile * TILE_SAMPLES
            band_count[band] = out - first_tile * TILE_SAMPLES
            band_samples[band] = samples
