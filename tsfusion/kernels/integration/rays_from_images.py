# SPDX-License-Identifier: MIT
"""Make rays from depth or disparity images.

An image is read in tiles of 12×12 pixels. A cell of a tile is about as wide as a voxel. Its pixels become one
ray through their mean for each layer of depth. In a flat tile, the tile's plane gives the distance from the
ray's voxels to the surface. Elsewhere it is the distance to the ray's end. Sums are integers, so no result
depends on threads. With `bundle = 0` every pixel is a ray. One unit of parallel work is a strip, a contiguous
run of tiles with its own region of the ray buffer.
"""

from tsfusion.kernels import F64, ANYx2, F64x2, I32x2, U8x2, ti
from tsfusion.kernels.base.kernel_functions import cross, dot, norm, product, quotient
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.sensor_noise import (
    DROPS_LONE_SAMPLES,
    MAX_RANGE,
    MIN_RANGE,
    VOXEL_SIZE,
    behind_width,
    bundle_weight,
    fixed_point,
    in_reach,
    layer_depth,
    noise_sigma,
    support_width,
    vec3,
)
from tsfusion.kernels.base.voxel_traversal import vec3i, write_ray, write_strip

TILE = 12  # divisible by both sides of every cell
TILE_SAMPLES = TILE * TILE
FEW = 15  # a number of rows or columns of a tile has four bits
assert TILE <= FEW
CELLS = ((2, 1), (2, 2), (3, 2), (3, 3), (4, 3), (4, 4), (6, 4), (6, 6), (12, 6), (12, 12))  # wide, high
CELL_AREA = 1.0  # largest area of a cell in voxels, across the ray
PLANE_STEP = 2  # a plane is fitted to every second pixel of every second row
LEAST, GREATEST, SUM = 0, TILE, 2 * TILE  # fields for each column of a row of cells, about its depths
MOST_SUMMED = 1 << 27  # limit of the depth: the sum of twelve such pixels has 31 bits
LEAST_PLANE = 9  # least number of pixels for a plane
PLANE_NOISE = 2.0  # limit of a plane's mean squared residual, in σ² …
PLANE_ROUGHNESS = 0.1 * 1024.0  # … and, squared, on top of it: 2⁻¹⁰ voxel
PLANE_SIGMA = 1.0  # voxels: with more noise a plane says nothing about voxels
LEAST_FACING = 0.15  # cosine between plane normal and ray: a surface seen more edge-on has no plane


# Conversion of an image's numbers to depths. `per_metre`: 2⁻¹⁰ voxels a metre.
DepthReading = ti.types.struct(
    is_disparity=ti.i32, scale=ti.f32, has_confidence=ti.i32, near=ti.f32, far=ti.f32, per_metre=ti.f32
)
# Voxels: changes of a pixel ray's direction per column and per row, direction of pixel (0, 0); start of all
# rays.
CameraArgs = ti.types.struct(du=vec3, dv=vec3, corner=vec3, origin=vec3)
# Pixels of a tile: from (x, y), counted from the tile's corner (left, top); its depths begin at index `base`.
Cell = ti.types.struct(left=ti.i32, top=ti.i32, x=ti.i32, y=ti.i32, wide=ti.i32, high=ti.i32, base=ti.i32)
# A tile's plane, if it is flat: slopes of the depth, 2⁻¹⁰ voxel a pixel.
Plane = ti.types.struct(is_flat=ti.i32, slope_x=ti.f32, slope_y=ti.f32)
# Samples of a cell with depths in [low, up_to]: the deepest, their number, Σ depth, Σ x, Σ y.
Layer = ti.types.struct(
    low=ti.i32, up_to=ti.i32, deepest=ti.i32, n=ti.i32, sum_q=ti.i64, sum_x=ti.i32, sum_y=ti.i32
)


def tiles_of(height: int, width: int) -> int:
    """Return the number of tiles of an image."""
    return -(-height // TILE) * -(-width // TILE)


def most_rays(height: int, width: int) -> int:
    """Return the capacity, in rays, that the ray buffer of an image needs."""
    return tiles_of(height, width) * TILE_SAMPLES


def are_given(sums: object) -> bool:
    """Return True for sums of columns (`column_sums`, `color_sums`), False for None, at compile time."""
    return sums is not None


@ti.func
def camera_of(rows: ti.template()):
    """Convert the (4, 3) rows of `ray_buffers._camera` to a `CameraArgs`: intrinsics and pose in a struct."""
    du, dv = vec3(rows[0, 0], rows[0, 1], rows[0, 2]), vec3(rows[1, 0], rows[1, 1], rows[1, 2])
    corner, origin = vec3(rows[2, 0], rows[2, 1], rows[2, 2]), vec3(rows[3, 0], rows[3, 1], rows[3, 2])
    return CameraArgs(du, dv, corner, origin)


@ti.func
def reading_of(model: ti.template(), is_disparity, scale, has_confidence):
    """Return the rule that converts an image's numbers to depths. `scale`, float64, is metres per number or,
    for disparities, metres times numbers."""
    near, far = ti.cast(model[MIN_RANGE], ti.f32), ti.cast(model[MAX_RANGE], ti.f32)
    per_metre = ti.cast(1.0 / (model[VOXEL_SIZE] / 1024.0), ti.f32)
    return DepthReading(is_disparity, ti.cast(scale, ti.f32), has_confidence, near, far, per_metre)


@ti.func
def few(count):
    """Return a small loop bound: a number of rows or columns of a tile. Without this hint LLVM adds a loop
    for 32 at once, which never runs and takes long to compile."""
    return count & FEW


@ti.func
def depth_of(raw, reading, divides: ti.template()):
    """Convert a pixel's number to its depth in 2⁻¹⁰ voxel; 0 = no usable return. All is float32 without a
    branch, so that a row of a tile is read in vectors. With `divides` the number may be a disparity."""
    z = raw * reading.scale
    if ti.static(divides):
        if reading.is_disparity == 1:
            z = quotient(reading.scale, ti.max(raw, 1e-9))
    # False also for NaN
    usable = (raw > 0.0) & (z >= reading.near) & (z <= reading.far)
    return ti.select(usable, ti.cast(z * reading.per_metre, ti.i32), 0)


@ti.func
def depth_at(image: ti.template(), confidence: ti.template(), reading, v, u):
    """Return the depth of a pixel in 2⁻¹⁰ voxel; 0 = no usable return."""
    q = depth_of(ti.cast(image[v, u], ti.f32), reading, True)
    if reading.has_confidence == 1:
        if confidence[v, u] == 0:
            q = 0
    return q


@ti.func
def load_tile(image: ti.template(), confidence: ti.template(), reading, left, top, depths: ti.template()):
    """Fill `depths` with the depths of the tile at (`left`, `top`). Returns their count and their sum."""
    bottom = ti.min(TILE, image.shape[0] - top)
    right = ti.min(TILE, image.shape[1] - left)
    if bottom < TILE or right < TILE:
        for i in range(TILE_SAMPLES):
            depths[i] = 0
        for y in range(few(bottom)):
            for x in range(few(right)):
                depths[y * TILE + x] = depth_of(ti.cast(image[top + y, left + x], ti.f32), reading, True)
    else:
        for y in range(TILE):
            for x in range(TILE):
                depths[y * TILE + x] = depth_of(ti.cast(image[top + y, left + x], ti.f32), reading, True)
    if reading.has_confidence == 1:
        for y in range(few(bottom)):
            for x in range(few(right)):
                if confidence[top + y, left + x] == 0:
                    depths[y * TILE + x] = 0
    valid = 0
    total = ti.i64(0)
    for i in range(TILE_SAMPLES):
        valid += ti.cast(depths[i] > 0, ti.i32)
        total += depths[i]
    return valid, total


@ti.func
def fit_plane(depths: ti.template(), base, anchor, sigma):
    """Fit q = c + x·slope_x + y·slope_y, a depth plane, by least squares over a lattice of the tile whose
    depths begin at `base`. Depths and `sigma` are in 2⁻¹⁰ voxel; `anchor` is near the depths."""
    sx, sy, sxx, sxy, syy, n = 0, 0, 0, 0, 0, 0
    sq, sxq, syq, sqq = 0, 0, 0, ti.i64(0)
    for row in range(TILE // PLANE_STEP):
        y = row * PLANE_STEP
        row_n, row_x, row_xx, row_q, row_xq = 0, 0, 0, 0, 0
        for column in range(TILE // PLANE_STEP):
            x = column * PLANE_STEP
            q = depths[base + y * TILE + x]
            here = ti.cast(q > 0, ti.i32)
            d = ti.select(q > 0, ti.min(ti.max(q - anchor, -(1 << 20)), 1 << 20), 0)
            row_n += here
            row_x += x * here
            row_xx += x * x * here
            row_q += d
            row_xq += d * x
            sqq += ti.cast(d, ti.i64) * d
        n += row_n
        sx += row_x
        sy += y * row_n
        sxx += row_xx
        sxy += y * row_x
        syy += y * y * row_n
        sq += row_q
        sxq += row_xq
        syq += row_q * y
    is_flat, slope_x, slope_y = 0, 0.0, 0.0
    if n >= LEAST_PLANE:
        mean_q = ti.cast(sq, ti.f64) / n
        cxx = sxx - ti.cast(sx * sx, ti.f64) / n
        cyy = syy - ti.cast(sy * sy, ti.f64) / n
        cxy = sxy - ti.cast(sx * sy, ti.f64) / n
        cxq = ti.cast(sxq, ti.f64) - product(mean_q, sx)
        cyq = ti.cast(syq, ti.f64) - product(mean_q, sy)
        determinant = product(cxx, cyy) - product(cxy, cxy)
        if determinant > 0.05 * cxx * cyy:
            slope_x = (product(cxq, cyy) - product(cyq, cxy)) / determinant
            slope_y = (product(cyq, cxx) - product(cxq, cxy)) / determinant
            left_over = ti.cast(sqq, ti.f64) - product(mean_q, sq)
            left_over -= product(slope_x, cxq)
            left_over -= product(slope_y, cyq)
            noise = product(PLANE_NOISE * sigma, sigma)
            if left_over < n * (noise + PLANE_ROUGHNESS * PLANE_ROUGHNESS):
                is_flat = 1
    return Plane(is_flat, slope_x, slope_y)


@ti.func
def tile_plane(model: ti.template(), unit, mean, depths: ti.template(), base):
    """Return the plane of a tile of `mean` depth (metres), marked flat if its depths fit within the noise."""
    plane = Plane(0, 0.0, 0.0)
    sigma = noise_sigma(model, mean)
    if sigma < PLANE_SIGMA * model[VOXEL_SIZE]:
        plane = fit_plane(depths, base, ti.cast(mean / unit, ti.i32), sigma / unit)
    return plane


@ti.func
def plane_gradient(ray, du, dv, z, slope_x, slope_y):
    """Return n / (n·u) of the plane through `ray`·z with these slopes (normal n); zero if seen edge-on."""
    right, down = product(du, z) + product(ray, slope_x), product(dv, z) + product(ray, slope_y)
    normal = cross(right, down)
    along = dot(normal, ray)
    gradient = vec3(0.0)
    if along * along > LEAST_FACING * LEAST_FACING * dot(normal, normal) * dot(ray, ray):
        gradient = normal * (norm(ray) / along)
    return gradient


@ti.func
def pixel_width(camera):
    """Return the width of a pixel, in voxels, at a depth of one metre."""
    return ti.max(norm(camera.du), norm(camera.dv))


@ti.func
def cell_shape(pixel):
    """Return width and height in pixels of the largest cell within `CELL_AREA`, voxels². `pixel`: voxels."""
    wide, high = 1, 1
    for w, h in ti.static(CELLS):
        if w * h * pixel * pixel <= CELL_AREA:
            wide, high = w, h
    return wide, high


@ti.func
def layer_sums(depths: ti.template(), cell, low, up_to):
    """Return sums of the cell's samples in depths [`low`, `up_to`], and the next depth (1 << 30: none)."""
    least, deepest, beyond, n, sum_q, sum_x, sum_y = 1 << 30, 0, 1 << 30, 0, ti.i64(0), 0, 0
    for row in range(few(cell.high)):
        y = cell.y + row
        for column in range(few(cell.wide)):
            x = cell.x + column
            q = depths[cell.base + y * TILE + x]
            inside = (q >= low) & (q <= up_to)
            one = ti.cast(inside, ti.i32)
            least = ti.min(least, ti.select(inside, q, 1 << 30))
            deepest = ti.max(deepest, ti.select(inside, q, 0))
            beyond = ti.min(beyond, ti.select(q > up_to, q, 1 << 30))
            n += one
            sum_q += ti.select(inside, q, 0)
            sum_x += x * one
            sum_y += y * one
    return Layer(least, up_to, deepest, n, sum_q, sum_x, sum_y), beyond


@ti.func
def column_sums(depths: ti.template(), first, high, columns: ti.template()):
    """Write the smallest, largest and summed depth of each column of `high` rows of a tile."""
    for x in range(TILE):
        columns[LEAST + x] = 1 << 30
        columns[GREATEST + x] = 0
        columns[SUM + x] = 0
    for row in range(few(high)):
        y = first + row
        for x in range(TILE):
            q = depths[y * TILE + x]
            columns[LEAST + x] = ti.min(columns[LEAST + x], q)
            columns[GREATEST + x] = ti.max(columns[GREATEST + x], q)
            columns[SUM + x] += q


@ti.func
def samples_of(depths: ti.template(), columns: ti.template(), cell):
    """Return the sums of all samples of a cell. `columns` is the result of `column_sums`, or None."""
    samples, is_known = Layer(1 << 30, 1 << 30, 0, 0, 0, 0, 0), 0
    if ti.static(are_given(columns)):
        low, deepest, sum_q = 1 << 30, 0, ti.i64(0)
        for column in range(few(cell.wide)):
            x = cell.x + column
            low = ti.min(low, columns[LEAST + x])
            deepest = ti.max(deepest, columns[GREATEST + x])
            sum_q += columns[SUM + x]
        if low > 0 and deepest < MOST_SUMMED:  # every pixel has a depth
            n = cell.wide * cell.high
            sum_x, sum_y = cell.x * n + n * (cell.wide - 1) // 2, cell.y * n + n * (cell.high - 1) // 2
            samples, is_known = Layer(low, 1 << 30, deepest, n, sum_q, sum_x, sum_y), 1
        elif deepest <= 0:
            is_known = 1
    if is_known == 0:
        samples, _ = layer_sums(depths, cell, 1, 1 << 30)
    return samples


@ti.func
def take_nearest(model: ti.template(), unit, depths: ti.template(), cell, rest: ti.template()):
    """Take the nearest surface layer from `rest`, the samples of a cell that are not yet in a layer."""
    layer = rest
    tolerance = ti.cast(ti.min(layer_depth(model, rest.low * unit) / unit, 1e9), ti.i32)
    layer.up_to = rest.low + tolerance
    if rest.deepest > layer.up_to:
        layer, beyond = layer_sums(depths, cell, rest.low, layer.up_to)
        rest.low = beyond
        rest.n = ti.select(layer.n > 0, rest.n - layer.n, 0)
        rest.sum_q -= layer.sum_q
        rest.sum_x -= layer.sum_x
        rest.sum_y -= layer.sum_y
    else:
        rest.n = 0
    return layer


@ti.func
def is_supported(image: ti.template(), confidence: ti.template(), reading, cell, layer):
    """Return True if one of eight neighbour pixels has nearly the same depth as a layer's only sample."""
    v, u = cell.top + layer.sum_y, cell.left + layer.sum_x
    found = 0
    for k in range(9):
        y = v + k // 3 - 1
        x = u + k % 3 - 1
        if found == 0 and k != 4 and y >= 0 and y < image.shape[0] and x >= 0 and x < image.shape[1]:
            other = depth_at(image, confidence, reading, y, x)
            if other > 0 and abs(other - layer.low) <= layer.up_to - layer.low:
                found = 1
    return found


@ti.func
def color_sums(color: ti.template(), left, top, first, high, columns: ti.template()):
    """Write the sums of blue, green and red in each column of `high` rows of a tile, within the image."""
    for x in range(3 * TILE):
        columns[x] = 0
    right = ti.min(3 * TILE, color.shape[1] - 3 * left)
    for y in range(top + first, ti.min(top + first + high, color.shape[0])):
        for x in range(right):
            columns[x] += ti.cast(color[y, 3 * left + x], ti.i32)


@ti.func
def layer_color(
    color: ti.template(), has_color, confidence: ti.template(), has_confidence, depths: ti.template(),
    colors: ti.template(), cell, layer,
):  # fmt: skip
    """Return a layer's mean colour 0xRRGGBB and summed confidence; `colors` is from `color_sums`, or None."""
    n, bgr, trust = layer.n, vec3i(0), 0
    is_summed = 0
    if ti.static(are_given(colors)):
        if n == cell.wide * cell.high and has_confidence == 0:
            is_summed = 1
            for column in range(few(cell.wide)):
                x = cell.x + column
                for c in ti.static(range(3)):
                    bgr[c] += colors[3 * x + c]
    if is_summed == 0:
        for row in range(few(cell.high)):
            y = cell.y + row
            for column in range(few(cell.wide)):
                x = cell.x + column
                q = depths[cell.base + y * TILE + x]
                if q >= layer.low and q <= layer.up_to:
                    if has_confidence == 1:
                        trust += ti.cast(confidence[cell.top + y, cell.left + x], ti.i32)
                    if has_color == 1:
                        for c in ti.static(range(3)):
                            bgr[c] += ti.cast(color[cell.top + y, 3 * (cell.left + x) + c], ti.i32)
    if has_confidence == 0:
        trust = 255 * n
    return ((bgr[2] // n) << 16) | ((bgr[1] // n) << 8) | (bgr[0] // n), trust


@ti.func
def write_layer_ray(
    rays: ti.template(), r, first, model: ti.template(), camera, plane, unit, color: ti.template(), has_color,
    confidence: ti.template(), has_confidence, depths: ti.template(), colors: ti.template(), cell, layer,
):  # fmt: skip
    """Write ray `r` through the mean of a layer's samples. Returns its weight (0 if out of range), and the
    cost of its addition.

    This is eq. 1 of the paper (u = column, v = row), in voxels: point = origin + z (u·du + v·dv + corner).
    """
    n = layer.n
    z = (ti.cast(layer.sum_q, ti.f64) / n + 0.5) * unit
    u = cell.left + ti.cast(layer.sum_x, ti.f64) / n
    v = cell.top + ti.cast(layer.sum_y, ti.f64) / n
    direction = camera.corner + product(camera.du, u) + product(camera.dv, v)
    p = camera.origin + product(direction, z)
    weight, cost = 0, 0
    if in_reach(p):
        rgb, trust = 0, 255 * n
        if has_confidence == 1 or has_color == 1:
            rgb, trust = layer_color(
                color, has_color, confidence, has_confidence, depths, colors, cell, layer
            )
        gradient = vec3(0.0)
        if plane.is_flat == 1:
            gradient = plane_gradient(
                direction, camera.du, camera.dv, z, plane.slope_x * unit, plane.slope_y * unit
            )
        sigma = noise_sigma(model, z)
        weight = bundle_weight(model, sigma, trust)
        support = support_width(model, sigma)
        behind = behind_width(model, sigma, support)
        cost = write_ray(
            rays, r, first, fixed_point(p), direction, gradient, support, support, behind, weight, rgb
        )
    return weight, cost


@QuickLaunch
@ti.kernel
def rays_from_image(
    image: ANYx2, is_disparity: ti.i32,
    scale: ti.f64,  # depth = image · scale, or scale / image
    color: U8x2,  # (H, 3 W): blue, green, red
    has_color: ti.i32, confidence: U8x2, has_confidence: ti.i32,
    camera_rows: F64x2,  # (4, 3): `Camera`
    model: F64, bundle: ti.i32, rays: I32x2, strips: I32x2,
):  # fmt: skip
    """Fill `rays` with a ray for each layer of depth of each cell, tile by tile, and list the `strips`."""
    tiles_x = (image.shape[1] + TILE - 1) // TILE
    tiles = tiles_x * ((image.shape[0] + TILE - 1) // TILE)
    count = strips.shape[0]
    unit = model[VOXEL_SIZE] / 1024.0  # metres
    for run in range(runs(count)):  # run loop: kernels/base/quick_launch.py
        strip = unit_of(run, count)
        if strip < count:
            camera = camera_of(camera_rows)
            reading = reading_of(model, is_disparity, scale, has_confidence)
            first_tile = ti.cast(ti.cast(strip, ti.i64) * tiles // count, ti.i32)
            last_tile = ti.cast(ti.cast(strip + 1, ti.i64) * tiles // count, ti.i32)
            first_ray = first_tile * TILE_SAMPLES
            out = first_ray
            depths, columns = ti.Vector([0] * TILE_SAMPLES), ti.Vector([0] * (3 * TILE))
            colors = ti.Vector([0] * (3 * TILE))
            samples, total_weight, total_cost = 0, 0, ti.i64(0)
            for tile in range(first_tile, last_tile):
                left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
                valid, total = load_tile(image, confidence, reading, left, top, depths)
                wide, high, plane = 1, 1, Plane(0, 0.0, 0.0)
                if valid > 0 and bundle == 1:
                    mean = ti.cast(total, ti.f64) / valid * unit
                    wide, high = cell_shape(mean * pixel_width(camera))
                    plane = tile_plane(model, unit, mean, depths, 0)
                across = TILE // wide
                cells = ti.select(valid > 0, across * (TILE // high), 0)
                for c in range(cells):
                    cell = Cell(left, top, c % across * wide, c // across * high, wide, high, 0)
                    if cell.x == 0:
                        column_sums(depths, cell.y, high, columns)
                        if has_color == 1:
                            color_sums(color, left, top, cell.y, high, colors)
                    rest = samples_of(depths, columns, cell)
                    while rest.n > 0:  # one layer of depth after the other
                        layer = take_nearest(model, unit, depths, cell, rest)
                        keep = layer.n > 0
                        if layer.n == 1 and model[DROPS_LONE_SAMPLES] > 0.0:
                            keep = 1 == is_supported(image, confidence, reading, cell, layer)
                        if keep:
                            weight, cost = write_layer_ray(
                                rays, out, first_ray, model, camera, plane, unit, color, has_color,
                                confidence, has_confidence, depths, colors, cell, layer,
                            )  # fmt: skip
                            if weight > 0:
                                total_weight += weight
                                total_cost += cost
                                samples += layer.n
                                out += 1
            write_strip(strips, strip, first_ray, out, samples, total_weight, total_cost)
