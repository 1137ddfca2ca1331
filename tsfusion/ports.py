# SPDX-License-Identifier: MIT
"""The server's three sockets, and how the gateway reads and writes them without ever waiting."""

import logging
from collections.abc import Callable
from typing import Any, TypeAlias

import zmq

from tsfusion.config import ServerConfig
from tsfusion.transport import Addresses, sockets

log = logging.getLogger(__name__)

_MESSAGES_A_STEP = 16
Handler: TypeAlias = Callable[[list[zmq.Frame]], None]


class Ports:
    """Keyframes in, control both ways, mesh updates out."""

    def __init__(self, context: "zmq.Context[Any]", server: ServerConfig) -> None:
        self.data = sockets.pull(context, server.max_frame_bytes)
        self.control = sockets.router(context)
        self.publish = sockets.publisher(context)

    def bind(self, server: ServerConfig) -> Addresses:
        """Open them to clients.

        Raises:
            TransportError: when a port is taken.
        """
        return sockets.bind(self.data, self.control, self.publish, server.listen, server.control)

    def close(self) -> None:
        """Close them; nothing lingers."""
        for socket in (self.data, self.control, self.publish):
            socket.close()


def each(socket: sockets.AnySocket, handle: Handler) -> None:
    """Handle what a socket holds, up to a limit: then the others get their turn."""
    for _ in range(_MESSAGES_A_STEP):
        try:
            frames = socket.recv_multipart(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return
        handle(frames)


def send_now(socket: sockets.AnySocket, frames: list[Any]) -> None:
    """Send, or drop what cannot leave at once: the asker will ask again."""
    try:
        socket.send_multipart(frames, zmq.NOBLOCK, copy=False)
    except zmq.Again:
        log.warning("an answer was dropped: its connection is full")
