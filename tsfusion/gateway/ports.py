# SPDX-License-Identifier: MIT
"""The server's three sockets, read and written without ever waiting, and what viewers subscribed to."""

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import zmq

from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import TransportError
from tsfusion.wire import messages, sockets
from tsfusion.wire.curve import ServerKeys
from tsfusion.wire.sockets import Addresses

log = logging.getLogger(__name__)

_MESSAGES_A_STEP = 16
_REBIND_INTERVAL = 0.01  # seconds
Handler: TypeAlias = Callable[[list[zmq.Frame]], None]


class Ports:
    """The sockets: keyframes in, control both ways, mesh updates out."""

    def __init__(
        self, context: "zmq.Context[Any]", server: ServerConfig, keys: ServerKeys | None = None
    ) -> None:
        self._context = context
        self._server = server
        self._keys = keys
        self._addresses: Addresses | None = None
        self._next_bind = 0.0
        self.problem = ""  # why nobody can connect; empty = clients can
        self._open()

    def _open(self) -> None:
        self.keyframes = sockets.pull(self._context, self._server.max_frame_bytes, keys=self._keys)
        self.control = sockets.router(self._context, keys=self._keys)
        self.viewers = sockets.publisher(self._context, keys=self._keys)

    def bind(self) -> Addresses:
        """Bind the sockets, so that clients can connect.

        Raises:
            TransportError: when a port is taken.
        """
        listen, control = self._server.listen, self._server.control
        self._addresses = sockets.bind(self.keyframes, self.control, self.viewers, listen, control)
        return self._addresses

    def reply(self, identity: bytes, message: messages.ToClient, frames: Sequence[zmq.Frame] = ()) -> None:
        """Send a message to a connection of the control socket, or drop it."""
        send_now(self.control, [identity, messages.encode_sealed(message), *frames])

    def publish(self, topic: bytes, message: bytes, frames: Sequence[zmq.Frame]) -> None:
        """Send a mesh update to the viewers that subscribed to its topic, or drop it."""
        send_now(self.viewers, [topic, message, *frames])

    def renew(self) -> None:
        """Drop every connection, with all that it holds in memory; `step` listens at the same ports again."""
        self.close()
        self.problem = "every connection is made anew"
        self.step()

    def step(self) -> None:
        """Listen again, as soon as ZeroMQ's threads have given the ports back. Never waits."""
        now = time.monotonic()
        if not self.problem or now < self._next_bind:
            return
        self._next_bind = now + _REBIND_INTERVAL
        try:
            if self.control.closed:
                self._open()
            if self._addresses is not None:
                addresses = self._addresses
                sockets.bind(self.keyframes, self.control, self.viewers, addresses.data, addresses.control)
        except (TransportError, zmq.ZMQError) as error:
            if self.control.closed:
                self.close()  # no room for all three
            self.problem = f"cannot listen any more, and will try again: {error}"
        else:
            self.problem = ""

    def close(self) -> None:
        """Close the sockets at once, with whatever they have not sent."""
        for socket in (self.keyframes, self.control, self.viewers):
            socket.close()


def receive_some(socket: sockets.AnySocket, handle: Handler) -> None:
    """Handle the messages that a socket holds, up to a limit: then the other sockets get their turn."""
    for _ in range(_MESSAGES_A_STEP):
        try:
            frames = socket.recv_multipart(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return
        handle(frames)


def send_now(socket: sockets.AnySocket, frames: list[Any]) -> None:
    """Send a message, or drop it when it cannot leave at once: whoever needs it will ask again."""
    try:
        socket.send_multipart(frames, zmq.NOBLOCK, copy=False)
    except zmq.ZMQError as error:  # zmq.Again: it is full; or it is being made anew
        log.warning("an answer was dropped: %s", error)


_MAX_TOPICS = 256  # of maps that are not open


class Subscriptions:
    """The topics that viewers subscribed to, as far as they can be a map's."""

    def __init__(self) -> None:
        self._topics: set[bytes] = set()

    def __len__(self) -> int:
        return len(self._topics)

    def add(self, topic: bytes, maps: Iterable[str]) -> bool:
        """Note a subscription; False when it can match no map. Topics of open maps are never too many.

        Args:
            maps: the names of the open maps.
        """
        wanted = any(sockets.mesh_topic(name).startswith(topic) for name in maps)
        if not wanted and (len(self._topics) >= _MAX_TOPICS or not sockets.is_mesh_topic(topic)):
            return False
        self._topics.add(topic)
        return True

    def discard(self, topic: bytes) -> None:
        """Note that the last subscription to a topic ended."""
        self._topics.discard(topic)

    def clear(self) -> None:
        """Forget all subscriptions: every connection was dropped."""
        self._topics.clear()

    def watched(self, map_name: str) -> bool:
        """Whether any viewer gets a map's updates."""
        topic = sockets.mesh_topic(map_name)
        return any(topic.startswith(wanted) for wanted in self._topics)
