# SPDX-License-Identifier: MIT
"""The server's two sockets, read and written without blocking: messages in, messages out."""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import zmq

from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import TransportError
from tsfusion.gateway.ports.access_control import AccessControl, ZapHandler, file_of, peer_address, sender_of
from tsfusion.gateway.ports.connections import Connections, Flood
from tsfusion.wire.messages import messages
from tsfusion.wire.records.codec import MAX_FRAMES
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.sockets import Addresses

log = logging.getLogger(__name__)

_MESSAGES_A_STEP = 16
_SECONDS_A_STEP = 0.05
_MANY_FRAMES = 1000  # more surplus frames than any mistake explains
_MOST_DISCARDED = 50_000  # frames of one message that are read and dropped: some 50 ms
_REBIND_INTERVAL = 0.01  # seconds


class Incoming(NamedTuple):
    """Message of a client that may use this server.

    Attributes:
        client: name under which its key is allowed; empty without keys.
        frames: from the control socket without the identity.
        identity: of the connection to the control socket.
        connection: file number of the connection; None if not known.
        address: of the client's machine; empty if not known.
    """

    client: str
    frames: list[memoryview]
    identity: bytes = b""
    connection: int | None = None
    address: str = ""


class OutgoingAnswer(NamedTuple):
    """Message for a connection to the control socket."""

    identity: bytes
    message: messages.ToClient
    frames: Sequence[Any] = ()


Handler: TypeAlias = Callable[[Incoming], None]


class Ports:
    """The sockets: records come in, control messages go both ways."""

    def __init__(self, context: "zmq.Context[Any]", server: ServerConfig, access: AccessControl) -> None:
        self._context, self._server, self._access = context, server, access
        self._zap = ZapHandler(context, access) if access.keys else None
        self._addresses: dict[str, str] = {}  # of the sockets, once they are bound
        self._unbound: set[str] = set()  # sockets that are being made anew
        self._next_bind = 0.0
        self.problem = ""  # why nobody can connect; empty if clients can
        self.connections = Connections(server.memory_bytes)
        self._sockets = {name: self._make(name) for name in ("keyframes", "control")}

    def _make(self, name: str) -> sockets.AnySocket:
        if name == "keyframes":
            return sockets.pull(self._context, self._server.max_frame_bytes, keys=self._access.keys)
        return sockets.router(self._context, keys=self._access.keys)

    @property
    def keyframes(self) -> sockets.AnySocket:
        """Socket for incoming records."""
        return self._sockets["keyframes"]

    @property
    def control(self) -> sockets.AnySocket:
        """Socket for incoming greetings, pings and commands, and for the answers."""
        return self._sockets["control"]

    @property
    def polled(self) -> list[sockets.AnySocket]:
        """Sockets whose messages `step` answers."""
        return [self._zap.socket] if self._zap else []

    def is_served(self, socket: sockets.AnySocket) -> bool:
        """True unless the socket is being made anew."""
        return all(self._sockets[name] is not socket for name in self._unbound)

    def bind(self) -> Addresses:
        """Bind the sockets. Clients can connect from then on.

        Raises:
            TransportError: when a port is taken.
        """
        listen, control = self._server.listen, self._server.control
        found = sockets.bind(self.keyframes, self.control, listen, control)
        self._addresses = {"keyframes": found.data, "control": found.control}
        self.connections.ports = {sockets.parse_address(one)[1] for one in self._addresses.values()}
        return found

    def send(self, one: OutgoingAnswer) -> None:
        """Send a message, or drop it if it cannot leave at once: its receiver will ask again."""
        frames = [one.identity, messages.encode_sealed(one.message), *one.frames]
        try:
            self.control.send_multipart(frames, zmq.NOBLOCK, copy=False)
        except zmq.ZMQError as error:  # zmq.Again: the queue is full; others: the socket is being made anew
            log.warning("an answer was dropped: %s", error)

    def receive_some(
        self, socket: sockets.AnySocket, handle: Handler, on_flood: Callable[[Flood], None]
    ) -> None:
        """Handle a limited number of messages of a socket, so that the other sockets get their turn.

        Args:
            on_flood: called for a message with many more frames than any valid one, which is not handled.
        """
        until = time.monotonic() + _SECONDS_A_STEP
        for _ in range(_MESSAGES_A_STEP):
            if socket.closed or time.monotonic() > until:  # the handler closed it, or the disk is slow
                return
            try:
                frames = [socket.recv(zmq.NOBLOCK, copy=False)]
            except zmq.Again:
                return
            while frames[-1].more and len(frames) <= MAX_FRAMES:  # one too many marks an invalid message
                frames.append(socket.recv(zmq.NOBLOCK, copy=False))
            discarded = _discard(socket) if frames[-1].more else 0
            if discarded > _MANY_FRAMES:
                on_flood(Flood(frames[0], discarded, socket.getsockopt(zmq.RCVMORE) == 1))
                return
            if (received := self._received(socket, frames)) is not None:
                handle(received)

    def _received(self, socket: sockets.AnySocket, frames: list[zmq.Frame]) -> Incoming | None:
        """Return a message with its sender, or None (and count it) if the sender has no access."""
        if (connection := file_of(frames[-1])) is not None:
            self.connections.note_read(connection, sum(map(len, frames)))
        client = self._access.client_of(sender_of(frames[0]) if self._access.keys else None)
        if client is None:
            self._access.refused["key"] += 1
            return None
        buffers = [frame.buffer for frame in frames]
        if socket is not self.control:
            return Incoming(client, buffers, connection=connection)
        identity, address = frames[0].bytes, peer_address(frames[0])
        return Incoming(client, buffers[1:], identity, connection, address)

    def renew(self, only: sockets.AnySocket | None = None) -> None:
        """Drop every connection, with its memory. `step` then listens at the same ports again.

        Args:
            only: the socket whose connections are dropped; None drops those of all sockets.
        """
        for name, socket in self._sockets.items():
            if only in (None, socket):
                socket.close()
                self._unbound.add(name)
        self.problem = "connections are made anew"
        self.step()

    def step(self) -> None:
        """Answer new connections. Listen again once ZeroMQ's threads have released the ports. Never block."""
        if self._zap:
            self._zap.answer_all()
        now = time.monotonic()
        if not self._unbound or now < self._next_bind:
            return
        self._next_bind = now + _REBIND_INTERVAL
        self.problem = ""
        for name in [one for one in self._sockets if one in self._unbound]:
            try:
                if self._sockets[name].closed:
                    self._sockets[name] = self._make(name)
                if self._addresses:
                    sockets.bind_socket(self._sockets[name], self._addresses[name])
                self._unbound.remove(name)
            except (TransportError, zmq.ZMQError) as error:
                self.problem = f"cannot listen any more, and will try again: {error}"

    def close(self) -> None:
        """Close the sockets at once. Unsent messages are lost."""
        for socket in self._sockets.values():
            socket.close()
        if self._zap:
            self._zap.close()


def _discard(socket: sockets.AnySocket) -> int:
    """Read and drop the rest of a message, up to a limit. Return the number of frames."""
    discarded, more = 0, True
    while more and discarded < _MOST_DISCARDED:
        socket.recv(zmq.NOBLOCK)
        more = socket.getsockopt(zmq.RCVMORE) == 1
        discarded += 1
    return discarded
