# SPDX-License-Identifier: MIT
"""The gateway: everything that must answer while a kernel runs.

A Taichi kernel holds its process for as long as it takes, so this is another one. Each message is checked,
journaled and acknowledged in one step; a map's fuser is told only where it lies in the journal.
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import zmq

from tsfusion.core import logs, process
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import DecodeError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway import fuser_queries
from tsfusion.gateway.access_control import AccessControl
from tsfusion.gateway.client_routes import ClientRoute, ClientRoutes
from tsfusion.gateway.fuser_queries import FuserQueries
from tsfusion.gateway.hosted_map import HostedMap
from tsfusion.gateway.keyframe_intake import KeyframeIntake
from tsfusion.gateway.map_registry import MapRegistry
from tsfusion.gateway.memory_guard import MemoryGuard
from tsfusion.gateway.metrics import Metrics
from tsfusion.gateway.ports import Ports, Subscriptions, each, send_now
from tsfusion.wire import messages, sockets
from tsfusion.wire.health import Health
from tsfusion.wire.sockets import mesh_topic

log = logging.getLogger(__name__)

_LISTEN_TICK_MS = 10
_TICK_MS = 100  # how long a signal or a fuser's death may go unnoticed
_SNAPSHOT_INTERVAL = 1.0  # seconds
_MESHES_SHARE = 4  # a quarter of the memory is for meshes that wait to be read
Handlers = dict[sockets.AnySocket, Callable[[list[zmq.Frame]], None]]


class Gateway:
    """One server's state between clients, journals and fusers. Call `step` for ever.

    Attributes:
        epoch: a new one tells clients that what was under way is lost.
        maps: those of the server.
    """

    def __init__(
        self,
        context: "zmq.Context[Any]",
        server: ServerConfig,
        ports: Ports,
        door: AccessControl,
        metrics: Metrics | None = None,
    ) -> None:
        self.ports = ports
        self.maps = MapRegistry(context, server, self)
        self._server = server
        self._door = door
        self._metrics = metrics
        self._routes = ClientRoutes()
        self._intake = KeyframeIntake(server, self.maps, door, self)
        self._refused = self._intake.refused
        self._questions = FuserQueries(self._answer, server.memory_bytes // _MESHES_SHARE)
        self._topics = Subscriptions()
        self._watched: dict[str, bool] = {}  # what each fuser knows of it
        self._memory = MemoryGuard(server.memory_bytes)
        self._accepting = self._stopped = False
        self._started = time.monotonic()
        self._next_snapshot = 0.0
        self._new_epoch()

    def _new_epoch(self) -> None:
        self.epoch = f"{time.monotonic_ns():x}"

    def accept(self) -> None:
        """Take keyframes from here on."""
        self._accepting = True
        self.maps.begun()
        self._next_snapshot = 0.0  # health checks are to know at once

    def stop_accepting(self) -> None:
        """Take no more keyframes; clients keep what is not acknowledged."""
        self._accepting, self._stopped = False, True

    def step(self) -> None:
        """Wait for something to happen (a moment at most) and deal with it.

        Raises:
            TsfusionError: when a map that was to be opened at the start cannot be.
        """
        handlers = self._handlers()
        fusers = [hosted.fuser.socket for hosted in self.maps]
        polled = [(socket, zmq.POLLIN) for socket in (*self._door.poll, *fusers, *handlers)]
        events = dict(zmq.zmq_poll(polled, _TICK_MS if handlers else _LISTEN_TICK_MS))
        if not self._guard():
            for socket, handle in handlers.items():
                if socket in events:
                    each(socket, handle)
        self.ports.step()
        self.maps.step(self._on_other)
        self._tell_fusers()
        self._snapshot()

    def _handlers(self) -> Handlers:
        """What to do with messages, by socket; nothing while these are made anew."""
        if self.ports.problem:
            return {}
        handlers: Handlers = {
            self.ports.control: self._on_control,
            self.ports.publish: self._on_subscription,
        }
        if self._accepting:
            handlers[self.ports.keyframes] = self._intake.take
        elif self._stopped:
            self.ports.keyframes.close()
        return handlers

    def _guard(self) -> bool:
        """Drop all connections when a key was revoked, or when they hold too much memory; whether it did.

        ZeroMQ limits a frame and a queue of whole messages, not a message that never ends.
        """
        if self._door.step():
            log.warning("a key was revoked: every connection is made anew")
            self._refused["revoked"] += 1
        else:
            held = self._memory.excess(self._questions.nbytes)
            if not held:
                return False
            log.error(
                "the gateway holds %d MB, more than memory_bytes: every connection is made anew", held >> 20
            )
            self._refused["memory"] += 1
        self.ports.renew()
        self._routes.clear()
        self._topics.clear()
        self._new_epoch()
        return True

    def _snapshot(self) -> None:
        now = time.monotonic()
        if now < self._next_snapshot:
            return
        self._next_snapshot = now + _SNAPSHOT_INTERVAL
        logs.tell_left_out()
        if self._metrics is not None:
            self._metrics.health = self.health()

    # --- maps ---

    def _tell_fusers(self) -> None:
        """Whether anybody watches their maps; and that nobody will answer where one has died."""
        for hosted in self.maps:
            if not hosted.fuser.ready:
                self._watched.pop(hosted.name, None)
                self._questions.give_up(hosted.name)
                continue
            watched = self._topics.watched(hosted.name)
            if watched != self._watched.get(hosted.name) and hosted.fuser.send(
                fuser_messages.Publish(watched)
            ):
                self._watched[hosted.name] = watched

    def _on_other(
        self,
        hosted: HostedMap,
        message: fuser_messages.Meshed | fuser_messages.FuserReply,
        frames: Sequence[zmq.Frame],
    ) -> None:
        if isinstance(message, fuser_messages.FuserReply):
            status = (
                None
                if message.status is None
                else fuser_queries.status(hosted, message.status, self.health(), self._server)
            )
            self._questions.answered(message, status, frames)
        elif frames:
            send_now(self.ports.publish, [mesh_topic(hosted.name), fuser_messages.encode(message), *frames])

    # --- control ---

    def _on_control(self, frames: list[zmq.Frame]) -> None:
        client = self._door.client_of(frames[0])
        if client is None:
            self._refused["key"] += 1
            return
        try:
            identity, content = frames
            message = messages.decode_to_server(content.buffer)
        except (DecodeError, ValueError) as error:
            self._refused["control"] += 1
            log.debug("%s", error)
            return
        self._on_message(identity.bytes, message, client)

    def _on_message(self, identity: bytes, message: messages.ToServer, client: str) -> None:
        if isinstance(message, messages.Command):
            self._on_command(identity, message, client)
        elif isinstance(message, messages.Hello):
            self._on_hello(identity, message, client)
        else:
            self._on_ping(identity, message, client)

    def _on_hello(self, identity: bytes, hello: messages.Hello, client: str) -> None:
        if denied := self._denial(identity, hello, client):
            self._answer(identity, messages.Denied(hello.session, *denied))
            return
        durable, fused = self.maps.progress(hello.map, hello.session)
        welcome = messages.Welcome(
            epoch=self.epoch,
            version=messages.PROTOCOL_VERSION,
            durable=durable,
            fused=fused,
            window_keyframes=self._server.window_keyframes,
            window_bytes=self._server.window_bytes,
            max_frame_bytes=self._server.max_frame_bytes,
        )
        self._answer(identity, welcome)

    def _denial(self, identity: bytes, hello: messages.Hello, client: str) -> tuple[str, str] | None:
        """Why a session is not opened, or None."""
        if hello.version != messages.PROTOCOL_VERSION:
            speaks = f"the server speaks version {messages.PROTOCOL_VERSION} of the wire format"
            return "version", f"{speaks}, this client {hello.version}"
        hosted = self.maps.open_for_client(hello.map)
        if hosted is None:
            return "map", f"map {hello.map} cannot be opened: {self.maps.why_not(hello.map)}"
        if not hosted.warm:
            return "opening", f"map {hello.map} is being opened"
        if not self._intake.owns(hosted, hello.session, client):
            return "session", "the session of this spool is another client's: use another spool folder"
        if not hosted.sessions.room_for(hello.session):
            return "session", f"map {hello.map} has {len(hosted.sessions)} sessions and takes no new one"
        scans = hosted.sessions.get(hello.session) is not None
        self._routes.connect(hello.session, hello.map, identity, client, scans=scans)
        return None

    def _on_ping(self, identity: bytes, ping: messages.Ping, client: str) -> None:
        received_ns = time.monotonic_ns()
        progress = (0, 0)
        route = self._routes.get(ping.session)
        if route is not None and route.client == client:
            self._routes.heard(route)
            route.said(ping)
            progress = self.maps.progress(route.map, ping.session)
        pong = messages.Pong(self.epoch, ping.sent_ns, received_ns, time.monotonic_ns(), *progress)
        self._answer(identity, pong)

    def _on_command(self, identity: bytes, command: messages.Command, client: str) -> None:
        if command.name == "ping":
            self._answer(identity, messages.Reply(name="ping"))
        elif command.name == "health":
            self._answer(identity, messages.Reply(name="health", health=self.health()))
        else:
            self._questions.ask(identity, command, self.maps.get(command.map), client)

    def _on_subscription(self, frames: list[zmq.Frame]) -> None:
        change, topic = frames[0].bytes[:1], frames[0].bytes[1:]
        if change == b"\x01" and self._door.client_of(frames[0]) is None:
            self._refused["key"] += 1
        elif change == b"\x00":
            self._topics.discard(topic)
        elif change != b"\x01" or not self._topics.add(topic, (hosted.name for hosted in self.maps)):
            self._refused["subscription"] += 1

    # --- what is known ---

    def health(self) -> Health:
        """How the server is doing."""
        now = time.monotonic()
        found, problems = self.maps.health()
        if self._door.problem:
            problems.insert(0, f"nobody may connect: {self._door.problem}")
        if self.ports.problem:
            problems.insert(0, self.ports.problem)
        blocked = self.ports.problem or self._door.problem or any(one.problem for one in found.values())
        return Health(
            ready=self._accepting and not blocked,
            problems=tuple(problems),
            epoch=self.epoch,
            uptime_s=now - self._started,
            rss_bytes=process.rss_bytes(),
            refused=dict(self._refused + self._door.refused),
            duplicates=self._intake.duplicates,
            maps=found,
            clients=tuple(
                route.health(now, self.maps.progress(*route.place), self.maps.corrections(*route.place))
                for route in self._routes
            ),
        )

    # --- sending: an answer that cannot leave at once is dropped, the asker will ask again ---

    def send(self, session: bytes, message: messages.ToClient) -> None:
        """Pass it to the session's client, if that is connected."""
        route = self._routes.get(session)
        if route is not None:
            self._answer(route.identity, message)

    def heard(self, session: bytes, client: str, *, scans: bool) -> None:
        """A keyframe message of the session came."""
        route = self._routes.get(session)
        if route is not None and route.client == client:
            self._routes.heard(route, scans=scans)

    def route(self, session: bytes) -> ClientRoute | None:
        """The connection of a session's client."""
        return self._routes.get(session)

    def observe(self, map_name: str, stage: str, seconds: float) -> None:
        """A keyframe took so long for a stage."""
        if self._metrics is not None:
            self._metrics.observe(map_name, stage, seconds)

    def _answer(self, identity: bytes, message: messages.ToClient, frames: Sequence[zmq.Frame] = ()) -> None:
        send_now(self.ports.control, [identity, messages.encode(message), *frames])
