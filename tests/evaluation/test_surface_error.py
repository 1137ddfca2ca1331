# SPDX-License-Identifier: MIT
"""The measures of a surface, on surfaces whose error is known beforehand."""

import numpy as np
import pytest
import trimesh

from tsfusion import Intrinsics, Keyframe, Mesh
from tsfusion.datasets import Synthetic
from tsfusion.datasets.synthetic import benchmark_worlds, worlds
from tsfusion.evaluation import surface_error
from tsfusion.evaluation.known_surfaces import ReferenceSurface, WorldSurface, edges_of, measure
from tsfusion.evaluation.view_prediction import compare_views, depth_metres, points_world, predicted_depth

VOXEL = 0.02
CAMERA = Intrinsics(200.0, 200.0, 79.5, 59.5)
SHAPE = (120, 160)


def as_mesh(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(
        shape.vertices.astype(np.float32), shape.faces.astype(np.int32),
        shape.vertex_normals.astype(np.float32),
    )  # fmt: skip


def ball(radius: float) -> worlds.World:
    return worlds.World("ball", np.array([worlds.solid(worlds.SPHERE, (0, 0, 0), (radius,) * 3, 0)]), {})


def wall(z: float, half: float = 5.0) -> Mesh:
    """A square that faces the origin from `z` metres along the optical axis."""
    corners = np.array([(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)], np.float32)
    faces = np.array([(0, 2, 1), (0, 3, 2)], np.int32)
    return Mesh(corners, faces, np.tile(np.float32((0, 0, -1)), (4, 1)))


# --- metrics


def test_spread_of_known_errors() -> None:
    spread = surface_error.spread_mm(np.array([-0.003, 0.001, 0.001, 0.003]))
    assert (spread.mean, spread.rmse) == pytest.approx((2.0, 5**0.5))
    assert surface_error.spread_mm(np.linspace(0, 0.1, 101)).p95 == pytest.approx(95.0)
    assert np.isnan(surface_error.spread_mm(np.empty(0)).mean)


def test_shares_and_their_harmonic_mean() -> None:
    assert surface_error.percent_within(np.array([-0.02, 0.01, 0.03, 0.05]), 0.02) == 50.0
    assert surface_error.f_score(50.0, 100.0) == pytest.approx(200 / 3)
    assert surface_error.f_score(0.0, 0.0) == 0.0


def test_angles_between_directions_of_any_length() -> None:
    a = np.array([(1, 0, 0), (0, 2, 0), (1, 0, 0), (1, 0, 0), (0, 0, 0)], np.float64)
    b = np.array([(3, 0, 0), (1, 1, 0), (0, 0, 1), (-1, 0, 0), (1, 0, 0)], np.float64)
    assert surface_error.angles(a, b) == pytest.approx([0, 45, 90, 180, 90])
    tiny = np.array([(1, 1e-7, 0)])
    assert surface_error.angles(tiny, np.array([(1.0, 0, 0)])) == pytest.approx(np.degrees(1e-7))


def test_distance_from_segments_ends_included() -> None:
    segments = np.array([[(0, 0, 0), (1, 0, 0)], [(0, 5, 0), (0, 5, 0)]], np.float64)
    points = np.array([(0.5, 0.3, 0.4), (2, 0, 0), (-3, 4, 0), (0, 5, 1)], np.float64)
    assert surface_error.segment_distance(points, segments) == pytest.approx([0.5, 1, np.hypot(3, 1), 1])
    assert np.isinf(surface_error.segment_distance(points, segments[:0])).all()


def test_distance_from_segments_by_the_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    points, segments = rng.normal(size=(57, 3)), rng.normal(size=(9, 2, 3))
    whole = surface_error.segment_distance(points, segments)
    monkeypatch.setattr(surface_error, "_CHUNK", 40)
    assert (surface_error.segment_distance(points, segments) == whole).all()


def test_one_point_a_cell_whatever_the_sign() -> None:
    points = np.array([(0.01, 0, 0), (0.02, 0, 0), (-0.01, 0, 0), (0.01, 0, 0), (0.01, 0, -7.0)])
    assert (surface_error.one_per_cell(points, 0.1) == points[[0, 2, 4]]).all()
    assert (surface_error.one_per_cell(points, 0.1, at_least=2) == points[[0]]).all()
    assert surface_error.one_per_cell(points[:0], 0.1).shape == (0, 3)


# --- truth


@pytest.mark.parametrize("offset", [0.004, -0.004])
def test_a_sphere_too_large_or_too_small_is_off_by_just_that(offset: float) -> None:
    shape = trimesh.creation.icosphere(5, 0.5 + offset)
    truth = WorldSurface(ball(0.5), trimesh.creation.icosphere(5, 0.5).vertices)
    found = measure(as_mesh(shape), truth, VOXEL)
    assert found["accuracy_mm"] == pytest.approx({"mean": 4, "rmse": 4, "p95": 4}, abs=1e-3)
    assert (found["precision"], found["completeness"], found["f_score"]) == (100, 100, 100)
    assert found["normal_deg"]["mean"] < 0.1
    assert found["edge_mm"] is None


def test_half_a_surface_is_half_complete_and_fully_precise() -> None:
    shape = trimesh.creation.icosphere(6, 0.5)
    truth = WorldSurface(ball(0.5), shape.vertices)
    shape.update_vertices(shape.vertices[:, 2] >= 0)
    found = measure(as_mesh(shape), truth, VOXEL)
    assert found["precision"] == 100
    assert found["completeness"] == pytest.approx(50 + 1.5 * VOXEL * 50 / 0.5, abs=1)  # the rim's reach
    share = found["completeness"] / 100
    assert found["f_score"] == pytest.approx(200 * share / (1 + share), abs=0.01)


def test_a_normal_tilted_by_ten_degrees_is_ten_degrees_off() -> None:
    world = worlds.World("floor", np.array([worlds.solid(worlds.GROUND, (0, 0, 0), (0, 0, 0), 0)]), {})
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * (1, 1, 0)
    tilted = np.tile((np.sin(np.radians(10)), 0, np.cos(np.radians(10))), (50, 1))
    mesh = Mesh(points.astype(np.float32), np.zeros((0, 3), np.int32), tilted.astype(np.float32))
    assert measure(mesh, WorldSurface(world, points), VOXEL)["normal_deg"] == pytest.approx(
        {"median": 10, "mean": 10}, abs=1e-3
    )


def test_edge_error_counts_what_is_near_an_edge() -> None:
    box = worlds.solid(worlds.BOX, (1, 2, 3), (0.5, 0.4, 0.3), 0, yaw=0.7)
    world = worlds.World("box", np.array([box]), {})
    edges = edges_of(world)
    assert edges.shape == (12, 2, 3)
    assert np.abs(world.distance(edges.reshape(-1, 3))).max() < 1e-12
    lengths = np.sort(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1))
    assert lengths == pytest.approx([0.6] * 4 + [0.8] * 4 + [1.0] * 4)
    top = np.array([(1, 2, 3.3), (1, 2, 3.31)])  # far from every edge
    corner = edges[0, 0] + np.sign(edges[0, 0] - (1, 2, 3)) * (0, 0, 0.006)  # 6 mm above or below it
    points = np.vstack([top, corner]).astype(np.float32)
    mesh = Mesh(points, np.zeros((0, 3), np.int32), np.tile(np.float32((0, 0, 1)), (3, 1)))
    assert measure(mesh, WorldSurface(world, top), VOXEL)["edge_mm"] == pytest.approx(6, abs=0.01)


def test_edges_inside_another_solid_are_none() -> None:
    """A box sunk in the floor to its middle: four edges above, four uprights that are half buried."""
    rows = [
        worlds.solid(worlds.GROUND, (0, 0, 0), (0, 0, 0), 0),
        worlds.solid(worlds.BOX, (0, 0, -0.1), (0.5, 0.5, 0.5), 0),
    ]
    edges = edges_of(worlds.World("sunk", np.array(rows), {}))
    assert len(edges) == 4
    assert (edges[..., 2] == 0.4).all()


def test_an_empty_mesh_is_measured_too() -> None:
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    found = measure(nothing, WorldSurface(ball(0.5), trimesh.creation.icosphere(3, 0.5).vertices), VOXEL)
    assert found["vertices"] == found["completeness"] == 0
    assert found["accuracy_mm"]["mean"] is None
    assert found["f_score"] is None


def test_a_reference_mesh_measures_to_its_triangles() -> None:
    cube = trimesh.creation.box((2, 2, 2))
    truth = ReferenceSurface(cube.vertices, cube.faces, np.array([(0, 0, 1.0)]), reach=0.2, samples=20_000)
    points = np.array([(0.3, 0.1, 1.25), (0, -0.8, 0.1), (1.3, 1.4, 0.0)])
    assert truth.distance(points) == pytest.approx([0.25, 0.2, 0.5], abs=1e-6)
    assert truth.normals(points)[:2] == pytest.approx(np.array([(0, 0, 1), (0, -1, 0)]), abs=1e-6)
    assert np.linalg.norm(truth.seen - (0, 0, 1), axis=1).max() <= 0.2


@pytest.mark.parametrize(
    "world",
    [worlds.street(30.0), benchmark_worlds.room(), benchmark_worlds.corners(), benchmark_worlds.thin()],
)
def test_column_by_column_is_as_all_at_once(world: worlds.World) -> None:
    points = np.random.default_rng(1).uniform((-8, -8, -0.5), (25, 8, 6), (4000, 3))
    truth = WorldSurface(world, points[:1], edges=False)
    assert (truth.distance(points) == world.distance(points)).all()


def test_seen_points_are_moved_onto_the_surface() -> None:
    rough = trimesh.creation.icosphere(3, 0.512).vertices
    assert np.linalg.norm(WorldSurface(ball(0.5), rough).seen, axis=1) == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize(("world", "path"), [
    (benchmark_worlds.corners(), "around"), (benchmark_worlds.thin(), "around"),
    (benchmark_worlds.room(), "wander"),
    (benchmark_worlds.room(), "still"),
])  # fmt: skip
def test_made_worlds_are_seen_where_they_are(world: worlds.World, path: str) -> None:
    views = Synthetic(world, "kinect", count=6, noise=False, color=False, width=64, path=path)
    for index in range(6):
        eye = views.pose(index)[:3, 3]
        assert world.distance(eye[None])[0] > 0.15  # in the open
        assert np.abs(world.distance(points_world(views[index]))).max() < 1e-3
    assert (views.pose(0) == views.pose(5)).all() == (path == "still")


# --- predict


def test_depth_in_metres_of_every_kind() -> None:
    pose = {"T_world_camera": np.eye(4), "intrinsics": CAMERA}
    raw = np.array([[0, 1500]], np.uint16)
    assert (depth_metres(Keyframe(depth=raw, depth_scale=0.002, **pose)) == [[0, 3.0]]).all()
    rough = np.array([[np.nan, -1, np.inf, 2.5]], np.float32)
    assert (depth_metres(Keyframe(depth=rough, **pose)) == [[0, 0, 0, 2.5]]).all()
    disparity = Keyframe(disparity=np.array([[0, 160]], np.uint16), baseline_fx=35.0, **pose)
    assert (depth_metres(disparity) == [[0, 3.5]]).all()


def test_points_in_the_world() -> None:
    T = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    depth = np.zeros(SHAPE, np.float32)
    depth[59, 99] = 2.0  # x = 0.195, y = -0.005
    found = points_world(Keyframe(depth=depth, intrinsics=CAMERA, T_world_camera=T))
    assert found == pytest.approx(np.array([(5.005, 6.195, 9.0)]))
    points = Keyframe(points=np.array([(1, 2, 3)], np.float32), T_world_camera=T)
    assert points_world(points) == pytest.approx(np.array([(3.0, 7.0, 10.0)]))


@pytest.mark.parametrize(
    "camera",
    [CAMERA, Intrinsics(200.0, 210.0, 60.25, 80.75), Intrinsics(200.0, -190.0, 90.0, 40.0)],
)
def test_the_depth_of_a_tilted_plane_through_any_pinhole(camera: Intrinsics) -> None:
    """z = 2 + 0.3 x - 0.2 y, met by a ray in closed form."""
    mesh = wall(0.0)
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    tilted = Mesh(np.stack([x, y, 2 + 0.3 * x - 0.2 * y], axis=1), mesh.faces, mesh.normals)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    across, down = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    expected = 2 / (1 - 0.3 * across + 0.2 * down)
    assert predicted_depth(tilted, np.eye(4), camera, SHAPE) == pytest.approx(expected, rel=1e-5)


def test_what_is_behind_or_turned_away_is_not_predicted() -> None:
    assert not predicted_depth(wall(-2.0), np.eye(4), CAMERA, SHAPE).any()
    turned = Mesh(wall(2.0).vertices, wall(2.0).faces[:, ::-1].copy(), wall(2.0).normals)
    assert not predicted_depth(turned, np.eye(4), CAMERA, SHAPE).any()


def test_a_wall_a_centimetre_off_is_predicted_a_centimetre_off() -> None:
    depth = np.full(SHAPE, 2.01, np.float32)
    depth[:30] = 0.0  # not measured: not asked for
    depth[90:] = 2.5  # measured half a metre behind
    view = Keyframe(depth=depth, intrinsics=CAMERA, T_world_camera=np.eye(4))
    found = compare_views(wall(2.0), [view], max_range=4.0, voxel_size=VOXEL)
    assert found["median_mm"] == pytest.approx(10, abs=0.01)
    assert found["p90_mm"] == found["all_p90_mm"] == pytest.approx(500, abs=0.01)
    assert (found["within_voxel"], found["predicted"]) == pytest.approx((200 / 3, 100))
    narrow = compare_views(wall(2.0, half=0.2), [view], max_range=2.4, voxel_size=VOXEL)
    assert narrow["all_p90_mm"] == np.inf
    assert narrow["median_mm"] == pytest.approx(10, abs=0.01)
    assert narrow["predicted"] == pytest.approx(100 * 40 * 40 / (60 * 160), abs=0.5)
