# SPDX-License-Identifier: MIT
"""Arrivals: maps that are copied from another server while in use there, then taken over.

One thread makes each copy: it waits for network and disk, and the gateway must not wait. The questions are in
`migration_messages`, the files in `moved_maps`. The states of the taker:

    state          asks           until
    asking         list           the giver has opened the map
    copying        list, read     the copied checkpoint is new, or does not come for a minute
    reading ahead  list, read     a fuser has read it (for 3 min at most), and little is new
    freezing       freeze, read   all files are on the disk, and `arrived.json`
    committing     commit         the giver answers, also after a restart: the map is here, or stays there
    given up       cancel         an error before `committing`; the copy is deleted
"""

import logging
import os
import secrets
import shutil
import threading
import time
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from tsfusion.core import durable_files, logs
from tsfusion.core.errors import JournalError, TransportError, TsfusionError
from tsfusion.gateway.maps import moved_maps
from tsfusion.gateway.maps.moved_maps import Arrival
from tsfusion.journal import state_folder
from tsfusion.journal.segments import journal_errors
from tsfusion.wire.asking.queries import CommandRefused, Exchange
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.migration_messages import READ_BYTES, HandOver, MapFile, Moved, MoveStep, Parcel
from tsfusion.wire.sockets.curve import ClientKeys

log = logging.getLogger(__name__)

_ANSWER_S = 10.0  # longest wait for one answer of the other server
_LITTLE = 4 << 20  # new bytes of the last round, at most: the rest is copied while the map is frozen
_MOST_ROUNDS = 30
_ROUND_S = 0.1  # between two rounds while there is little to copy
_SAVING_S = 60.0  # longest wait for the giver's checkpoint: without it, this server fuses more records again
_RETRY_S = 1.0  # before a question without an answer, or one that came too early, is asked again
_OPENING_S = 120.0  # longest wait until the other server has opened the map
OnEnd = Callable[[Moved | str], None]


class MoveRequest(Struct, frozen=True):
    """Request to fetch a map from the server that has it."""

    name: str
    source: str
    source_control: str


class MapArrival:
    """Map that is moving to this server, copied by a thread. `outcome` is set when the thread has ended.

    Before that, `wants_fuser` is set when the copied files can be read ahead. Set `prepared` when that is
    done, or cannot be done: only then the map is frozen.

    Args:
        own: data and control address of this server, for clients.
        keys: keys by which the other server knows this one; None without keys.
        resumed: complete copy of an earlier process, which did not get the answer to `commit`.
    """

    def __init__(
        self,
        state: str | Path,
        request: MoveRequest,
        own: tuple[str, str],
        keys: ClientKeys | None,
        *,
        on_end: OnEnd,
        resumed: Arrival | None = None,
    ) -> None:
        self.name = request.name
        self.on_end = [on_end]
        self.outcome: Moved | str | None = None  # result, or reason why the map did not come
        self.folder = moved_maps.arriving_folder(state, request.name)
        self.request = request
        self._own, self._keys, self._resumed = own, keys, resumed
        self._move = secrets.token_bytes(16) if resumed is None else bytes.fromhex(resumed.move)
        self._have: dict[str, tuple[int, str]] = {}  # bytes and version, by file
        self._copied = self._number = 0
        self.volume: dict[str, Any] = {}  # the map's settings, once they are known
        self.wants_fuser, self.prepared = threading.Event(), threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"arrival-{self.name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Tell the thread to end. The server's next start continues with a complete copy."""
        self._stopping.set()
        self._thread.join(_ANSWER_S)

    def _run(self) -> None:
        try:
            request = self.request
            with closing(Exchange(request.source, request.source_control, self._keys)) as link:
                self.outcome = self._fetch(link)
        except (TsfusionError, OSError) as error:
            self.outcome = f"map {self.name} did not come: {error}"

    def _fetch(self, link: Exchange) -> Moved:
        began = time.monotonic()
        frozen_at = began
        if self._resumed is None:
            shutil.rmtree(self.folder, ignore_errors=True)
            try:
                frozen_at = self._copy(link)
            except (TsfusionError, OSError):
                with suppress(TransportError):
                    self._ask(link, "cancel")
                shutil.rmtree(self.folder, ignore_errors=True)
                raise
        self._commit(link)
        now = time.monotonic()
        return Moved(self._own[0], self._copied, round(now - began, 3), round(now - frozen_at, 3))

    def _copy(self, link: Exchange) -> float:
        """Copy the map while it is in use, then freeze it and copy the rest. Return the freeze's time."""
        self._wait_until_it_can_leave(link)
        self._copy_what_is_there(link)
        frozen_at = time.monotonic()
        last, _ = self._ask(link, "freeze")
        self._take_files(link, _without_map(last))
        for folder in (self.folder, *(path for path in self.folder.iterdir() if path.is_dir())):
            durable_files.sync_folder(folder)
        arrival = Arrival(
            self._move.hex(), self.request.source, self.request.source_control, last.volume, last.sessions
        )
        with durable_files.replacing(self.folder / state_folder.ARRIVED_FILE) as file:
            file.write(msgspec.json.encode(arrival))
        return frozen_at

    def _copy_what_is_there(self, link: Exchange) -> None:
        """Copy new bytes in rounds, until few are new and a fuser has read the map: the freeze is short."""
        began, rounds = time.monotonic(), 0
        while rounds < _MOST_ROUNDS:
            parcel, before = self._ask(link, "list")[0], self._copied
            # Once the fuser reads the copied checkpoint, that file must not change any more.
            self._take_files(link, _without_map(parcel) if self.wants_fuser.is_set() else parcel.files)
            rounds += self._copied - before >= _LITTLE
            waited = time.monotonic() - began
            if not self.wants_fuser.is_set() and (parcel.is_saved or waited > _SAVING_S):
                self.volume = parcel.volume
                self.wants_fuser.set()
            is_little = self._copied - before < _LITTLE
            if is_little and (self.prepared.is_set() or waited > _SAVING_S + _OPENING_S):
                return
            if is_little and self._stopping.wait(_ROUND_S):
                raise JournalError("this server is ending")

    def _wait_until_it_can_leave(self, link: Exchange) -> None:
        until = time.monotonic() + _OPENING_S
        while True:
            try:
                self._ask(link, "list")
                return
            except CommandRefused as error:
                if not error.retry or time.monotonic() > until or self._stopping.wait(_RETRY_S):
                    raise

    def _take_files(self, link: Exchange, files: tuple[MapFile, ...]) -> None:
        missing = sum(one.nbytes for one in files) - sum(have for have, _ in self._have.values())
        durable_files.make_folder(self.folder)
        durable_files.require_room(self.folder, max(missing, 0))
        for one in files:
            have, version = self._have.get(one.name, (0, one.version))
            if version != one.version or have > one.nbytes:
                have = 0
            if have < one.nbytes or one.name not in self._have:
                self._take_file(link, one, have)

    def _take_file(self, link: Exchange, one: MapFile, at: int) -> None:
        """Copy a file of the map from byte `at` to its end at the other server, and sync it to the disk."""
        path = self.folder / one.name
        path.parent.mkdir(exist_ok=True)
        with open(path, "r+b" if path.exists() else "xb") as file:
            file.truncate(at)
            file.seek(at)
            while True:
                if self._stopping.is_set():
                    raise JournalError("this server is ending")
                parcel, frames = self._ask(link, "read", file=one.name, offset=at)
                piece = frames[0] if frames else memoryview(b"")
                if zlib.crc32(piece) != parcel.crc32 or len(piece) > READ_BYTES:
                    raise JournalError(f"a piece of {one.name} was damaged on its way")
                file.write(piece)
                at += len(piece)
                self._copied += len(piece)
                if len(piece) < READ_BYTES:
                    break
            file.flush()
            os.fsync(file.fileno())
        if at < one.nbytes:
            raise JournalError(f"{one.name} became shorter while it was copied")
        self._have[one.name] = (at, one.version)

    def _commit(self, link: Exchange) -> None:
        """Ask the giver to write that this server owns the map. Raise CommandRefused if it does not.

        Without an answer the owner is unknown, so the question is repeated until an answer comes.
        """
        while True:
            try:
                self._ask(link, "commit", address=self._own[0], control=self._own[1])
                return
            except CommandRefused:
                shutil.rmtree(self.folder, ignore_errors=True)
                raise
            except TransportError as error:
                log.warning(
                    "which server owns the map is not known yet: %s", error, extra=logs.about(map=self.name)
                )
            if self._stopping.wait(_RETRY_S):
                raise JournalError("this server is ending; it asks again at its next start")

    def _ask(self, link: Exchange, step: MoveStep, **fields: Any) -> tuple[Parcel, list[memoryview]]:
        question = HandOver(move=self._move, step=step, **fields)
        self._number += 1
        command = messages.Command(name="hand_over", map=self.name, hand_over=question, number=self._number)
        reply, frames = link.ask(command, timeout=_ANSWER_S, follow=False)
        return reply.parcel or Parcel(), frames


def _without_map(parcel: Parcel) -> tuple[MapFile, ...]:
    return tuple(one for one in parcel.files if one.name != state_folder.MAP_FILE)


def unfinished(state: str | Path) -> list[tuple[str, Arrival]]:
    """Return the maps that an earlier process had copied completely. Delete incomplete copies.

    Raises:
        JournalError: when the folder of the maps cannot be listed.
    """
    maps = Path(state) / state_folder.MAPS_FOLDER
    with journal_errors("list", maps):
        folders = sorted(maps.glob(f"{moved_maps.ARRIVING[0]}*{moved_maps.ARRIVING[1]}"))
    found = []
    for folder in folders:
        name = folder.name.removeprefix(moved_maps.ARRIVING[0]).removesuffix(moved_maps.ARRIVING[1])
        arrival = moved_maps.arrival_of(folder)
        if arrival is None:
            shutil.rmtree(folder, ignore_errors=True)
        else:
            found.append((name, arrival))
    return found
