# SPDX-License-Identifier: MIT
"""Client that follows a running server's map, and gives a live page its events, without Taichi."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from tsfusion.core.config import DEFAULT_MAP
from tsfusion.core.errors import DecodeError, InvalidConfig, TransportError
from tsfusion.geometry.map_questions import MOST_POINTS
from tsfusion.wire.asking.followed_map import FollowedMap, FollowedPaths, HealthSeen, LinkSeen, MapEvent
from tsfusion.wire.asking.map_client import MapClient
from tsfusion.wire.asking.queries import open_connection, refused_sockets
from tsfusion.wire.messages import messages, questions
from tsfusion.wire.messages.health import Health
from tsfusion.wire.messages.messages import PROTOCOL_VERSION, Command, Elsewhere, Reply, other_version
from tsfusion.wire.messages.questions import Answer, Cells, Keyframes, Question, Scans
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection import ServerLink, Whereabouts
from tsfusion.wire.sockets.curve import ClientKeys

_RETRY_S = 0.5  # after a question that was refused or not answered
_WEIGHTS_S = 2.0  # longest time of a question for weights
_HEALTH_INTERVAL = 1.0  # seconds
_SILENT_AFTER = 4.0  # seconds without an answer to the request for health
_GRACE_S = 1.0  # a new connection within this time is no problem to report
_QUESTION_S = 5.0  # longest time of a question
_MOST_AT_ONCE = 32  # replies
_LEAST_BYTES, _FIRST_BYTES = 1 << 13, 1 << 18  # of an answer
_QUICK_S, _SLOW_S = 0.25, 1.0  # seconds on the way of an answer, after which the next may be larger, smaller
QuestionKind = type[Question]
OnReply = Callable[[QuestionKind | None, Reply, list[memoryview]], None]


class MapWatcher:
    """Events of a map of a running server (a `viewer.map_feed.MapFeed`).

    The watcher never ends by itself. While the server is away, `LinkSeen` says so; afterwards all cells come
    again. A map that moves to another server is followed to it (without keys, only on this machine). Use the
    watcher from one thread, except for `weights`.

    Args:
        address: address of the server: tcp://HOST:PORT.
        map_name: name of the map on the server; the map may be opened later.
        control: control address of the server; None takes the port after that of `address`.
        keys: result of `curve.client_keys`, for a server with keys.

    Raises:
        InvalidConfig: for a malformed address.
        TransportError: when no socket can be opened.
    """

    time_line = None

    def __init__(
        self,
        address: str,
        map_name: str = DEFAULT_MAP,
        *,
        control: str | None = None,
        keys: ClientKeys | None = None,
    ) -> None:
        address, self._keys = sockets.connect_address(address), keys
        place = address, sockets.connect_address(sockets.control_address(address, control))
        self._where = Whereabouts(place, has_keys=keys is not None)
        self._compress = not sockets.is_loopback(sockets.parse_address(address)[0])
        self._weights_lock = threading.Lock()
        self._weights: MapClient | None = None
        self._map = map_name
        self._context = sockets.open_context()
        try:
            self._inquiry = Inquiry(self._context, place[1], keys, map_name)
        except TransportError:
            self._context.term()
            raise
        self._health: Health | None = None
        self._said: str | None = None  # problem of the link, as the last `LinkSeen` told it
        self._events: list[MapEvent] = []
        self._looked = time.monotonic()  # when `events` last returned
        self._follow(map_name)

    def _follow(self, map_name: str) -> None:
        self._map = self._inquiry.map = map_name
        self._followed, self._paths = FollowedMap(map_name), FollowedPaths()
        # Why a kind of question was refused, and when to ask again (`time.monotonic()`)
        self._refusals: dict[QuestionKind, tuple[str, float]] = {}
        self._said = None

    @property
    def address(self) -> str:
        """Data address of the server that has the map now."""
        return self._where.place[0]

    @property
    def title(self) -> str:
        """The map and its server, for a person."""
        return f"{self._map} at {self.address}"

    def close(self) -> None:
        with self._weights_lock:
            if self._weights is not None:
                self._weights.close()
                self._weights = None
        self._inquiry.close()
        self._context.term()

    def maps(self) -> list[str]:
        """Return the names of the server's maps, from its last health."""
        return sorted({self._map, *(self._health.maps if self._health else ())})

    def choose(self, map_name: str) -> None:
        """Watch another map. `Cleared` comes as soon as that map is open."""
        self._events.clear()
        self._inquiry.drop_questions()
        self._follow(map_name)
        with self._weights_lock:
            if self._weights is not None:
                self._weights.map = map_name

    def seek(self, keyframes: int) -> None:
        """Raise InvalidConfig: a running server shows only the newest state of its maps.

        Raises:
            InvalidConfig: always.
        """
        raise InvalidConfig("a running server shows its maps as they are now: there is no time line")

    # --- events ---

    def events(self, timeout: float) -> list[MapEvent]:
        """Return the events since the last call. Wait at most `timeout` seconds for the first one.

        Raises:
            TransportError: the system gives no socket for a new connection.
        """
        began = time.monotonic()
        self._inquiry.excuse(began - self._looked)
        deadline = began + timeout
        while True:
            with refused_sockets():
                self._step()
            if self._events or time.monotonic() >= deadline:
                found, self._events = self._events, []
                self._looked = time.monotonic()
                return found
            until = max(min(deadline, self._due()) - time.monotonic(), 0.0)
            zmq.zmq_poll(self._inquiry.polled, int(1000 * min(until, 1.0)) + 1)

    def _due(self) -> float:
        now = time.monotonic()
        again = [due for _, due in self._refusals.values() if due > now]
        return max(min(self._inquiry.due, *again, now + 1.0), now + 0.005)

    def _step(self) -> None:
        self._inquiry.step(self._on_reply)
        if self._health is not None and self._map in self._health.maps:
            self._ask(time.monotonic())
        problem = self._problem()
        if problem is not None and problem != self._said:
            self._said = problem
            self._events.append(LinkSeen(problem))

    def _ask(self, now: float) -> None:
        for question in self._questions(now):
            _, due = self._refusals.get(type(question), ("", 0.0))
            if now >= due and self._inquiry.may_ask(type(question)):
                self._inquiry.ask(question, compress=self._compress)

    def _questions(self, now: float) -> Iterator[Question]:
        yield self._followed.question(self._inquiry.most_bytes)
        if self._followed.epoch:
            yield self._paths.scans_question(self._inquiry.most_bytes)
            if (question := self._paths.question(now, self._inquiry.most_bytes)) is not None:
                yield question

    def _on_reply(self, kind: QuestionKind | None, reply: Reply, frames: list[memoryview]) -> None:
        if reply.elsewhere is not None:
            self._go_to(reply.elsewhere)
        elif reply.health is not None:
            self._on_health(reply.health)
        elif kind is not None and reply.answer is None:
            why = "" if reply.retry or reply.late else reply.error or ""
            self._refusals[kind] = why, time.monotonic() + _RETRY_S
        elif kind is not None and reply.answer is not None:
            self._refusals.pop(kind, None)
            try:
                self._events += self._taken(kind, reply.answer, frames)
            except DecodeError as error:
                why = f"an answer of the server makes no sense, is it of an earlier version? {error}"
                self._refusals[kind] = why, time.monotonic() + _RETRY_S

    def _go_to(self, elsewhere: Elsewhere) -> None:
        """Watch the map at its new server."""
        try:
            _, control = self._where.follow(elsewhere.address, elsewhere.control)
        except TransportError as error:
            self._refusals[Cells] = str(error), time.monotonic() + _RETRY_S
            return
        self._inquiry.connect_to(control)
        self._health = None
        with self._weights_lock:
            if self._weights is not None:
                self._weights.close()
                self._weights = None
        self._events += self._followed.forget()
        self._follow(self._map)

    def _taken(self, kind: QuestionKind, answer: Answer, frames: list[memoryview]) -> list[MapEvent]:
        arrays = questions.unpack(answer, frames)
        if kind is Scans:
            return self._paths.on_scans(questions.scans_of(arrays))
        take = self._paths.on_keyframes if kind is Keyframes else self._followed.on_cells
        return take(answer.state.epoch, arrays)

    def _on_health(self, health: Health) -> None:
        self._health = health
        self._events.append(HealthSeen(health))
        own = health.maps.get(self._map)
        if own is not None:
            self._paths.on_health(own)
        elif cleared := self._followed.forget():
            self._paths = FollowedPaths()
            self._events += cleared

    # --- the link ---

    def _problem(self) -> str | None:
        """Return the reason why nothing can be shown. It is empty without a problem, None while not known."""
        if problem := self._inquiry.problem:
            return problem
        version = self._inquiry.version
        if version is not None and (other := other_version(server=version, client=PROTOCOL_VERSION)):
            return f"the map at {self.address} cannot be watched: {other}"
        if version is None or self._health is None:
            return None
        own = self._health.maps.get(self._map)
        if own is None:
            others = ", ".join(sorted(self._health.maps)) or "none"
            return f"no map {self._map} is open at {self.address}, or its key may not use it (open: {others})"
        if own.state == "failed":
            return own.problem or f"the map {self._map} cannot be opened"
        if refusal := next((why for why, _ in self._refusals.values() if why), ""):
            return refusal
        if not self._followed.epoch:
            return f"the map {self._map} is being opened" if own.state in ("opening", "restarting") else None
        return ""

    # --- questions of others ---

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return the (n,) weights of the map at (n, 3) points, or None without an answer. For any thread."""
        found = [np.zeros(0, np.float32)]
        with self._weights_lock:
            try:
                if self._weights is None:
                    address, control = self._where.place
                    self._weights = MapClient(
                        address, self._map, control=control, keys=self._keys, timeout=_WEIGHTS_S
                    )
                for i in range(0, len(points), MOST_POINTS):
                    found.append(self._weights.sample(points[i : i + MOST_POINTS]).result.weight)
            except TransportError:
                return None
        return np.concatenate(found)


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
        # number → kind, when it was asked, seconds since then in which nobody looked for the answer
        self._open: dict[int, tuple[QuestionKind, float, float]] = {}
        self.most_bytes = _FIRST_BYTES

    @property
    def polled(self) -> list[tuple[sockets.AnySocket, int]]:
        """Sockets and events to poll: call `step` when one of them is ready."""
        return [(self._connection.socket, zmq.POLLIN), (self._connection.monitor.socket, zmq.POLLIN)]

    @property
    def due(self) -> float:
        """Time of the next `step` if no event comes before (`time.monotonic()`)."""
        waits = [self._health_due if self._health_asked is None else self._health_asked + _SILENT_AFTER]
        if self._connection.due:
            waits.append(self._connection.due)
        return (
            min(waits)
            if self._connection.monitor.connected
            else self._connection.due or time.monotonic() + 0.2
        )

    @property
    def problem(self) -> str:
        """Reason for a person why the server does not answer; empty without one, or while it is too early."""
        now = time.monotonic()
        if self._connection.monitor.connected:
            is_late = self._health_asked is not None and now - self._health_asked > _SILENT_AFTER / 2
            return f"the server at {self.address} does not answer" if is_late else ""
        if now - self._seen < _GRACE_S:
            return ""
        if self._connection.problem:
            return self._connection.problem
        return f"no server answers at {self.address}: is `tsfusion serve` running there?"

    def may_ask(self, kind: QuestionKind) -> bool:
        """True if the server can be asked, and no question of this kind is open."""
        is_open = any(one[0] is kind for one in self._open.values())
        return (
            self.version == messages.PROTOCOL_VERSION and self._connection.monitor.connected and not is_open
        )

    def ask(self, question: Question, *, compress: bool) -> None:
        """Ask about the map. `step` delivers the reply; without one, the question ends after some seconds."""
        self._number += 1
        self._open[self._number] = type(question), time.monotonic(), 0.0
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

    def excuse(self, seconds: float) -> None:
        """Note that nobody looked for answers for so long: the link is no slower for that."""
        self._open = {number: (*one[:2], one[2] + seconds) for number, one in self._open.items()}

    def drop_questions(self) -> None:
        """Ignore the answers to the open questions."""
        self._open.clear()

    def step(self, on_reply: OnReply) -> None:
        """Read the replies that came, and ask for the health if that is due."""
        now, connection = time.monotonic(), self._connection
        connection.check(now)
        self._read(on_reply)
        if not connection.monitor.connected:
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

    def _note_way(
        self, seconds: float, unseen: float, frames: list[memoryview], *, may_have_waited: bool
    ) -> None:
        """Note for how long an answer was on its way, and how much of it may have been `unseen` here."""
        if seconds - unseen > _SLOW_S and not may_have_waited:
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
            kind, asked, unseen = self._open.pop(reply.number)
            if reply.answer is not None:
                took = reply.answer.waited_s + reply.answer.took_s
                way = time.monotonic() - asked - took
                self._note_way(way, unseen, frames, may_have_waited=kind is Scans)
            on_reply(kind, reply, frames)

    def close(self) -> None:
        self._connection.close()
