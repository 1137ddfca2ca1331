# SPDX-License-Identifier: MIT
"""Rays from depth or disparity images.

An image is read in tiles of 12×12 pixels. In a tile, the pixels of a cell about as wide as a voxel are
bundled into one ray through their mean, a layer of depth at a time. Where the whole tile is flat, its plane
gives the distance that the ray's voxels have to the surface; elsewhere it is the distance to the ray's end.
Sums are integers, so nothing depends on threads. With `bundle = 0` every pixel is a ray.

One unit of parallel work is a band, a contiguous run of tiles with a region of the ray buffer to itself.
"""

import taichi as ti

from tsfusion.kernels.sensor_noise import (
    DROPS_LONE_SAMPLES,
    MAX_RANGE,
    MIN_RANGE,
    VOXEL_SIZE,
    before_width,
    bundle_weight,
    fixed_point,
    half_width,
    in_reach,
    layer_depth,
    noise_sigma,
    vec3,
)
from tsfusion.kernels.voxel_traversal import COUNT, RUN, SAMPLES, START, WEIGHT, write_ray

TILE = 12  # divided by both sides of every cell
TILE_SAMPLES = TILE * TILE
CELLS = ((2, 1), (2, 2), (3, 2), (3, 3), (4, 3), (4, 4), (6, 4), (6, 6), (12, 6), (12, 12))  # wide, high
CELL_AREA = 1.0  # voxels across the ray
PLANE_STEP = 2  # a plane is fitted to every second pixel of every second row
LEAST_PLANE = 9  # of these, for a plane
PLANE_NOISE = 2.0  # the most mean squared residual of a plane, in σ² …
PLANE_ROUGHNESS = 0.1 * 1024.0  # … and, squared, on top of it: 2⁻¹⁰ voxel
PLANE_SIGMA = 1.0  # voxels: with more noise than that a plane says nothing about voxels
LEAST_FACING = 0.15  # cosine between plane normal and ray: what is seen more edge-on has no plane


@ti.func
def depth_at(
    image: ti.template(), is_disparity, scale, confidence: ti.template(), has_confidence, near, far, unit,
    v, u,
):  # fmt: skip
    """Depth of a pixel in 2⁻¹⁰ voxel (`unit` = 1 / metres of that); 0 = no usable return. All float32."""
    raw = ti.cast(image[v, u], ti.f32)
    z = raw * scale
    if is_disparity == 1:
        z = scale / ti.max(raw, 1e-9)
    q = 0
    # False for NaN as well
    if raw > 0.0 and z >= near and z <= far:
        q = ti.cast(z * unit, ti.i32)
        if has_confidence == 1:
            if confidence[v, u] == 0:
                q = 0
    return q


@ti.func
def load_tile(
    image: ti.template(), is_disparity, scale, confidence: ti.template(), has_confidence, near, far, unit,
    top, left, depths: ti.template(), band,
):  # fmt: skip
    """Fill `depths[band]` with the tile's depths. Returns their count and sum."""
    bottom = ti.min(TILE, image.shape[0] - top)
    right = ti.min(TILE, image.shape[1] - left)
    if bottom < TILE or right < TILE:
        for i in range(TILE_SAMPLES):
            depths[band, i] = 0
    valid = 0
    total = ti.i64(0)
    for y in range(bottom):
        for x in range(right):
            q = depth_at(
                image, is_disparity, scale, confidence, has_confidence, near, far, unit, top + y, left + x
            )
            depths[band, y * TILE + x] = q
            valid += ti.cast(q > 0, ti.i32)
            total += q
    return valid, total


@ti.func
def fit_plane(depths: ti.template(), band, anchor, sigma):
    """Least squares q = c + x·slope_x + y·slope_y over a lattice of the tile; depths and `sigma` in 2⁻¹⁰
    voxel, `anchor` near the depths. Returns (1, slope_x, slope_y), or zeros where the tile is not flat."""
    sx, sy, sxx, sxy, syy, n = 0, 0, 0, 0, 0, 0
    sq, sxq, syq, sqq = ti.i64(0), ti.i64(0), ti.i64(0), ti.i64(0)
    for row in range(TILE // PLANE_STEP):
        y = row * PLANE_STEP
        row_n, row_x, row_xx, row_q, row_xq = 0, 0, 0, ti.i64(0), ti.i64(0)
        for column in range(TILE // PLANE_STEP):
            x = column * PLANE_STEP
            q = depths[band, y * TILE + x]
            if q > 0:
                d = ti.cast(ti.min(ti.max(q - anchor, -(1 << 20)), 1 << 20), ti.i64)
                row_n += 1
                row_x += x
                row_xx += x * x
                row_q += d
                row_xq += d * x
                sqq += d * d
        n += row_n
        sx += row_x
        sy += y * row_n
        sxx += row_xx
        sxy += y * row_x
        syy += y * y * row_n
        sq += row_q
        sxq += row_xq
        syq += row_q * y
    planar, slope_x, slope_y = 0, 0.0, 0.0
    if n >= LEAST_PLANE:
        mean_q = ti.cast(sq, ti.f64) / n
        cxx = sxx - ti.cast(sx * sx, ti.f64) / n
        cyy = syy - ti.cast(sy * sy, ti.f64) / n
        cxy = sxy - ti.cast(sx * sy, ti.f64) / n
        cxq = ti.cast(sxq, ti.f64) - mean_q * sx
        cyq = ti.cast(syq, ti.f64) - mean_q * sy
        determinant = cxx * cyy - cxy * cxy
        if determinant > 0.05 * cxx * cyy:
            slope_x = (cxq * cyy - cyq * cxy) / determinant
            slope_y = (cyq * cxx - cxq * cxy) / determinant
            left_over = ti.cast(sqq, ti.f64) - mean_q * sq - slope_x * cxq - slope_y * cyq
            if left_over < n * (PLANE_NOISE * sigma * sigma + PLANE_ROUGHNESS * PLANE_ROUGHNESS):
                planar = 1
    return planar, slope_x, slope_y


@ti.func
def plane_gradient(ray, du, dv, z, slope_x, slope_y):
    """n / (n·u) of the plane through `ray`·z whose depth has these slopes a pixel; zero if seen edge-on."""
    normal = (du * z + ray * slope_x).cross(dv * z + ray * slope_y)
    along = normal.dot(ray)
    gradient = vec3(0.0)
    if along * along > LEAST_FACING * LEAST_FACING * normal.norm_sqr() * ray.norm_sqr():
        gradient = normal * (ray.norm() / along)
    return gradient


@ti.func
def cell_shape(pixel):
    """Width and height in pixels of the largest cell within `CELL_AREA`; `pixel` = voxels a pixel spans."""
    wide, high = 1, 1
    for w, h in ti.static(CELLS):
        if w * h * pixel * pixel <= CELL_AREA:
            wide, high = w, h
    return wide, high


@ti.func
def layer_sums(depths: ti.template(), band, x0, y0, wide, high, above, up_to):
    """Of the cell's depths in (`above`, `up_to`]: least, largest, count, Σ depth, Σ x, Σ y."""
    low, top, n, sum_q, sum_x, sum_y = 1 << 30, 0, 0, ti.i64(0), 0, 0
    for y in range(y0, y0 + high):
        for x in range(x0, x0 + wide):
            q = depths[band, y * TILE + x]
            if q > above and q <= up_to:
                low = ti.min(low, q)
                top = ti.max(top, q)
                n += 1
                sum_q += q
                sum_x += x
                sum_y += y
    return low, top, n, sum_q, sum_x, sum_y


@ti.func
def layer_color(
    color: ti.template(), has_color, confidence: ti.template(), has_confidence, top, left,
    depths: ti.template(), band, x0, y0, wide, high, low, up_to, n,
):  # fmt: skip
    """Mean colour 0xRRGGBB and summed confidence of the cell's `n` samples with depths in [low, up_to]."""
    red, green, blue, trust = 0, 0, 0, 0
    for y in range(y0, y0 + high):
        for x in range(x0, x0 + wide):
            q = depths[band, y * TILE + x]
            if q >= low and q <= up_to:
                if has_confidence == 1:
                    trust += ti.cast(confidence[top + y, left + x], ti.i32)
                if has_color == 1:
                    blue += ti.cast(color[top + y, left + x, 0], ti.i32)
                    green += ti.cast(color[top + y, left + x, 1], ti.i32)
                    red += ti.cast(color[top + y, left + x, 2], ti.i32)
    if has_confidence == 0:
        trust = 255 * n
    return ((red // n) << 16) | ((green // n) << 8) | (blue // n), trust


@ti.func
def is_supported(
    image: ti.template(), is_disparity, scale, confidence: ti.template(), has_confidence, near, far, unit,
    v, u, q, tolerance,
):  # fmt: skip
    """Whether one of the eight neighbours has nearly the same depth."""
    found = 0
    for k in range(9):
        y = v + k // 3 - 1
        x = u + k % 3 - 1
        if found == 0 and k != 4 and y >= 0 and y < image.shape[0] and x >= 0 and x < image.shape[1]:
            other = depth_at(image, is_disparity, scale, confidence, has_confidence, near, far, unit, y, x)
            if other > 0 and abs(other - q) <= tolerance:
                found = 1
    return found


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
    depths: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (bands, TILE_SAMPLES)
    rays: ti.types.ndarray(dtype=ti.i32, ndim=2),
    bands: ti.types.ndarray(dtype=ti.i32, ndim=2),
):
    """paper eq. 1 (with u = column, v = row), in voxel units: point = origin + z (u·du + v·dv + corner)."""
    tiles_x = (image.shape[1] + TILE - 1) // TILE
    tiles = tiles_x * ((image.shape[0] + TILE - 1) // TILE)
    count = bands.shape[0]
    du = vec3(camera[0, 0], camera[0, 1], camera[0, 2])
    dv = vec3(camera[1, 0], camera[1, 1], camera[1, 2])
    corner = vec3(camera[2, 0], camera[2, 1], camera[2, 2])
    origin = vec3(camera[3, 0], camera[3, 1], camera[3, 2])
    pitch = ti.max(du.norm(), dv.norm())
    unit = model[VOXEL_SIZE] / 1024.0  # metres
    factor, per_metre = ti.cast(scale, ti.f32), ti.cast(1.0 / unit, ti.f32)
    near, far = ti.cast(model[MIN_RANGE], ti.f32), ti.cast(model[MAX_RANGE], ti.f32)
    for run in range(count * RUN):
        if run % RUN == 0:
            band = run // RUN
            first_tile = ti.cast(ti.cast(band, ti.i64) * tiles // count, ti.i32)
            last_tile = ti.cast(ti.cast(band + 1, ti.i64) * tiles // count, ti.i32)
            out = first_tile * TILE_SAMPLES
            samples, total_weight = 0, 0
            for tile in range(first_tile, last_tile):
                top = tile // tiles_x * TILE
                left = tile % tiles_x * TILE
                valid, total = load_tile(
                    image, is_disparity, factor, confidence, has_confidence, near, far, per_metre, top, left,
                    depths, band,
                )  # fmt: skip
                if valid > 0:
                    mean = ti.cast(total, ti.f64) / valid * unit
                    wide, high, planar, slope_x, slope_y = 1, 1, 0, 0.0, 0.0
                    if bundle == 1:
                        wide, high = cell_shape(mean * pitch)
                        sigma = noise_sigma(model, mean)
                        if sigma < PLANE_SIGMA * model[VOXEL_SIZE]:
                            anchor = ti.cast(mean / unit, ti.i32)
                            planar, slope_x, slope_y = fit_plane(depths, band, anchor, sigma / unit)
                    across = TILE // wide
                    for cell in range(across * (TILE // high)):
                        y0 = cell // across * high
                        x0 = cell % across * wide
                        above = 0
                        while above >= 0:  # one layer of depth after the other
                            low, deepest, n, sum_q, sum_x, sum_y = layer_sums(
                                depths, band, x0, y0, wide, high, above, 1 << 30
                            )
                            tolerance = 0
                            if n > 0:
                                tolerance = ti.cast(
                                    ti.min(layer_depth(model, low * unit) / unit, 1e9), ti.i32
                                )
                            more = n > 1 and deepest - low > tolerance
                            if more:
                                low, deepest, n, sum_q, sum_x, sum_y = layer_sums(
                                    depths, band, x0, y0, wide, high, above, low + tolerance
                                )
                            keep = n > 0
                            if n == 1 and model[DROPS_LONE_SAMPLES] > 0.0:
                                keep = 1 == is_supported(
                                    image, is_disparity, factor, confidence, has_confidence, near, far,
                                    per_metre, top + sum_y, left + sum_x, low, tolerance,
                                )  # fmt: skip
                            if keep:
                                z = (ti.cast(sum_q, ti.f64) / n + 0.5) * unit
                                u = left + ti.cast(sum_x, ti.f64) / n
                                v = top + ti.cast(sum_y, ti.f64) / n
                                ray = corner + du * u + dv * v
                                p = origin + ray * z
                                if in_reach(p):
                                    rgb, trust = 0, 255 * n
                                    if has_confidence == 1 or has_color == 1:
                                        rgb, trust = layer_color(
                                            color, has_color, confidence, has_confidence, top, left, depths,
                                            band, x0, y0, wide, high, low, low + tolerance, n,
                                        )  # fmt: skip
                                    gradient = vec3(0.0)
                                    if planar == 1:
                                        gradient = plane_gradient(
                                            ray, du, dv, z, slope_x * unit, slope_y * unit
                                        )
                                    sigma = noise_sigma(model, z)
                                    weight = bundle_weight(model, sigma, trust)
                                    half = half_width(model, sigma)
                                    before = before_width(model, half, ray.norm() * z)
                                    write_ray(
                                        rays, out, fixed_point(p), ray, gradient, before, half, weight, rgb
                                    )
                                    total_weight += weight
                                    samples += n
                                    out += 1
                            above = -1
                            if more:
                                above = low + tolerance
            bands[band, START] = first_tile * TILE_SAMPLES
            bands[band, COUNT] = out - first_tile * TILE_SAMPLES
            bands[band, SAMPLES] = samples
            bands[band, WEIGHT] = total_weight
