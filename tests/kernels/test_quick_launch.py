# SPDX-License-Identifier: MIT
"""Quick launches do what Taichi's own do, and leave to Taichi what they do not know."""

import numpy as np
import pytest

from tsfusion.kernels import ENGINE, ti
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.quick_launch import QuickLaunch


@ti.kernel
def scale(
    values: ti.types.ndarray(), factor: ti.f64, shift: ti.i32, sums: ti.types.ndarray(dtype=ti.i64, ndim=1)
):
    """`sums` += rows of `values` · factor + shift."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            sums[i] += ti.cast(values[i, j] * factor, ti.i64) + shift


def test_launches_follow_values_shapes_and_dtypes() -> None:
    runtime.start(2)
    quick = QuickLaunch(scale)
    for dtype in (np.float32, np.int32, np.float32, np.uint16, np.int32):
        for rows in (3, 0, 5):
            values = np.arange(rows * 4).reshape(rows, 4).astype(dtype)
            found, expected = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
            quick(values, 1.5, rows, found)
            scale(values, 1.5, rows, expected)
            assert (found == expected).all()
            quick(values, 2, np.int64(7), found)  # an integer for a float
            scale(values, 2, 7, expected)
            assert (found == expected).all()
            assert rows == 0 or found.any()
    assert quick._compiled  # else Taichi would have launched them all


def test_taichi_refuses_what_it_would_refuse() -> None:
    runtime.start(2)
    quick, sums = QuickLaunch(scale), np.zeros(4, np.int64)
    values = np.ones((4, 4), np.float32)
    quick(values, 1.0, 1, sums)
    quick(values, 1.0, 1, sums)
    assert (sums == 16).all()
    with pytest.raises(ValueError, match="contiguous"):
        quick(np.ones((4, 8), np.float32)[:, ::2], 1.0, 1, sums)
    with pytest.raises(ValueError, match="dimension"):
        quick(values, 1.0, 1, np.zeros((4, 1), np.int64))
    with pytest.raises(getattr(ti, f"{ENGINE.capitalize()}RuntimeTypeError")):
        quick(values, 1.0, 1.5, sums)
    with pytest.raises(AssertionError, match=">f4"):
        quick(values.astype(">f4"), 1.0, 1, sums)
    assert (sums == 16).all()


@ti.kernel
def add_vector(step: ti.types.vector(3, ti.i32), sums: ti.types.ndarray(dtype=ti.i64, ndim=1)):
    for a in ti.static(range(3)):
        sums[a] += step[a]


def test_vectors_are_left_to_taichi() -> None:
    runtime.start(2)
    quick, sums = QuickLaunch(add_vector), np.zeros(3, np.int64)
    for _ in range(3):
        quick(np.array([1, 2, 3], np.int32), sums)
    assert sums.tolist() == [3, 6, 9]
    assert not quick._compiled


def test_what_another_taichi_keeps_elsewhere_is_launched_as_ever() -> None:
    runtime.start(2)
    launched = []
    quick = QuickLaunch(lambda *arguments: launched.append(arguments))  # has nothing of a Taichi kernel
    for _ in range(3):
        quick(np.zeros(3), 1)
    assert len(launched) == 3


def test_a_kernel_keeps_its_name_and_docstring() -> None:
    quick = QuickLaunch(scale)
    assert quick.__doc__ == scale.__doc__
    assert quick.__name__ == "scale"
