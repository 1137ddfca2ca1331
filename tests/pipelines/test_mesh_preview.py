# SPDX-License-Identifier: MIT
"""The picture: right pixels, right depth, the same bytes every time."""

import dataclasses
import math

import cv2
import kernel_twins
import numpy as np
import pytest
import trimesh

from tsfusion.core.errors import OutputError
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.textured_mesh import Texture, TexturedMesh
from tsfusion.geometry.up_direction import Up, parse
from tsfusion.kernels.answers import rasterizer
from tsfusion.pipelines.maps import mesh_preview
from tsfusion.pipelines.maps.mesh_preview import PreviewCamera, choose_camera, draw


def from_trimesh(shape: trimesh.Trimesh, colors: np.ndarray | None = None) -> Mesh:
    """A Mesh with flat normals, one vertex a corner."""
    vertices = shape.triangles.reshape(-1, 3).astype(np.float32)
    normals = np.repeat(shape.face_normals, 3, axis=0).astype(np.float32)
    return Mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), normals, colors)


def box_room(extents: tuple[float, float, float] = (4.0, 4.0, 2.8)) -> Mesh:
    """A room seen from inside: the normals point inwards."""
    shape = trimesh.creation.box(extents)
    shape.apply_translation((0, 0, extents[2] / 2))
    shape.invert()
    return from_trimesh(shape)


def look(eye: tuple[float, float, float], forward: tuple[float, float, float]) -> np.ndarray:
    """T_world_camera at `eye`, looking along the horizontal `forward`, z up."""
    T = np.eye(4)
    T[:3, :3] = np.stack((np.cross(forward, (0, 0, 1)), (0, 0, -1), forward), axis=1)
    T[:3, 3] = eye
    return T


def test_depth_of_a_sphere() -> None:
    sphere = from_trimesh(trimesh.creation.icosphere(5, 1.0))
    T = np.eye(4)
    T[2, 3] = -4.0
    image = draw(sphere, PreviewCamera(T, fov=math.radians(60)), 201, 151)
    assert image[75, 100, 3] == pytest.approx(3.0, abs=2e-3)
    assert (image[0, 0] == (*np.float32(mesh_preview.BACKGROUND), 0)).all()
    # The silhouette of a unit sphere at 4 m: tan of its angular radius is 1/sqrt(15).
    focal = 100.5 / math.tan(math.radians(30))
    seen = np.count_nonzero(image[..., 3])
    assert seen == pytest.approx(math.pi * (focal / math.sqrt(15)) ** 2, rel=0.01)


def test_walls_are_open_from_outside_and_closed_from_inside() -> None:
    room = box_room()
    outside = draw(room, PreviewCamera(look((0, -6, 1.4), (0, 1, 0))), 120, 90)
    assert outside[45, 60, 3] == pytest.approx(8.0, rel=1e-4)  # through the near wall to the far one
    inside = draw(room, PreviewCamera(look((0, -1, 1.4), (0, 1, 0)), fov=math.radians(90)), 120, 90)
    assert (inside[..., 3] > 0).all()
    assert inside[45, 60, 3] == pytest.approx(3.0, rel=1e-4)


def test_backs_are_seen_but_those_of_walls() -> None:
    """A board that turns its back is seen before the sky and, where it is thin, before another surface."""

    def seen(width: float, behind: Mesh) -> np.ndarray:
        """RGB of a red board, 2 m high, with its back to the camera, in the middle of a picture."""
        corners = np.array([(-1, 0), (1, 0), (1, 2), (-1, 2)]) * (width / 2, 1)
        places = np.stack((corners[:, 0], np.full(4, -1.0), corners[:, 1]), axis=1).astype(np.float32)
        mesh = Mesh(
            np.concatenate((places, behind.vertices)),
            np.concatenate((np.array([(0, 2, 1), (0, 3, 2)], np.int32), behind.faces + 4)),
            np.concatenate((np.tile(np.float32((0, 1, 0)), (4, 1)), behind.normals)),
            np.array([(200, 40, 40)] * 4 + [(40, 40, 200)] * len(behind.vertices), np.uint8),
        )
        camera = PreviewCamera(look((0, -6, 1.4), (0, 1, 0)))
        return mesh_preview.picture(mesh, camera, 240, 180, up=np.array((0.0, 0, 1)))[90, 120].astype(int)

    room = box_room()
    far = Mesh(room.vertices, room.faces[(room.vertices[room.faces, 1] > 1.9).all(axis=1)], room.normals)
    sky = Mesh(room.vertices, room.faces[:0], room.normals)
    assert seen(2.0, sky)[0] > seen(2.0, sky)[2] + 50, "before the sky"
    assert seen(0.1, far)[0] > seen(0.1, far)[2] + 50, "a pole"
    assert seen(2.0, far)[2] > seen(2.0, far)[0] + 50, "a wall is open"


@pytest.mark.parametrize("near", [0.05, 0.7, 1.9])
def test_triangles_through_the_near_plane_are_cut(near: float) -> None:
    """Floor and walls reach behind the eye; every pixel whose surface is beyond `near` is still drawn."""
    room = box_room()
    camera = PreviewCamera(look((0.3, -1, 1.4), (0, 1, 0)), fov=math.radians(100), near=near)
    depth = draw(room, camera, 160, 120)[..., 3]
    full = draw(room, PreviewCamera(camera.T_world_camera, camera.fov, near=0.01), 160, 120)[..., 3]
    assert (full > 0).all()
    beyond = full > near * 1.01
    assert np.allclose(depth[beyond], full[beyond], rtol=1e-4)
    assert (depth[full < near * 0.99] == 0).all()


def test_the_nearer_surface_wins() -> None:
    """Two squares; the nearer one is listed second."""
    corners = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)], np.float32)
    vertices = np.concatenate([np.column_stack((corners, np.full(4, z, np.float32))) for z in (3, 2)])
    faces = np.array([(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)], np.int32)
    normals = np.tile(np.array((0, 0, -1), np.float32), (8, 1))
    colors = np.repeat(np.array([(255, 0, 0), (0, 255, 0)], np.uint8), 4, axis=0)
    image = draw(Mesh(vertices, faces, normals, colors), PreviewCamera(np.eye(4)), 61, 41)
    assert image[20, 30, 3] == 2.0
    assert image[20, 30, 0] == 0
    assert image[20, 30, 1] > 0.5


def test_same_bytes_every_time() -> None:
    room = box_room()
    rng = np.random.default_rng(3)
    noisy = Mesh(
        room.vertices + rng.normal(0, 0.3, room.vertices.shape).astype(np.float32), room.faces, room.normals
    )
    camera = PreviewCamera(look((0, -1, 1.4), (0, 1, 0)))
    first = draw(noisy, camera, 160, 120)
    assert all((draw(noisy, camera, 160, 120) == first).all() for _ in range(5))


def test_without_colour_height_is_shown() -> None:
    """From below to above the ramp gets lighter; grey everywhere is no colour either."""
    room = box_room()
    ramp = mesh_preview.height_colors(room.vertices, np.array((0.0, 0.0, 1.0))).astype(int).sum(axis=1)
    low = room.vertices[:, 2] < 1
    assert ramp[low].max() < ramp[~low].min()
    grey = Mesh(room.vertices, room.faces, room.normals, np.full_like(room.vertices, 160, np.uint8))
    camera = choose_camera(room, np.array((0.0, 0.0, 1.0)), aspect=1.6)
    image = draw(room, camera, 80, 50)
    assert (draw(grey, camera, 80, 50) == image).all()
    assert np.ptp(image[..., :3], axis=2).max() > 0.1
    painted = Mesh(room.vertices, room.faces, room.normals, (room.vertices * 20 + 100).astype(np.uint8))
    assert (draw(painted, camera, 80, 50) != image).any()


def test_chosen_camera_looks_into_the_room_from_outside() -> None:
    room = box_room()
    camera = choose_camera(room, np.array((0.0, 0.0, 1.0)), aspect=1.6)
    eye = camera.T_world_camera[:3, 3]
    assert eye[2] > 1.4
    assert np.abs(eye).max() > 2.0
    depth = draw(room, camera, 160, 100)[..., 3]
    assert np.count_nonzero(depth) > 0.35 * depth.size
    assert not depth[0].any()
    assert not depth[:, 0].any()


def test_render_writes_the_whole_file_or_none(tmp_path) -> None:
    path = mesh_preview.render(box_room(), tmp_path / "room.png", width=96, height=60)
    assert cv2.imread(str(path)).shape == (60, 96, 3)
    empty = np.zeros((0, 3), np.float32)
    with pytest.raises(OutputError, match="no triangles"):
        mesh_preview.render(Mesh(empty, np.zeros((0, 3), np.int32), empty), tmp_path / "empty.png")
    with pytest.raises(OutputError, match="cannot write"):
        mesh_preview.render(box_room(), tmp_path / "missing" / "room.png", width=96, height=60)
    assert [entry.name for entry in tmp_path.iterdir()] == ["room.png"]


def test_a_picture_is_held_by_the_mesh_s_up(tmp_path) -> None:
    """A room that lies on its side is drawn as the same room that stands: by where its up is."""
    room = box_room((4.0, 3.0, 2.8))
    up = Up((0.0, -1.0, 0.0), "given")
    back = up.to_y().T @ parse("z").to_y()  # takes +z to that up
    lying = Mesh(
        np.float32(room.vertices @ back.T), room.faces, np.float32(room.normals @ back.T), known_up=up
    )
    pictures = [
        cv2.imread(str(mesh_preview.render(mesh, tmp_path / f"{number}.png", width=96, height=60)))
        for number, mesh in enumerate((room, lying, dataclasses.replace(lying, known_up=None)))
    ]
    stands, lies, unknown = (cv2.resize(each, (12, 8), interpolation=cv2.INTER_AREA) for each in pictures)
    assert np.abs(stands - 1.0 * lies).mean() < 0.5 * np.abs(stands - 1.0 * unknown).mean()


def test_pixels_equal_the_twin_on_a_heap_of_triangles() -> None:
    random = np.random.default_rng(1)
    corners = random.uniform((-3, -2, -0.5), (3, 2, 6), (60, 1, 3)) + random.normal(0, 0.7, (60, 3, 3))
    mesh = from_trimesh(trimesh.Trimesh(corners.reshape(-1, 3), np.arange(180).reshape(-1, 3), process=False))
    camera = PreviewCamera(np.eye(4), fov=math.radians(70))
    image = draw(mesh, camera, 80, 60)
    focal = 0.5 * 80 / math.tan(camera.fov / 2)
    seen, depth = kernel_twins.see(mesh.vertices, mesh.faces, focal, (60, 80), camera.near)
    assert (seen >= 0).mean() > 0.3
    different = np.abs(image[..., 3] - depth) > 1e-3 * np.maximum(depth, 1)
    assert different.mean() < 0.005  # pixels that an edge runs through


def test_a_texture_is_drawn_instead_of_the_colours_at_the_vertices() -> None:
    vertices = np.array([(-1, -1, 2), (1, -1, 2), (1, 1, 2), (-1, 1, 2)], np.float32)
    page = np.zeros((2, 2, 3), np.uint8)
    page[:, 0], page[:, 1] = (255, 0, 0), (0, 0, 255)
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    faces = np.array([(0, 2, 1), (0, 3, 2)], np.int32)
    mesh = TexturedMesh(
        vertices,
        faces,
        np.tile(np.array((0, 0, -1), np.float32), (4, 1)),
        np.full((4, 3), (90, 120, 150), np.uint8) + np.arange(12, dtype=np.uint8).reshape(4, 3),
        texture=Texture(uv[faces], np.zeros(2, np.int32), [page]),
    )
    camera = PreviewCamera(np.eye(4))
    left, right = draw(mesh, camera, 64, 48, texture=True)[24, [20, 43], :3]
    assert left[0] > 0.3 > 10 * left[2]
    assert right[2] > 0.3 > 10 * right[0]
    plain = draw(mesh, camera, 64, 48)[24, 20, :3]
    assert plain[2] > 0.1


def test_corners_are_darker_than_open_walls() -> None:
    """By ambient occlusion: a flat wall keeps its light, its edge loses some; depths stay as they were."""
    room, camera = box_room(), PreviewCamera(look((0, -1, 1.4), (0, 1, 0)), fov=math.radians(90))
    plain = draw(room, camera, 160, 120)
    shaded = plain.copy()
    rasterizer.occlude(shaded, 1, 80.0, 0.5, 4.0)
    with np.errstate(invalid="ignore"):
        kept = shaded[..., 0] / plain[..., 0]
    wall, edge = kept[50:70, 70:90], kept[60, 24:30]  # the far wall; where it meets another, 2 m to the left
    assert (wall == 1).all()
    assert edge.min() < 0.8
    assert (kept <= 1).all()
    assert (shaded[..., 3] == plain[..., 3]).all()


def test_shade_of_a_pixel_equals_the_twin() -> None:
    room, camera = box_room(), PreviewCamera(look((0.4, -1, 1.2), (0, 1, 0)), fov=math.radians(90))
    plain = draw(room, camera, 80, 60)
    shaded = plain.copy()
    rasterizer.occlude(shaded, 1, 40.0, 0.7, 3.0)
    for v, u in ((30, 40), (45, 20), (5, 5), (33, 11), (50, 12)):
        light = kernel_twins.occlusion(plain[..., 3], v, u, 40.0, 0.7, 3.0)
        assert shaded[v, u, :3] == pytest.approx(light * plain[v, u, :3], abs=2e-3)
