# SPDX-License-Identifier: MIT
"""LiDAR keyframes of gtsam_points: clouds, poses and errors."""

from pathlib import Path

import numpy as np
import pytest
from geometry_checks import move
from small_recordings import LeftOut, one_line_of, put

from tsfusion.datasets import LidarDump, open_dataset
from tsfusion.geometry.keyframe import points_camera


def test_lidar_keyframes_meet_by_their_poses(data):
    from scipy.spatial import cKDTree

    dataset = open_dataset(data("kitti07_lidar_keyframes"))
    assert isinstance(dataset, LidarDump)
    assert (len(dataset), dataset.sensor) == (5, "lidar")
    a, b = (move(dataset[i].T_world_camera, points_camera(dataset[i])) for i in (0, 1))
    together = np.median(cKDTree(b).query(a)[0])
    apart = np.median(cKDTree(points_camera(dataset[1])).query(points_camera(dataset[0]))[0])
    assert together < 0.25
    assert apart > 1.5 * together


def dump(root: Path) -> Path:
    for number in range(3):
        place = root / f"{number:06d}"
        place.mkdir()
        np.full((4, 3), number, np.float32).tofile(place / "points.bin")
    (root / "graph.txt").write_text("v0 0 0 0 0 0 0 1\nv2 1 2 3 0 0 0.5 0.8660254\ne 0 1 0 0 0\n")
    return root


def test_clouds_go_by_their_number(tmp_path):
    dataset = open_dataset(dump(tmp_path))
    assert (len(dataset), dataset.skipped) == (2, {"without a pose": 1})
    assert dataset[1].points[0, 0] == 2
    assert list(dataset[1].T_world_camera[:3, 3]) == [1, 2, 3]
    assert dataset[1].T_world_camera[1, 0] == pytest.approx(np.sin(np.radians(60)))
    unposed = open_dataset(tmp_path, posed=False)
    assert [unposed.pose(index) is None for index in range(3)] == [False, True, False]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (put("graph.txt", None), r"graph\.txt is missing; .*`tsfusion scan"),
        (put("graph.txt", "v0 0 0 0 0 0 0\n"), r"graph\.txt:1: 6 numbers, expected 7"),
        (put("graph.txt", "v0 0 0 0 0 0 0 2\n"), r"graph\.txt:1: quaternion must have length 1, got 2"),
        (put("graph.txt", "vertex 0 0 0 0 0 0 1\n"), r"graph\.txt:1: 'vertex'; expected `vK tx"),
        (
            put("000000/points.bin", "x"),
            LeftOut(r"points\.bin has 1 bytes, not 12 a point", {"without a pose": 1, "unreadable": 1}),
        ),
    ],
)
def test_a_broken_dump_is_one_clear_line(tmp_path, change, match):
    change(dump(tmp_path))
    one_line_of(lambda: LidarDump(tmp_path), match)
