# SPDX-License-Identifier: MIT
"""Signed distances at points, against trilinear interpolation in plain NumPy."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tsfusion import InvalidConfig, Keyframe, Volume
from tsfusion.geometry.map_answers import Samples
from tsfusion.tsdf.store.block_store import pack_keys

VOXEL = 0.05
FINE = 1 << 16  # of a voxel


def filled(seed: int, *, regularizer: str = "off") -> Volume:
    """A map of random points, so that neighbouring voxels differ and many are unseen."""
    random = np.random.default_rng(seed)
    points = random.uniform(-0.5, 0.5, (3000, 3)).astype(np.float32)
    origins = points + random.normal(size=points.shape).astype(np.float32)
    volume = Volume(VOXEL, sensor="scanner", threads=2, regularizer=regularizer, bundle=False)
    volume.integrate(points=points, origins=origins, T_world_camera=np.eye(4))
    return volume


@pytest.fixture(scope="module")
def volume() -> Volume:
    return filled(1)


def expected(volume: Volume, points: NDArray[np.floating], min_weight: float = 0.25) -> Samples:
    """The twin of `kernels.answers.point_sampling`: of the sums, voxel by voxel."""
    store = volume._store
    slots = {int(key): slot for slot, key in enumerate(store.keys)}
    found = np.full(len(points), np.nan), np.zeros(len(points)), np.full((len(points), 3), np.nan)
    for n, point in enumerate(np.asarray(points, np.float64)):
        place = point / VOXEL
        if not (np.abs(place) < (1 << 20) - 64).all():
            continue
        place = np.floor(place * FINE + 0.5) / FINE - 0.5
        voxel = np.floor(place).astype(int)
        values, weights = np.full((2, 2, 2), np.nan), np.zeros((2, 2, 2))
        for corner in product((0, 1), repeat=3):
            x, y, z = (int(c) for c in voxel + corner)
            slot = slots.get((x // 8 + (1 << 20)) << 42 | (y // 8 + (1 << 20)) << 21 | z // 8 + (1 << 20))
            if slot is not None:
                packed = int(store.sums[slot, (x % 8) << 6 | (y % 8) << 3 | z % 8])
                weights[corner] = packed & (1 << 27) - 1
                if weights[corner] >= max(1, np.ceil(16 * min_weight)):
                    values[corner] = (packed >> 27) / weights[corner] * VOXEL / 60
        ends = np.stack([1 - (place - voxel), place - voxel])
        share = np.einsum("i,j,k->ijk", *ends.T)
        found[0][n] = np.where(share > 0, share * values, 0).sum()
        found[1][n] = (share * weights).sum() / 16
        for axis in range(3):
            lines = [np.array([-1.0, 1.0]) / VOXEL if a == axis else ends[:, a] for a in range(3)]
            found[2][n, axis] = (np.einsum("i,j,k->ijk", *lines) * values).sum()
        steep = np.linalg.norm(found[2][n])
        if steep > 1:
            found[0][n] /= steep
            found[2][n] /= steep
    return Samples(*(array.astype(np.float32) for array in found))


def assert_equal(found: Samples, wanted: Samples) -> None:
    np.testing.assert_allclose(found.distance, wanted.distance, atol=2e-6)
    np.testing.assert_allclose(found.weight, wanted.weight, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.gradient, wanted.gradient, atol=1e-4)


near = st.floats(-0.7, 0.7, allow_subnormal=False)
grid = st.integers(-30, 30).map(lambda half: half * VOXEL / 2)  # centres and borders of voxels and of blocks
odd = st.sampled_from([np.nan, np.inf, -np.inf, 1e30, 52428.0, -52428.0, 52424.0, 0.0])
coordinate = st.one_of(near, grid, near, grid, odd)


@settings(max_examples=150, deadline=None)
@given(points=st.lists(st.tuples(coordinate, coordinate, coordinate), max_size=20), single=st.booleans())
def test_samples_are_interpolated(volume: Volume, points: list[tuple[float, ...]], single: bool) -> None:
    given = np.array(points, np.float32 if single else np.float64).reshape(-1, 3)
    assert_equal(volume.sample(given, surface="raw"), expected(volume, given))


@pytest.mark.parametrize("min_weight", [0, 0.5, 1.0])
def test_voxels_with_fewer_votes_are_unseen(volume: Volume, min_weight: float) -> None:
    points = np.random.default_rng(2).uniform(-0.7, 0.7, (1500, 3))
    found = volume.sample(points, min_weight=min_weight, surface="raw")
    assert_equal(found, expected(volume, points, min_weight))
    assert 0 < np.isfinite(found.distance).sum() < len(points)


@pytest.mark.parametrize("surface", ["raw", "field"])
@pytest.mark.parametrize("regularizer", ["off", "ray"])
@pytest.mark.parametrize("far", [0, 40])
def test_an_answer_does_not_depend_on_how_many_points_are_asked(
    surface: str, regularizer: str, far: int
) -> None:
    """Many points go by a table of the map's blocks, unless these lie too far apart."""
    volume = filled(6, regularizer=regularizer)
    if far:
        there = np.full((1, 3), far * 8 * VOXEL, np.float32)
        volume.integrate(points=there, origins=there - np.float32(0.2), T_world_camera=np.eye(4))
    random = np.random.default_rng(7)
    count = 20 * volume.stats().blocks
    points = random.uniform(-0.9, 0.9, (count, 3))
    snapped = random.random((count, 3)) < 0.4
    points[snapped] = np.round(points[snapped] / VOXEL * 2) * VOXEL / 2  # centres and borders
    points[:6] = [
        (np.nan, 0, 0), (0, np.inf, 0), (1e30, 0, 0), (0, 0, -1e30), (52424, 0, 0), (0.1, -52428, 0),
    ]  # fmt: skip
    by_table = volume.sample(points, surface=surface)  # type: ignore[arg-type]
    assert 0.1 < np.isfinite(by_table.distance).mean() < 0.9
    for first in range(0, count, count // 40):
        part = slice(first, first + 10)
        found = volume.sample(points[part], surface=surface)  # type: ignore[arg-type]
        for name in ("distance", "weight", "gradient"):
            values, expected = getattr(found, name), getattr(by_table, name)[part]
            assert np.array_equal(values.view(np.uint32), expected.view(np.uint32)), name


def test_an_empty_map_has_seen_nothing() -> None:
    found = Volume(VOXEL, threads=2).sample(np.zeros((3, 3)))
    assert np.isnan(found.distance).all()
    assert np.isnan(found.gradient).all()
    assert (found.weight == 0).all()
    assert found.distance.dtype == found.weight.dtype == found.gradient.dtype == np.float32
    assert len(Volume(VOXEL, threads=2).sample(np.zeros((0, 3))).distance) == 0


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((2, 4)), np.zeros((1, 3), complex), "nowhere"])
def test_points_of_another_shape_are_refused(volume: Volume, points: object) -> None:
    with pytest.raises(InvalidConfig, match=r"points must be numbers of shape \(n, 3\)"):
        volume.sample(points)  # type: ignore[arg-type]


@pytest.mark.parametrize("surface", ["raw", "normal", "field"])
def test_each_surface_at_voxel_centres_is_what_is_meshed(surface: str) -> None:
    volume = filled(3, regularizer="ray")
    centres = (np.random.default_rng(4).integers(-10, 10, (500, 3)) + 0.5) * VOXEL
    found = volume.sample(centres, surface=surface)  # type: ignore[arg-type]
    blocks = np.unique(np.floor(centres / VOXEL).astype(np.int32) >> 3, axis=0)
    keys = np.unique(pack_keys(blocks))
    values = volume.surface.view(surface)(keys, volume._store, 0.25)  # type: ignore[arg-type]
    voxels = np.floor(centres / VOXEL).astype(int)
    x, y, z = voxels.T & 7
    at = values[np.searchsorted(keys, pack_keys(voxels >> 3)), x << 6 | y << 3 | z]
    assert np.array_equal(np.isnan(found.distance), np.isnan(at))
    flat = np.linalg.norm(found.gradient, axis=1) < 0.999
    halo = 0.01 * VOXEL if surface == "field" else 1e-6  # other blocks are solved with it
    np.testing.assert_allclose(found.distance[flat], at[flat] * VOXEL / 60, atol=halo)
    assert np.isfinite(at[flat]).sum() > 20


def test_a_wall_is_as_far_as_it_is(volume: Volume) -> None:
    u, v = (x.ravel() for x in np.mgrid[-0.5:0.5:0.01, -0.5:0.5:0.01])
    wall = np.stack([u, v, np.full_like(u, 1.0)], 1).astype(np.float32)
    origins = wall - np.array((0, 0, 0.5), np.float32)
    wall_map = Volume(VOXEL, sensor="scanner", threads=2, bundle=False)
    wall_map.integrate(Keyframe(points=wall, origins=origins, T_world_camera=np.eye(4)))
    points = np.random.default_rng(5).uniform((-0.4, -0.4, 0.88), (0.4, 0.4, 1.02), (200, 3))
    found = wall_map.sample(points)
    np.testing.assert_allclose(found.distance, 1 - points[:, 2], atol=2e-3)
    np.testing.assert_allclose(found.gradient, np.tile([0, 0, -1], (200, 1)), atol=0.05)
