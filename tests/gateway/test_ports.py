# SPDX-License-Identifier: MIT
"""The ports of a gateway under messages and connections that nobody should send; in this process."""

import contextlib
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from attacks import raw
from idle_fuser import COMMAND
from keyframes_and_servers import connected, until, wall

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.gateway import fuser_process, fuser_supervisor
from tsfusion.gateway.access_control import AccessControl
from tsfusion.gateway.gateway import Gateway
from tsfusion.gateway.metrics import Metrics
from tsfusion.gateway.ports import Ports
from tsfusion.wire import codec, messages, sockets

FRAMES = 300_000  # of a hostile message: read one by one they take half a second


class Served:
    """A gateway that listens, with a fuser that fuses nothing. Call `until` instead of waiting."""

    def __init__(self, gateway: Gateway) -> None:
        self.gateway = gateway
        self.addresses = gateway.ports.bind()
        self.longest = 0.0  # CPU seconds of a step
        gateway.accept()

    def step(self) -> None:
        began = time.thread_time()
        self.gateway.step()
        self.longest = max(self.longest, time.thread_time() - began)

    @property
    def durable(self) -> int:
        """Keyframes in the journal."""
        return self.gateway.health().maps["default"].keyframes_durable

    def until(self, reached: Any) -> None:
        """Step until that is true."""
        until(lambda: self.step() or reached())


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.setattr(fuser_process, "COMMAND", COMMAND)
    monkeypatch.setattr(fuser_supervisor, "_END_DEADLINE", 0.0)
    with contextlib.ExitStack() as stack:
        server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(tmp_path))
        context: zmq.Context[Any] = zmq.Context()
        stack.callback(context.term)
        ports = Ports(context, server)
        stack.callback(ports.close)
        gateway = Gateway(context, server, ports, AccessControl(context, None), Metrics(server))
        stack.callback(gateway.maps.close)
        gateway.maps.open_at_start({"default": VolumeConfig()})
        until(lambda: gateway.step() or gateway.maps.warm)
        yield Served(gateway)


def is_cut_off(link: socket.socket) -> bool:
    """Whether the other side has ended a connection."""
    link.settimeout(0.01)
    with contextlib.suppress(TimeoutError):
        try:
            return not link.recv(4096)
        except ConnectionResetError:
            return True
    return False


def record(seq: int) -> list[bytes]:
    return codec.encode(wall(seq), session=bytes(16), seq=seq, previous=seq - 1, jpeg_quality=90)


PORTS = {"data": b"PUSH", "control": b"DEALER", "publish": b"SUB"}


@pytest.mark.parametrize("port", PORTS)
def test_a_message_of_frames_without_end_is_not_read_to_its_end(served: Served, port: str) -> None:
    """ZeroMQ gives others' messages only behind its last frame; reading them all takes seconds."""
    address = getattr(served.addresses, port)
    with contextlib.closing(raw(address, PORTS[port])) as stranger:
        stranger.sendall(b"\x01\x00" * (FRAMES - 1) + b"\x00\x00")
        served.until(lambda: served.gateway.health().refused.get("frames"))
        assert served.longest < 0.15
        served.until(lambda: is_cut_off(stranger))
    with (
        connected(sockets.dealer, served.addresses.control) as client,
        connected(sockets.push, served.addresses.data) as push,
        connected(sockets.subscriber, served.addresses.publish),
    ):
        client.send(messages.encode(messages.Hello(bytes(16), messages.PROTOCOL_VERSION)))
        served.until(lambda: client.poll(0))
        push.send_multipart(record(1))
        served.until(lambda: served.durable)
        served.until(lambda: len(served.gateway._subscriptions) == 1)


@pytest.mark.parametrize("surplus", [500, 5000])
def test_frames_too_many_cost_nobody_else_a_connection(served: Served, surplus: int) -> None:
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
