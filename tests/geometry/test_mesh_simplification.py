# SPDX-License-Identifier: MIT
"""A simplified mesh has the triangles asked for, the same borders, and the surface and colours nearly."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from formula_scenes import sphere_views, volume_of
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tsfusion import Mesh, MissingDependency
from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.mesh_simplification import border_edges

RADIUS = 0.3


@pytest.fixture(scope="module")
def bowl() -> Mesh:
    """Half a sphere, with colours that grow along x, its farther part guessed."""
    mesh = volume_of(sphere_views(RADIUS, 8)).extract_mesh().cropped((-1, -1, -1, 1, 1, 0.05))
    colors = np.round((mesh.vertices + 0.31) * 400).clip(0, 255).astype(np.uint8)
    return replace(mesh, colors=colors, guessed=mesh.vertices[mesh.faces[:, 0], 1] > 0.1)


def borders(mesh: Mesh, faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """Ends of the border edges, in an order of their own."""
    ends = mesh.vertices[np.sort(border_edges(faces), axis=1)].reshape(-1, 6)
    return np.unique(np.concatenate((ends, ends[:, [3, 4, 5, 0, 1, 2]])), axis=0)


@pytest.mark.parametrize("target", [{"ratio": 0.3}, {"triangles": 2500}, {"max_error": 0.002}])
def test_fewer_triangles_of_the_same_surface(bowl: Mesh, target: dict[str, float]) -> None:
    less = bowl.simplified(**target)
    if "ratio" in target:
        assert len(less.faces) == pytest.approx(0.3 * len(bowl.faces), rel=0.02)
    elif "triangles" in target:
        assert len(less.faces) == pytest.approx(2500, abs=5)
    else:
        assert len(less.faces) < 0.7 * len(bowl.faces)
    corners = less.vertices[less.faces].astype(float)
    middle = np.concatenate((corners.mean(axis=1), less.vertices))
    off_sphere = [np.abs(np.linalg.norm(points, axis=1) - RADIUS).max() for points in (bowl.vertices, middle)]
    assert off_sphere[1] < off_sphere[0] + 0.004
    assert cKDTree(middle).query(bowl.vertices)[0].max() < 0.06  # nothing of it is gone
    assert np.linalg.norm(less.normals, axis=1) == pytest.approx(1, abs=1e-5)
    outward = less.vertices / np.linalg.norm(less.vertices, axis=1, keepdims=True)
    assert (less.normals * outward).sum(axis=1).min() > 0.9
    off = np.abs(less.colors / 400 - 0.31 - less.vertices)
    assert (off.mean(), off.max()) < (0.004, 0.03)
    assert len(np.unique(less.faces)) == len(less.vertices)


def test_borders_stay_also_of_what_is_guessed(bowl: Mesh) -> None:
    less = bowl.simplified(ratio=0.25)
    assert less.guessed is not None
    for which in (np.ones(2, bool), np.array([True, False]), np.array([False, True])):
        some = [mesh.faces[which[mesh.guessed.astype(int)]] for mesh in (bowl, less)]
        assert (borders(less, some[1]) == borders(bowl, some[0])).all()


def test_a_mesh_keeps_the_triangles_that_its_border_needs(bowl: Mesh) -> None:
    least = bowl.simplified(triangles=1)
    assert len(least.faces) >= len(border_edges(bowl.faces))
    assert (borders(least, least.faces) == borders(bowl, bowl.faces)).all()
    assert bowl.simplified(triangles=10**9) is not None
    assert len(bowl.simplified(ratio=1.0).faces) == len(bowl.faces)


def test_a_target_that_is_none_is_refused(bowl: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    for target in ({}, {"ratio": 0.5, "triangles": 9}, {"ratio": 0.0}, {"ratio": 1.5}, {"triangles": 0},
                   {"max_error": -1.0}, {"max_error": np.nan}):  # fmt: skip
        with pytest.raises(InvalidConfig):
            bowl.simplified(**target)
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(MissingDependency, match="pip install fast-simplification"):
        bowl.simplified(ratio=0.5)


@pytest.mark.parametrize("ratio", [0.03, 0.01])
def test_a_surface_that_folds_keeps_two_triangles_an_edge(ratio: float) -> None:
    """A thin ring collapses onto itself: the library alone makes edges of three triangles and more."""
    ring = trimesh.creation.torus(1.0, 0.05)
    less = Mesh(
        ring.vertices.astype(np.float32), ring.faces.astype(np.int32), ring.vertex_normals.astype(np.float32)
    ).simplified(ratio=ratio)
    edges = np.sort(less.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    assert len(np.unique(np.sort(less.faces, axis=1), axis=0)) == len(less.faces) > 0
    assert len(np.unique(less.faces)) == len(less.vertices) == len(less.normals)
