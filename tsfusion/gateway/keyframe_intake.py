# SPDX-License-Identifier: MIT
"""Keyframes and corrections from the data socket: checked, then journaled, held off, or refused.

Records that came together are journaled together: a disk takes many by one wait about as fast as one.
The cheapest checks come first, and nothing is answered before the message is known to be from the session's
own client: a forged message must not make a client give up a good keyframe.
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import zmq

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.gateway.client_routes import Admission, ClientRoutes
from tsfusion.gateway.hosted_map import HostedMap
from tsfusion.gateway.map_records import Checked
from tsfusion.gateway.map_registry import MapRegistry
from tsfusion.gateway.quotas import Quotas
from tsfusion.wire import codec, corrections, messages, sockets
from tsfusion.wire.record_header import Damaged, KeyframeHeader, RecordHeader, Refused, unpack

log = logging.getLogger(__name__)

# Seconds for which a client is held off: the keyframes that were under way have to be sent again.
_SHORTEST_HOLD = 0.25
_LONGEST_HOLD = 10.0
_MOST_DAMAGED = 8  # times that a record may come damaged before it is refused for good
_BATCH_BYTES = 4 << 20  # of records that are journaled together; one that is larger goes alone


class KeyframeIntake:
    """The way from the data socket into the journals. Call `finish` when some messages were handled.

    Args:
        on_keyframe: told of each keyframe that was journaled: its map, header, frames, and client.
    """

    def __init__(
        self,
        server: ServerConfig,
        maps: MapRegistry,
        admission: Admission,
        routes: ClientRoutes,
        *,
        on_keyframe: Callable[[str, KeyframeHeader, Sequence[Any], str], None],
    ) -> None:
        self.duplicates = 0  # messages with records that were journaled before
        self._server = server
        self._maps = maps
        self._admission = admission
        self._refused = admission.refused
        self._routes = routes
        self._quotas = Quotas(server)
        self._on_keyframe = on_keyframe
        self._batch: dict[HostedMap, list[Checked]] = {}  # not yet journaled
        self._batch_bytes = 0
        self._taken: dict[tuple[str, bytes], int] = {}  # map, session → the highest number among them

    def handle(self, frames: list[zmq.Frame]) -> None:
        """Check one message, and take its record to be journaled or answer why not."""
        received_ns = time.monotonic_ns()
        client = self._admission.client_of(frames[0])
        if client is None:
            return
        buffers = [frame.buffer for frame in frames]
        nbytes = sum(buffer.nbytes for buffer in buffers)
        try:
            header = unpack(buffers[0])
            if corrections.is_servers_own(header):
                raise Refused("forgetting", "only the server itself writes such a record")
        except Refused as error:
            self._refuse(error, client)
            return
        if forbidden := self._admission.denial_of_map(client, header.map, sends=True):
            self._refused["map"] += 1
            subject = logs.about(map=header.map, session=header.session, seq=header.seq, client=client)
            log.warning("a %s is refused: %s", header.kind, forbidden, extra=subject)
            return
        hosted = self._maps.get(header.map) or self._make_map(header, buffers, client)
        if hosted is None or not hosted.takes_records:  # its client will say hello, and send it again
            self._refused["map"] += 1
        elif not hosted.sessions.room_for(header.session):  # its client is told when it says hello
            self._refused["session"] += 1
        elif not self._admission.owns(hosted.sessions, header.session, client):
            self._refused["session"] += 1
            subject = logs.about(map=header.map, session=header.session, seq=header.seq, client=client)
            log.warning("a %s is refused: its session is another client's", header.kind, extra=subject)
        elif denied := self._maps.denial_of_world(hosted, header, self._admission.maps_of(client)):
            self._refused["world"] += 1
            subject = logs.about(map=header.map, session=header.session, seq=header.seq, client=client)
            log.warning("a %s is refused: %s", header.kind, denied.message, extra=subject)
            self._routes.send(header.session, denied)
        elif hosted.is_empty and (elsewhere := self._claimed_elsewhere(header)) is not None:
            self._refused["map"] += 1
            self._routes.send(header.session, elsewhere)
        elif not self._has_to_wait(hosted, header.session, client, nbytes, sockets.file_of(frames[0])):
            self._on_checked(hosted, header, buffers, client, received_ns)

    def _claimed_elsewhere(self, header: RecordHeader) -> messages.Denied | None:
        """The answer to the first record of a map that another server has; None = it begins here."""
        try:
            place = self._maps.claim(header.map)
        except JournalError as error:
            return messages.Denied(header.session, "map", f"map {header.map} cannot begin: {error}")
        if place is None:
            return None
        why = f"map {header.map} is at {place[0]} now"
        return messages.Denied(header.session, "moved", why, address=place[0], control=place[1])

    def _make_map(self, header: RecordHeader, buffers: list[Any], client: str) -> HostedMap | None:
        """The map that a client was let into, made for its first record; None = it is not, or cannot be."""
        route = self._routes.get(header.session)
        if route is None or (route.client, route.map) != (client, header.map):
            return None
        try:
            codec.check(buffers, self._server.max_frame_bytes)
            self._quotas.check(header, buffers)
        except Refused as error:
            self._refuse(error, client, header)
            return None
        if (elsewhere := self._claimed_elsewhere(header)) is not None:
            self._routes.send(header.session, elsewhere)
            return None
        hosted = self._maps.open_for_client(header.map)
        if hosted is None:
            why = f"map {header.map} cannot be opened: {self._maps.why_not(header.map)}"
            self._routes.send(header.session, messages.Denied(header.session, "map", why))
        return hosted

    def _has_to_wait(
        self, hosted: HostedMap, key: bytes, client: str, nbytes: int, connection: int | None
    ) -> bool:
        route = self._routes.get(key)
        now = time.monotonic()
        if route is not None:
            route.received_bytes += nbytes
            if now < route.held_until:
                self._refused["held"] += 1
                return True
        if seconds := hosted.disk.seconds_left(now):
            self._hold(key, seconds, "disk", hosted.disk.problem)
            return True
        if seconds := self._quotas.wait(client, nbytes, now, connection):
            rates = f"{self._server.quota_keyframes:g} keyframes and {self._server.quota_bytes >> 20} MB"
            self._hold(
                key,
                seconds,
                "quota",
                f"the server takes {rates} a second of {'each client' if client else 'all clients together'}",
            )
            return True
        return False

    def _hold(self, key: bytes, seconds: float, reason: str, message: str) -> None:
        self._refused["held"] += 1
        seconds = min(max(seconds, _SHORTEST_HOLD), _LONGEST_HOLD)
        route = self._routes.get(key)
        if route is not None:
            route.hold_reason, route.hold_message = reason, message
            route.held_until = time.monotonic() + seconds
            route.fates.held()
        self._routes.send(key, messages.Hold(key, seconds, reason, message))

    def _on_checked(
        self, hosted: HostedMap, header: RecordHeader, buffers: list[Any], client: str, received_ns: int
    ) -> None:
        # Duplicates come first: a keyframe that is journaled must not be refused when it is sent again.
        place = (header.map, header.session)
        verdict = hosted.sessions.admit(
            header.session, header.seq, header.previous, self._taken.get(place, 0)
        )
        if verdict != "next":
            self.finish()  # so that the answer says how far the session is
            self.duplicates += verdict == "duplicate"
            self._refused["gap"] += verdict == "gap"
            self._routes.mark_alive(header.session, client, scans=verdict == "duplicate")
            hosted.outcomes.acknowledge(header.session, resend=verdict == "gap")
            return
        try:
            codec.check(buffers, self._server.max_frame_bytes)
            self._quotas.check(header, buffers)
        except Refused as error:
            self.finish()
            if isinstance(error, Damaged) and self._comes_again(header):
                self._ask_again(error, hosted, header, client)
            else:
                self._refuse(error, client, header)
            return
        self._routes.mark_alive(header.session, client, scans=True)
        self._take(hosted, Checked(header, buffers, client, received_ns))

    def _take(self, hosted: HostedMap, record: Checked) -> None:
        """Put a record into the batch. What a new session may do is known when its first one is journaled."""
        header, nbytes = record.header, sum(frame.nbytes for frame in record.frames)
        if self._batch_bytes + nbytes > min(_BATCH_BYTES, self._server.segment_bytes):
            self.finish()
        self._batch.setdefault(hosted, []).append(record)
        self._batch_bytes += nbytes
        self._taken[header.map, header.session] = header.seq
        if hosted.sessions.get(header.session) is None:
            self.finish()

    def finish(self) -> None:
        """Journal the records of the batch, each map's by one wait for the disk, and answer their clients."""
        if not self._batch:
            return
        batch, self._batch, self._batch_bytes = self._batch, {}, 0
        self._taken.clear()
        for hosted, records in batch.items():
            try:
                hosted.accept(records)
            except JournalError:
                seconds, why = hosted.disk.seconds_left(time.monotonic()), hosted.disk.problem
                for key in dict.fromkeys(record.header.session for record in records):
                    self._hold(key, seconds, "disk", why)
                continue
            for header, frames, client, _ in records:
                if (route := self._routes.get(header.session)) is not None:
                    route.fates.taken()
                if isinstance(header, KeyframeHeader):
                    self._on_keyframe(header.map, header, frames, client)

    def _comes_again(self, header: RecordHeader) -> bool:
        """Count that a record came damaged; whether its client, whose copy may be well, sends it again."""
        route = self._routes.get(header.session)
        if route is None:
            return False
        seq, times = route.damaged
        route.damaged = (header.seq, times + 1 if seq == header.seq else 1)
        return route.damaged[1] < _MOST_DAMAGED

    def _ask_again(self, error: Damaged, hosted: HostedMap, header: RecordHeader, client: str) -> None:
        self._refused[error.reason] += 1
        subject = logs.about(
            map=header.map, session=header.session, seq=header.seq, client=client, reason=error.reason
        )
        log.warning("a %s is asked for again: %s", header.kind, error, extra=subject)
        hosted.outcomes.acknowledge(header.session, resend=True)

    def _refuse(self, error: Refused, client: str, header: RecordHeader | None = None) -> None:
        """Count a bad message; if its session is known, tell the client not to send it again."""
        self._refused[error.reason] += 1
        if header is None:
            subject = logs.about(client=client, reason=error.reason)
            log.warning("a message is refused: %s", error, extra=subject)
            return
        key, seq = header.session, header.seq
        subject = logs.about(map=header.map, session=key, seq=seq, client=client, reason=error.reason)
        log.warning("a %s is refused: %s", header.kind, error, extra=subject)
        if (route := self._routes.get(key)) is not None:
            route.refused += 1
            route.fates.turned_away(str(error))
        self._routes.send(key, messages.Nack(key, seq, "door", error.reason, str(error)))
