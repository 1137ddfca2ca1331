# SPDX-License-Identifier: MIT
"""The server's three sockets, and how the gateway reads and writes them without ever waiting."""

import logging
from collections.abc import Callable, Sequence
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
        self.keyframes = sockets.pull(context, server.max_frame_bytes)
        self.control = sockets.router(context)
        self.publish = sockets.publisher(context)

    def bind(self, server: ServerConfig) -> Addresses:
        """Open them to clients.

        Raises:
            TransportError: when a port is taken.
        """
        return sockets.bind(self.keyframes, self.control, self.publish, server.listen, server.control)

    def close(self) -> None:
        """Close them; nothing lingers."""
        for socket in (self.keyframes, self.control, self.publish):
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


class Departures:
    """Large answers that have not left yet, one a connection: who does not read must not fill our memory."""

    def __init__(self) -> None:
        self._trackers: dict[bytes, zmq.MessageTracker] = {}

    def pending(self, identity: bytes) -> bool:
        """Whether an earlier one still waits for its reader. One whose reader is gone does not."""
        self._trackers = {key: tracker for key, tracker in self._trackers.items() if not tracker.done}
        return identity in self._trackers

    def wrap(self, identity: bytes, frames: Sequence[zmq.Frame]) -> list[zmq.Frame]:
        """The frames anew, so that it shows when the last has left."""
        *others, last = (frame.buffer for frame in frames)
        tracked = zmq.Frame(last, track=True, copy=False, copy_threshold=0)
        self._trackers[identity] = tracked.tracker
        return [*(zmq.Frame(other, copy=False) for other in others), tracked]
