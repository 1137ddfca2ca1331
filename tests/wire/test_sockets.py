# SPDX-License-Identifier: MIT
"""Addresses, the sockets that listen at them, and questions that nobody answers."""

import socket
from typing import Any

import pytest
import zmq

from tsfusion.core.errors import InvalidConfig, ServerUnreachable, TransportError
from tsfusion.wire import sockets
from tsfusion.wire.messages import Command
from tsfusion.wire.queries import request
from tsfusion.wire.sockets import control_address


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
    ],
)
def test_a_malformed_address_is_one_clear_error(address: str) -> None:
    with pytest.raises(InvalidConfig, match="an address looks like"):
        control_address(address)
    with pytest.raises(InvalidConfig, match="an address looks like"):
        sockets.parse_address(address)


@pytest.mark.parametrize("address", ["tcp://0.0.0.0:5555", "tcp://*:5555", "tcp://192.168.1.4:5555"])
def test_without_keys_only_this_machine_may_connect(address: str) -> None:
    for word in ("tsfusion keys new server", "tsfusion keys allow", "--keys", "ssh -L"):
        with pytest.raises(InvalidConfig, match=word):
            sockets.check_reachable(address, has_keys=False)
    sockets.check_reachable(address, has_keys=True)
    for own in ("tcp://127.0.0.1:5555", "tcp://localhost:5555", "tcp://[::1]:5555"):
        sockets.check_reachable(own, has_keys=False)


@pytest.mark.parametrize("host", ["*", "0.0.0.0", "127.0.0.1"])
def test_a_server_can_listen_on_every_interface(host: str) -> None:
    context: zmq.Context[Any] = zmq.Context()
    made = sockets.pull(context, 1024), sockets.router(context), sockets.publisher(context)
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
        with pytest.raises(ServerUnreachable, match=f"no server answered at {address} within 0.2 s"):
            request(address, Command(name="status"), timeout=0.2)
