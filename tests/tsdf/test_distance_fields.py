# SPDX-License-Identifier: MIT
"""Distances to the surface are SciPy's on the same voxels, and nearer the truth where it is known."""

import sys
from pathlib import Path

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from tsfusion import DistanceField, Volume
from tsfusion.core import durable_files
from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.kernels.answers import distance_transform as kernels
from tsfusion.kernels.base import runtime
from tsfusion.tsdf.answers import distance_fields

RADIUS, VOXEL = 0.4, 0.03
BOX = (-0.8, -0.8, -0.8, 0.8, 0.8, 0.8)


@pytest.fixture(scope="module")
def sphere() -> Volume:
    return volume_of(sphere_views(RADIUS, 12), voxel_size=VOXEL)


def centres(field: DistanceField) -> NDArray[np.float64]:
    steps = np.stack(np.meshgrid(*map(np.arange, field.distance.shape), indexing="ij"), axis=-1) + 0.5
    found: NDArray[np.float64] = field.origin + steps * field.voxel_size
    return found


def test_between_voxels_the_distances_are_scipys(sphere: Volume) -> None:
    field = sphere.distance_field(BOX, max_distance=0.5, subvoxel=False, unseen_is_free=True)
    assert field.distance.dtype == np.float32
    found, sites = np.abs(field.distance), field.distance == 0
    assert 1000 < sites.sum() < 4000
    expected = np.minimum(distance_transform_edt(~sites) * VOXEL, 0.5)
    assert np.abs(found - expected).max() < 1e-6


def test_within_voxels_the_distances_are_nearer_the_truth(sphere: Volume) -> None:
    errors = {}
    for subvoxel in (False, True):
        field = sphere.distance_field(BOX, max_distance=0.5, subvoxel=subvoxel, unseen_is_free=True)
        radius = np.linalg.norm(centres(field), axis=-1)
        outside = (radius > RADIUS + 2 * VOXEL) & (radius < RADIUS + 0.4)
        errors[subvoxel] = np.abs(field.distance - (radius - RADIUS))[outside].mean()
        behind = (radius < RADIUS - VOXEL) & (field.occupancy == 100)
        assert (field.distance[behind] < 0).all()
        assert behind.sum() > 100
        assert (field.distance[radius > RADIUS + VOXEL] > 0).all()
    assert errors[True] < 0.1 * VOXEL
    assert errors[True] < 0.6 * errors[False]


@pytest.mark.parametrize("subvoxel", [False, True])
def test_a_voxel_has_the_same_distance_in_every_box(sphere: Volume, subvoxel: bool) -> None:
    whole = sphere.distance_field(BOX, max_distance=0.3, subvoxel=subvoxel)
    boxes = (
        (-0.3, -0.2, 0.1, 0.5, 0.3, 0.12),
        (-0.8, 0.42, -0.5, -0.6, 0.45, 0.8),
        (0.5, 0, 0, 0.53, 0.7, 0.7),
    )
    for box in boxes:
        part = sphere.distance_field(box, max_distance=0.3, subvoxel=subvoxel)
        at = np.rint((part.origin - whole.origin) / VOXEL).astype(int)
        same = tuple(slice(a, a + n) for a, n in zip(at, part.distance.shape, strict=True))
        assert part.distance.size
        assert (part.distance == whole.distance[same]).all()
        assert (part.occupancy == whole.occupancy[same]).all()


def test_blocks_of_the_whole_map_are_its_field(sphere: Volume, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distance_fields, "_TILE", 3)  # several tiles
    whole = sphere.distance_field((-1.44,) * 3 + (1.44,) * 3, max_distance=0.1, unseen_is_free=True)
    rest = np.abs(whole.distance) < np.float32(0.1)
    first = np.rint(whole.origin / VOXEL / 8).astype(int)
    seen = set()
    for blocks, distance in sphere.distance_blocks(max_distance=0.1):
        for block, values in zip(blocks, distance, strict=True):
            x, y, z = 8 * (block - first)
            here = slice(x, x + 8), slice(y, y + 8), slice(z, z + 8)
            assert (whole.distance[here] == values).all()
            rest[here] = False
            assert tuple(block) not in seen
            seen.add(tuple(block))
    assert not rest.any()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.tuples(*[st.integers(1, 12)] * 3), st.floats(0, 0.3), st.integers(1, 14))
def test_the_transform_is_scipys(seed: int, shape: tuple[int, int, int], share: float, most: int) -> None:
    """Any sites, of which those far away do not count; of equally near ones the first is named."""
    runtime.start(2)
    random = np.random.default_rng(seed)
    sites = random.random(shape) < share
    found = np.where(sites, 0, kernels.FAR).astype(np.int32).ravel(), np.arange(sites.size, dtype=np.int32)
    reach = distance_fields.Reach(most, 1.0)
    for axis in random.permutation(3):
        length, inner = shape[axis], int(np.prod(shape[axis + 1 :]))
        into = np.empty(sites.size, np.int32), np.empty(sites.size, np.int32)
        lines = (0, sites.size // length)
        found = distance_fields.spread(
            found, into, (length, inner), lines=lines, places=(0, length), reach=reach
        )
    apart = ((np.argwhere(sites)[None] - np.argwhere(np.ones(shape, bool))[:, None]) ** 2).sum(axis=2)
    if not sites.any():
        assert (found[1] == kernels.NONE).all()
        return
    near = apart.min(axis=1) <= reach.most_squared
    assert (found[0] == np.where(near, apart.min(axis=1), kernels.FAR)).all()
    assert (found[1] == np.where(near, np.flatnonzero(sites)[apart.argmin(axis=1)], kernels.NONE)).all()


@pytest.mark.skipif(sys.platform != "linux", reason="memory_bytes needs Linux")
def test_a_map_in_files_has_the_same_field(sphere: Volume, tmp_path: Path) -> None:
    if durable_files.is_in_memory(tmp_path):
        pytest.skip("the folder for temporary files is a RAM disk")
    opened = Volume.load(sphere.save(tmp_path / "map.tsf"), memory_bytes=1 << 20, cache=tmp_path)
    for box in (None, BOX):
        ours, theirs = (one.distance_field(box, max_distance=0.2) for one in (opened, sphere))
        assert (ours.distance == theirs.distance).all()
    slices = [one.distance_slice(-0.1, 0.1, up="z") for one in (opened, sphere)]
    assert (slices[0].distance == slices[1].distance).all()


def test_what_cannot_be_answered_is_refused(sphere: Volume) -> None:
    empty = volume_of([])
    with pytest.raises(MapError, match="the map is empty, so no box surrounds it"):
        empty.distance_field()
    field = empty.distance_field((0, 0, 0, 0.1, 0.1, 0.1), max_distance=0.2, unseen_is_free=True)
    assert (field.distance == np.float32(0.2)).all()
    assert (field.occupancy == -1).all()
    assert list(empty.distance_blocks()) == []
    far = sphere.distance_field((900, 0, 0, 900.1, 0.1, 0.1), max_distance=0.2, unseen_is_free=True)
    assert (far.distance == np.float32(0.2)).all()
    for box in ((0, 0, 0, 0, 1, 1), (0, 0, 0, 1, 1), (0, 0, 0, np.nan, 1, 1)):
        with pytest.raises(InvalidConfig, match="a box must be"):
            sphere.distance_field(box)
    with pytest.raises(InvalidConfig, match="no voxel has its centre in the box"):
        sphere.distance_field((0.001, 0, 0, 0.002, 1, 1))
    with pytest.raises(InvalidConfig, match=r"too many .at most .*give a smaller box, or a smaller max_dist"):
        sphere.distance_field((-100, -100, -100, 100, 100, 100))
    for wrong in (0, -1, np.nan, np.inf):
        with pytest.raises(InvalidConfig, match="max_distance must be > 0 m"):
            sphere.distance_field(BOX, max_distance=wrong)
    with pytest.raises(InvalidConfig, match="give less"):
        sphere.distance_field(BOX, max_distance=1e6)
