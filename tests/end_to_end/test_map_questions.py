# SPDX-License-Identifier: MIT
"""Questions to the map of a running server: real processes, real sockets."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq
from command_processes import python
from keyframes_and_servers import CAMERA, DEADLINE, SHAPE, VOLUME, Server, serving, until, wall
from numpy.typing import NDArray

from tsfusion import AnswerLate, Client, InvalidConfig, MapClient, ServerUnreachable, Volume
from tsfusion.core.errors import TransportError
from tsfusion.geometry import map_questions
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.map_answers import View
from tsfusion.geometry.map_questions import MOST_POINTS, Field, Raycast, Sample, Slice
from tsfusion.wire.asking.queries import CommandRefused, fetch_health, forget
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.messages import Command, Reply
from tsfusion.wire.messages.questions import Cells, Following, Keyframes
from tsfusion.wire.sockets import sockets

COUNT = 4
EASY = 30.0  # seconds for an answer that is there in milliseconds


def gray(i: int) -> Keyframe:
    """A wall whose colours no JPEG changes: without any."""
    return replace(wall(i), color=None)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server whose map has some walls."""
    with serving(tmp_path_factory.mktemp("state")) as running:
        scan(running)
        yield running


def scan(server: Server) -> None:
    with Client(server.address) as client:
        for i in range(COUNT):
            client.send(gray(i))
        client.wait_settled(DEADLINE)


def points(n: int = 500) -> NDArray[np.float32]:
    low, high = (-0.8, -0.6, 1.0), (0.8, 0.6, 1.5)
    return np.random.default_rng(3).uniform(low, high, (n, 3)).astype(np.float32)


def counts(server: Server) -> dict[str, int]:
    return fetch_health(server.address).maps["default"].questions


def test_answers_are_those_of_the_map_itself(server: Server) -> None:
    """Also compressed, and up to the most points of a question: the same arrays, of a state that is named."""
    volume = Volume(VOLUME)
    for i in range(COUNT):
        volume.integrate(gray(i))
    for compress in (False, True):
        with MapClient(server.address, compress=compress, timeout=EASY) as asked:
            many = asked.sample(points(MOST_POINTS))
            one = asked.sample(points(1), surface=None, min_weight=2.0)
            view = asked.raycast(CAMERA, np.eye(4), SHAPE)
            bare = asked.raycast(CAMERA, np.eye(4), SHAPE, normals=False, colors=False)
        equal(bare.result, View(view.result.depth))
        equal(many.result, volume.sample(points(MOST_POINTS), surface="raw"))
        equal(one.result, volume.sample(points(1), min_weight=2.0))
        equal(view.result, volume.raycast(CAMERA, np.eye(4), SHAPE, surface="raw"))
        assert np.isfinite(many.result.distance).any()
        assert (view.result.depth > 0).any()
        assert many.state == view.state
        assert (many.state.keyframes, many.state.segment) == (COUNT, 1)
        assert many.delay_s > many.took_s > 0


def equal(one: Any, other: Any) -> None:
    """Two results of the same kind, array by array."""
    assert type(one) is type(other)
    for name, value in vars(other).items():
        found = getattr(one, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(found, value, strict=True)
        elif hasattr(value, "__dict__"):
            equal(found, value)
        else:
            assert found == value


SLICE: dict[str, Any] = {"up": "-y", "box": (-1, -2, 2, 0), "resolution": 0.05, "max_distance": 0.4}
BOX = (-0.4, -0.4, 1.0, 0.4, 0.4, 1.4)


def test_answers_follow_the_map(tmp_path: Path) -> None:
    """While a scan comes in, each answer is of one state, and the states move on.

    Slices are those of the map as it is then, also after keyframes were forgotten. When the fuser dies, the
    same client asks on, until the server dies.
    """
    volume = Volume(VOLUME)
    with serving(tmp_path) as running, MapClient(running.address, timeout=EASY) as asked:
        with Client(running.address) as client:
            for i in range(30):
                client.send(gray(i % 8))
                volume.integrate(gray(i % 8))
            seen = [asked.sample(points(50)).state for _ in range(20)]
            client.wait_settled(DEADLINE)
        assert [one.changes for one in seen] == sorted(one.changes for one in seen)
        assert all(one.keyframes == one.changes for one in seen)
        same_slices(asked, volume)
        scan(running)
        for i in range(COUNT):
            volume.integrate(gray(i))
        same_slices(asked, volume)
        forget(running.address, Selection(numbers=((1, 1),), session=session_of(running)))
        until(lambda: asked.sample(points(1)).state.keyframes == 30 + COUNT - 1)
        volume.retract(gray(0))
        same_slices(asked, volume)
        whole = asked.distance_slice(-0.2, 0.2, up="-y").result  # around the map, with its own voxels
        equal(whole, volume.distance_slice(-0.2, 0.2, up="-y"))
        before = asked.sample(points())
        os.kill(running.fuser_pid(), signal.SIGKILL)
        until(lambda: again(asked, volume.keyframes))
        after = asked.sample(points())
        equal(after.result, before.result)
        assert after.state.epoch != before.state.epoch
        running.kill()
        with pytest.raises(ServerUnreachable):
            asked.sample(points(1), timeout=0.2)


def session_of(server: Server) -> str:
    """The first session that sent something, as a person names it."""
    clients = fetch_health(server.address).clients
    return min(clients, key=lambda one: -one.heard_s).session


def same_slices(asked: MapClient, volume: Volume) -> None:
    equal(asked.occupancy_slice(-0.2, 0.2, **SLICE).result, volume.occupancy_slice(-0.2, 0.2, **SLICE))
    equal(asked.distance_slice(-0.2, 0.2, **SLICE).result, volume.distance_slice(-0.2, 0.2, **SLICE))
    field = asked.distance_field(BOX, max_distance=0.3)
    equal(field.result, volume.distance_field(BOX, max_distance=0.3))
    assert field.state.keyframes == volume.keyframes


def test_the_client_needs_no_taichi() -> None:
    python("import sys, tsfusion; tsfusion.MapClient; assert 'taichi' not in sys.modules")


class Raw:
    """A connection that sends whatever it likes."""

    def __init__(self, server: Server) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self._link = sockets.dealer(self._context)
        self._link.connect(server.control)

    def send(self, *frames: bytes) -> None:
        assert self._link.poll(EASY * 1000, zmq.POLLOUT)
        self._link.send_multipart(frames)

    def ask(self, question: Any, *frames: bytes, **fields: Any) -> Reply:
        """The reply to a question."""
        command = Command(name="ask", question=question, **{"timeout_s": EASY, **fields})
        self.send(messages.encode(command), *frames)
        return self.reply()

    def reply(self) -> Reply:
        assert self._link.poll(EASY * 1000), "no reply"
        reply = messages.decode_to_client(self._link.recv_multipart()[0])
        assert isinstance(reply, Reply)
        return reply

    def close(self) -> None:
        self._link.close()
        self._context.term()


GOOD = points(3).tobytes()
SAMPLE = Sample(points=3, crc=map_questions.crc_of([GOOD]))
LOOK = Raycast(intrinsics=(40, 40, 31.5, 23.5), pose=tuple(np.eye(4).ravel().tolist()), shape=(4, 4))
FLAT = Slice(kind="distance", low=0.0, high=0.1, up=(0.0, -1.0, 0.0), box=(-1, -1, 1, 1), resolution=0.05)
AROUND = Field(box=BOX, max_distance=0.3)
NAN = np.array([[0, np.nan, 1]], "<f4").tobytes()


def changed(question: Any, **fields: Any) -> Any:
    return msgspec.structs.replace(question, **fields)


@pytest.mark.parametrize(
    ("question", "frames", "why"),
    [
        (changed(SAMPLE, points=10**9), [GOOD], "1 to 20000 points, got 1000000000"),
        (changed(SAMPLE, points=-1), [], "1 to 20000 points"),
        (SAMPLE, [], "36 bytes"),
        (SAMPLE, [GOOD[:-4]], "36 bytes"),
        (SAMPLE, [GOOD, b"x"], "36 bytes"),
        (changed(SAMPLE, crc=7), [GOOD], "CRC-32"),
        (Sample(points=1, crc=map_questions.crc_of([NAN])), [NAN], "finite"),
        (changed(SAMPLE, min_weight=float("nan")), [GOOD], "min_weight"),
        (LOOK, [GOOD], "without points"),
        (changed(LOOK, shape=(1 << 40, 1)), [], "shape"),
        (changed(LOOK, shape=(4096, 4096)), [], "1048576 pixels"),
        (changed(LOOK, pose=(float("nan"),) * 16), [], ""),
        (changed(LOOK, intrinsics=(0.0, 1.0, float("inf"), 1.0)), [], "intrinsics"),
        (changed(FLAT, up=(0.0, 0.0, 0.0)), [], "direction"),
        (changed(FLAT, low=float("nan")), [], "finite"),
        (changed(FLAT, resolution=1e-4), [], "1048576 cells"),
        (changed(AROUND, max_distance=1e9), [], "max_distance"),
        (Cells(wait_s=0.0), [GOOD], "without points"),
        (Cells(), [], "earlier version"),
        (Cells(wait_s=1e9), [], "may wait 1 s"),
        (Cells(wait_s=0.0, since=-1), [], "since is from 0"),
        (Cells(wait_s=0.0, since=1 << 63), [], "since is from 0"),
        (Keyframes(), [GOOD], "without points"),
        (Keyframes(after=-1), [], "number"),
        (None, [], "nothing was asked"),
    ],
)
def test_a_bad_question_is_refused_and_counted(
    server: Server, question: Any, frames: list[bytes], why: str
) -> None:
    """By the server: the client would not have sent it. Viewers' questions are not among a map's counts."""
    before, asked_before = fetch_health(server.address), counts(server)
    with closing(Raw(server)) as link:
        reply = link.ask(question, *frames, number=5)
        assert why in (reply.error or "")
        assert (reply.answer, reply.number) == (None, 5)
        assert link.ask(SAMPLE, GOOD).answer is not None  # it lives
    after = fetch_health(server.address)
    assert after.refused.get("question", 0) == before.refused.get("question", 0) + 1
    counted = not isinstance(question, Following)
    assert counts(server).get("refused", 0) == asked_before.get("refused", 0) + counted


def test_bad_times_and_bad_messages(server: Server) -> None:
    with closing(Raw(server)) as link:
        for seconds in (0.0, -1.0, float("nan"), float("inf"), 1e9):
            assert "may wait" in (link.ask(SAMPLE, GOOD, timeout_s=seconds).error or "")
        refused = fetch_health(server.address).refused.get("control", 0)
        short = msgspec.msgpack.encode(
            {"type": "command", "name": "ask", "question": {"type": "raycast", "pose": [1.0]}}
        )
        link.send(short)  # no pose
        link.send(messages.encode(Command(name="ping")), b"more")
        assert link.ask(SAMPLE, GOOD).answer is not None
    assert fetch_health(server.address).refused["control"] == refused + 2


def test_what_is_too_large_is_an_error_of_the_fuser(server: Server) -> None:
    """Bounds that only the map knows: how large its voxels are, and whether there are so many."""
    before = counts(server).get("failed", 0)
    with MapClient(server.address, timeout=EASY) as asked:
        for box, farthest in ((BOX, 20.0), ((-90, -90, -90, 90, 90, 90), 0.1)):
            with pytest.raises(CommandRefused, match="4194304 voxels"):
                asked.distance_field(box, max_distance=farthest)
        with pytest.raises(CommandRefused, match="at most 1048576 cells"):
            asked.occupancy_slice(0, 0.1, up="-y", box=(-900, -900, 900, 900))
        with pytest.raises(CommandRefused, match="resolution"):
            asked.distance_slice(0, 0.1, up="-y", resolution=0.001, box=(-0.01, -0.01, 0.01, 0.01))
    assert counts(server)["failed"] == before + 4


def test_what_the_client_does_not_ask(server: Server) -> None:
    with MapClient(server.address) as asked:
        for bad in (np.zeros((0, 3)), [[0, 0, np.nan]], np.zeros((MOST_POINTS + 1, 3)), np.zeros(3)):
            with pytest.raises(InvalidConfig):
                asked.sample(bad)
        with pytest.raises(InvalidConfig, match="timeout"):
            asked.sample(points(1), timeout=0)
        with pytest.raises(InvalidConfig, match="pixels"):
            asked.raycast(CAMERA, np.eye(4), (4000, 4000))


@pytest.mark.parametrize("age", [-0.1, -np.inf, np.inf, np.nan, 61.0])
def test_an_age_out_of_range_is_asked_by_nobody_and_refused(server: Server, age: float) -> None:
    with MapClient(server.address) as asked, pytest.raises(InvalidConfig, match="max_age must be 0 to 60 s"):
        asked.raycast(CAMERA, np.eye(4), SHAPE, max_age=age)
    before = fetch_health(server.address).refused.get("question", 0)
    with closing(Raw(server)) as link:
        refused = link.ask(msgspec.structs.replace(LOOK, max_age=age))
        assert "max_age must be 0 to 60 s" in (refused.error or "")
        assert refused.answer is None
    assert fetch_health(server.address).refused["question"] == before + 1


@pytest.mark.parametrize("age", ["0.2", "soon", b"1", None, [0.2], 10**400, 1j])
def test_an_age_that_is_no_number(server: Server, age: Any) -> None:
    with MapClient(server.address) as asked, pytest.raises(InvalidConfig, match="max_age must be a number"):
        asked.raycast(CAMERA, np.eye(4), SHAPE, max_age=age)


def test_an_age_in_words_is_a_message_that_is_refused(server: Server) -> None:
    before = fetch_health(server.address).refused.get("control", 0)
    question = msgspec.to_builtins(LOOK) | {"max_age": "soon"}
    with closing(Raw(server)) as link:
        link.send(msgspec.msgpack.encode({"type": "command", "name": "ask", "question": question}))
        assert link.ask(SAMPLE, GOOD).answer is not None
    assert fetch_health(server.address).refused["control"] == before + 1


def test_an_answer_that_is_late_is_an_error_in_time(server: Server) -> None:
    """The fuser stands still: the question ends after its own time, and the next one is answered."""
    late = counts(server).get("late", 0)
    with MapClient(server.address) as asked:
        asked.sample(points(1), timeout=EASY)
        pid = server.fuser_pid()
        os.kill(pid, signal.SIGSTOP)
        began = time.monotonic()
        try:
            with pytest.raises(AnswerLate):
                asked.sample(points(1), timeout=0.2)
            assert time.monotonic() - began < 10
            until(lambda: counts(server).get("late", 0) == late + 1)
        finally:
            os.kill(pid, signal.SIGCONT)
        assert asked.sample(points(1), timeout=EASY).state.keyframes == COUNT


def again(asked: MapClient, keyframes: int) -> bool:
    """Whether the map has all its keyframes again."""
    try:
        return asked.sample(points(1)).state.keyframes == keyframes
    except CommandRefused as error:
        if not error.retry:
            raise
        return False


@pytest.mark.nightly
def test_each_client_has_so_many_questions_a_second(tmp_path: Path) -> None:
    """The rate is each connection's own where there are no keys."""
    with (
        serving(tmp_path, quota_questions=1e-3) as running,
        MapClient(running.address, timeout=EASY) as asked,
        MapClient(running.address, timeout=EASY) as other,
    ):
        asked.sample(points(1))
        with pytest.raises(CommandRefused, match="questions a second") as caught:
            asked.sample(points(1))
        assert caught.value.retry
        other.sample(points(1))
        assert counts(running) == {"answered": 2, "refused": 1}


def test_a_server_of_another_version_is_named() -> None:
    """A server of version 2 answers a ping without its version."""
    context: zmq.Context[Any] = zmq.Context()
    link = sockets.router(context)
    port = link.bind_to_random_port("tcp://127.0.0.1")

    def answer() -> None:
        greeted = 0
        while greeted < 2 and link.poll(EASY * 1000):
            identity, *frames = link.recv_multipart()
            if msgspec.msgpack.decode(frames[0])["name"] == "ping":
                link.send_multipart([identity, msgspec.msgpack.encode({"type": "reply", "name": "ping"})])
                greeted += 1

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        words = "version 2 of the wire format, this client 3: update the older one"
        address = f"tcp://127.0.0.1:{port - 1}"
        with MapClient(address, timeout=EASY) as asked, pytest.raises(TransportError, match=words):
            asked.sample(points(1))
        with pytest.raises(TransportError, match=words):
            fetch_health(address)
    finally:
        thread.join()
        link.close()
        context.term()
