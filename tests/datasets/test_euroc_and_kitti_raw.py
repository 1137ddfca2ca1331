# SPDX-License-Identifier: MIT
"""Stereo and LiDAR on rigs: EuRoC's poses are a body's, KITTI raw's a GPS unit's; files go missing."""

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import rig_recordings
import written_recordings
from geometry_checks import move, warp_residual
from rig_recordings import circle
from written_recordings import at, fits_together

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import EuRoC, KITTIRaw, describe, open_dataset
from tsfusion.evaluation.view_prediction import points_camera
from tsfusion.geometry.calibration import Camera
from tsfusion.geometry.se3 import angle, inverse

scipy_spatial = pytest.importorskip("scipy.spatial")

Change = Callable[[Path], object]
CAM0, CAM1, TRUTH = "mav0/cam0", "mav0/cam1", "mav0/state_groundtruth_estimate0/data.csv"


@pytest.fixture(scope="module", params=["radial-tangential", "equidistant"])
def euroc_root(request, tmp_path_factory):
    return rig_recordings.euroc(tmp_path_factory.mktemp("euroc") / request.param, request.param)


@pytest.fixture
def euroc(euroc_root, tmp_path):
    """One to break."""
    return Path(shutil.copytree(euroc_root, tmp_path / "V1"))


@pytest.fixture(scope="module")
def drive_root(tmp_path_factory):
    return rig_recordings.kitti_raw(tmp_path_factory.mktemp("kitti"), cameras=("00", "01", "02", "03"))


@pytest.fixture
def drive(drive_root, tmp_path):
    """One to break."""
    return Path(shutil.copytree(drive_root.parent, tmp_path / "day")) / drive_root.name


def test_euroc_poses_and_depth_are_the_rectified_left_cameras(euroc_root):
    dataset = open_dataset(euroc_root)
    assert isinstance(dataset, EuRoC)
    assert (len(dataset), dataset.sensor, dataset.skipped) == (3, "stereo", {})
    turn = inverse(circle(1)[0]) @ dataset.pose(0)
    assert 0.3 < np.degrees(angle(turn)) < 5  # rectification turns the camera, and moves it nowhere
    for index, T in enumerate(circle(3)):
        np.testing.assert_allclose(dataset.pose(index), T @ turn, atol=1e-6)
    a, b = dataset[0], dataset[1]
    assert (a.disparity > 0).mean() > 0.85
    fits_together(a, b, bound=0.026)
    truth = at([a.T_world_camera], width=640)[0]
    assert warp_residual(a, truth) < 0.04  # 0.2 px of disparity at 2.6 m
    flat = Camera(dataset.intrinsics, (240, 376))
    expected = written_recordings.through_lens(truth.color, truth.intrinsics, flat)
    assert written_recordings.shift(a.color, expected) < 0.1  # pixels


def test_euroc_frames_are_pairs_with_stamps(euroc_root):
    dataset = EuRoC(euroc_root / "mav0")
    assert dataset.name == f"EuRoC {euroc_root.name}"
    frame = dataset.frame(1)
    assert (frame.kind, frame.shape) == ("pair", (240, 376))
    assert frame.timestamp_ns == rig_recordings.FIRST_NS + 50_000_000
    assert frame.baseline_fx == pytest.approx(dataset.intrinsics.fx * np.linalg.norm((0.06, 0.002, -0.003)))
    assert describe(dataset).endswith("3 stereo pairs 376×240 at 20 Hz, all with poses")


def test_euroc_images_without_their_other_half_are_counted(euroc):
    left, right = (sorted((euroc / cam / "data").glob("*.png")) for cam in (CAM0, CAM1))
    left[0].unlink()
    lines = (euroc / CAM1 / "data.csv").read_text().splitlines()
    (euroc / CAM1 / "data.csv").write_text("\n".join([*lines[:2], *lines[3:]]) + "\n")
    dataset = EuRoC(euroc)
    assert dataset.skipped == {"without their other half": 2}
    assert list(dataset.timestamps_ns) == [int(left[2].stem)]
    with pytest.raises(DatasetError, match=r"no usable frames.*\(3 without their other half\)"):
        EuRoC(euroc, max_difference_s=1e-9)
    right[2].write_bytes(b"")
    with pytest.raises(DatasetError, match=r"cannot be decoded; expected a grey image"):
        dataset[0]


def test_euroc_stamps_can_be_shifted_and_poses_missing(euroc):
    shifted = EuRoC(euroc, time_offset_s=0.05)
    assert shifted.skipped == {"without a pose in time": 1}
    np.testing.assert_allclose(shifted.pose(0), EuRoC(euroc).pose(1), atol=1e-9)
    unposed = EuRoC(euroc, time_offset_s=0.05, posed=False)
    assert [unposed.pose(index) is None for index in range(3)] == [False, False, True]
    (euroc / TRUTH).unlink()
    assert EuRoC(euroc, posed=False).frame(0).T_world_camera is None
    with pytest.raises(DatasetError, match=r"data\.csv is missing; expected `ns,px.*`tsfusion scan"):
        EuRoC(euroc)


def replace(name: str, old: str, new: str) -> Change:
    return lambda root: (root / name).write_text((root / name).read_text().replace(old, new))


def put(name: str, text: str) -> Change:
    return lambda root: (root / name).write_text(text)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda root: (root / CAM1 / "sensor.yaml").unlink(), r"cam1/sensor\.yaml is missing"),
        (replace(f"{CAM0}/sensor.yaml", "T_BS", "T_XX"), r"sensor\.yaml"),
        (replace(f"{CAM0}/sensor.yaml", "resolution: [376, 240]", "resolution: [752, 480]"),
         r"the camera was calibrated for images of 752×480, got 376×240"),
        (replace(f"{CAM0}/data.csv", ",", ";"), r"cam0/data\.csv:2: .*; expected `ns,file` a line"),
        (replace(TRUTH, f"{rig_recordings.FIRST_NS},", "soon,"), r"must be nanoseconds, got 'soon'"),
        (replace(TRUTH, ",0,0,0,0,0,0,0,0,0", ""), None),
        (put(TRUTH, "1,2,3\n"), r"data\.csv:1: 2 numbers, expected 7"),
        (put(TRUTH, "1,2,3,4,5,6,7,8\n"), r"quaternion must have length 1"),
        (put(TRUTH, "1,0,0,0,1,0,0,0\n"), r"\(3 without a pose in time\)"),
    ],
)  # fmt: skip
def test_a_broken_euroc_sequence_is_one_clear_line(euroc, change, match):
    change(euroc)
    if match is None:  # the columns of velocity and bias are not needed
        assert len(list(EuRoC(euroc))) == 3
        return
    with pytest.raises(DatasetError, match=match) as caught:
        list(EuRoC(euroc))
    assert "\n" not in str(caught.value)


def test_euroc_as_recorded(data):
    dataset = open_dataset(data("euroc_V1_01"))
    assert (len(dataset), dataset.skipped) == (4, {})
    frame = dataset.frame(0)
    assert frame.baseline_fx / frame.intrinsics.fx == pytest.approx(0.11008, abs=5e-5)
    corners = cv2.goodFeaturesToTrack(frame.left, 300, 0.01, 8)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        frame.left, frame.right, corners, None, winSize=(21, 21), maxLevel=4
    )
    apart = np.abs((moved - corners)[found[:, 0] == 1, 0, 1])
    assert np.median(apart) < 0.4
    assert (dataset[0].disparity > 0).mean() > 0.5
    # The drone stands: its body is where the ground truth's first row has it, the camera 7 cm from there.
    assert np.linalg.norm(dataset.pose(0)[:3, 3] - (0.878895, 2.1834, 0.948427)) == pytest.approx(
        0.0689, abs=1e-3
    )
    assert warp_residual(dataset[0], dataset[3], max_depth=4) < 0.02


@pytest.mark.parametrize(("cameras", "shift"), [("grey", 0.0), ("color", -0.06)])
def test_kitti_raw_poses_and_depth_are_the_left_cameras(drive_root, cameras, shift):
    dataset = open_dataset(drive_root, cameras=cameras)
    assert isinstance(dataset, KITTIRaw)
    assert (len(dataset), dataset.skipped) == (3, {})
    beside = np.eye(4)
    beside[0, 3] = shift
    expected = [T @ beside for T in circle(3)]
    for index in (1, 2):
        np.testing.assert_allclose(
            inverse(dataset.pose(0)) @ dataset.pose(index), inverse(expected[0]) @ expected[index], atol=1e-5
        )
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
    grey, color, lidar = (
        KITTIRaw(drive_root, **options) for options in ({}, {"cameras": "color"}, {"modality": "lidar"})
    )
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
        (replace("../calib_velo_to_cam.txt", "R: ", "R; "), r"txt:2: .*; expected `name: numbers`"),
        (replace("oxts/data/0000000001.txt", " 4 11 4 4 0", ""), r"01\.txt:1: 25 numbers, expected 30"),
        (replace("image_00/timestamps.txt", "2011-09-26", "today"), r"timestamps\.txt: .*; expected `year"),
        (
            lambda root: (root / "image_00/timestamps.txt").write_text(""),
            r"has 0 lines, but there is a frame 2",
        ),
        (
            lambda root: (root / "image_00/timestamps.txt").write_text("\n\n\n"),
            r"txt:1 is empty, but there is",
        ),
        (lambda root: root.rename(root.with_name("2011_09_26_drive_0001_extract")), r"is not rectified"),
        (
            lambda root: shutil.copytree(root, root.with_name("2011_09_26_drive_0002_sync")),
            r"holds 2 KITTI drives",
        ),
    ],
)
def test_a_broken_drive_is_one_clear_line(drive, change, match):
    change(drive)
    with pytest.raises(DatasetError, match=match) as caught:
        list(KITTIRaw(drive.parent))
    assert "\n" not in str(caught.value)
    with pytest.raises(DatasetError, match="modality of KITTI raw must be stereo or lidar, cameras grey"):
        KITTIRaw(drive.parent, modality="radar")
