# SPDX-License-Identifier: MIT
"""Numbers of records that left a spool unsent or refused, while one of its files still holds them.

Without them a scanner that starts after a crash would find these records again and send them. Not synced: a
record whose number a power cut takes is found again, and sent.
"""

import contextlib
import logging
from collections.abc import Iterable
from pathlib import Path

import numpy as np

NAME = "gone"
_NUMBER = np.dtype("<u8")
_SESSION_BYTES = 16

log = logging.getLogger(__name__)


def stored(folder: Path, session: bytes) -> set[int] | None:
    """The numbers in a spool's file; None = it is another session's."""
    try:
        content = (folder / NAME).read_bytes()
    except OSError:
        return set()
    if content[:_SESSION_BYTES] != session:
        return None
    whole = (len(content) - _SESSION_BYTES) // _NUMBER.itemsize
    return set(np.frombuffer(content, _NUMBER, whole, _SESSION_BYTES).tolist())


def _whole_bytes(size: int) -> int:
    """Bytes of a file of this size up to its last whole number."""
    numbers = (size - _SESSION_BYTES) // _NUMBER.itemsize
    return _SESSION_BYTES + numbers * _NUMBER.itemsize if size >= _SESSION_BYTES else 0


class Tombstones:
    """A file of numbers, behind the session they belong to. A disk that refuses is passed over."""

    def __init__(self, folder: Path, session: bytes) -> None:
        self._path = folder / NAME
        self._session = session
        self.numbers = self._read()  # those in the file at the start
        self.written = len(self.numbers)  # count of the numbers in the file

    def _read(self) -> set[int]:
        found = stored(self._path.parent, self._session)
        if found is None:  # of a spool that was here before
            self.clear()
        return found or set()

    def add(self, seq: int) -> None:
        """Append a number."""
        self._write([seq])

    def keep(self, numbers: Iterable[int]) -> None:
        """Write the file anew with these numbers; the records of all others are deleted."""
        self.clear()
        self._write(numbers)

    def clear(self) -> None:
        """Delete the file."""
        self.written = 0
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _write(self, numbers: Iterable[int]) -> None:
        added = np.fromiter(numbers, _NUMBER)
        try:
            with self._path.open("ab") as file:
                whole = _whole_bytes(file.tell())
                file.truncate(whole)  # what a full disk took of the last number would shift all that follow
                head = b"" if whole else self._session
                file.write(head + added.tobytes())
        except OSError as error:
            log.debug("%s cannot be written: %s", self._path, error.strerror)
        self.written += len(added)
