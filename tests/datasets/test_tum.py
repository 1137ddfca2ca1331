# SPDX-License-Identifier: MIT
"""TUM RGB-D, its relatives, and poses between poses."""

from pathlib import Path

import numpy as np
import pytest
from geometry_checks import move
from small_recordings import corbs

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import TUM, open_dataset
from tsfusion.datasets.trajectory_files import nanoseconds, read_tum
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.trajectory import Trajectory, rigid, slerp

scipy_spatial = pytest.importorskip("scipy.spatial")

SECOND = 1_000_000_000


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


def test_corbs_camera_follows_the_image_size(tmp_path):
    half = TUM(corbs(tmp_path / "half", shape=(240, 320)))
    assert half.intrinsics == Intrinsics(468.60, 468.61, 318.27, 243.99).scaled(0.5)
    wide = corbs(tmp_path / "wide", shape=(270, 480))
    with pytest.raises(
        DatasetError, match="depth images of 480×270, but the CoRBS camera is known for 640×480 only"
    ):
        TUM(wide)
    assert TUM(wide, intrinsics=Intrinsics(300, 300, 240, 135))[0].intrinsics.cx == 240


def test_a_gap_in_the_trajectory_is_not_bridged(tmp_path):
    place = corbs(tmp_path)
    lines = (tmp_path / "D1_Trajectory" / "groundtruth.txt").read_text().splitlines()
    (tmp_path / "D1_Trajectory" / "groundtruth.txt").write_text("\n".join(lines[:3] + lines[6:]))
    assert TUM(place).skipped == {"without a pose in time": 3}
    assert TUM(place, max_gap_s=0.3).skipped == {"without a pose in time": 1}


def _edit(name: str, old: str, new: str):
    def change(place: Path) -> None:
        path = place / name
        path.write_bytes(path.read_bytes().replace(old.encode(), new.encode()))

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            lambda p: (p / "depth" / "3.png").unlink(),
            r"3\.png is missing \(1 of 5 images that .*depth\.txt lists\)",
        ),
        (
            lambda p: (p / "rgb" / "3.png").unlink(),
            r"3\.png is missing \(1 of 5 images that .*rgb\.txt lists\)",
        ),
        (
            _edit("depth.txt", "1000.100000 depth", "1000.100000depth"),
            r"depth\.txt:4: .*expected `timestamp path`",
        ),
        (_edit("depth.txt", "1000.100000", "then"), r"depth\.txt:4: timestamp must be seconds, got 'then'"),
        (lambda p: (p / "depth.txt").write_text("# nothing\n"), r"depth\.txt lists no images"),
        (_edit("../D1_Trajectory/groundtruth.txt", " 2 0 0", " nan 0 0"), r"groundtruth\.txt:5: not finite"),
        (
            _edit("../D1_Trajectory/groundtruth.txt", " 2 0 0", " 2 0"),
            r"groundtruth\.txt:5: 7 numbers, expected 8",
        ),
        (
            _edit("../D1_Trajectory/groundtruth.txt", "2 0 0 0 0 0 1", "2 0 0 0 0 0 0"),
            r":5: quaternion must have",
        ),
        (
            _edit("../D1_Trajectory/groundtruth.txt", "1000", "2000"),
            r"no usable frames.*\(5 without a pose in time\)",
        ),
        (
            lambda p: (p / "../D1_Trajectory/groundtruth.txt").unlink(),
            r"groundtruth\.txt is missing; expected .*trajectory",
        ),
    ],
)
def test_a_broken_recording_is_one_clear_line(tmp_path, change, match):
    place = corbs(tmp_path)
    change(place)
    with pytest.raises(DatasetError, match=match) as caught:
        TUM(place)
    assert "\n" not in str(caught.value)


def test_freiburg_images_are_associated_by_time(data, tmp_path):
    place = data("tum_rgbd/rgbd_dataset_freiburg1_360")
    poses = tmp_path / "orb.txt"
    poses.write_text("".join(f"{1305031790.6 + 0.05 * i:.4f} {i} 0 0 0 0 0 1\n" for i in range(8)))
    dataset = TUM(place, trajectory=poses)
    assert (len(dataset), dataset.uncolored, dataset.skipped) == (5, 0, {})
    assert dataset.intrinsics == Intrinsics(517.3, 516.5, 318.6, 255.3)
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


def test_slerp_takes_the_short_way_at_even_speed():
    def turn(degrees: float) -> np.ndarray:
        half = np.radians(degrees) / 2
        return np.array([0, 0, np.sin(half), np.cos(half)])

    rotations = scipy_spatial.transform.Rotation
    for share in (0.0, 0.25, 0.5, 1.0):
        for sign in (1, -1):
            mixed = slerp(turn(10), sign * turn(130), share)
            np.testing.assert_allclose(
                rigid(mixed, np.zeros(3)), rigid(turn(10 + 120 * share), np.zeros(3)), atol=1e-12
            )
    np.testing.assert_allclose(
        rigid(turn(33), np.zeros(3))[:3, :3], rotations.from_quat(turn(33)).as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(slerp(turn(5), turn(5), 0.3), turn(5))


def test_a_trajectory_is_never_extrapolated():
    stamps = np.array([10, 20, 30], dtype=np.int64) * SECOND
    still = Trajectory(stamps, np.arange(9.0).reshape(3, 3), np.tile([0.0, 0, 0, 1], (3, 1)))
    middle = still.at(15 * SECOND, max_gap_ns=10 * SECOND)
    np.testing.assert_allclose(middle[:3, 3], [1.5, 2.5, 3.5])
    assert still.at(15 * SECOND, max_gap_ns=9 * SECOND) is None
    assert still.at(9 * SECOND, max_gap_ns=99 * SECOND) is None
    assert still.at(31 * SECOND, max_gap_ns=99 * SECOND) is None
    for exact in (10, 20, 30):
        np.testing.assert_allclose(still.at(exact * SECOND, max_gap_ns=1)[0, 3], (exact - 10) * 0.3)


def test_stamps_keep_every_digit():
    here = Path("list.txt")
    assert nanoseconds("1305031790.645155", here, 1) == 1305031790645155000
    assert nanoseconds("1.5e3", here, 1) == 1500 * SECOND
    assert nanoseconds("7", here, 1) == 7 * SECOND
    for bad in ("-1", "nan", "inf", "x", ""):
        with pytest.raises(DatasetError, match=r"list\.txt:1: timestamp must be seconds"):
            nanoseconds(bad, here, 1)
