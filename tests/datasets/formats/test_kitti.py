# SPDX-License-Identifier: MIT
"""KITTI odometry and raw: geometry of pairs and scans, the stereo matcher, pykitti's traps."""

import contextlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rig_recordings
from command_processes import python, tsfusion
from geometry_checks import move, warp_residual
from rig_recordings import circle
from small_recordings import P0, P1, TR, UNPOSED, UNREAD, LeftOut, kitti, one_line_of, put, replace
from written_recordings import fits_together

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import KITTI, KITTIRaw, open_dataset, select
from tsfusion.datasets.dataset import NO_HALF
from tsfusion.datasets.folder_frames import WithTrajectory
from tsfusion.geometry.keyframe import depth_metres, points_camera, points_world
from tsfusion.geometry.se3 import inverse
from tsfusion.geometry.stereo_matching import Matcher
from tsfusion.scanner.sources.source import RecordedSource

scipy_spatial = pytest.importorskip("scipy.spatial")

POSES = "../../poses/06.txt"


def test_stereo_depth_of_one_pair_lands_on_the_next(data):
    dataset = KITTI(data("kitti_odometry"), "06")
    a, b = dataset[5], dataset[6]
    residual = warp_residual(a, b, max_depth=15)
    inverse = warp_residual(a, b, T_b_a=b.T_world_camera @ np.linalg.inv(a.T_world_camera), max_depth=15)
    assert residual < 0.065
    assert inverse > 4 * residual
    assert a.baseline_fx == pytest.approx(379.8145)
    assert (a.disparity > 0).mean() > 0.65
    assert a.color.shape == (370, 1226, 3)


def test_the_road_is_flat_and_at_the_height_of_the_car(data):
    keyframe = KITTI(data("kitti_odometry"), "06", color=False)[0]
    z, K = depth_metres(keyframe)[310:365, 500:760], keyframe.intrinsics
    height = ((np.arange(310, 365)[:, None] - K.cy) / K.fy * z)[z > 0]
    assert (z > 0).mean() > 0.95
    assert 1.4 < np.median(height) < 1.75  # the benchmark's cameras are nominally 1.65 m up
    assert np.percentile(height, 95) - np.percentile(height, 5) < 0.08


def test_velodyne_scans_meet_with_the_slam_poses_and_not_with_the_bad_ground_truth(data):
    scans = KITTI(data("kitti_odometry"), "00", "lidar", poses="poses_estimated/00_ORB.txt")
    a, b = scans[0], scans[1]
    assert a.points.shape == (124668, 3)
    above_ground = np.flatnonzero(a.points[:, 2] > -1.4)[::12]
    tree = scipy_spatial.cKDTree(points_world(b))
    apart = np.median(tree.query(points_world(a)[above_ground])[0])
    assert apart < 0.055
    truth = KITTI(data("kitti_odometry"), "00", "lidar")
    tree = scipy_spatial.cKDTree(points_world(truth[1]))
    assert np.median(tree.query(points_world(truth[0])[above_ground])[0]) > 1.3 * apart


def test_numbers_agree_with_pykittis_own(data):
    root = data("kitti_odometry")
    import pykitti

    with contextlib.redirect_stdout(None):
        theirs = pykitti.odometry(str(root), "06", frames=range(30))
    ours = KITTI(root, "06", color=False)
    K = ours.intrinsics
    np.testing.assert_allclose(K.matrix, theirs.calib.K_cam0)
    assert ours.baseline_fx / K.fx == pytest.approx(theirs.calib.b_gray)
    np.testing.assert_allclose(ours._poses, theirs.poses, atol=2e-6)
    seconds = [stamp.total_seconds() for stamp in theirs.timestamps]
    np.testing.assert_allclose(ours.timestamps_ns / 1e9, seconds, atol=1e-6)
    scan = KITTI(root, "00", "lidar")
    with contextlib.redirect_stdout(None):
        T = pykitti.odometry(str(root), "00", frames=range(6)).calib.T_cam0_velo
    first = np.loadtxt(root / "poses" / "00.txt")[3].reshape(3, 4)
    expected = np.linalg.inv(T) @ np.vstack([first, (0, 0, 0, 1)]) @ T
    np.testing.assert_allclose(scan[3].T_world_camera, expected, atol=2e-5)


def test_a_tiny_sequence_in_both_modalities(tmp_path):
    root = kitti(tmp_path)
    stereo, lidar = open_dataset(root), open_dataset(root, modality="lidar")
    assert (stereo.name, lidar.name) == ("KITTI 06 stereo", "KITTI 06 lidar")
    keyframe = stereo[2]
    found = keyframe.disparity[keyframe.disparity > 0]
    assert len(found) > 0.7 * keyframe.disparity.size
    assert np.median(found) == 8 * 16
    assert np.median(depth_metres(keyframe)[keyframe.disparity > 0]) == pytest.approx(350 / 8)
    assert keyframe.T_world_camera[2, 3] == 2
    assert lidar[2].T_world_camera[:3, 3] == pytest.approx([2, 0, 0])  # forward is x for the scanner
    assert list(stereo.timestamps_ns) == [0, 100_000_000, 200_000_000, 300_000_000]


def test_a_street_has_larger_voxels_whatever_part_of_it_is_played(tmp_path):
    kitti(tmp_path)
    whole = open_dataset(tmp_path, modality="stereo")
    part = select(WithTrajectory(whole, tmp_path / "poses" / "06.txt"), limit=2)
    assert whole.usual == part.usual == RecordedSource(part).usual == {"voxel_size": 0.1}


def test_names_need_no_zeros_before_their_numbers(tmp_path):
    root = kitti(tmp_path, 12)
    for path in (root / "sequences" / "06").glob("*/*"):
        path.rename(path.with_stem(str(int(path.stem))))
    found = KITTI(root, "06")
    assert [keyframe.T_world_camera[2, 3] for keyframe in found] == list(range(12))
    assert found.timestamps_ns.tolist() == [frame * 10**8 for frame in range(12)]


def test_frames_beyond_the_poses_are_skipped_and_counted(tmp_path):
    root = kitti(tmp_path)
    (root / "poses" / "06.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3 + "\n")
    dataset = KITTI(root, "06", "lidar")
    assert (len(dataset), dataset.skipped) == (3, {"without a pose": 1})


def test_calibration_without_tr_serves_stereo_only(tmp_path):
    root = kitti(tmp_path)
    (root / "sequences" / "06" / "calib.txt").write_text(f"P0: {P0}\nP1: {P1}\n")
    assert len(KITTI(root, "06")) == 4
    with pytest.raises(
        DatasetError, match=r"calib\.txt has no usable line Tr; expected `Tr:` and 12 finite numbers"
    ):
        KITTI(root, "06", "lidar")


@pytest.mark.parametrize(
    ("modality", "name", "content", "match"),
    [
        ("stereo", "image_0/000000.png", None, LeftOut(r"image_1/000000\.png is left out", {NO_HALF: 1})),
        ("stereo", "image_0/copy.png", "x", r"copy\.png is not named by a frame number"),
        ("stereo", "calib.txt", "hello", r"calib\.txt:1: 'hello'; expected `name: numbers`"),
        ("stereo", "calib.txt", f"P0: {P0}\nP1: 1 2\n", r"no usable line P1; expected `P1:` and 12 finite"),
        ("stereo", "calib.txt", f"P0: {P1}\nP1: {P0}\n", r"P1 must lie to the right of P0"),
        ("stereo", "calib.txt", None, r"calib\.txt is missing; expected KITTI's calibration"),
        ("lidar", "calib.txt", f"Tr: 2{TR[1:]}\n", r"calib\.txt: Tr: T_world_camera must hold a rot"),
        (
            "lidar",
            "velodyne/000001.bin",
            b"12345",
            LeftOut(r"000001\.bin has 5 bytes, not 16 a point", UNREAD),
        ),
        ("stereo", POSES, None, r"poses/06\.txt is missing; expected 12 numbers a line"),
        ("stereo", POSES, "1 0 0 0 0 1 0 0 0 0 1 nan\n", r"06\.txt:1: not finite"),
        ("stereo", POSES, "1 0 0 0\n", r"06\.txt:1: 4 numbers, expected 12"),
        ("stereo", POSES, "1 0 0 0 0 1 0 0 0 0 1 zero\n", r"06\.txt:1: could not convert .*zero"),
        ("stereo", POSES, "1 0 0 0 0 1 0 0 0 0 9 0\n", r"06\.txt, pose 0: T_world_camera must hold"),
        ("stereo", "times.txt", "0\n", r"times\.txt has 1 lines, but there is a frame 3"),
        ("radar", "README", "", r"modality of KITTI must be stereo or lidar, got 'radar'"),
    ],
)
def test_a_broken_sequence_is_one_clear_line(tmp_path, modality, name, content, match):
    root = kitti(tmp_path)
    put(name, content)(root / "sequences" / "06")
    one_line_of(lambda: KITTI(root, "06", modality), match)


def test_which_sequence_must_be_clear(tmp_path):
    root = kitti(tmp_path)
    with pytest.raises(DatasetError, match=r"sequences/99 does not exist"):
        KITTI(root, "99")
    shutil.copytree(root / "sequences" / "06", root / "sequences" / "07")
    with pytest.raises(
        DatasetError, match=r"holds 2 KITTI sequences with data \(06, 07\); name one with --sequence"
    ):
        open_dataset(root)
    assert open_dataset(root / "sequences" / "06").name == "KITTI 06 stereo"
    listed = json.loads(tsfusion("datasets", root, "--json").stdout)
    assert [row["path"] for row in listed] == [str(root / "sequences" / name) for name in ("06", "07")]


def test_the_matcher_against_ground_truth(data):
    place = data("middlebury_motorcycle")
    left, right = (
        cv2.imread(str(place / f"motorcycle_{side}.png"), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")
    )
    truth = np.load(place / "motorcycle_disp.npz")["arr_0"]
    disparity = Matcher()(left, right)
    both = np.isfinite(truth) & (disparity > 0)
    error = np.abs(disparity / 16 - truth)[both]
    assert both.sum() > 0.85 * np.isfinite(truth).sum()
    assert np.median(error) < 0.2
    assert (error > 1).mean() < 0.07


def test_the_matcher_is_silent_where_there_is_nothing_to_match():
    rng = np.random.default_rng(0)
    left, right = (rng.integers(0, 256, (60, 200)).astype(np.uint8) for _ in range(2))
    assert (Matcher()(left, right) > 0).mean() < 0.02
    assert Matcher()(left, right).dtype == np.uint16


def test_reading_loads_nothing_that_pykittis_package_does(data):
    code = (
        "import sys; from tsfusion.datasets import open_dataset; "
        "open_dataset(sys.argv[1], sequence='06')[0]; "
        "sys.exit(' '.join({'pykitti', 'pandas', 'matplotlib'} & set(sys.modules)) or None)"
    )
    done = python(code, data("kitti_odometry"))
    assert (done.returncode, done.stderr) == (0, "")


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
            r"calib_velo_to_cam\.txt: its axes are not those of KITTI's sensors",
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


def test_semantic_kitti_has_its_poses_in_the_sequence_and_labels_that_are_unused(tmp_path, caplog):
    root = kitti(tmp_path / "dataset")
    expected = [KITTI(root, "06", modality="lidar").pose(index) for index in range(4)]
    sequence = root / "sequences" / "06"
    (root / "poses" / "06.txt").rename(sequence / "poses.txt")
    for name in ("image_0", "image_1"):
        shutil.rmtree(sequence / name)
    (sequence / "labels").mkdir()
    for path in (root, sequence, tmp_path):
        dataset = open_dataset(path)
        assert dataset.sensor == "lidar"
        np.testing.assert_array_equal([dataset.pose(index) for index in range(4)], expected)
    assert "06: the labels are not used; what moves is fused, too" in caplog.text
