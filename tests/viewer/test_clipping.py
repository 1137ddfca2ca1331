# SPDX-License-Identifier: MIT
"""Parts of a mesh that a plane and a box leave, exactly."""

import numpy as np
from formula_scenes import sphere_views, volume_of

from tsfusion.viewer.map.clipping import Clipping

SLANTED = np.array((0.6, 0.0, 0.8))


def area(mesh) -> float:  # type: ignore[no-untyped-def]
    a, b, c = mesh.vertices[mesh.faces].astype(float).transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_a_plane_and_its_other_side_make_the_whole() -> None:
    mesh = volume_of(sphere_views(0.3)[:8]).extract_mesh()
    below, above = Clipping(SLANTED, 0.05).cut(mesh), Clipping(-SLANTED, -0.05).cut(mesh)
    assert (below.vertices @ SLANTED).max() <= 0.05 + 1e-6
    assert (above.vertices @ SLANTED).min() >= 0.05 - 1e-6
    assert abs(area(below) + area(above) - area(mesh)) < 1e-5 * area(mesh)
    assert Clipping(SLANTED, 0.05).shows(below.vertices.astype(float) - 1e-5 * SLANTED).all()


def test_a_box_and_a_plane_together() -> None:
    mesh = volume_of(sphere_views(0.3)[:8]).extract_mesh()
    box = np.array(((-0.2, -0.2, -1.0), (0.2, 0.2, 1.0)))
    cut = Clipping(np.array((0, 0, 1.0)), 0.1, box).cut(mesh)
    assert len(cut.faces)
    assert cut.vertices[:, 2].max() <= 0.1 + 1e-6
    assert (cut.vertices >= box[0] - 1e-6).all()
    assert (cut.vertices <= box[1] + 1e-6).all()


def test_sides_of_tiles_are_those_of_their_points() -> None:
    random = np.random.default_rng(0)
    sides = set()
    for _ in range(300):
        bounds = np.sort(random.uniform(-1, 1, (2, 3)), axis=0).astype(np.float32)
        normal = random.normal(size=3)
        box = np.sort(random.uniform(-1.5, 1.5, (2, 3)), axis=0)
        clipping = Clipping(normal / np.linalg.norm(normal), random.uniform(-1, 1), box)
        corners = np.array(np.meshgrid(*bounds.T.astype(float))).reshape(3, -1).T
        points = np.concatenate((corners, random.uniform(*bounds.astype(float), (400, 3))))
        shown, side = clipping.shows(points), clipping.side(bounds)
        sides.add(side)
        assert side != "hidden" or not shown.any()
        assert side != "whole" or shown.all()
        assert side == "whole" or not shown.all(), "what is whole is not cut"
    assert sides == {"hidden", "part", "whole"}
