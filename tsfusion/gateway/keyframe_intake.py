# SPDX-License-Identifier: MIT
"""What becomes of a keyframe or correction that arrives: checked; journaled, held, refused or known.

Cheapest first, and nothing is answered before it is known to be the session's own client that asks: a
forged message must not have a good keyframe given up.
"""

import logging
import time
from collections import Counter
from typing import Any

import zmq

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.gateway.access_control import AccessControl
from tsfusion.gateway.hosted_map import HostedMap
from tsfusion.gateway.keyframe_outcomes import Clients
from tsfusion.gateway.map_registry import MapRegistry
from tsfusion.gateway.quotas import Quotas
from tsfusion.wire import codec, messages
from tsfusion.wire.record_header import RecordHeader, Refused, unpack

log = logging.getLogger(__name__)

_HOLDS = (0.25, 10.0)  # seconds, shortest and longest: each costs what was under way


class KeyframeIntake:
    """The way from the data socket into the journals.

    Attributes:
        refused: messages that were not journaled, by reason.
        duplicates: those that were journaled before.
        quotas: of every client, whatever it sends.
    """

    def __init__(
        self, server: ServerConfig, maps: MapRegistry, door: AccessControl, clients: Clients
    ) -> None:
        self.refused: Counter[str] = Counter()
        self.duplicates = 0
        self._server = server
        self._maps = maps
        self._door = door
        self._clients = clients
        self.quotas = Quotas(server)

    def take(self, frames: list[zmq.Frame]) -> None:
        """One message."""
        received_ns = time.monotonic_ns()
        client = self._door.client_of(frames[0])
        if client is None:
            self.refused["key"] += 1
            return
        buffers = [frame.buffer for frame in frames]
        nbytes = sum(buffer.nbytes for buffer in buffers)
        try:
            header = unpack(buffers[0])
        except Refused as error:
            self._refuse(error, client)
            return
        hosted = self._maps.get(header.map)
        if hosted is None or not hosted.warm:  # its client will say hello, and send it again
            self.refused["map"] += 1
        elif not hosted.sessions.room_for(header.session):  # its client is told when it says hello
            self.refused["session"] += 1
        elif not self.owns(hosted, header.session, client):
            self.refused["session"] += 1
            subject = logs.about(map=header.map, session=header.session, seq=header.seq, client=client)
            log.warning("a %s is refused: its session is another client's", header.kind, extra=subject)
        elif not self._has_to_wait(hosted, header.session, client, nbytes):
            self._on_checked(hosted, header, buffers, client, received_ns)

    def owns(self, hosted: HostedMap, key: bytes, client: str) -> bool:
        """Whether a session is this client's to go on with: it journaled it, or is the one who is heard."""
        session, route = hosted.sessions.get(key), self._clients.route(key)
        return (session is None or session.belongs_to(client)) and (route is None or route.open_to(client))

    def _has_to_wait(self, hosted: HostedMap, key: bytes, client: str, nbytes: int) -> bool:
        route = self._clients.route(key)
        now = time.monotonic()
        if route is not None:
            route.received_bytes += nbytes
            if now < route.held_until:
                self.refused["held"] += 1
                return True
        if seconds := hosted.held(now):
            self._hold(key, seconds, "disk", hosted.problem)
            return True
        if seconds := self.quotas.wait(client, nbytes, now):
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
        self.refused["held"] += 1
        seconds = min(max(seconds, _HOLDS[0]), _HOLDS[1])
        route = self._clients.route(key)
        if route is not None:
            route.held, route.held_until = reason, time.monotonic() + seconds
        self._clients.send(key, messages.Hold(key, seconds, reason, message))

    def _on_checked(
        self, hosted: HostedMap, header: RecordHeader, buffers: list[Any], client: str, received_ns: int
    ) -> None:
        # before all else: what is journaled must not be refused when it comes again
        verdict = hosted.sessions.admit(header.session, header.seq, header.previous)
        if verdict != "next":
            self.duplicates += verdict == "duplicate"
            self.refused["gap"] += verdict == "gap"
            self._clients.heard(header.session, client, scans=verdict == "duplicate")
            hosted.acknowledge(header.session, resend=verdict == "gap")
            return
        try:
            codec.check(buffers, self._server.max_frame_bytes)
            self.quotas.check(header, buffers)
            self._clients.heard(header.session, client, scans=True)
            hosted.accept(header, buffers, client, received_ns)
        except Refused as error:
            self._refuse(error, client, header)
        except JournalError:
            self._hold(header.session, hosted.held(time.monotonic()), "disk", hosted.problem)

    def _refuse(self, error: Refused, client: str, header: RecordHeader | None = None) -> None:
        """Count a bad message; answer it when it says whose it is, so that it is not sent for ever."""
        self.refused[error.reason] += 1
        if header is None:
            log.warning(
                "a message is refused: %s", error, extra=logs.about(client=client, reason=error.reason)
            )  # fmt: skip
            return
        key, seq = header.session, header.seq
        subject = logs.about(map=header.map, session=key, seq=seq, client=client, reason=error.reason)
        log.warning("a %s is refused: %s", header.kind, error, extra=subject)
        self._clients.send(key, messages.Nack(key, seq, "door", error.reason, str(error)))
