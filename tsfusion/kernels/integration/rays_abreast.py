# SPDX-License-Identifier: MIT
"""Walk eight rays side by side, so that a step of all of them is a few vector instructions.

A stretch is up to 64 voxels of each ray. Its first pass walks and lists voxels. This pass is arithmetic
without a branch, on arrays of the function, which no store to an argument can change: so the rays become
lanes of vectors. The caller then goes through the list, ray by ray.

A ray crosses about ten voxels and two or three blocks. A look-up of each new block would cost more than the
voxels: a jump that no processor predicts, and the hash. So a ray walks in a window of 8³ blocks, and each
voxel reads the index of its block from a small table.
"""

from tsfusion.kernels import ti
from tsfusion.kernels.base.voxel_traversal import (
    CROSSING,
    DISTANCE,
    END,
    INTERVAL,
    LOSS,
    NEVER,
    VOXEL,
    pack,
    parts_of,
    ray_vector,
    steps,
    vec3i,
)

ABREAST = 8
WINDOW_BITS = 6  # of a voxel's coordinate in its window
STRETCH = 1 << WINDOW_BITS  # voxels: a ray leaves its window at most once per axis
LIST = ABREAST * STRETCH

# Position of a ray in its window, 21 bits: number of the voxel in the block, 64 x + 8 y + z; number of the
# block in the window, likewise; and for each axis 1 if the window's number is odd. So each axis has seven
# bits, in three groups. A listed voxel has the distance to the surface above them, 11 bits, quanta.
BLOCK_AT, WINDOW_AT, DISTANCE_AT = 9, 18, 21
ONE = (1 << 6, 1 << 3, 1)  # a step towards +x, +y, +z adds this
ALL_BITS = tuple(
    (7 * ONE[a] << BLOCK_AT) + 7 * ONE[a] + (4 >> a << WINDOW_AT) for a in range(3)
)  # of an axis
MOST_LISTED = 1023  # quanta

# Numbers of the walking rays, `walks`: field + lane. There are fields for each axis: next crossing along the
# band, the interval, changes of `AT` and `OFF` per step, number of the window. `AT`: position in the window;
# `OFF`: distance to the surface, 2⁻¹⁶ quantum; `ODD`: odd bits of the window in `WINDOW`.
NEXT, EVERY, STEP, TURN, WINDOW = (axis * ABREAST for axis in (0, 3, 6, 9, 12))
AT, OFF, ODD, RAY_LENGTH, BAND, COLORED, RAY, MET, VOXELS, FREE, UNCOLORED = (
    field * ABREAST for field in range(15, 26)
)
WALKS = 26 * ABREAST
NOBODY = -1  # marks a lane without a ray
HALF_A_QUANTUM = 1 << 15  # of `OFF`: added, so that its upper bits are rounded
WINDOWS = 64  # windows that a unit keeps: the last one for each value of the low bits of the key
WINDOW_BLOCKS = 512
WINDOW_SCRATCH = WINDOWS * (1 + WINDOW_BLOCKS)  # int64 of a unit: keys, indices of blocks in the layers
UNKNOWN = 8 - (1 << 31)  # marks an index that was not looked up


@ti.func
def begin(rays: ti.template(), r, per_voxel: ti.template(), colors, walks: ti.template(), k):
    """Start the walk of ray `r` in lane `k` of eight. `per_voxel`: quanta of distance per voxel."""
    length, end, _ = parts_of(rays, r)
    voxel, towards = ray_vector(rays, r, VOXEL), steps(rays[r, END])
    at = 0
    for a in ti.static(range(3)):
        walks[NEXT + a * ABREAST + k] = rays[r, CROSSING + a]
        walks[EVERY + a * ABREAST + k] = rays[r, INTERVAL + a]
        walks[STEP + a * ABREAST + k] = ti.select(towards[a] > 0, ONE[a], ALL_BITS[a])
        walks[TURN + a * ABREAST + k] = -rays[r, LOSS + a] * per_voxel
        walks[WINDOW + a * ABREAST + k] = voxel[a] >> WINDOW_BITS
        at += ONE[a] * ((voxel[a] & 7) + ((voxel[a] & 56) << (BLOCK_AT - 3)))
    walks[AT + k] = at
    walks[ODD + k] = 0
    walks[OFF + k] = rays[r, DISTANCE] * per_voxel + HALF_A_QUANTUM
    walks[RAY_LENGTH + k] = length
    walks[BAND + k] = end - (length - end)
    walks[COLORED + k] = ti.select(colors == 1 and end + 1 != length, end + 1, NEVER)
    walks[RAY + k] = r
    walks[MET + k] = 0


@ti.func
def crossed_before(walks: ti.template(), k, until):
    """Return the number of voxels that the ray in lane `k` leaves before distance `until` along its band."""
    n = 0
    for a in ti.static(range(3)):
        gap = until - 1 - walks[NEXT + a * ABREAST + k]
        # Exact: a quotient of such integers is an integer, or farther from it than float64 rounds
        times = ti.cast(ti.cast(gap, ti.f64) / ti.cast(walks[EVERY + a * ABREAST + k], ti.f64), ti.i32) + 1
        n += ti.select(gap >= 0, times, 0)
    return n


@ti.func
def measure(walks: ti.template(), carves, colors):
    """Count the remaining voxels of each ray: all, those in free space, and those before the voxel that takes
    the colour. Returns the largest count of all voxels, the steps that a walk of the rays takes."""
    for k in range(ABREAST):
        n = crossed_before(walks, k, walks[RAY_LENGTH + k]) + 1
        walks[VOXELS + k] = ti.select(walks[RAY + k] != NOBODY, n, 0)
        here = walks[AT + k] >> WINDOW_AT
        for a in ti.static(range(3)):
            walks[WINDOW + a * ABREAST + k] += beyond(walks, k, here, a)
        walks[ODD + k] = here
    if carves == 1:
        for k in range(ABREAST):
            walks[FREE + k] = crossed_before(walks, k, walks[BAND + k])
    if colors == 1:
        for k in range(ABREAST):
            walks[UNCOLORED + k] = crossed_before(walks, k, walks[COLORED + k])
    longest = 0
    for k in range(ABREAST):
        longest = ti.max(longest, walks[VOXELS + k])
    return longest


@ti.func
def beyond(walks: ti.template(), k, here, a: ti.template()):
    """Return the step (−1, 0 or 1) on axis `a` from the window that `walks` names to the window with odd bits
    `here`. A window is 8³ blocks; its odd bits tell for each axis if its number is odd."""
    changed = ((here ^ walks[ODD + k]) >> (2 - a)) & 1
    return ti.select(walks[STEP + a * ABREAST + k] == ALL_BITS[a], -changed, changed)


@ti.func
def window_of(walks: ti.template(), k, here):
    """Return the window (8³ blocks) with odd bits `here` that the ray in lane `k` reaches in this stretch."""
    window = vec3i(walks[WINDOW + k], walks[WINDOW + ABREAST + k], walks[WINDOW + 2 * ABREAST + k])
    for a in ti.static(range(3)):
        window[a] += beyond(walks, k, here, a)
    return window


@ti.func
def walk(
    walks: ti.template(), count, listed: ti.template(), distances: ti.template(), exactly: ti.template()
):
    """List `count` voxels of each ray: first the first voxel of all rays, then the second, and so on. Entries
    after a ray's end are undefined. With `exactly`, `distances` gets the unrounded distances, too."""
    for i in range(count):
        for k in range(ABREAST):
            at, off = walks[AT + k], walks[OFF + k]
            x, y, z = walks[NEXT + k], walks[NEXT + ABREAST + k], walks[NEXT + 2 * ABREAST + k]
            # The axis that is crossed next, the first of equals
            is_x, is_y = (x <= y) & (x <= z), y <= z
            walks[NEXT + k] = x + ti.select(is_x, walks[EVERY + k], 0)
            walks[NEXT + ABREAST + k] = y + ti.select(is_x, 0, ti.select(is_y, walks[EVERY + ABREAST + k], 0))
            walks[NEXT + 2 * ABREAST + k] = z + ti.select(is_x | is_y, 0, walks[EVERY + 2 * ABREAST + k])
            step = ti.select(is_y, walks[STEP + ABREAST + k], walks[STEP + 2 * ABREAST + k])
            turn = ti.select(is_y, walks[TURN + ABREAST + k], walks[TURN + 2 * ABREAST + k])
            bits = ti.select(is_x, ALL_BITS[0], ti.select(is_y, ALL_BITS[1], ALL_BITS[2]))
            # Set bits between the axis' bits carry from one to the next
            stepped = (at | ~bits) + ti.select(is_x, walks[STEP + k], step)
            walks[AT + k] = (stepped & bits) | (at & ~bits)
            walks[OFF + k] = off + ti.select(is_x, walks[TURN + k], turn)
            if ti.static(exactly):
                distances[i * ABREAST + k] = off
            m = ti.min(ti.max(off >> 16, -MOST_LISTED), MOST_LISTED)
            listed[i * ABREAST + k] = (m << DISTANCE_AT) | at


@ti.func
def open_window(window, scratch: ti.template(), base):
    """Return the index of a window's table of block indices in the unit's scratch, which begins at `base`.

    A window that is new to the unit starts with unknown blocks.
    """
    number = (window[0] & 3) << 4 | (window[1] & 3) << 2 | (window[2] & 3)
    blocks = base + WINDOWS + number * WINDOW_BLOCKS
    key = pack(window[0], window[1], window[2])
    if scratch[base + number] != key:
        scratch[base + number] = key
        for i in range(blocks, blocks + WINDOW_BLOCKS):
            scratch[i] = UNKNOWN
    return blocks
