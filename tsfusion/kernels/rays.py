# SPDX-License-Identifier: MIT
"""Rays from depth, disparity or points.

Samples are taken in tiles (16×16 pixels, or 256 consecutive points). In a tile, samples that end in the
same voxel are bundled into one ray through their weighted mean; sums are integers, so the result does not
depend on threads. With `bundle = 0` every sample is a ray of its own.

Tiles are handed out in `bands`, contiguous runs of tiles: one band is one unit of parallel work, with a
hash table and a region of the ray buffer to itself.
"""

import taichi as ti

from tsfusion.kernels.traversal import DIRECTION_ONE, POSITION_BITS, RUN, VOXEL_LIMIT, pack, unpack

TILE = 16
TILE_SAMPLES = TILE * TILE
TABLE_SIZE = 512  # twice a tile's samples
TABLE_FIELDS = 12  # key, Σ position·w (3), Σw, Σ half·w, Σ colour (3), Σ origin·w (3)
WEIGHT_ONE = 16  # a full-confidence sample
MAX_BUNDLE_WEIGHT = 255  # more samples of one voxel in one tile are not independent evidence

vec3 = ti.types.vector(3, ti.f64)
vec6 = ti.types.vector(6, ti.f64)

# `model`: σ floor, σ slope, σ z0, least and most half-width (voxels), voxel size, σ below which weight is full,
# least and most range. See config.SensorModel.
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
def write_ray(rays: ti.template(), r, x, y, z, direction, half, weight, color):
    """`x y z` int32 2⁻¹⁰ voxel; direction any length, float64."""
    length = direction.norm()
    usable = weight
    if length <= 0.0:
        usable = 0
        length = 1.0
    rays[r, 0] = x
    rays[r, 1] = y
    rays[r, 2] = z
    for a in ti.static(range(3)):
        rays[r, 3 + a] = ti.cast(ti.floor(direction[a] / length * DIRECTION_ONE + 0.5), ti.i32)
    rays[r, 6] = (half << 16) | usable
    rays[r, 7] = color


@ti.func
def add_sample(
    table: ti.template(), listed: ti.template(), band, entries, p, origin, has_origin, weight, half, color
):
    """Add one sample to the tile's table; returns the number of entries."""
    x = ti.cast(ti.floor(p[0] * 1024.0), ti.i32)
    y = ti.cast(ti.floor(p[1] * 1024.0), ti.i32)
    z = ti.cast(ti.floor(p[2] * 1024.0), ti.i32)
    vx, vy, vz = x >> POSITION_BITS, y >> POSITION_BITS, z >> POSITION_BITS
    key = pack(vx, vy, vz)
    i = ((vx * 73856093) ^ (vy * 19349663) ^ (vz * 83492791)) & (TABLE_SIZE - 1)
    count = entries
    while table[band, i, 0] != key and table[band, i, 0] != 0:  # never full: a tile has half its size
        i = (i + 1) & (TABLE_SIZE - 1)
    if table[band, i, 0] == 0:
        table[band, i, 0] = key
        listed[band, count] = i
        count += 1
    w = ti.cast(weight, ti.i64)
    # not `+=`: Taichi makes that atomic, and a band has its table to itself
    table[band, i, 1] = table[band, i, 1] + (x & 1023) * w
    table[band, i, 2] = table[band, i, 2] + (y & 1023) * w
    table[band, i, 3] = table[band, i, 3] + (z & 1023) * w
    table[band, i, 4] = table[band, i, 4] + w
    table[band, i, 5] = table[band, i, 5] + half * w
    table[band, i, 6] = table[band, i, 6] + ((color >> 16) & 255) * w
    table[band, i, 7] = table[band, i, 7] + ((color >> 8) & 255) * w
    table[band, i, 8] = table[band, i, 8] + (color & 255) * w
    if has_origin == 1:
        for a in ti.static(range(3)):
            table[band, i, 9 + a] = table[band, i, 9 + a] + ti.cast(ti.floor(origin[a] * 1024.0), ti.i64) * w
    return count


@ti.func
def flush_tile(
    table: ti.template(),
    listed: ti.template(),
    band,
    entries,
    rays: ti.template(),
    first,
    common_origin,
    has_origin,
):
    """Turn the tile's entries into rays `first …` and clear them."""
    for n in range(entries):
        i = listed[band, n]
        w = table[band, i, 4]
        voxel = unpack(table[band, i, 0])
        position = vec3(0.0)
        origin = common_origin
        fixed = voxel * 1024
        for a in ti.static(range(3)):
            fixed[a] += ti.cast(table[band, i, 1 + a] // w, ti.i32)
            position[a] = (ti.cast(fixed[a], ti.f64) + 0.5) / 1024.0
            if has_origin == 1:
                origin[a] = ti.cast(table[band, i, 9 + a], ti.f64) / ti.cast(w, ti.f64) / 1024.0
        half = ti.cast(table[band, i, 5] // w, ti.i32)
        color = (
            (ti.cast(table[band, i, 6] // w, ti.i32) << 16)
            | (ti.cast(table[band, i, 7] // w, ti.i32) << 8)
            | ti.cast(table[band, i, 8] // w, ti.i32)
        )
        weight = ti.cast(ti.min(w, MAX_BUNDLE_WEIGHT), ti.i32)
        write_ray(rays, first + n, fixed[0], fixed[1], fixed[2], position - origin, half, weight, color)
        for f in ti.static(range(TABLE_FIELDS)):
            table[band, i, f] = 0


@ti.func
def write_sample(rays: ti.template(), r, p, origin, weight, half, color):
    x = ti.cast(ti.floor(p[0] * 1024.0), ti.i32)
    y = ti.cast(ti.floor(p[1] * 1024.0), ti.i32)
    z = ti.cast(ti.floor(p[2] * 1024.0), ti.i32)
    write_ray(rays, r, x, y, z, p - origin, half, weight, color)


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
    table: ti.types.ndarray(dtype=ti.i64, ndim=3),
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
    for run in range(bands * RUN):
        if run % RUN == 0:
            band = run // RUN
            first_tile = ti.cast(ti.cast(band, ti.i64) * tiles // bands, ti.i32)
            last_tile = ti.cast(ti.cast(band + 1, ti.i64) * tiles // bands, ti.i32)
            band_start[band] = first_tile * TILE_SAMPLES
            out = first_tile * TILE_SAMPLES
            samples = 0
            for tile in range(first_tile, last_tile):
                top = tile // tiles_x * TILE
                left = tile % tiles_x * TILE
                entries = 0
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
                                weight = sample_weight(model, sigma, trust)
                                half = half_width(model, sigma)
                                rgb = 0
                                if has_color == 1:
                                    rgb = (
                                        (ti.cast(color[v, u, 2], ti.i32) << 16)
                                        | (ti.cast(color[v, u, 1], ti.i32) << 8)
                                        | ti.cast(color[v, u, 0], ti.i32)
                                    )
                                samples += 1
                                if bundle == 1:
                                    entries = add_sample(
                                        table, listed, band, entries, p, origin, 0, weight, half, rgb
                                    )
                                else:
                                    write_sample(rays, out, p, origin, weight, half, rgb)
                                    out += 1
                if bundle == 1:
                    flush_tile(table, listed, band, entries, rays, out, origin, 0)
                    out += entries
            band_count[band] = out - first_tile * TILE_SAMPLES
            band_samples[band] = samples


@ti.kernel
def rays_from_points(
    points: ti.types.ndarray(dtype=ti.f32, ndim=2),
    origins: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (1, 3) or (N, 3), sensor frame
    color: ti.types.ndarray(dtype=ti.u8, ndim=2),
    has_color: ti.i32,
    confidence: ti.types.ndarray(dtype=ti.u8, ndim=1),
    has_confidence: ti.i32,
    pose: ti.types.ndarray(dtype=ti.f64, ndim=2),  # (3, 4), metres → voxels
    model: ti.types.ndarray(dtype=ti.f64, ndim=1),
    bundle: ti.i32,
    table: ti.types.ndarray(dtype=ti.i64, ndim=3),
    listed: ti.types.ndarray(dtype=ti.i32, ndim=2),
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    band_start: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_count: ti.types.ndarray(dtype=ti.i32, ndim=1),
    band_samples: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    count = points.shape[0]
    tiles = (count + TILE_SAMPLES - 1) // TILE_SAMPLES
    bands = band_count.shape[0]
    own_origins = ti.select(origins.shape[0] == 1, 0, 1)
    for run in range(bands * RUN):
        if run % RUN == 0:
            band = run // RUN
            first_tile = ti.cast(ti.cast(band, ti.i64) * tiles // bands, ti.i32)
            last_tile = ti.cast(ti.cast(band + 1, ti.i64) * tiles // bands, ti.i32)
            band_start[band] = first_tile * TILE_SAMPLES
            out = first_tile * TILE_SAMPLES
            samples = 0
            for tile in range(first_tile, last_tile):
                entries = 0
                origin = vec3(0.0)
                for n in range(tile * TILE_SAMPLES, ti.min((tile + 1) * TILE_SAMPLES, count)):
                    o = vec3(0.0)
                    q = vec3(0.0)
                    for a in ti.static(range(3)):
                        o[a] = ti.cast(origins[n * own_origins, a], ti.f64)
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
                            weight = sample_weight(model, sigma, trust)
                            half = half_width(model, sigma)
                            rgb = 0
                            if has_color == 1:
                                rgb = (
                                    (ti.cast(color[n, 2], ti.i32) << 16)
                                    | (ti.cast(color[n, 1], ti.i32) << 8)
                                    | ti.cast(color[n, 0], ti.i32)
                                )
                            samples += 1
                            if bundle == 1:
                                entries = add_sample(
                                    table, listed, band, entries, p, origin, own_origins, weight, half, rgb
                                )
                            else:
                                write_sample(rays, out, p, origin, weight, half, rgb)
                                out += 1
                if bundle == 1:
                    flush_tile(table, listed, band, entries, rays, out, origin, own_origins)
                    out += entries
            band_count[band] = out - first_tile * TILE_SAMPLES
            band_samples[band] = samples
