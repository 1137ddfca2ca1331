# SPDX-License-Identifier: MIT
"""Islands are left out of GLB and pictures and kept in PLY and OBJ, unless a person says otherwise."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines.maps import mesh_finishing


@pytest.fixture(scope="module")
def scattered() -> Mesh:
    """A ball, and two crumbs far from it."""
    ball = trimesh.creation.icosphere(3)
    crumbs = [trimesh.creation.box((0.1,) * 3, trimesh.transformations.translation_matrix((x, 0, 0)))
              for x in (-9, 9)]  # fmt: skip
    shape = trimesh.util.concatenate([ball, *crumbs])
    vertices, normals = shape.vertices.astype(np.float32), shape.vertex_normals.astype(np.float32)
    return Mesh(vertices, shape.faces.astype(np.int32), normals)


@pytest.mark.parametrize(
    ("keep", "without"),
    [(None, ["m.glb", "m.png"]), (True, []), (False, ["m.ply", "m.obj", "m.glb", "m.png"])],
)
def test_which_files_have_islands(
    scattered: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: bool | None, without: list[str]
) -> None:
    drawn: list[Mesh] = []
    monkeypatch.setattr("tsfusion.pipelines.maps.mesh_preview.render", lambda mesh, _file: drawn.append(mesh))
    files = [tmp_path / f"m{suffix}" for suffix in (".ply", ".obj", ".glb", ".png")]
    left_out = mesh_finishing.write(scattered, files, keep_islands=keep)
    assert left_out["files"] == without
    assert (left_out["islands"], left_out["triangles"]) == ((2, 24) if without else (0, 0))
    surfaces = {file.name: trimesh.load(file, force="mesh", process=False).vertices for file in files[:3]}
    for name, vertices in {**surfaces, "m.png": drawn[0].vertices}.items():
        assert vertices.max() == pytest.approx(1.0 if name in without else 9.05, abs=0.01)


def test_a_mesh_without_islands_says_nothing(scattered: Mesh, tmp_path: Path) -> None:
    left_out = mesh_finishing.write(scattered.without_islands(), [tmp_path / "m.glb"])
    assert left_out == {"islands": 0, "triangles": 0, "files": []}
