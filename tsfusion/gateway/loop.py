# SPDX-License-Identifier: MIT
"""The loop of a gateway's process: its sockets are polled and read, and the gateway's messages sent."""

from collections.abc import Callable
from functools import partial
from typing import Any

import zmq

from tsfusion.core.config import ServerConfig
from tsfusion.gateway.gateway import Gateway
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.connections import ConnectionLimits, Flood
from tsfusion.gateway.ports.fuser_process import FuserProcess
from tsfusion.gateway.ports.ports import Handler, Ports
from tsfusion.wire.messages.health import Health
from tsfusion.wire.sockets import sockets

_TICK_MS = 100  # within which a signal or a fuser's death is noticed
_RENEW_TICK_MS = 10  # while the sockets are made anew


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
        self.ports = Ports(context, server, access)
        self.limits = ConnectionLimits(self.ports.connections, access, server.memory_bytes)

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
                    self.ports.receive_some(socket, handle, partial(self._on_flood, socket))
                    self._send()  # before records wait for the disk: pongs tell the time
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

    def _on_flood(self, socket: sockets.AnySocket, flood: Flood) -> None:
        self.limits.on_flood(flood)
        if flood.goes_on:  # only a new port gets rid of it; other clients are back at once
            self.ports.renew(socket)

    def _send(self) -> None:
        for one in self.gateway.out:
            self.ports.send(one)
        self.gateway.out.clear()

    def close(self) -> None:
        """End the fusers and the moves, and close the sockets. Unsent messages are lost."""
        self.gateway.moves.close()
        self.gateway.maps.close()
        self.ports.close()
