# SPDX-License-Identifier: MIT
"""The gateway: the part of the server that must answer while a kernel runs.

A Taichi kernel blocks its process while it runs, so the gateway is a process of its own. Each message is
checked, journaled and acknowledged in one step. A map's fuser gets only its position in the journal.
Messages come in by calls and go out by a list: `loop` has the sockets.
"""

import logging
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import msgspec
import zmq

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import DecodeError, JournalError
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.clients.client_routes import ClientRoutes
from tsfusion.gateway.fusers.spare_fusers import StartFuser
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.intake.greetings import Greetings
from tsfusion.gateway.intake.keyframe_intake import KeyframeIntake
from tsfusion.gateway.maps.forgetting import ForgetRequest
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.map_condition import ServerCondition
from tsfusion.gateway.maps.map_registry import MapRegistry
from tsfusion.gateway.migration.map_moves import MapMoves
from tsfusion.gateway.people.requests import DeferredCommands, Requests, status_of
from tsfusion.gateway.people.scan_updates import ScanUpdates
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.connections import PendingReplies
from tsfusion.gateway.ports.ports import Incoming, OutgoingAnswer
from tsfusion.wire.keys.key_folder import ALL_MAPS, AllowedMaps
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.forget_messages import Forgotten
from tsfusion.wire.messages.health import Health
from tsfusion.wire.sockets.sockets import Addresses

log = logging.getLogger(__name__)

_REPLIES_SHARE = 4  # one fourth of the memory is for meshes and answers that wait to be read
_PLACE_KEPT = 0.5  # seconds for which the server of a map is cached
_MOST_PLACES = 64
_OF_AN_OPEN_MAP = frozenset({"forget", "ask", "status", "mesh"})


class Gateway:
    """One server between clients, journals and fusers. Give it messages, and call `step` again and again.

    Args:
        start: starts the fuser processes.

    Attributes:
        out: messages that are to be sent; who sends them removes them.
        intake: takes the messages of the data socket.
    """

    def __init__(
        self,
        start: StartFuser,
        server: ServerConfig,
        access: AccessControl,
        metrics: Metrics,
        *,
        on_health: Callable[[Health], None] = lambda _: None,
    ) -> None:
        self.out: list[OutgoingAnswer] = []
        self._server, self._access = server, access
        self._routes = ClientRoutes(self.out)
        self.maps = MapRegistry(start, server, self._routes, metrics)
        self._greetings = Greetings(server, self.maps, access, self._routes, self.out)
        scans = ScanUpdates()
        self.intake = KeyframeIntake(server, self.maps, access, self._routes, on_keyframe=scans.note)
        unread, rate = PendingReplies(server.memory_bytes // _REPLIES_SHARE), server.quota_questions
        self.requests = Requests(self.out, metrics, access.refused, unread, rate=rate, scans=scans)
        give_up = self.requests.give_up
        self.moves = MapMoves(
            server, self.maps, self._routes, self.out, access, unread=unread, on_left=give_up
        )
        self._places: dict[str, tuple[messages.Elsewhere | None, float]] = {}  # map → server, cached until
        self._deferred = DeferredCommands()
        self._condition = ServerCondition(access, self.maps, self._routes, metrics, on_health=on_health)
        self.is_accepting = self.has_stopped = False
        self.drop_clients()

    def drop_clients(self) -> None:
        """Forget who is connected, after every connection was dropped."""
        self._routes.clear()
        self.epoch = f"{time.monotonic_ns():x}"  # a new one tells clients that unanswered messages are lost

    def accept(self, addresses: Addresses) -> None:
        """Start to accept keyframes. `addresses` are those by which clients reach this server."""
        self.is_accepting = True
        self.maps.end_start((addresses.data, addresses.control))
        self.moves.resume()
        self._condition.next_look = 0.0  # health checks see the change at once

    def stop_accepting(self) -> None:
        """Accept no more keyframes. Clients keep the keyframes that are not acknowledged."""
        self.is_accepting, self.has_stopped, self.maps.is_ending = False, True, True

    def step(self, closed: str = "") -> None:
        """Do what is due, after the messages that came together were handled.

        Args:
            closed: why no connection is accepted now; empty if they are.

        Raises:
            TsfusionError: when a map of the start cannot be opened.
        """
        self._condition.closed = closed
        self.maps.step(self._pass_on)
        self.moves.step()
        self.requests.step()
        self._deferred.step(self._opens)
        for hosted in self.maps:
            if not hosted.fuser.ready:
                self.requests.give_up(hosted.name)
        self._condition.step(self.health)

    # --- maps ---

    def _pass_on(
        self, hosted: HostedMap, answer: fuser_messages.FuserAnswer, frames: Sequence[zmq.Frame]
    ) -> None:
        """Pass a fuser's answer on to the client that asked."""
        figures = answer.figures
        status = status_of(hosted, figures, self.health(), self._server) if figures else None
        self.requests.on_answer(answer, frames, status)

    # --- control ---

    def on_control(self, received: Incoming) -> None:
        """Handle a message of the control socket."""
        try:
            content, *points = received.frames
            message = messages.decode_to_server(content)
            if points and not (isinstance(message, messages.Command) and message.name == "ask"):
                raise DecodeError(f"{len(points)} frames too many")
        except (DecodeError, ValueError) as error:
            self._access.refused["control"] += 1
            log.debug("%s", error)
            return
        if isinstance(message, messages.Command):
            self._on_command(received.identity, message, points, received.client)
        elif isinstance(message, messages.Hello):
            self._greetings.on_hello(received, message, self.epoch)
        else:
            self._greetings.on_ping(received, message, self.epoch)

    def _reply(self, identity: bytes, command: messages.Command, **fields: Any) -> None:
        reply = messages.Reply(name=command.name, number=command.number, **fields)
        self.out.append(OutgoingAnswer(identity, reply))

    def _opens(self, name: str) -> bool:
        """True if a map is on this server and its fuser will soon be ready."""
        hosted = self.maps.get(name)
        return hosted is not None and not hosted.fuser.ready and not hosted.fuser.failed

    def _on_command(
        self,
        identity: bytes,
        command: messages.Command,
        points: list[memoryview],
        client: str,
        *,
        has_waited: bool = False,
    ) -> None:
        maps = self._access.maps_of(client)
        if command.name == "ping":
            self._reply(identity, command, version=messages.PROTOCOL_VERSION)
        elif command.name == "health":
            elsewhere = self._elsewhere(command.map) if command.map in maps else None
            self._reply(identity, command, health=self.health(maps), elsewhere=elsewhere)
        elif command.name == "new_map":
            try:
                name = self.maps.keep_free_name(command.map, maps)
                error = None if name else self.maps.why_none_free(command.map, maps)
            except JournalError as refusal:
                name, error = None, str(refusal)
            self._reply(identity, command, map=name, error=error)
        elif forbidden := self._access.denial_of_map(client, command.map):
            self._reply(identity, command, error=forbidden)
        elif command.name in _OF_AN_OPEN_MAP and (place := self._elsewhere(command.map)) is not None:
            self._reply(identity, command, error=place.why(command.map), elsewhere=place)
        elif not has_waited and self._defer(identity, command, points, client):
            pass  # it comes again
        elif command.name == "forget":
            self._on_forget(identity, command, client)
        elif command.name in ("move", "hand_over"):
            self.moves.on_command(identity, command, client)
        else:
            self.requests.submit(identity, command, points, self.maps.get(command.map), client)

    def _defer(
        self, identity: bytes, command: messages.Command, points: list[memoryview], client: str
    ) -> bool:
        """Keep a command until its map is open. Return False if it need not wait, or too many do."""
        if command.name not in _OF_AN_OPEN_MAP or not self._opens(command.map):
            return False
        again = partial(self._on_command, identity, command, points, client, has_waited=True)
        return self._deferred.add(command, client.encode() or identity, again, has_points=bool(points))

    def _elsewhere(self, name: str) -> messages.Elsewhere | None:
        """Return the other server that has a map, or None if none is known or the map is open here."""
        if self.maps.has(name):
            return None
        now = time.monotonic()
        place, until = self._places.get(name, (None, 0.0))
        if now >= until:  # cached: it is read from disks, and clients can ask without limit
            try:
                place = self.maps.elsewhere(name)
            except JournalError as error:
                log.error("%s", error, extra=logs.about(map=name))
            if len(self._places) >= _MOST_PLACES:
                self._places.clear()
            self._places[name] = place, now + _PLACE_KEPT
        return place

    def _on_forget(self, identity: bytes, command: messages.Command, client: str) -> None:
        def answer(found: Forgotten | str) -> None:
            error, forgotten = (found, None) if isinstance(found, str) else (None, found)
            self._reply(identity, command, error=error, forgotten=forgotten)

        def end(found: Forgotten | str) -> None:
            if not command.dry_run:
                self.requests.scans.forget(command.map)
            answer(found)

        selection, hosted = command.selection, self.maps.get(command.map)
        if selection is None or selection.is_empty:
            answer("name the keyframes that are to be forgotten: nothing was named")
        elif hosted is None:
            answer(f"no map {command.map} is open")
        elif hosted.is_leaving:
            answer(f"map {command.map} moves to another server; ask that one")
        elif not hosted.warm:
            answer(f"map {command.map} is being opened; ask again")
        elif not self._access.may_forget_all(client) and selection.client not in (None, client):
            self._access.refused["forbidden"] += 1
            answer(f"this key may forget keyframes of client {client} only (`tsfusion keys allow --forget`)")
        else:
            if not self._access.may_forget_all(client):
                selection = msgspec.structs.replace(selection, client=client)
            hosted.forgetting.add(ForgetRequest(selection, end, erase=command.erase, dry_run=command.dry_run))

    # --- health ---

    def health(self, shown: AllowedMaps = ALL_MAPS) -> Health:
        """Return the health of the server.

        Args:
            shown: only these maps, their clients, and their problems; `ready` is the whole server's.
        """
        return self._condition.health(
            shown,
            is_accepting=self.is_accepting,
            epoch=self.epoch,
            refused=dict(+self._access.refused),
            duplicates=self.intake.duplicates,
        )
