# SPDX-License-Identifier: MIT
"""Send the records of the spool from the client's thread, as far as the server's credit allows.

A PUSH socket silently loses messages under way when a server dies. So every record is kept until it is on the
server's disk. It is sent again after a restart of the server (epoch), silence, or a stall (no progress).
"""

import errno
import logging
import socket
import threading
import time
from contextlib import closing, suppress
from typing import Any

import zmq

from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import MISSING, DecodeError, JournalError, TransportError
from tsfusion.delivery.control_session import ControlSession, RefusedRecords
from tsfusion.delivery.outbox import LinkState, Outbox
from tsfusion.delivery.spool import Waiting
from tsfusion.wire.records.record_header import with_fields
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection import MOST_HOPS, ServerLink, Whereabouts
from tsfusion.wire.sockets.curve import ClientKeys

log = logging.getLogger(__name__)

_READ_INTERVAL = 0.5  # seconds until a record that could not be read is tried again
_MAX_READS = 6
_MAX_READS_AWAY = 120  # while the folder is missing: it may come back
_HOP_INTERVAL = 2.0  # seconds; a person must repair servers that send a client to each other
_HOME_AFTER = 10.0  # seconds without a Welcome, until the client asks the first server again
_LEAST_SILENCE = 2.0  # seconds; a server answers each ping, two a second, and never waits
_FAREWELL_MS = 100  # for the last message to leave
_SOCKET_INTERVAL = 0.5  # seconds until a socket that could not be opened is tried again
_SCARCE = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)  # other processes will release these
_MOST_PATIENCE = 16  # times the shortest wait: a link that needs so long for one keyframe still works


class Patience:
    """Time to wait for a sign of life before a client connects again.

    TCP itself waits a quarter of an hour on a dead path, for example after the scanner got another address,
    or a NAT forgot the connection. Each wait in vain doubles the next one: a slow link is not a dead one, and
    after each new connection the client sends its unacknowledged messages again.
    """

    def __init__(self, least: float) -> None:
        self._least = self._seconds = least
        self._ended = 0.0

    def has_ended(self, now: float, *, since: float, sign: float) -> bool:
        """True if the wait has ended; then a new one begins (all times: `time.monotonic()`).

        Args:
            since: time from which there was something to wait for.
            sign: time of the last sign of life.
        """
        if sign > self._ended:
            self._seconds = self._least
        if now - max(since, sign, self._ended) <= self._seconds:
            return False
        self._seconds = min(2 * self._seconds, _MOST_PATIENCE * self._least)
        self._ended = now
        return True


class Sender:
    """Loop that sends the spool's records to the server; `run` is the body of the client's thread.

    Raises:
        OSError: too few files can be opened.
    """

    def __init__(
        self, address: str, control: str, outbox: Outbox, config: ClientConfig, keys: ClientKeys | None = None
    ) -> None:
        self._where = Whereabouts((address, control), has_keys=keys is not None)
        self._keys = keys
        self._outbox = outbox
        self._config = config
        self._refused = RefusedRecords(outbox)
        self._control_session = ControlSession(
            outbox, self._refused, self._send_control, address=control, map_name=config.map
        )
        self._silence = Patience(max(config.stall_timeout, _LEAST_SILENCE))
        self._stall = Patience(config.stall_timeout)
        self._stopping = threading.Event()
        sockets.check_context()
        self._waker, self._woken = socket.socketpair()
        self._waker.setblocking(False)
        self._woken.setblocking(False)
        self._ahead = config.backlog if config.policy == "drop_oldest" else None
        self.finds_nobody = False  # nobody listens at the control address, as far as is known; for any thread
        self._no_socket = ""  # why none could be opened at the last failure
        self._blocked = False  # the data socket takes no more for now
        self._unread = 0  # times that the next record could not be read
        self._read_due = 0.0

    @property
    def last_heard(self) -> float:
        """Time of the server's last message, `time.monotonic()`; 0 = none yet. From any thread."""
        return self._control_session.last_heard

    def wake(self) -> None:
        """Make the sending thread look for new work in the outbox. From any thread."""
        with suppress(OSError):  # it is being woken already, or has ended
            self._waker.send(b"\0")

    def stop(self) -> None:
        """Make `run` return. From any thread."""
        self._stopping.set()
        self.wake()

    def run(self) -> None:
        """Exchange messages with the server until stopped."""
        try:
            while not self._stopping.is_set():
                try:
                    self._exchange()
                except (OSError, zmq.ZMQError) as error:
                    if error.errno not in _SCARCE:
                        raise
                    self._wait_for_files(str(error.strerror))
        finally:
            self._waker.close()
            self._woken.close()

    def _exchange(self) -> None:
        sockets.check_context()
        with (
            zmq.Context() as context,
            closing(ServerLink(context, sockets.dealer, self._where.place[1], self._keys)) as control,
            closing(ServerLink(context, sockets.push, self._where.place[0], self._keys)) as data,
        ):
            self._control, self._data = control, data
            self._outbox.change_link_state(self._outbox.link_state.reachable(self._no_socket))
            while not self._stopping.is_set():
                self._step()
            self._control_session.take_leave()
            control.close(_FAREWELL_MS)

    def _wait_for_files(self, reason: str) -> None:
        """Report that no socket can be opened (too many files), and pause; then send records again."""
        self._no_socket = f"cannot open a socket: {reason}; it is tried again, and keyframes wait for it"
        if self._outbox.change_link_state(LinkState("connecting", self._no_socket)):
            log.error("%s", self._no_socket)
        self._control_session.greet_again()
        self._control_session.rewind()
        self._stopping.wait(_SOCKET_INTERVAL)

    def _step(self) -> None:
        for _ in range(64):
            try:
                self._control_session.receive(self._control.socket.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                break
        now = time.monotonic()
        if (place := self._control_session.take_move()) is not None:
            self._follow_if_allowed(*place)
        self._watch_connections(now)
        self._control_session.tick(now)
        self._watch_for_stall(now)
        self._pump(now)
        self._wait(now)

    def _wait(self, now: float) -> None:
        control, data = self._control, self._data
        sources: list[Any] = [
            control.socket,
            control.monitor.socket,
            data.monitor.socket,
            self._woken.fileno(),
        ]
        polled = [(source, zmq.POLLIN) for source in sources]
        if self._blocked:
            polled.append((data.socket, zmq.POLLOUT))
        others = (self._read_due if now < self._read_due else 0.0, control.due, data.due)
        due = min([self._control_session.due, *filter(None, others)])
        zmq.zmq_poll(polled, max(int((due - now) * 1000), 1))
        with suppress(BlockingIOError):
            self._woken.recv(4096)

    def _send_control(self, frame: bytes) -> None:
        with suppress(zmq.Again):
            self._control.socket.send(frame, zmq.NOBLOCK)

    def _watch_connections(self, now: float) -> None:
        for connection in (self._control, self._data):
            before = connection.problem
            news, ended = connection.check(now)
            is_reported = (
                connection is self._control or self._control.monitor.connected
            )  # once, where both fail
            if news is not None and is_reported:
                self._control_session.on_connection(news, before, refused=connection.monitor.refused)
            if ended and connection is self._control:
                self._control_session.on_cut()
            elif ended:
                self._control_session.rewind()  # what was under way is lost
        if self.finds_nobody != self._control.finds_nobody:
            self.finds_nobody = self._control.finds_nobody
            self._outbox.wake_waiting()

    def _watch_for_stall(self, now: float) -> None:
        session = self._control_session
        if session.welcome is not None:
            self._where.let_in()
        elif self._where.is_locked_out(_HOME_AFTER):
            self._follow(self._where.go_home())
        if now - session.last_heard > self._config.stall_timeout:
            session.on_silence(self._control.problem)
        if self._control.monitor.connected and self._silence.has_ended(
            now, since=self._control.monitor.connected_since, sign=session.last_heard
        ):
            log.info("the server sends nothing: connecting to %s again", self._where.place[1])
            self._connect_again(self._control, self._data)
        elif (
            self._outbox.outstanding
            and not session.held
            and self._stall.has_ended(now, since=session.last_active, sign=session.last_progress)
        ):
            log.info("the server acknowledges no record: connecting to %s again", self._where.place[0])
            self._connect_again(self._data)

    def _follow_if_allowed(self, data: str, control: str) -> None:
        """Switch to the server that has the map now; without keys, only to a server of this machine."""
        try:
            self._follow(self._where.follow(data, control))
        except TransportError as error:
            self._control_session.refuse_move(str(error))

    def _follow(self, place: tuple[str, str]) -> None:
        self._data.connect_to(place[0])
        self._control.connect_to(place[1])
        after = _HOP_INTERVAL if self._where.hops > MOST_HOPS else 0.0
        self._control_session.follow(place[1], after=after)

    def _connect_again(self, *connections: ServerLink) -> None:
        """Reopen connections, and greet again; the Welcome makes unacknowledged records be sent again."""
        for connection in connections:
            connection.reopen()
        self._control_session.greet_again()
        self._control_session.rewind()

    # --- records ---

    def _pump(self, now: float) -> None:
        self._blocked = False
        while not self._blocked and now >= self._read_due:
            if (terms := self._control_session.terms) is None:
                return
            claimed = self._outbox.claim(terms.window_keyframes, terms.window_bytes, self._ahead)
            if claimed is None:
                return
            entry, previous = claimed
            if entry.nbytes > terms.max_frame_bytes:
                text = f"{entry.nbytes} bytes, the server takes {terms.max_frame_bytes}"
                self._refused.give_up(entry, "size", text)
            elif (frames := self._read(entry, now)) is not None:
                self._send(entry, previous, frames)

    def _read(self, entry: Waiting, now: float) -> list[memoryview] | None:
        """Return the frames of a record from the spool; None if it cannot be read now, or is given up."""
        try:
            frames = self._outbox.spool.read(entry)
        except JournalError as error:
            self._unread += 1
            if error.errno in _SCARCE or (error.errno is not None and self._unread < self._most_reads()):
                level = logging.WARNING if self._unread == 1 else logging.DEBUG
                log.log(level, "%s; it is tried again", error)
                self._read_due = now + _READ_INTERVAL
                self._outbox.unclaim()
                return None
            self._refused.give_up(entry, "spool", str(error), readable=False)
            if error.errno not in MISSING:  # a missing file has many records: do not wait for each of them
                self._unread = 0
            return None
        self._unread = 0
        return frames

    def _most_reads(self) -> int:
        return _MAX_READS_AWAY if self._outbox.spool.is_away else _MAX_READS

    def _send(self, entry: Waiting, previous: int, frames: list[memoryview]) -> None:
        sent_ns = time.monotonic_ns()
        try:
            head = with_fields(
                frames[0],
                previous=previous,
                sent_ns=sent_ns,
                map=self._outbox.spool.map_name,
                world=self._outbox.spool.world,
                same_frame=self._outbox.spool.same_frame,
            )
        except (DecodeError, IndexError) as error:
            self._refused.give_up(entry, "spool", str(error))
            return
        try:
            self._data.socket.send_multipart([head, *frames[1:]], zmq.NOBLOCK, copy=False)
        except zmq.Again:
            self._blocked = True
            self._outbox.unclaim()
            return
        if self._outbox.sent(entry, sent_ns):
            self._control_session.last_active = time.monotonic()
