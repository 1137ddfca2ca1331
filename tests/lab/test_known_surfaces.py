# SPDX-License-Identifier: MIT
"""Meshes measured against surfaces that are known."""

import numpy as np
import pytest
import trimesh

from lab.evaluation.known_surfaces import ReferenceSurface, WorldSurface, edges_of, measure
from lab.worlds import benchmark_worlds
from tsfusion import Mesh
from tsfusion.datasets import Synthetic
from tsfusion.datasets.worlds import worlds
from tsfusion.geometry.keyframe import points_world

VOXEL = 0.02


def as_mesh(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(
        shape.vertices.astype(np.float32), shape.faces.astype(np.int32),
        shape.vertex_normals.astype(np.float32),
    )  # fmt: skip


def ball(radius: float) -> worlds.World:
    return worlds.World("ball", np.array([worlds.solid(worlds.SPHERE, (0, 0, 0), (radius,) * 3, 0)]), {})


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
    floor = worlds.solid(worlds.GROUND, (0, 0, 0), (0, 0, 0), 0)
    box = worlds.solid(worlds.BOX, (0, 0, -0.1), (0.5, 0.5, 0.5), 0)
    edges = edges_of(worlds.World("sunk", np.array([floor, box]), {}))
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
