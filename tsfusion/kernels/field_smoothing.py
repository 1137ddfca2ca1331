# SPDX-License-Identifier: MIT
"""The field regulariser: paper eq. 3 carried from the ray to the volume.

    x̂ = argmin Σ W (x − y)² + λ Σ over the three axes of ω |D2 x|²      D2: second differences

y = Σ w·m / Σ w and W = Σ w are read from the map, x near a flat surface is a ramp with D2 x = 0, and
ω = 1 / (1 + (D2 x / ε)²), taken anew from x now and then, lets edges bend: what bends more than ε hardly
counts (Geman and McClure; the gentler 1 / √(1 + …) rounds edges by a quarter more, docs/accuracy.md).

The voxels near the surface are numbered into one dense list with the numbers of their neighbours; a missing
one has the number past the end, where all is 0. A step is two sweeps of the list, each writing only its own
voxel: the first leaves q = ω D2 x, the second goes down the gradient W (x − y) + λ D2ᵀ q. Hence no order of
threads can show. A launch costs as much as a step of a thousand voxels: one does several steps.
"""

import taichi as ti

from tsfusion.kernels.integrate import CUBE, lane_weight
from tsfusion.kernels.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.voxel_traversal import RUN

NONE = -1
AT_ONCE = 3  # steps of a launch


@ti.kernel
def number_voxels(
    values: ti.types.ndarray(dtype=ti.f32, ndim=2),
    reach: ti.f32,
    number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    counts: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Number the voxels of each block that were seen within `reach` quanta of the surface; −1 elsewhere."""
    for run in range(values.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            b = run // RUN
            n = 0
            for o in range(CUBE):
                is_near = abs(values[b, o]) <= reach  # never true of NaN
                number[b, o] = ti.select(is_near, n, NONE)
                n += ti.cast(is_near, ti.i32)
            counts[b] = n


@ti.func
def neighbour(
    number: ti.template(), starts: ti.template(), around: ti.template(), bits, b, o, axis, side, none
):
    """Number in the list of the cell before or after cell o along an axis, `none` if it is not in it."""
    shift = (2 - axis) * bits
    mask = (1 << bits) - 1
    at = ((o >> shift) & mask) + 2 * side - 1
    block = ti.select((at & ~mask) == 0, b, around[b, 2 * axis + side])
    row = ti.max(block, 0)  # without branches: whether a cell is listed cannot be foretold
    k = number[row, (o & ~(mask << shift)) | ((at & mask) << shift)]
    return ti.select((block >= 0) & (k >= 0), starts[row] + k, none)


@ti.func
def link(
    number: ti.template(), starts: ti.template(), around: ti.template(), bits, b, o, i, links: ti.template()
):
    """Row i of `links`: the numbers of the cells beside cell o, the number of rows where there is none."""
    for side in ti.static(range(6)):
        links[i, side] = neighbour(number, starts, around, bits, b, o, side // 2, side % 2, links.shape[0])


@ti.kernel
def list_voxels(
    values: ti.types.ndarray(dtype=ti.f32, ndim=2),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    around: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (blocks, 6): −x, +x, −y, +y, −z, +z; −1 = none
    number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (blocks + 1,)
    links: ti.types.ndarray(dtype=ti.i32, ndim=2),
    y: ti.types.ndarray(dtype=ti.f32, ndim=1),
    weight: ti.types.ndarray(dtype=ti.f32, ndim=1),
    x: ti.types.ndarray(dtype=ti.f32, ndim=1),
):
    """Fill the list: each voxel's value, its weight in full-confidence samples, and its neighbours."""
    for run in range(values.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            b = run // RUN
            for o in range(ti.select(starts[b] < starts[b + 1], CUBE, 0)):
                k = number[b, o]
                if k >= 0:
                    i = starts[b] + k
                    y[i] = values[b, o]
                    x[i] = values[b, o]
                    weight[i] = ti.cast(lane_weight(sums[slots[b], o]), ti.f32) / WEIGHT_ONE
                    link(number, starts, around, 3, b, o, i, links)


@ti.func
def parent_of(o, bits):
    """The cell of half the resolution that holds cell o of a block with 2^bits cells a side."""
    mask = (1 << bits) - 1
    x = o >> (2 * bits)
    y = (o >> bits) & mask
    z = o & mask
    return ((((x >> 1) << (bits - 1)) | (y >> 1)) << (bits - 1)) | (z >> 1)


@ti.kernel
def number_parents(
    bits: ti.i32,  # of the finer cells
    number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    coarse_number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    coarse_counts: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Number the cells that hold a listed finer cell."""
    for run in range(number.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            b = run // RUN
            for c in range(coarse_number.shape[1]):
                coarse_number[b, c] = NONE
            for o in range(number.shape[1]):
                if number[b, o] >= 0:
                    coarse_number[b, parent_of(o, bits)] = 0
            n = 0
            for c in range(coarse_number.shape[1]):
                if coarse_number[b, c] == 0:
                    coarse_number[b, c] = n
                    n += 1
            coarse_counts[b] = n


@ti.func
def slope(links: ti.template(), x: ti.template(), i, axis):
    """Difference to the next cell along an axis: central, one-sided at the rim, 0 alone."""
    m = links[i, 2 * axis]
    p = links[i, 2 * axis + 1]
    none = links.shape[0]
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
    """From its parent's centre to cell o, in cells of its size: ±½."""
    return ti.cast((o >> ((2 - axis) * bits)) & 1, ti.f32) - 0.5


@ti.kernel
def list_parents(
    bits: ti.i32,  # of the finer cells
    around: ti.types.ndarray(dtype=ti.i32, ndim=2),
    number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    links: ti.types.ndarray(dtype=ti.i32, ndim=2),
    y: ti.types.ndarray(dtype=ti.f32, ndim=1),
    weight: ti.types.ndarray(dtype=ti.f32, ndim=1),
    coarse_number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    coarse_starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    coarse_links: ti.types.ndarray(dtype=ti.i32, ndim=2),
    coarse_y: ti.types.ndarray(dtype=ti.f32, ndim=1),
    coarse_weight: ti.types.ndarray(dtype=ti.f32, ndim=1),
    coarse_x: ti.types.ndarray(dtype=ti.f32, ndim=1),
):
    """Each coarse cell: the weighted mean of its finer cells, the sum of their weights, its neighbours.

    Each value is moved to the cell's centre along its own slope: ramps stay ramps where cells are missing.
    """
    for run in range(number.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            b = run // RUN
            for c in range(coarse_number.shape[1]):
                if coarse_number[b, c] >= 0:
                    i = coarse_starts[b] + coarse_number[b, c]
                    coarse_y[i] = 0.0
                    coarse_weight[i] = 0.0
                    link(coarse_number, coarse_starts, around, bits - 1, b, c, i, coarse_links)
            for o in range(number.shape[1]):
                if number[b, o] >= 0:
                    k = starts[b] + number[b, o]
                    i = coarse_starts[b] + coarse_number[b, parent_of(o, bits)]
                    value = y[k]
                    for axis in ti.static(range(3)):
                        value -= off_center(o, bits, axis) * slope(links, y, k, axis)
                    coarse_y[i] = coarse_y[i] + weight[k] * value
                    coarse_weight[i] = coarse_weight[i] + weight[k]
            for c in range(coarse_number.shape[1]):
                if coarse_number[b, c] >= 0:
                    i = coarse_starts[b] + coarse_number[b, c]
                    coarse_y[i] = coarse_y[i] / coarse_weight[i]
                    coarse_x[i] = coarse_y[i]


@ti.kernel
def refine(
    bits: ti.i32,  # of the finer cells
    links: ti.types.ndarray(dtype=ti.i32, ndim=2),  # of the coarse cells
    coarse_number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    coarse_starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    coarse_x: ti.types.ndarray(dtype=ti.f32, ndim=1),
    number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    x: ti.types.ndarray(dtype=ti.f32, ndim=1),
):
    """Start the finer cells from the coarse solution, linear inside each coarse cell."""
    for run in range(number.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            b = run // RUN
            for o in range(number.shape[1]):
                if number[b, o] >= 0:
                    i = coarse_starts[b] + coarse_number[b, parent_of(o, bits)]
                    value = coarse_x[i]
                    for axis in ti.static(range(3)):
                        value += 0.5 * off_center(o, bits, axis) * slope(links, coarse_x, i, axis)
                    x[starts[b] + number[b, o]] = value


@ti.kernel
def weigh(
    links: ti.types.ndarray(dtype=ti.i32, ndim=2),
    x: ti.types.ndarray(dtype=ti.f32, ndim=1),
    sharpness: ti.f32,  # 1 / ε; 0: ω = 1
    weight: ti.types.ndarray(dtype=ti.f32, ndim=1),
    smoothness: ti.f32,
    omega: ti.types.ndarray(dtype=ti.f32, ndim=2),
    inverse: ti.types.ndarray(dtype=ti.f32, ndim=1),
    q: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    """ω = 1 / (1 + (D2 x / ε)²), 0 where one of the three cells is missing; q = ω D2 x; and 1 / M with
    M = W + 4 λ Σ |D2|ᵀ ω: then 0 < M⁻¹ A ≤ 1, as (1, −2, 1) has an l1 norm of 4."""
    for i in range(links.shape[0]):
        for axis in ti.static(range(3)):
            m = links[i, 2 * axis]
            p = links[i, 2 * axis + 1]
            bent = x[m] - 2.0 * x[i] + x[p]
            share = 1.0 / (1.0 + (sharpness * bent) * (sharpness * bent))
            share = ti.select(ti.max(m, p) < links.shape[0], share, 0.0)
            omega[i, axis] = share
            q[i, axis] = share * bent
    for i in range(links.shape[0]):
        total = ti.f32(0.0)
        for axis in ti.static(range(3)):
            total += (
                2.0 * omega[i, axis] + omega[links[i, 2 * axis], axis] + omega[links[i, 2 * axis + 1], axis]
            )
        whole = weight[i] + 4.0 * smoothness * total
        inverse[i] = ti.select(whole > 0.0, 1.0 / whole, 0.0)  # what nothing draws at stays


@ti.kernel
def relax(
    links: ti.types.ndarray(dtype=ti.i32, ndim=2),
    y: ti.types.ndarray(dtype=ti.f32, ndim=1),
    weight: ti.types.ndarray(dtype=ti.f32, ndim=1),
    omega: ti.types.ndarray(dtype=ti.f32, ndim=2),
    inverse: ti.types.ndarray(dtype=ti.f32, ndim=1),
    smoothness: ti.f32,
    steps: ti.types.ndarray(dtype=ti.f32, ndim=2),  # (AT_ONCE, 2): share of the last, gain of the residual
    bent: ti.i32,  # whether q is of this x
    q: ti.types.ndarray(dtype=ti.f32, ndim=2),
    step: ti.types.ndarray(dtype=ti.f32, ndim=1),
    x: ti.types.ndarray(dtype=ti.f32, ndim=1),
):
    """Some steps of the Chebyshev iteration, each after q = ω D2 x along each axis."""
    for k in ti.static(range(AT_ONCE)):
        for i in range(links.shape[0] * (1 - bent if ti.static(k == 0) else 1)):
            twice = 2.0 * x[i]
            for axis in ti.static(range(3)):
                q[i, axis] = omega[i, axis] * (x[links[i, 2 * axis]] - twice + x[links[i, 2 * axis + 1]])
        for i in range(links.shape[0]):
            back = ti.f32(0.0)
            for axis in ti.static(range(3)):
                back += q[links[i, 2 * axis], axis] - 2.0 * q[i, axis] + q[links[i, 2 * axis + 1], axis]
            residual = weight[i] * (y[i] - x[i]) - smoothness * back
            change = steps[k, 0] * step[i] + steps[k, 1] * inverse[i] * residual
            step[i] = change
            x[i] = x[i] + change


@ti.kernel
def write_values(
    number: ti.types.ndarray(dtype=ti.i32, ndim=2),
    starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    x: ti.types.ndarray(dtype=ti.f32, ndim=1),
    values: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    """The field where it was solved; other values stay."""
    for run in range(number.shape[0] * RUN):  # run loop: kernels/__init__.py
        if run % RUN == 0:
            b = run // RUN
            if starts[b] < starts[b + 1]:
                for o in range(CUBE):
                    k = number[b, o]
                    if k >= 0:
                        values[b, o] = x[starts[b] + k]
