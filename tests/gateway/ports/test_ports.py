# SPDX-License-Identifier: MIT
"""The ports of a gateway under messages and connections that nobody should send; in this process."""

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq
from keyframes_and_servers import connected, secured, wall
from served_gateway import Listening, record, serving_here

from lab.reliability.attacks import part, raw
from tsfusion import Client
from tsfusion.gateway.ports import access_control, ports
from tsfusion.gateway.ports.connections import Connections, OpenConnection
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.questions import Scans
from tsfusion.wire.sockets import sockets

FRAMES = 150_000  # of a hostile message, of which a third may be read


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Listening]:
    with serving_here(tmp_path) as made:
        yield made


def is_cut_off(link: socket.socket) -> bool:
    """Whether the other side has ended a connection."""
    link.settimeout(0.01)
    with contextlib.suppress(TimeoutError):
        try:
            return not link.recv(4096)
        except ConnectionResetError:
            return True
    return False


def sent(link: sockets.AnySocket, frames: list[bytes]) -> None:
    """Send a message if there is a connection; what is on its way when that ends is lost."""
    with contextlib.suppress(zmq.Again):
        link.send_multipart(frames, zmq.NOBLOCK)


PORTS = {"data": b"PUSH", "control": b"DEALER"}


@pytest.mark.parametrize("port", PORTS)
def test_a_message_of_frames_without_end_is_not_read_to_its_end(
    served: Listening, port: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ZeroMQ gives others' messages only behind its last frame; reading them all takes seconds."""
    floods: list[ports.Flood] = []
    usual = ports.Flood

    def noted(*given: Any) -> ports.Flood:
        floods.append(usual(*given))
        return floods[-1]

    monkeypatch.setattr(ports, "Flood", noted)
    address = getattr(served.addresses, port)
    with contextlib.closing(raw(address, PORTS[port])) as stranger:
        stranger.sendall(b"\x01\x00" * (FRAMES - 1) + b"\x00\x00")
        served.until(lambda: sum(served.gateway.health().refused.values()))
        assert floods[0].goes_on
        assert floods[0].discarded < FRAMES / 2
        served.until(lambda: is_cut_off(stranger))
    with (
        connected(sockets.dealer, served.addresses.control) as client,
        connected(sockets.push, served.addresses.data) as push,
    ):
        hello = messages.encode(messages.Hello(bytes(16), messages.PROTOCOL_VERSION))
        served.until(lambda: client.poll(0) or sent(client, [hello]))
        served.until(lambda: served.durable or sent(push, record(1)))


def test_ports_are_served_while_another_cannot_be_bound_again(served: Listening) -> None:
    """Somebody else may take a port in the moment in which it is given back."""
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as thief:
        served.ports._addresses["keyframes"] = f"tcp://127.0.0.1:{thief.getsockname()[1]}"
        served.ports.renew()
        with connected(sockets.dealer, served.addresses.control) as client:
            hello = messages.encode(messages.Hello(bytes(16), messages.PROTOCOL_VERSION))
            served.until(lambda: client.poll(0) or sent(client, [hello]))
        assert "cannot listen any more" in served.gateway.health().problems[0]
        assert not served.gateway.health().ready
    served.until(lambda: served.gateway.health().ready)


@pytest.mark.parametrize("surplus", [500, 5000])
def test_frames_too_many_cost_nobody_else_a_connection(served: Listening, surplus: int) -> None:
    """Only who sends very many is cut off."""
    with (
        connected(sockets.push, served.addresses.data) as push,
        contextlib.closing(raw(served.addresses.data, b"PUSH")) as stranger,
    ):
        push.setsockopt(zmq.RECONNECT_IVL, -1)
        push.send_multipart(record(1))
        served.until(lambda: served.durable == 1)
        stranger.sendall(b"\x01\x00" * surplus + b"\x00\x00")
        served.until(lambda: sum(served.gateway.health().refused.values()))
        if surplus > 1000:
            assert served.gateway.health().refused == {"frames": 1}
            served.until(lambda: is_cut_off(stranger))
        push.send_multipart(record(2))
        served.until(lambda: served.durable == 2)


def test_connections_that_say_nothing_give_way(served: Listening) -> None:
    """Connections without a greeting go, the oldest first; a client's connections stay."""
    served.ports.connections.most = 60
    with contextlib.ExitStack() as stack:
        push = stack.enter_context(connected(sockets.push, served.addresses.data))
        push.setsockopt(zmq.RECONNECT_IVL, -1)
        push.send_multipart(record(1))
        served.until(lambda: served.durable == 1)
        host, port = sockets.parse_address(served.addresses.data)
        open_before = len(os.listdir("/proc/self/fd"))
        strangers = [stack.enter_context(socket.create_connection((host, port))) for _ in range(150)]
        served.until(lambda: is_cut_off(strangers[0]))
        served.until(lambda: served.gateway.health().refused["connection"] > 150 - 60)
        assert len(os.listdir("/proc/self/fd")) < open_before + 150 + 100
        push.send_multipart(record(2))
        served.until(lambda: served.durable == 2)


def test_who_fills_the_memory_is_cut_off_alone(served: Listening, monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ keeps the parts of a message until its last one, as many as come."""
    with (
        connected(sockets.push, served.addresses.data) as push,
        contextlib.closing(raw(served.addresses.data, b"PUSH")) as stranger,
    ):
        push.setsockopt(zmq.RECONNECT_IVL, -1)
        push.send_multipart(record(1))
        served.until(lambda: served.durable == 1)
        for _ in range(40):
            stranger.sendall(part(bytes(100_000)))
        alarms = [1 << 30]
        monkeypatch.setattr(served.loop.limits._memory, "excess", lambda _: alarms.pop() if alarms else 0)
        epoch = served.gateway.epoch
        served.until(lambda: is_cut_off(stranger))
        push.send_multipart(record(2))
        served.until(lambda: served.durable == 2)
        assert (served.gateway.epoch, served.gateway.health().refused) == (epoch, {"memory": 1})
        monkeypatch.setattr(served.loop.limits._memory, "excess", lambda _: 1 << 30)
        served.until(lambda: served.gateway.epoch != epoch)  # nobody stands out: all have to go


def test_the_number_of_a_connection_that_ended_may_be_another_files() -> None:
    """A new connection's bytes are counted from its own beginning; others are not cut off."""
    connections = Connections(1 << 30)
    here, there = socket.socketpair()
    with here, there:
        assert not connections.cut(here.fileno())
        there.sendall(b"x")
        assert here.recv(1) == b"x"
    new = OpenConnection(7, 0, 5 << 20)
    connections._all = lambda: iter([new])  # type: ignore[method-assign]
    for before, kept in ((1 << 30, 5 << 20), (3 << 20, 3 << 20)):
        connections._read.clear()
        connections.note_read(7, before)
        connections._look()
        assert connections._read[7] == kept


def test_a_step_ends_when_its_time_is_up(served: Listening, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each message may cost a write to a slow disk; other sockets get their turn in between."""
    now = [0.0]
    monkeypatch.setattr(ports, "time", SimpleNamespace(monotonic=lambda: now[0]))
    handled: list[int] = []

    def handle(received: ports.Incoming) -> None:
        handled.append(len(received.frames))
        now[0] += 0.6 * ports._SECONDS_A_STEP

    inbox: Any = SimpleNamespace(closed=False, recv=lambda *_, **__: zmq.Frame(b"x"))
    served.ports.receive_some(inbox, handle, lambda _: None)
    assert len(handled) == 2


def test_answers_leave_before_records_wait_for_the_disk(
    served: Listening, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pong tells the server's time, by which clients set theirs."""
    done: list[str] = []
    monkeypatch.setattr(served.ports, "send", lambda _: done.append("sent"))
    monkeypatch.setattr(served.gateway.intake, "finish", lambda: done.append("journaled"))
    with connected(sockets.dealer, served.addresses.control) as client:
        served.until(lambda: client.poll(0, zmq.POLLOUT))
        done.clear()
        client.send(messages.encode(messages.Ping(bytes(16), 1)))
        served.until(lambda: "sent" in done)
    at = done.index("sent")
    assert done[at : at + 2] == ["sent", "journaled"]


def test_who_may_not_connect_any_more_is_heard_and_served_no_more(tmp_path: Path) -> None:
    given = secured(tmp_path / "keys")
    with (
        serving_here(tmp_path / "state", **given.server) as served,
        connected(sockets.dealer, served.addresses.control, given.keys) as viewer,
    ):
        question = messages.Command(name="ask", question=Scans(wait_s=0.0))
        served.until(lambda: viewer.poll(0) or sent(viewer, [messages.encode(question)]))
        access, epoch = served.gateway._access, served.gateway.epoch
        assert given.keys is not None
        assert access.client_of(given.keys.public) == "robot"
        key_folder.revoke(given.server["keys"], "robot")
        assert access.client_of(given.keys.public) is None  # not "", which is anybody's name without keys
        served.until(lambda: served.gateway.epoch != epoch)  # every connection is made anew
        served.until(lambda: access.refused["revoked"])


def test_a_client_that_floods_is_kept_out_for_a_while(tmp_path: Path) -> None:
    """With keys it has a name; ZeroMQ connects again by itself, in vain."""
    given = secured(tmp_path / "keys")
    with (
        serving_here(tmp_path / "state", **given.server) as served,
        connected(sockets.push, served.addresses.data, given.keys) as push,
    ):
        served.until(lambda: push.poll(0, zmq.POLLOUT))
        push.send_multipart([b""] * 3000)
        served.until(lambda: served.gateway.health().refused.get("frames"))
        served.until(lambda: served.gateway.health().refused.get("kept out"))
        access = served.gateway._access
        assert access.name_of(given.keys.public) is None
        access._kept_out["robot"] -= access_control.KEPT_OUT
        assert access.name_of(given.keys.public) == "robot"


def test_a_scanner_whose_key_a_flood_came_with_goes_on_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing that it has is lost meanwhile, and it says why nothing of the server is heard."""
    monkeypatch.setattr(access_control, "KEPT_OUT", 3.0)
    given = secured(tmp_path / "keys")
    with (
        serving_here(tmp_path / "state", **given.server) as served,
        Client(
            served.addresses.data, key=given.client["key"], server_key=given.client["server_key"]
        ) as client,
        connected(sockets.push, served.addresses.data, given.keys) as push,
    ):
        client.send(wall(1))
        served.until(lambda: served.durable == 1)
        served.until(lambda: push.poll(0, zmq.POLLOUT))
        push.send_multipart([b""] * 3000)
        served.until(lambda: served.gateway.health().refused.get("frames"))
        client.send(wall(2))
        served.until(lambda: "it keeps this client out for a minute" in client.problem)
        served.until(lambda: served.durable == 2)
        assert client.stats.refused == {}
