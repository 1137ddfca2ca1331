# SPDX-License-Identifier: MIT
"""Registry of a server's maps: the open ones, and the reasons why others could not be opened."""

import logging
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import zmq

from tsfusion.core import logs
from tsfusion.core.config import DEFAULT_MAP, MAP_NAME_LENGTH, ServerConfig, VolumeConfig
from tsfusion.core.errors import JournalError, TsfusionError
from tsfusion.core.readable_numbers import count_of
from tsfusion.fuser.fuser_messages import FuserAnswer
from tsfusion.gateway.clients.client_routes import ClientRoutes, Session
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.fusers.spare_fusers import SpareFusers, StartFuser
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps import moved_maps
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.moved_maps import AddressPair, MapDirectory
from tsfusion.journal import state_folder
from tsfusion.journal.segments import journal_errors
from tsfusion.wire.keys.key_folder import ALL_MAPS, AllowedMaps
from tsfusion.wire.messages.messages import Denied, Elsewhere

log = logging.getLogger(__name__)

# Called while a journal is read: name of the map, bytes read, all bytes, and records so far
RecoveryProgress = Callable[[str, int, int, int], None]
_MAX_UNOPENED = 64
_RETRY_INTERVAL = 10.0  # seconds before a map that could not be opened is tried again
_UNOPENED_KEPT = 600.0  # seconds for which a map that could not be opened is a problem
_KEPT_NAMES = 64  # free names that were given out
_KEPT_SECONDS = 300.0  # seconds for which a name is given to nobody else: a map takes a while to open


class MapRegistry:
    """Open maps of a server by name, and errors of others. Call `step` again and again."""

    def __init__(
        self, start: StartFuser, server: ServerConfig, routes: ClientRoutes, metrics: Metrics
    ) -> None:
        self._server = server
        self._routes = routes
        self._metrics = metrics
        self._volumes: Mapping[str, VolumeConfig] = {}
        self._watch: RecoveryProgress = lambda *_progress: None
        self._open: dict[str, HostedMap] = {}
        self._unopened: dict[str, tuple[str, float]] = {}  # name → why, when
        self._kept: dict[str, float] = {}  # free name that was given out → when
        self.place = ("", "")  # data and control address by which clients reach this server
        self.arriving: set[str] = set()  # maps that are being copied from another server
        self._spares = SpareFusers(start, server)
        self._directory = MapDirectory(server.directory) if server.directory else None
        if self._directory is not None:
            self._directory.check()
        self._started = self.is_ending = False  # while the server ends, no waiting fuser is started

    def __iter__(self) -> Iterator[HostedMap]:
        return iter(self._open.values())

    def get(self, name: str) -> HostedMap | None:
        """Return an open map by name, or None. Start its fuser if it was to start at the first use."""
        hosted = self._open.get(name)
        if hosted is not None:
            hosted.fuser.begin()
        return hosted

    def progress(self, name: str, session: bytes) -> tuple[int, int]:
        """Return the highest durable seq and the highest fused seq of a session."""
        hosted = self.get(name)
        return hosted.records.sessions.progress(session) if hosted else (0, 0)

    def session(self, name: str, key: bytes) -> Session | None:
        """Return a session of a map, or None if it has no record in the journal."""
        hosted = self.get(name)
        return hosted.records.sessions.get(key) if hosted else None

    def open_at_start(
        self,
        volumes: Mapping[str, VolumeConfig],
        watch: RecoveryProgress = lambda *_progress: None,
        *,
        later: Collection[str] = (),
    ) -> None:
        """Open maps by name with their settings. Maps of later clients get the default map's settings.

        Args:
            later: maps whose fusers start when a client asks for them, or else one after the other.
            watch: called with the progress of reading a map's journal, also of maps opened later. An error
                from it ends the start.

        Raises:
            TsfusionError: when a journal cannot be opened.
        """
        self._volumes, self._watch = volumes, watch
        for name in volumes:
            self._open_map(name, waits=name in later)

    def end_start(self, place: AddressPair) -> None:
        """Record that the server is up: from now on a map that cannot be opened does not end it."""
        self._started, self.place = True, place
        for hosted in self:
            if not hosted.is_empty:
                self._enter(hosted.name)

    # --- other servers ---

    def has(self, name: str) -> bool:
        """True if a map is open on this server and not empty."""
        hosted = self.get(name)
        return hosted is not None and not hosted.is_empty

    def elsewhere(self, name: str) -> Elsewhere | None:
        """Return the other server that has a map, if the map is empty or absent here; else None.

        Raises:
            JournalError: when the directory or the files of moved maps cannot be read.
        """
        if self.has(name) or name in self.arriving:
            return None
        entered = self._directory.place_of(name) if self._directory else None
        if entered is not None and entered != self.place:
            return Elsewhere(*entered)
        left = moved_maps.departed(self._server.state, name)
        return None if left is None else Elsewhere(left.address, left.control)

    def claim(self, name: str) -> Elsewhere | None:
        """Enter a new map here into the fleet's directory. Return another server that has it, or None.

        Raises:
            JournalError: when the directory cannot be written.
        """
        if (found := self.elsewhere(name)) is not None or self._directory is None:
            return found
        owner = self._directory.claim(name, self.place)
        return None if owner == self.place else Elsewhere(*owner)

    def _enter(self, name: str) -> None:
        """Enter a map of this server into the fleet's directory, even over another server's entry."""
        if self._directory is None:
            return
        try:
            self._directory.move(name, self.place)
        except JournalError as error:
            log.error("%s", error, extra=logs.about(map=name))

    def why_not_take(self, name: str) -> str:
        """Return why a map of this name cannot be moved here from another server; empty if it can."""
        if name in self.arriving:
            return f"map {name} is coming already"
        if self._has_own(name):
            return f"this server has a map {name} of its own"
        return "" if self.get(name) is not None else self.why_not(name)

    def _has_own(self, name: str) -> bool:
        hosted = self._open.get(name)
        return state_folder.holds_records(self._folder(name)) if hosted is None else not hosted.is_empty

    def begin_to_take(self, name: str) -> None:
        """Reserve the name of a map that is moving to this server, so that no new map gets it."""
        self.arriving.add(name)
        if (hosted := self.get(name)) is not None:
            hosted.freeze()

    def end_to_take(self, name: str) -> None:
        """Release the name of a map whose move to this server has ended."""
        self.arriving.discard(name)
        if (hosted := self._open.get(name)) is not None:
            hosted.stay()

    def open_ahead(self, name: str, folder: Path, volume: VolumeConfig) -> FuserSupervisor:
        """Start a fuser that reads a moving map in `folder` ahead. `take_in` continues with the result.

        If no spare process has these settings, the process of an empty map is used: a start takes seconds.

        Raises:
            MapError: when the system cannot start the process.
        """
        in_use = {route.map for route in self._routes}
        idle = (one for one in self if one.is_empty and one.fuser.idle and one.fuser.volume == volume)
        if not self._spares.has_for(volume):
            unused = sorted((one for one in idle if one.name not in in_use), key=lambda one: one.name != name)
            for hosted in unused[:1]:
                self._spares.add(hosted.fuser.give_process(), volume)
        place = self._folder(name)
        return FuserSupervisor(self._spares, place, self._server, volume, ahead=folder)

    def give_away(self, name: str) -> None:
        """Close a map that another server now has, or an empty one in whose place a map comes."""
        hosted = self._open.pop(name, None)
        if hosted is not None:
            hosted.close(wait=False)

    def take_in(self, name: str, fuser: FuserSupervisor | None = None) -> None:
        """Open a map that was copied completely from another server, which gave it up.

        Raises:
            TsfusionError: when it cannot be opened. Its files are then here, and the next start tries again.
        """
        if self._has_own(name):
            raise JournalError(f"this server has a map {name} of its own")
        self.give_away(name)
        moved_maps.install(self._server.state, name)
        self._enter(name)
        self._open_map(name, fuser)

    def greet(self, name: str) -> HostedMap | None:
        """Return the map that a client greets if it is open or on the disk, else None (see `why_not`).

        A greeting alone makes no map: the first record does.
        """
        try:
            is_there = name in self._open or state_folder.holds_a_map(self._folder(name))
        except JournalError as error:
            self._give_up(name, error)
            return None
        return self.open_for_client(name) if is_there else None

    def open_for_client(self, name: str) -> HostedMap | None:
        """Return the map with this name, opened or made. Return None if that fails (see `why_not`)."""
        if self.why_not(name) and name not in self._open:
            return None
        try:
            return self.get(name) or self._open_map(name)
        except TsfusionError as error:
            self._give_up(name, error)
            return None

    def why_not(self, name: str) -> str:
        """Return the reason why a closed map cannot be opened now; empty if it can."""
        if name in self.arriving:
            return "it is coming from another server"
        why, failed = self._unopened.get(name, ("", -_RETRY_INTERVAL))
        if time.monotonic() - failed < _RETRY_INTERVAL:
            return why
        return self.why_full if len(self._open) >= self._server.max_maps else ""

    @property
    def why_full(self) -> str:
        """Reason why no further map can be opened, and what to do."""
        most = self._server.max_maps
        return (
            f"{most} are open; use one of them (`tsfusion status` lists them), or restart the server with a "
            f"larger max_maps than {most} (--config)"
        )

    def why_none_free(self, like: str, maps: AllowedMaps) -> str:
        """Return the reason why `keep_free_name` finds no name of a new map for a client."""
        if self.free_name(like, maps) is None:
            return f"no name is free of the maps that this key may use: {maps}"
        return f"no room for another map: {self.why_full}"

    def denial_of_world(self, hosted: HostedMap, session: bytes, maps: AllowedMaps = ALL_MAPS) -> Denied:
        """Return the answer to a session whose poses are not in the map's coordinate frame.

        Args:
            maps: maps that the client can use, from which a free name is offered.
        """
        keyframes = count_of(hosted.keyframes_durable, "keyframe")
        why = f"map {hosted.name} has {keyframes} of another session, in another coordinate frame"
        try:
            free = self.free_name(hosted.name, maps)
        except JournalError:
            free = None
        return Denied(session, "world", why, free or "")

    def free_name(self, like: str, maps: AllowedMaps = ALL_MAPS) -> str | None:
        """Return a name for a new map: the first of NAME, NAME-2, … that is unused and not promised.

        If the client cannot use that name, return the first free name made from a map name that it can use.
        Return None without one.

        Args:
            maps: maps that the client can use.

        Raises:
            JournalError: when the state folder cannot be listed.
        """
        now = time.monotonic()
        in_use = {one.name for one in self if len(one.records.sessions)} | {
            route.map for route in self._routes
        }
        on_disk = set(state_folder.map_names(self._server.state)) - self._open.keys()
        kept = {name for name, since in self._kept.items() if now - since < _KEPT_SECONDS}
        taken = in_use | on_disk | kept | set(self._unopened)
        stem = re.sub(r"-[0-9]+$", "", like)
        stems = [stem if stem in taken else like]
        stems += [one.rstrip("*").rstrip("-_") for one in maps.patterns or ()]
        # More names than are taken: at least one of them is free.
        numbered = (_numbered(one, number) for one in stems if one for number in range(1, len(taken) + 3))
        return next((name for name in numbered if name not in taken and name in maps), None)

    def keep_free_name(self, like: str, maps: AllowedMaps = ALL_MAPS) -> str | None:
        """Return a name for a new map, promised to one client for a while; None if no map can be added.

        Raises:
            JournalError: as `free_name`.
        """
        name = self.free_name(like, maps)
        if name is None:
            return None
        if name not in self._open and len(self._open) >= self._server.max_maps:
            return None
        self._kept[name] = time.monotonic()
        if len(self._kept) > _KEPT_NAMES:
            self._kept.pop(next(iter(self._kept)))
        return name

    def _open_map(self, name: str, fuser: FuserSupervisor | None = None, *, waits: bool = False) -> HostedMap:
        own = moved_maps.volume_of(self._folder(name))
        volume = own or self._volumes.get(name) or self._volumes[DEFAULT_MAP]
        with journal_errors("open", self._folder(name)):
            hosted = HostedMap(
                self._spares,
                name,
                self._server,
                volume,
                routes=self._routes,
                metrics=self._metrics,
                watch=partial(self._watch, name),
                fuser=fuser,
                waits=waits,
            )
        self._open[name] = hosted
        self._unopened.pop(name, None)
        return hosted

    def _folder(self, name: str) -> Path:
        return state_folder.map_folder(self._server.state, name)

    def _give_up(self, name: str, error: Exception) -> None:
        log.error("the map cannot be opened: %s", error, extra=logs.about(map=name))
        self._unopened[name] = (str(error), time.monotonic())
        if len(self._unopened) > _MAX_UNOPENED:
            self._unopened.pop(next(iter(self._unopened)))
        hosted = self._open.pop(name, None)
        if hosted is not None:
            hosted.close(wait=False)

    def step(self, pass_on: Callable[[HostedMap, FuserAnswer, Sequence[zmq.Frame]], None]) -> None:
        """Call `step` of every open map. In quiet times, start one fuser that waits for its first use.

        Raises:
            TsfusionError: when a map of the start cannot be opened.
        """
        for hosted in list(self):
            try:
                hosted.step(partial(pass_on, hosted))
            except TsfusionError as error:
                if not self._started or hosted.warm:
                    raise
                self._give_up(hosted.name, error)
        if self._started:
            waiting = next((one for one in self if one.fuser.waits and one.name not in self.arriving), None)
            self._spares.step(self._volumes[DEFAULT_MAP], may_start=self.warm and waiting is None)
            if waiting is not None and self.warm and not self.is_ending:
                self.open_for_client(waiting.name)

    @property
    def warm(self) -> bool:
        """True if every open map whose fuser was started has its content loaded, and accepts keyframes."""
        return all(hosted.warm for hosted in self._begun)

    @property
    def _begun(self) -> list[HostedMap]:
        """Open maps whose fuser was started; other maps nobody has used yet."""
        return [hosted for hosted in self if not hosted.fuser.waits]

    @property
    def drained(self) -> bool:
        """True if, in all maps with a started fuser, every journaled record is fused or rejected."""
        return all(hosted.drained for hosted in self._begun)

    @property
    def ended(self) -> bool:
        """True if every map with a started fuser is drained, or cannot be for now (fuser or disk fails)."""
        return all(hosted.ended for hosted in self._begun)

    def finish(self) -> bool:
        """Order all fusers to write a checkpoint and end. Return True once all have ended."""
        self._spares.close()
        for hosted in self._begun:
            hosted.fuser.finish()
        return all(hosted.fuser.ended() for hosted in self._begun)

    @property
    def finished_well(self) -> bool:
        """True if every map's last checkpoint is written."""
        return all(hosted.fuser.finished_well for hosted in self._begun)

    def close(self) -> None:
        """End the fusers, and close the journals."""
        self._spares.close()
        for hosted in self:
            hosted.close()

    def unopened(self) -> Iterator[tuple[str, str]]:
        """Return names of maps that could not be opened recently, each with the reason."""
        before = time.monotonic() - _UNOPENED_KEPT
        self._unopened = {name: one for name, one in self._unopened.items() if one[1] > before}
        return ((name, why) for name, (why, _) in self._unopened.items())


def _numbered(stem: str, number: int) -> str:
    suffix = f"-{number}" if number > 1 else ""
    return stem[: MAP_NAME_LENGTH - len(suffix)] + suffix
