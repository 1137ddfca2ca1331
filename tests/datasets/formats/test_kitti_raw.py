# SPDX-License-Identifier: MIT
"""KITTI raw: a drive through the synthetic room comes back with its poses, depth and scans."""

import contextlib
import shutil
from pathlib import Path

import numpy as np
import pytest
import rig_recordings
from geometry_checks import move
from rig_recordings import circle
from small_recordings import UNPOSED, LeftOut, one_line_of, put, replace
from written_recordings import fits_together

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import KITTIRaw, open_dataset
from tsfusion.geometry.keyframe import points_camera
from tsfusion.geometry.se3 import inverse

scipy_spatial = pytest.importorskip("scipy.spatial")


@pytest.fixture(scope="module")
def drive_root(tmp_path_factory):
    return rig_recordings.kitti_raw(tmp_path_factory.mktemp("kitti"), cameras=("00", "01", "02", "03"))


@pytest.fixture
def drive(drive_root, tmp_path):
    """One to break."""
    return Path(shutil.copytree(drive_root.parent, tmp_path / "day")) / drive_root.name


@pytest.mark.parametrize(("cameras", "shift"), [("grey", 0.0), ("color", -0.06)])
def test_kitti_raw_poses_and_depth_are_the_left_cameras(drive_root, cameras, shift):
    dataset = open_dataset(drive_root, cameras=cameras)
    assert isinstance(dataset, KITTIRaw)
    assert (len(dataset), dataset.skipped) == (3, {})
    beside = np.eye(4)
    beside[0, 3] = shift
    expected = [T @ beside for T in circle(3)]
    for index in (1, 2):
        step = inverse(dataset.pose(0)) @ dataset.pose(index)
        np.testing.assert_allclose(step, inverse(expected[0]) @ expected[index], atol=1e-5)
    np.testing.assert_allclose(dataset.pose(0)[:3, :3], expected[0][:3, :3], atol=1e-6)  # east, north, up
    fits_together(dataset[0], dataset[1], bound=0.02)
    color = dataset[0].color
    assert (np.ptp(color, axis=2).max() == 0) == (cameras == "grey")


def test_kitti_raw_scans_meet_each_other_and_the_stereo_depth(drive_root):
    scans, stereo = open_dataset(drive_root, modality="lidar"), open_dataset(drive_root.parent)
    assert (scans.name, scans.sensor) == ("KITTI raw 2011_09_26_drive_0001_sync lidar", "lidar")
    first = scipy_spatial.cKDTree(move(scans[0].T_world_camera, scans[0].points))
    own = np.median(first.query(move(scans[2].T_world_camera, scans[2].points))[0])
    swapped = np.median(first.query(move(scans[0].T_world_camera, scans[2].points))[0])
    assert own < 0.02
    assert swapped > 3 * own
    pair = move(stereo[0].T_world_camera, points_camera(stereo[0])[::40])
    assert np.median(first.query(pair)[0]) < 0.03


def test_kitti_raw_numbers_agree_with_pykittis_own(drive_root):
    import pykitti

    with contextlib.redirect_stdout(None):
        theirs = pykitti.raw(str(drive_root.parents[1]), rig_recordings.DAY, "0001")
    grey, color = KITTIRaw(drive_root), KITTIRaw(drive_root, cameras="color")
    lidar = KITTIRaw(drive_root, modality="lidar")
    np.testing.assert_allclose(grey.intrinsics.matrix, theirs.calib.K_cam0)
    assert grey.baseline_fx / grey.intrinsics.fx == pytest.approx(theirs.calib.b_gray)
    assert color.baseline_fx / color.intrinsics.fx == pytest.approx(theirs.calib.b_rgb)
    for index, packet in enumerate(theirs.oxts):
        for dataset, name in ((grey, "cam0"), (color, "cam2"), (lidar, "velo")):
            T_sensor_imu = getattr(theirs.calib, f"T_{name}_imu")
            np.testing.assert_allclose(dataset.pose(index) @ T_sensor_imu, packet.T_w_imu, atol=1e-8)
    stamps = np.array(theirs.timestamps, "datetime64[ns]").astype(np.int64)
    assert np.abs(grey.timestamps_ns - stamps).max() < 1000  # pykitti's end at microseconds


def test_kitti_raw_files_that_are_missing_move_no_other(drive):
    whole = KITTIRaw(drive)
    (drive / "image_01" / "data" / "0000000001.png").unlink()
    pairs = KITTIRaw(drive)
    assert pairs.skipped == {"without their other half": 1}
    np.testing.assert_array_equal(pairs.pose(1), whole.pose(2))
    assert pairs.timestamps_ns[1] == whole.timestamps_ns[2]
    (drive / "velodyne_points" / "data" / "0000000000.bin").unlink()
    stamps = (drive / "velodyne_points" / "timestamps.txt").read_text().splitlines()
    (drive / "velodyne_points" / "timestamps.txt").write_text("\n".join(["", *stamps[1:]]) + "\n")
    (drive / "oxts" / "data" / "0000000002.txt").unlink()
    scans = KITTIRaw(drive, modality="lidar")
    assert (len(scans), scans.skipped) == (1, {"without a pose": 1})
    unposed = KITTIRaw(drive, modality="lidar", posed=False)
    assert [unposed.pose(index) is None for index in range(2)] == [False, True]
    assert KITTIRaw(drive.parent, modality="lidar").name == scans.name


def test_kitti_raw_without_a_gps_unit_serves_scans_without_poses(drive):
    shutil.rmtree(drive / "oxts")
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    for modality in ("stereo", "lidar"):
        assert KITTIRaw(drive, modality=modality, posed=False).pose(0) is None
        with pytest.raises(DatasetError, match=r"oxts/data has no packets"):
            KITTIRaw(drive, modality=modality)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (replace("../calib_cam_to_cam.txt", "P_rect_01", "P_rect_09"), r"has no usable line P_rect_01"),
        (replace("../calib_cam_to_cam.txt", "P_rect_01: ", "P_rect_01: x"), r"has no usable line P_rect_01"),
        (replace("../calib_velo_to_cam.txt", "R: ", "R: 9 "), r"calib_velo_to_cam\.txt has no usable line R"),
        (
            lambda root: shutil.copy(root / "../calib_imu_to_velo.txt", root / "../calib_velo_to_cam.txt"),
            r"calib_velo_to_cam\.txt turns forward elsewhere",
        ),
        (replace("../calib_velo_to_cam.txt", "R: ", "R; "), r"txt:2: .*; expected `name: numbers`"),
        (
            replace("oxts/data/0000000001.txt", " 4 11 4 4 0", ""),
            LeftOut(r"01\.txt:1: 25 numbers, expected 30", UNPOSED),
        ),
        (replace("image_00/timestamps.txt", "2011-09-26", "today"), r"timestamps\.txt: .*; expected `year"),
        (put("image_00/timestamps.txt", ""), r"has 0 lines, but there is a frame 2"),
        (put("image_00/timestamps.txt", "\n\n\n"), r"txt:1 is empty, but there is"),
        (lambda root: root.rename(root.with_name("2011_09_26_drive_0001_extract")), r"is not rectified"),
        (
            lambda root: shutil.copytree(root, root.with_name("2011_09_26_drive_0002_sync")),
            r"holds 2 KITTI drives",
        ),
    ],
)
def test_a_broken_drive_is_one_clear_line(drive, change, match):
    change(drive)
    one_line_of(lambda: KITTIRaw(drive.parent), match)
    with pytest.raises(DatasetError, match="modality of KITTI raw must be stereo or lidar, cameras grey"):
        KITTIRaw(drive.parent, modality="radar")
