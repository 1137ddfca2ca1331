# SPDX-License-Identifier: MIT
"""Voxels in a file have the numbers and places that the map gives them."""

import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest
import vdb_reader
from formula_scenes import sphere_views, volume_of

from tsfusion import Volume
from tsfusion.core.errors import InvalidConfig, MissingDependency, OutputError
from tsfusion.geometry import point_files
from tsfusion.tsdf.files import voxel_arrays
from tsfusion.tsdf.files.voxel_arrays import FieldName

VIEWS = sphere_views(0.4, 5)
READ_BY_OPENVDB = "b462b416a0a428f11a815ff535cacd6790376a4996c5b3835095aa23c5ff1a2f"


@pytest.mark.parametrize("dense", [False, True])
def test_the_arrays_are_the_voxels(tmp_path: Path, dense: bool) -> None:
    volume = volume_of(VIEWS, voxel_size=0.02, surface="raw")
    told: list[tuple[int, int]] = []
    path = volume.save_voxels(tmp_path / "a.npz", dense=dense, watch=lambda *count: told.append(count))
    found = np.load(path)
    tsdf, weight, color = found["tsdf"], found["weight"], found["color"]
    assert (tsdf.dtype, weight.dtype, color.dtype) == (np.float32, np.float32, np.uint8)
    steps = np.stack(np.meshgrid(*map(np.arange, tsdf.shape[-3:]), indexing="ij"), axis=-1) + 0.5
    size = float(found["voxel_size"])
    if dense:
        centres = found["origin"] + steps * size
    else:
        centres = (8 * found["blocks"][:, None, None, None] + steps) * size
    seen = ~np.isnan(tsdf)
    assert (seen == (weight > 0)).all()
    assert seen.sum() == sum(volume.diff(volume_of([])).voxels.values())
    assert 16 * weight.astype(np.float64).sum() == (volume._store.sums & ((1 << 27) - 1)).sum()
    distance = np.linalg.norm(centres[seen], axis=-1) - 0.4
    assert np.abs(np.median(tsdf[seen] - distance)) < 0.003
    painted = color.any(axis=-1)
    assert np.abs(color[painted].astype(int) - (220, 120, 20)).max() <= 1
    assert not color[~seen].any()
    assert told[-1][0] == told[-1][1] == tsdf.nbytes + weight.nbytes + color.nbytes
    assert path.read_bytes() == volume.save_voxels(tmp_path / "b.npz", dense=dense).read_bytes()


def test_maps_without_colour_and_those_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    volume = volume_of(VIEWS[:1], voxel_size=0.03, color=False)
    path = volume.save_voxels(tmp_path / "a.npz")
    assert sorted(np.load(path)) == ["blocks", "tsdf", "voxel_size", "weight"]
    with pytest.raises(OutputError, match="the map is empty"):
        volume_of([]).save_voxels(path)
    monkeypatch.setattr(voxel_arrays, "MOST_DENSE", 1000)
    with pytest.raises(OutputError, match=r"too large .at most 1000.: crop the map"):
        volume.save_voxels(path, dense=True)
    with pytest.raises(OutputError, match="cannot write"):
        volume.save_voxels(tmp_path / "none" / "a.npz")
    assert len(list(tmp_path.iterdir())) == 1


@pytest.fixture(scope="module")
def sphere() -> Volume:
    return volume_of(VIEWS, voxel_size=0.04)


@pytest.mark.parametrize("field", ["tsdf", "distance"])
@pytest.mark.parametrize("dense", [False, True])
def test_zarr_holds_the_same_arrays(sphere: Volume, tmp_path: Path, field: FieldName, dense: bool) -> None:
    zarr = pytest.importorskip("zarr")
    arrays, group = (
        sphere.save_voxels(tmp_path / name, dense=dense, field=field, max_distance=0.2)
        for name in ("a.npz", "a.zarr")
    )
    sphere.save_voxels(group, dense=dense, field=field, max_distance=0.2)  # in the place of the one before
    expected, found = np.load(arrays), zarr.open_group(group, mode="r")
    assert sorted(expected) == sorted(found)
    assert field in found
    assert found.attrs["voxel_size"] == expected["voxel_size"]
    assert {"generator", "unit", "field"} <= set(found.attrs)
    assert found[field].attrs["units"] == "m"
    sizes = {}
    for name in expected:
        names = found[name].metadata.dimension_names
        for axis, length in zip(
            names or (), found[name].shape, strict=True
        ):  # one name, one length: xarray's rule
            assert sizes.setdefault(axis, length) == length
        assert expected[name].dtype == found[name].dtype
        np.testing.assert_array_equal(expected[name], found[name][...])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "a.zarr"]


def test_the_distance_field_in_a_file_is_the_maps(sphere: Volume, tmp_path: Path) -> None:
    found = np.load(sphere.save_voxels(tmp_path / "a.npz", field="distance", max_distance=0.2))
    blocks = list(sphere.distance_blocks(max_distance=0.2))
    assert (found["blocks"] == np.concatenate([one.blocks for one in blocks])).all()
    assert (found["distance"] == np.concatenate([one.distance for one in blocks])).all()
    whole = np.load(sphere.save_voxels(tmp_path / "b.npz", field="distance", max_distance=0.2, dense=True))
    around = sphere.distance_field(max_distance=0.2, unseen_is_free=True)
    assert (whole["distance"] == around.distance).all()


def test_other_files_and_fields_are_refused(sphere: Volume, tmp_path: Path) -> None:
    for name, how in (("a.txt", {}), ("a.vdb", {"dense": True}), ("a.npz", {"field": "weight"})):
        with pytest.raises(InvalidConfig, match=r"voxels are written to \.npz, \.zarr, \.vdb"):
            sphere.save_voxels(tmp_path / name, **how)
    pytest.importorskip("zarr")
    (tmp_path / "b.zarr").write_text("mine")
    (tmp_path / "c.zarr").mkdir()
    (tmp_path / "c.zarr" / "mine").write_text("mine")
    with pytest.raises(OutputError, match="a folder of something else"):
        sphere.save_voxels(tmp_path / "c.zarr")
    with pytest.raises(OutputError, match="it is a file, not a folder"):
        sphere.save_voxels(tmp_path / "b.zarr")
    with pytest.raises(OutputError, match="cannot write"):
        sphere.save_voxels(tmp_path / "none" / "a.vdb")
    with pytest.raises(OutputError, match="no surface with so much weight"):
        sphere.save_voxels(tmp_path / "a.npz", field="distance", min_weight=1e5)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.zarr", "c.zarr"]


def test_without_zarr_the_command_is_named(
    sphere: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(MissingDependency, match=r"pip install '\.\[zarr\]'"):
        sphere.save_voxels(tmp_path / "a.zarr")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("field", ["tsdf", "distance"])
def test_an_openvdb_file_holds_the_field(sphere: Volume, tmp_path: Path, field: FieldName) -> None:
    grid = vdb_reader.read(sphere.save_voxels(tmp_path / "a.vdb", field=field, max_distance=0.2))
    expected = np.load(sphere.save_voxels(tmp_path / "a.npz", field=field, max_distance=0.2))
    assert grid.name == field
    assert (grid.voxel_size, grid.translation) == (0.04, 0.02)
    values = np.nan_to_num(expected[field], nan=grid.background)
    assert {tuple(block) for block in expected["blocks"].tolist()} == set(grid.leaves)
    for block, leaf in zip(expected["blocks"].tolist(), values, strict=True):
        assert (grid.leaves[tuple(block)] == leaf).all()


def test_openvdb_has_read_this_file(tmp_path: Path) -> None:
    """OpenVDB 10.0 has read the file of these bytes, and found these values."""
    random = np.random.default_rng(0)
    blocks = np.unique(random.integers(-600, 600, (40, 3)).astype(np.int32), axis=0)
    blocks = blocks[point_files.order_of(blocks)]
    values = random.integers(-30, 30, (len(blocks), 8, 8, 8)).astype(np.float32) / 16
    values[random.random(values.shape) < 0.5] = 3
    path = tmp_path / "a.vdb"
    parts = [(blocks[:17], values[:17]), (blocks[17:], values[17:])]
    point_files.write(path, parts, name="tsdf", voxel_size=0.0625, background=3.0)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == READ_BY_OPENVDB
    grid = vdb_reader.read(path)
    for block, leaf in zip(blocks.tolist(), values, strict=True):
        assert (grid.leaves[tuple(block)] == leaf).all()
    assert len(grid.leaves) == len(blocks)
