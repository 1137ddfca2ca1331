# SPDX-License-Identifier: MIT
"""One question to a server, one answer."""

import time
from contextlib import suppress
from typing import Any

import zmq

from tsfusion.errors import DecodeError, ServerUnreachable, TransportError
from tsfusion.transport import messages, sockets

_LONGEST = 1e6  # seconds; a poll takes no more than 2³¹ ms


def request(
    address: str, command: messages.Command, *, timeout: float
) -> tuple[messages.Reply, list[memoryview]]:
    """Send a command to a server's control address; its reply and the raw frames that came with it.

    Raises:
        InvalidConfig: for a malformed address.
        ServerUnreachable: when nobody answered within `timeout` seconds.
        TransportError: when the server answered that it cannot.
    """
    address, timeout = sockets.target(address), min(timeout, _LONGEST)
    context: zmq.Context[Any] = zmq.Context()
    link = sockets.dealer(context)
    try:
        link.connect(address)
        deadline = time.monotonic() + timeout
        if link.poll(int(timeout * 1000), zmq.POLLOUT):
            with suppress(zmq.Again):  # gone again already: no answer will come
                link.send(messages.encode(command), zmq.NOBLOCK)
        if not link.poll(max(int((deadline - time.monotonic()) * 1000), 0)):
            raise ServerUnreachable(f"no server answered at {address} within {timeout:g} s")
        head, *frames = link.recv_multipart(copy=False)
        reply = messages.decode_to_client(head.buffer)
    except DecodeError as error:
        raise TransportError(f"what answers at {address} is no tsfusion server: {error}") from error
    finally:
        link.close()
        context.term()
    if not isinstance(reply, messages.Reply):
        raise TransportError(f"the server at {address} answered a command with a {type(reply).__name__}")
    if reply.error is not None:
        raise TransportError(f"the server at {address}: {reply.error}")
    return reply, [frame.buffer for frame in frames]
