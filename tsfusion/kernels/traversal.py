# SPDX-License-Identifier: MIT
"""Integer geometry shared by all kernels: voxel keys, and the traversal of the voxels a ray crosses.

A ray is eight int32 (`RAY_FIELDS`), made once per keyframe. Everything after that is integer arithmetic
or single IEEE operations without a multiply-add to contract, so every kernel visits the same voxels.

Units: position 2⁻¹⁰ voxel, direction 2⁻¹⁶, distance along the ray 2⁻¹⁶ voxel.
"""

import taichi as ti

# end point x y z, unit direction x y z, half-width (2⁻⁸ voxel) << 16 | weight, colour 0xRRGGBB
RAY_FIELDS = 8
MAX_CROSSED = 64  # voxels in one ray's band: 2 · 16 · √3 and the ends
VOXEL_LIMIT = 1 << 20  # |voxel coordinate| < VOXEL_LIMIT − 64, so that a band stays inside 21 bits

# Taichi 1.7's CPU backend hands out a parallel loop in runs of 512 iterations, whatever `block_dim` says
# (measured: a loop of 512 heavy iterations ran on one thread). One unit of work is therefore one run.
RUN = 512

POSITION_BITS = 10
DIRECTION_ONE = 1 << 16
NEVER = 1 << 25  # a crossing far behind the longest band

vec3i = ti.types.vector(3, ti.i32)


@ti.func
def pack(x, y, z):
    """A non-zero int64 key of three coordinates in (−2²⁰, 2²⁰)."""
    return (
        (ti.cast(x + 1048576, ti.i64) << 42)
        | (ti.cast(y + 1048576, ti.i64) << 21)
        | ti.cast(z + 1048576, ti.i64)
    )


@ti.func
def unpack(key):
    return vec3i(
        ti.cast((key >> 42) & 2097151, ti.i32) - 1048576,
        ti.cast((key >> 21) & 2097151, ti.i32) - 1048576,
        ti.cast(key & 2097151, ti.i32) - 1048576,
    )


@ti.func
def hash_key(key):
    """31 well-mixed bits (Fibonacci hashing, twice: neighbouring blocks differ in few bits)."""
    h = key * ti.i64(-7046029254386353131)
    h = h ^ (h >> 29)
    h = h * ti.i64(-4658895280553007687)
    return ti.cast((h >> 32) & 2147483647, ti.i32)


@ti.func
def ray_weight(rays: ti.template(), r):
    return rays[r, 6] & 65535


@ti.func
def ray_length(rays: ti.template(), r):
    """Length of the band, 2⁻¹⁶ voxel."""
    return (rays[r, 6] >> 16) << 9


@ti.func
def ray_start(rays: ti.template(), r):
    """First voxel of the band, next crossing and crossing interval an axis, direction, and the signed
    distance (along the ray, positive before the end point) of the first voxel's centre."""
    half = (rays[r, 6] >> 16) << 8
    voxel = vec3i(0)
    crossing = vec3i(0)
    interval = vec3i(0)
    direction = vec3i(0)
    dot = ti.i64(0)
    for a in ti.static(range(3)):
        u = rays[r, 3 + a]
        end = ti.cast(rays[r, a], ti.i64) << 6
        start = end - ((ti.cast(u, ti.i64) * half) >> 16)
        v = ti.cast(start >> 16, ti.i32)
        inside = ti.cast(start & 65535, ti.i32)
        gap = inside
        if u > 0:
            gap = 65536 - inside
        next_crossing = NEVER
        step = NEVER
        if abs(u) > 128:
            inverse = 65536.0 / ti.cast(abs(u), ti.f64)
            step = ti.cast(inverse * 65536.0, ti.i32)
            next_crossing = ti.cast(ti.cast(gap, ti.f64) * inverse, ti.i32)
        voxel[a] = v
        crossing[a] = next_crossing
        interval[a] = step
        direction[a] = u
        dot += (end - (ti.cast(v, ti.i64) << 16) - 32768) * u
    return voxel, crossing, interval, direction, ti.cast(dot >> 16, ti.i32)


@ti.func
def next_axis(crossing):
    axis = 2
    if crossing[0] <= crossing[1] and crossing[0] <= crossing[2]:
        axis = 0
    elif crossing[1] <= crossing[2]:
        axis = 1
    return axis


@ti.func
def sign(x):
    s = 1
    if x < 0:
        s = -1
    return s


@ti.func
def offset_in_block(voxel):
    return ((voxel[0] & 7) << 6) | ((voxel[1] & 7) << 3) | (voxel[2] & 7)


@ti.func
def block_key(voxel):
    return pack(voxel[0] >> 3, voxel[1] >> 3, voxel[2] >> 3)
