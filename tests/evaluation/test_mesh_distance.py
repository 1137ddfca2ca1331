# SPDX-License-Identifier: MIT
"""Distances from triangles of any size, against formulas."""

import sys

import numpy as np
import pytest
import trimesh

from tsfusion.core.errors import MissingDependency
from tsfusion.evaluation import mesh_distance
from tsfusion.evaluation.mesh_distance import MOST_CANDIDATES, SLACK, MeshDistance

HALF = np.array([1.5, 1.0, 0.05])


def from_box(points: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - HALF
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return np.abs(outside + np.minimum(beyond.max(axis=1), 0))


@pytest.mark.parametrize("balls", [100, 50_000])
@pytest.mark.parametrize(("reach", "slack"), [(0.0, 0.0), (0.02, SLACK), (2.0, SLACK)])
def test_a_box_of_twelve_triangles(
    balls: int, reach: float, slack: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_distance, "_BALLS", balls)
    box = trimesh.creation.box(2 * HALF)
    random = np.random.default_rng(0)
    points = trimesh.sample.sample_surface(box, 2000, seed=0)[0] + random.normal(0, 1, (2000, 3)) * reach
    measure, truth = MeshDistance(box.vertices, box.faces), from_box(points)
    found = measure(points)
    assert (found >= truth - 1e-9).all()
    assert (found <= (1 + 1.05 * slack) * truth + 1e-9).all()
    assert np.median(found - truth) < 1e-9


def test_a_sphere_from_its_centre_is_at_most_a_ball_too_far() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    measure = MeshDistance(ball.vertices, ball.faces)
    assert len(ball.faces) > MOST_CANDIDATES
    distance = measure(np.zeros((1, 3)))
    least = np.linalg.norm(ball.triangles_center, axis=1).min()
    assert least - 1e-9 <= distance[0] <= least + measure.radius


def test_slivers_and_points_at_once() -> None:
    vertices = np.array([[0, 0, 0], [10, 0, 0], [10, 1e-4, 0], [5, 0, 3]], float)
    measure = MeshDistance(vertices, np.array([[0, 1, 2], [3, 3, 3]]))
    found = measure(np.array([[4.0, 0, 1], [5, 0, 3], [-3, -4, 0]]))
    assert np.allclose(found, [1, 0, 5], rtol=SLACK, atol=1e-9)
    assert measure(np.zeros((0, 3))).shape == (0,)


def test_without_scipy_the_command_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    with pytest.raises(MissingDependency, match=r"pip install '.\[slam\]'"):
        MeshDistance(np.eye(3), np.array([[0, 1, 2]]))
