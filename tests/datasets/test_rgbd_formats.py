# SPDX-License-Identifier: MIT
"""RGB-D layouts of ScanNet, Replica, nerfstudio, Redwood and ICL-NUIM, and clouds of gtsam_points."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import written_recordings
from geometry_checks import move, warp_residual
from small_recordings import Change, one_line, put
from written_recordings import check, matrix, millimetres, replica, scannet, views

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import TUM, LidarDump, Redwood, Replica, ScanNet, open_dataset
from tsfusion.evaluation.view_prediction import depth_metres, points_camera
from tsfusion.geometry.keyframe import Intrinsics


def drop(name: str) -> Change:
    return lambda root: (root / name).unlink()


@pytest.mark.parametrize("frames25k", [False, True])
def test_scannet_is_read_back(tmp_path, frames25k):
    dataset = open_dataset(scannet(tmp_path / "scene0000_00", frames25k=frames25k))
    assert isinstance(dataset, ScanNet)
    assert dataset.name == "ScanNet scene0000_00"
    check(dataset, views())


def test_scannet_frames_that_the_tracker_lost_have_no_pose(tmp_path):
    root = scannet(tmp_path, lost=(1,))
    (root / "pose" / "21.txt").unlink()
    posed, all_ = ScanNet(root), ScanNet(root, posed=False)
    assert (len(posed), posed.skipped) == (2, {"without a pose": 2})
    assert (len(all_), all_.skipped) == (4, {})
    assert [all_.pose(index) is None for index in range(4)] == [False, True, False, True]
    np.testing.assert_array_equal(posed.frame(1).depth, all_.frame(2).depth)
    with pytest.raises(DatasetError, match=r"frame 1 of ScanNet .* has no pose; `tsfusion scan"):
        all_[1]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (drop("intrinsic/intrinsic_depth.txt"), r"intrinsic_depth\.txt is missing; expected color/N\.jpg"),
        (put("intrinsic/intrinsic_depth.txt", "1 0 0\n"), r"must hold a 4×4 or 3×3 camera matrix, got 1×3"),
        (put("pose/7.txt", "1 0 0 0\n"), r"pose/7\.txt must hold 4 rows of 4 numbers, got 1"),
        (put("pose/7.txt", matrix(np.eye(4)).replace("1.0", "2.0")), r"pose/7\.txt: T_world_camera must"),
        (drop("color/7.jpg"), r"color/7\.png or \.jpg is missing, but .*depth/7\.png is there"),
        (put("color/7.jpg", ""), r"color/7\.jpg cannot be decoded"),
        (drop("depth/0.png"), r"holds no usable frames"),
    ],
)
def test_a_broken_scannet_scene_is_one_clear_line(tmp_path, change, match):
    scannet(tmp_path, count=2)
    change(tmp_path)
    if match == r"holds no usable frames":
        (tmp_path / "depth" / "7.png").unlink()
    one_line(lambda: list(ScanNet(tmp_path)), match)


def replica_with_camera(root: Path, **changed: object) -> Path:
    K = views(1)[0].intrinsics
    assert K is not None
    camera = {"w": 160, "h": 120, "fx": K.fx, "fy": K.fy, "cx": K.cx, "cy": K.cy, "scale": 6553.5}
    root.mkdir()
    (root / "cam_params.json").write_text(json.dumps({"camera": {**camera, **changed}}))
    return replica(root / "room0")


def test_replica_is_read_back(tmp_path):
    dataset = open_dataset(replica_with_camera(tmp_path / "Replica"))
    assert isinstance(dataset, Replica)
    check(dataset, views(), depth_m=0.0002)
    assert open_dataset(tmp_path / "Replica").name == "Replica room0"


def test_replica_without_its_camera_file_has_nice_slams_camera(tmp_path):
    root = tmp_path / "room0"
    written_recordings.write(root / "results" / "depth000003.png", np.full((68, 120), 6554, np.uint16))
    (root / "traj.txt").write_text("\n".join(" ".join(matrix(np.eye(4) * 1.0).split()) for _ in range(4)))
    dataset = Replica(root)
    assert dataset.intrinsics == Intrinsics(600.0, 600.0, 599.5, 339.5).scaled(0.1)
    assert depth_metres(dataset[0])[0, 0] == pytest.approx(1, abs=1e-3)
    assert dataset[0].color is None
    written_recordings.write(root / "results" / "depth000004.png", np.full((68, 120), 6554, np.uint16))
    assert Replica(root).skipped == {"without a pose": 1}
    assert len(Replica(root, posed=False)) == 2


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (drop("room0/traj.txt"), r"traj\.txt is missing; expected 16 numbers a line; `tsfusion scan"),
        (put("room0/traj.txt", "1 2 3\n"), r"traj\.txt:1: 3 numbers, expected 16"),
        (put("cam_params.json", "{}"), r"cam_params\.json must hold camera: w, h, fx.*; KeyError: 'camera'"),
        (drop("room0/results/frame000001.jpg"), r"frame000001\.jpg is missing, but .*depth000001\.png"),
        (drop("cam_params.json"), r"depth000000\.png is 160×120, its camera 1200×680"),
    ],
)
def test_a_broken_replica_scene_is_one_clear_line(tmp_path, change, match):
    replica_with_camera(tmp_path / "Replica")
    change(tmp_path / "Replica")
    one_line(lambda: list(Replica(tmp_path / "Replica" / "room0")), match)


def redwood(root: Path, color: str, log: str, depth: str = "depth") -> Path:
    """Open3D's and Redwood's places for the same images and poses."""
    K = Intrinsics(525, 525, 319.5, 239.5)
    text = ""
    for number, view in enumerate(views()):
        assert view.color is not None
        written_recordings.write(root / depth / f"{number:05d}.png", millimetres(view))
        written_recordings.write(root / color / f"{number:05d}.jpg", view.color)
        text += f"{number}\t{number}\t{number + 1}\n{matrix(view.T_world_camera)}"
        K = view.intrinsics or K
    (root / log).parent.mkdir(exist_ok=True)
    (root / log).write_text(text)
    camera = {"width": 160, "height": 120, "intrinsic_matrix": [K.fx, 0, 0, 0, K.fy, 0, K.cx, K.cy, 1]}
    (root / "intrinsic.json").write_text(json.dumps(camera))
    return root


@pytest.mark.parametrize(
    ("color", "log", "depth"),
    [
        ("image", "trajectory.log", "depth"),
        ("color", "odometry.log", "depth"),
        ("rgb", "scene/trajectory.log", "depth"),
        ("color", "lounge_trajectory.log", "depth"),
        ("livingroom1-color", "livingroom1-traj.txt", "livingroom1-depth-clean"),
    ],
)
def test_redwoods_and_open3ds_places_are_known(tmp_path, color, log, depth):
    root = redwood(tmp_path / "scene1", color, log, depth)
    dataset = open_dataset(root)
    assert isinstance(dataset, Redwood)
    check(dataset, views())
    if log.endswith(".log"):
        check(open_dataset(root / log), views())


def test_a_log_that_is_given_beats_the_one_that_is_found(tmp_path):
    root = redwood(tmp_path, "image", "trajectory.log")
    lines = (root / "trajectory.log").read_text().splitlines()
    (root / "other.log").write_text("\n".join(lines[:10]) + "\n")
    for dataset in (open_dataset(root / "other.log"), open_dataset(root, poses="other.log")):
        assert (len(dataset), dataset.skipped) == (2, {"without a pose": 2})
    (root / "livingroom1-depth-clean").mkdir()
    (root / "depth").rename(root / "livingroom1-depth-simulated")
    one_line(lambda: Redwood(root), r"holds 2 depth folders \(livingroom1-depth-clean, .*simulated\)")


def icl(root: Path, order: str, truth: Path) -> Path:
    """As the archive is: frames from 0, a list of pairs; the trajectory from 1, downloaded by itself."""
    rows = []
    for number in range(3):
        written_recordings.write(root / "depth" / f"{number}.png", np.full((480, 640), 5000, np.uint16))
        written_recordings.write(root / "rgb" / f"{number}.png", np.full((480, 640, 3), number, np.uint8))
        depth, color = f"{number} depth/{number}.png", f"{number} rgb/{number}.png"
        rows.append(f"{depth} {color}" if order == "depth" else f"{color} {depth}")
    (root / "associations.txt").write_text("\n".join(rows) + "\n")
    truth.write_text("1 0 0 -2.25 0 0 0 1\n2 0.1 0 -2.25 0 0 0 1\n")
    return root


@pytest.mark.parametrize("order", ["depth", "rgb"])
@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("living_room_traj2_frei_png", "livingRoom2.gt.freiburg"),
        ("living_room_traj2_frei_png", "living_room_traj2_frei_png/livingRoom2.gt.freiburg"),
        ("traj1_frei_png", "traj1.gt.freiburg"),
        ("mine", "mine/livingRoom0.gt.freiburg"),
    ],
)
def test_icl_nuim_as_published(tmp_path, order, name, truth):
    (tmp_path / name).mkdir()
    (tmp_path / "livingRoom9.gt.freiburg").write_text("7 0 0 0 0 0 0 1\n")  # another sequence's
    dataset = open_dataset(icl(tmp_path / name, order, tmp_path / truth))
    assert isinstance(dataset, TUM)
    assert dataset.name == f"ICL-NUIM {name}"
    assert dataset.intrinsics == Intrinsics(481.2, -480.0, 319.5, 239.5)
    assert dataset.skipped == {"without a pose in time": 1}
    assert [keyframe.T_world_camera[0, 3] for keyframe in dataset] == [0, 0.1]
    assert [int(keyframe.color[0, 0, 0]) for keyframe in dataset] == [1, 2]
    unposed = open_dataset(tmp_path / name, posed=False)
    assert [unposed.pose(index) is None for index in range(3)] == [True, False, False]


def test_icl_nuim_by_its_list_of_pairs_alone(data, tmp_path):
    for folder in ("depth", "rgb"):
        shutil.copytree(data("icl_nuim_tum") / folder, tmp_path / "icl-nuim" / folder)
    shutil.copy(data("icl_nuim_tum") / "associations.txt", tmp_path / "icl-nuim")
    shutil.copy(data("icl_nuim_tum") / "groundtruth.txt", tmp_path / "icl-nuim" / "livingRoom2.gt.freiburg")
    ours, theirs = open_dataset(tmp_path / "icl-nuim"), open_dataset(data("icl_nuim_tum"))
    assert len(ours) == len(theirs) == 3
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
        np.testing.assert_array_equal(a.color, b.color)
    assert warp_residual(ours[0], ours[2]) < 0.0008


@pytest.mark.parametrize("line", ["1 a.png 2 b.png", "1 depth/1.png 1 depth/2.png", "1 depth/1.png"])
def test_a_broken_list_of_pairs_is_one_clear_line(tmp_path, line):
    (tmp_path / "associations.txt").write_text(line + "\n")
    one_line(lambda: TUM(tmp_path), r"associations\.txt:1: .*; expected `timestamp depth/…")


def test_stamps_can_be_shifted(tmp_path):
    (tmp_path / "icl").mkdir()
    root = icl(tmp_path / "icl", "depth", tmp_path / "icl" / "groundtruth.txt")
    late = TUM(root, time_offset_s=1.0)
    assert [keyframe.T_world_camera[0, 3] for keyframe in late] == [0, 0.1]
    assert list(late.timestamps_ns) == [0, 1_000_000_000]
    assert TUM(root, time_offset_s=0.5, max_gap_s=2).skipped == {"without a pose in time": 2}


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
        (drop("graph.txt"), r"graph\.txt is missing; .*`tsfusion scan"),
        (put("graph.txt", "v0 0 0 0 0 0 0\n"), r"graph\.txt:1: 6 numbers, expected 7"),
        (put("graph.txt", "v0 0 0 0 0 0 0 2\n"), r"graph\.txt:1: quaternion must have length 1, got 2"),
        (put("graph.txt", "vertex 0 0 0 0 0 0 1\n"), r"graph\.txt:1: 'vertex'; expected `vK tx"),
        (put("000000/points.bin", "x"), r"points\.bin has 1 bytes; expected 12 a point"),
    ],
)
def test_a_broken_dump_is_one_clear_line(tmp_path, change, match):
    change(dump(tmp_path))
    one_line(lambda: list(LidarDump(tmp_path)), match)
