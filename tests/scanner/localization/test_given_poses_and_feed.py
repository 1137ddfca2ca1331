# SPDX-License-Identifier: MIT
"""Poses from elsewhere: the source's own, a trajectory file, a feed from another process."""

import contextlib
import json
import logging
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st
from repository import ROOT

from tsfusion.core.errors import DatasetError, DecodeError, InvalidConfig, TransportError
from tsfusion.datasets import open_dataset
from tsfusion.datasets.dataset import frame_of
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.datasets.worlds.synthetic import Synthetic
from tsfusion.geometry import se3, sweeps
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.trajectory import quaternion, rigid, slerp
from tsfusion.scanner.localization.given_poses import GivenPoses, TrajectoryFilePoses
from tsfusion.scanner.localization.localizer import Lost, TrackedPose
from tsfusion.scanner.localization.pose_feed.feed import MAX_BYTES, PoseFeed, PoseHistory, decode

SENDER = ROOT / "contrib" / "pose_sender.py"
DEADLINE = 20.0  # seconds
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def frame(stamp_ns: int, T: np.ndarray | None = None) -> Frame:
    return Frame(sensor="lidar", points=np.ones((1, 3), np.float32), timestamp_ns=stamp_ns, T_world_camera=T)


def way(seconds: float) -> np.ndarray:
    """A pose that goes on and turns."""
    return se3.exp(np.array([0.3, -0.1, 0.5, 0.02, 0.3, 0.01]) * seconds)


def seven(T: np.ndarray) -> list[float]:
    return [*T[:3, 3].tolist(), *quaternion(T[:3, :3]).tolist()]


def same(pose: TrackedPose | Lost, T: np.ndarray, within: float = 1e-9) -> None:
    assert isinstance(pose, TrackedPose), pose
    np.testing.assert_allclose(pose.T_world_camera, T, atol=within)


# ── given ──────────────────────────────────────────────────────────────────────────────────────────


def test_given_poses_are_believed() -> None:
    room, localizer = Synthetic("room", "lidar", count=12, color=False), GivenPoses()
    found = [localizer.track(room.frame(index)) for index in range(12)]
    for index, pose in enumerate(found):
        same(pose, room.pose(index))
    anchors = [pose for pose in found if isinstance(pose, TrackedPose) and pose.starts_anchor]
    assert [pose.anchor for pose in anchors] == list(range(len(anchors)))
    assert len(anchors) > 2
    assert localizer.corrections() is None
    assert localizer.absolute


def test_no_pose_given_is_lost() -> None:
    localizer = GivenPoses()
    assert isinstance(localizer.track(frame(1, way(0))), TrackedPose)
    assert localizer.track(frame(2)) == Lost(reason="the source gives no pose for this frame", timestamp_ns=2)
    localizer.reset()
    after = localizer.track(frame(3, way(1)))
    same(after, way(1))
    assert isinstance(after, TrackedPose)
    assert (after.anchor, after.starts_anchor) == (1, True)


# ── a file ─────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def tum(tmp_path: Path) -> Path:
    """Ten poses a second for a second, a gap of one, and another second."""
    path = tmp_path / "poses.txt"
    tenths = [*range(11), *range(20, 31)]
    write_tum(path, [START + k * SECOND // 10 for k in tenths], [way(k / 10) for k in tenths])
    return path


def test_trajectory_is_interpolated(tum: Path) -> None:
    localizer = TrajectoryFilePoses(tum, max_gap_s=0.15)
    same(localizer.track(frame(START)), way(0), 1e-8)
    same(localizer.track(frame(START + SECOND // 4)), way(0.25), 1e-3)
    exact = slerp(quaternion(way(0.2)[:3, :3]), quaternion(way(0.3)[:3, :3]), 0.5)
    same(localizer.track(frame(START + SECOND // 4)), rigid(exact, (way(0.2) + way(0.3))[:3, 3] / 2), 1e-8)
    shifted = TrajectoryFilePoses(tum, max_gap_s=0.15, time_offset_s=-0.5)
    same(shifted.track(frame(START + SECOND)), way(0.5), 1e-8)
    assert localizer.absolute


@pytest.mark.parametrize(
    ("seconds", "reason"),
    [
        (1.5, "the trajectory has a gap of 1.000 s here (at most 0.15 s is bridged)"),
        (-0.5, "the frame is 0.500 s before the trajectory begins"),
        (3.25, "the frame is 0.250 s after the trajectory ends"),
        (1000, "the frame is 997.000 s after the trajectory ends: are these the same clock?"),
    ],
)
def test_no_pose_at_that_time_is_lost(tum: Path, seconds: float, reason: str) -> None:
    stamp = START + round(seconds * SECOND)
    found = TrajectoryFilePoses(tum, max_gap_s=0.15).track(frame(stamp))
    assert found == Lost(reason=reason, timestamp_ns=stamp)


def test_kitti_file_with_its_times(data: Callable[[str], Path]) -> None:
    root = data("kitti_odometry")
    dataset = open_dataset(root, sequence="06", modality="stereo")
    localizer = TrajectoryFilePoses(root / "poses" / "06.txt", max_gap_s=0.2)
    for index in (0, 3, 29):
        same(localizer.track(frame_of(dataset, index)), dataset[index].T_world_camera)


def test_a_source_without_times_gets_one_pose_at_most(data: Callable[[str], Path]) -> None:
    localizer = TrajectoryFilePoses(data("kitti_odometry") / "poses" / "06.txt", max_gap_s=0.2)
    assert isinstance(localizer.track(frame(0)), TrackedPose)  # KITTI's clock begins at 0
    lost = localizer.track(frame(0))
    assert isinstance(lost, Lost)
    assert "no time" in lost.reason


ROW = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("poses", "times", "message"),
    [
        (ROW, None, r"has no times \(KITTI's format\); put them beside it as .*times.txt"),
        (ROW * 3, "0\n1\n", "has 2 lines, .* has 3 poses"),
        (ROW * 3, "0\n2\n1\n", "time 3 is not after the one before it"),
        ("1 2 3\n", None, "1 lines; expected five a pose"),
        ("# nothing\n", None, "is no trajectory: .*got 0"),
    ],
)
def test_useless_files_are_explained(tmp_path: Path, poses: str, times: str | None, message: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(poses, encoding="utf-8")
    if times is not None:
        (tmp_path / "times.txt").write_text(times, encoding="utf-8")
    with pytest.raises(DatasetError, match=message):
        TrajectoryFilePoses(path, max_gap_s=0.1)


# ── a feed ─────────────────────────────────────────────────────────────────────────────────────────


class Sender:
    """The documented sender, as a process of its own."""

    def __init__(self, address: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(SENDER), address, "connect"], stdin=subprocess.PIPE, text=True
        )
        self._lines: IO[str] = self._process.stdin

    def say(self, seconds: float, rest: str) -> None:
        stamp = START + round(seconds * SECOND)
        self._lines.write(f"{stamp // SECOND}.{stamp % SECOND:09d} {rest}\n")
        self._lines.flush()

    def pose(self, seconds: float) -> None:
        self.say(seconds, " ".join(f"{number!r}" for number in seven(way(seconds))))

    def close(self) -> None:
        self._lines.close()
        assert self._process.wait(DEADLINE) == 0


@pytest.fixture
def feed() -> Iterator[PoseFeed]:
    with PoseFeed("@tcp://127.0.0.1:0", max_gap_s=0.15, wait_s=0.05) as made:
        yield made


def wait_until_received(feed: PoseFeed, say: Callable[[int], None]) -> None:
    """Speak until somebody listens: what is published before is nobody's."""
    until, count = time.monotonic() + DEADLINE, 0
    while not feed.received:
        assert time.monotonic() < until, "no message arrived"
        say(count)
        count += 1
        feed.track(frame(START - 1000 * SECOND))


def test_the_documented_sender_drives_it(feed: PoseFeed) -> None:
    sender = Sender(feed.address)
    try:
        wait_until_received(feed, lambda count: sender.pose(-100 + count))
        for tenth in range(6):
            sender.pose(tenth / 10)
        same(follow(feed, 0.5), way(0.5))
        same(feed.track(frame(START + SECOND // 4)), way(0.25), 1e-3)
        sender.say(0.6, "lost")
        sender.pose(0.7)
        same(follow(feed, 0.7), way(0.7))
        between = feed.track(frame(START + 65 * SECOND // 100))
        assert isinstance(between, Lost)
        assert "no pose within 0.15 s on both sides" in between.reason
        silent = feed.track(frame(START + 5 * SECOND))
        assert isinstance(silent, Lost)
        assert "is 4.300 s older than the frame, after 0.05 s of waiting" in silent.reason
        assert not feed.dropped
    finally:
        sender.close()


def test_the_documented_sender_passes_over_what_is_no_pose(feed: PoseFeed) -> None:
    seconds = START // SECOND
    lines = "# timestamp tx ty tz qx qy qz qw", "", "now 0 0 0 0 0 0 1", f"{seconds} 0 0 0", f"{seconds} here"
    pose = f"{seconds} " + " ".join(f"{number!r}" for number in seven(way(0.0)))
    with subprocess.Popen(
        [sys.executable, str(SENDER), feed.address, "connect"], stdin=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    ) as sender:  # fmt: skip
        until = time.monotonic() + DEADLINE
        sender.stdin.write("\n".join((*lines, "NaN 0 0 0 0 0 0 1", "Infinity lost", "")))
        while not feed.received:
            assert time.monotonic() < until, "no message arrived"
            sender.stdin.write(f"{pose}\n")
            sender.stdin.flush()
            feed.track(frame(START))
        same(follow(feed, 0.0), way(0.0))
        sender.stdin.close()
        complaints = sender.stderr.read().splitlines()
        assert sender.wait(DEADLINE) == 0
    assert [line.split(" is no ")[0] for line in complaints] == [f"line {n}" for n in (3, 4, 5, 6, 7)]
    assert not feed.dropped


def encoded(message: Any) -> bytes:
    """Bytes as they are, and anything else as JSON."""
    return message if isinstance(message, bytes) else json.dumps(message).encode()


@contextlib.contextmanager
def publisher(address: str) -> Iterator[Callable[[Any], None]]:
    with zmq.Context() as context, context.socket(zmq.PUB) as made:
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.SNDHWM, 10_000)
        made.connect(address)
        yield lambda message: made.send(encoded(message))


def posed(seconds: float, T: np.ndarray | None = None) -> dict[str, Any]:
    T = way(seconds) if T is None else T
    return {"stamp_ns": START + round(seconds * SECOND), "pose": seven(T)}


def follow(feed: PoseFeed, seconds: float) -> TrackedPose:
    """The feed's pose at a time, as soon as it is there."""
    until = time.monotonic() + DEADLINE
    while isinstance(found := feed.track(frame(START + round(seconds * SECOND))), Lost):
        assert time.monotonic() < until, found.reason
    return found


def test_a_frame_waits_for_the_pose_after_it() -> None:
    with (
        PoseFeed("@tcp://127.0.0.1:0", max_gap_s=0.15, wait_s=DEADLINE) as feed,
        publisher(feed.address) as send,
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(feed, "_wait", 0.05)
            wait_until_received(feed, lambda count: send(posed(-100 + count)))
        send(posed(0.0))
        feed.track(frame(START))
        code = (
            "import json, sys, zmq\n"
            "with zmq.Context() as c, c.socket(zmq.PUB) as s:\n"
            "    s.connect(sys.argv[1])\n"
            "    while s.poll(20, zmq.POLLIN) == 0: s.send(sys.argv[2].encode())\n"
        )
        later = subprocess.Popen([sys.executable, "-c", code, feed.address, json.dumps(posed(0.1))])
        try:
            same(feed.track(frame(START + SECOND // 20)), way(0.05), 1e-3)
        finally:
            later.kill()
            later.wait()


def test_poses_between_frames_tell_the_motion_in_a_sweep(feed: PoseFeed) -> None:
    with publisher(feed.address) as send:
        wait_until_received(feed, lambda count: send(posed(-100 + count)))
        for k in range(40):
            send(posed(k / 100))
        times = np.linspace(-0.05, 0.1, 5, dtype=np.float32)
        sweep = replace(frame(START + SECOND // 5), points=np.ones((5, 3), np.float32), point_times_s=times)
        until = time.monotonic() + DEADLINE
        while isinstance(found := feed.track(sweep), Lost):
            assert time.monotonic() < until, found.reason
    put_right = sweeps.at_stamp(sweep.points, times, found.motion)
    for point, t in zip(put_right, times.tolist(), strict=True):
        np.testing.assert_allclose(
            point, se3.apply(se3.inverse(way(0.2)) @ way(0.2 + t), np.ones(3)), atol=1e-4
        )


def test_matrices_and_messagepack_are_understood(feed: PoseFeed) -> None:
    with publisher(feed.address) as send:
        wait_until_received(feed, lambda count: send(posed(-100 + count)))
        send({"stamp_ns": START, "pose": way(0).ravel().tolist(), "frame": "odom"})
        send(msgspec.msgpack.encode(posed(0.1)))
        same(follow(feed, 0.1), way(0.1))
        same(follow(feed, 0.0), way(0.0))
        assert not feed.dropped


BAD: list[Any] = [
    b"",
    b"{",
    b"\xff\x00\x17",
    b"{" * 100_000,
    b"\x91" * 100_000,
    [1, 2],
    {"stamp_ns": START},
    {"stamp_ns": START, "pose": [0.0] * 7},
    {"stamp_ns": START, "pose": [0, 0, 0, 0, 0, 0, 2]},
    {"stamp_ns": START, "pose": [0] * 9},
    {"stamp_ns": START, "pose": [0] * 17},
    {"stamp_ns": START, "pose": [1] * 16},
    {"stamp_ns": START, "pose": [1e300, 0, 0, 0, 0, 0, 1]},
    {"stamp_ns": START, "pose": [0, 0, 0, 0, 0, 0, 1], "lost": True},
    {"stamp_ns": "now", "pose": [0, 0, 0, 0, 0, 0, 1]},
    {"stamp_ns": 0, "pose": [0, 0, 0, 0, 0, 0, 1]},
    {"stamp_ns": 2**63, "pose": [0, 0, 0, 0, 0, 0, 1]},
    {"stamp_ns": 10**400, "pose": [0, 0, 0, 0, 0, 0, 1]},
    {"pose": [0, 0, 0, 0, 0, 0, 1]},
    {"lost": True},
    {"corrections": {"stamps_ns": [1, 2], "poses": [[0, 0, 0, 0, 0, 0, 1]]}},
    msgspec.msgpack.encode({"stamp_ns": START, "pose": [math.nan, 0, 0, 0, 0, 0, 1]}),
    msgspec.msgpack.encode({"stamp_ns": START, "pose": [0, 0, 0, 0, 0, 0, math.inf]}),
]


@pytest.mark.parametrize("index", range(len(BAD)))
def test_what_is_no_pose_is_refused(index: int) -> None:
    with pytest.raises(DecodeError):
        decode(encoded(BAD[index]))


@given(st.binary(max_size=200))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_a_pose_or_refused(message: bytes) -> None:
    with contextlib.suppress(DecodeError):
        decode(message)


def test_hostile_messages_are_counted_and_dropped(feed: PoseFeed, caplog: pytest.LogCaptureFixture) -> None:
    with publisher(feed.address) as send, zmq.Context() as context, context.socket(zmq.PUB) as parts:
        wait_until_received(feed, lambda count: send(posed(-100 + count)))
        before = feed.received
        with caplog.at_level(logging.WARNING):
            for message in BAD:
                send(message)
            send(posed(0.0))
            same(follow(feed, 0.0), way(0.0))
        assert feed.received == before + 1
        assert feed.dropped.total() == len(BAD)
        assert sum("is no pose and was dropped" in record.getMessage() for record in caplog.records) == 1
        parts.setsockopt(zmq.LINGER, 0)
        parts.connect(feed.address)
        until = time.monotonic() + DEADLINE
        while not feed.dropped["a message has 1 frame"]:
            assert time.monotonic() < until
            parts.send_multipart([b"topic", json.dumps(posed(0.1)).encode()])
            feed.track(frame(START))


def test_a_message_that_is_too_long_costs_its_connection_only(feed: PoseFeed) -> None:
    with publisher(feed.address) as send:
        wait_until_received(feed, lambda count: send(posed(-100 + count)))
        send(b"{" + b" " * MAX_BYTES)
    with publisher(feed.address) as send:
        until = time.monotonic() + DEADLINE
        while isinstance(feed.track(frame(START)), Lost):
            assert time.monotonic() < until
            send(posed(0.0))


def test_a_connection_that_libzmq_gave_up_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a message that is too long it never tries again to connect."""
    monkeypatch.setattr("tsfusion.scanner.localization.pose_feed.feed.RECONNECT_AFTER", 0.5)
    with zmq.Context() as context, context.socket(zmq.PUB) as made:
        made.setsockopt(zmq.LINGER, 0)
        address = f"tcp://127.0.0.1:{made.bind_to_random_port('tcp://127.0.0.1')}"
        with PoseFeed(address, max_gap_s=0.15, wait_s=0.05) as feed:
            wait_until_received(feed, lambda count: made.send(json.dumps(posed(-100 + count)).encode()))
            made.send(b"{" + b" " * MAX_BYTES)
            until = time.monotonic() + DEADLINE
            while isinstance(feed.track(frame(START)), Lost):
                assert time.monotonic() < until
                made.send(json.dumps(posed(0.0)).encode())


def test_a_flood_does_not_hold_up_a_frame(feed: PoseFeed) -> None:
    code = (
        "import sys, zmq\n"
        "with zmq.Context() as c, c.socket(zmq.PUB) as s:\n"
        "    s.connect(sys.argv[1])\n"
        "    while True: s.send(b'x' * 100)\n"
    )
    flood = subprocess.Popen([sys.executable, "-c", code, feed.address])
    try:
        until = time.monotonic() + DEADLINE
        while feed.dropped.total() < 5000:
            assert time.monotonic() < until
            before = time.monotonic()
            feed.track(frame(START))
            assert time.monotonic() - before < 5
        assert len(feed.dropped) == 1
    finally:
        flood.kill()
        flood.wait()


def test_large_graphs_one_after_the_other_do_not_hold_up_a_frame(feed: PoseFeed) -> None:
    stamps = [START + index for index in range(2000)]
    graph = {"stamps_ns": stamps, "poses": [[0.0, 0, 0, 0, 0, 0, 1]] * len(stamps)}
    with publisher(feed.address) as send:
        wait_until_received(feed, lambda count: send(posed(-100 + count)))
        received = feed.received
        for _ in range(100):
            send({"corrections": graph})
        until = time.monotonic() + DEADLINE
        while feed.received == received:
            assert time.monotonic() < until
            before = time.thread_time()
            feed.track(frame(START))
            assert time.thread_time() - before < 3


def test_corrections_move_the_tracking_keyframes(feed: PoseFeed) -> None:
    """Odometry drifts sideways by 1 cm in 0.1 s; the sender's loop closure finds out at 1.0 s."""
    with publisher(feed.address) as send:
        wait_until_received(feed, lambda count: send(posed(-100 + count)))
        feed.reset()

        def straight(seconds: float, drift: float = 0.0) -> np.ndarray:
            T = np.eye(4)
            T[:3, 3] = (drift * seconds, 0, 2 * seconds)
            return T

        found: dict[int, TrackedPose] = {}
        for tenth in range(11):
            send(posed(tenth / 10, straight(tenth / 10, 0.1)))
            found[tenth] = follow(feed, tenth / 10)
        assert feed.corrections() is None
        nodes = [0, 3, 10]
        graph = {
            "stamps_ns": [START + k * SECOND // 10 for k in reversed(nodes)] + [START - 500 * SECOND],
            "poses": [seven(straight(k / 10)) for k in reversed(nodes)] + [seven(np.eye(4))],
            "loops": 1,
        }
        send({"corrections": graph})
        until = time.monotonic() + DEADLINE
        while (corrections := feed.corrections()) is None:
            assert time.monotonic() < until
            feed.track(frame(START))
        assert corrections.loops == 1
        anchors = {pose.anchor: tenth for tenth, pose in found.items() if pose.starts_anchor}
        assert len(anchors) > 2
        assert set(anchors) <= set(corrections.anchors)
        for anchor, tenth in anchors.items():
            np.testing.assert_allclose(corrections.anchors[anchor], straight(tenth / 10), atol=1e-9)
        moved = corrections.T_corrected_world @ found[10].T_world_camera
        np.testing.assert_allclose(moved, straight(1.0), atol=1e-9)
        assert feed.corrections() is None
        move = np.eye(4)
        move[0, 3] = 7.0
        send({**posed(1.1), "corrections": {"stamps_ns": [], "poses": [], "T_corrected_world": seven(move)}})
        follow(feed, 1.1)
        second = feed.corrections()
        np.testing.assert_allclose(second.T_corrected_world, move, atol=1e-12)


def test_a_sender_that_binds_may_come_later_and_again() -> None:
    with zmq.Context() as context, context.socket(zmq.PUB) as probe:
        port = probe.bind_to_random_port("tcp://127.0.0.1")
    address = f"tcp://127.0.0.1:{port}"
    with PoseFeed(address, max_gap_s=0.15, wait_s=0.05) as feed:
        assert feed.address == address
        nothing = feed.track(frame(START))
        assert isinstance(nothing, Lost)
        assert nothing.reason == f"no pose has come from {address} yet"
        for turn in range(2):
            with zmq.Context() as context, context.socket(zmq.PUB) as made:
                made.setsockopt(zmq.LINGER, 0)
                made.bind(address)
                until = time.monotonic() + DEADLINE
                while isinstance(feed.track(frame(START + turn * SECOND)), Lost):
                    assert time.monotonic() < until
                    made.send(json.dumps(posed(turn)).encode())


def test_what_cannot_be_listened_to_is_explained(feed: PoseFeed) -> None:
    nothing = feed.track(frame(START))
    assert isinstance(nothing, Lost)
    assert f"@{feed.address}, where it listens" in nothing.reason
    for address, message in (
        ("5570", "an address looks like"),
        ("tcp://127.0.0.1:0", "connecting needs a port"),
        ("@tcp://0.0.0.0:5570", r"only tcp://127.0.0.1 can be bound"),
    ):
        with pytest.raises(InvalidConfig, match=message):
            PoseFeed(address, max_gap_s=0.1)
    with pytest.raises(TransportError, match="cannot listen"):
        PoseFeed(f"@{feed.address}", max_gap_s=0.1)
    without = feed.track(frame(0))
    assert isinstance(without, Lost)
    assert "no time" in without.reason


def test_another_clock_is_named(feed: PoseFeed) -> None:
    with publisher(feed.address) as send:
        wait_until_received(feed, lambda count: send(posed(count)))
        lost = feed.track(frame(5 * SECOND))
        assert isinstance(lost, Lost)
        assert "same clock?" in lost.reason


def test_history_forgets_the_oldest_and_takes_any_order() -> None:
    history = PoseHistory(limit=100)
    order = np.random.default_rng(0).permutation(150)
    for k in order:
        history.add(int(k + 1) * SECOND, way(float(k)))
    assert 90 <= len(history) <= 100
    assert history.last_ns == 150 * SECOND
    exact = history.at(150 * SECOND, max_gap_ns=SECOND)
    np.testing.assert_allclose(exact, way(149.0), atol=1e-9)
    assert history.at(SECOND // 2, max_gap_ns=SECOND) is None
    history.add(150 * SECOND, None)
    assert history.at(150 * SECOND, max_gap_ns=SECOND) is None
    assert len(history) <= 100
