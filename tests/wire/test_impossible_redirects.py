# SPDX-License-Identifier: MIT
"""A map that is elsewhere by now is followed there: not to any machine, and not for ever."""

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zmq

from tsfusion.core.errors import TransportError
from tsfusion.wire.asking.map_client import MapClient
from tsfusion.wire.asking.queries import CommandRefused, fetch_status
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command, Elsewhere, Reply
from tsfusion.wire.sockets import sockets


class Redirecting:
    """A server that says of every map that it is elsewhere; None = at this server itself."""

    def __init__(self) -> None:
        self.elsewhere: Elsewhere | None = None
        self.asked = 0
        self._context: zmq.Context[Any] = zmq.Context()
        self._socket = sockets.router(self._context)
        self.control = sockets.bind_socket(self._socket, "tcp://127.0.0.1:0")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._answer)
        self._thread.start()

    def _answer(self) -> None:
        while not self._stop.is_set():
            if not self._socket.poll(20):
                continue
            identity, content, *_ = self._socket.recv_multipart()
            command = messages.decode_to_server(content)
            assert isinstance(command, Command)
            reply = Reply(name="ping", version=messages.PROTOCOL_VERSION)
            if command.name != "ping":
                self.asked += 1
                elsewhere = self.elsewhere or Elsewhere(self.control, self.control)
                reply = Reply(name=command.name, number=command.number, error="gone", elsewhere=elsewhere)
            self._socket.send_multipart([identity, messages.encode(reply)])

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()
        self._context.term()


@pytest.fixture
def server() -> Iterator[Redirecting]:
    made = Redirecting()
    try:
        yield made
    finally:
        made.close()


@pytest.mark.parametrize(
    "place",
    [
        Elsewhere("tcp://192.0.2.1:5555"),
        Elsewhere("tcp://127.0.0.1:5555", "tcp://192.0.2.1:5556"),
        Elsewhere("tcp://example.org:5555"),
        Elsewhere("ipc:///tmp/any"),
        Elsewhere(""),
    ],
)
def test_nobody_is_sent_to_another_machine_without_keys(server: Redirecting, place: Elsewhere) -> None:
    server.elsewhere = place
    with pytest.raises(TransportError, match="the server says that the map is at"):
        fetch_status(server.control, control=server.control, timeout=10)
    with (
        MapClient(server.control, control=server.control, timeout=10) as client,
        pytest.raises(TransportError, match="the server says that the map is at"),
    ):
        client.sample(np.zeros((1, 3)))


def test_a_circle_has_an_end(server: Redirecting) -> None:
    with pytest.raises(CommandRefused, match="gone"):
        fetch_status(server.control, control=server.control, timeout=10)
    assert 5 <= server.asked < 10
    with (
        MapClient(server.control, control=server.control, timeout=10) as client,
        pytest.raises(CommandRefused, match="gone"),
    ):
        client.sample(np.zeros((1, 3)))
    assert 10 <= server.asked < 20  # a connection that is made anew asks again
