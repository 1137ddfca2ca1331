# SPDX-License-Identifier: MIT
"""The connections of a process as the system shows them."""

import socket
import struct
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from types import SimpleNamespace
from typing import Any, cast
from unittest import mock

import pytest

from tsfusion.gateway.ports import connections
from tsfusion.gateway.ports.connections import ConnectionLimits, Connections

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows them")
_PLENTY = 1 << 40  # bytes of memory
_PIECE = 1 << 16


class Port:
    """A listening socket, and connections to it."""

    def __init__(self, stack: ExitStack, family: socket.AddressFamily, host: str) -> None:
        self._stack = stack
        self._listening = stack.enter_context(closing(socket.socket(family)))
        self._listening.bind((host, 0))
        self._listening.listen()
        self.limits = Connections(_PLENTY)
        self.limits.ports = {self._listening.getsockname()[1]}

    def connect(self, host: str) -> tuple[socket.socket, socket.socket]:
        """Both ends of a new connection: that of the client, and that of this port."""
        place = host, self._listening.getsockname()[1]
        client = self._stack.enter_context(closing(socket.create_connection(place)))
        return client, self._stack.enter_context(closing(self._listening.accept()[0]))


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


def send(link: socket.socket, other: socket.socket, nbytes: int) -> None:
    """Send so much over a connection and see it come."""
    for _ in range(nbytes // _PIECE):
        link.sendall(bytes(_PIECE))
        left = _PIECE
        while left:
            left -= len(other.recv(left))


@pytest.mark.parametrize(
    ("family", "listen", "connect", "peer"),
    [
        (socket.AF_INET, "127.0.0.1", "127.0.0.1", "127.0.0.1"),
        (socket.AF_INET6, "::1", "::1", "::1"),
        (socket.AF_INET6, "::", "127.0.0.1", "127.0.0.1"),
    ],
)
def test_a_hoarder_is_named_by_its_address(
    stack: ExitStack, family: socket.AddressFamily, listen: str, connect: str, peer: str
) -> None:
    port = Port(stack, family, listen)
    send(*port.connect(connect), 3 << 20)
    assert port.limits.cut_hoarders() == [(peer, 3 << 20)]


def test_a_number_that_is_used_again_makes_nobody_a_hoarder(stack: ExitStack) -> None:
    """A connection that gets the file number of an earlier one begins with nothing read."""
    port = Port(stack, socket.AF_INET, "127.0.0.1")
    client, server = port.connect("127.0.0.1")
    port.limits.note_read(server.fileno(), 10 << 20)  # over an earlier one
    port.limits.step()
    send(client, server, 4 << 20)
    port.limits.note_read(server.fileno(), 4 << 20)
    assert port.limits.cut_hoarders() == []


def test_a_system_that_tells_less_of_its_connections(
    stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an emulator of another processor, and Linux before 4.6: it answers with fewer bytes."""
    port = Port(stack, socket.AF_INET, "127.0.0.1")
    port.connect("127.0.0.1")
    monkeypatch.setattr(connections, "_TCP_INFO", struct.Struct("=B51xI72xQ4096x"))
    assert not port.limits.cut_hoarders()
    assert port.limits.step() == 0


def test_other_files_are_no_crowd(stack: ExitStack) -> None:
    """Looking at each connection takes long where there are many: it is not done ten times a second."""
    port = Port(stack, socket.AF_INET, "127.0.0.1")
    _links = [port.connect("127.0.0.1") for _ in range(3)]
    port.limits.most = 4
    with (
        mock.patch.object(connections, "_INTERVAL", 0.0),
        mock.patch.object(port.limits, "_all", wraps=port.limits._all) as looks,
        mock.patch.object(connections, "_SHARE", 1e6),
    ):
        for _ in range(10):
            port.limits.step()
        assert looks.call_count == 1
        _more = [port.connect("127.0.0.1") for _ in range(2)]
        assert port.limits.step() == 2


def limits_of(connections: SimpleNamespace, refused: Counter[str]) -> ConnectionLimits:
    access = SimpleNamespace(take_revoked=lambda: False, refused=refused)
    return ConnectionLimits(cast("Any", connections), cast("Any", access), 1 << 30)


def test_those_that_fill_the_memory_go_first_and_all_if_that_does_not_help(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refused = Counter[str]()
    limits = limits_of(SimpleNamespace(cut_hoarders=lambda: [("198.51.100.7", 9_000_000)]), refused)
    monkeypatch.setattr(limits._memory, "excess", lambda _: 2 << 30)
    now = 100.0
    monkeypatch.setattr(connections, "time", SimpleNamespace(monotonic=lambda: now))
    assert [limits.all_must_go(0), limits.all_must_go(0)] == [False, True]
    now += connections._CUT_HELPS_WITHIN
    assert not limits.all_must_go(0)
    assert refused == {"memory": 3}
