# SPDX-License-Identifier: MIT
"""Multiply and divide with the same rounding on every device, and check that a device is exact.

Taichi's CUDA backend and Vulkan drivers may turn a·b + c into one instruction that rounds once (FMA), which
changes the last bit. There a product passes through `max` with a number below all possible products: no
compiler can leave out or fuse it. On the CPU, where Taichi does not fuse (`fast_math=False`), it is the plain
product. `is_exact` checks a device's atomics on int64, and its float64 results.
"""

import numpy as np

from tsfusion.kernels import F64, I64, ti

LOWEST = -3.0e38  # fits float32, too
_ADDED = 4096
_STEP = -(1 << 27) - 3


def _may_fuse() -> bool:
    return ti.lang.impl.current_cfg().arch not in (ti.x64, ti.arm64)


@ti.func
def product(a, b):
    """Return a·b of numbers or vectors, by component, rounded before any addition (never part of an FMA)."""
    found = a * b
    if ti.static(_may_fuse()):
        found = ti.max(found, LOWEST)
    return found


@ti.func
def quotient(a, b):
    """Return a / b of float32, correctly rounded on every device: CUDA's own division is not."""
    found = a / b
    if ti.static(_may_fuse()):
        found = ti.cast(ti.max(ti.cast(a, ti.f64) / ti.cast(b, ti.f64), LOWEST), ti.f32)
    return found


@ti.func
def dot(a, b):
    """Return a · b of two vectors."""
    return product(a, b).sum()


@ti.func
def norm(a):
    """Return the length of a vector."""
    return ti.sqrt(dot(a, a))


@ti.func
def cross(a, b):
    """Return a × b of two vectors of three components."""
    left = product(ti.Vector([a[1], a[2], a[0]]), ti.Vector([b[2], b[0], b[1]]))
    return left - product(ti.Vector([a[2], a[0], a[1]]), ti.Vector([b[1], b[2], b[0]]))


@ti.kernel
def _sum_and_largest(sums: I64, count: ti.i32, step: ti.i64):
    for i in range(count):
        ti.atomic_add(sums[0], step * i)
        ti.atomic_max(sums[1], ti.cast(i, ti.i64) << 42)


@ti.kernel
def _roots(values: F64):
    for i in range(values.shape[0]):
        values[i] = ti.floor(65536.0 / ti.sqrt(values[i]) + 0.5)


def is_exact() -> bool:
    """Return True if the device's int64 sums and maxima, and float64 roots and quotients, equal NumPy's."""
    sums = ti.ndarray(ti.i64, (2,))
    sums.fill(0)
    _sum_and_largest(sums, _ADDED, _STEP)
    values = np.arange(1.0, _ADDED)
    expected = np.floor(65536.0 / np.sqrt(values) + 0.5)
    _roots(values)
    total = _STEP * (_ADDED * (_ADDED - 1) // 2)
    return sums.to_numpy().tolist() == [total, (_ADDED - 1) << 42] and bool((values == expected).all())
