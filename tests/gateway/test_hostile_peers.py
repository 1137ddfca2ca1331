# SPDX-License-Identifier: MIT
"""Mishaps around a server: strangers, full disks, missing files. Its other clients do not notice."""

import os
import time
import zlib
from collections import Counter
from pathlib import Path
from typing import Any, cast

import fake_server
import msgspec
import pytest
import zmq
from clients_and_spools import NOBODY
from keyframes_and_servers import DEADLINE, Server, connected, until, wall

from tsfusion import Client
from tsfusion.core import config
from tsfusion.core.errors import InvalidConfig, ServerUnreachable, TransportError
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.people.requests import Requests
from tsfusion.gateway.people.scan_updates import ScanUpdates
from tsfusion.gateway.ports.connection_limits import PendingReplies
from tsfusion.gateway.ports.ports import Ports
from tsfusion.wire.asking import queries
from tsfusion.wire.asking.queries import fetch_mesh, fetch_status, request
from tsfusion.wire.messages import health, messages
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import Refused, pack, unpack
from tsfusion.wire.sockets import sockets

# --- strangers ---


def test_a_client_goes_on_after_a_flood_of_greetings(shared: Server) -> None:
    with Client(shared.address) as client, connected(sockets.dealer, shared.control) as stranger:
        client.connect()
        for _ in range(1100):
            stranger.send(messages.encode(messages.Hello(os.urandom(16), messages.PROTOCOL_VERSION)))
        asked = time.monotonic()
        request(shared.address, Command(name="ping"), timeout=DEADLINE)
        until(lambda: time.monotonic() - asked > 1.0)  # two pings
        client.send(wall(3))
        client.wait_meshed(timeout=10)


def test_a_jpeg_of_a_million_segments_does_not_hold_the_gateway_up() -> None:
    good = codec.encode(wall(), session=bytes(16), seq=1, jpeg_quality=90)
    header = unpack(good[0])
    evil = b"\xff\xd8" + b"\xff\xe0\x00\x02" * (4 << 20)
    color = msgspec.structs.replace(header.buffers[1], bytes=len(evil), crc32=zlib.crc32(evil))
    head = pack(msgspec.structs.replace(header, buffers=(header.buffers[0], color)))
    started = time.process_time()
    with pytest.raises(Refused, match="without a frame header"):
        codec.check([head, good[1], evil])
    assert time.process_time() - started < 0.5  # a millisecond; a loop over the segments takes seconds


def test_who_does_not_fetch_a_mesh_gets_no_second_one(shared: Server) -> None:
    """Else each would wait in the server's memory."""

    def one_at_a_time(context: "zmq.Context[Any]") -> sockets.AnySocket:
        made = sockets.dealer(context)
        made.setsockopt(zmq.RCVHWM, 1)
        made.setsockopt(zmq.RCVBUF, 4096)
        return made

    with Client(shared.address) as client:
        client.send(wall(4))
        client.wait_fused(timeout=DEADLINE)
    replies = []
    with connected(one_at_a_time, shared.control) as stranger:
        for _ in range(60):
            stranger.send(messages.encode(Command(name="mesh", min_weight=0.0)))
            request(shared.address, Command(name="status"), timeout=DEADLINE)
        until(lambda: fetch_status(shared.address).fuser != "busy")
        while stranger.poll(1000):
            replies.append(messages.decode_to_client(stranger.recv_multipart()[0]))
    errors = [reply.error for reply in replies if isinstance(reply, messages.Reply) and reply.error]
    assert any("still on its way" in error for error in errors)


class Map:
    """As `Requests` sees one: what its fuser was asked, and whether keyframes come."""

    ready, failed = True, ""

    def __init__(self) -> None:
        self.fuser: Any = self
        self.asked: list[fuser_messages.FuserQuestion] = []
        self.is_idle = True

    def send(self, ask: fuser_messages.FuserQuestion, _frames: Any = ()) -> bool:
        self.asked.append(ask)
        return True

    def idle_since(self, since: float) -> bool:
        return self.is_idle


class Asking:
    """Requests about a map, and the errors that they were answered with."""

    def __init__(self, most_bytes: int = 1 << 30) -> None:
        self.map: Any = Map()
        self.errors: list[str | None] = []
        self.frames: list[Any] = []
        self.queries = Requests(
            cast(Ports, self),
            Metrics(),
            Counter(),
            unread=PendingReplies(),
            max_bytes=most_bytes,
            rate=1e6,
            scans=ScanUpdates(),
        )

    def reply(self, identity: bytes, message: messages.ToClient, frames: Any = ()) -> None:
        assert isinstance(message, messages.Reply)
        self.errors.append(message.error)
        self.frames += frames  # which nobody reads

    def ask(self, identity: bytes, client: str = "", map_name: str = "default") -> bool:
        """Whether the mesh was passed on."""
        before = len(self.map.asked)
        self.queries.submit(identity, Command(name="mesh", map=map_name), [], self.map, client)
        return len(self.map.asked) > before

    def make(self, nbytes: int) -> None:
        """The one that was asked for last."""
        layout = health.MeshLayout(vertices=0, faces=0, colors=False)
        frames = [zmq.Frame(bytes(nbytes // 2)), zmq.Frame(bytes(nbytes // 2))]
        self.queries.on_answer(fuser_messages.FuserAnswer(self.map.asked[-1].number, mesh=layout), frames)


def test_a_fuser_makes_one_mesh_at_a_time() -> None:
    asking = Asking()
    assert asking.ask(b"1")
    assert not asking.ask(b"2")
    assert asking.errors == ["another mesh is being made; ask again"]
    assert asking.ask(b"3", map_name="yard")
    asking.queries.give_up("default")
    assert asking.ask(b"2")


def test_a_client_gets_one_mesh_at_a_time_over_all_its_connections() -> None:
    asking = Asking()
    assert asking.ask(b"1", "robot")
    assert not asking.ask(b"2", "robot", "yard")
    asking.make(100)
    assert not asking.ask(b"3", "robot", "yard")  # not read yet
    assert asking.ask(b"4", "cart", "yard")
    assert all(error is None or "still on its way" in error for error in asking.errors)


def test_after_a_mesh_it_is_the_keyframes_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(time, "monotonic_ns", lambda: int(1e9 * now[0]))
    asking = Asking()
    asking.map.is_idle = False
    assert asking.ask(b"1")
    now[0] = 102.0
    asking.make(100)
    now[0] = 107.9
    assert not asking.ask(b"2")
    assert asking.errors[-1] == "a mesh was just made, now it is the keyframes' turn; ask again"
    asking.map.is_idle = True  # nobody scans: nobody has to wait
    assert asking.ask(b"2")
    asking.make(100)
    asking.map.is_idle = False
    now[0] = 108.0
    assert asking.ask(b"3")


def test_meshes_that_nobody_reads_are_few() -> None:
    asking = Asking(most_bytes=1000)
    for identity in (b"1", b"2", b"3"):
        assert asking.ask(identity)
        asking.make(300)
    assert not asking.ask(b"4")
    assert "do not read" in (asking.errors[-1] or "")
    assert asking.queries.nbytes == 900
    asking.frames.clear()
    until(lambda: asking.queries.nbytes == 0)
    assert asking.ask(b"5")
    asking.make(5000)  # one may be larger than all should be
    assert asking.queries.nbytes == 5000
    assert not asking.ask(b"6")


# --- settings and addresses ---


def test_a_configuration_that_is_not_text_is_one_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(b"\xff\xfe[[[")
    with pytest.raises(InvalidConfig, match="is not TOML: "):
        config.load(path)


def test_the_last_port_has_no_next_one() -> None:
    with pytest.raises(InvalidConfig, match=r"65535 has no next port for control"):
        sockets.control_address("tcp://127.0.0.1:65535")
    with pytest.raises(InvalidConfig, match="needs a port"):
        request("tcp://127.0.0.1:0", Command(name="ping"), timeout=1.0)


def test_a_patience_of_ages_is_no_error(shared: Server) -> None:
    reply, _ = request(shared.address, Command(name="ping"), timeout=1e300)
    assert reply.name == "ping"


def test_a_port_that_speaks_something_else(shared: Server) -> None:
    with pytest.raises(TransportError, match="no server answered"):
        request(shared.address, Command(name="ping"), control=shared.address, timeout=0.3)


def test_who_answers_with_nonsense_is_named(caplog: pytest.LogCaptureFixture) -> None:
    with fake_server.serving(lambda _: b"nonsense") as (control, _):
        with pytest.raises(TransportError, match=r"what answers at tcp://.* is no tsfusion server"):
            fetch_status(NOBODY, control=control)
        with (
            Client(NOBODY, control=control) as client,
            pytest.raises(ServerUnreachable, match="is no tsfusion server"),
        ):
            client.connect(timeout=0.5)
    assert caplog.text == ""


def test_a_mesh_is_asked_for_again_when_the_server_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queries, "_AGAIN_INTERVAL", 0.01)
    again = messages.Reply(name="mesh", error="busy", retry=True)
    settled = messages.Reply(name="mesh", error="no room; do not ask again")
    replies = iter([again, again, settled])
    for answer, error, timeout in ((lambda _: next(replies), "no room", 5.0), (lambda _: again, "busy", 0.3)):
        with fake_server.serving(answer) as (control, _), pytest.raises(TransportError, match=error):
            fetch_mesh(NOBODY, control=control, timeout=timeout)


def test_a_server_that_falls_silent_has_said_why_there_is_no_mesh() -> None:
    replies = iter([messages.Reply(name="mesh", error="busy", retry=True)])
    with (
        fake_server.serving(lambda _: next(replies, None)) as (control, _),
        pytest.raises(TransportError, match="busy"),
    ):
        fetch_mesh(NOBODY, control=control, timeout=1.5)
