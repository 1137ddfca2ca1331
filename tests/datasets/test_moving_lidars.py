# SPDX-License-Identifier: MIT
"""Recordings of a LiDAR that moves in its sweeps give the points that were put right beforehand."""

from pathlib import Path
from typing import Any

import moving_lidars as lidar
import numpy as np
import pytest
from rosbag_writing import writing

from tsfusion import open_dataset
from tsfusion.datasets import describe, select
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.evaluation import pose_check

COUNT = 3
TIMES = {
    "time.pcd": ("time", lambda number, s: s.astype(np.float32)),
    "t.pcd": ("t", lambda number, s: (s * 1e9).astype(np.uint32)),
    "timestamp.pcd": ("timestamp", lambda number, s: lidar.T0_NS / 1e9 + number * lidar.PERIOD_S + s),
    "time.ply": ("time", lambda number, s: s.astype(np.float32)),
    "timestamp.ply": ("timestamp", lambda number, s: lidar.T0_NS + number * lidar.PERIOD_S * 1e9 + s * 1e9),
    "gps_time.las": ("gps_time", lambda number, s: 270_000 + number * lidar.PERIOD_S + s),
}


def folder(root: Path, kind: str = "time.pcd", *, count: int = COUNT, named: str = "", right: bool = False,
           **density: int) -> Path:  # fmt: skip
    """Scans named by the times at which their sweeps begin, or numbered; `right`: put right, with times."""
    root.mkdir(exist_ok=True)
    field, moments = TIMES[kind]
    for number in range(count):
        swept = lidar.sweep(number, **density)
        name = named.format(number) if named else str(lidar.T0_NS + round(number * lidar.PERIOD_S * 1e9))
        points = swept.put_right if right else swept.points
        lidar.save(root / f"{name}.{kind.partition('.')[2]}", points, field, moments(number, swept.times_s))
    return root


def with_poses(root: Path, name: str = "slam_tum.txt", *, every_s: float = 0.01, last: int = COUNT) -> Path:
    write_tum(root / name, *lidar.trajectory(0, last, every_s))
    return root


def worst(dataset: Any, count: int = COUNT) -> float:
    assert len(dataset) == count
    return max(lidar.off(dataset[number].points, lidar.sweep(number)) for number in range(count))


@pytest.mark.parametrize("kind", TIMES)
def test_points_in_files_go_where_they_were(tmp_path: Path, kind: str) -> None:
    root = with_poses(folder(tmp_path / "scans", kind))
    dataset = open_dataset(root)
    assert worst(dataset) < 2e-3
    assert "motion is taken out of sweeps of 0.1 s (--option deskew=false leaves it)" in describe(dataset)
    untouched = open_dataset(root, deskew=False)
    assert worst(untouched) > 0.3
    assert "sweep" not in describe(untouched)


def test_a_part_of_a_recording_is_as_the_whole(tmp_path: Path) -> None:
    dataset = open_dataset(with_poses(folder(tmp_path)))
    (last,) = select(dataset, start=2)
    np.testing.assert_array_equal(last.points, dataset[2].points)


def test_numbered_scans_have_the_times_of_their_poses(tmp_path: Path) -> None:
    root = with_poses(folder(tmp_path, named="{:06d}"), every_s=lidar.PERIOD_S, last=COUNT - 1)
    dataset = open_dataset(root)
    assert worst(dataset) < 0.15  # between poses a period apart, and beyond the last
    assert dataset.timestamps_ns is not None


def test_poses_without_times_are_of_the_scans(tmp_path: Path) -> None:
    root = folder(tmp_path)
    poses = [lidar.pose_at(number * lidar.PERIOD_S) for number in range(COUNT)]
    (root / "poses.txt").write_text("\n".join(" ".join(map(str, T[:3].ravel())) for T in poses) + "\n")
    assert worst(open_dataset(root)) < 0.15


def test_without_a_motion_that_is_said(tmp_path: Path) -> None:
    root = folder(tmp_path, named="{:06d}")
    poses = [lidar.pose_at(number * lidar.PERIOD_S) for number in range(COUNT)]
    (root / "poses.txt").write_text("\n".join(" ".join(map(str, T[:3].ravel())) for T in poses) + "\n")
    dataset = open_dataset(root)
    assert worst(dataset) > 0.3
    assert "its poses tell no motion within sweeps" in describe(dataset)
    assert dataset[0].point_times_s is not None


def test_times_of_no_use_are_said(tmp_path: Path) -> None:
    root = with_poses(tmp_path)
    for number in range(COUNT):
        points = lidar.sweep(number).points
        stamp = lidar.T0_NS + round(number * lidar.PERIOD_S * 1e9)
        lidar.save(root / f"{stamp}.pcd", points, "time", np.zeros(len(points), np.float32))
    assert describe(open_dataset(root)).endswith(
        "motion within sweeps is not taken out: time is the same for all points"
    )


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("shift_s", [0.0, 0.05, 0.1])  # stamped at the sweep's begin, middle and end
def test_points_in_bags_go_where_they_were(tmp_path: Path, shift_s: float, given: bool) -> None:
    stamps, poses = lidar.trajectory(-1, COUNT + 2)
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")]
    with writing(tmp_path, "mcap") as (bag, path):
        for number in range(COUNT):
            swept, begin_ns = lidar.sweep(number), lidar.T0_NS + number * round(lidar.PERIOD_S * 1e9)
            records = np.zeros(len(swept.points), kinds)
            records["x"], records["y"], records["z"] = swept.points.T
            records["timestamp"] = begin_ns / 1e9 + swept.times_s
            bag.cloud("/points", records[None], begin_ns + round(shift_s * 1e9), frame="lidar")
        for stamp, T in zip(stamps, poses, strict=True):
            bag.odometry("/odom", np.eye(4) if given else T, "map", "lidar", stamp)
    write_tum(tmp_path / "other_slam.txt", stamps, poses)
    dataset = open_dataset(path, trajectory=tmp_path / "other_slam.txt" if given else None)
    for number in range(COUNT):
        keyframe, swept = dataset[number], lidar.sweep(number)
        T_begin = lidar.pose_at(number * lidar.PERIOD_S)
        T = np.linalg.inv(T_begin) @ keyframe.T_world_camera
        assert lidar.off(keyframe.points @ T[:3, :3].T + T[:3, 3], swept) < 2e-3


def test_points_that_were_put_right_before_are_found_out(tmp_path: Path) -> None:
    root = folder(tmp_path / "a", count=8, right=True, columns=360, rings=24)
    report = pose_check.check(open_dataset(with_poses(root, last=8)))
    assert (report.verdict, report.mistake) == ("disagree", "point times")
    assert "--option deskew=false" in report.text
    assert pose_check.check(open_dataset(root, deskew=False)).verdict == "agree"
    moving = folder(tmp_path / "b", count=8, columns=360, rings=24)
    assert pose_check.check(open_dataset(with_poses(moving, last=8))).verdict == "agree"
