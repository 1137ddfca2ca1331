# SPDX-License-Identifier: MIT
"""Products that a sum is made of, each rounded by itself, as on every CPU.

Taichi's CUDA backend and drivers of Vulkan may turn a·b + c into one instruction that rounds once (FMA): its
last bit differs. There a product passes through `max` with a number below all that occur, which no
compiler can leave out or fuse. On the CPU, where Taichi does not fuse (`fast_math=False`), it is the bare
product.
"""

import taichi as ti

LOWEST = -3.0e38  # of float32, too


def _may_fuse() -> bool:
    return ti.lang.impl.current_cfg().arch not in (ti.x64, ti.arm64)


@ti.func
def product(a, b):
    """a·b, of numbers or of each component."""
    found = a * b
    if ti.static(_may_fuse()):
        found = ti.max(found, LOWEST)
    return found


@ti.func
def quotient(a, b):
    """a / b of float32, which CUDA else divides only nearly."""
    found = a / b
    if ti.static(_may_fuse()):
        found = ti.cast(ti.max(ti.cast(a, ti.f64) / ti.cast(b, ti.f64), LOWEST), ti.f32)
    return found


@ti.func
def dot(a, b):
    """a · b of two vectors."""
    return product(a, b).sum()


@ti.func
def norm(a):
    """Length of a vector."""
    return ti.sqrt(dot(a, a))


@ti.func
def cross(a, b):
    """a × b of two vectors of three."""
    left = product(ti.Vector([a[1], a[2], a[0]]), ti.Vector([b[2], b[0], b[1]]))
    return left - product(ti.Vector([a[2], a[0], a[1]]), ti.Vector([b[1], b[2], b[0]]))
