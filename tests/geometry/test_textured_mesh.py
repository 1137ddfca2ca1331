# SPDX-License-Identifier: MIT
"""Meshes with a texture: their charts, their files, and what is left of them without islands."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tsfusion.core.errors import OutputError
from tsfusion.geometry import texture_charts
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.textured_mesh import Texture, TexturedMesh
from tsfusion.geometry.up_direction import Up


def two_squares(pages: int = 2) -> TexturedMesh:
    """Two squares side by side that share an edge, each with a picture of its own."""
    vertices = np.array([(x, y, 0) for y in (0, 1) for x in (0, 1, 2)], np.float32)
    faces = np.array([(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4)], np.int32)
    u = [[(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]] * 2
    random = np.random.default_rng(0)
    pictures = [random.integers(0, 256, (8, 16 + 8 * page, 3), np.uint8) for page in range(pages)]
    return TexturedMesh(
        vertices,
        faces,
        np.tile(np.array((0, 0, 1), np.float32), (6, 1)),
        random.integers(0, 256, (6, 3), np.uint8),
        known_up=Up((0.0, 0.0, 1.0), "given"),
        texture=Texture(np.array(u, np.float32), np.array([0, 0, 1, 1], np.int32), pictures),
    )


def picture_of(mesh: trimesh.Trimesh) -> np.ndarray:
    material = mesh.visual.material
    return np.asarray(getattr(material, "baseColorTexture", None) or material.image)[..., :3]


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_another_library_reads_what_was_saved(suffix: str, tmp_path: Path) -> None:
    mesh = two_squares()
    mesh.save(tmp_path / f"room{suffix}")
    scene = trimesh.load(tmp_path / f"room{suffix}", force="scene", process=False)
    found = sorted(scene.geometry.values(), key=lambda read: picture_of(read).shape)
    assert len(found) == 2
    for page, read in enumerate(found):
        np.testing.assert_array_equal(picture_of(read), mesh.texture.pages[page])
        chosen = mesh.texture.page == page
        corners = mesh.vertices[mesh.faces[chosen]]
        np.testing.assert_allclose(read.vertices[read.faces], corners, atol=1e-6)
        uv = mesh.texture.corners[chosen] * (1, -1) + (0, 1)  # trimesh counts v from below
        np.testing.assert_allclose(read.visual.uv[read.faces], uv, atol=1e-6)


def test_obj_names_its_pictures_after_itself(tmp_path: Path) -> None:
    two_squares().save(tmp_path / "room.obj")
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"room.obj", "room.mtl", "room-0.png", "room-1.png"}
    lines = (tmp_path / "room.mtl").read_text().splitlines()
    for kind, light in (
        ("Kd", 1.0),
        ("Ka", 1.0),
        ("Ks", 0.0),
    ):  # times the picture: as bright as it is, no shine
        found = [[float(word) for word in line.split()[1:]] for line in lines if line.startswith(kind)]
        assert found == [[light] * 3] * 2


def test_ply_has_the_colours_at_the_vertices(tmp_path: Path) -> None:
    mesh = two_squares()
    read = trimesh.load(mesh.save(tmp_path / "room.ply"), process=False)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], mesh.colors)


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        two_squares().save(tmp_path / "missing" / "room.glb")
    assert not list(tmp_path.iterdir())


def cube(size: int = 6) -> Mesh:
    """A cube of small triangles."""
    made = trimesh.creation.box().subdivide_to_size(1 / size)
    return Mesh(
        np.asarray(made.vertices, np.float32),
        np.asarray(made.faces, np.int32),
        np.asarray(made.vertex_normals, np.float32),
    )


def test_each_side_of_a_cube_is_a_chart_that_keeps_its_size() -> None:
    mesh = cube()
    charts = texture_charts.find(mesh.vertices, mesh.faces, mesh.normals)
    assert len(np.unique(charts.number)) == 6
    a, b, c = (charts.corners[:, k] for k in range(3))
    flat = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert flat.sum() == pytest.approx(6, rel=1e-3)


def test_charts_lie_apart_on_their_pages() -> None:
    mesh = cube()
    charts = texture_charts.find(mesh.vertices, mesh.faces, mesh.normals)
    for side, several in ((4096, False), (300, True)):
        layout = texture_charts.pack(charts, mesh.faces, texel=0.005, side=side)  # 200 texels a side
        assert (len(layout.sizes) > 1) is several
        assert max(max(size) for size in layout.sizes) <= side
        boxes = []
        for number in range(6):
            of_chart = charts.number == number
            assert len(set(layout.page[of_chart])) == 1
            corners = layout.corners[of_chart].reshape(-1, 2)
            boxes.append((layout.page[of_chart][0], corners.min(axis=0), corners.max(axis=0)))
        for i, (page, low, high) in enumerate(boxes):
            for other, other_low, other_high in boxes[:i]:
                gap = np.maximum(other_low - high, low - other_high).max()
                assert page != other or gap >= 2 * texture_charts.GUARD - 1


def test_what_lies_below_another_face_gets_a_chart_of_its_own() -> None:
    mesh = cube(2)
    charts = texture_charts.find(mesh.vertices, mesh.faces, mesh.normals)
    covered = np.zeros(len(mesh.faces), bool)
    covered[:3] = True
    parted = texture_charts.split(charts, mesh.faces, len(mesh.vertices), covered)
    assert not set(parted.number[covered]) & set(parted.number[~covered])


def test_triangles_without_area_shrink_to_a_corner() -> None:
    mesh = cube(2)
    faces = np.concatenate([mesh.faces, [[mesh.faces[0, 0], mesh.faces[0, 1], mesh.faces[0, 1]]]])
    charts = texture_charts.find(mesh.vertices, faces.astype(np.int32), mesh.normals)
    layout = texture_charts.pack(charts, faces, texel=0.01, side=1024)
    assert np.ptp(layout.corners[-1], axis=0).max() <= 60  # of a face's edge, not across the page
