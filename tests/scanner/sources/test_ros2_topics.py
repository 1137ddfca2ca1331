# SPDX-License-Identifier: MIT
"""Topics of ROS 2 as a source: real publishers in other processes, over DDS and Zenoh, on this machine."""

import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import count, islice
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from keyframes_and_servers import CAMERA, SHAPE, map_hash, pose, until, wall
from known_turns import R_SENSOR_IMU, assert_known, attitude, samples
from ros2_talker import libraries, listener, on_this_machine, talker
from rosbag_scenes import COLOR, DEPTH, T0, T_BODY_OPTICAL, infos, records, scan
from rosbag_writing import BODY, OPTICAL, WORLD, BagWriter, writing

import tsfusion
from tsfusion.core.errors import DatasetError, InvalidConfig, MissingDependency, SourceError
from tsfusion.datasets.rosbag.reader import Stream
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame

pytest.importorskip("rosbags", reason="extra ros2")
TENTH = 100_000_000
TRANSPORTS = [
    pytest.param("dds", id="dds"),
    pytest.param("zenoh", id="zenoh"),
]


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> tuple[int, str]:
    return on_this_machine(monkeypatch)


@contextmanager
def playing(
    bag: Path, transport: str, place: tuple[int, str], rate: float = 20.0, *part: int
) -> Iterator[None]:
    """A talker, and the router that Zenoh needs."""
    libraries(transport)
    with ExitStack() as stack:
        if transport == "zenoh":
            stack.callback(listener(place[1]).close)
        stack.enter_context(talker(bag, transport, *place, rate, *part))
        yield


def opened(transport: str, place: tuple[int, str], **options: object) -> tsfusion.Source:
    given = {"transport": transport, "router": place[1], "idle": 3.0, "posed": True, **options}
    return tsfusion.open_source(f"ros2:{place[0]}", **given)


def assert_same(frame: Frame, other: Frame) -> None:
    assert frame.timestamp_ns == other.timestamp_ns
    for name in ("depth", "color", "T_world_camera", "points"):
        np.testing.assert_array_equal(getattr(frame, name), getattr(other, name), err_msg=name)
    assert (frame.sensor, frame.intrinsics, frame.depth_scale) == (
        other.sensor,
        other.intrinsics,
        other.depth_scale,
    )


def wait_for(source: Any, **counts: int) -> None:
    """Wait until so many messages of topics have come, whether or not they found room."""
    live = source._live

    def came() -> dict[str, int]:
        with live._news:
            waiting = [each.stream.topic for each in live._waiting]
        return {topic: live.dropped[topic] + waiting.count(topic) for topic in counts}

    until(lambda: came() == counts)


def walls(folder: Path, count: int = 12) -> Path:
    with writing(folder, "mcap") as (bag, path):
        scan(bag, [wall(i) for i in range(count)])
    return path


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_frames_are_those_of_the_bag(tmp_path: Path, transport: str, place: tuple[int, str]) -> None:
    path = walls(tmp_path)
    recorded = tsfusion.open_dataset(path)
    with playing(path, transport, place), opened(transport, place) as source:
        frames = list(source)
    assert len(frames) == len(recorded)
    for frame, other in zip(frames, recorded, strict=True):
        assert_same(frame, Frame.of(other, recorded.sensor))
        assert frame.captured_ns
    assert not source.skipped
    assert source.sensor == recorded.sensor


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_an_imu_on_the_robot_tells_turns_and_up(
    tmp_path: Path, transport: str, place: tuple[int, str]
) -> None:
    T_body_imu = se3.transform(T_BODY_OPTICAL[:3, :3] @ R_SENSOR_IMU, (0.1, 0.2, 0.3))
    with writing(tmp_path, "mcap") as (bag, path):
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
        bag.transform(T_body_imu, BODY, "imu_link", T0, static=True)
        for number, (seconds, force, rate) in enumerate(samples()):
            stamp = T0 + round(seconds * 1e9)
            bag.imu("/imu/data", force, stamp, "imu_link", rate=rate)
            bag.imu("/elsewhere/imu", force, stamp, "another_robot", rate=-rate)
            if number % 7 == 3:
                infos(bag, stamp)
                bag.image(DEPTH, wall().measurement, "16UC1", stamp + 1_000_000)
    with playing(path, transport, place), opened(transport, place, posed=False) as source:
        wait_for(source, **{"/imu/data": number + 1, "/elsewhere/imu": number + 1, DEPTH: (number + 4) // 7})
        frames = list(source)
    assert_known(((frame.timestamp_ns - T0) / 1e9, frame.attitude) for frame in frames)
    assert attitude(0) @ frames[5].specific_force == pytest.approx((0, 0, 9.81), abs=0.01)


def test_transforms_are_kept_when_images_find_no_room(
    tmp_path: Path, place: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The transform from the body to the camera came once, and first."""
    from tsfusion.datasets.ros2 import live_messages

    monkeypatch.setattr(live_messages, "_MOST_BYTES", 16 * wall(0).measurement.nbytes)
    monkeypatch.setattr(live_messages, "_SMALL", 2000)
    path = walls(tmp_path, 30)
    with playing(path, "zenoh", place), opened("zenoh", place) as source:
        wait_for(source, **{"/tf": 30, "/tf_static": 1, DEPTH: 30, COLOR: 30})
        frames = list(source)
    assert frames[-1].T_world_camera is not None
    assert len(frames) < 30


@pytest.mark.slow
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_real_recording_gives_the_same_map(
    tmp_path: Path, transport: str, place: tuple[int, str], data: Callable[[str], Path]
) -> None:
    """At 10 Hz, 640×480 with colour, and nothing is dropped."""
    kitchen = tsfusion.open_dataset(data("7scenes/redkitchen"))
    with writing(tmp_path, "mcap") as (bag, path):
        scan(bag, [kitchen[i] for i in range(60)])
    with playing(path, transport, place, 10.0), opened(transport, place) as source:
        frames = list(source)
    assert not source.skipped
    assert len(frames) == 60
    poses = [frame.T_world_camera for frame in frames]
    assert all(T is not None for T in poses)
    live = [frame.keyframe(T, None) for frame, T in zip(frames, poses, strict=True)]
    assert map_hash(live) == map_hash(tsfusion.open_dataset(path))


def test_a_publisher_that_ends_is_waited_for(tmp_path: Path, place: tuple[int, str]) -> None:
    libraries("dds")
    path = walls(tmp_path, 16)
    recorded = tsfusion.open_dataset(path)
    with ExitStack() as first:
        first.enter_context(playing(path, "dds", place, 20.0, 0, 8))
        with opened("dds", place, idle=30.0) as source:
            frames = iter(source)
            got = list(islice(frames, 8))
            first.close()
            time.sleep(1.0)  # it may have restarted faster; then it counts as a second one
            with playing(path, "dds", place, 20.0, 8):
                got += islice(frames, 8)
    for frame, other in zip(got, recorded, strict=True):
        assert_same(frame, Frame.of(other, recorded.sensor))


def sent(place: tuple[int, str]) -> Any:
    """Zenoh as a publisher in this process: its bytes are not checked on their way."""
    from tsfusion.datasets.ros2.live_messages import open_middlewares

    (own,) = open_middlewares(lambda _: None, transport="zenoh", domain=place[0], router=place[1])
    return own


class Held:
    """Messages of a bag in memory, in place of a writer of rosbags."""

    def __init__(self) -> None:
        from tsfusion.datasets.ros2.middleware import message_types

        self.store, self.messages = message_types(), []
        self.bag = BagWriter(self, self.store, is2=True)

    def add_connection(self, topic: str, kind: str, **_: object) -> tuple[str, str]:
        return topic, kind

    def write(self, connection: tuple[str, str], _: int, raw: memoryview) -> None:
        self.messages.append((*connection, bytes(raw)))

    def send(self, own: Any) -> None:
        for topic, kind in {(topic, kind): None for topic, kind, _ in self.messages}:
            if topic not in own._publishers:
                own.announce(topic, kind)
        for topic, _, raw in self.messages:
            own.publish(topic, raw)
        self.messages.clear()


@contextmanager
def source_of(
    place: tuple[int, str], more: Callable[[BagWriter, int], None], **options: Any
) -> Iterator[Any]:
    """A source, and a thread that sends what `more` writes for 0, 1, 2, … until it is closed."""
    libraries("zenoh")
    router, held, ended = listener(place[1]), Held(), Event()
    own = sent(place)

    def run() -> None:
        for number in count():
            more(held.bag, number)
            held.send(own)
            if ended.wait(0.05):
                return

    thread = Thread(target=run)
    thread.start()
    try:
        with opened("zenoh", place, **options) as source:
            yield source
    finally:
        ended.set()
        thread.join()
        own.close()
        router.close()


def one(bag: BagWriter, number: int, **wrong: Any) -> None:
    """A depth image, its camera and a pose."""
    stamp = T0 + number * TENTH
    bag.camera_info("/cam/camera_info", CAMERA, SHAPE, stamp)
    bag.transform(pose(0.01 * number), WORLD, OPTICAL, stamp)
    bag.image("/cam/depth", wall(0).measurement, "16UC1", stamp, **wrong)


def test_depth_in_metres(place: tuple[int, str]) -> None:
    metres = wall(0).measurement.astype(np.float32) / 1000

    def more(bag: BagWriter, number: int) -> None:
        one(bag, number)
        bag._writer.messages.pop()
        bag.image("/cam/depth", metres, "32FC1", T0 + number * TENTH)

    with source_of(place, more) as source:
        (frame,) = islice(source, 1)
    np.testing.assert_array_equal(frame.depth, metres)


def test_hostile_messages_are_counted(place: tuple[int, str], caplog: pytest.LogCaptureFixture) -> None:
    """Cut short, sizes that no memory holds, and an image that says it is another."""

    def more(bag: BagWriter, number: int) -> None:
        wrong = [{}, {"width": 1 << 31}, {"step": 1}, {}][number % 4] if number > 20 else {}
        one(bag, number, **wrong)
        if number > 20 and number % 4 == 3:
            topic, kind, raw = bag._writer.messages.pop()
            bag._writer.messages.append((topic, kind, raw[: len(raw) // 2]))

    with source_of(place, more) as source:
        stamps = [frame.timestamp_ns for frame in islice(source, 30)]
    assert stamps == sorted(set(stamps))
    assert source.skipped["of /cam/depth that are broken"] >= 6
    assert "a message on /cam/depth" in caplog.text


def test_a_message_that_was_on_its_way_when_its_topic_was_left_is_dropped(place: tuple[int, str]) -> None:
    """A transport's own thread may deliver it later; the second camera's size would be nobody's."""
    libraries("zenoh")
    from tsfusion.datasets.ros2.middleware import CdrMessage

    held = Held()
    held.bag.camera_info("/left/camera_info", CAMERA, SHAPE, T0)
    ((topic, kind, raw),) = held.messages
    with source_of(place, one) as source:
        source._live._arrived(CdrMessage(Stream(topic, kind, 0), b"", 0, 0, raw))
        assert len(list(islice(source, 3))) == 3
    assert topic not in source._live.heard


def test_stamps_of_zero_are_times_of_arrival(place: tuple[int, str]) -> None:
    def more(bag: BagWriter, number: int) -> None:
        bag.camera_info("/cam/camera_info", CAMERA, SHAPE, 0)
        bag.transform(pose(0.01 * number), WORLD, OPTICAL, 0)
        bag.image("/cam/depth", wall(0).measurement, "16UC1", 0)

    began = time.time_ns()
    with source_of(place, more) as source:
        frames = list(islice(source, 5))
    assert began < frames[0].timestamp_ns < frames[-1].timestamp_ns < time.time_ns()
    assert frames[-1].T_world_camera is not None


def test_odometry_places_a_frame(place: tuple[int, str]) -> None:
    def more(bag: BagWriter, number: int) -> None:
        stamp = T0 + number * TENTH
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
        bag.camera_info("/cam/camera_info", CAMERA, SHAPE, stamp)
        bag.odometry("/odom", pose(0.01 * number), "odom", BODY, stamp)
        bag.image("/cam/depth", wall(0).measurement, "16UC1", stamp)

    with source_of(place, more) as source:
        frames = list(islice(source, 8))
    last = frames[-1]
    assert last.T_world_camera is not None
    expected = pose(0.01 * (last.timestamp_ns - T0) / TENTH) @ T_BODY_OPTICAL
    np.testing.assert_allclose(last.T_world_camera, expected, atol=1e-9)


def test_poses_stay_in_the_world_frame_of_the_first(
    place: tuple[int, str], caplog: pytest.LogCaptureFixture
) -> None:
    """A localisation that starts later puts `map` above `odom`."""
    T_map_odom = se3.exp(np.array([0.0, 0.0, 0.7, 2.0, 1.0, 0.0]))

    def more(bag: BagWriter, number: int) -> None:
        stamp = T0 + number * TENTH
        if number >= late:
            bag.transform(T_map_odom, "map", "odom", stamp)
        bag.camera_info("/cam/camera_info", CAMERA, SHAPE, stamp)
        bag.transform(pose(0.01 * number), "odom", OPTICAL, stamp)
        bag.image("/cam/depth", wall(0).measurement, "16UC1", stamp)

    late = 1_000_000
    with source_of(place, more) as source:
        posed = (frame for frame in islice(source, 200) if frame.T_world_camera is not None)
        list(islice(posed, 3))
        late = 0
        frames = list(islice(posed, 20))
    assert len(frames) == 20
    for frame in frames:
        expected = pose(0.01 * (frame.timestamp_ns - T0) / TENTH)
        np.testing.assert_allclose(frame.T_world_camera, expected, atol=1e-9)
    assert "'map' now leads to 'odom', in which poses stay" in caplog.text


def test_a_named_world_that_comes_late_is_waited_for(
    place: tuple[int, str], caplog: pytest.LogCaptureFixture
) -> None:
    def more(bag: BagWriter, number: int) -> None:
        one(bag, number)
        if number >= late:
            bag.transform(np.eye(4), "earth", WORLD, T0 + number * TENTH)

    late = 1_000_000
    with source_of(place, more, world_frame="earth") as source:
        frames = iter(source)
        assert next(frames).T_world_camera is None
        late = 0
        assert any(frame.T_world_camera is not None for frame in islice(frames, 40))
    assert "no transforms lead from 'earth'" in caplog.text


def test_several_topics_of_poses_are_no_matter_to_a_scan_that_finds_its_own(
    place: tuple[int, str], caplog: pytest.LogCaptureFixture
) -> None:
    def more(bag: BagWriter, number: int) -> None:
        stamp = T0 + number * TENTH
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
        bag.camera_info("/cam/camera_info", CAMERA, SHAPE, stamp)
        for topic in ("/odom", "/odometry/filtered"):
            bag.odometry(topic, pose(0.01 * number), "odom", BODY, stamp)
        bag.image("/cam/depth", wall(0).measurement, "16UC1", stamp)

    with source_of(place, more, posed=False) as source:
        assert [frame.T_world_camera for frame in islice(source, 10)][-1] is None
    assert "several topics hold poses (/odom, /odometry/filtered)" in caplog.text
    with pytest.raises(DatasetError, match="choose with pose_topic"), source_of(place, more) as source:
        list(islice(source, 40))


def test_what_tsfusion_publishes_is_no_sensor(place: tuple[int, str]) -> None:
    """A map that is shown to ROS has distances, points and poses of the scan that made it."""

    def more(bag: BagWriter, number: int) -> None:
        stamp = T0 + number * TENTH
        one(bag, number)
        bag.image("/tsfusion/distance", np.ones((4, 4), np.float32), "32FC1", stamp)
        bag.cloud("/tsfusion/points", records(), stamp)
        bag.write("/tsfusion/scanner_1/pose", bag.posed(pose(9.0), "tsfusion", stamp), stamp)

    with source_of(place, more) as source:
        (frame,) = islice(source, 1)
        assert {topic.name for topic in source._live.topics} == {"/cam/depth", "/cam/camera_info", "/tf"}
    assert frame.kind == "depth"


def test_a_flood_of_unknown_types_is_not_subscribed_to(place: tuple[int, str]) -> None:
    def more(bag: BagWriter, number: int) -> None:
        one(bag, number)
        raw = b"\0\1\0\0" + bytes(64)
        for i in range(100):
            bag._writer.messages.append((f"/flood/{i}", "std_msgs/msg/String", raw))

    with source_of(place, more) as source:
        assert len(list(islice(source, 5))) == 5
        assert len(source._live.topics) > 100
        assert set(source._live._subscribed) == {"/cam/depth", "/cam/camera_info", "/tf"}


def test_only_one_of_two_publishers_is_followed(
    place: tuple[int, str], caplog: pytest.LogCaptureFixture
) -> None:
    with source_of(place, one) as source, closing(sent(place)) as other:
        frames = iter(source)
        list(islice(frames, 3))
        held = Held()
        one(held.bag, 1_000_000)
        other.announce("/cam/depth", "sensor_msgs/msg/Image")
        until(lambda: other.listeners("/cam/depth"))
        held.send(other)
        stamps = []
        for frame in islice(frames, 400):  # of which many may have come before the other's
            stamps.append(frame.timestamp_ns)
            if source.skipped:
                break
    assert max(stamps) < T0 + 1_000_000 * TENTH
    assert "/cam/depth has several publishers" in caplog.text
    assert source.skipped["of another publisher of /cam/depth"] == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"depth_topic": "/wrong"}, "depth_topic='/wrong' is no topic of Image or CompressedImage"),
        ({"pose_topic": "/wrong"}, "pose_topic='/wrong' is no topic of poses"),
        ({"info_topic": "/wrong"}, "info_topic='/wrong' is no topic of CameraInfo"),
    ],
)
def test_wrong_topics_are_said(place: tuple[int, str], options: dict[str, str], words: str) -> None:
    with (
        pytest.raises(SourceError, match=re.escape(words)) as caught,
        source_of(place, one, wait=4.0, **options),
    ):
        pass
    assert "/cam/depth (sensor_msgs/Image)" in str(caught.value)


def test_a_camera_info_that_never_comes_is_said(place: tuple[int, str]) -> None:
    def more(bag: BagWriter, number: int) -> None:
        bag.image("/cam/depth", wall(0).measurement, "16UC1", T0 + number * TENTH)

    with pytest.raises(SourceError, match="no CameraInfo of /cam/depth"), source_of(place, more, wait=4.0):
        pass


def test_nobody_there_is_said(place: tuple[int, str]) -> None:
    libraries("dds")
    with pytest.raises(SourceError, match=r"no images and no point clouds; nobody publishes .*waited 1 s"):
        opened("dds", place, wait=1.0)


@pytest.mark.parametrize(
    ("spec", "options", "words"),
    [
        ("ros2:home", {}, "ros2 takes the number of a domain"),
        ("ros2:233", {}, "a ROS domain must be 0 to 232"),
        ("ros2", {"transport": "udp"}, "transport of ROS 2 must be dds or zenoh"),
        ("ros2", {"depth": "/cam/depth"}, "takes no `depth`"),
        ("ros2", {"wait": -5.0}, "wait=-5: expected seconds, 0 or more"),
    ],
)
def test_wrong_options_are_said(spec: str, options: dict[str, str], words: str) -> None:
    with pytest.raises(InvalidConfig, match=re.escape(words)):
        tsfusion.open_source(spec, **options)


@pytest.mark.parametrize("missing", [("zenoh",), ("cyclonedds", "zenoh")])
def test_missing_libraries_are_said(monkeypatch: pytest.MonkeyPatch, missing: tuple[str, ...]) -> None:
    for name in ("dds", "zenoh_session"):
        monkeypatch.delitem(sys.modules, f"tsfusion.datasets.ros2.{name}", raising=False)
    for name in missing:
        monkeypatch.setitem(sys.modules, name, None)
    words = "ROS 2 needs a library for " + ("zenoh" if len(missing) == 1 else "dds")
    transport = "zenoh" if len(missing) == 1 else None
    with pytest.raises(MissingDependency, match=rf"{words}.*pip install '.\[ros2\]'"):
        tsfusion.open_source("ros2", transport=transport)
