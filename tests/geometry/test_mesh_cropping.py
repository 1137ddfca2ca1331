# SPDX-License-Identifier: MIT
"""A mesh cut to a box ends at its sides, exactly, and keeps its surface, colours and frame."""

from dataclasses import replace

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of

from tsfusion import Mesh
from tsfusion.core.errors import InvalidConfig

BOX = (-0.113, -0.5, -0.077, 0.151, 0.093, 0.5)


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    """A mesh whose colour is its place, so that colours can be checked anywhere."""
    mesh = volume_of(sphere_views(0.2, 6)).extract_mesh()
    colors = np.round((mesh.vertices + 0.3) * 400).astype(np.uint8)
    return replace(mesh, colors=colors, guessed=mesh.vertices[mesh.faces[:, 0], 0] > 0)


def test_what_is_left_lies_in_the_box_and_reaches_its_sides(sphere: Mesh) -> None:
    part = sphere.cropped(BOX)
    low, high = np.float32(BOX[:3]), np.float32(BOX[3:])
    assert ((part.vertices >= low) & (part.vertices <= high)).all()
    for side in (low[0], low[2], high[0], high[1]):
        assert (part.vertices == side).any()
    assert len(np.unique(part.faces)) == len(part.vertices)
    assert np.linalg.norm(part.normals, axis=1) == pytest.approx(1, abs=1e-5)
    assert part.colors / 400 - 0.3 == pytest.approx(part.vertices, abs=0.004)
    assert part.up == sphere.up


def test_parts_of_boxes_side_by_side_are_the_whole(sphere: Mesh) -> None:
    halves = [sphere.cropped((a, -1, -1, b, 1, 1)) for a, b in ((-1, 0.0123), (0.0123, 1))]
    assert sum(map(area, halves)) == pytest.approx(area(sphere), rel=1e-6)
    for half in halves:
        corners = half.vertices[half.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert ((across * half.normals[half.faces].sum(axis=1)).sum(axis=1) >= -1e-9).all()  # not turned
    cuts = [half.vertices[half.vertices[:, 0] == np.float32(0.0123)] for half in halves]
    assert (np.unique(cuts[0], axis=0) == np.unique(cuts[1], axis=0)).all()
    assert len(np.unique(cuts[0], axis=0)) == len(cuts[0])  # neighbours share them


def test_corners_on_a_side_are_no_triangles(sphere: Mesh) -> None:
    """The plane z = 0.05 goes through voxel centres, and so through vertices."""
    side = sphere.vertices[np.abs(sphere.vertices[:, 2] - 0.05) < 1e-6, 2][0]
    part = sphere.cropped((-1, -1, -1, 1, 1, float(side)))
    assert (part.faces != part.faces[:, [1, 2, 0]]).all()
    assert len(np.unique(part.vertices, axis=0)) == len(part.vertices)


def test_triangles_stay_guessed_when_they_are_cut(sphere: Mesh) -> None:
    part = sphere.cropped((-1, -1, -1, 1, 1, 0.05))
    assert part.guessed is not None
    middle = part.vertices[part.faces].mean(axis=1)
    assert part.guessed[middle[:, 0] > 0.03].all()
    assert not part.guessed[middle[:, 0] < -0.03].any()


def test_a_box_around_everything_changes_nothing_and_one_elsewhere_leaves_nothing(sphere: Mesh) -> None:
    assert (sphere.cropped((-1, -1, -1, 1, 1, 1)).faces == sphere.faces).all()
    assert sphere.cropped((5, 5, 5, 6, 6, 6)).faces.shape == (0, 3)


@pytest.mark.parametrize("box", [(0, 0, 0, 1, 1), (0, 0, 0, 1, 0, 1), (0, 0, 0, 1, 1, np.nan)])
def test_a_box_that_is_none_is_refused(sphere: Mesh, box: tuple[float, ...]) -> None:
    with pytest.raises(InvalidConfig, match="a box is x0 y0 z0 x1 y1 z1"):
        sphere.cropped(box)
