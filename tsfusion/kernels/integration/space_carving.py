# SPDX-License-Identifier: MIT
"""Carve space by images: find the voxels that a depth image looks through, and add free-space votes.

A ray for each cell of the image would visit a voxel four times, and more often near the camera, where rays
meet. Instead each block is projected into the image once. Look-up tables have the depths up to which 3x3
pixel patches are clear. Further tables have the minimum and maximum of these depths in squares of patches,
level by level. They show that most blocks, and cubes of blocks, are completely hidden or clear.

Positions in the image are integers, linear in a voxel's coordinates: the positions of a block's corners bound
those of all its voxels. Only quotients are float32, which every processor rounds alike. With the longest
lenses and largest images the integers are as coarse as a sixty-fourth of a voxel. Rounding errors add up over
at most 3 · 63 steps from the voxel at which counting starts.
"""

from tsfusion.kernels import F32, F64, I32, I64, U8, F32x2, I32x2, I64x2, U8x2, ti
from tsfusion.kernels.base.kernel_functions import dot, product
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.sensor_noise import (
    DROPS_LONE_SAMPLES,
    MAX_RANGE,
    MIN_RANGE,
    MODEL_FIELDS,
    VOXEL_SIZE,
    bundle_weight,
    noise_sigma,
    support_width,
    vec3,
)
from tsfusion.kernels.base.voxel_traversal import pack, vec3i
from tsfusion.kernels.integration.integrate import (
    CUBE,
    QUANTA_PER_VOXEL,
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    WEIGHT_BITS,
)
from tsfusion.kernels.integration.rays_from_images import depth_at, depth_of, reading_of
from tsfusion.kernels.integration.rays_from_points import confidence_at, row

PATCH = 3  # pixels per side
GROUP = 8  # patches that are read together
WORDS, BITS = 8, 64  # of a block's mask: bit 8 y + z of word x
SIDE = 64  # side in voxels of the cubes in which blocks are looked for
MOST_SQUARES = 5  # largest side, in squares, of the area that is looked up for a cube
NEAREST = 4.0  # voxels ahead of the camera, where carving begins
MARGIN = 0.1  # patches: larger than the error of a float32 quotient
NO_SAMPLE = 1 << 30
HIDDEN, PARTLY, CLEAR = 0, 1, 2
BLOCKS, VOXELS = 0, 1  # in `counts`

# `view`, float64: the camera's centre (voxels); factors from a relative position (voxels) to column · depth,
# row · depth (patches, voxels) and depth (voxels), three numbers each; the depth up to which the view carves
# (voxels); units per such number, a power of two; fx, fy, cx, cy.
CENTRE, COLUMN, ROW, DEPTH, FAR, SCALE, FX, FY, CX, CY = 0, 3, 6, 9, 12, 13, 14, 15, 16, 17
VIEW_FIELDS = 18
FINEST = 1 << 14  # units per voxel
VIEWS = 6  # views of points: both directions along x, y and z
VIEW_TANGENT = 1.25  # of half a view's angle: views overlap, so that each cube is completely in one

# Column · depth, row · depth and depth of a voxel, in units; and their changes per step on each axis.
PixelPlace = ti.types.struct(column=ti.i32, row=ti.i32, depth=ti.i32)
Steps = ti.types.struct(column=vec3i, row=vec3i, depth=vec3i)
# Carved space: depths from `near` to `far`, units, in an image of `rows` and `columns` of patches. The last
# patches may be cut off: the image is `high` and `wide` patches large.
DepthReach = ti.types.struct(near=ti.i32, far=ti.i32, rows=ti.i32, columns=ti.i32, high=ti.f32, wide=ti.f32)


@ti.func
def view_row(view: ti.template(), first):
    """Return three neighbouring numbers of a `view` (a camera's pose and projection) as a vector."""
    return vec3(view[first], view[first + 1], view[first + 2])


@ti.func
def whole(number):
    """Round to the nearest integer: a number, or each component of a vector."""
    return ti.cast(ti.floor(number + 0.5), ti.i32)


@ti.func
def begin_cube(first, view: ti.template(), v, height, width, rows, columns):
    """Project the first voxel of a cube into view v, an image of (height, width) pixels and (rows, columns)
    of patches. Return its position there, the change per voxel step, reach and scale."""
    at = VIEW_FIELDS * v
    scale, away = view[at + SCALE], ti.cast(first * SIDE, ti.f64) + 0.5 - view_row(view, at + CENTRE)
    column, row = view_row(view, at + COLUMN), view_row(view, at + ROW)
    depth = view_row(view, at + DEPTH)
    steps = Steps(whole(column * scale), whole(row * scale), whole(depth * scale))
    corner = PixelPlace(
        whole(dot(column, away) * scale), whole(dot(row, away) * scale), whole(dot(depth, away) * scale)
    )
    near, far = ti.cast(NEAREST * scale, ti.i32), ti.cast(view[at + FAR] * scale, ti.i32)
    high, wide = ti.cast(height, ti.f32) / PATCH, ti.cast(width, ti.f32) / PATCH
    return corner, steps, DepthReach(near, far, rows, columns, high, wide), scale


@ti.func
def note_sample(depth, x, nearest: ti.template(), second: ti.template()):
    """Keep the depth of a pixel in column x if it is among the two nearest so far; 2⁻¹⁰ voxel, 0 = none."""
    q = ti.select(depth > 0, depth, NO_SAMPLE)
    second[x] = ti.min(second[x], ti.max(nearest[x], q))
    nearest[x] = ti.min(nearest[x], q)


@ti.func
def clear_up_to(model: ti.template(), nearest, second, cosine, far, scale):
    """Return the depth up to which a 3x3 patch is clear (free space), in units: a band's half-width before
    the `second` nearest of its samples, because a single sample may be wrong. It is 0 without a sample, and
    with `outlier_filter` also for one sample.

    The samples are in 2⁻¹⁰ voxel; `cosine` is of the angle between the patch and the camera's axis. All is
    float32 without a branch, so that a row of patches is computed in vectors.
    """
    unit = model[VOXEL_SIZE] / 1024.0  # metres
    least = ti.select(second < NO_SAMPLE, second, nearest)
    half = support_width(model, noise_sigma(model, least * unit)) * 4  # 2⁻¹⁰ voxel
    depth = ti.max(least - ti.cast(product(half, cosine), ti.i32), 0)
    clear = ti.cast(ti.min(product(depth, scale / 1024.0), far * scale), ti.i32)
    is_known = ti.select(model[DROPS_LONE_SAMPLES] > 0.0, second, nearest) < NO_SAMPLE
    return ti.select(is_known, clear, 0)


@ti.func
def fill_level(
    n, levels: ti.template(), clear: ti.template(), v, base, least: ti.template(), most: ti.template()
):
    """Fill level n of image v's pyramid: minimum and maximum of the clear depths in squares of patches."""
    rows = levels[0, 3]
    for y in range(levels[n, 1]):
        for x in range(levels[n, 2]):
            low, high = NO_SAMPLE, 0
            for k in ti.static(range(4)):
                i, j = 2 * y + k // 2, 2 * x + k % 2
                if n == 0:
                    i, j = v * rows + ti.min(i, rows - 1), ti.min(j, clear.shape[1] - 1)
                    low, high = ti.min(low, clear[i, j]), ti.max(high, clear[i, j])
                else:
                    i, j = ti.min(i, levels[n - 1, 1] - 1), ti.min(j, levels[n - 1, 2] - 1)
                    at = base + levels[n - 1, 0] + i * levels[n - 1, 2] + j
                    low, high = ti.min(low, least[at]), ti.max(high, most[at])
            at = base + levels[n, 0] + y * levels[n, 2] + x
            least[at], most[at] = low, high


@QuickLaunch
@ti.kernel
def fill_levels(clear: I32x2, levels: I32x2, least: I32, most: I32):
    """Fill the pyramids `least` and `most` of several images, whose patches are row below row in `clear`."""
    views = clear.shape[0] // levels[0, 3]
    for run in range(runs(views)):  # run loop: kernels/base/quick_launch.py
        v = unit_of(run, views)
        if v < views:
            for n in range(levels.shape[0]):
                fill_level(n, levels, clear, v, v * (least.shape[0] // views), least, most)


@QuickLaunch
@ti.kernel
def find_clear_depths(
    image: F32x2, is_disparity: ti.i32,
    scale: ti.f64,  # depth = image · scale, or scale / image
    confidence: U8x2, has_confidence: ti.i32, view: F64, model: F64, levels: I32x2, clear: I32x2, least: I32,
    most: I32,
):  # fmt: skip
    """Fill `clear`, (rows, columns) of patches, with the depths up to which each is free space, and `least`
    and `most` with the minimum and maximum in squares of 2×2 patches, of 4×4, and so on.

    `levels`, (n, 4): start of a level's numbers, its rows and columns, and the rows of patches.
    """
    for run in range(runs(clear.shape[0])):  # run loop: kernels/base/quick_launch.py
        r = unit_of(run, clear.shape[0])
        if r < clear.shape[0]:
            reading = reading_of(model, is_disparity, scale, has_confidence)
            nearest, second = ti.Vector([0] * (GROUP * PATCH)), ti.Vector([0] * (GROUP * PATCH))
            found, noise = ti.Vector([0] * GROUP), ti.Vector([0.0] * MODEL_FIELDS, dt=ti.f32)
            for i in ti.static(range(MODEL_FIELDS)):
                noise[i] = ti.cast(model[i], ti.f32)
            far, units = ti.cast(view[FAR], ti.f32), ti.cast(view[SCALE], ti.f32)
            top, bottom = r * PATCH, ti.min(r * PATCH + PATCH, image.shape[0])
            for group in range((clear.shape[1] + GROUP - 1) // GROUP):
                left = group * GROUP * PATCH
                right = ti.min(GROUP * PATCH, image.shape[1] - left)
                for x in range(GROUP * PATCH):
                    nearest[x], second[x] = NO_SAMPLE, NO_SAMPLE
                for v in range(top, bottom):
                    if right < GROUP * PATCH or has_confidence == 1 or is_disparity == 1:
                        for x in range(right):
                            note_sample(depth_at(image, confidence, reading, v, left + x), x, nearest, second)
                    else:
                        for x in range(GROUP * PATCH):
                            note_sample(depth_of(image[v, left + x], reading, False), x, nearest, second)
                along = ti.cast((top + PATCH // 2 - view[CY]) / view[FY], ti.f32)
                begin, step = (
                    ti.cast((left + PATCH // 2 - view[CX]) / view[FX], ti.f32),
                    ti.cast(PATCH / view[FX], ti.f32),
                )
                for p in range(GROUP):
                    across = begin + product(step, p)
                    cosine = 1.0 / ti.sqrt(1.0 + product(across, across) + product(along, along))
                    a, b, c = nearest[p * PATCH], nearest[p * PATCH + 1], nearest[p * PATCH + 2]
                    one = ti.min(a, b, c)
                    two = ti.max(ti.min(a, b), ti.min(ti.max(a, b), c))
                    for k in ti.static(range(PATCH)):
                        two = ti.min(two, second[p * PATCH + k])
                    found[p] = clear_up_to(noise, one, two, cosine, far, units)
                for p in range(ti.min(GROUP, clear.shape[1] - group * GROUP)):
                    clear[r, group * GROUP + p] = found[p]
    for _ in range(1):  # one thread: it takes less time than a launch
        for n in range(levels.shape[0]):
            fill_level(n, levels, clear, 0, 0, least, most)


@ti.func
def moved(place, steps, x, y, z):
    """Return the image position of the voxel x, y, z voxels away from one at `place`."""
    by = vec3i(x, y, z)
    return PixelPlace(
        place.column + (steps.column * by).sum(), place.row + (steps.row * by).sum(),
        place.depth + (steps.depth * by).sum(),
    )  # fmt: skip


@ti.func
def look(place, steps, side, reach, levels: ti.template(), base, least: ti.template(), most: ti.template()):
    """Return HIDDEN, CLEAR or PARTLY (possibly clear in part) for a cube of `side` voxels, whose first voxel
    has image position `place`. The image's squares start at index `base` of `least` and `most`."""
    nearest, farthest = NO_SAMPLE, -NO_SAMPLE
    left, right, top, bottom = 1e9, -1e9, 1e9, -1e9
    # Distance of the cube from each of the image's edges, if on the inner side
    inner_left, inner_top, inner_right, inner_bottom = -1.0, -1.0, -1.0, -1.0
    for k in ti.static(range(8)):
        n = side - 1
        corner = moved(place, steps, n * (k >> 2), n * (k >> 1 & 1), n * (k & 1))
        nearest, farthest = ti.min(nearest, corner.depth), ti.max(farthest, corner.depth)
        column, row = ti.cast(corner.column, ti.f64), ti.cast(corner.row, ti.f64)
        depth = ti.cast(corner.depth, ti.f64)
        inner_left, inner_top = ti.max(inner_left, column), ti.max(inner_top, row)
        inner_right = ti.max(inner_right, reach.columns * depth - column)
        inner_bottom = ti.max(inner_bottom, reach.rows * depth - row)
        inverse = 1.0 / ti.max(depth, 1.0)
        left, right = ti.min(left, column * inverse), ti.max(right, column * inverse)
        top, bottom = ti.min(top, row * inverse), ti.max(bottom, row * inverse)
    found = HIDDEN
    if (
        ti.min(inner_left, inner_top, inner_right, inner_bottom) >= 0.0
        and farthest >= reach.near
        and nearest < reach.far
    ):
        if nearest < reach.near:
            found = PARTLY  # the cube may lie anywhere in the image, or behind the camera
        else:
            x0 = ti.cast(ti.max(left - MARGIN, 0.0), ti.i32)
            y0 = ti.cast(ti.max(top - MARGIN, 0.0), ti.i32)
            x1 = ti.cast(ti.min(right + MARGIN, reach.columns - 1.0), ti.i32)
            y1 = ti.cast(ti.min(bottom + MARGIN, reach.rows - 1.0), ti.i32)
            n, up = 0, 1  # the level, and the power of two of its squares' width
            while ti.max((x1 >> up) - (x0 >> up), (y1 >> up) - (y0 >> up)) >= MOST_SQUARES:
                n, up = n + 1, up + 1  # the last level is a single square
            low, high = NO_SAMPLE, 0
            for y in range(y0 >> up, (y1 >> up) + 1):
                for x in range(x0 >> up, (x1 >> up) + 1):
                    at = base + levels[n, 0] + y * levels[n, 2] + x
                    low, high = ti.min(low, least[at]), ti.max(high, most[at])
                if low <= farthest and high > nearest:
                    break  # the other squares change nothing
            if high > nearest:
                found = PARTLY
                is_inside = left >= MARGIN and top >= MARGIN
                is_inside &= right < reach.wide - MARGIN and bottom < reach.high - MARGIN
                if low > farthest and is_inside:
                    found = CLEAR
    return found


@ti.func
def look_at_middle(place, steps, side, reach, clear: ti.template(), top):
    """Return a cube's state by the patch at its middle alone: HIDDEN or CLEAR if the cube is wholly beyond or
    before the patch's clear depth, else PARTLY; CLEAR outside the image. The image's rows start at `top`."""
    middle = moved(place, steps, side // 2, side // 2, side // 2)
    inverse = 1.0 / ti.cast(ti.max(middle.depth, 1), ti.f32)
    x, y = ti.cast(middle.column * inverse, ti.i32), ti.cast(middle.row * inverse, ti.i32)
    found = CLEAR
    if x >= 0 and y >= 0 and x < reach.columns and y < reach.rows and middle.depth > reach.near:
        n, up_to = side - 1, clear[top + y, x]
        if up_to <= place.depth + n * ti.min(steps.depth, vec3i(0)).sum():
            found = HIDDEN
        elif up_to <= place.depth + n * ti.max(steps.depth, vec3i(0)).sum():
            found = PARTLY
    return found


@ti.func
def block_in_cube(n):
    """Return the n-th block of a cube, in an order that keeps the blocks of every smaller cube together."""
    return vec3i(
        (n & 1) | (n >> 2 & 2) | (n >> 4 & 4), (n >> 1 & 1) | (n >> 3 & 2) | (n >> 5 & 4),
        (n >> 2 & 1) | (n >> 4 & 2) | (n >> 6 & 4),
    )  # fmt: skip


@ti.func
def free_vote(model: ti.template(), view: ti.template(), depth):
    """Return the amount to add to a clear voxel at this depth (voxels): the votes of a ray through each pixel
    that the voxel covers, with a band's half-width as their distance."""
    sigma = noise_sigma(model, depth * model[VOXEL_SIZE])
    pixel = depth / ti.min(view[FX], ti.abs(view[FY]))  # voxels that a pixel spans
    weight = bundle_weight(model, sigma, 255.0 / ti.max(product(pixel, pixel), 1e-3))
    distance = (support_width(model, sigma) * QUANTA_PER_VOXEL + 128) >> 8
    return (ti.cast(distance * weight, ti.i64) << WEIGHT_BITS) + weight


@ti.func
def mark_clear(
    place, steps, reach, clear: ti.template(), columns_by: ti.template(), rows_by: ti.template(),
    depths_by: ti.template(), depths: ti.template(), patches: ti.template(), words: ti.template(),
):  # fmt: skip
    """Set the bit mask `words` of clear voxels of the block whose first voxel is at image position `place`.
    Returns their number. The first loop has no branch, so that it becomes vectors."""
    count = 0
    for x in range(WORDS):
        base = moved(place, steps, x, 0, 0)
        for i in range(BITS):
            column, row = base.column + columns_by[i], base.row + rows_by[i]
            depth = base.depth + depths_by[i]
            inverse = 1.0 / ti.cast(ti.max(depth, 1), ti.f32)
            u, v = ti.cast(column, ti.f32) * inverse, ti.cast(row, ti.f32) * inverse
            is_seen = (column >= 0) & (row >= 0) & (u < reach.wide) & (v < reach.high)
            is_seen &= depth >= reach.near
            patches[i] = ti.select(is_seen, ti.cast(v, ti.i32) * reach.columns + ti.cast(u, ti.i32), 0)
            depths[i] = ti.select(is_seen, depth, NO_SAMPLE)
        word = ti.i64(0)
        for i in range(BITS):
            word |= ti.cast(ti.select(depths[i] < clear[0, patches[i]], 1, 0), ti.i64) << i
        words[x] = word
        count += ti.math.popcnt(word)
    return count


@QuickLaunch
@ti.kernel
def list_free_blocks(
    clear: I32x2,
    height: ti.i32,  # pixels
    width: ti.i32, levels: I32x2, least: I32, most: I32, view: F64, model: F64,
    cubes: I32,  # the first of them, and how many on each axis
    keys: I64, amounts: I64, masks: I64x2, counts: I32,
):  # fmt: skip
    """List the blocks with voxels that an image looks through: their keys, masks of these voxels, and the
    addition to each. `counts` gets the number of blocks and voxels; a full list ends early."""
    for run in range(runs(cubes[3] * cubes[4] * cubes[5])):  # run loop: kernels/base/quick_launch.py
        n = unit_of(run, cubes[3] * cubes[4] * cubes[5])
        if n < cubes[3] * cubes[4] * cubes[5]:
            first = vec3i(
                cubes[0] + n // (cubes[4] * cubes[5]), cubes[1] + n // cubes[5] % cubes[4],
                cubes[2] + n % cubes[5],
            )  # fmt: skip
            corner, steps, reach, scale = begin_cube(
                first, view, 0, height, width, clear.shape[0], clear.shape[1]
            )
            depths, patches = ti.Vector([0] * BITS), ti.Vector([0] * BITS)
            words = ti.Vector([0] * WORDS, dt=ti.i64)
            columns_by, rows_by = ti.Vector([0] * BITS), ti.Vector([0] * BITS)
            depths_by = ti.Vector([0] * BITS)
            for i in range(BITS):
                by = moved(PixelPlace(0, 0, 0), steps, 0, i >> 3, i & 7)
                columns_by[i], rows_by[i], depths_by[i] = by.column, by.row, by.depth
            b = 0
            while b < CUBE and counts[BLOCKS] <= keys.shape[0]:
                block, side = block_in_cube(b), 8
                for power in ti.static((1, 2, 3)):  # a larger cube begins here
                    if b & ((1 << (3 * power)) - 1) == 0:
                        side = 8 << power
                place = moved(corner, steps, 8 * block[0], 8 * block[1], 8 * block[2])
                found, passed = PARTLY, 1
                while side >= 8 and found != HIDDEN:
                    found = look(place, steps, side, reach, levels, 0, least, most)
                    if found == HIDDEN:
                        passed = (side >> 3) ** 3
                    side >>= 1
                if found == PARTLY:
                    found = mark_clear(
                        place, steps, reach, clear, columns_by, rows_by, depths_by, depths, patches, words
                    )
                elif found == CLEAR:
                    found = CUBE
                    for x in ti.static(range(WORDS)):
                        words[x] = ti.i64(-1)
                if found > 0:
                    ti.atomic_add(counts[VOXELS], found)
                    at = ti.atomic_add(counts[BLOCKS], 1)
                    if at < keys.shape[0]:
                        key, middle = first * WORDS + block, moved(place, steps, 4, 4, 4)
                        keys[at] = pack(key[0], key[1], key[2])
                        amounts[at] = free_vote(model, view, middle.depth / scale)
                        for x in ti.static(range(WORDS)):
                            masks[at, x] = words[x]
                b += passed


@QuickLaunch
@ti.kernel
def list_clear_blocks(
    clear: I32x2, height: ti.i32, width: ti.i32, levels: I32x2, least: I32, most: I32, views: F64,
    cubes: I32x2, least_power: ti.i32, keys: I64, counts: I32,
):  # fmt: skip
    """List the keys of the blocks that images look through completely, once per image, and their number. They
    lie in clear cubes of at least 8 · 2^`least_power` voxels per side. `clear` has the images' patches, rows
    one below the other, `least` and `most` their pyramids (`fill_levels`) in a row. `cubes` has for each
    image the index of its first cube of 64 voxels in the list of all cubes, that cube, and the cubes per
    axis. Its last entry is the end of the list."""
    images = cubes.shape[0] - 1
    units, rows, squares = cubes[images, 0], clear.shape[0] // images, least.shape[0] // images
    for run in range(runs(units)):  # run loop: kernels/base/quick_launch.py
        unit = unit_of(run, units)
        if unit < units:
            v = 0
            while cubes[v + 1, 0] <= unit:
                v += 1
            n = unit - cubes[v, 0]
            first = vec3i(
                cubes[v, 1] + n // (cubes[v, 5] * cubes[v, 6]), cubes[v, 2] + n // cubes[v, 6] % cubes[v, 5],
                cubes[v, 3] + n % cubes[v, 6],
            )  # fmt: skip
            corner, steps, reach, _ = begin_cube(first, views, v, height, width, rows, clear.shape[1])
            b = 0
            while b < CUBE:
                block, power = block_in_cube(b), least_power
                while power < 3 and b & ((8 << (3 * power)) - 1) == 0:
                    power += 1  # a larger cube begins here
                place = moved(corner, steps, 8 * block[0], 8 * block[1], 8 * block[2])
                found, passed = PARTLY, 1 << (3 * least_power)
                while power >= least_power and found == PARTLY:
                    found = look_at_middle(place, steps, 8 << power, reach, clear, rows * v)
                    if found == CLEAR or (found == HIDDEN and power > least_power):
                        found = look(place, steps, 8 << power, reach, levels, squares * v, least, most)
                    if found != PARTLY:
                        passed = 1 << (3 * power)
                    power -= 1
                if found == CLEAR:
                    at = ti.atomic_add(counts[BLOCKS], passed)
                    for i in range(ti.min(passed, keys.shape[0] - at)):
                        key = first * WORDS + block_in_cube(b + i)
                        keys[at + i] = pack(key[0], key[1], key[2])
                b += passed


@QuickLaunch
@ti.kernel
def see_points(
    points: F32x2, starts: F32x2, confidence: U8, has_confidence: ti.i32, step: ti.i32, centre: F32,
    model: F64, units: ti.f64, ends: I32x2, seen: I32,
):  # fmt: skip
    """Draw every `step`-th point of a scan into six square images around `centre`, towards ±x, ±y and ±z. A
    patch gets the clear depth before its nearest point, in `units` per voxel.

    `ends` has the images' rows one below the other, `NO_SAMPLE` without a point; `seen` marks used images. A
    point too near for the map makes its patch's clear depth 0.
    """
    near, far = ti.cast(model[MIN_RANGE] ** 2, ti.f32), ti.cast(model[MAX_RANGE] ** 2, ti.f32)
    own_starts = ti.select(starts.shape[0] == 1, 0, 1)
    for run in range(runs(VIEWS)):  # run loop: kernels/base/quick_launch.py
        v = unit_of(run, VIEWS)
        if v < VIEWS:
            side = ends.shape[1]
            along, sign = v >> 1, ti.cast(1 - 2 * (v & 1), ti.f32)
            across, down = (along + 1) % 3, (along + 2) % 3
            for n in range((points.shape[0] + step - 1) // step):
                i = n * step
                depth = sign * (points[i, along] - centre[along])
                x, y = points[i, across] - centre[across], points[i, down] - centre[down]
                if depth > 0.0 and ti.max(ti.abs(x), ti.abs(y)) < VIEW_TANGENT * depth:
                    q, o = row(points, i), row(starts, i * own_starts)
                    away = dot(q - o, q - o)
                    trusted = confidence_at(q, o, near, far, confidence, has_confidence, i) > 0
                    if trusted or away < near:
                        u = ti.cast((x / depth + VIEW_TANGENT) * (side / (2 * VIEW_TANGENT)), ti.i32)
                        v_down = ti.cast((y / depth + VIEW_TANGENT) * (side / (2 * VIEW_TANGENT)), ti.i32)
                        at = v * side + ti.min(v_down, side - 1), ti.min(u, side - 1)
                        reach = ti.sqrt(ti.cast(away, ti.f64))
                        support = support_width(model, noise_sigma(model, reach)) * model[VOXEL_SIZE] / 256.0
                        clear = depth / model[VOXEL_SIZE] * ti.max(1.0 - support / reach, 0.0) * units
                        if not trusted:
                            clear = 0.0
                        ends[at] = ti.min(ends[at], ti.cast(ti.min(clear, NO_SAMPLE - 1.0), ti.i32))
                        seen[v] = 1


@QuickLaunch
@ti.kernel
def add_free_blocks(
    slots: I32, amounts: I64, masks: I64x2, sign_: ti.i32, version: ti.i32, versions: I32, places: I32,
    touched: I32, sums: I64x2,
):  # fmt: skip
    """Add free-space votes to the clear voxels of the blocks in `slots` (distinct). Blocks that keyframe
    `version` has not touched yet are listed."""
    for run in range(runs(slots.shape[0])):  # run loop: kernels/base/quick_launch.py
        n = unit_of(run, slots.shape[0])
        if n < slots.shape[0]:
            slot, amount, lanes = slots[n], sign_ * amounts[n], ti.Vector([0] * BITS, dt=ti.i64)
            if versions[slot] != version:
                place = ti.atomic_add(touched[TOUCHED_COUNT], 1)
                touched[TOUCHED_HEADER + place] = slot
                versions[slot], places[slot] = version, place
            for x in range(WORDS):
                word = masks[n, x]
                if word != 0:
                    for i in range(BITS):  # three loops, so that each becomes vectors
                        lanes[i] = sums[slot, x * BITS + i]
                    for i in range(BITS):
                        lanes[i] += amount & -((word >> i) & 1)
                    for i in range(BITS):
                        sums[slot, x * BITS + i] = lanes[i]
