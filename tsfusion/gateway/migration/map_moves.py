# SPDX-License-Identifier: MIT
"""Move maps between servers: departures, arrivals, and messages that send clients to the new server."""

import errno
import logging
import time
from collections.abc import Callable, Sequence

import zmq

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig, VolumeConfig, make_settings
from tsfusion.core.errors import InvalidConfig, JournalError, MapError, TsfusionError
from tsfusion.gateway.clients.client_routes import ClientRoutes
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.maps.map_registry import MapRegistry
from tsfusion.gateway.maps.moved_maps import Arrival
from tsfusion.gateway.migration import map_arrivals
from tsfusion.gateway.migration.map_arrivals import MapArrival, MoveRequest
from tsfusion.gateway.migration.map_departures import MapDepartures
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.connections import PendingReplies
from tsfusion.gateway.ports.ports import OutgoingAnswer
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command, Reply
from tsfusion.wire.messages.migration_messages import Moved
from tsfusion.wire.sockets import sockets

log = logging.getLogger(__name__)

_MOST_ARRIVALS = 4  # at once
_MOST_UNREAD = 32  # unread answers to one server: it is known late that an answer was read


class MapMoves:
    """Moves of maps from and to this server, and their commands. Call `step` again and again.

    Args:
        unread: replies on their way; beyond their limit no piece of a map is sent.
        on_left: called with the name of a map that is closed here: its open queries are refused.
    """

    def __init__(
        self,
        server: ServerConfig,
        maps: MapRegistry,
        routes: ClientRoutes,
        out: list[OutgoingAnswer],
        access: AccessControl,
        *,
        unread: PendingReplies,
        on_left: Callable[[str], None],
    ) -> None:
        self._unread = unread
        self._on_left = on_left
        self._server = server
        self._maps, self._routes, self._out, self._access = maps, routes, out, access
        self._departures = MapDepartures(server, maps, on_left=self._send_away, on_stay=self._call_back)
        self._arrivals: list[MapArrival] = []
        self._fusers: dict[str, FuserSupervisor] = {}  # supervisors that read arriving maps ahead

    def resume(self) -> None:
        """Continue the moves whose complete copies an earlier process left."""
        for name, arrival in map_arrivals.unfinished(self._server.state):
            log.info("going on with the move of the map from %s", arrival.source, extra=logs.about(map=name))
            request = MoveRequest(name, arrival.source, arrival.source_control)
            self._begin(request, lambda _: None, arrival)

    def step(self) -> None:
        """Open the maps that were copied completely, and report the moves that failed."""
        self._departures.step()
        for one in self._arrivals:
            self._prepare(one)
        for one in [one for one in self._arrivals if one.outcome is not None]:
            self._arrivals.remove(one)
            fuser = self._fusers.pop(one.name, None)
            if fuser is not None and (not fuser.is_prepared or fuser.ended()):
                fuser.close(wait=False)
                fuser = None
            self._maps.end_to_take(one.name)
            outcome = one.outcome
            assert outcome is not None
            if isinstance(outcome, Moved):
                try:
                    self._maps.take_in(one.name, fuser)
                    fuser = None
                except TsfusionError as error:
                    outcome = f"map {one.name} has come and cannot be opened: {error}"
            if isinstance(outcome, str):
                log.error("%s", outcome, extra=logs.about(map=one.name))
            if fuser is not None:
                fuser.close(wait=False)
            for answer in one.on_end:
                answer(outcome)

    def _prepare(self, one: MapArrival) -> None:
        """Let a fuser read a map ahead while it is copied. If that fails, the map is read later."""
        if one.prepared.is_set() or not one.wants_fuser.is_set():
            return
        fuser = self._fusers.get(one.name)
        try:
            if fuser is None:
                volume = make_settings(VolumeConfig, one.volume)
                fuser = self._fusers[one.name] = self._maps.open_ahead(one.name, one.folder, volume)
            while fuser.receive() is not None:
                pass
            if fuser.is_prepared:
                one.prepared.set()
            elif fuser.ended():
                raise MapError("its process ended")
        except TsfusionError as error:
            log.warning("the map cannot be read ahead: %s", error, extra=logs.about(map=one.name))
            if (fuser := self._fusers.pop(one.name, None)) is not None:
                fuser.close(wait=False)
            one.prepared.set()

    def close(self) -> None:
        """End the threads, and close the files."""
        for one in self._arrivals:
            one.stop()
        for fuser in self._fusers.values():
            fuser.close()
        self._departures.close()

    def on_command(self, identity: bytes, command: Command, client: str) -> None:
        """Answer a command `move` or `hand_over`: `move` once the map has come, `hand_over` at once."""
        parcel, error, retry = None, None, False
        frames: list[zmq.Frame] = []
        try:
            if not self._access.may_forget_all(client):
                raise JournalError("this key may not move maps (`tsfusion keys allow --forget`)")
            if command.name == "move":
                self._ask_for(identity, command)
                return
            if command.hand_over is None:
                raise JournalError("the request to hand over a map has no question")
            if self._unread.of(identity)[0] >= _MOST_UNREAD or self._unread.nbytes > self._unread.max_bytes:
                raise JournalError("earlier answers wait to be read: read them, then ask again")
            parcel, frames = self._departures.answer(command.map, command.hand_over)
        except TsfusionError as refusal:
            error = str(refusal)
            retry = isinstance(refusal, JournalError) and refusal.errno == errno.EAGAIN
        reply = Reply(name=command.name, number=command.number, parcel=parcel, error=error, retry=retry)
        reader = identity + command.number.to_bytes(8, "big")
        self._out.append(OutgoingAnswer(identity, reply, self._unread.wrap(reader, frames) if frames else ()))

    def _ask_for(self, identity: bytes, command: Command) -> None:
        def answer(outcome: Moved | str) -> None:
            moved, error = (outcome, None) if isinstance(outcome, Moved) else (None, outcome)
            reply = Reply(name="move", number=command.number, moved=moved, error=error)
            self._out.append(OutgoingAnswer(identity, reply))

        source = sockets.connect_address(command.source)
        control = sockets.connect_address(sockets.control_address(source, command.source_control or None))
        sockets.check_reachable(source, has_keys=self._server.keys is not None)
        if (source, control) == self._maps.place:
            raise InvalidConfig(f"map {command.map} cannot move from this server to itself")
        request = MoveRequest(command.map, source, control)
        under_way = next((one for one in self._arrivals if one.request == request), None)
        if under_way is not None and len(under_way.on_end) < _MOST_UNREAD:
            under_way.on_end.append(answer)  # the client gave up waiting, and asks again
            return
        if why := self._maps.why_not_take(command.map):
            raise JournalError(why)
        if len(self._arrivals) >= _MOST_ARRIVALS:
            raise JournalError(
                f"{len(self._arrivals)} maps move to this server already: try again when one has arrived"
            )
        self._begin(request, answer, None)

    def _begin(self, request: MoveRequest, answer: map_arrivals.OnEnd, resumed: Arrival | None) -> None:
        self._maps.begin_to_take(request.name)
        keys = self._access.keys.as_client() if self._access.keys else None
        self._arrivals.append(
            MapArrival(self._server.state, request, self._maps.place, keys, on_end=answer, resumed=resumed)
        )

    # --- clients ---

    def _send_away(self, name: str, where: messages.Elsewhere) -> None:
        self._on_left(name)
        for session in self._sessions(name):
            self._routes.send(session, where.denial(session, name))

    def _call_back(self, name: str) -> None:
        """Ask clients of a map to send again the records that came while it was frozen."""
        for session in self._sessions(name):
            self._routes.send(session, messages.Ack(session, *self._maps.progress(name, session), (), True))

    def _sessions(self, name: str) -> Sequence[bytes]:
        now = time.monotonic()
        return [one.session for one in self._routes if one.map == name and one.state(now) != "gone"]
