# SPDX-License-Identifier: MIT
"""Smoothing along rays against a dense solve."""

import kernel_twins
import numpy as np
import pytest
from ray_maps import CASES, QUANTA, RayMap, random_segments, rays_along


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("case", ["one", "many", "crowded", "borders", "carving"])
def test_smoothing_equals_a_dense_solve(case: str, weighted: bool) -> None:
    smoothness, here, random = 2.5, RayMap(), np.random.default_rng(5)
    # part of the voxels were in the map before, with smoothed values of their own
    here.apply(rays_along(random_segments(6, 200, spread=20.0)))
    weight = here.store.sums & 0x7FFFFFF
    here.store.correction[:] = random.normal(0, 30, weight.shape) * weight
    before = {
        voxel: (here.value(at), int(weight[at])) for voxel, at in here.voxels().items() if weight[at] > 0
    }
    here.apply(CASES[case])
    here.smooth(smoothness, weighted=weighted)
    expected = kernel_twins.smooth(CASES[case], QUANTA, before, smoothness, weighted)
    voxels = here.voxels()
    assert expected.keys() <= voxels.keys()
    # values reach ±1000 quanta: a float32 solve and a sixteenth of a quantum of rounding
    assert max(abs(here.value(voxels[v]) - expected[v]) for v in expected) < 0.2
    for voxel in before.keys() - kernel_twins.integrate(CASES[case], QUANTA).keys():
        assert abs(here.value(voxels[voxel]) - before[voxel][0]) < 1e-3
    assert not here.buffers.votes.any()


def test_a_ramp_passes_the_smoother_unchanged() -> None:
    for ray in CASES["many"][:40]:
        here = RayMap()
        here.apply(ray[None])
        here.smooth(1000.0, feedback=False)
        weight = np.maximum(here.store.sums & 0x7FFFFFF, 1)
        # the stored ramp is rounded to quanta; nothing else may bend it
        assert np.abs(here.store.correction / weight).max() <= 0.75


def test_no_smoothness_returns_the_signal() -> None:
    here = RayMap()
    here.apply(CASES["crowded"])
    here.smooth(0.0, feedback=False)
    weight = np.maximum(here.store.sums & 0x7FFFFFF, 1)
    assert np.abs(here.store.correction / weight).max() <= 0.05
