# SPDX-License-Identifier: MIT
"""Depth predicted by a mesh."""

import numpy as np
import pytest

from lab.evaluation.view_prediction import compare_views, predicted_depth
from tsfusion import Intrinsics, Keyframe, Mesh

VOXEL = 0.02
CAMERA = Intrinsics(200.0, 200.0, 79.5, 59.5)
SHAPE = (120, 160)


def wall(z: float, half: float = 5.0) -> Mesh:
    """A square that faces the origin from `z` metres along the optical axis."""
    corners = np.array([(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)], np.float32)
    faces = np.array([(0, 2, 1), (0, 3, 2)], np.int32)
    return Mesh(corners, faces, np.tile(np.float32((0, 0, -1)), (4, 1)))


@pytest.mark.parametrize(
    "camera", [CAMERA, Intrinsics(200.0, 210.0, 60.25, 80.75), Intrinsics(200.0, -190.0, 90.0, 40.0)]
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
