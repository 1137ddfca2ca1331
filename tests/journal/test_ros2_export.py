# SPDX-License-Identifier: MIT
"""Exported bags hold what was journaled, to two independent readers of ROS 2 bags."""

import builtins
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corrected_maps import final_keyframes
from failures import raising
from keyframes_and_servers import CAMERA, pose, wall
from mcap.reader import make_reader
from repository import ROOT
from saved_maps import ANNA, correct, make_map

from tsfusion import Keyframe
from tsfusion.core.errors import JournalError, MissingDependency, OutputError
from tsfusion.datasets import Dataset, open_dataset
from tsfusion.geometry.keyframe import points_camera, points_world
from tsfusion.journal import Journal, read, records, segment_path
from tsfusion.journal.ros2_export import Export, export
from tsfusion.journal.ros2_messages import depth_image
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import unpack

rosbags_highlevel = pytest.importorskip("rosbags.highlevel")
NOW = 1_700_000_000_123_456_789
Data = Callable[[str], Path]
Read = dict[str, list[tuple[int, Any]]]


def journal_of(folder: Path, scans: dict[str, list[Keyframe]]) -> JournalPlace:
    """A journal with a session for each client."""
    log = Journal(folder / "journal", 1 << 30, sync=False)
    for number, (client, keyframes) in enumerate(scans.items(), 1):
        session = bytes([number]) * 16
        for seq, keyframe in enumerate(keyframes, 1):
            frames = codec.encode(keyframe, session=session, seq=seq, jpeg_quality=90)
            log.append(frames, session=session, seq=seq, client=client, logged_ns=NOW + seq)
    log.close()
    return JournalPlace(folder / "journal")


def exported(folder: Path, scans: dict[str, list[Keyframe]]) -> tuple[Export, Read]:
    """Export, and read back with rosbags: (time, message) by topic."""
    done = export(journal_of(folder, scans), folder / "out.mcap", lambda *_: None)
    found: Read = {}
    with rosbags_highlevel.AnyReader([folder / "out.mcap"]) as reader:
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, reader.deserialize(raw, connection.msgtype))
            )
    assert {topic: len(messages) for topic, messages in found.items()} == done.messages
    return done, found


def image(message: Any) -> np.ndarray:
    dtype = {"16UC1": "<u2", "32FC1": "<f4"}[message.encoding]
    assert message.step == message.width * np.dtype(dtype).itemsize
    return message.data.view(dtype).reshape(message.height, message.width)


def matrix(transform: Any) -> np.ndarray:
    q, t = transform.rotation, transform.translation
    x, y, z, w = q.x, q.y, q.z, q.w
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = t.x, t.y, t.z
    return T


def check_places(found: Read, name: str, keyframes: list[Keyframe]) -> None:
    transforms = [m.transforms[0] for _, m in found["/tf"] if m.transforms[0].child_frame_id == name]
    poses = [message for _, message in found[f"/{name}/pose"]]
    assert len(transforms) == len(poses) == len(keyframes)
    for keyframe, transform, stamped in zip(keyframes, transforms, poses, strict=True):
        expected = keyframe.T_world_camera
        assert (transform.header.frame_id, stamped.header.frame_id) == ("world", "world")
        assert np.array_equal(matrix(transform.transform)[:3, 3], expected[:3, 3])
        assert np.allclose(matrix(transform.transform), expected, atol=1e-9, rtol=0)
        assert stamped.pose.orientation == transform.transform.rotation
        position = stamped.pose.position
        assert [position.x, position.y, position.z] == expected[:3, 3].tolist()


def check_projection(found: Read, name: str, keyframe: Keyframe) -> None:
    """Image, camera and place together give the points of the keyframe."""
    depth = image(found[f"/{name}/depth/image"][0][1])
    depth = depth * 0.001 if depth.dtype == np.uint16 else np.nan_to_num(depth)
    camera = found[f"/{name}/depth/camera_info"][0][1]
    assert (camera.height, camera.width) == depth.shape
    v, u = np.nonzero(depth)
    rays = np.linalg.inv(camera.k.reshape(3, 3)) @ np.stack([u, v, np.ones(len(u))])
    T = next(m for _, m in found["/tf"] if m.transforms[0].child_frame_id == name).transforms[0].transform
    points = (matrix(T) @ np.vstack([rays * depth[v, u], np.ones(len(u))]))[:3].T
    expected = points_world(keyframe)
    assert np.allclose(points[:: 1 + len(points) // 5000], expected[:: 1 + len(points) // 5000], atol=1e-4)


# --- real sensors ---


def some(dataset: Dataset, count: int) -> list[Keyframe]:
    return [dataset[index] for index in range(count)]


def test_a_kinect_recording_comes_out_bit_for_bit(data: Data, tmp_path: Path) -> None:
    keyframes = some(open_dataset(data("7scenes/redkitchen")), 3)
    done, found = exported(tmp_path, {"kitchen": keyframes})
    assert (done.keyframes, done.lost, done.problems) == (3, 0, [])
    for i, keyframe in enumerate(keyframes):
        stamp, message = found["/kitchen/depth/image"][i]
        assert (message.encoding, message.header.frame_id) == ("16UC1", "kitchen")
        assert np.array_equal(image(message), keyframe.depth)
        assert stamp == (keyframe.timestamp_ns or NOW + i + 1)  # this dataset has no clock
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
    stored = [record.frames for record in records(segment_path(tmp_path / "journal", 1))]
    for frames, (_, message) in zip(stored, found["/kitchen/color/image/compressed"], strict=True):
        names = [buffer.name for buffer in unpack(frames[0]).buffers]
        assert (message.format, message.data.tobytes()) == ("jpeg", bytes(frames[1 + names.index("color")]))
    check_places(found, "kitchen", keyframes)
    check_projection(found, "kitchen", keyframes[0])


def test_a_stereo_recording_comes_out_as_metres(data: Data, tmp_path: Path) -> None:
    keyframes = some(open_dataset(data("kitti_odometry"), sequence="06"), 2)
    _, found = exported(tmp_path, {"car.1": keyframes})
    for keyframe, (stamp, message) in zip(keyframes, found["/car_1/depth/image"], strict=True):
        disparity = keyframe.disparity
        assert disparity is not None
        depth = image(message)
        assert (message.encoding, stamp) == ("32FC1", keyframe.timestamp_ns)
        assert np.array_equal(np.isnan(depth), disparity == 0)
        there = disparity > 0
        expected = keyframe.baseline_fx / (disparity[there].astype(np.float64) * keyframe.disparity_scale)
        assert np.array_equal(depth[there], expected.astype(np.float32))
    check_places(found, "car_1", keyframes)
    check_projection(found, "car_1", keyframes[0])


def test_a_lidar_recording_comes_out_bit_for_bit(data: Data, tmp_path: Path) -> None:
    keyframes = some(open_dataset(data("kitti_odometry"), sequence="00", modality="lidar"), 2)
    _, found = exported(tmp_path, {"": keyframes})
    for keyframe, (_, message) in zip(keyframes, found["/scanner/points"], strict=True):
        assert [(field.name, field.offset, field.datatype) for field in message.fields] == [
            ("x", 0, 7), ("y", 4, 7), ("z", 8, 7),
        ]  # fmt: skip
        shape = (len(keyframe.points), 1, len(message.data))
        assert (message.width, message.height, message.row_step) == shape
        assert np.array_equal(message.data.view("<f4").reshape(-1, 3), keyframe.points)
    check_places(found, "scanner", keyframes)


# --- the rest of what a keyframe may be ---


def cloud(i: int) -> Keyframe:
    rng = np.random.default_rng(i)
    points = rng.normal(size=(100, 3)).astype(np.float32)
    points[3] = np.nan
    return Keyframe(
        T_world_camera=pose(1.0), points=points, color=rng.integers(0, 256, (100, 3)).astype(np.uint8)
    )


def test_points_keep_their_colours(tmp_path: Path) -> None:
    _, found = exported(tmp_path, {"laser": [cloud(0)]})
    message = found["/laser/points"][0][1]
    assert [field.name for field in message.fields] == ["x", "y", "z", "rgb"]
    rows = message.data.reshape(-1, message.point_step)
    packed = rows[:, 12:].copy().view("<u4")[:, 0]
    color = cloud(0).color
    assert color is not None
    assert np.array_equal(packed, color.astype(np.uint32) @ np.array([1, 1 << 8, 1 << 16], np.uint32))
    assert not message.is_dense


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ([0, 7, 9], [0, 7, 9]),  # a clock that began with the recording
        ([5, 7, 9], [5, 7, 9]),
        ([0, 0, 9], [NOW + 1, NOW + 2, NOW + 3]),  # no clock
        ([0], [NOW + 1]),
        ([5, 5, 6, 6], [5, 6, 7, 8]),  # a reader takes two of one time for one
        ([2**62], [NOW + 1]),  # more seconds than a ROS stamp holds
    ],
)
def test_time_is_the_sensor_s_or_that_of_arrival(
    tmp_path: Path, stamps: list[int], expected: list[int]
) -> None:
    keyframes = [wall(i, timestamp_ns=stamp) for i, stamp in enumerate(stamps)]
    _, found = exported(tmp_path, {"a": keyframes})
    assert [stamp for stamp, _ in found["/a/pose"]] == expected
    said = [message.header.stamp for _, message in found["/a/depth/image"]]
    assert [stamp.sec * 10**9 + stamp.nanosec for stamp in said] == expected


@pytest.mark.parametrize(
    ("depth", "scale", "expected"),
    [
        (np.array([[0, 1500]], np.uint16), 0.001, np.array([[0, 1500]], np.uint16)),
        (np.array([[0, 5000]], np.uint16), 1 / 5000, np.array([[np.nan, 1]], np.float32)),
        (np.array([[0, -1, np.inf, 2.5]], np.float32), 0.001, np.array([[np.nan] * 3 + [2.5]], np.float32)),
    ],
)
def test_depth_is_millimetres_or_metres(depth: np.ndarray, scale: float, expected: np.ndarray) -> None:
    given = Keyframe(T_world_camera=pose(), depth=depth, depth_scale=scale, intrinsics=CAMERA)
    assert depth_image(given).dtype == expected.dtype
    assert np.array_equal(depth_image(given), expected, equal_nan=True)


def test_a_cloud_of_every_other_pixel_lies_where_the_depth_is(tmp_path: Path) -> None:
    place = journal_of(tmp_path, {"": [wall(3)]})
    done = export(place, tmp_path / "out.mcap", lambda *_: None, clouds=True)
    assert done.messages["/scanner/points"] == 1
    with rosbags_highlevel.AnyReader([tmp_path / "out.mcap"]) as reader:
        found = [
            reader.deserialize(raw, one.msgtype)
            for one, _, raw in reader.messages()
            if one.topic == "/scanner/points"
        ]
    rows = found[0].data.reshape(-1, found[0].point_step)
    points = rows[:, :12].copy().view("<f4")
    depth = wall(3).depth
    assert depth is not None
    assert len(points) == np.count_nonzero(depth[::2, ::2])
    assert np.allclose(points[:, 2], depth[::2, ::2][depth[::2, ::2] > 0] * 0.001)
    every = points_camera(wall(3)).astype(np.float32)
    assert {tuple(one) for one in points.round(4)} <= {tuple(one) for one in every.round(4)}
    assert (rows[:, 12:15] != 0).any()


def test_foxglove_s_layout_names_what_an_export_holds(tmp_path: Path) -> None:
    layout = json.loads((ROOT / "contrib/foxglove/tsfusion.json").read_text(encoding="utf-8"))
    place = journal_of(tmp_path, {"": [wall(0)]})
    export(place, tmp_path / "out.mcap", lambda *_: None, clouds=True)
    messages: dict[str, Any] = {}
    with rosbags_highlevel.AnyReader([tmp_path / "out.mcap"]) as reader:
        for one, _, raw in reader.messages():
            messages[one.topic] = reader.deserialize(raw, one.msgtype)

    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    assert {one.partition("!")[0] for one in panels} == {"3D", "Image", "Plot"}, "kinds that Foxglove has"
    named = [one for one in words(panels) if one.startswith("/")]
    assert set(messages) == {one.split(".")[0] for one in named} | {"/tf", "/scanner/depth/camera_info"}
    for path in (one for one in named if "." in one):
        topic, *fields = path.split(".")
        value = messages[topic]
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, float)
    frames = {messages["/tf"].transforms[0].header.frame_id, messages["/tf"].transforms[0].child_frame_id}
    map_panel = panels["3D!map"]
    assert {one.removeprefix("frame:") for one in map_panel["transforms"]} == frames
    assert {map_panel["followTf"], map_panel["layers"]["grid"]["frameId"]} == {"world"}
    cloud_shown, fields = map_panel["topics"]["/scanner/points"], messages["/scanner/points"].fields
    assert cloud_shown["colorField"] in [field.name for field in fields]


def leaves(split: Any) -> list[str]:
    """The panels of a layout's tree."""
    return [split] if isinstance(split, str) else leaves(split["first"]) + leaves(split["second"])


def words(tree: Any) -> list[str]:
    """Every text in a tree of dicts and lists, names too."""
    if isinstance(tree, dict):
        return [*tree, *(word for one in tree.values() for word in words(one))]
    if isinstance(tree, list):
        return [word for one in tree for word in words(one)]
    return [tree] if isinstance(tree, str) else []


def test_mcap_s_own_reader_takes_the_file(tmp_path: Path) -> None:
    export(journal_of(tmp_path, {"a": [wall(0), cloud(1)]}), tmp_path / "out.mcap", lambda *_: None)
    with (tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        found = [
            (schema.name, schema.encoding, channel.message_encoding)
            for schema, channel, _ in reader.iter_messages()
        ]
        summary = reader.get_summary()
    assert {kind for kind, _, _ in found} == {
        "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/Image",
        "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2",
    }  # fmt: skip
    assert {(encoding, form) for _, encoding, form in found} == {("ros2msg", "cdr")}
    assert summary is not None
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    text = next(schema for schema in summary.schemas.values() if schema.name == "sensor_msgs/msg/Image").data
    assert b"uint8[] data" in text
    assert b"MSG: std_msgs/Header" in text


def test_sessions_have_names_of_their_own(tmp_path: Path) -> None:
    log = Journal(tmp_path / "journal", 1 << 30, sync=False)
    for number, client in enumerate(["arm-7", "arm-7", "", "", "7up"], 1):
        session = bytes([number]) * 16
        frames = codec.encode(wall(number, timestamp_ns=0), session=session, seq=1, jpeg_quality=90)
        log.append(frames, session=session, seq=1, client=client)
        log.append(frames, session=session, seq=1, client=client)  # a second time
    log.close()
    done = export(JournalPlace(tmp_path / "journal"), tmp_path / "out.mcap", lambda *_: None)
    assert done.keyframes == 5
    named = {topic.split("/")[1] for topic in done.messages} - {"tf"}
    assert named == {"arm_7", "arm_7_2", "scanner", "scanner_2", "scanner_7up"}


# --- when it cannot be done ---


def test_damaged_keyframes_are_left_out_and_named(tmp_path: Path) -> None:
    place = journal_of(tmp_path, {"a": [wall(i) for i in range(3)]})
    path = segment_path(place.path, 1)
    second = list(records(path))[1]
    content = bytearray(path.read_bytes())
    content[second.position.offset + 500] ^= 1
    path.write_bytes(content)
    done = export(place, tmp_path / "out.mcap", lambda *_: None)
    assert (done.keyframes, done.lost) == (2, 1)
    assert [(one.offset, one.kind) for one in done.problems] == [(second.position.offset, "damage")]


@pytest.fixture
def small(tmp_path: Path) -> JournalPlace:
    return journal_of(tmp_path, {"a": [wall(0)]})


def test_keyframes_are_where_corrections_moved_them(tmp_path: Path) -> None:
    folder = make_map(tmp_path / "map", range(4))
    correct(folder, ANNA, 5, {1: pose(0.5), 4: pose(0.7)}, removed=(2,))
    other = tmp_path / "other.mcap"
    done = export(JournalPlace(folder / "journal"), other, lambda *_: None)
    assert (done.keyframes, done.lost) == (3, 0)
    with rosbags_highlevel.AnyReader([other]) as reader:
        places = [
            matrix(reader.deserialize(raw, connection.msgtype).transforms[0].transform)
            for connection, _, raw in reader.messages()
            if connection.topic == "/tf"
        ]
    expected = [one.T_world_camera for one in final_keyframes(folder / "journal")]
    np.testing.assert_allclose(places, expected, atol=1e-9)
    segment = segment_path(folder / "journal", 1)
    with pytest.raises(OutputError, match="it is in a journal"):  # of another map
        export(JournalPlace(tmp_path / "other"), segment, lambda *_: None)


def test_nothing_half_written_is_left(small: JournalPlace, tmp_path: Path) -> None:
    before = sorted(tmp_path.iterdir())

    with pytest.raises(KeyboardInterrupt):
        export(small, tmp_path / "out.mcap", raising(KeyboardInterrupt()))
    assert sorted(tmp_path.iterdir()) == before


def test_places_that_cannot_be_written_are_named(small: JournalPlace, tmp_path: Path) -> None:
    segment = segment_path(small.path, 1)
    content = segment.read_bytes()
    for out, message in (
        (tmp_path / "out.bag", "ending in .mcap"),
        (tmp_path / "missing" / "out.mcap", "No such file"),
        (segment, "it is in a journal"),
        (small.path / "out.mcap", "it is in a journal"),
    ):
        with pytest.raises(OutputError, match=message):
            export(small, out, lambda *_: None)
    with pytest.raises(OutputError, match="it is in a journal"):
        export(JournalPlace(segment), segment, lambda *_: None)
    assert segment.read_bytes() == content
    assert read(small.path, next(records(segment)).position).seq == 1


def test_an_empty_journal_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "journal").mkdir()
    with pytest.raises(JournalError, match="no keyframes in"):
        export(JournalPlace(tmp_path / "journal"), tmp_path / "out.mcap", lambda *_: None)
    assert not (tmp_path / "out.mcap").exists()


def test_without_rosbags_the_error_names_the_command(
    small: JournalPlace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *arguments: Any, **more: Any) -> Any:
        if name.startswith("rosbags"):
            raise ImportError(name)
        return real(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependency, match=r"pip install '.\[ros\]'"):
        export(small, tmp_path / "out.mcap", lambda *_: None)
