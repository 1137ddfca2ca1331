# SPDX-License-Identifier: MIT
"""Integer geometry for all kernels: voxel keys, and the traversal of the voxels that a ray crosses.

A ray is a row of `RAY_FIELDS` int32, made once per keyframe: the start of its band and its steps. All later
arithmetic is in integers, so every kernel visits the same voxels. Units: position 2⁻¹⁰ voxel, direction 2⁻¹⁶,
distance along the ray 2⁻¹⁶ voxel.
"""

from tsfusion.kernels import ti
from tsfusion.kernels.base.kernel_functions import dot, norm, product

# First voxel of the band (3), next crossing per axis (3), crossing interval per axis (3), loss of the
# distance per step on each axis (3), signed distance of the first voxel's centre to the surface along the ray
# (positive before it), length of the ray, position of the end point along it, weight << 24 | 0xRRGGBB. The
# band is as wide before the end point as behind it. The low 3 bits of `END` are the axes that decrease; the
# next 5, above the low 8 of `LENGTH`, are the support, 2⁻⁸ voxel.
RAY_FIELDS = 16
VOXEL, CROSSING, INTERVAL, LOSS = 0, 3, 6, 9
DISTANCE, LENGTH, END, WEIGHT_COLOR = 12, 13, 14, 15

# A strip of the keyframe: a contiguous run of rays that one thread works on.
STRIP_FIELDS = 16  # a cache line
START, COUNT, SAMPLES, WEIGHT, DEFERRED, UPDATES, ADDED, COST, UNIT, SHARED = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9

MAX_CROSSED = 64  # voxels in one ray's band: 2 · 16 · √3 and the ends
VOXEL_LIMIT = 1 << 20  # |voxel coordinate| < VOXEL_LIMIT − 64, so that a band stays inside 21 bits


DIRECTION_ONE = 1 << 16
FAR_COST = 5  # factor on the cost of far voxels; measured: 100 ns instead of 20
NEVER = 1 << 30  # a crossing far behind the end of the longest band
LEAST_DIRECTION = 8  # a slower axis is not crossed: 2⁻¹³, one voxel in 8192

vec3i = ti.types.vector(3, ti.i32)


@ti.func
def pack(x, y, z):
    """Return the key of a block or voxel: three coordinates in (−2²⁰, 2²⁰) in one non-zero int64."""
    return (
        (ti.cast(x + 1048576, ti.i64) << 42)
        | (ti.cast(y + 1048576, ti.i64) << 21)
        | ti.cast(z + 1048576, ti.i64)
    )


@ti.func
def unpack(key):
    """Return the three coordinates of a key: the inverse of `pack`."""
    return vec3i(
        ti.cast((key >> 42) & 2097151, ti.i32) - 1048576,
        ti.cast((key >> 21) & 2097151, ti.i32) - 1048576,
        ti.cast(key & 2097151, ti.i32) - 1048576,
    )


@ti.func
def hash_key(key):
    """Return a 31-bit hash of a block key (Fibonacci hashing, twice: neighbours differ in few bits)."""
    h = key * ti.i64(-7046029254386353131)
    h = h ^ (h >> 29)
    h = h * ti.i64(-4658895280553007687)
    return ti.cast((h >> 32) & 2147483647, ti.i32)


@ti.func
def write_ray(
    rays: ti.template(), r, first, end, direction, gradient, before, support, behind, weight, color
):
    """Write ray `r` to its row of `rays`. Returns its cost: the most voxels that it can cross.

    The cost is multiplied by `FAR_COST` if the ray begins away from the ray before it in its strip, which
    starts with ray `first`: then none of its blocks is in the processor's cache.

    `end` int32 2⁻¹⁰ voxel; `direction` float64 of any length; the ray reaches `before` and `behind` the end
    point, int32 2⁻⁸ voxel. A ray without a direction gets no weight. `support`, in the same unit, is the
    distance written before the band. `gradient`, float64, is the loss of the distance along the ray per voxel
    on each axis: n / (n·u) for a plane with normal n. Zero means the plane across the ray with gradient u.
    """
    length = norm(direction)
    usable = weight
    if length <= 0.0:
        usable = 0
        length = 1.0
    unit = product(direction, DIRECTION_ONE / length)
    slope = gradient
    if dot(gradient, gradient) == 0.0:
        slope = unit / DIRECTION_ONE
    distance = ti.i64(0)
    downward, across = 0, 0
    for a in ti.static(range(3)):
        u = ti.cast(ti.floor(unit[a] + 0.5), ti.i32)
        across += abs(u)
        exact = ti.cast(end[a], ti.i64) << 6
        start = exact - ((ti.cast(u, ti.i64) * before) >> 8)
        voxel = ti.cast(start >> 16, ti.i32)
        inside = ti.cast(start & 65535, ti.i32)
        gap = inside
        if u > 0:
            gap = 65536 - inside
        crossing = NEVER
        interval = NEVER
        if abs(u) > LEAST_DIRECTION:
            inverse = 65536.0 / ti.cast(abs(u), ti.f64)
            interval = ti.cast(inverse * 65536.0, ti.i32)
            crossing = ti.cast(ti.cast(gap, ti.f64) * inverse, ti.i32)
        rays[r, VOXEL + a] = voxel
        rays[r, CROSSING + a] = crossing
        rays[r, INTERVAL + a] = interval
        loss = ti.cast(ti.floor(slope[a] * DIRECTION_ONE + 0.5), ti.i32)
        distance += (exact - (ti.cast(voxel, ti.i64) << 16) - 32768) * loss
        if u < 0:
            downward |= 1 << a
            loss = -loss
        rays[r, LOSS + a] = loss
    rays[r, DISTANCE] = ti.cast(distance >> 16, ti.i32)
    rays[r, LENGTH] = ((before + behind) << 8) | (support & 255)
    rays[r, END] = (before << 8) | (support >> 8 << 3) | downward
    rays[r, WEIGHT_COLOR] = (usable << 24) | color
    cost = 4 + ti.cast((ti.cast(across, ti.i64) * (before + behind)) >> 24, ti.i32)
    if is_apart(rays, r, ti.max(r - 1, first)):
        cost *= FAR_COST
    return cost


@ti.func
def is_apart(rays: ti.template(), r, other):
    """Return True if two rays begin neither in the same block nor in adjacent blocks."""
    step = abs((ray_vector(rays, r, VOXEL) >> 3) - (ray_vector(rays, other, VOXEL) >> 3))
    return ti.max(step[0], step[1], step[2]) > 1


@ti.func
def write_strip(strips: ti.template(), strip, first, end, samples, weight, cost):
    """Write a strip, a run of rays handled by one thread: rays `first` … `end` − 1, their samples, their
    total `weight`, and the cost of their addition (int64; clamped)."""
    strips[strip, START] = first
    strips[strip, COUNT] = end - first
    strips[strip, SAMPLES] = samples
    strips[strip, WEIGHT] = weight
    strips[strip, COST] = ti.cast(ti.min(cost, ti.i64(2147483647)), ti.i32)


@ti.func
def ray_weight(rays: ti.template(), r):
    """Return the weight of ray `r`, 0 … 255."""
    return (rays[r, WEIGHT_COLOR] >> 24) & 255


@ti.func
def parts_of(rays: ti.template(), r):
    """Return three distances along ray `r`, 2⁻¹⁶ voxel: its length, its end point, and its support."""
    length, end = rays[r, LENGTH], rays[r, END]
    return length & ~255, end & ~255, (end & 248) << 13 | (length & 255) << 8


@ti.func
def ray_vector(rays: ti.template(), r, first: ti.template()):
    """Return three neighbouring fields of ray `r` from `first`: `VOXEL`, `CROSSING`, `INTERVAL` or `LOSS`."""
    return vec3i(rays[r, first], rays[r, first + 1], rays[r, first + 2])


@ti.func
def next_step(crossing):
    """Return a mask with all bits in the axis that is crossed next (the first of equals), none in the others,
    and the distance of this crossing. No branch, because a processor predicts the next axis badly."""
    nearest = ti.min(crossing[0], crossing[1], crossing[2])
    x = -ti.cast(crossing[0] == nearest, ti.i32)
    y = -ti.cast(crossing[1] == nearest, ti.i32) & ~x
    return vec3i(x, y, ~(x | y)), nearest


@ti.func
def steps(end):
    """Return the direction of a ray's steps along each axis, +1 or −1, from its field `END`."""
    return vec3i(1 - 2 * (end & 1), 1 - (end & 2), 1 - ((end & 4) >> 1))


# State of a walk: the voxel, the distance of its centre to the surface, the next crossing of each axis along
# the band; and the changes of these three with a step along each axis.
Walk = ti.types.struct(
    voxel=vec3i, distance=ti.i32, crossing=vec3i, towards=vec3i, loss=vec3i, interval=vec3i
)


@ti.func
def begin_walk(rays: ti.template(), r):
    """Return the state of a walk along ray `r`, voxel by voxel, at the first voxel of its band."""
    return Walk(
        ray_vector(rays, r, VOXEL), rays[r, DISTANCE], ray_vector(rays, r, CROSSING), steps(rays[r, END]),
        ray_vector(rays, r, LOSS), ray_vector(rays, r, INTERVAL),
    )  # fmt: skip


@ti.func
def advance(walk: ti.template(), step):
    """Move `walk` in place to the next voxel of its ray. `step` is the mask that `next_step` returned."""
    walk.crossing += walk.interval & step
    walk.voxel += walk.towards & step
    walk.distance -= (walk.loss & step).sum()


@ti.func
def offset_in_block(voxel):
    """Return the number of a voxel in its block, 0 … 511: 64 x + 8 y + z."""
    return ((voxel[0] & 7) << 6) | ((voxel[1] & 7) << 3) | (voxel[2] & 7)


@ti.func
def voxel_of(o):
    """Return the position (x, y, z in 0 … 7) in its block of the voxel with number `o`."""
    return vec3i(o >> 6, (o >> 3) & 7, o & 7)


@ti.func
def block_key(voxel):
    """Return the key of the block that contains a voxel."""
    return pack(voxel[0] >> 3, voxel[1] >> 3, voxel[2] >> 3)
