# SPDX-License-Identifier: MIT
"""The loop of a gateway's process: its sockets are polled and read, and the gateway's messages sent.

Connections that flood, fill memory or are too many are cut off.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import zmq

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.readable_numbers import count_of
from tsfusion.gateway.gateway import Gateway
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.ports.access_control import AccessControl, sender_of
from tsfusion.gateway.ports.connections import MemoryGuard
from tsfusion.gateway.ports.fuser_process import FuserProcess
from tsfusion.gateway.ports.ports import Flood, Handler, Ports
from tsfusion.wire.messages.health import Health
from tsfusion.wire.sockets import sockets

log = logging.getLogger(__name__)

_TICK_MS = 100  # within which a signal or a fuser's death is noticed
_RENEW_TICK_MS = 10  # while the sockets are made anew
_CUT_HELPS_WITHIN = 1.0  # seconds until a cut frees memory: more memory after that is a new attack
_UNNOTICED = 4  # one quarter of the memory is reserved for messages that arrive before an alarm


class GatewayLoop:
    """A gateway with its sockets. Call `step` again and again, and `close` at the end."""

    def __init__(
        self,
        context: "zmq.Context[Any]",
        server: ServerConfig,
        access: AccessControl,
        metrics: Metrics,
        *,
        on_health: Callable[[Health], None] = lambda _: None,
    ) -> None:
        start = partial(FuserProcess, context, server)
        self.gateway = Gateway(start, server, access, metrics, on_health=on_health)
        self.ports = Ports(context, server, access, self.gateway.refused)
        self.limits = ConnectionLimits(self.ports, access, self.gateway.refused, server.memory_bytes)

    def step(self) -> None:
        """Wait a moment for messages, handle them, and send the answers.

        Raises:
            TsfusionError: when a map of the start cannot be opened.
        """
        handlers = self._handlers()
        fusers = [hosted.fuser.process.socket for hosted in self.gateway.maps]
        polled = [(socket, zmq.POLLIN) for socket in (*self.ports.polled, *fusers, *handlers)]
        events = dict(zmq.zmq_poll(polled, _RENEW_TICK_MS if self.ports.problem else _TICK_MS))
        if self.limits.all_must_go(self.gateway.requests.nbytes):
            self.ports.renew()
            self.gateway.drop_clients()
        else:
            for socket, handle in handlers.items():
                if socket in events:
                    self.ports.receive_some(socket, handle, partial(self.limits.on_flood, socket))
            self.gateway.intake.finish()
        self._send()
        self.ports.step()
        self.limits.step()
        self.gateway.step(self.ports.problem)
        self._send()

    def _handlers(self) -> dict[sockets.AnySocket, Handler]:
        """Return the function that handles each socket's messages; sockets being made anew are left out."""
        ports, gateway = self.ports, self.gateway
        handlers: dict[sockets.AnySocket, Handler] = {ports.control: gateway.on_control}
        if gateway.is_accepting:
            handlers[ports.keyframes] = gateway.intake.handle
        elif gateway.has_stopped and ports.is_served(ports.keyframes):
            ports.keyframes.close()
        return {socket: handle for socket, handle in handlers.items() if ports.is_served(socket)}

    def _send(self) -> None:
        for one in self.gateway.out:
            self.ports.send(one)
        self.gateway.out.clear()

    def close(self) -> None:
        """End the fusers and the moves, and close the sockets. Unsent messages are lost."""
        self.gateway.moves.close()
        self.gateway.maps.close()
        self.ports.close()


class ConnectionLimits:
    """Limits of a gateway's connections. Call `step` and `all_must_go` again and again."""

    def __init__(self, ports: Ports, access: AccessControl, refused: Counter[str], memory_bytes: int) -> None:
        self._ports = ports
        self._access = access
        self._refused = refused
        self._memory = MemoryGuard(memory_bytes - memory_bytes // _UNNOTICED)
        self._hoarders_cut = -_CUT_HELPS_WITHIN  # time.monotonic()

    def step(self) -> None:
        """Cut off surplus connections."""
        if surplus := self._ports.connections.step():
            self._refused["connection"] += surplus
            cut = count_of(surplus, "connection is", "connections are")
            log.warning("%s cut off: there are too many", cut)

    def on_flood(self, socket: sockets.AnySocket, flood: Flood) -> None:
        """Cut off the sender of a message with endless frames. If the flood goes on, make its port anew.

        Other clients of the port are back at once. The sender, if it has a name, is kept out for a while.
        """
        self._refused["frames"] += 1
        client = self._access.keep_out(sender_of(flood.first))
        log.warning(
            "a message from %s has more than %d frames: its connection is cut off%s",
            sockets.peer_address(flood.first) or "somewhere",
            flood.discarded,
            ", and the others of that port are made anew" if flood.goes_on else "",
            extra=logs.about(client=client, reason="frames"),
        )
        self._ports.cut_off(flood.first)
        if flood.goes_on:
            self._ports.renew(socket)

    def all_must_go(self, uncounted: int) -> bool:
        """True if every connection must be made anew: a key was revoked, or connections hold too much memory.

        ZeroMQ limits the size of a frame and the queue of complete messages, but not a message that never
        ends.

        Args:
            uncounted: bytes of this process that no connection causes.
        """
        if self._access.take_revoked():
            log.warning("a key was revoked, or may use other maps: every connection is made anew")
            self._refused["revoked"] += 1
            return True
        held = self._memory.excess(uncounted)
        if not held or self._cut_hoarders(held):
            return False
        log.error(
            "the gateway holds %d MB, too near to memory_bytes: every connection is made anew", held >> 20
        )
        self._refused["memory"] += 1
        return True

    def _cut_hoarders(self, held: int) -> bool:
        """Cut off connections that fill the memory. Return False without any, or if a cut did not help."""
        now = time.monotonic()
        if now - self._hoarders_cut < _CUT_HELPS_WITHIN:
            return False
        hoarders = self._ports.connections.cut_hoarders()
        for peer, nbytes in hoarders:
            self._hoarders_cut = now
            self._refused["memory"] += 1
            log.warning(
                "the gateway holds %d MB, too near to memory_bytes: the connection from %s, with %.1f MB of "
                "messages that are not whole, is cut off",
                held >> 20,
                peer,
                nbytes / 1e6,
            )
        return bool(hoarders)
