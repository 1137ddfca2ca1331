# SPDX-License-Identifier: MIT
"""ROS recordings of every form, written by rosbags from real frames, come back bit for bit."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from keyframes_and_servers import SHAPE, pose, wall
from rosbag_scenes import DEPTH, FRAME_NS, T0, journal_of, only_depth, scan
from rosbag_writing import FORMS, BagWriter, writing

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import open_dataset
from tsfusion.datasets.rosbag.dataset import Bag
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.journal.recording import JournalRecording
from tsfusion.journal.ros2_export import export

pytest.importorskip("rosbags")

Data = Callable[[str], Path]


def test_images_of_a_late_clock_take_the_poses_of_their_time(tmp_path: Path) -> None:
    found = only_depth(
        tmp_path, lambda bag: bag.image(DEPTH, wall().measurement, "16UC1", T0 - 10**9), time_offset_s=1.05
    )
    assert np.allclose(found[0].T_world_camera[:3, 3], (pose(1.0) + pose(2.0))[:3, 3] / 2, atol=1e-6)


def test_what_cannot_be_told_apart_or_is_of_another_size_is_counted(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        for stamp in (T0 + 5, T0 + 5, T0 + 10**7):
            bag.image(DEPTH, wall().measurement, "16UC1", stamp)
        bag.image(DEPTH, np.ones((2 * SHAPE[0], SHAPE[1]), np.uint16), "16UC1", T0 + 2 * 10**7)

    found = only_depth(tmp_path, write)
    assert len(found) == 2
    assert found.skipped == {f"of {DEPTH} with another's time": 1, f"of {DEPTH} that are broken": 1}


# --- every form, and both kinds of sensors ---


@pytest.mark.parametrize("form", FORMS)
def test_a_kinect_recording_comes_back_bit_for_bit(data: Data, tmp_path: Path, form: str) -> None:
    kitchen = open_dataset(data("7scenes/redkitchen"))
    keyframes = [kitchen[i] for i in range(4)]
    with writing(tmp_path, form) as (bag, path):
        scan(bag, keyframes)
    found = open_dataset(path)
    assert isinstance(found, Bag)
    assert (len(found), found.sensor, found.skipped, found.uncolored) == (4, "kinect", {}, 0)
    for i in (2, 0, 3, 1):  # in any order
        assert np.array_equal(found[i].measurement, keyframes[i].measurement)
        assert np.array_equal(found[i].color, keyframes[i].color)
        assert found[i].depth_scale == 0.001
        assert found[i].intrinsics == keyframes[i].intrinsics
        assert np.allclose(found[i].T_world_camera, keyframes[i].T_world_camera, atol=1e-9, rtol=0)
        assert found[i].timestamp_ns == T0 + i * FRAME_NS


@pytest.mark.parametrize("form", ["ros1", "mcap"])
@pytest.mark.parametrize("big", [False, True])
def test_a_lidar_recording_comes_back_bit_for_bit(data: Data, tmp_path: Path, form: str, big: bool) -> None:
    drive = open_dataset(data("kitti_odometry"), sequence="00", modality="lidar")
    order = ">" if big else "<"
    dtype = np.dtype({"names": ["intensity", "z", "t", "x", "y"],
                      "formats": [order + kind for kind in ("u2", "f4", "u4", "f8", "f4")],
                      "offsets": [0, 6, 10, 16, 24], "itemsize": 33})  # fmt: skip
    with writing(tmp_path, form) as (bag, path):
        for i in range(2):
            points = drive[i].measurement[:120_000].reshape(10, 12_000, 3)
            records = np.zeros(points.shape[:2], dtype)
            for axis, name in enumerate("xyz"):
                records[name] = points[..., axis]
            records["t"] = np.linspace(0, 1e8, records.size).reshape(records.shape)
            bag.cloud("/velodyne_points", records, T0 + i * 10**8, big=big, padding=7)
            bag.odometry("/odom", drive[i].T_world_camera, "odom", "velodyne", T0 + i * 10**8)
    found = open_dataset(path)
    assert (len(found), found.sensor) == (2, "lidar")
    for i in range(2):
        frame = found.frame(i)  # type: ignore[attr-defined]
        assert np.array_equal(frame.points, drive[i].measurement[:120_000])
        assert np.allclose(frame.point_times_s, np.linspace(0, 0.1, 120_000), atol=1e-7)
        assert np.allclose(frame.T_world_camera, drive[i].T_world_camera, atol=1e-9, rtol=0)


def test_a_stereo_recording_comes_back_as_pairs(data: Data, tmp_path: Path) -> None:
    drive = open_dataset(data("kitti_odometry"), sequence="06")
    with writing(tmp_path, "mcap") as (bag, path):
        for i in range(3):
            frame = drive.frame(i)  # type: ignore[attr-defined]
            stamp = T0 + i * 10**8
            for side, image in (("left", frame.left), ("right", frame.right)):
                bag.camera_info(f"/kitti/{side}/camera_info", frame.intrinsics, frame.shape, stamp,
                                baseline_fx=frame.baseline_fx if side == "right" else 0.0)  # fmt: skip
                if (i, side) != (1, "right"):  # lost on the way
                    bag.image(f"/kitti/{side}/image_rect", image, "mono8", stamp)
    found = Bag(path, posed=False)
    assert (len(found), found.sensor) == (2, "stereo")
    assert found.skipped == {"without a right image in time": 1}
    for index, i in enumerate((0, 2)):
        read, written = found.frame(index), drive.frame(i)  # type: ignore[attr-defined]
        assert np.array_equal(read.left, written.left)
        assert np.array_equal(read.right, written.right)
        assert (read.intrinsics, read.baseline_fx) == (written.intrinsics, pytest.approx(written.baseline_fx))
        assert read.T_world_camera is None
    with pytest.raises(DatasetError, match="no pose; `tsfusion scan"):
        found[0]


def test_an_exported_journal_comes_back_equal(data: Data, tmp_path: Path) -> None:
    kitchen = open_dataset(data("7scenes/redkitchen"))
    drive = open_dataset(data("kitti_odometry"), sequence="00", modality="lidar")
    painted = np.random.default_rng(1).integers(0, 256, (len(drive[0].measurement), 3)).astype(np.uint8)
    painting = Keyframe(T_world_camera=drive[0].T_world_camera, points=drive[0].points, color=painted)
    for name, keyframes in (("kitchen", [kitchen[i] for i in range(5)]), ("car", [painting, drive[1]])):
        place = journal_of(tmp_path / name, keyframes)
        out = tmp_path / f"{name}.mcap"
        export(place, out, lambda _done, _all: None)
        journaled, found = JournalRecording(place.path), open_dataset(out)
        assert len(found) == len(journaled)
        for read, written in zip(found, journaled, strict=True):
            assert np.array_equal(read.measurement, written.measurement, equal_nan=True)
            assert read.measurement.dtype == written.measurement.dtype
            assert (read.color is None) == (written.color is None)
            assert written.color is None or np.array_equal(read.color, written.color)
            assert read.intrinsics == written.intrinsics
            assert np.allclose(read.T_world_camera, written.T_world_camera, atol=1e-9, rtol=0)
