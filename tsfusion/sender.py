# SPDX-License-Identifier: MIT
"""The client's thread: sends what the spool holds, as far as the server's credit goes.

PUSH loses what is under way when a server dies, silently; so everything is kept until the server says it is
on its disk, and sent again from there when the server is a new one (epoch) or nothing moves (stall).
"""

import logging
import socket
import threading
import time
from contextlib import suppress
from typing import Any

import zmq

from tsfusion import codec
from tsfusion.errors import DecodeError, JournalError
from tsfusion.outbox import Outbox
from tsfusion.spool import Waiting
from tsfusion.transport import ClockOffset, messages, sockets
from tsfusion.transport.clock import SAMPLES

log = logging.getLogger(__name__)

_HELLO_INTERVAL = (0.02, 0.5)  # seconds: first and longest, doubling until welcomed
_PING_INTERVAL = 0.5
_FIRST_PINGS_INTERVAL = 0.02  # until the clock estimate stands on all its samples
_REWIND_INTERVAL = 0.2  # one gap is reported by every keyframe behind it


class Sender:
    """Owns the sockets; `run` is the thread's body."""

    def __init__(self, address: str, control: str, outbox: Outbox, stall_timeout: float) -> None:
        self._address = address
        self._control = control
        self._outbox = outbox
        self._stall_timeout = stall_timeout
        self._stopping = threading.Event()
        self._waker, self._woken = socket.socketpair()
        self._waker.setblocking(False)
        self._woken.setblocking(False)
        self._clock = ClockOffset()
        self._welcome: messages.Welcome | None = None
        self._hello_due = self._ping_due = 0.0
        self._hello_interval = _HELLO_INTERVAL[0]
        self._heard = self._moved = self._rewound = 0.0
        self._asked_again = False
        self._blocked = False  # the data socket takes no more for now

    @property
    def heard(self) -> float:
        """When the server last said something, `time.monotonic()`; 0 = never. From any thread."""
        return self._heard

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
        self._link = sockets.dealer(context)
        self._push = sockets.push(context)
        try:
            self._link.connect(self._control)
            self._push.connect(self._address)
            while not self._stopping.is_set():
                self._step(context)
        finally:
            self._link.close()
            self._push.close()
            self._waker.close()
            self._woken.close()
            context.term()

    def _step(self, context: "zmq.Context[Any]") -> None:
        for _ in range(64):
            try:
                self._hear(self._link.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                break
        now = time.monotonic()
        self._greet(now)
        self._ping(now)
        self._watch_for_stall(now, context)
        if self._asked_again and now - self._rewound > _REWIND_INTERVAL:
            with self._outbox.changed:
                self._rewind()
        self._pump()
        self._wait(now)

    def _wait(self, now: float) -> None:
        polled: list[tuple[Any, int]] = [(self._link, zmq.POLLIN), (self._woken.fileno(), zmq.POLLIN)]
        if self._blocked:
            polled.append((self._push, zmq.POLLOUT))
        due = min(self._hello_due, self._ping_due) if self._welcome is None else self._ping_due
        if self._asked_again:
            due = min(due, self._rewound + _REWIND_INTERVAL)
        zmq.zmq_poll(polled, max(int((due - now) * 1000), 1))
        with suppress(BlockingIOError):
            self._woken.recv(4096)

    # --- control ---

    def _greet_again(self) -> None:
        self._welcome = None
        self._hello_due = 0.0
        self._hello_interval = _HELLO_INTERVAL[0]

    def _greet(self, now: float) -> None:
        if self._welcome is None and now >= self._hello_due:
            self._hello_due = now + self._hello_interval
            self._hello_interval = min(2 * self._hello_interval, _HELLO_INTERVAL[1])
            self._say(messages.Hello(self._outbox.spool.session, codec.VERSION))

    def _ping(self, now: float) -> None:
        if now >= self._ping_due:
            settled = self._welcome is None or self._clock.count >= SAMPLES
            self._ping_due = now + (_PING_INTERVAL if settled else _FIRST_PINGS_INTERVAL)
            session = self._outbox.spool.session
            self._say(messages.Ping(session, time.monotonic_ns(), self._clock.offset_ns))

    def _say(self, message: messages.ToServer) -> None:
        with suppress(zmq.Again):  # nobody is there; it is said again when due
            self._link.send(messages.encode(message), zmq.NOBLOCK)

    def _hear(self, frames: list[bytes]) -> None:
        returned_ns = time.monotonic_ns()
        try:
            message = messages.decode_to_client(b"".join(frames))
        except DecodeError as error:
            self._on_nonsense(error)
            return
        self._heard = time.monotonic()
        with self._outbox.changed:
            if isinstance(message, messages.Welcome):
                self._on_welcome(message)
            elif isinstance(message, messages.Ack):
                self._on_ack(message)
            elif isinstance(message, messages.Nack):
                log.error("keyframe %d: %s (%s)", message.seq, message.message, message.reason)
                self._outbox.nack(message)
                self._moved = self._heard
            elif isinstance(message, messages.Pong):
                self._on_pong(message, returned_ns)

    def _on_nonsense(self, error: DecodeError) -> None:
        if self._welcome is None and not self._outbox.problem:
            with self._outbox.changed:
                self._outbox.problem = f"what answers at {self._control} is no tsfusion server: {error}"
        log.debug("the server sent %s", error)

    def _on_welcome(self, welcome: messages.Welcome) -> None:
        if welcome.version != codec.VERSION:
            self._outbox.problem = (
                f"the server speaks version {welcome.version} of the wire format, this client {codec.VERSION}"
            )
            log.error("%s", self._outbox.problem)
            return
        self._outbox.problem = ""
        self._welcome = welcome
        self._ping_due = 0.0
        self._outbox.progress(welcome.durable, welcome.fused)
        self._outbox.meshed(welcome.fused)  # a new server stamps only what it fuses from here on
        self._rewind()

    def _on_pong(self, pong: messages.Pong, returned_ns: int) -> None:
        if self._welcome is None or pong.epoch != self._welcome.epoch:
            if self._welcome is not None:
                log.info("the server at %s is a new one", self._address)
                self._clock.clear()
                self._greet_again()
            return
        self._outbox.connected = True
        if not self._clock.count:
            self._ping_due = 0.0  # tells the server the offset before the first keyframe comes
        self._clock.add(pong.ping_sent_ns, pong.received_ns, pong.sent_ns, returned_ns)
        self._on_progress(pong.durable, pong.fused)

    def _on_ack(self, ack: messages.Ack) -> None:
        if ack.session != self._outbox.spool.session or self._welcome is None:
            return
        self._on_progress(ack.durable, ack.fused)
        for stamps in ack.stamps:
            self._outbox.stamp(stamps, self._clock.offset_ns or 0, self._clock.bound_ns)
        self._asked_again |= ack.resend

    def _on_progress(self, durable: int, fused: int) -> None:
        if self._outbox.progress(durable, fused):
            self._moved = self._heard

    # --- keyframes ---

    def _rewind(self) -> None:
        """Send everything that is not acknowledged once more."""
        self._outbox.outstanding = 0
        self._asked_again = False
        self._rewound = self._moved = time.monotonic()

    def _watch_for_stall(self, now: float, context: "zmq.Context[Any]") -> None:
        if now - self._heard > self._stall_timeout:
            with self._outbox.changed:
                self._outbox.connected = False
        if self._outbox.outstanding and now - self._moved > self._stall_timeout:
            log.info("nothing moves: connecting to %s again", self._address)
            self._push.close()
            self._push = sockets.push(context)
            self._push.connect(self._address)
            self._greet_again()
            with self._outbox.changed:
                self._rewind()

    def _pump(self) -> None:
        self._blocked = False
        if not self._clock.count:
            return  # the answers could not be put on our clock
        while (welcome := self._welcome) is not None and not self._blocked:
            with self._outbox.changed:
                entry = self._outbox.next_entry(welcome.window_keyframes, welcome.window_bytes)
                previous = self._outbox.last_on_its_way
            if entry is None:
                return
            self._send(entry, previous, welcome.max_frame_bytes)

    def _send(self, entry: Waiting, previous: int, max_bytes: int) -> None:
        if entry.nbytes > max_bytes:
            self._give_up(entry, "size", f"{entry.nbytes} bytes, the server takes {max_bytes}")
            return
        try:
            frames = self._outbox.spool.read(entry)
            sent_ns = time.monotonic_ns()
            head = codec.stamp(frames[0], previous=previous, sent_ns=sent_ns)
        except (JournalError, DecodeError) as error:
            self._give_up(entry, "spool", str(error))
            return
        try:
            self._push.send_multipart([head, *frames[1:]], zmq.NOBLOCK, copy=False)
        except zmq.Again:
            self._blocked = True
            return
        with self._outbox.changed:
            if self._outbox.outstanding == 0:
                self._moved = time.monotonic()
            self._outbox.sent(entry, sent_ns)

    def _give_up(self, entry: Waiting, reason: str, message: str) -> None:
        log.error("keyframe %d is lost: %s", entry.seq, message)
        with self._outbox.changed:
            self._outbox.refuse(entry, reason, message)
