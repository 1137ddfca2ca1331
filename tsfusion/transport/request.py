# SPDX-License-Identifier: MIT
"""One question to a server, one answer."""

import time
from contextlib import suppress
from typing import Any

import zmq

from tsfusion.errors import DecodeError, NotAllowed, ServerUnreachable, TransportError
from tsfusion.transport import messages, sockets
from tsfusion.transport.curve import ClientKeys
from tsfusion.transport.monitor import Monitor

_LOOK_EVERY = 0.2  # seconds
_LONGEST = 1e6  # seconds; a poll takes no more than 2³¹ ms


def request(
    address: str, command: messages.Command, *, timeout: float, keys: ClientKeys | None = None
) -> tuple[messages.Reply, list[memoryview]]:
    """Send a command to a server's control address; its reply and the raw frames that came with it.

    Args:
        timeout: seconds.
        keys: of `curve.client_keys`; None = a connection without.

    Raises:
        InvalidConfig: for a malformed address.
        NotAllowed: as soon as the server turns the connection away.
        ServerUnreachable: when nobody answered within `timeout` seconds.
        TransportError: when the server answered that it cannot.
    """
    address, timeout = sockets.target(address), min(timeout, _LONGEST)
    context: zmq.Context[Any] = zmq.Context()
    link = sockets.dealer(context, keys)
    monitor = Monitor(link, address, keys)
    try:
        link.connect(address)
        head, *frames = _ask(link, monitor, command, timeout)
        reply = messages.decode_to_client(head.buffer)
    except DecodeError as error:
        raise TransportError(f"what answers at {address} is no tsfusion server: {error}") from error
    finally:
        monitor.close()
        link.close()
        context.term()
    if not isinstance(reply, messages.Reply):
        raise TransportError(f"the server at {address} answered a command with a {type(reply).__name__}")
    if reply.error is not None:
        raise TransportError(f"the server at {address}: {reply.error}")
    return reply, [frame.buffer for frame in frames]


def _ask(
    link: sockets.AnySocket, monitor: Monitor, command: messages.Command, timeout: float
) -> list[zmq.Frame]:
    """Send the question on each connection that is made, until there is an answer; its frames."""
    deadline = time.monotonic() + timeout
    why, asked = "", 0  # on which connection
    while (left := deadline - time.monotonic()) > 0:
        wanted = zmq.POLLIN | (zmq.POLLOUT if monitor.made > asked else 0)
        polled = [(link, wanted), (monitor.socket, zmq.POLLIN)]
        events = dict(zmq.zmq_poll(polled, int(min(left, _LOOK_EVERY) * 1000) + 1)).get(link, 0)
        if events & zmq.POLLIN:
            return link.recv_multipart(copy=False)
        if events & zmq.POLLOUT:
            asked = monitor.made
            with suppress(zmq.Again):  # gone again already: it is asked again on the next connection
                link.send(messages.encode(command), zmq.NOBLOCK)
        news = monitor.problem()
        why = why if news is None else news
        if monitor.gave_up:
            raise (NotAllowed if monitor.refused else TransportError)(why)
    reason = f": {why}" if why else ""
    raise ServerUnreachable(f"no server answered at {monitor.address} within {timeout:g} s{reason}")
