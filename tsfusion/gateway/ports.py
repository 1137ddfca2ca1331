# SPDX-License-Identifier: MIT
"""The server's three sockets, and how the gateway reads and writes them without ever waiting."""

import logging
import time
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import zmq

from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import TransportError
from tsfusion.wire import sockets
from tsfusion.wire.curve import ServerKeys
from tsfusion.wire.sockets import Addresses

log = logging.getLogger(__name__)

_MESSAGES_A_STEP = 16
_REBIND_INTERVAL = 0.01  # seconds
Handler: TypeAlias = Callable[[list[zmq.Frame]], None]


class Ports:
    """Keyframes in, control both ways, mesh updates out.

    Attributes:
        problem: why nobody can connect; empty = they can.
    """

    def __init__(
        self, context: "zmq.Context[Any]", server: ServerConfig, keys: ServerKeys | None = None
    ) -> None:
        self._context = context
        self._server = server
        self._keys = keys
        self._addresses: Addresses | None = None
        self._again = 0.0  # when it is tried again to listen
        self.problem = ""
        self._open()

    def _open(self) -> None:
        self.keyframes = sockets.pull(self._context, self._server.max_frame_bytes, keys=self._keys)
        self.control = sockets.router(self._context, keys=self._keys)
        self.publish = sockets.publisher(self._context, keys=self._keys)

    def bind(self) -> Addresses:
        """Open them to clients.

        Raises:
            TransportError: when a port is taken.
        """
        listen, control = self._server.listen, self._server.control
        self._addresses = sockets.bind(self.keyframes, self.control, self.publish, listen, control)
        return self._addresses

    def renew(self) -> None:
        """Drop every connection, with all that it holds in memory; `step` listens at the same ports again."""
        self.close()
        self.problem = "every connection is made anew"
        self.step()

    def step(self) -> None:
        """Listen again, as soon as ZeroMQ's threads have given the ports back. Never waits."""
        now = time.monotonic()
        if not self.problem or now < self._again:
            return
        self._again = now + _REBIND_INTERVAL
        try:
            if self.control.closed:
                self._open()
            if self._addresses is not None:
                addresses = self._addresses
                sockets.bind(self.keyframes, self.control, self.publish, addresses.data, addresses.control)
        except (TransportError, zmq.ZMQError) as error:
            if self.control.closed:
                self.close()  # no room for all three
            self.problem = f"cannot listen any more, and will try again: {error}"
        else:
            self.problem = ""

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
    except zmq.ZMQError as error:  # zmq.Again: it is full; or it is being made anew
        log.warning("an answer was dropped: %s", error)


_MAX_TOPICS = 256  # of maps that are not open


class Subscriptions:
    """Topics that somebody subscribed to, as far as they can be a map's."""

    def __init__(self) -> None:
        self._topics: set[bytes] = set()

    def __len__(self) -> int:
        return len(self._topics)

    def add(self, topic: bytes, maps: Iterable[str]) -> bool:
        """Somebody subscribed; False when that leads to nothing. The topics of open maps always have room.

        Args:
            maps: those that are open.
        """
        wanted = any(sockets.mesh_topic(name).startswith(topic) for name in maps)
        if not wanted and (len(self._topics) >= _MAX_TOPICS or not sockets.is_mesh_topic(topic)):
            return False
        self._topics.add(topic)
        return True

    def discard(self, topic: bytes) -> None:
        """Nobody does any more."""
        self._topics.discard(topic)

    def clear(self) -> None:
        """All connections are gone."""
        self._topics.clear()

    def watched(self, map_name: str) -> bool:
        """Whether anybody gets a map's updates."""
        topic = sockets.mesh_topic(map_name)
        return any(topic.startswith(wanted) for wanted in self._topics)
