# SPDX-License-Identifier: MIT
"""The key of a server's own page: it may watch every map, and send nothing."""

from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
import zmq
from served_gateway import Served, record, serving_here

from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.questions import Scans
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys, server_keys


@pytest.mark.parametrize("limited", [False, True], ids=["", "with clients of few maps"])
def test_a_guest_watches_and_sends_nothing(tmp_path: Path, limited: bool) -> None:
    key_folder.create_pair(tmp_path / "keys", "server")
    robot = key_folder.create_pair(tmp_path / "robot", "robot")
    key_folder.allow(tmp_path / "keys", "robot", robot.public, maps=["yard"] if limited else None)
    keys = ClientKeys.drawn(server_keys(tmp_path / "keys").public)
    with ExitStack() as stack:
        context: zmq.Context[Any] = zmq.Context()
        stack.callback(context.destroy, 0)
        served = stack.enter_context(
            serving_here(tmp_path / "state", keys=str(tmp_path / "keys"), guest=keys.public)
        )
        dealer = stack.enter_context(closing(sockets.dealer(context, keys=keys)))
        push = stack.enter_context(closing(sockets.push(context, keys=keys)))
        stranger = stack.enter_context(closing(sockets.dealer(context, keys=ClientKeys.drawn(keys.server))))
        dealer.connect(served.addresses.control)
        push.connect(served.addresses.data)
        stranger.connect(served.addresses.control)

        health = ask(served, dealer, messages.Command(name="health")).health
        assert health is not None
        assert list(health.maps) == ["default"]
        watch = messages.Command(name="ask", question=Scans(wait_s=0.0))
        send(served, dealer, [messages.encode(watch)])
        served.until(lambda: dealer.poll(0))
        reply = messages.decode_to_client(dealer.recv_multipart()[0])
        assert isinstance(reply, messages.Reply)
        assert reply.answer is not None

        denied = served.greet(dealer, "default")
        assert (denied.reason, denied.message) == ("map", "this key may only watch")
        send(served, push, record(1))
        served.until(lambda: served.gateway.health().refused.get("forbidden", 0) == 2)
        assert served.durable == 0
        everything = messages.Command(name="forget", selection=Selection(client="robot"))
        assert "may forget keyframes of client (guest) only" in str(ask(served, dealer, everything).error)
        served.until(lambda: served.gateway._access.refused["unknown"] == 1)


def ask(served: Served, dealer: sockets.AnySocket, command: messages.Command) -> messages.Reply:
    send(served, dealer, [messages.encode(command)])
    found = served.heard(dealer, messages.Reply)
    assert isinstance(found, messages.Reply)
    return found


def send(served: Served, socket: sockets.AnySocket, frames: list[bytes]) -> None:
    """Send a message once there is a connection, which the gateway has to allow first."""

    def is_sent() -> bool:
        try:
            socket.send_multipart(frames, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    served.until(is_sent)
