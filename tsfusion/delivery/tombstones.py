# SPDX-License-Identifier: MIT
"""Which keyframes left a spool unsent or refused, while their records are still in one of its files.

Else a scanner that starts after a crash would find them again and send them. Not synced: what a power cut
takes of it is found again, and sent.
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


class Tombstones:
    """A file of numbers, behind the session they belong to. A disk that refuses is passed over.

    Attributes:
        numbers: what was there at the start.
        written: how many the file holds.
    """

    def __init__(self, folder: Path, session: bytes) -> None:
        self._path = folder / NAME
        self._session = session
        self.numbers = self._read()
        self.written = len(self.numbers)

    def _read(self) -> set[int]:
        try:
            stored = self._path.read_bytes()
        except OSError:
            return set()
        if stored[:_SESSION_BYTES] != self._session:  # of a spool that was here before
            self.clear()
            return set()
        whole = (len(stored) - _SESSION_BYTES) // _NUMBER.itemsize
        return set(np.frombuffer(stored, _NUMBER, whole, _SESSION_BYTES).tolist())

    def add(self, seq: int) -> None:
        """This one is gone."""
        self._write([seq])

    def keep(self, numbers: Iterable[int]) -> None:
        """Forget all others: their records are gone, too."""
        self.clear()
        self._write(numbers)

    def clear(self) -> None:
        """Forget all."""
        self.written = 0
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _write(self, numbers: Iterable[int]) -> None:
        added = np.fromiter(numbers, _NUMBER)
        try:
            with self._path.open("ab") as file:
                head = b"" if file.tell() else self._session
                file.write(head + added.tobytes())
        except OSError as error:
            log.debug("%s cannot be written: %s", self._path, error.strerror)
        self.written += len(added)
