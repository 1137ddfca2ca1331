# SPDX-License-Identifier: MIT
"""The maps of a server: the open ones, and why others could not be opened."""

import logging
import re
import time
from collections.abc import Iterator, Mapping
from itertools import count
from typing import Any

import zmq

from tsfusion.core import logs
from tsfusion.core.config import DEFAULT_MAP, MAP_NAME_LENGTH, ServerConfig, VolumeConfig
from tsfusion.core.errors import JournalError, TsfusionError
from tsfusion.gateway.client_routes import ClientRoutes
from tsfusion.gateway.hosted_map import ForPeople, HostedMap
from tsfusion.gateway.metrics import Metrics
from tsfusion.gateway.sessions import Session
from tsfusion.journal import state_folder
from tsfusion.wire.health import MapHealth
from tsfusion.wire.messages import Denied, Hello
from tsfusion.wire.record_header import RecordHeader

log = logging.getLogger(__name__)

_MAX_UNOPENED = 64
_RETRY_INTERVAL = 10.0  # seconds before a map that could not be opened is tried again
_KEPT_NAMES = 64  # free names that were given out
_KEPT_SECONDS = 300.0  # until then nobody else is given them: a map takes a while to be opened


class MapRegistry:
    """The open maps of a server. Call `step` again and again."""

    def __init__(
        self, context: "zmq.Context[Any]", server: ServerConfig, routes: ClientRoutes, metrics: Metrics
    ) -> None:
        self._context = context
        self._server = server
        self._routes = routes
        self._metrics = metrics
        self._volumes: Mapping[str, VolumeConfig] = {}
        self._open: dict[str, HostedMap] = {}
        self._unopened: dict[str, tuple[str, float]] = {}  # name → why, when
        self._kept: dict[str, float] = {}  # free name that was given out → when
        self._started = False

    def __iter__(self) -> Iterator[HostedMap]:
        return iter(self._open.values())

    def get(self, name: str) -> HostedMap | None:
        """An open map, by name."""
        return self._open.get(name)

    def progress(self, name: str, session: bytes) -> tuple[int, int]:
        """The highest seq of a session that is durable, and that is fused."""
        hosted = self.get(name)
        return hosted.sessions.progress(session) if hosted else (0, 0)

    def session(self, name: str, key: bytes) -> Session | None:
        """A session of a map; None = it has nothing in the journal."""
        hosted = self.get(name)
        return hosted.sessions.get(key) if hosted else None

    def open_at_start(self, volumes: Mapping[str, VolumeConfig]) -> None:
        """Open maps by name with their settings; those that clients ask for get those of the default map.

        Raises:
            TsfusionError: when a journal cannot be opened.
        """
        self._volumes = volumes
        for name in volumes:
            self._open_map(name)

    def end_start(self) -> None:
        """Go on when a map cannot be opened, from here on; before, that is an error of the server."""
        self._started = True

    def open_for_client(self, name: str) -> HostedMap | None:
        """A map by name, opened when need be; None when it cannot be, and `why_not` says why."""
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
        """Why a map cannot be opened."""
        why, _ = self._unopened.get(name, (self.why_full, 0.0))
        return why

    @property
    def why_full(self) -> str:
        """Why there is no room for another map, and what makes some."""
        most = self._server.max_maps
        return (
            f"{most} are open; use one of them (`tsfusion status` lists them), or restart the server with a "
            f"larger max_maps than {most} (--config)"
        )

    def denial_of_world(self, hosted: HostedMap, record: Hello | RecordHeader) -> Denied | None:
        """The answer to a session that does not share a map's coordinate frame; None = it may go on.

        Every record is asked this, not its session's greeting alone: of two that greet a map nobody has yet,
        the one whose record comes first has it.
        """
        if hosted.sessions.shares_frame(record.session, record):
            return None
        keyframes = hosted.health().keyframes_durable
        why = f"map {hosted.name} has {keyframes} keyframes of another session, in another coordinate frame"
        try:
            free = self.free_name(hosted.name)
        except JournalError:
            free = ""
        return Denied(record.session, "world", why, free)

    def free_name(self, like: str) -> str:
        """The first of NAME, NAME-2, NAME-3, … that is no map's yet and was given to nobody just now.

        Raises:
            JournalError: when the state folder cannot be listed.
        """
        now = time.monotonic()
        in_use = {one.name for one in self if len(one.sessions)} | {route.map for route in self._routes}
        on_disk = {name for name in state_folder.map_names(self._server.state) if name not in self._open}
        kept = {name for name, since in self._kept.items() if now - since < _KEPT_SECONDS}
        taken = in_use | on_disk | kept | set(self._unopened)
        stem = re.sub(r"-[0-9]+$", "", like)
        stem = stem if stem in taken else like
        names = (stem if number == 1 else _numbered(stem, number) for number in count(1))
        return next(name for name in names if name not in taken)

    def keep_free_name(self, like: str) -> str | None:
        """A free name that nobody else is given; None = there is no room for another map.

        Raises:
            JournalError: as `free_name`.
        """
        name = self.free_name(like)
        if name not in self._open and len(self._open) >= self._server.max_maps:
            return None
        self._kept[name] = time.monotonic()
        if len(self._kept) > _KEPT_NAMES:
            self._kept.pop(next(iter(self._kept)))
        return name

    def _open_map(self, name: str) -> HostedMap:
        volume = self._volumes.get(name) or self._volumes[DEFAULT_MAP]
        hosted = self._open[name] = HostedMap(
            self._context, name, self._server, volume, routes=self._routes, metrics=self._metrics
        )
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

    def step(self) -> list[tuple[HostedMap, ForPeople]]:
        """Step every map.

        Returns:
            The fusers' messages for viewers and for those who asked.

        Raises:
            TsfusionError: when a map that was to be opened at the start cannot be.
        """
        for_people: list[tuple[HostedMap, ForPeople]] = []
        for hosted in list(self):
            try:
                for_people += ((hosted, one) for one in hosted.step())
            except TsfusionError as error:
                if not self._started or hosted.warm:
                    raise
                self._give_up(hosted.name, error)
        return for_people

    @property
    def warm(self) -> bool:
        """Whether every open map can take keyframes."""
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
        """Have every fuser write its checkpoint and end; whether all have ended. Call it until they have."""
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
        """How each map is doing, by name, and the problems of all."""
        found = {hosted.name: hosted.health() for hosted in self}
        problems = [f"map {name}: {one.problem}" for name, one in found.items() if one.problem]
        problems += [f"map {hosted.name}: {notice}" for hosted in self for notice in hosted.notices]
        problems += [f"map {name} cannot be opened: {why}" for name, (why, _) in self._unopened.items()]
        return found, problems


def _numbered(stem: str, number: int) -> str:
    suffix = f"-{number}"
    return stem[: MAP_NAME_LENGTH - len(suffix)] + suffix
