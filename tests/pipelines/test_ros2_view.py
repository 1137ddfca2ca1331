# SPDX-License-Identifier: MIT
"""A live map on ROS 2: what a process of its own publishes over DDS and Zenoh, and its services."""

import struct
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_processes import COMMAND, end, environment, eventually
from keyframes_and_servers import VOLUME, serving, wall
from ros2_talker import libraries, listener, on_this_machine

import tsfusion
from tsfusion.geometry.mesh import Mesh

pytest.importorskip("rosbags", reason="extra ros2")
pytest.importorskip("yaml")
COUNT = 3
HEIGHTS = (-0.4, 0.4)
UP = "-y"


class Heard:
    """All that is published, by topic, decoded by a type store of its own."""

    def __init__(self, transport: str, place: tuple[int, str]) -> None:
        from rosbags.typesys import Stores, get_typestore

        from tsfusion.datasets.ros2.live_messages import open_middlewares

        self.store, self.messages = get_typestore(Stores.ROS2_JAZZY), defaultdict[str, list[Any]](list)
        (self.own,) = open_middlewares(self.take, transport=transport, domain=place[0], router=place[1])

    def take(self, arrived: Any) -> None:
        content = self.store.deserialize_cdr(arrived.content, arrived.stream.kind)
        self.messages[arrived.stream.topic].append(content)

    def last(self, topic: str) -> Any:
        """The last message of a topic, once there is one."""

        def found() -> bool:
            for each in self.own.topics():
                self.own.subscribe(each)
            return bool(self.messages[topic])

        eventually(found)
        return self.messages[topic][-1]


@contextmanager
def published(
    state: Path, transport: str, place: tuple[int, str], *more: object
) -> Iterator[tuple[str, Heard]]:
    """A server with some keyframes, a process that publishes its map, and one who hears it."""
    import subprocess

    with ExitStack() as stack:
        server = stack.enter_context(serving(state / "state", VOLUME))
        with tsfusion.Client(server.address) as client:
            for i in range(COUNT):
                client.send(wall(i))
            client.flush(60.0)
        if transport == "zenoh":
            stack.callback(listener(place[1]).close)
        words = ["ros2", "publish", server.address, "--transport", transport, "--domain", place[0]]
        words += ["--router", place[1], "--slice", *HEIGHTS, "--up", UP, "--out", state / "out", *more]
        process = subprocess.Popen([*COMMAND, *map(str, words)], env=environment(), text=True)
        stack.callback(end, process)
        heard = Heard(transport, place)
        stack.callback(heard.own.close)
        yield server.address, heard
        assert process.poll() is None


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> tuple[int, str]:
    return on_this_machine(monkeypatch)


def triangles(messages: list[Any]) -> np.ndarray:
    """The corners of all triangles of the newest marker of each id, in an order of their own."""
    newest = {one.id: one for one in messages}
    corners = [(p.x, p.y, p.z) for one in newest.values() if one.action == 0 for p in one.points]
    found = np.array(corners).reshape(-1, 9)
    return found[np.lexsort(found.T)]


@pytest.mark.parametrize("transport", ["dds", "zenoh"])
def test_a_map_is_published(tmp_path: Path, transport: str, place: tuple[int, str]) -> None:
    libraries(transport)
    with published(tmp_path, transport, place) as (address, heard):
        with tsfusion.MapClient(address, timeout=30.0) as client:
            wanted = client.distance_slice(*HEIGHTS, up=UP).result
        grid = heard.last("/tsfusion/map")
        cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
        np.testing.assert_array_equal(cells, wanted.cells)
        assert {0, 100, -1} >= set(np.unique(cells).tolist()) > {100}
        assert grid.info.resolution == np.float32(wanted.grid.resolution)
        assert (grid.info.origin.position.x, grid.info.origin.position.y) == wanted.grid.origin
        assert grid.header.frame_id == "map"

        image = heard.last("/tsfusion/distance")
        assert image.encoding == "32FC1"
        distance = np.frombuffer(image.data, np.float32).reshape(image.height, image.width)
        np.testing.assert_array_equal(distance, wanted.distance)

        path = heard.last("/tsfusion/scanner_1/path")
        expected = [wall(i).T_world_camera[:3, 3] for i in range(COUNT)]
        got = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in path.poses]
        np.testing.assert_allclose(got, expected, atol=1e-9)
        assert heard.last("/tsfusion/scanner_1/pose").header.frame_id == "tsfusion"
        (flat,) = heard.last("/tf_static").transforms
        assert (flat.header.frame_id, flat.child_frame_id) == ("map", "tsfusion")
        assert {one.child_frame_id for one in heard.last("/tf").transforms} == {"scanner_1"}
        (status,) = heard.last("/diagnostics").status
        assert {pair.key: pair.value for pair in status.values}["keyframes fused"] == str(COUNT)

        heard.last("/tsfusion/mesh")
        eventually(lambda: len(triangles(heard.messages["/tsfusion/mesh"])) > 100)
        cloud = heard.last("/tsfusion/points")
        assert cloud.width > 10
        shown = triangles(heard.messages["/tsfusion/mesh"]).reshape(-1, 3)
        depth = wall(0).T_world_camera[2, 3] + 2.0
        assert np.isfinite(shown).all()
        assert np.ptp(shown, axis=0).max() < 10 * depth


def test_triangles_are_those_of_the_mesh() -> None:
    """Bytes that are put together are what the message classes read."""
    from rosbags.typesys import Stores, get_typestore

    from tsfusion.journal.ros2_messages import Converter

    store, rng = get_typestore(Stores.ROS2_JAZZY), np.random.default_rng(0)
    for count, world in ((0, "w"), (5, "world"), (7, "some_map"), (1, "tsfusion")):
        made = Converter(store.types, world=world)
        faces = rng.integers(0, 12, (count, 3)).astype(np.int32)
        colors = rng.integers(0, 256, (12, 3)).astype(np.uint8)
        vertices = rng.normal(size=(12, 3)).astype(np.float32)
        mesh = Mesh(vertices=vertices, faces=faces, normals=np.zeros((12, 3), np.float32), colors=colors)
        marker = made.marker(3, "/mesh", 5)
        raw = made.with_triangles(bytes(store.serialize_cdr(marker.content, marker.kind)), mesh)
        read = store.deserialize_cdr(raw, marker.kind)
        np.testing.assert_array_equal(
            np.array([(p.x, p.y, p.z) for p in read.points]).reshape(-1, 3), vertices[faces.reshape(-1)]
        )
        np.testing.assert_allclose(
            np.array([(c.r, c.g, c.b) for c in read.colors]).reshape(-1, 3), colors[faces.reshape(-1)] / 255
        )
        assert (read.id, read.type, read.ns, read.header.frame_id, read.frame_locked) == (
            3,
            11,
            "tsfusion",
            world,
            True,
        )


def map_server_cells(file: Path) -> np.ndarray:
    """Read the pair of files as Nav2's map_server does in the mode `trinary` (map_io.cpp)."""
    import yaml

    described = yaml.safe_load(file.read_text())
    picture = cv2.imread(str(file.with_name(described["image"])), cv2.IMREAD_GRAYSCALE)
    shade = (255 - picture[::-1].astype(np.float64)) / 255
    if described["negate"]:
        shade = 1 - shade
    cells = np.full(picture.shape, -1, np.int8)
    cells[shade > described["occupied_thresh"]] = 100
    cells[shade < described["free_thresh"]] = 0
    return cells


def call_dds(place: tuple[int, str], service: str) -> tuple[bool, str]:
    """Call a Trigger as rmw_cyclonedds does, with types of its own."""
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    @dataclass
    class Request(IdlStruct, typename="std_srvs.srv.dds_.Trigger_Request_"):
        client: types.uint64
        number: types.int64
        structure_needs_at_least_one_member: types.uint8

    @dataclass
    class Response(IdlStruct, typename="std_srvs.srv.dds_.Trigger_Response_"):
        client: types.uint64
        number: types.int64
        success: bool
        message: str

    qos = Qos(Policy.Reliability.Reliable(10**8), Policy.History.KeepLast(10))
    participant = DomainParticipant(place[0])
    writer = DataWriter(participant, Topic(participant, f"rq{service}Request", Request), qos=qos)
    reader = DataReader(participant, Topic(participant, f"rr{service}Reply", Response), qos=qos)
    eventually(lambda: bool(writer.get_matched_subscriptions()) and bool(reader.get_matched_publications()))
    writer.write(Request(77, 5, 0))
    replies: list[Any] = []
    eventually(lambda: bool(replies.extend(reader.take(10)) or replies))
    (reply,) = replies
    assert (reply.client, reply.number) == (77, 5)
    return reply.success, reply.message


def call_zenoh(place: tuple[int, str], service: str) -> tuple[bool, str]:
    """Call a Trigger as rmw_zenoh does."""
    from tsfusion.datasets.ros2 import zenoh_session

    session = zenoh_session.zenoh.open(zenoh_session._config(place[1]))
    key = f"{place[0]}{service}/std_srvs::srv::dds_::Trigger_/*"
    found: list[Any] = []

    def asked() -> bool:
        found.extend(session.get(key, payload=b"\0\1\0\0\0", attachment=b"number", timeout=30.0))
        return bool(found)

    eventually(asked)
    reply = found[0].ok
    assert reply.attachment.to_bytes() == b"number"
    raw = reply.payload.to_bytes()
    session.close()
    (length,) = struct.unpack_from("<I", raw, 8)
    return bool(raw[4]), raw[12 : 12 + length - 1].decode()


def test_each_subscriber_of_rmw_zenoh_is_counted(place: tuple[int, str]) -> None:
    libraries("zenoh")
    from tsfusion.datasets.ros2.zenoh_session import Zenoh

    with ExitStack() as stack:
        stack.callback(listener(place[1]).close)
        publisher = stack.enter_context(closing(Zenoh(lambda _: None, *place)))
        publisher.announce("/tsfusion/mesh", "visualization_msgs/msg/Marker")
        for count in (1, 2):  # the second one gets the whole map, too
            other = stack.enter_context(closing(Zenoh(lambda _: None, *place)))
            key = publisher._key("/tsfusion/mesh", "visualization_msgs/msg/Marker", "RIHS01_0")
            other._announce("MS", "/tsfusion/mesh", key, "::,10:,:,:,,")
            eventually(lambda count=count: publisher.listeners("/tsfusion/mesh") == count)
        assert [topic.name for topic in other.topics()] == ["/tsfusion/mesh"]


CALLS: dict[str, Callable[[tuple[int, str], str], tuple[bool, str]]] = {"dds": call_dds, "zenoh": call_zenoh}


@pytest.mark.parametrize("transport", ["dds", "zenoh"])
def test_services_save_forget_and_tell(tmp_path: Path, transport: str, place: tuple[int, str]) -> None:
    libraries(transport)
    with published(tmp_path, transport, place, "--forget", 3600) as (address, heard):
        heard.last("/tsfusion/map")
        success, words = CALLS[transport](place, "/tsfusion/status")
        assert (success, bool(words)) == (True, True)
        (tmp_path / "out").write_text("a file where a folder must be")
        success, words = CALLS[transport](place, "/tsfusion/save_map")
        assert not success
        assert "File exists" in words
        (tmp_path / "out").unlink()
        success, words = CALLS[transport](place, "/tsfusion/save_map")
        assert success, words
        mesh, text, _ = map(Path, words.split(", "))
        assert mesh.stat().st_size > 1000
        with tsfusion.MapClient(address, timeout=30.0) as client:
            wanted = client.occupancy_slice(*HEIGHTS, up=UP).result
        np.testing.assert_array_equal(map_server_cells(text), wanted.cells)
        success, words = CALLS[transport](place, "/tsfusion/forget")
        assert (success, words) == (True, f"{COUNT} keyframes of the last 3600 s are forgotten")


def test_no_server_is_told_in_diagnostics(tmp_path: Path, place: tuple[int, str]) -> None:
    """Nobody listens at the address; the topics are there all the same, and say so."""
    import subprocess

    libraries("dds")
    words = ["ros2", "publish", "tcp://127.0.0.1:9", "--transport", "dds", "--domain", str(place[0])]
    process = subprocess.Popen([*COMMAND, *words], env=environment())
    heard = Heard("dds", place)
    try:
        (status,) = heard.last("/diagnostics").status
        assert status.level in (3, b"\x03")
        assert "no server answers" in status.message
    finally:
        heard.own.close()
        assert end(process) == 0
