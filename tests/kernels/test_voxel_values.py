# SPDX-License-Identifier: MIT
"""Values read from the sums, against NumPy."""

import numpy as np
import pytest
from block_stores import store_of

from tsfusion.tsdf.block_store import pack_keys
from tsfusion.tsdf.surface_values import values_of

PATCH = np.array([(x, y, z) for x in (-2, -1, 0) for y in (-1, 0) for z in (-1, 0, 1) if x + y + z], np.int32)


@pytest.mark.parametrize("smoothed", [False, True])
def test_values_equal_the_twin(smoothed: bool) -> None:
    random = np.random.default_rng(5)
    weight = random.integers(0, 60, (len(PATCH), 512)) << random.integers(0, 20, (len(PATCH), 512))
    sums = (weight * random.integers(-1023, 1024, weight.shape) << 27) + weight
    sums[0, :2] = ((1 << 36) - 1 << 27) + 77, (-(1 << 36) << 27) + 99
    correction = random.normal(0, 99, weight.shape).astype(np.float32) if smoothed else None
    store = store_of(pack_keys(PATCH), sums, correction=correction)
    absent = pack_keys(np.array([[7, 7, 7]], np.int32))
    found = values_of(np.concatenate([pack_keys(PATCH), absent]), store, 2.0)
    distance, weight = (sums >> 27).astype(np.float32), (sums & 0x7FFFFFF).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = distance if correction is None else distance + correction
        expected = np.where(weight >= 32, moved / weight, np.nan)
    assert found.dtype == np.float32
    assert np.array_equal(found[:-1], expected, equal_nan=True)
    assert np.isnan(found[-1]).all()


def test_a_lane_becomes_the_nearest_float() -> None:
    """The two halves a lane is converted in round once, like the whole."""
    lane = np.random.default_rng(6).integers(-(1 << 36), 1 << 36, (1, 512))
    store = store_of(pack_keys(PATCH[:1]), (lane << 27) + 1)
    assert np.array_equal(values_of(pack_keys(PATCH[:1]), store, 0.0), lane.astype(np.float32))
