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
    """Send the question once there is a connection; the answer's frames."""
    deadline = time.monotonic() + timeout
    wanted, why, lost = zmq.POLLOUT, "", 0
    while (left := deadline - time.monotonic()) > 0:
        events = dict(zmq.zmq_poll([(link, wanted), (monitor.socket, zmq.POLLIN)], int(left * 1000) + 1))
        if monitor.socket in events:
            news = monitor.problem()
            why = why if news is None else news
            if monitor.gave_up:
                raise (NotAllowed if monitor.refused else TransportError)(why)
            if monitor.lost > lost:  # and the question or its answer with it
                wanted, lost = zmq.POLLOUT, monitor.lost
        if events.get(link, 0) & zmq.POLLIN:
            return link.recv_multipart(copy=False)
        if events.get(link, 0) & zmq.POLLOUT:
            with suppress(zmq.Again):  # gone again already: no answer will come
                link.send(messages.encode(command), zmq.NOBLOCK)
                wanted = zmq.POLLIN
    reason = f": {why}" if why else ""
    raise ServerUnreachable(f"no server answered at {monitor.address} within {timeout:g} s{reason}")
