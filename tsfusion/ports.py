# SPDX-License-Identifier: MIT
"""The server's three sockets, and how the gateway reads and writes them without ever waiting."""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import zmq

from tsfusion import process
from tsfusion.config import ServerConfig
from tsfusion.errors import TransportError
from tsfusion.transport import Addresses, sockets
from tsfusion.transport.curve import ServerKeys

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


class MemoryBound:
    """When what connections hold in memory is too much, so that they have to be dropped.

    That frees it, but not at once (threads of ZeroMQ's do it) and perhaps not all (this process may need
    it): who was told counts from what is held then, or would be told for ever.
    """

    def __init__(self, most: int) -> None:
        self._most = self._bound = most

    def excess(self, elsewhere: int) -> int:
        """What this process holds, bytes, when that is too much; else 0.

        Args:
            elsewhere: bytes that do not count.
        """
        held = process.rss_bytes() - elsewhere
        if held > self._bound:  # perhaps freed already, and only kept for later
            process.give_back_memory()
            held = process.rss_bytes() - elsewhere
        told = held if held > self._bound else 0
        reached = held + self._most // 8
        self._bound = max(self._most, reached if told else min(self._bound, reached))
        return told


class Departures:
    """Large answers that have not left yet, one a reader: who does not read must not fill our memory."""

    def __init__(self) -> None:
        self._trackers: dict[bytes, tuple[zmq.MessageTracker, int]] = {}

    def pending(self, reader: bytes) -> bool:
        """Whether an earlier one still waits for its reader. One whose reader is gone does not."""
        self._forget()
        return reader in self._trackers

    @property
    def nbytes(self) -> int:
        """What waits for readers."""
        self._forget()
        return sum(nbytes for _, nbytes in self._trackers.values())

    @property
    def largest(self) -> int:
        """The largest of them."""
        self._forget()
        return max((nbytes for _, nbytes in self._trackers.values()), default=0)

    def _forget(self) -> None:
        self._trackers = {key: kept for key, kept in self._trackers.items() if not kept[0].done}

    def wrap(self, reader: bytes, frames: Sequence[zmq.Frame]) -> list[zmq.Frame]:
        """The frames anew, so that it shows when the last has left."""
        *others, last = (frame.buffer for frame in frames)
        tracked = zmq.Frame(last, track=True, copy=False, copy_threshold=0)
        nbytes = sum(other.nbytes for other in others) + last.nbytes
        self._trackers[reader] = (tracked.tracker, nbytes)
        return [*(zmq.Frame(other, copy=False) for other in others), tracked]
