# SPDX-License-Identifier: MIT
"""Addresses, the sockets that listen at them, and questions that nobody answers."""

import socket
import time
from contextlib import closing
from typing import Any

import fake_server
import pytest
import zmq
from clients_and_spools import NOBODY
from keyframes_and_servers import DEADLINE, Server, until, wall
from scripted_server import scripted

from tsfusion import Client
from tsfusion.core.errors import InvalidConfig, ServerUnreachable, TransportError
from tsfusion.gateway.ports.access_control import peer_address
from tsfusion.wire.asking import queries
from tsfusion.wire.asking.queries import fetch_mesh, fetch_status, request
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection import ServerLink
from tsfusion.wire.sockets.sockets import control_address

needs_ipv6 = pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="this machine has no IPv6")


def test_the_control_socket_is_the_next_port_unless_told() -> None:
    assert control_address("tcp://127.0.0.1:5555") == "tcp://127.0.0.1:5556"
    assert control_address("tcp://127.0.0.1:5555", "tcp://127.0.0.1:9000") == "tcp://127.0.0.1:9000"
    assert control_address("tcp://[::1]:5555") == "tcp://[::1]:5556"


@pytest.mark.parametrize(
    "address",
    [
        *("", "127.0.0.1:5555", "tcp://127.0.0.1", "tcp://:5555", "udp://127.0.0.1:5"),
        *("tcp://127.0.0.1:99999", "tcp://127.0.0.1:5555/x", "tcp://host:port"),
        *("tcp://a b:5555", "tcp://127.0.0.1:5555?x", "tcp://u@127.0.0.1:5", "tcp://\0:5"),
        *("tcp://::1:5555", "tcp://[::1]", "tcp://[::1:5555", "tcp://[1::2::3]:5555", "tcp://[]:5555"),
        *("tcp://[host]:5555", "tcp://[127.0.0.1]:5555", "tcp://[::1%]:5555", "tcp://[::1]:99999"),
    ],
)
def test_a_malformed_address_is_one_clear_error(address: str) -> None:
    with pytest.raises(InvalidConfig, match="an address looks like"):
        control_address(address)
    with pytest.raises(InvalidConfig, match="an address looks like"):
        sockets.parse_address(address)


def test_a_link_local_address_names_its_interface() -> None:
    with pytest.raises(InvalidConfig, match=r"names its interface, as in tcp://\[fe80::1%eth0\]:5555"):
        sockets.parse_address("tcp://[fe80::2]:5555")
    assert sockets.parse_address("tcp://[fe80::2%br-lan.1]:5555") == ("fe80::2%br-lan.1", 5555)


@pytest.mark.parametrize(
    "address",
    [
        *("tcp://0.0.0.0:5555", "tcp://*:5555", "tcp://192.168.1.4:5555", "tcp://[::]:5555"),
        *("tcp://[fe80::1%lo]:5555", "tcp://[2001:db8::1]:5555", "tcp://[::ffff:192.168.1.4]:5555"),
        "tcp://[::ffff:0.0.0.0]:5555",
    ],
)
def test_without_keys_only_this_machine_may_connect(address: str) -> None:
    for word in ("tsfusion keys new server", "tsfusion keys allow", "--keys", "ssh -L"):
        with pytest.raises(InvalidConfig, match=word):
            sockets.check_reachable(address, has_keys=False)
    sockets.check_reachable(address, has_keys=True)
    for own in ("127.0.0.1", "localhost", "[::1]", "[::ffff:127.0.0.1]", "127.0.0.2"):
        sockets.check_reachable(f"tcp://{own}:5555", has_keys=False)


@pytest.mark.parametrize("host", ["*", "0.0.0.0", "127.0.0.1", "[::1]", "[::]", "[::ffff:127.0.0.1]"])
def test_a_server_can_listen_on_every_interface(host: str) -> None:
    if ":" in host and not socket.has_dualstack_ipv6():
        pytest.skip("this machine has no IPv6")
    context: zmq.Context[Any] = zmq.Context()
    made = sockets.pull(context, 1024), sockets.router(context)
    try:
        sockets.check_free(f"tcp://{host}:0")
        addresses = sockets.bind(*made, f"tcp://{host}:0", None)
        shown = host.replace("*", "0.0.0.0")
        assert addresses.data.startswith(f"tcp://{shown}:")
        assert sockets.control_address(addresses.data) == addresses.control
    finally:
        for one in made:
            one.close()
        context.term()


@needs_ipv6
@pytest.mark.parametrize(
    ("listen", "seen"),
    [
        ("[::]", {"[::1]": "::1", "127.0.0.1": "127.0.0.1", "[::ffff:127.0.0.1]": "127.0.0.1"}),
        ("[::1]", {"[::1]": "::1", "127.0.0.1": ""}),
        ("*", {"127.0.0.1": "127.0.0.1", "[::1]": ""}),
    ],
)
def test_who_can_connect_over_ipv4_and_ipv6(listen: str, seen: dict[str, str]) -> None:
    """The address of the other end, as the server sees it; empty = it cannot connect."""
    with zmq.Context() as context, sockets.pull(context, 1024) as server:
        port = sockets.bind_socket(server, f"tcp://{listen}:0").rpartition(":")[2]
        for host, address in seen.items():
            with sockets.push(context) as client:
                sockets.connect(client, f"tcp://{host}:{port}")
                if address:
                    assert client.poll(10_000, zmq.POLLOUT)
                    client.send(b"x")
                    assert peer_address(server.recv(copy=False)) == address
                else:
                    assert not client.poll(100, zmq.POLLOUT)


@needs_ipv6
@pytest.mark.parametrize("listen", ["[::1]", "127.0.0.1"])
@pytest.mark.parametrize("host", ["localhost", "own"])
def test_a_client_finds_a_server_at_either_kind_of_address(listen: str, host: str) -> None:
    anywhere = f"tcp://{listen}:0"
    with scripted(address=anywhere, control=anywhere) as server:
        ports = [int(one.rpartition(":")[2]) for one in (server.address, server.control)]
        data, control = (f"tcp://{listen if host == 'own' else host}:{port}" for port in ports)
        with Client(data, control=control) as client:
            client.send(wall())
            client.flush(DEADLINE)
            client.connect(DEADLINE)
        assert server.numbers == [0]


@needs_ipv6
def test_a_name_is_looked_for_at_both_kinds_of_address() -> None:
    with socket.socket(socket.AF_INET6) as unused, zmq.Context() as context:
        unused.bind(("::1", 0))
        address = f"tcp://localhost:{unused.getsockname()[1]}"
        with closing(ServerLink(context, sockets.dealer, address, None)) as connection:
            until(lambda: connection.check(time.monotonic()) is not None and connection.finds_nobody)
            made = connection.socket
            assert connection.check(time.monotonic()) == (None, False)
            assert connection.socket is made  # and not sought again and again at once


def test_a_taken_port_is_one_clear_error() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"cannot listen on {address}: Address already in use"):
            sockets.check_free(address)


def test_a_dead_server_is_one_clear_error() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(ServerUnreachable, match=f"no server answered at {address} .* within 0.2 s"):
            request(address, Command(name="status"), control=address, timeout=0.2)


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
