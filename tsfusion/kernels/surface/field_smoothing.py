# SPDX-License-Identifier: MIT
"""Smooth the field (the regulariser): eq. 3 of the paper, extended from the ray to the volume.

    x̂ = argmin Σ W (x − y)² + λ Σ over the three axes of ω |D2 x|²      D2: second differences

y = Σ w·m / Σ w and W = Σ w are read from the map. x near a flat surface is a ramp with D2 x = 0.
ω = 1 / (1 + (D2 x / ε)²), computed again from x in each round, lets edges bend: a bend of more than ε hardly
counts (Geman and McClure; the gentler 1 / √(1 + …) rounds edges by a quarter more, docs/accuracy.md).

The voxels near the surface are numbered into one dense list, with the numbers of their neighbours. A missing
neighbour has the number past the end, where all is 0. Each cell of a block has a bit in the bit planes
`planes`, 1 = listed, 64 cells per word. `places` has the index in the list of each word's first cell. A
cell's number is a count of bits, so a search for numbers reads only a hundred bytes per block.

A step is two sweeps of the list, each writing only its own voxel: the first computes q = ω D2 x, the second
descends the gradient W (x − y) + λ D2ᵀ q. Hence the order of threads has no effect. A launch costs as much as
a step of a thousand voxels, so it does several steps. Each axis and side has its own array, and four voxels
are read before one is written, because LLVM loads an array's address again after each store.
"""

from tsfusion.kernels import F32, I32, F32x2, I32x2, I64x2, U64x2, ti
from tsfusion.kernels.base.quick_launch import QuickLaunch, runs, unit_of
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration.integrate import lane_weight
from tsfusion.kernels.surface.surface_cells import lowest

AT_ONCE = 3  # steps per launch
ABREAST = 4  # voxels per iteration; their number divides the list's, whose last entries may be empty

abreast = ti.types.vector(ABREAST, ti.f32)


@ti.func
def count_bits(plane):
    """Return the number of set bits in a word."""
    return ti.cast(ti.math.popcnt(plane), ti.i32)


@ti.func
def without_lowest(plane):
    """Return a word without its lowest set bit."""
    return plane & (plane - ti.u64(1))


@QuickLaunch
@ti.kernel
def mark_voxels(values: F32x2, reach: ti.f32, planes: U64x2, counts: I32x2):
    """Set in `planes` the bit of each seen voxel within `reach` of the surface, in sixtieths of a voxel."""
    for run in range(runs(values.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, values.shape[0])
        if b < values.shape[0]:
            for word in range(planes.shape[1]):
                plane = ti.u64(0)
                for j in range(64):  # LLVM vectorises this loop
                    is_near = abs(values[b, 64 * word + j]) <= reach  # false for NaN
                    plane |= ti.cast(is_near, ti.u64) << ti.cast(j, ti.u64)
                planes[b, word] = plane
                counts[b, word] = count_bits(plane)


@ti.func
def number_of(planes: ti.template(), places: ti.template(), b, o):
    """Return the index of cell o of block b in the list of cells to solve. A cell that is not in the list
    gets the index of the next one that is."""
    below = (ti.u64(1) << ti.cast(o & 63, ti.u64)) - ti.u64(1)
    return places[b, o >> 6] + count_bits(planes[b, o >> 6] & below)


@ti.func
def neighbour(
    planes: ti.template(), places: ti.template(), around: ti.template(), bits, b, o, axis, side, none
):
    """Return the list index of cell o's neighbour along an axis (before or after), `none` if not listed."""
    shift = (2 - axis) * bits
    mask = (1 << bits) - 1
    at = ((o >> shift) & mask) + 2 * side - 1
    block = ti.select((at & ~mask) == 0, b, around[b, 2 * axis + side])
    row = ti.max(block, 0)  # without branches: no processor predicts if a cell is listed
    cell = (o & ~(mask << shift)) | ((at & mask) << shift)
    is_listed = (planes[row, cell >> 6] >> ti.cast(cell & 63, ti.u64)) & ti.u64(1)
    return ti.select((block >= 0) & (is_listed == ti.u64(1)), number_of(planes, places, row, cell), none)


@ti.func
def link(
    planes: ti.template(), places: ti.template(), around: ti.template(), bits, b, o, i, links: ti.template()
):
    """Write column i of `links`: the list indices of the six face neighbours of cell o in block b. The number
    of columns stands for a neighbour that is not listed."""
    for side in ti.static(range(6)):
        links[side, i] = neighbour(planes, places, around, bits, b, o, side // 2, side % 2, links.shape[1])


@QuickLaunch
@ti.kernel
def list_voxels(
    values: F32x2, slots: I32, sums: I64x2,
    around: I32x2,  # (blocks, 6): −x, +x, −y, +y, −z, +z; −1 = none
    planes: U64x2, places: I32x2, links: I32x2, y: F32, weight: F32, x: F32,
):  # fmt: skip
    """Fill the list of voxels: value y, weight in full samples, first estimate x, and neighbours."""
    for run in range(runs(values.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, values.shape[0])
        if b < values.shape[0]:
            for word in range(planes.shape[1]):
                left = planes[b, word]
                i = places[b, word]
                while left != 0:
                    o = 64 * word + lowest(left)
                    y[i] = values[b, o]
                    x[i] = values[b, o]
                    weight[i] = ti.cast(lane_weight(sums[slots[b], o]), ti.f32) / WEIGHT_ONE
                    link(planes, places, around, 3, b, o, i, links)
                    i += 1
                    left = without_lowest(left)


@ti.func
def parent_of(o, bits):
    """Return the number of the coarse cell that contains cell o, in a block with 2^bits cells per side."""
    mask = (1 << bits) - 1
    x = o >> (2 * bits)
    y = (o >> bits) & mask
    z = o & mask
    return ((((x >> 1) << (bits - 1)) | (y >> 1)) << (bits - 1)) | (z >> 1)


@QuickLaunch
@ti.kernel
def mark_parents(
    bits: ti.i32,  # of the finer cells
    planes: U64x2, coarse_planes: U64x2, coarse_counts: I32x2,
):  # fmt: skip
    """Set in `coarse_planes` the bit of each cell, twice as wide, that contains a listed cell."""
    for run in range(runs(planes.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, planes.shape[0])
        if b < planes.shape[0]:
            for word in range(coarse_planes.shape[1]):
                coarse_planes[b, word] = ti.u64(0)
            for word in range(planes.shape[1]):
                left = planes[b, word]
                while left != 0:
                    c = parent_of(64 * word + lowest(left), bits)
                    coarse_planes[b, c >> 6] = coarse_planes[b, c >> 6] | (
                        ti.u64(1) << ti.cast(c & 63, ti.u64)
                    )
                    left = without_lowest(left)
            for word in range(coarse_planes.shape[1]):
                coarse_counts[b, word] = count_bits(coarse_planes[b, word])


@ti.func
def slope(links: ti.template(), x: ti.template(), i, axis):
    """Return the derivative of x along an axis: central difference, one-sided at the rim, 0 if alone."""
    m = links[2 * axis, i]
    p = links[2 * axis + 1, i]
    none = links.shape[1]
    result = ti.f32(0.0)
    if m < none and p < none:
        result = 0.5 * (x[p] - x[m])
    elif p < none:
        result = x[p] - x[i]
    elif m < none:
        result = x[i] - x[m]
    return result


@ti.func
def off_center(o, bits, axis):
    """Return the offset of cell o from the centre of its coarse cell along an axis, in cells of o: ±½."""
    return ti.cast((o >> ((2 - axis) * bits)) & 1, ti.f32) - 0.5


@QuickLaunch
@ti.kernel
def list_parents(
    bits: ti.i32,  # of the finer cells
    around: I32x2, planes: U64x2, places: I32x2, links: I32x2, y: F32, weight: F32, coarse_planes: U64x2,
    coarse_places: I32x2, coarse_links: I32x2, coarse_y: F32, coarse_weight: F32, coarse_x: F32,
):  # fmt: skip
    """Fill the list of the coarser grid: weighted mean of the finer cells, sum of their weights, neighbours.

    Each value is moved to the cell's centre along its own slope: ramps stay ramps where cells are missing.
    """
    for run in range(runs(planes.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, planes.shape[0])
        if b < planes.shape[0]:
            for word in range(coarse_planes.shape[1]):
                left = coarse_planes[b, word]
                i = coarse_places[b, word]
                while left != 0:
                    coarse_y[i] = 0.0
                    coarse_weight[i] = 0.0
                    c = 64 * word + lowest(left)
                    link(coarse_planes, coarse_places, around, bits - 1, b, c, i, coarse_links)
                    i += 1
                    left = without_lowest(left)
            for word in range(planes.shape[1]):
                left = planes[b, word]
                k = places[b, word]
                while left != 0:
                    o = 64 * word + lowest(left)
                    i = number_of(coarse_planes, coarse_places, b, parent_of(o, bits))
                    value = y[k]
                    for axis in ti.static(range(3)):
                        value -= off_center(o, bits, axis) * slope(links, y, k, axis)
                    coarse_y[i] = coarse_y[i] + weight[k] * value
                    coarse_weight[i] = coarse_weight[i] + weight[k]
                    k += 1
                    left = without_lowest(left)
            for word in range(coarse_planes.shape[1]):
                first = coarse_places[b, word]
                for i in range(first, first + count_bits(coarse_planes[b, word])):
                    coarse_y[i] = coarse_y[i] / coarse_weight[i]
                    coarse_x[i] = coarse_y[i]


@QuickLaunch
@ti.kernel
def refine(
    bits: ti.i32,  # of the finer cells
    links: I32x2,  # of the coarse cells
    coarse_planes: U64x2, coarse_places: I32x2, coarse_x: F32, planes: U64x2, places: I32x2, x: F32,
):  # fmt: skip
    """Start the solution of the finer grid from that of the coarser one, linear inside each coarse cell."""
    for run in range(runs(planes.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, planes.shape[0])
        if b < planes.shape[0]:
            for word in range(planes.shape[1]):
                left = planes[b, word]
                k = places[b, word]
                while left != 0:
                    o = 64 * word + lowest(left)
                    i = number_of(coarse_planes, coarse_places, b, parent_of(o, bits))
                    value = coarse_x[i]
                    for axis in ti.static(range(3)):
                        value += 0.5 * off_center(o, bits, axis) * slope(links, coarse_x, i, axis)
                    x[k] = value
                    k += 1
                    left = without_lowest(left)


@ti.func
def bend(before: ti.template(), after: ti.template(), x: ti.template(), i):
    """Return the second difference D2 x at cell i along the axis of the links `before` and `after`."""
    return x[before[i]] - 2.0 * x[i] + x[after[i]]


@ti.func
def share_of(before: ti.template(), after: ti.template(), bent, sharpness, i):
    """Return the weight ω = 1 / (1 + (D2 x / ε)²) of cell i along an axis; 0 if a neighbour is missing."""
    share = 1.0 / (1.0 + (sharpness * bent) * (sharpness * bent))
    return ti.select(ti.max(before[i], after[i]) < before.shape[0], share, 0.0)


@QuickLaunch
@ti.kernel
def weigh(
    x_before: I32, x_after: I32, y_before: I32, y_after: I32, z_before: I32, z_after: I32, x: F32,
    sharpness: ti.f32,  # 1 / ε; 0: ω = 1
    weight: F32, smoothness: ti.f32, omega_x: F32, omega_y: F32, omega_z: F32, inverse: F32, q_x: F32,
    q_y: F32, q_z: F32,
):  # fmt: skip
    """Write the solver's weights ω = 1 / (1 + (D2 x / ε)²), 0 if a neighbour is missing; q = ω D2 x; and
    `inverse`, 1 / M with M = W + 4 λ Σ |D2|ᵀ ω: then 0 < M⁻¹ A ≤ 1, as (1, −2, 1) has an l1 norm of 4."""
    for group in range(x_before.shape[0] // ABREAST):
        along_x, along_y, along_z = abreast(0.0), abreast(0.0), abreast(0.0)
        share_x, share_y, share_z = abreast(0.0), abreast(0.0), abreast(0.0)
        for n in ti.static(range(ABREAST)):
            i = ABREAST * group + n
            along_x[n] = bend(x_before, x_after, x, i)
            along_y[n] = bend(y_before, y_after, x, i)
            along_z[n] = bend(z_before, z_after, x, i)
            share_x[n] = share_of(x_before, x_after, along_x[n], sharpness, i)
            share_y[n] = share_of(y_before, y_after, along_y[n], sharpness, i)
            share_z[n] = share_of(z_before, z_after, along_z[n], sharpness, i)
        for n in ti.static(range(ABREAST)):
            i = ABREAST * group + n
            omega_x[i], omega_y[i], omega_z[i] = share_x[n], share_y[n], share_z[n]
            q_x[i], q_y[i], q_z[i] = share_x[n] * along_x[n], share_y[n] * along_y[n], share_z[n] * along_z[n]
    for group in range(x_before.shape[0] // ABREAST):
        whole = abreast(0.0)
        for n in ti.static(range(ABREAST)):
            i = ABREAST * group + n
            total = 2.0 * omega_x[i] + omega_x[x_before[i]] + omega_x[x_after[i]]
            total += 2.0 * omega_y[i] + omega_y[y_before[i]] + omega_y[y_after[i]]
            total += 2.0 * omega_z[i] + omega_z[z_before[i]] + omega_z[z_after[i]]
            whole[n] = weight[i] + 4.0 * smoothness * total
        for n in ti.static(range(ABREAST)):  # without data and neighbours a value does not change
            inverse[ABREAST * group + n] = ti.select(whole[n] > 0.0, 1.0 / whole[n], 0.0)


@QuickLaunch
@ti.kernel
def relax(
    x_before: I32, x_after: I32, y_before: I32, y_after: I32, z_before: I32, z_after: I32, y: F32,
    weight: F32, omega_x: F32, omega_y: F32, omega_z: F32, inverse: F32, smoothness: ti.f32,
    steps: F32x2,  # (AT_ONCE, 2): share of the last, gain of the residual
    bent: ti.i32,  # whether q is of this x
    q_x: F32, q_y: F32, q_z: F32, step: F32, x: F32,
):  # fmt: skip
    """Do the field's Chebyshev iterations (one per row of `steps`), which update x after q = ω D2 x."""
    for k in ti.static(range(AT_ONCE)):
        for group in range(x_before.shape[0] // ABREAST * (1 - bent if ti.static(k == 0) else 1)):
            along_x, along_y, along_z = abreast(0.0), abreast(0.0), abreast(0.0)
            for n in ti.static(range(ABREAST)):
                i = ABREAST * group + n
                along_x[n] = omega_x[i] * bend(x_before, x_after, x, i)
                along_y[n] = omega_y[i] * bend(y_before, y_after, x, i)
                along_z[n] = omega_z[i] * bend(z_before, z_after, x, i)
            for n in ti.static(range(ABREAST)):
                i = ABREAST * group + n
                q_x[i], q_y[i], q_z[i] = along_x[n], along_y[n], along_z[n]
        for group in range(x_before.shape[0] // ABREAST):
            change, moved = abreast(0.0), abreast(0.0)
            for n in ti.static(range(ABREAST)):
                i = ABREAST * group + n
                back = bend(x_before, x_after, q_x, i)
                back += bend(y_before, y_after, q_y, i)
                back += bend(z_before, z_after, q_z, i)
                residual = weight[i] * (y[i] - x[i]) - smoothness * back
                change[n] = steps[k, 0] * step[i] + steps[k, 1] * inverse[i] * residual
                moved[n] = x[i] + change[n]
            for n in ti.static(range(ABREAST)):
                i = ABREAST * group + n
                step[i], x[i] = change[n], moved[n]


@QuickLaunch
@ti.kernel
def write_values(planes: U64x2, places: I32x2, x: F32, values: F32x2):
    """Write the smoothed field x to `values` of the listed voxels; other values do not change."""
    for run in range(runs(planes.shape[0])):  # run loop: kernels/base/quick_launch.py
        b = unit_of(run, planes.shape[0])
        if b < planes.shape[0]:
            for word in range(planes.shape[1]):
                left = planes[b, word]
                i = places[b, word]
                while left != 0:
                    values[b, 64 * word + lowest(left)] = x[i]
                    i += 1
                    left = without_lowest(left)
