# SPDX-License-Identifier: MIT
"""Traversal and integration against their NumPy twins: seeded, empty, single and block-border inputs."""

import kernel_twins
import numpy as np
import pytest
from ray_maps import CASES, QUANTA, SEGMENTS, RayMap, random_segments, rays_along

from tsfusion.kernels.base.voxel_traversal import SHARED
from tsfusion.tsdf.store.block_store import unpack_keys


@pytest.mark.parametrize("case", ["one", "many", "crowded", "borders"])
def test_the_traversal_visits_every_voxel_the_band_runs_through(case: str) -> None:
    for (end, direction, half), ray in list(zip(SEGMENTS[case], CASES[case], strict=True))[:60]:
        visited = [voxel for voxel, _ in kernel_twins.crossed(ray)]
        assert len(set(visited)) == len(visited)
        truth = kernel_twins.segment_voxels(end, direction, half / 256)
        # a voxel missed by either is one whose corner or face is only grazed
        for voxel in truth ^ set(visited):
            assert kernel_twins.neighbours(voxel) & truth & set(visited)
        assert len(truth - set(visited)) <= 0.1 * len(truth) + 2
        ends = np.floor(end / 1024).astype(int)
        assert np.abs(np.array(kernel_twins.end_of(ray)) - ends).max() <= 1


@pytest.mark.parametrize("case", CASES)
def test_the_maps_blocks_are_those_of_the_crossed_voxels(case: str) -> None:
    here = RayMap()
    here.apply(CASES[case])
    found = [tuple(key) for key in unpack_keys(here.store.keys).tolist()]
    assert len(set(found)) == len(found)
    assert set(found) == kernel_twins.blocks_of(CASES[case])
    assert sorted(here.buffers.touched_slots.tolist()) == list(range(len(found)))


@pytest.mark.parametrize("case", CASES)
def test_integration_equals_the_twin_to_the_bit(case: str) -> None:
    here, half = RayMap(), len(CASES[case]) // 2
    # the second time, some blocks are there and some are missing
    updates = here.apply(CASES[case][:half]) + here.apply(CASES[case])
    expected = kernel_twins.integrate(np.vstack([CASES[case][:half], CASES[case]]), QUANTA)
    found = {voxel: int(here.store.sums[at]) for voxel, at in here.voxels().items()}
    assert found == {voxel: (s << 27) + w for voxel, (s, w) in expected.items()}
    assert updates == sum(len(kernel_twins.crossed(ray)) for ray in (*CASES[case][:half], *CASES[case]))


@pytest.mark.parametrize("case", CASES)
def test_colours_equal_the_twin_to_the_bit(case: str) -> None:
    here = RayMap()
    here.apply(CASES[case])
    voxels, rgn = here.voxels(), here.store.color_rgn
    found = {
        voxel: (int(rgn[at] >> 40), int(rgn[at] >> 16 & 0xFFFFFF), int(here.store.color_b[at]),
                int(rgn[at] & 0xFFFF))
        for voxel, at in voxels.items() if rgn[at]
    }  # fmt: skip
    assert found == kernel_twins.colors(CASES[case])


@pytest.mark.parametrize("case", CASES)
def test_what_is_taken_away_leaves_no_bit(case: str) -> None:
    here = RayMap()
    here.apply(CASES["many"])
    before = {name: layer.copy() for name, layer in here.store.layers().items()}
    here.apply(CASES[case])
    here.apply(CASES[case], sign=-1)
    for name, layer in here.store.layers().items():
        assert (layer[: len(before[name])] == before[name]).all()
        assert not layer[len(before[name]) :].any()


@pytest.mark.parametrize("case", ["many", "crowded"])
@pytest.mark.parametrize("sign", [1, -1])
def test_units_that_share_blocks_add_what_one_does(case: str, sign: int) -> None:
    maps, updates, half = [RayMap(units) for units in (1, 2, 7)], [], len(CASES[case]) // 2
    for here in maps:
        here.apply(CASES[case][:half])  # then, some blocks are there and some are missing
        if sign < 0:
            here.apply(CASES[case])
        updates.append(here.apply(CASES[case], sign))
    assert len(set(updates)) == 1
    for here in maps[1:]:
        assert here.buffers.strips[:, SHARED].any()
        assert (here.store.keys == maps[0].store.keys).all()
        for name, layer in here.store.layers().items():
            assert (layer == maps[0].store.layers()[name]).all()


def test_windows_that_take_the_place_of_others_are_read_anew() -> None:
    """Rays in turn through windows whose coordinates have equal low bits."""
    ends = [np.array([256.0 * (i % 3), 64.0 * (i % 2) + 0.3 * i, i]) for i in range(40)]
    segments = [(kernel_twins.fixed(end), np.array([1.0, 0.2, 0]), 2048) for end in ends]
    rays = rays_along(segments)
    here = RayMap()
    assert here.apply(rays) == sum(len(kernel_twins.crossed(ray)) for ray in rays)
    found = {voxel: int(here.store.sums[at]) for voxel, at in here.voxels().items()}
    expected = kernel_twins.integrate(rays, QUANTA)
    assert found == {voxel: (s << 27) + w for voxel, (s, w) in expected.items()}


def test_many_missing_blocks_are_all_found() -> None:
    rays = rays_along(random_segments(7, 6000, spread=400.0))
    here = RayMap()
    here.apply(rays)
    assert here.store.count == len(kernel_twins.blocks_of(rays))
