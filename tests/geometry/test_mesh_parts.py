# SPDX-License-Identifier: MIT
"""A mesh that was written in parts is the mesh that was written as a whole."""

import errno
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from failures import refuse
from formula_scenes import sphere_views, tilted_plane, volume_of
from numpy.typing import NDArray

from tsfusion import Volume
from tsfusion.core.errors import OutputError
from tsfusion.geometry import up_direction
from tsfusion.tsdf.surface import field_regularizer


@pytest.fixture
def volume(monkeypatch: pytest.MonkeyPatch) -> Volume:
    """A map of several tiles."""
    monkeypatch.setattr(field_regularizer, "BATCH", 25)
    volume = volume_of(sphere_views(0.4, 6))
    assert volume.stats().blocks > 5 * 25
    return volume


@pytest.mark.parametrize("surface", ["raw", "normal", "field"])
def test_one_ply_of_tiles_is_byte_for_byte_that_of_the_whole_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, surface: str
) -> None:
    monkeypatch.setattr(field_regularizer, "BATCH", 32)
    monkeypatch.setattr(up_direction, "SAMPLE", 700)
    volume = volume_of(sphere_views(0.4, 6), surface=surface, color=surface != "raw")
    whole = volume.extract_mesh()
    whole.save(tmp_path / "whole.ply")
    parts = volume.mesh_parts(tmp_path)
    assert parts.up == whole.up is not None
    (file,) = parts.save(tmp_path / "parts.ply")
    assert file.read_bytes() == (tmp_path / "whole.ply").read_bytes()
    figures = {**whole.figures, "islands": None, "island_triangles": None}
    assert parts.figures == figures
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parts.ply", "whole.ply"]


def linear_colors(path: Path) -> NDArray[np.uint16]:
    """(m, 3, 4) of the corners of a GLB of one mesh."""
    (mesh,) = trimesh.load(path, process=False).geometry.values()
    return np.asarray(mesh.visual.vertex_attributes["color"])[mesh.faces]


def test_glb_tiles_are_the_triangles_of_the_whole_mesh(tmp_path: Path, volume: Volume) -> None:
    whole = volume.extract_mesh()
    (tmp_path / "map-0001.glb").write_bytes(b"of a mesh before")
    (tmp_path / "map-0099.glb").write_bytes(b"somebody's own")
    parts = volume.mesh_parts(tmp_path)
    count = len(parts.save(tmp_path / "map.glb"))
    stale = [tmp_path / f"map-{count + more:04}.glb" for more in (1, 2)]
    for path in stale:
        path.write_bytes(b"of a larger mesh before")
    files = parts.save(tmp_path / "map.glb")
    assert not any(path.exists() for path in stale)
    assert (tmp_path / "map-0099.glb").exists()
    assert len(files) > 4
    assert files[0].name == "map-0001.glb"
    expected = trimesh.load(whole.save(tmp_path / "whole.glb"), process=False).to_geometry()
    found = [trimesh.load(file, process=False).to_geometry() for file in files]
    assert np.array_equal(np.concatenate([one.triangles for one in found]), expected.triangles)
    colors = [linear_colors(file) for file in (*files, tmp_path / "whole.glb")]
    assert np.array_equal(np.concatenate(colors[:-1]), colors[-1])


@pytest.mark.parametrize("min_extent", [0.0, 0.2, 0.3, 0.6, 9.0])
def test_parts_have_the_islands_of_the_whole_mesh(tmp_path: Path, volume: Volume, min_extent: float) -> None:
    """Pieces of 0.28 m and less beside the ball, across tiles' borders."""
    for x, radius in ((0.9, 0.1), (-0.8, 0.05)):
        for view in sphere_views(radius, 6):
            T = view.T_world_camera.copy()
            T[:3, 3] += (x, 0.05, 0.02)
            volume.integrate(replace(view, T_world_camera=T))
    whole = replace(volume.extract_mesh(), provenance=volume.provenance("map.tsf"))
    tidy = whole.without_islands(min_extent)
    parts = volume.mesh_parts(tmp_path)
    parts.provenance = whole.provenance
    found = parts.without_islands(min_extent)
    assert found.left_out == whole.count_islands(whole.islands(min_extent))
    assert (found.vertices, found.faces) == (len(tidy.vertices), len(tidy.faces))
    if found.faces:
        (file,) = found.save(tmp_path / "parts.ply")
        assert file.read_bytes() == tidy.save(tmp_path / "whole.ply").read_bytes()
    else:
        assert min_extent == 9.0


def test_what_cannot_be_written_is_named(
    tmp_path: Path, volume: Volume, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = volume.mesh_parts(tmp_path, up=up_direction.parse("z"))
    with pytest.raises(OutputError, match=r"is saved as .ply or .glb, got 'mesh.obj'"):
        parts.save(tmp_path / "mesh.obj")
    with pytest.raises(OutputError, match=r"cannot write .*mesh.ply: No such file"):
        parts.save(tmp_path / "none" / "mesh.ply")
    with pytest.raises(OutputError, match="no triangles"):
        Volume(0.02, threads=2).mesh_parts(tmp_path).save(tmp_path / "mesh.ply")
    with pytest.raises(OutputError, match="no triangles"):
        volume_of(tilted_plane()[1]).mesh_parts(tmp_path, min_weight=1000).save(tmp_path / "mesh.ply")
    monkeypatch.setattr(tempfile, "TemporaryFile", refuse(errno.ENOSPC))
    with pytest.raises(OutputError, match=r"cannot write the mesh to .*: No space left"):
        volume.mesh_parts(tmp_path)
    assert list(tmp_path.iterdir()) == []
