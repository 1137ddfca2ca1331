# SPDX-License-Identifier: MIT
"""The maps of a server: those that are open, and why others cannot be."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import zmq

from tsfusion.core import logs
from tsfusion.core.config import DEFAULT_MAP, ServerConfig, VolumeConfig
from tsfusion.core.errors import TsfusionError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway.hosted_map import HostedMap
from tsfusion.gateway.keyframe_outcomes import Clients
from tsfusion.wire.health import MapHealth

log = logging.getLogger(__name__)

_MAX_UNOPENED = 64
_RETRY_INTERVAL = 10.0  # seconds before a map that could not be opened is tried again
Other = Callable[[HostedMap, fuser_messages.Meshed | fuser_messages.FuserReply, Sequence[zmq.Frame]], None]


class MapRegistry:
    """Opens maps, keeps all of them going, ends them."""

    def __init__(self, context: "zmq.Context[Any]", server: ServerConfig, clients: Clients) -> None:
        self._context = context
        self._server = server
        self._clients = clients
        self._volumes: Mapping[str, VolumeConfig] = {}
        self._open: dict[str, HostedMap] = {}
        self._unopened: dict[str, tuple[str, float]] = {}  # why, when
        self._started_up = False

    def __iter__(self) -> Iterator[HostedMap]:
        return iter(self._open.values())

    def get(self, name: str) -> HostedMap | None:
        """A map that is open."""
        return self._open.get(name)

    def progress(self, name: str, session: bytes) -> tuple[int, int]:
        """The highest seq of a session that is durable, and that is fused."""
        hosted = self.get(name)
        return hosted.sessions.progress(session) if hosted else (0, 0)

    def corrections(self, name: str, key: bytes) -> int:
        """How many corrections of a session were journaled."""
        hosted = self.get(name)
        session = hosted.sessions.get(key) if hosted else None
        return session.corrections if session else 0

    def begin(self, volumes: Mapping[str, VolumeConfig]) -> None:
        """Open these maps with these settings; one that a client asks for gets those of the default map.

        Raises:
            TsfusionError: when a journal cannot be opened.
        """
        self._volumes = volumes
        for name in volumes:
            self._open_map(name)

    def begun(self) -> None:
        """From here on a map that cannot be opened is no reason to end the server."""
        self._started_up = True

    def open_for_client(self, name: str) -> HostedMap | None:
        """A map by name, opened when need be; None when it cannot be: `why_not`."""
        hosted = self._open.get(name)
        if hosted is not None:
            return hosted
        _, failed = self._unopened.get(name, ("", -_RETRY_INTERVAL))
        if len(self._open) >= self._server.max_maps or time.monotonic() - failed < _RETRY_INTERVAL:
            return None
        try:
            return self._open_map(name)
        except TsfusionError as error:
            self._give_up(name, error)
            return None

    def why_not(self, name: str) -> str:
        """Why a map is not open."""
        why, _ = self._unopened.get(name, (f"{self._server.max_maps} are open (max_maps)", 0.0))
        return why

    def _open_map(self, name: str) -> HostedMap:
        volume = self._volumes.get(name) or self._volumes[DEFAULT_MAP]
        hosted = self._open[name] = HostedMap(self._context, name, self._server, volume, self._clients)
        self._unopened.pop(name, None)
        return hosted

    def _give_up(self, name: str, error: TsfusionError) -> None:
        log.error("the map cannot be opened: %s", error, extra=logs.about(map=name))
        self._unopened[name] = (str(error), time.monotonic())
        if len(self._unopened) > _MAX_UNOPENED:
            self._unopened.pop(next(iter(self._unopened)))
        hosted = self._open.pop(name, None)
        if hosted is not None:
            hosted.close()

    def step(self, other: Other) -> None:
        """Let every map do what it has to.

        Args:
            other: takes what a fuser says to people.

        Raises:
            TsfusionError: when a map that was to be opened at the start cannot be.
        """
        for hosted in list(self):
            try:
                hosted.step(partial(other, hosted))
            except TsfusionError as error:
                if not self._started_up or hosted.warm:
                    raise
                self._give_up(hosted.name, error)

    @property
    def warm(self) -> bool:
        """Whether every map that is open can take keyframes."""
        return all(hosted.warm for hosted in self)

    @property
    def drained(self) -> bool:
        """Whether every map has every keyframe of its journal."""
        return all(hosted.drained for hosted in self)

    @property
    def settled(self) -> bool:
        """Whether every map is drained, or never will be."""
        return all(hosted.settled for hosted in self)

    def finish(self) -> bool:
        """Have every fuser write its checkpoint and end; whether all have. Call it until then."""
        for hosted in self:
            hosted.fuser.finish()
        return all(hosted.fuser.ended() for hosted in self)

    @property
    def finished_well(self) -> bool:
        """Whether every checkpoint is on the disk."""
        return all(hosted.fuser.finished_well for hosted in self)

    def close(self) -> None:
        """End the fusers and finish the journals."""
        for hosted in self:
            hosted.close()

    def health(self) -> tuple[dict[str, MapHealth], list[str]]:
        """How each map is doing, and what is wrong with any."""
        found = {hosted.name: hosted.health() for hosted in self}
        problems = [f"map {name}: {one.problem}" for name, one in found.items() if one.problem]
        problems += [f"map {hosted.name}: {notice}" for hosted in self for notice in hosted.notices]
        problems += [f"map {name} cannot be opened: {why}" for name, (why, _) in self._unopened.items()]
        return found, problems
