# SPDX-License-Identifier: MIT
"""Answer clients' greetings (Hello), which open sessions, and their pings."""

import logging
import time

from tsfusion.core import logs
from tsfusion.core.config import SERVER_SESSION, ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.gateway.clients.client_routes import ClientRoutes, Sessions
from tsfusion.gateway.maps.map_registry import MapRegistry
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.ports import Incoming, OutgoingAnswer
from tsfusion.wire.messages import messages

log = logging.getLogger(__name__)


class Greetings:
    """Answers to greetings and pings, with the server's epoch. A new epoch tells clients of lost messages."""

    def __init__(
        self,
        server: ServerConfig,
        maps: MapRegistry,
        access: AccessControl,
        routes: ClientRoutes,
        out: list[OutgoingAnswer],
    ) -> None:
        self._server, self._maps, self._out = server, maps, out
        self._access, self._routes = access, routes

    def on_hello(self, received: Incoming, hello: messages.Hello, epoch: str) -> None:
        """Open a session, or deny it with a reason."""
        if denied := self._denial(received.identity, hello, received.client):
            self._out.append(OutgoingAnswer(received.identity, messages.Denied(hello.session, *denied)))
            return
        if (route := self._routes.get(hello.session)) is not None:
            route.address = received.address
        durable, fused = self._maps.progress(hello.map, hello.session)
        welcome = messages.Welcome(
            epoch=epoch,
            version=messages.PROTOCOL_VERSION,
            durable=durable,
            fused=fused,
            window_keyframes=self._server.window_keyframes,
            window_bytes=self._server.window_bytes,
            max_frame_bytes=self._server.max_frame_bytes,
        )
        if (hosted := self._maps.get(hello.map)) is not None:
            hosted.outcomes.tell_untold(hello.session)  # rejections go out before the progress counts them
        self._out.append(OutgoingAnswer(received.identity, welcome))

    def _denial(self, identity: bytes, hello: messages.Hello, client: str) -> tuple[str, ...] | None:
        """Return the fields of a Denied, or make the session's route and return None if the session opens."""
        if version := messages.other_version(server=messages.PROTOCOL_VERSION, client=hello.version):
            return "version", version
        if forbidden := self._access.denial_of_map(client, hello.map, sends=True):
            return "map", forbidden
        try:
            elsewhere = self._maps.elsewhere(hello.map)
        except JournalError as error:
            return "map", f"map {hello.map} cannot be opened: {error}"
        if elsewhere is not None:
            return "moved", elsewhere.why(hello.map), "", elsewhere.address, elsewhere.control
        hosted = self._maps.greet(hello.map)
        if hosted is None and (why := self._maps.why_not(hello.map)):
            return "map", f"map {hello.map} cannot be opened: {why}"
        if hosted is not None and not hosted.takes_records:
            what = "moves to another server" if hosted.is_frozen else "is being opened"
            return "opening", f"map {hello.map} {what}"
        if hello.session == SERVER_SESSION:
            return "session", "the session of this spool is the server's own: use another spool folder"
        sessions = Sessions() if hosted is None else hosted.records.sessions
        if not self._routes.may_continue(hello.session, client, sessions):
            return "session", "the session of this spool is another client's: use another spool folder"
        if not sessions.room_for(hello.session):
            return "session", f"map {hello.map} has {len(sessions)} sessions and takes no new one"
        if hosted is not None and not sessions.shares_frame(hello.session, hello):
            other = self._maps.denial_of_world(hosted, hello.session, self._access.maps_of(client))
            self._access.refused["world"] += 1
            log.warning("%s", other.message, extra=logs.about(session=hello.session, client=client))
            return other.reason, other.message, other.free_map
        scans = sessions.get(hello.session) is not None
        self._routes.connect(hello.session, hello.map, identity, client, scans=scans)
        return None

    def on_ping(self, received: Incoming, ping: messages.Ping, epoch: str) -> None:
        """Answer a ping with a Pong, and store the client's counts that came with it."""
        received_ns = time.monotonic_ns()
        progress: tuple[int, int] = (0, 0)
        waiting = None
        route = self._routes.mark_alive(ping.session, received.client)
        if route is not None:
            route.identity = received.identity  # of several connections, this one is alive
            route.update(ping)
            progress = self._maps.progress(route.map, ping.session)
            if (hosted := self._maps.get(route.map)) is not None:
                hosted.outcomes.tell_untold(ping.session)
                waiting = hosted.corrections_waiting
        pong = messages.Pong(epoch, ping.sent_ns, received_ns, time.monotonic_ns(), *progress, waiting)
        self._out.append(OutgoingAnswer(received.identity, pong))
