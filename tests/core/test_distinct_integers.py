# SPDX-License-Identifier: MIT
import numpy as np
import pytest

from tsfusion.core.number_ranges import distinct


@pytest.mark.parametrize(
    "values", [[], [5], [3, 3, 3], [2, -1, 2, 7, -1], [[1 << 62, 0], [-(1 << 62), 0]]], ids=str
)
def test_each_integer_comes_once_in_ascending_order(values: list[int]) -> None:
    array = np.array(values, np.int64)

    found = distinct(array)

    assert found.dtype == np.int64
    np.testing.assert_array_equal(found, np.unique(array))
