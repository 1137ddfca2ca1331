# SPDX-License-Identifier: MIT
"""Read and write the files that say which maps came from another server, and which server has a map now.

`STATE/maps/NAME/arrived.json` tells where a map came from. `STATE/moved/NAME.json` tells which server has it
now. The map's old files are then in `STATE/moved/NAME/` (after a second departure in `NAME.2/`, …), and
nothing reads them again.
"""

import logging
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from tsfusion.core import durable_files, logs
from tsfusion.core.config import AnyStruct, VolumeConfig, make_settings
from tsfusion.core.errors import JournalError
from tsfusion.journal import state_folder
from tsfusion.journal.segments import journal_error
from tsfusion.wire.messages.migration_messages import MovedSession

log = logging.getLogger(__name__)

_SUFFIX = ".json"
ARRIVING = ".", ".arriving"  # before and after a map's name, in the name of its incomplete copy


class Arrival(Struct, frozen=True):
    """Origin of a map that came from another server, and its sessions' progress.

    Attributes:
        move: id of this move, hexadecimal.
        source, source_control: addresses of the server that had the map.
        volume: settings of the map.
    """

    move: str
    source: str
    source_control: str
    volume: dict[str, Any]
    sessions: tuple[MovedSession, ...]


class Departed(Struct, frozen=True):
    """Note that a map has left this server, with the server that has it now.

    Attributes:
        move: id of this move, hexadecimal.
        before: id of the move by which the map had come here; empty if it began here.
    """

    move: str
    before: str
    address: str
    control: str


def arrival_of(folder: Path) -> Arrival | None:
    """Return the origin of the map in a folder, or None if it began here."""
    return _read(folder / state_folder.ARRIVED_FILE, Arrival)


def volume_of(folder: Path) -> VolumeConfig | None:
    """Return the settings of a map that came from another server, or None if it began here.

    Raises:
        JournalError: when the file cannot be read.
        InvalidConfig: when the settings are another version's.
    """
    arrival = arrival_of(folder)
    return None if arrival is None else make_settings(VolumeConfig, arrival.volume)


def departed(state: str | Path, name: str) -> Departed | None:
    """Return the server that has a map now, if the map left this server and did not come back."""
    found = _read(path_of(state, name), Departed)
    if found is None:
        return None
    here = arrival_of(state_folder.map_folder(state, name))
    return found if here is None or here.move == found.before else None


def write_departed(state: str | Path, name: str, where: Departed) -> None:
    """Write to disk that another server has a map. Raise JournalError if the disk refuses."""
    path = path_of(state, name)
    try:
        durable_files.make_folder(path.parent)
        with durable_files.replacing(path) as file:
            file.write(msgspec.json.encode(where))
    except OSError as error:
        with suppress(OSError):  # a file without a promise must not stay
            path.unlink(missing_ok=True)
        raise journal_error("write", path, error) from error


def put_aside(state: str | Path, name: str) -> None:
    """Move the old files of a map that left to `STATE/moved`. Log a failure; the next start tries again."""
    folder = state_folder.map_folder(state, name)
    if departed(state, name) is None or not folder.is_dir() or not state_folder.holds_a_map(folder):
        return
    aside = next(path for path in _asides(state, name) if not path.exists())
    try:
        os.replace(folder, aside)
        durable_files.sync_folder(folder.parent)
        log.info("the map has moved; its files are kept in %s", aside, extra=logs.about(map=name))
    except OSError as error:
        log.error("%s", journal_error("move away", folder, error), extra=logs.about(map=name))


def left_behind(folder: Path) -> list[Path]:
    """Return the folders with a map's old files, one for each time that it left this server."""
    where = folder.parent.parent / state_folder.MOVED_FOLDER
    return sorted(path for path in where.glob(f"{folder.name}*") if _is_aside(path, folder.name))


def _is_aside(path: Path, name: str) -> bool:
    return path.name.partition(".")[0] == name and path.is_dir()


def _asides(state: str | Path, name: str) -> Iterator[Path]:
    """Yield names of folders for the old files of a map that leaves: NAME, NAME.2, NAME.3, …"""
    first = path_of(state, name).with_suffix("")
    yield first
    yield from (first.with_name(f"{name}.{number}") for number in count(2))


def departed_names(state: str | Path) -> list[str]:
    """Return the names of all maps that ever left this server."""
    with suppress(OSError):
        return sorted(
            path.stem
            for path in (Path(state) / state_folder.MOVED_FOLDER).iterdir()
            if path.suffix == _SUFFIX
        )
    return []


def path_of(state: str | Path, name: str) -> Path:
    """Return the path of the file that says which server has a map now."""
    return Path(state) / state_folder.MOVED_FOLDER / f"{name}{_SUFFIX}"


def _read(path: Path, kind: type[AnyStruct]) -> AnyStruct | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise journal_error("read", path, error) from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise JournalError(f"{path} is damaged: {error}") from error


def arriving_folder(state: str | Path, name: str) -> Path:
    """Return the folder for the copy of a map that is moving here."""
    return Path(state) / state_folder.MAPS_FOLDER / f"{ARRIVING[0]}{name}{ARRIVING[1]}"


def install(state: str | Path, name: str) -> None:
    """Move the complete copy of a map among this server's maps. Raise JournalError if the disk refuses."""
    folder, arriving = state_folder.map_folder(state, name), arriving_folder(state, name)
    try:
        if folder.is_dir():  # it has only a lock file, and nothing that is needed
            shutil.rmtree(folder)
        os.replace(arriving, folder)
        durable_files.sync_folder(folder.parent)
    except OSError as error:
        raise JournalError(f"cannot install map {name}: {error}", error.errno) from error
    with suppress(OSError):  # the file that says that another server has the map
        path_of(state, name).unlink(missing_ok=True)


_WAIT_S = 0.5  # longest wait for another server that writes
_TABLE = (
    "CREATE TABLE IF NOT EXISTS maps (name TEXT PRIMARY KEY, address TEXT NOT NULL, control TEXT NOT NULL)"
)
AddressPair = tuple[str, str]  # data and control address of a server


class MapDirectory:
    """Directory of a fleet: which server has which map, in an SQLite file that its servers share.

    The directory only helps to find a map. The truth is on the servers' disks: a server owns the maps there
    that did not leave. A wrong entry costs a client a detour. While the directory cannot be read, no new map
    can begin. Each call reads or writes the file.

    Args:
        path: path of the file, made if absent, on a disk that all servers reach and whose locks work.
    """

    def __init__(self, path: str) -> None:
        self._path = path

    def check(self) -> None:
        """Raise JournalError if the file cannot be used: a test before clients come."""
        with self._open():
            pass

    def place_of(self, name: str) -> AddressPair | None:
        """Return the server that has a map, or None without one. Raise JournalError as `claim`."""
        with self._open() as database:
            return self._find(database, name)

    def claim(self, name: str, own: AddressPair) -> AddressPair:
        """Enter a map for this server unless another one has it. Return the addresses of its server.

        Raises:
            JournalError: when the file cannot be read or written.
        """
        with self._open() as database:
            database.execute("INSERT OR IGNORE INTO maps VALUES (?, ?, ?)", (name, *own))
            return self._find(database, name) or own

    def move(self, name: str, own: AddressPair) -> None:
        """Enter a map for this server, over any other server's entry. Raise JournalError as `claim`."""
        with self._open() as database:
            database.execute("INSERT OR REPLACE INTO maps VALUES (?, ?, ?)", (name, *own))

    def _find(self, database: sqlite3.Connection, name: str) -> AddressPair | None:
        row = database.execute("SELECT address, control FROM maps WHERE name = ?", (name,)).fetchone()
        return None if row is None else (str(row[0]), str(row[1]))

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        try:
            with closing(sqlite3.connect(self._path, timeout=_WAIT_S)) as database, database:
                database.execute(_TABLE)
                yield database
        except sqlite3.Error as error:
            raise JournalError(
                f"cannot use the directory of maps {self._path}: {error}; expected a file, on a disk "
                "that all servers reach"
            ) from error
