# SPDX-License-Identifier: MIT
"""The error of points against meshes, points, worlds and runs; what is no truth is named."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.worlds.synthetic import WORLDS
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import Up
from tsfusion.pipelines.report.measured_errors import error_measure

POINTS = np.array([[0.2, 0.3, 0.01], [0.2, 0.3, -0.02]], np.float32)


def square() -> Mesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), normals)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_a_mesh_of_every_kind(suffix: str, tmp_path: Path) -> None:
    measure = error_measure(square().save(tmp_path / f"truth{suffix}"))
    found = measure(POINTS)
    assert (found.shape, found.dtype) == ((2,), np.float32)
    assert np.allclose(found, [0.01, 0.02], atol=1e-6)


def test_points_alone(tmp_path: Path) -> None:
    trimesh.PointCloud(square().vertices).export(tmp_path / "cloud.ply")
    measure = error_measure(tmp_path / "cloud.ply")
    assert np.allclose(measure(POINTS), np.linalg.norm(POINTS, axis=1), atol=1e-6)


def test_a_world_and_a_run_in_it(tmp_path: Path) -> None:
    mesh = square()
    truth = np.abs(WORLDS["room"](40).distance(mesh.vertices.astype(np.float64)))
    assert np.allclose(error_measure("synthetic:room")(mesh.vertices), truth, atol=1e-6)
    mesh.save(tmp_path / "mesh.ply")
    (tmp_path / "run.json").write_text(
        json.dumps(
            {"dataset": "synthetic room", "keyframes_sent": 2, "config": {"volume": {"voxel_size": 0.02}}}
        )
    )
    np.save(tmp_path / "error.npy", truth.astype(np.float32))
    world = WORLDS["room"](1).distance(POINTS.astype(np.float64))
    assert np.allclose(error_measure(tmp_path)(POINTS), np.abs(world), atol=1e-6)
    # another world than that of today: what the run wrote down counts, near its vertices
    np.save(tmp_path / "error.npy", np.float32([0.1, 0.2, 0.3, 0.4]))
    near = mesh.vertices + np.float32([0, 0, 0.03])
    assert np.allclose(error_measure(tmp_path)(near), [0.1, 0.2, 0.3, 0.4])
    assert np.isnan(error_measure(tmp_path)(POINTS)).all()


def test_a_glb_whose_node_turns_it_is_a_truth_in_the_maps_frame(tmp_path: Path) -> None:
    turned = dataclasses.replace(square(), known_up=Up((0.0, 0.0, 1.0), "given"))
    expected = error_measure(square().save(tmp_path / "m.ply"))(POINTS)
    assert np.allclose(error_measure(turned.save(tmp_path / "m.glb"))(POINTS), expected, atol=1e-6)


def test_what_is_no_truth_is_named(tmp_path: Path) -> None:
    scene = trimesh.Scene(square().to_trimesh())
    for shape in scene.geometry.values():  # as files were written before nodes turned them
        shape.metadata["up"] = "map's +z (given: 0.0000 0.0000 1.0000), here +y"
    scene.export(str(tmp_path / "turned.glb"))
    (tmp_path / "torn.ply").write_bytes(square().encode(".ply")[:200])
    (tmp_path / "empty.ply").write_bytes(b"")
    for truth, message in (
        (tmp_path / "turned.glb", "give the .ply instead"),
        (tmp_path / "torn.ply", "cannot read|no points"),
        (tmp_path / "empty.ply", "cannot read|no points"),
        (tmp_path / "absent.ply", "cannot read"),
        (tmp_path / "photo.jpg", "a truth is a mesh or points"),
        (tmp_path, "no error that was measured"),
        ("synthetic:moon", "one of room"),
    ):
        with pytest.raises(DatasetError, match=message):
            error_measure(truth)
