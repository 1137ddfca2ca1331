# SPDX-License-Identifier: MIT
"""Directory of a fleet: which server has which map, in an SQLite file that its servers share.

It is a signpost, not the truth: a server has the maps of its own disk that did not leave it. A wrong entry
costs a client a detour, and a directory that cannot be read costs new maps, which nobody may begin then.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager

from tsfusion.core.errors import JournalError

_WAIT_S = 0.5  # for another server that writes
_TABLE = (
    "CREATE TABLE IF NOT EXISTS maps (name TEXT PRIMARY KEY, address TEXT NOT NULL, control TEXT NOT NULL)"
)
AddressPair = tuple[str, str]  # data and control address of a server


class MapDirectory:
    """The entries; each call reads or writes the file.

    Args:
        path: of the file, made when absent; on a disk that all servers reach and whose locks work.
    """

    def __init__(self, path: str) -> None:
        self._path = path

    def check(self) -> None:
        """Raise JournalError as `claim`, before clients come."""
        with self._open():
            pass

    def place_of(self, name: str) -> AddressPair | None:
        """The server that has a map; None = no server has it. Raises JournalError as `claim`."""
        with self._open() as database:
            return self._find(database, name)

    def claim(self, name: str, own: AddressPair) -> AddressPair:
        """Enter a map as one's own unless another server has it; the place of who has it now.

        Raises:
            JournalError: when the file cannot be read or written.
        """
        with self._open() as database:
            database.execute("INSERT OR IGNORE INTO maps VALUES (?, ?, ?)", (name, *own))
            return self._find(database, name) or own

    def move(self, name: str, own: AddressPair) -> None:
        """Enter a map as one's own, whoever had it. Raises JournalError as `claim`."""
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
