# SPDX-License-Identifier: MIT
"""Check that a device computes as the map needs it: atomics on int64, and float64 as on the CPU."""

import numpy as np

from tsfusion.kernels import F64, I64
from tsfusion.kernels import taichi as ti

_ADDED = 4096
_STEP = -(1 << 27) - 3


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
    """True if sums, the largest of numbers, and rounded quotients of roots come out as NumPy has them."""
    sums = ti.ndarray(ti.i64, (2,))
    sums.fill(0)
    _sum_and_largest(sums, _ADDED, _STEP)
    values = np.arange(1.0, _ADDED)
    expected = np.floor(65536.0 / np.sqrt(values) + 0.5)
    _roots(values)
    total = _STEP * (_ADDED * (_ADDED - 1) // 2)
    return sums.to_numpy().tolist() == [total, (_ADDED - 1) << 42] and bool((values == expected).all())
