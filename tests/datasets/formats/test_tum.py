# SPDX-License-Identifier: MIT
"""TUM RGB-D recordings and their relatives CoRBS and ICL-NUIM."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from geometry_checks import move, warp_residual
from small_recordings import LeftOut, corbs, one_line, one_line_of, put, replace
from written_recordings import write

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import TUM, open_dataset
from tsfusion.datasets.trajectory_files import nanoseconds, read_tum
from tsfusion.geometry import up_direction
from tsfusion.geometry.keyframe import Intrinsics, points_camera
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import SensorPosture

scipy_spatial = pytest.importorskip("scipy.spatial")

SECOND = 1_000_000_000
TRUTH = "../D1_Trajectory/groundtruth.txt"


def test_corbs_as_shipped(tmp_path):
    dataset = open_dataset(corbs(tmp_path))
    assert isinstance(dataset, TUM)
    assert (dataset.name, dataset.sensor) == ("CoRBS D1_pre_registereddata", "tof")
    assert dataset.intrinsics == Intrinsics(468.60, 468.61, 318.27, 243.99)
    assert dataset.skipped == {"without a pose in time": 1}
    assert dataset.uncolored == 1
    assert list(dataset.timestamps_ns) == [1000 * SECOND + i * SECOND // 10 for i in range(4)]
    keyframes = list(dataset)
    assert [float(k.depth[0, 0] * k.depth_scale) for k in keyframes] == pytest.approx([1, 2, 3, 4])
    assert [k.T_world_camera[0, 3] for k in keyframes] == pytest.approx([-0.2, 1.8, 3.8, 5.8])
    assert [None if k.color is None else int(k.color[0, 0, 0]) for k in keyframes] == [0, 1, None, 3]


@pytest.mark.parametrize("shape", [(240, 320), (270, 480)])
def test_a_published_camera_is_not_guessed_for_another_size(tmp_path, shape):
    root = corbs(tmp_path, shape=shape)
    one_line(lambda: TUM(root), r"not known \(that of CoRBS is published for 640×480 alone\).*--intrinsics")
    assert TUM(root, intrinsics=Intrinsics(300, 300, 160, 120))[0].intrinsics.cx == 160


def test_a_gap_in_the_trajectory_is_not_bridged(tmp_path):
    place = corbs(tmp_path)
    lines = (place / TRUTH).read_text().splitlines()
    (place / TRUTH).write_text("\n".join(lines[:3] + lines[6:]))
    assert TUM(place).skipped == {"without a pose in time": 3}
    assert TUM(place, max_gap_s=0.3).skipped == {"without a pose in time": 1}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            put("depth/3.png", None),
            LeftOut(r"3\.png is missing; expected a depth", {"without a pose in time": 1, "unreadable": 1}),
        ),
        (
            put("rgb/3.png", None),
            LeftOut(
                r"3\.png is missing; expected a colour image", {"without a pose in time": 1, "unreadable": 1}
            ),
        ),
        (replace("depth.txt", "1000.100000 d", "1000.100000d"), r"depth\.txt:4: .*expected `timestamp path`"),
        (replace("depth.txt", "1000.100000", "then"), r"depth\.txt:4: timestamp must be seconds, got 'then'"),
        (put("depth.txt", "# nothing\n"), r"depth\.txt lists no images"),
        (
            replace(TRUTH, " 2 0 0", " nan 0 0"),
            LeftOut(r"groundtruth\.txt:5: not finite", {"without a pose in time": 2}),
        ),
        (
            replace(TRUTH, " 2 0 0", " 2 0"),
            LeftOut(r"groundtruth\.txt:5: 7 numbers, expected 8", {"without a pose in time": 2}),
        ),
        (
            replace(TRUTH, "2 0 0 0 0 0 1", "2 0 0 0 0 0 0"),
            LeftOut(r":5: quaternion must have", {"without a pose in time": 2}),
        ),
        (replace(TRUTH, "1000", "2000"), r"no usable frames.*\(5 without a pose in time\)"),
        (put(TRUTH, None), r"groundtruth\.txt is missing; expected .*trajectory"),
    ],
)
def test_a_broken_recording_is_one_clear_line(tmp_path, change, match):
    place = corbs(tmp_path)
    change(place)
    one_line_of(lambda: TUM(place), match)


def test_freiburg_images_are_associated_by_time(data, tmp_path):
    place = data("tum_rgbd/rgbd_dataset_freiburg1_360")
    poses = tmp_path / "orb.txt"
    poses.write_text("".join(f"{1305031790.6 + 0.05 * i:.4f} {i} 0 0 0 0 0 1\n" for i in range(8)))
    dataset = TUM(place, trajectory=poses)
    assert (len(dataset), dataset.uncolored, dataset.skipped) == (5, 0, {})
    assert dataset.camera.lens.intrinsics == Intrinsics(517.3, 516.5, 318.6, 255.3)
    assert dataset.camera.lens.distortion == (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    assert str(dataset.camera).endswith("published for TUM freiburg1, undistorted")
    first = dataset[0]
    assert first.T_world_camera[0, 3] == pytest.approx(0.040468 / 0.05, abs=1e-4)
    assert first.timestamp_ns == 1305031790640468000
    assert first.color.shape == (480, 640, 3)
    assert 0.5 < np.median(first.depth[first.depth > 0]) * first.depth_scale < 5
    with pytest.raises(DatasetError, match=r"groundtruth\.txt is missing"):
        TUM(place)


def test_listed_images_that_are_not_there_are_counted(data):
    with pytest.raises(DatasetError, match=r"is missing \(595 of 595 images"):
        TUM(data("tum_rgbd/rgbd_dataset_freiburg1_desk"))


def test_interpolated_poses_bring_two_real_clouds_together(data):
    place = data("tum_rgbd/rgbd_dataset_freiburg1_desk")
    clouds = sorted((place / "pcd_ds").glob("*.pcd"))
    trajectory = read_tum(place / "groundtruth.txt")
    camera, world = [], []
    for path in clouds[:2]:
        points = _read_pcd(path)
        T = trajectory.at(nanoseconds(path.stem, path, 0), max_gap_ns=SECOND // 10)
        camera.append(points)
        world.append(move(T, points))
    apart, together = (np.median(scipy_spatial.cKDTree(a).query(b)[0]) for a, b in (camera, world))
    assert together < 0.008
    assert apart > 0.03


def _read_pcd(path: Path) -> np.ndarray:
    lines = path.read_text().splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("DATA"))
    points = np.array([line.split()[:3] for line in lines[start + 1 :]], dtype=np.float64)
    return points[np.isfinite(points).all(axis=1)]


def test_a_kinects_accelerometer_finds_the_mocaps_up(data, tmp_path):
    """Real forces and poses of a hand-held scan; the images are a stand-in, 2 a second."""
    desk = data("tum_rgbd/rgbd_dataset_freiburg1_desk")
    root = tmp_path / desk.name
    root.mkdir()
    for name in ("groundtruth.txt", "accelerometer.txt"):
        (root / name).symlink_to(desk / name)
    write(root / "0.png", np.full((480, 640), 5000, np.uint16))
    (root / "depth.txt").write_text("".join(f"{1305031453.3 + 0.5 * i:.6f} 0.png\n" for i in range(40)))
    dataset = TUM(root)
    assert len(dataset) > 30
    held = SensorPosture()
    for index in range(len(dataset)):
        held.add(dataset.pose(index), "kinect", dataset.frame(index).specific_force)
    nothing = np.zeros((0, 3), np.float32)
    up = up_direction.find(Mesh(nothing, nothing.astype(np.int32), nothing), held)
    assert up.found_by == "imu"
    assert np.degrees(np.arccos(up.direction[2])) < 4  # the sensor is mounted a few degrees askew


def test_icl_nuim_has_a_negative_fy_and_5000_units_a_metre(data):
    dataset = TUM(data("icl_nuim_tum"))
    a, b = dataset[0], dataset[2]
    assert dataset.intrinsics == Intrinsics(481.2, -480.0, 319.5, 239.5)
    assert warp_residual(a, b) < 0.0008
    assert 2 < np.median(points_camera(a)[:, 2]) < 6
    upright = TUM(data("icl_nuim_tum"), intrinsics=Intrinsics(481.2, 480.0, 319.5, 239.5))
    assert warp_residual(upright[0], upright[2]) > 0.0015


def icl(root: Path, order: str, truth: Path) -> Path:
    """As the archive is: frames from 0, a list of pairs; the trajectory from 1, downloaded by itself."""
    rows = []
    for number in range(3):
        write(root / "depth" / f"{number}.png", np.full((480, 640), 5000, np.uint16))
        write(root / "rgb" / f"{number}.png", np.full((480, 640, 3), number, np.uint8))
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
    (tmp_path / "icl-nuim").mkdir()
    root = icl(tmp_path / "icl-nuim", "depth", tmp_path / "icl-nuim" / "groundtruth.txt")
    late = TUM(root, time_offset_s=1.0)
    assert [keyframe.T_world_camera[0, 3] for keyframe in late] == [0, 0.1]
    assert list(late.timestamps_ns) == [0, 1_000_000_000]
    assert TUM(root, time_offset_s=0.5, max_gap_s=2).skipped == {"without a pose in time": 2}
