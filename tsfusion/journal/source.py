# SPDX-License-Identifier: MIT
"""A segment file as bytes by offset, bad sectors included."""

import errno
import logging
import os
from pathlib import Path
from types import TracebackType

_SECTOR_BYTES = 1 << 16

log = logging.getLogger(__name__)


class Source:
    """A file as it is now: what a writer adds later is not seen.

    Attributes:
        failed: whether some of it could not be read.
        answered: whether any of it could.

    Raises:
        OSError: as `open` does.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("rb", buffering=0)
        self.size = os.fstat(self._file.fileno()).st_size
        self.failed = self.answered = False

    def __enter__(self) -> "Source":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self._file.close()

    def read(self, at: int, count: int, end: int | None = None) -> bytes:
        """Up to `count` bytes, none of them at or behind `end` (default: the file's).

        What the disk cannot read is zeros: it fails the CRC of the record it was in, and no other.
        """
        count = min(count, (self.size if end is None else end) - at)
        if count <= 0:
            return b""
        try:
            return self._pread(at, count)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
        if not self.failed:
            self.failed = True
            log.error("%s: the disk cannot read all of it", self.path)
        return b"".join(self._sector(one, at + count) for one in range(at, at + count, _SECTOR_BYTES))

    def _sector(self, at: int, end: int) -> bytes:
        count = min(_SECTOR_BYTES, end - at)
        try:
            return self._pread(at, count)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return bytes(count)

    def _pread(self, at: int, count: int) -> bytes:
        content = os.pread(self._file.fileno(), count, at)
        self.answered = True
        return content
