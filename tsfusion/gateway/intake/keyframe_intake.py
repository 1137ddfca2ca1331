# SPDX-License-Identifier: MIT
"""Take keyframes and corrections from the data socket: each is checked, then journaled, held or refused.

Records that came together are journaled together: one wait for the disk costs about the same for many
records. The cheapest checks come first. Nothing is answered before the sender is known to be the session's
own client: a forged message must not make a client give up a good keyframe.
"""

import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tsfusion.core import logs
from tsfusion.core.config import SENSORS, ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.core.limits import Bucket
from tsfusion.gateway.clients.client_routes import ClientRoutes
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.map_records import IncomingRecord
from tsfusion.gateway.maps.map_registry import MapRegistry
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.ports import Incoming
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.records.codec import measurement
from tsfusion.wire.records.record_header import (
    CorrectionHeader,
    Damaged,
    KeyframeHeader,
    RecordHeader,
    Refused,
    is_servers_own,
    unpack,
)

_MAX_CLIENTS = 4096
# Without keys all clients share one quota. Up to _SHARES connections have one part in _SHARES of it each,
# whatever others send. A connection loses its part after _SHARE_KEPT_S of silence.
_SHARES = 16
_SHARE_KEPT_S = 10.0


class Allowance:
    """Limit of keyframes and bytes a second, with what is left of it."""

    def __init__(self, server: ServerConfig, now: float, part: int = 1) -> None:
        self._keyframes = Bucket(server.quota_keyframes / part, now)
        self._bytes = Bucket(server.quota_bytes / part, now)
        self.asked = now

    def wait(self, nbytes: int, now: float) -> float:
        """Return the seconds until a message of `nbytes` is within the limit; 0 counts it as passed."""
        self.asked = now
        seconds = max(self._keyframes.wait(1.0, now), self._bytes.wait(nbytes, now))
        if not seconds:
            self._keyframes.spend(1.0)
            self._bytes.spend(nbytes)
        return seconds


class Quotas:
    """Limits of keyframes and bytes a second for all clients, and of what one record may ask."""

    def __init__(self, server: ServerConfig) -> None:
        self._server = server
        self._clients: OrderedDict[str, Allowance] = OrderedDict()
        self._shares: dict[int, Allowance] = {}  # by connection, where there are no keys

    def wait(self, owner: str, nbytes: int, now: float, connection: int | None = None) -> float:
        """Return the seconds until a client may send a message; 0 counts it as passed now.

        Args:
            owner: name of the client. Without keys all clients are one: new sessions cost nothing.
            connection: file number of the message's connection; None if not known.
        """
        allowance = self._clients.get(owner)
        if allowance is None:
            allowance = self._clients[owner] = Allowance(self._server, now)
            if len(self._clients) > _MAX_CLIENTS:
                self._clients.popitem(last=False)
        self._clients.move_to_end(owner)
        share = None if owner or connection is None else self._share_of(connection, now)
        seconds = allowance.wait(nbytes, now)
        return 0.0 if seconds and share is not None and not share.wait(nbytes, now) else seconds

    def _share_of(self, connection: int, now: float) -> Allowance | None:
        """Return a connection's own part of the quota, or None if other connections have all parts."""
        share = self._shares.get(connection)
        if share is None and len(self._shares) >= _SHARES:
            self._shares = {fd: one for fd, one in self._shares.items() if now - one.asked < _SHARE_KEPT_S}
        if share is None and len(self._shares) < _SHARES:
            share = self._shares[connection] = Allowance(self._server, now, _SHARES)
        if share is not None:
            share.asked = now
        return share

    def check(self, header: RecordHeader, frames: Sequence[Any]) -> None:
        """Raise Refused for a valid record that exceeds the server's limits.

        Raises:
            Refused: `quota` for too many points, or a sensor too far from the origin. `values` for a sensor
                model that no map knows, or a correction that names its own number or a higher one.
        """
        if isinstance(header, CorrectionHeader):
            self._check_correction(header, frames[1])
        else:
            self._check_keyframe(header)

    def _check_keyframe(self, header: KeyframeHeader) -> None:
        server = self._server
        shape = next(buffer.shape for buffer in header.buffers if buffer.name == measurement(header))
        points = shape[0] if len(shape) == 2 and measurement(header) == "points" else int(np.prod(shape))
        if points > server.quota_points:
            raise Refused("quota", f"a keyframe may have {server.quota_points} points, got {points}")
        self._check_place(math.dist(header.pose[3::4], (0.0, 0.0, 0.0)))
        if header.sensor and header.sensor not in SENSORS:
            raise Refused("values", f"sensor must be one of {', '.join(SENSORS)}, got {header.sensor!r}")

    def _check_correction(self, header: CorrectionHeader, body: Any) -> None:
        seqs, rows, removed = corrections.arrays(header, body)
        last = max(seqs.max(initial=0), removed.max(initial=0))
        if last >= header.seq:
            raise Refused("values", f"correction {header.seq} names keyframe {last}, which comes after it")
        self._check_place(float(np.linalg.norm(rows[:, :, 3], axis=1).max(initial=0.0)))

    def _check_place(self, away: float) -> None:
        server = self._server
        if away > server.quota_extent:
            raise Refused(
                "quota", f"a sensor may be {server.quota_extent:g} m from the origin, got {away:.0f} m"
            )


log = logging.getLogger(__name__)

# Seconds for which a client is held: it then sends again the keyframes that were under way.
_SHORTEST_HOLD = 0.25
_LONGEST_HOLD = 10.0
_MOST_DAMAGED = 8  # a record that came damaged so often is refused for good
_BATCH_BYTES = 4 << 20  # limit for records journaled together; a larger record is journaled alone


class KeyframeIntake:
    """Path of records from the data socket into the journals, in batches. `finish` ends a batch.

    Args:
        on_keyframe: called for each journaled keyframe with its map, header, frames, and client.
    """

    def __init__(
        self,
        server: ServerConfig,
        maps: MapRegistry,
        access: AccessControl,
        routes: ClientRoutes,
        *,
        on_keyframe: Callable[[str, KeyframeHeader, Sequence[Any], str], None],
    ) -> None:
        self.duplicates = 0  # messages with records that were journaled before
        self._server = server
        self._maps = maps
        self._access, self._refused = access, access.refused
        self._routes = routes
        self._quotas = Quotas(server)
        self._on_keyframe = on_keyframe
        self._batch: dict[HostedMap, list[IncomingRecord]] = {}  # not yet journaled
        self._batch_bytes = 0
        self._taken: dict[tuple[str, bytes], int] = {}  # map, session → the highest number among them

    def handle(self, received: Incoming) -> None:
        """Check one message. Add its record to the batch for the journal, or answer why not."""
        received_ns = time.monotonic_ns()
        client, buffers = received.client, received.frames
        try:
            header = unpack(buffers[0])
            if is_servers_own(header):
                raise Refused("forgetting", "only the server itself writes such a record")
        except Refused as error:
            self._refused[error.reason] += 1
            subject = logs.about(client=client, reason=error.reason)
            log.warning("a message is refused: %s", error, extra=subject)
            return
        record = IncomingRecord(header, buffers, client, received_ns, self._routes.get(header.session))
        if forbidden := self._access.denial_of_map(client, header.map, sends=True):
            self._turn_away(record, "map", forbidden)
            return
        hosted = self._maps.get(header.map) or self._make_map(record)
        if hosted is None or not hosted.takes_records:  # the client will greet, and send the record again
            self._turn_away(record, "map")
        elif not hosted.records.sessions.room_for(header.session):  # the answer to its Hello says so
            self._turn_away(record, "session")
        elif not self._routes.may_continue(header.session, client, hosted.records.sessions):
            self._turn_away(record, "session", "its session is another client's")
        elif not hosted.records.sessions.shares_frame(header.session, header):
            denied = self._maps.denial_of_world(hosted, header.session, self._access.maps_of(client))
            self._turn_away(record, "world", denied.message, denied)
        elif hosted.is_empty and (elsewhere := self._claimed_elsewhere(header)) is not None:
            self._turn_away(record, "map", answer=elsewhere)
        elif not self._has_to_wait(hosted, record, received.connection):
            self._on_admitted(hosted, record)

    def _turn_away(
        self, record: IncomingRecord, reason: str, why: str = "", answer: messages.Denied | None = None
    ) -> None:
        """Count a record that is not accepted now; its client keeps it. Log `why`, and send `answer`."""
        self._refused[reason] += 1
        if why:
            log.warning("a %s is refused: %s", record.header.kind, why, extra=record.about(reason))
        if answer is not None:
            self._routes.send(record.header.session, answer)

    def _claimed_elsewhere(self, header: RecordHeader) -> messages.Denied | None:
        """Return a Denied if another server has the map of this first record; None if the map can begin."""
        try:
            elsewhere = self._maps.claim(header.map)
        except JournalError as error:
            return messages.Denied(header.session, "map", f"map {header.map} cannot begin: {error}")
        return None if elsewhere is None else elsewhere.denial(header.session, header.map)

    def _make_map(self, record: IncomingRecord) -> HostedMap | None:
        """Make or open the map for the first record of a connected client. Return None if that fails."""
        header, route = record.header, record.route
        if route is None or (route.client, route.map) != (record.client, header.map):
            return None
        try:
            self._check(record)
        except Refused as error:
            self._refuse(error, record)
            return None
        if (elsewhere := self._claimed_elsewhere(header)) is not None:
            self._routes.send(header.session, elsewhere)
            return None
        hosted = self._maps.open_for_client(header.map)
        if hosted is None:
            why = f"map {header.map} cannot be opened: {self._maps.why_not(header.map)}"
            self._routes.send(header.session, messages.Denied(header.session, "map", why))
        return hosted

    def _check(self, record: IncomingRecord) -> None:
        """Raise Refused for an invalid record, or one that exceeds a quota."""
        codec.check(record.frames, self._server.max_frame_bytes, record.header)
        self._quotas.check(record.header, record.frames)

    def _has_to_wait(self, hosted: HostedMap, record: IncomingRecord, connection: int | None) -> bool:
        route, now = record.route, time.monotonic()
        if route is not None:
            route.received_bytes += record.nbytes
            if now < route.held_until:
                self._refused["held"] += 1
                return True
        if seconds := hosted.records.disk.seconds_left(now):
            self._hold(record, seconds, "disk", hosted.records.disk.problem)
            return True
        if seconds := self._quotas.wait(record.client, record.nbytes, now, connection):
            rates = f"{self._server.quota_keyframes:g} keyframes and {self._server.quota_bytes >> 20} MB"
            whose = "each client" if record.client else "all clients together"
            self._hold(record, seconds, "quota", f"the server takes {rates} a second of {whose}")
            return True
        return False

    def _hold(self, record: IncomingRecord, seconds: float, reason: str, message: str) -> None:
        self._refused["held"] += 1
        seconds = min(max(seconds, _SHORTEST_HOLD), _LONGEST_HOLD)
        if (route := record.route) is not None:
            route.hold_reason, route.hold_message = reason, message
            route.held_until = time.monotonic() + seconds
            route.fates.held()
        session = record.header.session
        self._routes.send(session, messages.Hold(session, seconds, reason, message))

    def _on_admitted(self, hosted: HostedMap, record: IncomingRecord) -> None:
        # Duplicates are found first: a journaled keyframe must not be refused when it comes again.
        header = record.header
        taken = self._taken.get((header.map, header.session), 0)
        verdict = hosted.records.sessions.admit(header.session, header.seq, header.previous, taken)
        if verdict != "next":
            self.finish()  # so the answer has the session's newest progress
            self.duplicates += verdict == "duplicate"
            self._refused["gap"] += verdict == "gap"
            self._routes.mark_alive(header.session, record.client, scans=verdict == "duplicate")
            hosted.outcomes.acknowledge(header.session, resend=verdict == "gap")
            return
        try:
            self._check(record)
        except Refused as error:
            self.finish()
            if isinstance(error, Damaged) and _comes_again(record):
                self._refused[error.reason] += 1
                log.warning(
                    "a %s is asked for again: %s", header.kind, error, extra=record.about(error.reason)
                )
                hosted.outcomes.acknowledge(header.session, resend=True)
            else:
                self._refuse(error, record)
            return
        self._routes.mark_alive(header.session, record.client, scans=True)
        self._take(hosted, record)

    def _take(self, hosted: HostedMap, record: IncomingRecord) -> None:
        """Add a record to the batch. Journal a new session's first record at once: it sets the rights."""
        header = record.header
        if self._batch_bytes + record.nbytes > min(_BATCH_BYTES, self._server.segment_bytes):
            self.finish()
        self._batch.setdefault(hosted, []).append(record)
        self._batch_bytes += record.nbytes
        self._taken[header.map, header.session] = header.seq
        if hosted.records.sessions.get(header.session) is None:
            self.finish()

    def finish(self) -> None:
        """Journal the batch, with one wait for the disk per map, and acknowledge its records."""
        if not self._batch:
            return
        batch, self._batch, self._batch_bytes = self._batch, {}, 0
        self._taken.clear()
        for hosted, records in batch.items():
            try:
                hosted.accept(records)
            except JournalError:
                seconds, why = hosted.records.disk.seconds_left(time.monotonic()), hosted.records.disk.problem
                for record in {one.header.session: one for one in records}.values():
                    self._hold(record, seconds, "disk", why)
                continue
            for record in records:
                if record.route is not None:
                    record.route.fates.taken()
                if isinstance(record.header, KeyframeHeader):
                    self._on_keyframe(hosted.name, record.header, record.frames, record.client)

    def _refuse(self, error: Refused, record: IncomingRecord) -> None:
        """Count an invalid record, and tell its client (Nack) not to send it again."""
        self._turn_away(record, error.reason, str(error))
        if record.route is not None:
            record.route.refused += 1
            record.route.fates.turned_away(str(error))
        session, seq = record.header.session, record.header.seq
        self._routes.send(session, messages.Nack(session, seq, "door", error.reason, str(error)))


def _comes_again(record: IncomingRecord) -> bool:
    """Count a record that came damaged. Return True if its client will send its copy, which may be good."""
    if (route := record.route) is None:
        return False
    seq, times = route.damaged
    route.damaged = (record.header.seq, times + 1 if seq == record.header.seq else 1)
    return route.damaged[1] < _MOST_DAMAGED
