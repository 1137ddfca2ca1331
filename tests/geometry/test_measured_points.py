# SPDX-License-Identifier: MIT
"""Depth and points that a keyframe measured."""

import numpy as np
import pytest

from tsfusion import Intrinsics, Keyframe
from tsfusion.geometry.keyframe import depth_metres, points_world

CAMERA = Intrinsics(200.0, 200.0, 79.5, 59.5)
SHAPE = (120, 160)


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
