# SPDX-License-Identifier: MIT
"""ROS recordings of every form, written by rosbags from real frames: what is read is what was written."""

import builtins
import logging
import random
import sqlite3
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from keyframes_and_servers import CAMERA, SHAPE, pose, wall
from mcap.writer import CompressionType, Writer
from rosbag_writing import BODY, FORMS, OPTICAL, WORLD, BagWriter, jpeg, writing

from tsfusion.cli import replay
from tsfusion.core.errors import DatasetError, MissingDependency
from tsfusion.datasets import open_dataset
from tsfusion.datasets.rosbag.dataset import Bag, recognises
from tsfusion.datasets.rosbag.transforms import PoseSamples
from tsfusion.geometry import se3
from tsfusion.geometry.calibration import Camera, Rectifier, StereoRig, Undistorter
from tsfusion.geometry.depth_registration import Registration
from tsfusion.geometry.keyframe import Intrinsics, Keyframe
from tsfusion.journal import Journal, segment_path
from tsfusion.journal.recording import JournalRecording
from tsfusion.journal.ros2_export import export
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.wire import codec

pytest.importorskip("rosbags")

Data = Callable[[str], Path]
T0, FRAME_NS = 1_700_000_000_123_456_789, 33_333_333
T_BODY_OPTICAL = se3.exp(np.array([0.1, -0.05, 0.3, 1.2, -1.1, 1.3]))
DEPTH, COLOR = "/camera/depth_registered/image_rect", "/camera/rgb/image_rect_color"


def infos(bag: BagWriter, stamp: int = T0, shape: tuple[int, ...] = SHAPE, camera: Any = CAMERA) -> None:
    for topic in (DEPTH, COLOR):
        bag.camera_info(topic.rpartition("/")[0] + "/camera_info", camera, shape, stamp)


def scan(bag: BagWriter, keyframes: list[Keyframe]) -> None:
    """Depth, colour and a robot that carries the camera."""
    bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
    for i, keyframe in enumerate(keyframes):
        stamp = T0 + i * FRAME_NS
        assert keyframe.color is not None
        infos(bag, stamp, keyframe.shape, keyframe.intrinsics)
        bag.transform(keyframe.T_world_camera @ se3.inverse(T_BODY_OPTICAL), WORLD, BODY, stamp)
        bag.image(DEPTH, keyframe.measurement, "16UC1", stamp)
        bag.image(COLOR, keyframe.color[..., ::-1], "rgb8", stamp + 1_000_000)


def walls(folder: Path, form: str = "mcap", count: int = 3) -> Path:
    with writing(folder, form) as (bag, path):
        scan(bag, [wall(i) for i in range(count)])
    return path


def only_depth(folder: Path, write: Callable[[BagWriter], None], **options: Any) -> Bag:
    """A recording of what `write` writes besides a camera and a place."""
    with writing(folder, "ros1") as (bag, path):
        infos(bag)
        bag.transform(pose(1.0), WORLD, OPTICAL, T0)
        bag.transform(pose(2.0), WORLD, OPTICAL, T0 + 10**8)
        write(bag)
    return Bag(path, **options)


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


def journal_of(folder: Path, keyframes: list[Keyframe]) -> JournalPlace:
    log, session = Journal(folder / "journal", 1 << 30, sync=False), bytes(range(16))
    for seq, keyframe in enumerate(keyframes, 1):
        frames = codec.encode(keyframe, session=session, seq=seq, jpeg_quality=90)
        log.append(frames, session=session, seq=seq, client="scanner", logged_ns=T0 + seq * 10**8)
    log.close()
    return JournalPlace(folder / "journal")


def test_a_journal_and_a_ros_recording_are_told_apart(tmp_path: Path) -> None:
    place = journal_of(tmp_path, [wall(i) for i in range(2)])
    segment = segment_path(place.path, 1)
    export(place, tmp_path / "out.mcap", lambda _done, _all: None)
    bag = walls(tmp_path)
    for journaled in (tmp_path, place.path, segment):
        assert isinstance(replay.open_recording(journaled), JournalRecording)
        assert not recognises(journaled) or journaled == tmp_path
    for recorded in (tmp_path / "out.mcap", bag, bag / "recorded.mcap"):
        assert isinstance(replay.open_recording(recorded), Bag)
    with pytest.raises(DatasetError, match="is a journal of tsfusion"):
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
                assert schema is not None
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


# --- images ---

_BGR = np.random.default_rng(2).integers(0, 256, (*SHAPE, 3)).astype(np.uint8)
_GRAY = _BGR[..., 0]
_WITH_ALPHA = np.dstack([_BGR, np.full(SHAPE, 9, np.uint8)])


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "stored", "expected"),
    [
        ("bgr8", _BGR, _BGR),
        ("rgb8", _BGR[..., ::-1], _BGR),
        ("bgra8", _WITH_ALPHA, _BGR),
        ("rgba8", _WITH_ALPHA[..., [2, 1, 0, 3]], _BGR),
        ("mono8", _GRAY, np.dstack([_GRAY] * 3)),
        ("8UC3", _BGR, _BGR),
    ],
)
def test_colour_encodings(
    tmp_path: Path, encoding: str, stored: np.ndarray, expected: np.ndarray, padding: int
) -> None:
    def write(bag: BagWriter) -> None:
        bag.image(DEPTH, wall().measurement, "16UC1", T0)
        bag.image(COLOR, stored, encoding, T0, padding=padding)

    assert np.array_equal(only_depth(tmp_path, write)[0].color, expected)


@pytest.mark.parametrize(("encoding", "first"), [("yuv422", 1), ("yuv422_yuy2", 0)])
def test_yuv_is_read(tmp_path: Path, encoding: str, first: int) -> None:
    stored = np.full((*SHAPE, 2), 128, np.uint8)
    stored[..., first if encoding != "yuv422" else 1] = 180  # luminance

    def write(bag: BagWriter) -> None:
        bag.image(DEPTH, wall().measurement, "16UC1", T0)
        bag.image(COLOR, stored, encoding, T0)

    color = only_depth(tmp_path, write)[0].color
    assert color is not None
    assert np.ptp(color) == 0  # grey
    assert abs(int(color[0, 0, 0]) - round(1.164 * (180 - 16))) <= 1


@pytest.mark.parametrize(
    ("pattern", "red"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))]
)
def test_bayer_patterns_have_red_where_they_say(tmp_path: Path, pattern: str, red: tuple[int, int]) -> None:
    stored = np.zeros(SHAPE, np.uint8)
    stored[red[0] :: 2, red[1] :: 2] = 200

    def write(bag: BagWriter) -> None:
        bag.image(DEPTH, wall().measurement, "16UC1", T0)
        bag.image(COLOR, stored, f"bayer_{pattern}8", T0)

    color = only_depth(tmp_path, write)[0].color
    assert color is not None
    assert color[5:-5, 5:-5].reshape(-1, 3).mean(axis=0) == pytest.approx([0, 0, 200], abs=1)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 6])
def test_depth_encodings(tmp_path: Path, big: bool, padding: int) -> None:
    metres = np.where(wall().measurement > 0, wall().measurement * np.float32(0.00137), np.nan)

    def write(bag: BagWriter) -> None:
        bag.image(DEPTH, metres.astype(np.float32), "32FC1", T0, big=big, padding=2 * padding)
        bag.image(DEPTH, wall(1).measurement, "16UC1", T0 + FRAME_NS, big=big, padding=padding)
        bag.image(DEPTH, wall(2).measurement, "mono16", T0 + 2 * FRAME_NS, big=big, padding=padding)

    found = only_depth(tmp_path, write)
    assert np.array_equal(found[0].measurement, metres.astype(np.float32), equal_nan=True)
    for i in (1, 2):
        assert np.array_equal(found[i].measurement, wall(i).measurement)


def test_compressed_images(tmp_path: Path) -> None:
    import struct

    depth, color = wall().measurement, wall().color
    assert color is not None
    a, b = 100.0 * (100.0 + 1), 1 - 100.0 * 101.0 / 10  # of image_transport: quantisation 100, at most 10 m
    metres = depth * np.float32(0.001)
    inverse = np.where(depth > 0, np.round(a / np.maximum(metres, 0.1) + b), 0)

    def write(bag: BagWriter) -> None:
        first, second, third = T0, T0 + FRAME_NS, T0 + 2 * FRAME_NS
        name, head = f"{DEPTH}/compressedDepth", struct.pack("<iff", 0, a, b)
        bag.compressed(name, head + jpeg(depth, ".png"), "16UC1; compressedDepth png", first)
        bag.compressed(name, head + jpeg(inverse.astype(np.uint16), ".png"), "32FC1; compressedDepth", second)
        bag.compressed(name, jpeg(depth, ".png"), "16UC1; png compressed", third)
        bag.compressed(f"{COLOR}/compressed", jpeg(color), "rgb8; jpeg compressed bgr8", first)
        bag.compressed(f"{COLOR}/compressed", jpeg(color, ".png"), "png", second)

    found = only_depth(tmp_path, write)
    assert (len(found), found.uncolored) == (3, 1)
    assert np.array_equal(found[0].measurement, depth)
    assert np.array_equal(found[2].measurement, depth)
    read = found[1].measurement
    assert np.array_equal(np.isnan(read), depth == 0)
    step = metres[depth > 0] ** 2 / a  # what one step of the quantisation is at that depth
    assert (np.abs(read[depth > 0] - metres[depth > 0]) <= 0.51 * step).all()
    assert np.array_equal(found[1].color, color)
    assert found[0].color is not None
    assert np.abs(found[0].color.astype(int) - color).mean() < 4
    assert found[2].color is None


def test_an_image_that_cannot_be_decoded_is_named(tmp_path: Path) -> None:
    name, form = f"{DEPTH}/compressedDepth", "16UC1; compressedDepth"

    def write(bag: BagWriter, *, whole: bool = True) -> None:
        bag.compressed(name, bytes(50), form, T0)
        if whole:
            bag.compressed(name, bytes(12) + jpeg(wall().measurement, ".png"), form, T0 + FRAME_NS)

    found = only_depth(tmp_path, write)
    with pytest.raises(DatasetError, match=r"message 0 of .*compressedDepth of 50 bytes cannot be decoded"):
        found[0]
    assert np.array_equal(found[1].measurement, wall().measurement)
    with pytest.raises(DatasetError, match="compressedDepth cannot be decoded"):
        only_depth(tmp_path / "two", lambda bag: write(bag, whole=False), depth_topic=name)


def test_messages_that_do_not_fit_themselves_are_counted(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        bag.image(DEPTH, wall(0).measurement, "16UC1", T0)
        for i, wrong in enumerate(({"step": 20}, {"height": 49}, {"data": np.zeros(7, np.uint8)},
                                   {"width": 1 << 30}, {"encoding": "64FC7"}, {"height": 0}), 1):  # fmt: skip
            encoding = wrong.pop("encoding", "16UC1")
            bag.image(DEPTH, wall(i).measurement, encoding, T0 + i, **wrong)
        bag.image(DEPTH, wall(1).measurement, "16UC1", T0 + FRAME_NS)

    found = only_depth(tmp_path, write)
    assert len(found) == 2
    assert found.skipped == {f"of {DEPTH} that are broken": 6}
    assert np.array_equal(found[1].measurement, wall(1).measurement)


# --- clouds ---


def records(**columns: Any) -> np.ndarray:
    """One row of points with the columns given; x, y and z count up."""
    n = len(next(iter(columns.values()))) if columns else 4
    columns = {**{axis: np.arange(1, n + 1, dtype=np.float32) for axis in "xyz"}, **columns}
    table = np.zeros((1, n), [(name, np.asarray(column).dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return table


def of_cloud(folder: Path, table: np.ndarray, **wrong: Any) -> Any:
    with writing(folder, "sqlite3") as (bag, path):
        bag.cloud("/points", table, T0, **wrong)
    return Bag(path, posed=False).frame(0)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("kind", ["f4", "u4"])
def test_points_have_their_colours(tmp_path: Path, kind: str, big: bool) -> None:
    packed = np.array([0x00112233, 0x00445566, 0xFFFFFFFF, 0], np.uint32)
    table = records(rgb=packed.view(kind))
    if big:
        table = table.astype(table.dtype.newbyteorder(">"))
    frame = of_cloud(tmp_path, table, big=big)
    assert frame.color.tolist() == [[0x33, 0x22, 0x11], [0x66, 0x55, 0x44], [255] * 3, [0] * 3]


def test_points_without_a_return_are_not_numbers(tmp_path: Path) -> None:
    x = np.array([1, 0, np.nan, 2], np.float32)
    frame = of_cloud(tmp_path, records(x=x, y=x, z=x))
    assert np.isfinite(frame.points).all(axis=1).tolist() == [True, False, False, True]
    assert frame.point_times_s is None


@pytest.mark.parametrize(
    ("name", "column", "expected"),
    [
        ("t", np.array([0, 5e7, 1e8], np.uint32), [0, 0.05, 0.1]),  # Ouster: ns of the sweep
        ("time", np.array([-0.1, -0.05, 0], np.float32), [-0.1, -0.05, 0]),  # Velodyne
        ("timestamp", T0 * 1e-9 + np.array([0, 0.05, 0.1]), [0, 0.05, 0.1]),  # Hesai: absolute s
        ("timestamp", T0 + np.array([0, 5e7, 1e8]), [0, 0.05, 0.1]),  # Livox: absolute ns as float64
        ("timestamp", np.array([0, 50, 100], np.float64), [0, 0.05, 0.1]),  # ms
        ("offset_time", np.array([0, 50_000, 100_000], np.uint32), [0, 0.05, 0.1]),  # µs
        ("timestamp", 100 + np.array([7, 7.05, 7.1]), [0, 0.05, 0.1]),  # of another clock
        ("time", np.array([np.nan, 0, 0.1], np.float32), [0, 0, 0.1]),
        ("t", np.array([0, 0, 0], np.uint32), None),
        ("time", np.array([0, 1e12, 2e12]), None),
    ],
)
def test_points_have_their_times(tmp_path: Path, name: str, column: np.ndarray, expected: Any) -> None:
    times = of_cloud(tmp_path, records(**{name: column})).point_times_s
    if expected is None:
        assert times is None
    else:
        assert times.tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"row_step": 3}, {"point_step": 8}, {"height": 2}, {"data": np.zeros(5, np.uint8)}]
)
def test_clouds_that_do_not_fit_themselves_are_counted(tmp_path: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(DatasetError, match=r"no usable frames.*1 of /points that are broken"):
        of_cloud(tmp_path, records(), **wrong)


# --- poses ---


def turning(seconds: float) -> np.ndarray:
    """Where a body is that turns and moves evenly."""
    T = se3.exp(np.array([0, 0, 0, 0.3, -0.9, 1.1]) * seconds)
    T[:3, 3] = np.array([0.5, -0.2, 0.1]) * seconds
    return T


def moments(bag: BagWriter, *, count: int = 10) -> list[int]:
    """Depth images between the times at which `turning` is told, each 100 ms."""
    stamps = [T0 + 37_000_000 + i * 100_000_000 for i in range(count)]
    bag.camera_info("/camera/camera_info", CAMERA, SHAPE, T0)
    for i, stamp in enumerate(stamps):
        bag.image("/camera/depth", wall(i).measurement, "16UC1", stamp)
    return stamps


def check_turning(found: Bag, after: np.ndarray = T_BODY_OPTICAL, before: np.ndarray | None = None) -> None:
    assert len(found) == 10
    for keyframe in found:
        T = turning((keyframe.timestamp_ns - T0) * 1e-9) @ after
        expected = T if before is None else before @ T
        assert np.allclose(keyframe.T_world_camera, expected, atol=1e-9, rtol=0)


def test_transforms_are_chained_and_interpolated(tmp_path: Path) -> None:
    T_odom = se3.exp(np.array([3.0, 1, 0, 0, 0, 0.4]))
    with writing(tmp_path, "ros1") as (bag, path):
        moments(bag)
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, 0, static=True, log_ns=T0)
        for i in range(12):
            stamp = T0 + i * 100_000_000
            bag.transform(turning(i * 0.1), "odom", BODY, stamp)
            bag.transform(T_odom, "/map", "/odom", stamp + 10**9, log_ns=stamp)  # constant, of the future
            bag.transform(pose(i), BODY, "arm", stamp)
    check_turning(Bag(path), before=T_odom)
    check_turning(Bag(path, world_frame="odom"))
    with pytest.raises(DatasetError, match="no transforms lead from 'moon'"):
        Bag(path, world_frame="moon")


def test_no_pose_is_made_up_across_a_gap(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        stamps = moments(bag)
        for i in (0, 1, 2, 3, 7, 8):
            bag.transform(turning(i * 0.1), WORLD, OPTICAL, T0 + i * 100_000_000)
    found = Bag(path)
    assert found.skipped == {"without a pose in time": 6}
    assert found.timestamps_ns is not None
    assert found.timestamps_ns.tolist() == [stamps[i] for i in (0, 1, 2, 7)]
    everything = Bag(path, posed=False)
    known = [everything.frame(i).T_world_camera is not None for i in range(10)]
    assert [i for i in range(10) if known[i]] == [0, 1, 2, 7]
    assert len(Bag(path, max_gap_s=0.5)) == 8


def odometry(bag: BagWriter, topic: str = "/odom") -> None:
    for i in range(12):
        bag.odometry(topic, turning(i * 0.1), "odom", BODY, T0 + i * 100_000_000)


def test_odometry_is_carried_to_the_sensor(tmp_path: Path) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        moments(bag)
        odometry(bag)
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
        bag.transform(pose(5.0), "map", "odom", T0, static=True)
    check_turning(Bag(path))
    check_turning(Bag(path, world_frame="map"), before=pose(5.0))


@pytest.mark.parametrize("kind", ["pose", "covariance", "transform", "path"])
def test_other_topics_tell_poses_too(tmp_path: Path, kind: str) -> None:
    told = [(T0 + i * 100_000_000, turning(i * 0.1)) for i in range(12)]
    with writing(tmp_path, "mcap") as (bag, path):
        moments(bag)
        for i, (stamp, T) in enumerate(told):
            if kind == "pose":
                bag.write("/slam", bag.posed(T, "map", stamp), stamp)
            elif kind == "transform":
                bag.write("/slam", bag.stamped(T, "map", OPTICAL, stamp), stamp)
            elif kind == "path":
                bag.path("/slam", told[: i + 1], "map", stamp)
            else:
                within = bag.make("geometry_msgs/msg/PoseWithCovariance", pose=bag.pose(T),
                                  covariance=np.zeros(36))  # fmt: skip
                name, heading = "geometry_msgs/msg/PoseWithCovarianceStamped", bag.heading(stamp, "map")
                bag.write("/slam", bag.make(name, header=heading, pose=within), stamp)
    check_turning(Bag(path), after=np.eye(4))


def test_a_pose_topic_that_was_named_goes_before_the_transforms(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        moments(bag)
        odometry(bag)
        odometry(bag, "/other")
        for i in range(12):
            bag.transform(pose(i), WORLD, OPTICAL, T0 + i * 100_000_000)
    check_turning(Bag(path, pose_topic="/odom", body_frame=OPTICAL), after=np.eye(4))
    with pytest.raises(DatasetError, match="holds poses of 'base_link', and no transforms lead from there"):
        Bag(path, pose_topic="/odom")
    with pytest.raises(DatasetError, match=r"no topic of poses.*nav_msgs/Odometry, 12"):
        Bag(path, pose_topic="/nowhere")


def test_poses_that_cannot_be_told_are_one_clear_error(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        moments(bag)
    with pytest.raises(DatasetError, match="has no poses of 'camera_color_optical_frame'"):
        Bag(path)
    assert len(Bag(path, posed=False)) == 10
    with writing(tmp_path / "two", "ros1") as (bag, path):
        moments(bag)
        for topic in ("/one", "/two"):
            odometry(bag, topic)
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
    with pytest.raises(DatasetError, match=r"several topics hold poses \(/one, /two\)"):
        Bag(path)


# --- topics and cameras ---


def test_the_registered_depth_and_its_colour_are_chosen(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        for name, encoding, image, frame in (
            ("depth/image_rect_raw", "16UC1", wall(1).measurement, "camera_depth_optical_frame"),
            ("aligned_depth_to_color/image_raw", "16UC1", wall(2).measurement, OPTICAL),
            ("color/image_raw", "rgb8", _BGR[..., ::-1], OPTICAL),
            ("infra1/image_rect_raw", "mono8", _GRAY, "camera_infra1_optical_frame"),
        ):
            bag.image(f"/camera/{name}", image, encoding, T0, frame)
            bag.camera_info(f"/camera/{name.split('/')[0]}/camera_info", CAMERA, SHAPE, T0)
    found = Bag(path, posed=False).frame(0)
    assert found.sensor == "realsense"
    assert np.array_equal(found.depth, wall(2).measurement)
    assert np.array_equal(found.color, _BGR)
    other = Bag(path, posed=False, depth_topic="/camera/depth/image_rect_raw").frame(0)
    assert np.array_equal(other.depth, wall(1).measurement)
    assert other.color is None  # it is not registered to that one, and no transforms tell how to
    assert Bag(path, posed=False, color=False).frame(0).color is None


@pytest.mark.parametrize("posed", [True, False])
def test_colour_of_another_camera_is_registered_by_tf_static(tmp_path: Path, posed: bool) -> None:
    T_color_depth = se3.exp(np.array([0.03, 0.002, -0.001, 0.01, -0.02, 0.005]))
    camera, color = Intrinsics(55.0, 54.0, 38.0, 29.0), np.repeat(np.repeat(_BGR, 2, axis=0), 2, axis=1)
    d = np.array([0.05, -0.02, 0.0, 0.0, 0.0])
    metres = np.where(wall().measurement > 0, wall().measurement * 0.001, np.nan).astype(np.float32)
    with writing(tmp_path, "mcap") as (bag, path):
        bag.transform(pose(1.0), BODY, "color", T0, static=True)
        bag.transform(pose(1.0) @ T_color_depth, BODY, "depth", T0, static=True)
        for i in range(3):
            stamp = T0 + i * FRAME_NS
            bag.odometry("/odom", pose(float(i)), "odom", BODY, stamp)
            bag.image("/camera/depth/image_rect_raw", metres, "32FC1", stamp, "depth")
            bag.camera_info("/camera/depth/camera_info", CAMERA, SHAPE, stamp)
            bag.image("/camera/color/image_raw", color, "bgr8", stamp, "color")
            bag.camera_info("/camera/color/camera_info", camera, color.shape[:2], stamp, d=d)
    flat = Undistorter(Camera.named(camera.matrix, color.shape[:2], "plumb_bob", d))
    registration = Registration(
        CAMERA, flat.intrinsics, T_color_depth, SHAPE, color_size=color.shape[:2]
    )  # fmt: skip
    expected = registration.color_of_depth(flat.image(color), np.nan_to_num(metres))
    found = Bag(path, posed=posed)
    assert len(found) == 3
    difference = np.abs(found.frame(1).color.astype(int) - expected)  # type: ignore[union-attr]
    assert difference.max() <= 1
    assert np.allclose(found.frame(2).T_world_camera, pose(3.0) @ T_color_depth, atol=1e-9)


@pytest.mark.parametrize("units", ["0.000250", 0.00025])
def test_a_recording_of_librealsense_has_its_own_depth_units(tmp_path: Path, units: Any) -> None:
    place = "/device_0/sensor_0"
    with writing(tmp_path, "sqlite3" if isinstance(units, str) else "ros1") as (bag, path):
        kind = "std_msgs/msg/String" if isinstance(units, str) else "std_msgs/msg/Float32"
        bag.write(f"{place}/option/Depth_Units/value", bag.make(kind, data=units), T0)
        bag.image(f"{place}/Depth_0/image/data", wall().measurement, "mono16", T0, "Depth")
        bag.camera_info(f"{place}/Depth_0/info/camera_info", CAMERA, SHAPE, T0)
        bag.image(f"{place}/Infrared_1/image/data", _GRAY, "mono8", T0, "Depth")
    found = Bag(path, posed=False)
    assert (found.sensor, found.frame(0).color) == ("realsense", None)
    assert found.frame(0).depth_scale == pytest.approx(0.00025)
    assert Bag(path, posed=False, depth_scale=0.001).frame(0).depth_scale == 0.001


def test_what_cannot_be_chosen_is_listed(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        for camera in ("front", "back"):
            bag.image(f"/{camera}/depth", wall().measurement, "16UC1", T0)
            bag.camera_info(f"/{camera}/camera_info", CAMERA, SHAPE, T0)
            bag.cloud(f"/{camera}/points", records(), T0)
    with pytest.raises(
        DatasetError, match=r"several fit \(/back/depth, /front/depth\): choose with depth_topic"
    ):
        Bag(path)
    with pytest.raises(DatasetError, match=r"/front/depth \(sensor_msgs/Image, 1\)"):
        Bag(path, depth_topic="/side/depth")
    with pytest.raises(DatasetError, match="choose one with points_topic"):
        Bag(path, modality="lidar")
    with pytest.raises(DatasetError, match="topics of depth and lidar given"):
        Bag(path, depth_topic="/front/depth", points_topic="/front/points")
    with pytest.raises(DatasetError, match="no stereo found"):
        Bag(path, modality="stereo")
    with pytest.raises(DatasetError, match="modality of a ROS recording must be"):
        Bag(path, modality="sonar")  # type: ignore[arg-type]
    assert len(Bag(path, points_topic="/front/points", posed=False)) == 1
    assert len(Bag(path, depth_topic="/front/depth", posed=False)) == 1


def of_camera(folder: Path, shape: tuple[int, ...] = SHAPE, name: str = "depth", **info: Any) -> Path:
    with writing(folder, "ros1") as (bag, path):
        bag.image(f"/camera/{name}", np.ones(shape, np.uint16), "16UC1", T0)
        bag.camera_info("/camera/camera_info", CAMERA, SHAPE, T0, **info)
    return path


def test_a_lens_that_distorts_is_undistorted_unless_rectified(tmp_path: Path) -> None:
    K = Intrinsics(38.0, 37.0, 31.0, 24.0)
    d = np.array([-0.12, 0.03, 0.001, -0.002, 0.0])
    lens = Camera.named(K.matrix, SHAPE, "plumb_bob", d)
    flat = Undistorter(lens)
    with writing(tmp_path, "ros1") as (bag, path):
        bag.image("/camera/depth", wall().measurement, "16UC1", T0)
        bag.image("/camera/rgb", _BGR, "bgr8", T0)
        bag.camera_info("/camera/camera_info", CAMERA, SHAPE, T0, d=d, k=K.matrix.reshape(-1))
    frame = Bag(path, posed=False).frame(0)
    assert frame.intrinsics == flat.intrinsics
    assert np.array_equal(frame.depth, flat.depth(wall().measurement))
    assert np.array_equal(frame.color, flat.image(_BGR))
    rectified = Bag(path, posed=False, rectified=True).frame(0)
    assert rectified.intrinsics == CAMERA
    assert np.array_equal(rectified.depth, wall().measurement)
    path = of_camera(tmp_path / "rect", name="image_rect", d=d, k=K.matrix.reshape(-1))
    assert Bag(path, posed=False).frame(0).intrinsics == CAMERA
    path = of_camera(tmp_path / "odd", d=d, distortion_model="inverse_brown_conrady")
    with pytest.raises(DatasetError, match=r"distortion model must be one of .*rectified=True"):
        Bag(path, posed=False)


def test_raw_stereo_is_rectified_as_its_camera_infos_say(tmp_path: Path) -> None:
    """Two cameras turned away from each other and their rectification, by OpenCV as image_proc uses it."""
    K, baseline = Intrinsics(40.0, 40.0, 31.5, 23.5), 0.11
    T_right_left = se3.exp(np.array([-baseline, 0.004, -0.003, 0.02, -0.03, 0.01]))
    turns = cv2.stereoRectify(K.matrix, np.zeros(5), K.matrix, np.zeros(5), SHAPE[::-1],
                              T_right_left[:3, :3], T_right_left[:3, 3:])  # fmt: skip
    with writing(tmp_path, "mcap") as (bag, path):
        for side, R, P in (("left", turns[0], turns[2]), ("right", turns[1], turns[3])):
            bag.image(f"/stereo/{side}/image_raw", _GRAY, "mono8", T0)
            bag.camera_info(f"/stereo/{side}/camera_info", K, SHAPE, T0, r=R.reshape(-1), p=P.reshape(-1))
        for i in range(2):
            bag.transform(pose(float(i)), WORLD, OPTICAL, T0 + i * FRAME_NS)
    lens = Camera.named(K.matrix, SHAPE, "plumb_bob", np.zeros(5))
    expected = Rectifier(StereoRig(lens, lens, T_right_left))
    frame = Bag(path).frame(0)
    assert np.allclose(frame.intrinsics.matrix, expected.intrinsics.matrix, atol=1e-6)
    assert frame.baseline_fx == pytest.approx(expected.baseline_fx)
    assert frame.baseline_fx == pytest.approx(frame.intrinsics.fx * np.linalg.norm(T_right_left[:3, 3]))
    left, right = expected.pair(_GRAY, _GRAY)
    assert np.abs(frame.left.astype(int) - left).max() <= 1
    assert np.abs(frame.right.astype(int) - right).max() <= 1
    assert np.allclose(frame.T_world_camera[:3, :3], expected.T_left_rectified[:3, :3], atol=1e-9)


def test_binning_and_regions_move_the_camera(tmp_path: Path) -> None:
    path = of_camera(tmp_path, shape=(12, 20), binning_x=2, binning_y=2,
                     roi={"x_offset": 8, "y_offset": 4, "width": 40, "height": 24})  # fmt: skip
    camera = Bag(path, posed=False).frame(0).intrinsics
    assert camera is not None
    assert (camera.fx, camera.cx, camera.cy) == (20.0, (31.5 - 8) / 2, (23.5 - 4) / 2)


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"width": 99}, "its CameraInfo says 99×48"),
        ({"k": np.zeros(9), "p": np.zeros(12)}, "fx > 0"),
    ],
)
def test_cameras_that_do_not_fit_are_refused(tmp_path: Path, info: dict[str, Any], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        Bag(of_camera(tmp_path, **info), posed=False)


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
    path, real = walls(tmp_path), builtins.__import__

    def without(name: str, *arguments: Any, **more: Any) -> Any:
        if name.startswith("rosbags"):
            raise ImportError(name)
        return real(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependency, match=r"pip install 'tsfusion\[ros\]'"):
        open_dataset(path)


def test_poses_of_a_long_recording_stay_small() -> None:
    """A robot with thirty joints tells millions of transforms an hour."""
    q, t = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0), SimpleNamespace(x=1.0, y=2.0, z=3.0)
    samples = PoseSamples()
    tracemalloc.start()
    try:
        for stamp in range(10_000):
            samples.add(stamp * 10**9, t, q)
        assert tracemalloc.get_traced_memory()[0] < 100 * 10_000
    finally:
        tracemalloc.stop()
    assert len(samples.trajectory().timestamps_ns) == 10_000
