# SPDX-License-Identifier: MIT
"""The server's three sockets, read and written without ever waiting, and what viewers subscribed to."""

import logging
import time
from collections import Counter
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
    """The sockets: keyframes in, control both ways, mesh updates out.

    Args:
        grants_topics: asked when sockets are made: whether viewers get only what `grant_topics` says.
    """

    def __init__(
        self,
        context: "zmq.Context[Any]",
        server: ServerConfig,
        keys: ServerKeys | None = None,
        *,
        grants_topics: Callable[[], bool] = lambda: False,
    ) -> None:
        self._context = context
        self._server = server
        self._keys = keys
        self._grants_topics = grants_topics
        self._addresses: Addresses | None = None
        self._next_bind = 0.0
        self.problem = ""  # why nobody can connect; empty = clients can
        self._open()

    def _open(self) -> None:
        self.keyframes = sockets.pull(self._context, self._server.max_frame_bytes, keys=self._keys)
        self.control = sockets.router(self._context, keys=self._keys)
        self._open_viewers()

    def _open_viewers(self) -> None:
        self._is_manual = self._grants_topics()
        self.viewers = sockets.publisher(self._context, keys=self._keys, manual=self._is_manual)

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
        if not self.viewers.closed:
            send_now(self.viewers, [topic, message, *frames])

    def grant_topics(self, topics: Iterable[bytes]) -> None:
        """Send these topics' updates to the viewer whose message was received last."""
        for topic in topics if self._is_manual else ():
            self.viewers.setsockopt(zmq.SUBSCRIBE, topic)

    def revoke_topics(self, topics: Iterable[bytes]) -> None:
        """Send these topics' updates to that viewer no more."""
        for topic in topics if self._is_manual else ():
            self.viewers.setsockopt(zmq.UNSUBSCRIBE, topic)

    def pass_over_rubbish(self) -> bool:
        """Pass over what a viewer sent that is no subscription; whether all viewers have to connect anew.

        Where topics are granted, ZeroMQ takes subscriptions that wait behind it for other viewers' than those
        that sent them.
        """
        for _ in range(_MESSAGES_A_STEP if self._is_manual else 0):
            if not int(self.viewers.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                return False
            if self.viewers.recv_multipart(copy=False)[0].bytes[:1] in (b"\x00", b"\x01"):
                break
        if self._is_manual:
            self.viewers.close()
        return self._is_manual

    def renew(self) -> None:
        """Drop every connection, with all that it holds in memory; `step` listens at the same ports again."""
        self.close()
        self.problem = "every connection is made anew"
        self.step()

    def step(self) -> None:
        """Listen again, as soon as ZeroMQ's threads have given the ports back. Never waits."""
        now = time.monotonic()
        if now < self._next_bind:
            return
        if not self.problem and self.viewers.closed:
            self._next_bind = now + _REBIND_INTERVAL
            self._listen_for_viewers()
        if not self.problem:
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

    def _listen_for_viewers(self) -> None:
        try:
            self._open_viewers()
            if self._addresses is not None:
                sockets.bind_socket(self.viewers, self._addresses.publish)
        except (TransportError, zmq.ZMQError) as error:
            log.debug("viewers cannot connect yet: %s", error)
            self.viewers.close()

    def close(self) -> None:
        """Close the sockets at once, with whatever they have not sent."""
        for socket in (self.keyframes, self.control, self.viewers):
            socket.close()


def receive_some(socket: sockets.AnySocket, handle: Handler) -> None:
    """Handle the messages that a socket holds, up to a limit: then the other sockets get their turn."""
    for _ in range(_MESSAGES_A_STEP):
        if socket.closed:  # by the handler
            return
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
    """The topics that viewers subscribed to, as far as they can be a map's.

    A connection that ends takes its subscriptions back, but nobody says then whose they were. So those that
    were not granted are counted, too: a map may be taken for watched that is not, never the other way round.
    """

    def __init__(self) -> None:
        self._granted: Counter[bytes] = Counter()
        self._denied: Counter[bytes] = Counter()

    def __len__(self) -> int:
        return len(self._granted.keys() | self._denied.keys())

    def add(self, topic: bytes, maps: Iterable[str], *, granted: bool = True) -> bool:
        """Note a subscription; False when it is not to be granted. Topics of open maps are never too many.

        Args:
            maps: the names of the open maps.
            granted: whether its viewer may have any of it.
        """
        wanted = any(sockets.mesh_topic(name).startswith(topic) for name in maps)
        new = topic not in self._granted and topic not in self._denied
        if not wanted and ((new and len(self) >= _MAX_TOPICS) or not sockets.is_mesh_topic(topic)):
            return False
        (self._granted if granted else self._denied)[topic] += 1
        return granted

    def discard(self, topic: bytes, *, granted: bool | None = None) -> None:
        """Note that a subscription to a topic ended.

        Args:
            granted: as in `add`; None = not known.
        """
        denied_first = granted is None and self._denied[topic] > 0
        counts = self._denied if denied_first or granted is False else self._granted
        counts[topic] -= 1
        self._granted, self._denied = +self._granted, +self._denied

    def clear(self) -> None:
        """Forget all subscriptions: every connection was dropped."""
        self._granted.clear()
        self._denied.clear()

    def watched(self, map_name: str) -> bool:
        """Whether any viewer gets a map's updates."""
        topic = sockets.mesh_topic(map_name)
        return any(topic.startswith(wanted) for wanted in self._granted)
