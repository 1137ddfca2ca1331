# SPDX-License-Identifier: MIT
"""Client that follows a running server's map, and gives a live page its events, without Taichi."""

import threading
import time
from typing import Any

import numpy as np
import zmq
from msgspec import MsgspecError
from numpy.typing import NDArray

from tsfusion.core.config import DEFAULT_MAP
from tsfusion.core.errors import DecodeError, InvalidConfig, TransportError
from tsfusion.geometry.map_questions import MOST_POINTS
from tsfusion.wire.asking.followed_map import FollowedMap
from tsfusion.wire.asking.followed_paths import FollowedPaths
from tsfusion.wire.asking.inquiry import Inquiry
from tsfusion.wire.asking.map_client import MapClient
from tsfusion.wire.asking.map_events import HealthSeen, LinkSeen, MapEvent
from tsfusion.wire.messages import mesh_updates, questions
from tsfusion.wire.messages.health import Health
from tsfusion.wire.messages.messages import PROTOCOL_VERSION, Elsewhere, Reply, other_version
from tsfusion.wire.messages.questions import Answer, Cells, Keyframes
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection import ServerLink, Whereabouts
from tsfusion.wire.sockets.curve import ClientKeys

_MOST_AT_ONCE = 16  # updates of one call
_TOGETHER_S = 0.2  # between two readings of updates: each time the thread wakes up costs
_FEW = 6  # after a reading of more updates than this, the next comes at once: the socket's queue is short
_PAUSE_S, _BUSY_PAUSE_S = 0.02, 0.05  # between two questions; the second while the map fuses keyframes
_RETRY_S = 0.5  # after a question that was refused or not answered
_WEIGHTS_S = 2.0  # longest time of a question for weights


class MapWatcher:
    """Events of a map of a running server (a `viewer.map_feed.MapFeed`).

    The watcher never ends by itself. While the server is away, `LinkSeen` says so; afterwards all cells come
    again. A map that moves to another server is followed to it (without keys, only on this machine). Use the
    watcher from one thread, except for `weights`.

    Args:
        address: address of the server: tcp://HOST:PORT.
        map_name: name of the map on the server; the map may be opened later.
        control, publish: other addresses of the server; None takes the ports after that of `address`.
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
        publish: str | None = None,
        keys: ClientKeys | None = None,
    ) -> None:
        address, self._keys = sockets.connect_address(address), keys
        place = address, sockets.connect_address(sockets.control_address(address, control))
        self._where = Whereabouts(place, has_keys=keys is not None)
        self._publish = sockets.connect_address(sockets.publish_address(address, control, publish))
        self._compress = not sockets.is_loopback(sockets.parse_address(address)[0])
        self._weights_lock = threading.Lock()
        self._weights: MapClient | None = None
        self._map = map_name
        self._context = sockets.open_context()
        self._inquiry = Inquiry(self._context, place[1], keys, map_name)
        try:
            self._updates = ServerLink(self._context, self._subscriber, self._publish, keys)
        except zmq.ZMQError as error:
            self._inquiry.close()
            self._context.term()
            raise TransportError(f"cannot open a socket: {error.strerror}") from error
        self._health: Health | None = None
        self._asked: Cells | Keyframes | None = None
        self._next_question = self._next_read = 0.0  # time.monotonic()
        self._refusal = ""  # why a question was refused for good
        self._said: str | None = None  # problem of the link, as the last `LinkSeen` told it
        self._events: list[MapEvent] = []
        self._follow(map_name)

    def _follow(self, map_name: str) -> None:
        self._map = self._inquiry.map = map_name
        self._followed, self._paths = FollowedMap(map_name), FollowedPaths()
        self._asked, self._refusal, self._said = None, "", None

    def _subscriber(self, context: "zmq.Context[Any]", keys: ClientKeys | None) -> sockets.AnySocket:
        made = sockets.subscriber(context, keys, map_name=self._map)
        made.setsockopt(zmq.SUBSCRIBE, sockets.scan_topic(self._map))
        return made

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
        self._updates.close()
        self._context.term()

    def maps(self) -> list[str]:
        """Return the names of the server's maps, from its last health."""
        return sorted({self._map, *(self._health.maps if self._health else ())})

    def choose(self, map_name: str) -> None:
        """Watch another map. `Cleared` comes as soon as that map is open."""
        for topic in sockets.topics_of(self._map):
            self._updates.socket.setsockopt(zmq.UNSUBSCRIBE, topic)
        self._events.clear()
        self._inquiry.drop_question()
        self._follow(map_name)
        for topic in sockets.topics_of(map_name):
            self._updates.socket.setsockopt(zmq.SUBSCRIBE, topic)
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
        """Return the events since the last call. Wait at most `timeout` seconds for the first one."""
        deadline = time.monotonic() + timeout
        while True:
            self._step()
            if self._events or time.monotonic() >= deadline:
                found, self._events = self._events, []
                return found
            until = max(min(deadline, self._due()) - time.monotonic(), 0.0)
            polled = [*self._inquiry.polled, (self._updates.events, zmq.POLLIN)]
            if time.monotonic() >= self._next_read:
                polled.append((self._updates.socket, zmq.POLLIN))
            zmq.zmq_poll(polled, int(1000 * min(until, 1.0)) + 1)

    def _due(self) -> float:
        waits = [self._inquiry.due]
        if self._next_read > time.monotonic():
            waits.append(self._next_read)
        if self._updates.due:
            waits.append(self._updates.due)
        if self._inquiry.may_ask:
            waits.append(self._next_question)
        return max(min(waits), time.monotonic() + 0.005)

    def _step(self) -> None:
        self._updates.check(time.monotonic())
        self._inquiry.step(self._on_reply)
        self._read_updates()
        self._ask()
        self._say_link()

    def _ask(self) -> None:
        now = time.monotonic()
        if now < self._next_question or not self._inquiry.may_ask or not self._is_open:
            return
        question: Cells | Keyframes | None = None
        if self._followed.epoch:  # ask for the poses of keyframes right after `Cleared`
            question = self._paths.question(now)
        question = question or self._followed.question(now)
        is_busy = self._health is not None and self._health.maps[self._map].state == "busy"
        self._next_question = now + (_BUSY_PAUSE_S if is_busy else _PAUSE_S)
        if question is None:
            self._next_question = now + 0.1
            return
        self._asked = question
        self._inquiry.ask(self._map, question, compress=self._compress)

    @property
    def _is_open(self) -> bool:
        return self._health is not None and self._map in self._health.maps

    def _on_reply(self, reply: Reply, frames: list[memoryview]) -> None:
        if reply.elsewhere is not None:
            self._go_to(reply.elsewhere)
        elif reply.health is not None:
            self._on_health(reply.health)
        elif reply.answer is None:
            self._refusal = "" if reply.retry or reply.late else reply.error or ""
            self._next_question = time.monotonic() + _RETRY_S
        else:
            self._refusal = ""
            try:
                self._events += self._taken(reply.answer, frames)
            except DecodeError as error:
                self._refusal = f"an answer of the server makes no sense: {error}"
                self._next_question = time.monotonic() + _RETRY_S

    def _go_to(self, elsewhere: Elsewhere) -> None:
        """Watch the map at its new server."""
        try:
            data, control = self._where.follow(elsewhere.address, elsewhere.control)
        except TransportError as error:
            self._refusal = str(error)
            return
        self._publish = sockets.connect_address(sockets.publish_address(data, control, None))
        self._inquiry.connect_to(control)
        self._updates.connect_to(self._publish)
        self._health = None
        with self._weights_lock:
            if self._weights is not None:
                self._weights.close()
                self._weights = None
        self._events += self._followed.forget()
        self._follow(self._map)

    def _taken(self, answer: Answer, frames: list[memoryview]) -> list[MapEvent]:
        arrays = questions.unpack(answer, frames)
        if isinstance(self._asked, Keyframes):
            return self._paths.on_keyframes(answer.state.epoch, arrays)
        return self._followed.on_cells(answer.state.epoch, arrays)

    def _on_health(self, health: Health) -> None:
        self._health = health
        self._events.append(HealthSeen(health))
        own = health.maps.get(self._map)
        if own is not None:
            self._followed.on_health(own, health.epoch, time.monotonic())
            self._paths.on_health(own)
        elif cleared := self._followed.forget():
            self._paths = FollowedPaths()
            self._events += cleared

    def _read_updates(self) -> None:
        if time.monotonic() < self._next_read:
            return
        mesh_topic, scan_topic = sockets.topics_of(self._map)
        for count in range(_MOST_AT_ONCE):
            if not sockets.has_message(self._updates.socket):
                self._next_read = time.monotonic() + (_TOGETHER_S if 0 < count <= _FEW else 0.0)
                return
            topic, *frames = self._updates.socket.recv_multipart(zmq.NOBLOCK, copy=False)
            try:
                if topic.bytes == mesh_topic:
                    self._on_meshed(frames)
                elif topic.bytes == scan_topic and self._followed.epoch:
                    self._on_scanned(frames)
            except (DecodeError, MsgspecError, ValueError, IndexError) as error:
                self._refusal = f"an update of the server makes no sense: {error}"

    def _on_meshed(self, frames: list[zmq.Frame]) -> None:
        meshed = mesh_updates.meshed_of(frames[0].buffer)
        self._events += self._followed.on_update(
            meshed, [frame.buffer for frame in frames[1:]], time.monotonic()
        )

    def _on_scanned(self, frames: list[zmq.Frame]) -> None:
        scanned = mesh_updates.scanned_of(frames[0].buffer)
        picture = frames[1].bytes if len(frames) > 1 else None
        self._events.append(self._paths.on_scanned(scanned, picture))

    # --- the link ---

    def _say_link(self) -> None:
        problem = self._problem()
        if problem is not None and problem != self._said:
            self._said = problem
            self._events.append(LinkSeen(problem))

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
        if self._refusal:
            return self._refusal
        if not self._followed.epoch:
            return f"the map {self._map} is being opened" if own.state in ("opening", "restarting") else None
        return self._problem_of_updates()

    def _problem_of_updates(self) -> str:
        """Return the reason why mesh updates do not come, though the server answers; empty without one."""
        link = self._updates
        if link.is_made or not (link.problem or link.finds_nobody):
            return ""
        why = link.problem or "nobody listens there"
        return f"no mesh updates come from {self._publish}, and the map is asked for them instead: {why}"

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
