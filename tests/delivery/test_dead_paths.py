# SPDX-License-Identifier: MIT
"""A path to the server that is no more: connections over it are made anew, in time and not too often."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zmq
from bad_network import Proxy
from clients_and_spools import QUICK, deliver, send_all
from keyframes_and_servers import until, wall
from scripted_server import ScriptedServer, scripted

from tsfusion import Client
from tsfusion.core.config import ClientConfig
from tsfusion.delivery import sender
from tsfusion.delivery.sender import Patience
from tsfusion.wire.sockets import sockets

SOON = 25.0  # seconds: 2 of silence and what a busy machine needs; TCP by itself takes a quarter of an hour


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client takes half a second of silence for an absence, not two seconds."""
    monkeypatch.setattr(sender, "_LEAST_SILENCE", 0.5)


@contextmanager
def behind_a_relay(config: ClientConfig = QUICK) -> Iterator[tuple[ScriptedServer, Proxy, Client]]:
    with scripted() as server, Proxy() as proxy:
        proxy.target(server.address, server.control)
        with Client(proxy.address, config=config) as client:
            yield server, proxy, client


@pytest.mark.usefixtures("impatient")
def test_a_scanner_that_a_nat_forgot_is_on_again() -> None:
    with behind_a_relay() as (server, proxy, client):
        deliver(client, map(wall, range(3)))
        proxy.forget()
        send_all(client, range(3, 10))
        client.flush(SOON)
        client.wait_fused(SOON)
        assert server.numbers == [*range(10)]
        assert client.connected


@pytest.mark.usefixtures("impatient")
def test_a_scanner_is_on_again_when_its_network_is() -> None:
    with behind_a_relay() as (server, proxy, client):
        deliver(client, map(wall, range(3)))
        proxy.black_hole(True)
        send_all(client, range(3, 10))
        until(lambda: not client.connected)
        proxy.heal()
        client.flush(SOON)
        assert server.numbers == [*range(10)]


def test_patience_doubles_until_there_is_a_sign_of_life() -> None:
    patience = Patience(2.0)
    ends = [now for now in range(1, 200) if patience.has_ended(now, since=0.0, sign=0.0)]
    assert ends == [3, 8, 17, 34, 67, 100, 133, 166, 199]
    assert not patience.has_ended(203, since=0.0, sign=202.0)
    assert patience.has_ended(205, since=0.0, sign=202.0)


def test_waiting_begins_when_there_is_something_to_wait_for() -> None:
    patience = Patience(2.0)
    assert not patience.has_ended(100.0, since=99.0, sign=50.0)
    assert patience.has_ended(101.5, since=99.0, sign=50.0)


@pytest.mark.parametrize(
    ("make", "seconds"),
    [
        *((make, 5.0) for make in (sockets.push, sockets.dealer)),
        *((make, 30.0) for make in (lambda context: sockets.pull(context, 1024), sockets.router)),
    ],
)
def test_both_ends_notice_that_the_other_left_without_a_word(make, seconds: float) -> None:
    """A relay on this machine answers probes as long as it lives: only the settings can be looked at."""
    with zmq.Context() as context, make(context) as made:
        assert made.getsockopt(zmq.TCP_KEEPALIVE) == 1
        probes = made.getsockopt(zmq.TCP_KEEPALIVE_INTVL) * made.getsockopt(zmq.TCP_KEEPALIVE_CNT)
        assert 0 < made.getsockopt(zmq.TCP_KEEPALIVE_IDLE) + probes <= seconds
        assert 0 < made.getsockopt(zmq.TCP_MAXRT) <= 1000 * seconds
        assert 0 < made.getsockopt(zmq.HANDSHAKE_IVL) <= 5000


def test_a_server_that_is_away_is_not_hammered(monkeypatch: pytest.MonkeyPatch) -> None:
    """While nobody listens, libzmq asks once a second; nothing that is new comes on top of that."""
    monkeypatch.setattr(sender, "_LEAST_SILENCE", 0.2)
    impatient = ClientConfig(stall_timeout=0.2)
    with scripted() as server, Client(server.address, control=server.control, config=impatient) as client:
        deliver(client, [wall()])
        server.stop()
        made = client._sender._control.socket
        send_all(client, range(1, 3))
        until(lambda: client._sender.finds_nobody)
        ends = time.monotonic() + 1.0
        until(lambda: time.monotonic() > ends)
        assert client._sender._control.socket is made
        server.start()
        client.flush(SOON)
        assert server.numbers == [0, 1, 2]
