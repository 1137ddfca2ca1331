# SPDX-License-Identifier: MIT
"""The client's thread: sends what the spool holds, as far as the server's credit goes.

PUSH loses what is under way when a server dies, silently; so everything is kept until the server says it is
on its disk, and sent again from there when the server is a new one (epoch) or nothing moves (stall).
"""

import errno
import logging
import socket
import threading
import time
from contextlib import suppress
from typing import Any

import zmq

from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import DecodeError, JournalError
from tsfusion.delivery.connection import Connection
from tsfusion.delivery.control_session import ControlSession
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.refused_keyframes import RefusedFolder
from tsfusion.delivery.spool import Waiting
from tsfusion.wire import sockets
from tsfusion.wire.curve import ClientKeys
from tsfusion.wire.record_header import stamp

log = logging.getLogger(__name__)

_READ_AGAIN = 0.5  # seconds
_READ_TRIES = 6
_SCARCE = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)  # what others of this machine will give back


class Sender:
    """Owns the sockets; `run` is the thread's body."""

    def __init__(
        self,
        address: str,
        control: str,
        outbox: Outbox,
        config: ClientConfig,
        keys: ClientKeys | None = None,
    ) -> None:
        self._address = address
        self._control = control
        self._keys = keys
        self._outbox = outbox
        self._config = config
        self._refused = RefusedFolder(outbox)
        self._talk = ControlSession(outbox, self._refused, self._say, address=control, map_name=config.map)
        self._stopping = threading.Event()
        self._waker, self._woken = socket.socketpair()
        self._waker.setblocking(False)
        self._woken.setblocking(False)
        self._ahead = config.backlog if config.policy == "drop_oldest" else None
        self._blocked = False  # the data socket takes no more for now
        self._unread = 0  # times that the next keyframe could not be read
        self._read_due = 0.0

    @property
    def heard(self) -> float:
        """When the server last said something, `time.monotonic()`; 0 = never. From any thread."""
        return self._talk.heard

    def wake(self) -> None:
        """There is something new in the outbox. From any thread."""
        with suppress(OSError):  # it is being woken already, or has ended
            self._waker.send(b"\0")

    def stop(self) -> None:
        """Let `run` return. From any thread."""
        self._stopping.set()
        self.wake()

    def run(self) -> None:
        """Talk to the server until stopped."""
        context: zmq.Context[Any] = zmq.Context()
        self._link = Connection(context, sockets.dealer, self._control, self._keys)
        self._data = Connection(context, sockets.push, self._address, self._keys)
        try:
            while not self._stopping.is_set():
                self._step()
        finally:
            self._link.close()
            self._data.close()
            self._waker.close()
            self._woken.close()
            self._refused.close()
            context.term()

    def _step(self) -> None:
        for _ in range(64):
            try:
                self._talk.hear(self._link.socket.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                break
        now = time.monotonic()
        self._watch_connections(now)
        self._talk.tick(now)
        self._watch_for_stall(now)
        self._pump(now)
        self._wait(now)

    def _wait(self, now: float) -> None:
        sources: list[Any] = [self._link.socket, self._link.events, self._data.events, self._woken.fileno()]
        polled = [(source, zmq.POLLIN) for source in sources]
        if self._blocked:
            polled.append((self._data.socket, zmq.POLLOUT))
        others = (self._read_due if self._unread else 0.0, self._link.due, self._data.due)
        due = min([self._talk.due, *filter(None, others)])
        zmq.zmq_poll(polled, max(int((due - now) * 1000), 1))
        with suppress(BlockingIOError):
            self._woken.recv(4096)

    def _say(self, frame: bytes) -> None:
        with suppress(zmq.Again):
            self._link.socket.send(frame, zmq.NOBLOCK)

    def _watch_connections(self, now: float) -> None:
        for connection in (self._link, self._data):
            before = connection.problem
            news, ended = connection.look(now)
            if news is not None and (connection is self._link or self._link.made):  # else it is said twice
                self._talk.on_connection(news, before, refused=connection.refused)
            if ended and connection is self._link:
                self._talk.greet_again()  # the server does not know the new connection yet
            elif ended:
                with self._outbox.changed:
                    self._talk.rewind()  # what was under way is lost

    def _watch_for_stall(self, now: float) -> None:
        patience = self._config.stall_timeout
        if now - self._talk.heard > patience:
            with self._outbox.changed:
                self._outbox.connected = False
        if self._outbox.outstanding and not self._talk.held and now - self._talk.moved > patience:
            log.info("nothing moves: connecting to %s again", self._address)
            self._data.reopen()
            self._talk.greet_again()
            with self._outbox.changed:
                self._talk.rewind()

    # --- keyframes ---

    def _pump(self, now: float) -> None:
        self._blocked = False
        while (terms := self._talk.terms) is not None and not self._blocked and now >= self._read_due:
            with self._outbox.changed:
                previous = self._outbox.last_on_its_way
                entry = self._outbox.claim(terms.window_keyframes, terms.window_bytes, self._ahead)
            if entry is None:
                return
            if entry.nbytes > terms.max_frame_bytes:
                text = f"{entry.nbytes} bytes, the server takes {terms.max_frame_bytes}"
                self._refused.give_up(entry, "size", text)
            elif (frames := self._read(entry, now)) is not None:
                self._send(entry, previous, frames)

    def _read(self, entry: Waiting, now: float) -> list[memoryview] | None:
        """Its frames; None = not now, or never."""
        try:
            frames = self._outbox.spool.read(entry)
        except JournalError as error:
            self._on_unread(entry, error, now)
            return None
        self._unread = 0
        return frames

    def _on_unread(self, entry: Waiting, error: JournalError, now: float) -> None:
        cause = error.__cause__
        number = cause.errno if isinstance(cause, OSError) else None
        self._unread += 1
        if number in _SCARCE or (number == errno.EIO and self._unread < _READ_TRIES):
            log.log(logging.WARNING if self._unread == 1 else logging.DEBUG, "%s; it is tried again", error)
            self._read_due = now + _READ_AGAIN
            with self._outbox.changed:
                self._outbox.unclaim()
            return
        self._unread = 0
        self._refused.give_up(entry, "spool", str(error), readable=False)

    def _send(self, entry: Waiting, previous: int, frames: list[memoryview]) -> None:
        sent_ns = time.monotonic_ns()
        try:
            head = stamp(frames[0], previous=previous, sent_ns=sent_ns)
        except (DecodeError, IndexError) as error:
            self._refused.give_up(entry, "spool", str(error))
            return
        try:
            self._data.socket.send_multipart([head, *frames[1:]], zmq.NOBLOCK, copy=False)
        except zmq.Again:
            self._blocked = True
            with self._outbox.changed:
                self._outbox.unclaim()
            return
        with self._outbox.changed:
            if self._outbox.outstanding == 0:
                self._talk.moved = time.monotonic()
            self._outbox.sent(entry, sent_ns)
