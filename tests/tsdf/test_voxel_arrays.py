# SPDX-License-Identifier: MIT
"""Voxels in a file have the numbers and places that the map gives them."""

from pathlib import Path

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of

from tsfusion.core.errors import OutputError
from tsfusion.tsdf import voxel_arrays

VIEWS = sphere_views(0.4, 5)


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
    assert np.abs(np.median(tsdf[seen] - distance)) < 0.002
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
