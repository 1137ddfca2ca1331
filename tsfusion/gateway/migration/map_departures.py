# SPDX-License-Identifier: MIT
"""Departures: maps that leave this server, and the answers to the server that takes them.

The questions are in `migration_messages`. The states of the giver's map:

    state         question → next state                 a silent taker loses the map after
    whole         list → being copied
    being copied  freeze → frozen; cancel → whole       2 min, to a third server after 3 s
    frozen        commit → gone; cancel → whole         15 s, to a third server after 3 s
    gone          commit of the same move → gone
"""

import errno
import logging
import os
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import msgspec
import zmq
from msgspec import Struct, field

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.gateway.maps import moved_maps
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.map_registry import MapRegistry
from tsfusion.gateway.maps.moved_maps import Departed
from tsfusion.journal.segments import journal_errors
from tsfusion.journal.state_folder import JOURNAL_FOLDER, MAP_FILE, QUARANTINE_FOLDER
from tsfusion.wire.messages.messages import Elsewhere
from tsfusion.wire.messages.migration_messages import READ_BYTES, HandOver, MapFile, MovedSession, Parcel

log = logging.getLogger(__name__)

_FROZEN_S = 15.0  # a taker that is silent for so long loses a frozen map
_LEAVING_S = 120.0  # a taker that is silent for so long loses a map before the freeze
_REPLACED_S = 3.0  # a taker that is silent for so long can lose the map to a third server
_DOUBTED_S = 0.5  # a third server is told to ask again after such a silence: takers ask ten times a second


class _Departure(Struct, eq=False):
    """Map of this server that another server is copying, with its files and state."""

    move: bytes
    hosted: HostedMap
    asked: float  # time.monotonic()
    files: dict[str, int] = field(default_factory=dict)  # descriptors, by name

    def close(self) -> None:
        """Close the files that are open for copying."""
        for descriptor in self.files.values():
            os.close(descriptor)
        self.files.clear()


class MapDepartures:
    """Maps of this server that other servers are copying. Call `step` again and again.

    Args:
        on_left: called with the name of a map that now belongs to another server, and its addresses.
        on_stay: called with the name of a map that was frozen and stays here.
    """

    def __init__(
        self,
        server: ServerConfig,
        maps: MapRegistry,
        *,
        on_left: Callable[[str, Elsewhere], None],
        on_stay: Callable[[str], None],
    ) -> None:
        self._state = server.state
        self._maps = maps
        self._on_left, self._on_stay = on_left, on_stay
        self._leaving: dict[str, _Departure] = {}  # by map

    def step(self) -> None:
        """End the moves of takers that are silent for too long: their maps stay here."""
        now = time.monotonic()
        for name, one in list(self._leaving.items()):
            if now - one.asked > (_FROZEN_S if one.hosted.is_frozen else _LEAVING_S):
                log.warning(
                    "the map stays: the server that asked for it is silent", extra=logs.about(map=name)
                )
                self._give_up(name)

    def close(self) -> None:
        """Close the files that are being copied."""
        for one in self._leaving.values():
            one.close()

    def answer(self, name: str, question: HandOver) -> tuple[Parcel, list[zmq.Frame]]:
        """Return the answer to a request of the taking server, and its frames.

        Raises:
            JournalError: when the map is not open here, cannot leave now, or the disk refuses.
        """
        if question.step == "commit":
            return self._commit(name, question), []
        one = self._departure(name, question)
        one.asked = time.monotonic()
        if question.step == "read":
            return self._read(one, question)
        if question.step == "cancel":
            self._give_up(name)
            return Parcel(), []
        if question.step == "freeze" and not one.hosted.is_frozen:
            one.hosted.freeze()
            log.info("the map takes no records: it moves to another server", extra=logs.about(map=name))
        return self._listed(one), []

    def _departure(self, name: str, question: HandOver) -> _Departure:
        one = self._leaving.get(name)
        if one is not None and one.move == question.move:
            return one
        if one is not None and (silent := time.monotonic() - one.asked) < _REPLACED_S:
            again = errno.EAGAIN if silent > _DOUBTED_S else None
            raise JournalError(f"map {name} is moving to another server already", again)
        if one is not None and question.step == "list":
            log.warning("another server takes the map: the one before is silent", extra=logs.about(map=name))
            self._give_up(name)
        hosted = self._maps.get(name)
        if hosted is None or question.step != "list":
            raise JournalError(f"no map {name} is open here, or its move was given up")
        if not hosted.warm or not hosted.forgetting.is_idle:
            raise JournalError(f"map {name} is being opened, or forgets keyframes: ask again", errno.EAGAIN)
        hosted.begin_to_leave()
        one = self._leaving[name] = _Departure(question.move, hosted, time.monotonic())
        return one

    def _give_up(self, name: str) -> None:
        one = self._leaving.pop(name)
        one.close()
        was_frozen = one.hosted.is_frozen
        one.hosted.stay()
        if was_frozen:
            self._on_stay(name)

    def _listed(self, one: _Departure) -> Parcel:
        folder = one.hosted.records.folder
        sessions: tuple[MovedSession, ...] = ()
        with journal_errors("list", folder):
            files = tuple(sorted(_files(folder), key=lambda file: file.name))
        if one.hosted.is_frozen:
            sessions = tuple(
                MovedSession(each.key, each.client, each.world, each.durable)
                for each in one.hosted.records.sessions
            )
        volume = msgspec.to_builtins(one.hosted.fuser.volume)
        is_saved = one.hosted.checkpoints.is_answered
        return Parcel(files=files, volume=volume, is_saved=is_saved, sessions=sessions)

    def _read(self, one: _Departure, question: HandOver) -> tuple[Parcel, list[zmq.Frame]]:
        path = one.hosted.records.folder / question.file
        with journal_errors("read", path):
            if question.offset == 0 and (before := one.files.pop(question.file, None)) is not None:
                os.close(before)
            if (descriptor := one.files.get(question.file)) is None:
                descriptor = one.files[question.file] = os.open(path, os.O_RDONLY)
            piece = os.pread(descriptor, READ_BYTES, question.offset)
            if len(piece) < READ_BYTES:
                os.close(one.files.pop(question.file))
        return Parcel(crc32=zlib.crc32(piece)), [zmq.Frame(piece)]

    def _commit(self, name: str, question: HandOver) -> Parcel:
        """Write to disk that the map belongs to the taker. A repeated request gets the same answer."""
        before = moved_maps.departed(self._state, name)
        if before is not None and before.move == question.move.hex():
            return Parcel()
        one = self._leaving.get(name)
        if one is None or one.move != question.move or not one.hosted.is_frozen:
            raise JournalError(f"map {name} stays: its move was given up")
        arrival = moved_maps.arrival_of(one.hosted.records.folder)
        where = Departed(
            question.move.hex(), arrival.move if arrival else "", question.address, question.control
        )
        moved_maps.write_departed(self._state, name, where)
        self._leaving.pop(name).close()
        self._maps.give_away(name)
        moved_maps.put_aside(self._state, name)
        log.info("the map is at %s now", question.address, extra=logs.about(map=name))
        self._on_left(name, Elsewhere(question.address, question.control))
        return Parcel()


def _files(folder: Path) -> Iterator[MapFile]:
    """Yield the files that make a map, with their present sizes."""
    paths = [folder / MAP_FILE]
    for kind in (JOURNAL_FOLDER, QUARANTINE_FOLDER):
        paths += (folder / kind).glob("[0-9A-Za-z]*.mcap")
    for path in paths:
        with suppress(FileNotFoundError):  # no checkpoint yet, or a deleted file of the quarantine
            stat = path.stat()
            version = f"{stat.st_ino:x}-{stat.st_mtime_ns:x}" if path.parent == folder else ""
            yield MapFile(str(path.relative_to(folder)), stat.st_size, version)
