# SPDX-License-Identifier: MIT
"""One connection to a server, over which several questions are open at once, without blocking."""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import zmq

from tsfusion.core.errors import DecodeError
from tsfusion.wire.asking.queries import open_connection
from tsfusion.wire.messages import messages, questions
from tsfusion.wire.messages.messages import Command, Reply
from tsfusion.wire.messages.questions import Question, Scans
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection import ServerLink
from tsfusion.wire.sockets.curve import ClientKeys

_HEALTH_INTERVAL = 1.0  # seconds
_SILENT_AFTER = 4.0  # seconds without an answer to the request for health
_GRACE_S = 1.0  # a new connection within this time is no problem to report
_QUESTION_S = 5.0  # longest time of a question
_MOST_AT_ONCE = 32  # replies
_LEAST_BYTES, _FIRST_BYTES = 1 << 13, 1 << 18  # of an answer
_QUICK_S, _SLOW_S = 0.25, 1.0  # seconds on the way of an answer, after which the next may be larger, smaller
QuestionKind = type[Question]
OnReply = Callable[[QuestionKind | None, Reply, list[memoryview]], None]


class Inquiry:
    """Asks a server for its health once a second, and for more: one question of each kind at a time.

    Attributes:
        map: map named in the health request; the reply names the map's new server, if it moved.
        version: the server's `PROTOCOL_VERSION`; None while not known.
        most_bytes: of an answer, so that the link brings it long before the server counts as silent.
    """

    def __init__(
        self, context: "zmq.Context[Any]", address: str, keys: ClientKeys | None, map_name: str
    ) -> None:
        self._connection: ServerLink = open_connection(context, sockets.connect_address(address), keys)
        self.address, self.map = address, map_name
        self.version: int | None = None
        self._greeted = 0  # number of the connection on which the server was greeted
        self._seen = time.monotonic()  # last time with a connection; at first, the time of the start
        self._health_due = 0.0
        self._health_asked: float | None = None
        self._number = 0  # number of the last question
        self._open: dict[int, tuple[QuestionKind, float]] = {}  # number → kind, when it was asked
        self.most_bytes = _FIRST_BYTES

    @property
    def polled(self) -> list[tuple[sockets.AnySocket, int]]:
        """Sockets and events to poll: call `step` when one of them is ready."""
        return [(self._connection.socket, zmq.POLLIN), (self._connection.events, zmq.POLLIN)]

    @property
    def due(self) -> float:
        """Time of the next `step` if no event comes before (`time.monotonic()`)."""
        waits = [self._health_due if self._health_asked is None else self._health_asked + _SILENT_AFTER]
        if self._connection.due:
            waits.append(self._connection.due)
        return min(waits) if self._connection.is_made else self._connection.due or time.monotonic() + 0.2

    @property
    def problem(self) -> str:
        """Reason for a person why the server does not answer; empty without one, or while it is too early."""
        now = time.monotonic()
        if self._connection.is_made:
            is_late = self._health_asked is not None and now - self._health_asked > _SILENT_AFTER / 2
            return f"the server at {self.address} does not answer" if is_late else ""
        if now - self._seen < _GRACE_S:
            return ""
        if self._connection.problem:
            return self._connection.problem
        return f"no server answers at {self.address}: is `tsfusion serve` running there?"

    def may_ask(self, kind: QuestionKind) -> bool:
        """True if the server can be asked, and no question of this kind is open."""
        is_open = any(one is kind for one, _ in self._open.values())
        return self.version == messages.PROTOCOL_VERSION and self._connection.is_made and not is_open

    def ask(self, question: Question, *, compress: bool) -> None:
        """Ask about the map. `step` delivers the reply; without one, the question ends after some seconds."""
        self._number += 1
        self._open[self._number] = type(question), time.monotonic()
        self._send(
            Command(
                name="ask",
                map=self.map,
                question=question,
                number=self._number,
                timeout_s=_QUESTION_S,
                compress=compress,
            )
        )

    def connect_to(self, address: str) -> None:
        """Switch to another server, and drop the open questions."""
        self.drop_questions()
        self.address, self.version, self._health_asked = address, None, None
        self._seen = time.monotonic()
        self._connection.connect_to(address)

    def drop_questions(self) -> None:
        """Ignore the answers to the open questions."""
        self._open.clear()

    def step(self, on_reply: OnReply) -> None:
        """Read the replies that came, and ask for the health if that is due."""
        now, connection = time.monotonic(), self._connection
        connection.check(now)
        self._read(on_reply)
        if not connection.is_made:
            self._health_asked = None
            self._lose()
            return
        self._seen = now
        if connection.made > self._greeted:
            self._greeted, self.version = connection.made, None
            self._lose()
            self._health_asked, self._health_due = None, now
            self._send(Command(name="ping"))
        self._lose(now - _QUESTION_S - 1.0)
        if self._health_asked is not None and now - self._health_asked > _SILENT_AFTER:
            self._health_asked, self._seen = None, now - _GRACE_S
            connection.reopen()  # an open connection may be dead without an event
        elif self._health_asked is None and now >= self._health_due:
            self._health_due, self._health_asked = now + _HEALTH_INTERVAL, now
            self._send(Command(name="health", map=self.map))

    def _lose(self, before: float = math.inf) -> None:
        """Drop questions asked before this time, and ask for less: the link may be slow."""
        left = {number: one for number, one in self._open.items() if one[1] >= before}
        if len(left) < len(self._open):
            self._open, self.most_bytes = left, max(self.most_bytes // 4, _LEAST_BYTES)

    def _note_way(self, seconds: float, frames: list[memoryview], *, may_have_waited: bool) -> None:
        """Note for how long an answer was on its way, or also waited at the server."""
        if seconds > _SLOW_S and not may_have_waited:
            self.most_bytes = max(self.most_bytes // 2, _LEAST_BYTES)
        elif seconds < _QUICK_S and 8 * sum(one.nbytes for one in frames) > self.most_bytes:
            self.most_bytes = min(2 * self.most_bytes, questions.ANSWER_BYTES)

    def _send(self, command: Command) -> None:
        with suppress(zmq.Again):  # the connection has ended: all is asked again on the next one
            self._connection.socket.send(messages.encode_sealed(command), zmq.NOBLOCK)

    def _read(self, on_reply: OnReply) -> None:
        for _ in range(_MOST_AT_ONCE):
            if not sockets.has_message(self._connection.socket):
                return
            head, *frames = self._connection.socket.recv_multipart(zmq.NOBLOCK, copy=False)
            try:
                reply = messages.decode_to_client(head.buffer)
            except DecodeError:
                continue  # damaged on its way: the question is asked again
            if isinstance(reply, Reply):
                self._take(reply, [frame.buffer for frame in frames], on_reply)
                if reply.elsewhere is not None:
                    return  # `on_reply` may have replaced the connection

    def _take(self, reply: Reply, frames: list[memoryview], on_reply: OnReply) -> None:
        if reply.name == "ping":
            self.version = reply.version
        elif reply.name == "health":
            self._health_asked = None
            if reply.health is not None:
                on_reply(None, reply, frames)
        elif reply.name == "ask" and reply.number in self._open:
            kind, asked = self._open.pop(reply.number)
            if reply.answer is not None:
                took = reply.answer.waited_s + reply.answer.took_s
                self._note_way(time.monotonic() - asked - took, frames, may_have_waited=kind is Scans)
            on_reply(kind, reply, frames)

    def close(self) -> None:
        self._connection.close()
