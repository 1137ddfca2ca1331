# SPDX-License-Identifier: MIT
"""A gateway in this process that listens, with fusers that fuse nothing."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import zmq
from idle_fuser import COMMAND, FuserThread, starting
from keyframes_and_servers import until, wall

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.gateway.fusers import fuser_process, fuser_supervisor
from tsfusion.gateway.gateway import Gateway
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.ports import Ports
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import with_fields
from tsfusion.wire.sockets import sockets


class Served:
    """A gateway that listens, with a fuser that fuses nothing. Call `until` instead of waiting."""

    def __init__(self, gateway: Gateway) -> None:
        self.gateway = gateway
        self.addresses = gateway.ports.bind()
        gateway.accept(self.addresses)

    def step(self) -> None:
        self.gateway.step()

    @property
    def durable(self) -> int:
        """Keyframes in the journal."""
        return self.gateway.health().maps["default"].keyframes_durable

    def until(self, reached: Callable[[], Any]) -> None:
        """Step until that is true."""
        until(lambda: self.step() or reached())

    def greet(self, link: sockets.AnySocket, map_name: str, session: bytes = bytes(16)) -> Any:
        """The answer to a greeting over a DEALER."""
        link.send(messages.encode(messages.Hello(session, messages.PROTOCOL_VERSION, map_name)))
        return self.heard(link, messages.Welcome, messages.Denied)

    def heard(self, link: sockets.AnySocket, *kinds: type) -> Any:
        """The next message of these kinds from the gateway to a DEALER."""
        while True:
            self.until(lambda: link.poll(0))
            if isinstance(message := messages.decode_to_client(link.recv()), kinds):
                return message


@contextlib.contextmanager
def serving_here(
    state: Path,
    *,
    guest: str | None = None,
    later: tuple[str, ...] = (),
    processes: bool = False,
    **settings: Any,
) -> Iterator[Served]:
    """Start a gateway whose default map is open, and end it afterwards whatever happens.

    Args:
        later: further maps, whose fusers wait.
        processes: fusers are processes, not threads of this one.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(fuser_process, "COMMAND", COMMAND))
        if not processes:
            stack.enter_context(mock.patch.object(fuser_process, "subprocess", starting(FuserThread)))
        stack.enter_context(mock.patch.object(fuser_supervisor, "_END_DEADLINE", 0.0))
        settings = {"memory_bytes": 1 << 40, **settings}  # the tests of this process may hold much
        server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(state), **settings)
        context: zmq.Context[Any] = zmq.Context()
        stack.callback(context.term)
        access = AccessControl(context, server.keys, guest=guest)
        stack.callback(access.close)
        ports = Ports(context, server, access.keys)
        stack.callback(ports.close)
        gateway = Gateway(context, server, ports, access, Metrics(server))
        stack.callback(gateway.maps.close)
        gateway.maps.open_at_start(dict.fromkeys(("default", *later), VolumeConfig()), later=later)
        until(lambda: gateway.step() or gateway.maps.warm)
        yield Served(gateway)


def record(seq: int, map_name: str = "default", session: bytes = bytes(16)) -> list[bytes]:
    """A keyframe as it is sent."""
    frames = codec.encode(wall(seq), session=session, seq=seq, previous=seq - 1, jpeg_quality=90)
    return [with_fields(frames[0], previous=seq - 1, sent_ns=1, map=map_name), *frames[1:]]
