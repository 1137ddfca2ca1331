# SPDX-License-Identifier: MIT
"""ROS recordings of every form come back bit for bit; found, read one message at a time, damaged."""

import logging
import random
import sqlite3
import sys
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from keyframes_and_servers import CAMERA, SHAPE, pose, wall
from known_turns import BIAS, R_SENSOR_IMU, assert_known, attitude, samples
from mcap.writer import CompressionType, Writer
from rosbag_scenes import DEPTH, FRAME_NS, T0, T_BODY_OPTICAL, infos, journal_of, only_depth, scan
from rosbag_writing import BODY, FORMS, OPTICAL, WORLD, BagWriter, writing

from tsfusion.cli import runs
from tsfusion.core.errors import DatasetError, MissingDependency
from tsfusion.datasets import open_dataset
from tsfusion.datasets.dataset import clock_parts
from tsfusion.datasets.rosbag.bag import Bag, recognises
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.journal import segment_path
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.journal.ros2_export import export
from tsfusion.pipelines.report import shortfall

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


@pytest.mark.parametrize("form", ["ros1", "mcap"])
def test_an_imu_on_the_robot_tells_each_frame_its_up(tmp_path: Path, form: str) -> None:
    T_body_imu = se3.exp(np.array([0.2, 0.1, 0, 0.5, 1.5, -0.4]))
    keyframes = [wall(index) for index in range(3)]
    with writing(tmp_path, form) as (bag, path):
        scan(bag, keyframes)
        bag.transform(T_body_imu, BODY, "imu_link", T0, static=True)
        for index, keyframe in enumerate(keyframes):
            T_world_imu = keyframe.T_world_camera @ se3.inverse(T_BODY_OPTICAL) @ T_body_imu
            force, stamp = T_world_imu[:3, :3].T @ (0, 0, 9.81), T0 + index * FRAME_NS
            bag.imu("/imu/data", force, stamp, "imu_link")
            bag.imu("/gyro/sample", np.zeros(3), stamp, "imu_link", rate=np.array([0.0, 2.0, 0.0]))
            bag.imu("/a_model/imu", force[::-1], stamp, "imu_link", measured=False)
            bag.imu("/elsewhere/imu", force[::-1], stamp, "another_robot")
    dataset = open_dataset(path)
    for index in range(3):
        up = dataset.pose(index)[:3, :3] @ dataset.frame(index).specific_force
        assert up == pytest.approx((0, 0, 9.81), abs=0.1)  # the neighbours' are within 50 ms, too
    assert dataset.frame(1).specific_force == pytest.approx(dataset.frame(1).specific_force)
    turn = dataset.frame(1).turn_since(dataset.frame(0).attitude)
    assert se3.angle(se3.transform(turn, np.zeros(3))) == pytest.approx(2 * FRAME_NS / 1e9)


def realsense_turn(bag: BagWriter) -> None:
    """Depth and an inertial unit as librealsense records them: all in frame 0, each quantity on its topic."""
    for number, (seconds, force, rate) in enumerate(samples()):
        frame, stamp, place = "0", T0 + round(seconds * 1e9), "/device_0/sensor_2/"
        turned = R_SENSOR_IMU @ (rate - BIAS)
        bag.imu(f"{place}Accel_0/imu/data", R_SENSOR_IMU @ force, stamp, frame)
        bag.imu(f"{place}Gyro_0/imu/data", np.zeros(3), stamp, frame, rate=turned)
        if number % 7 == 3:
            topic = "/device_0/sensor_0/Depth_0/"
            bag.camera_info(f"{topic}info/camera_info", CAMERA, SHAPE, stamp)
            bag.image(f"{topic}image/data", wall().measurement, "mono16", stamp + 1_000_000, frame="0")


def test_a_realsense_s_own_recording_tells_turns_and_up(tmp_path: Path) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        realsense_turn(bag)
    dataset = open_dataset(path, posed=False)
    frames = [dataset.frame(index) for index in range(len(dataset))]
    assert_known(((frame.timestamp_ns - T0) / 1e9, frame.attitude) for frame in frames)
    assert attitude(0) @ frames[5].specific_force == pytest.approx((0, 0, 9.81), abs=0.01)


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


# --- telling recordings apart ---


def walls(folder: Path, form: str = "mcap", count: int = 3) -> Path:
    with writing(folder, form) as (bag, path):
        scan(bag, [wall(i) for i in range(count)])
    return path


def test_a_journal_and_a_ros_recording_are_told_apart(tmp_path: Path) -> None:
    place = journal_of(tmp_path, [wall(i) for i in range(2)])
    segment = segment_path(place.path, 1)
    export(place, tmp_path / "out.mcap", lambda _done, _all: None)
    bag = walls(tmp_path)
    for journaled in (tmp_path, place.path, segment):
        assert isinstance(runs.open_recording(journaled), JournalRecording)
        assert not recognises(journaled) or journaled == tmp_path
    for recorded in (tmp_path / "out.mcap", bag, bag / "recorded.mcap"):
        assert isinstance(runs.open_recording(recorded), Bag)
    with pytest.raises(DatasetError, match=r"a ROS recording .*reads a journal of tsfusion"):
        Bag(segment)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(segment.read_bytes()[:20])
    assert not recognises(torn)


# --- files and folders ---


def test_lone_files_and_folders_of_one_are_taken(tmp_path: Path) -> None:
    for form, name in (("sqlite3", "recorded.db3"), ("mcap", "recorded.mcap"), ("ros1", "recorded.bag")):
        path = walls(tmp_path / form, form)
        (path / "metadata.yaml").unlink() if path.is_dir() else None
        for given in (path / name if path.is_dir() else path, path, path.parent):
            assert len(open_dataset(given)) == 3, given
    (tmp_path / "two").mkdir()
    for form, name in (("ros1", "recorded.bag"), ("sqlite3", "recorded/recorded.db3")):
        (tmp_path / "two" / Path(name).name).write_bytes((tmp_path / form / name).read_bytes())
    with pytest.raises(DatasetError, match="holds 2 files"):
        Bag(tmp_path / "two")


def test_a_recording_without_definitions_is_read_by_the_usual_ones(tmp_path: Path) -> None:
    path = walls(tmp_path, "sqlite3")
    with sqlite3.connect(path / "recorded.db3") as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert np.array_equal(open_dataset(path)[1].measurement, wall(1).measurement)


def test_an_mcap_file_without_index_is_read_and_said_to_be_slow(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rewritten(walls(tmp_path) / "recorded.mcap", tmp_path / "plain.mcap", use_chunking=False,
              use_summary_offsets=False, use_statistics=False, repeat_channels=False, repeat_schemas=False,
              index_types=0)  # fmt: skip
    with caplog.at_level(logging.WARNING):
        found = open_dataset(tmp_path / "plain.mcap")
    assert "has no index" in caplog.text
    for i in (2, 0, 1):
        assert np.array_equal(found[i].measurement, wall(i).measurement)


def rewritten(
    path: Path, out: Path, *, profile: str = "ros2", encoding: str = "ros2msg", **form: Any
) -> None:
    """Another MCAP file with the same messages."""
    from mcap.reader import make_reader
    from mcap.writer import IndexType

    if "index_types" in form:
        form["index_types"] = IndexType(form["index_types"])
    with path.open("rb") as file, out.open("wb") as copy:
        writer = Writer(copy, compression=CompressionType.NONE, **form)
        writer.start(profile=profile, library="test")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", kind)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


def test_frames_are_read_one_at_a_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(1, 5000, (60, 240, 320), dtype=np.uint16)  # 9 MB that do not shrink
    with writing(tmp_path, "mcap") as (bag, path):
        infos(bag, shape=images.shape[1:])
        for i, image in enumerate(images):
            bag.transform(pose(i), WORLD, OPTICAL, T0 + i * FRAME_NS)
            bag.image(DEPTH, image, "16UC1", T0 + i * FRAME_NS)
    found = open_dataset(path)
    found[0]
    tracemalloc.start()
    try:
        for i in rng.permutation(60):
            assert np.array_equal(found[int(i)].measurement, images[i])
        assert tracemalloc.get_traced_memory()[1] < 6e6
    finally:
        tracemalloc.stop()


# --- when it cannot be read ---


@pytest.mark.parametrize("form", ["ros1", "ros1-lz4", "sqlite3", "mcap"])
def test_damage_is_one_clear_error_or_no_matter(tmp_path: Path, form: str) -> None:
    path = walls(tmp_path, form)
    file = next(path.glob("recorded.*")) if path.is_dir() else path
    whole, rng = file.read_bytes(), random.Random(form)
    errors = []
    for case in range(60):
        content = bytearray(whole[: rng.randrange(1, len(whole))] if case % 2 else whole)
        if not case % 2:
            for _ in range(rng.choice([1, 30])):
                content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        file.write_bytes(content)
        try:
            found = Bag(path)
            for i in range(len(found)):
                found[i]
            errors.append("")
        except DatasetError as error:
            errors.append(str(error))
    assert any(errors)
    assert not any("\n" in error for error in errors)


def test_empty_and_foreign_files_are_named(tmp_path: Path) -> None:
    bag = walls(tmp_path) / "recorded.mcap"
    rewritten(bag, tmp_path / "ros1.mcap", profile="ros1")
    rewritten(bag, tmp_path / "proto.mcap", encoding="protobuf")
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "cut.mcap").write_bytes(bag.read_bytes()[:-100])
    with writing(tmp_path, "ros1") as (_, nothing):
        pass
    for path, message in (
        (tmp_path / "ros1.mcap", "only MCAP files of the profile ros2"),
        (tmp_path / "proto.mcap", "protobuf"),
        (tmp_path / "empty.mcap", "does not begin as a ROS recording"),
        (tmp_path / "cut.mcap", "mcap recover"),
        (nothing, "it holds no messages"),
        (tmp_path / "missing.bag", "does not exist"),
    ):
        with pytest.raises(DatasetError, match=message):
            Bag(path)


def test_without_rosbags_the_error_names_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = walls(tmp_path)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(MissingDependency, match=r"pip install '.\[ros\]'"):
        open_dataset(path)


# --- a clock that steps back ---


def walk(folder: Path, form: str, back_ns: int) -> Path:
    """20 walls a frame apart, each at its place; from the eleventh on all stamps are earlier."""
    with writing(folder, form) as (bag, path):
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
        for index in range(20):
            back = back_ns if index >= 10 else 0
            keyframe, stamp = wall(index), T0 + index * FRAME_NS - back
            infos(bag, stamp)
            bag.transform(keyframe.T_world_camera @ se3.inverse(T_BODY_OPTICAL), WORLD, BODY, stamp)
            bag.image(DEPTH, keyframe.measurement, "16UC1", stamp)
            bag.imu(
                "/imu/data",
                np.array([0, -9.0 - index / 10, 0]),
                stamp,
                OPTICAL,
                rate=np.array([0.0, 1.0, 0.0]),
            )
    return path


@pytest.mark.parametrize("form", ["ros1", "ros1-lz4", "sqlite3", "mcap", "mcap-storage"])
def test_a_clock_that_steps_back_cuts_the_recording(tmp_path: Path, form: str) -> None:
    path = walk(tmp_path, form, 5 * FRAME_NS)
    first, second = open_dataset(path), open_dataset(path, part=2)
    reason = f"after the clock of {DEPTH} stepped back by 0.13 s (--option part=2 reads them instead)"
    assert first.skipped == {reason: 10}
    assert shortfall.of_clock(first.skipped) == f"10 frames are not in the map: {reason}"
    assert second.skipped == {"of other parts": 10}
    assert shortfall.of_clock(second.skipped) == ""
    for index in range(10):
        for found, number in ((first, index), (second, 10 + index)):
            np.testing.assert_array_equal(found[index].measurement, wall(number).measurement)
            np.testing.assert_allclose(found[index].T_world_camera, wall(number).T_world_camera, atol=1e-9)
            assert -9.0 - found.frame(index).specific_force[1] == pytest.approx(number / 10, abs=0.11)
        turn = found.frame(index).turn_since(found.frame(0).attitude)
        assert se3.angle(se3.transform(turn, np.zeros(3))) == pytest.approx(index * FRAME_NS / 1e9)
    with pytest.raises(DatasetError, match="has 2 parts, got part=3"):
        open_dataset(path, part=3)


def test_a_clock_set_back_by_a_day_mixes_nothing(tmp_path: Path) -> None:
    found = open_dataset(walk(tmp_path, "ros1", 86_400 * 10**9))
    assert (len(found), found.skipped) == (20, {})


@pytest.mark.parametrize(
    ("order", "parts"),
    [
        (range(40), 1),
        ([*range(20), 18, *range(20, 40)], 1),  # one that came late
        ([*range(20), *range(10, 30)], 2),
        ([*range(20), *range(10, 30), *range(25, 35)], 3),
        ([*range(20, 40), *range(20)], 1),  # sorted as text, for instance
        (np.random.default_rng(1).permutation(40), 1),
        ([], 1),
    ],
)
def test_parts_of_a_series(order: Sequence[int], parts: int) -> None:
    found = clock_parts([100_000_000 * number for number in order])
    assert len(found) == parts
    assert [number for part in found for number in list(order)[part]] == list(order)


# --- files that end early ---


@pytest.mark.parametrize(
    ("form", "cure"),
    [("ros1", "rosbag reindex"), ("mcap", "mcap recover"), ("sqlite3", "sqlite3 FILE .recover")],
)
def test_a_recording_that_was_cut_names_its_cure(tmp_path: Path, form: str, cure: str) -> None:
    path = walk(tmp_path, form, 0)
    file = path if path.is_file() else next(path.glob("*.[dm]*[!l]"))
    whole = file.read_bytes()
    for share in (0.1, 0.4, 0.7, 0.95, 0.999):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(DatasetError, match=cure):
            open_dataset(path)
