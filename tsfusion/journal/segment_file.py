# SPDX-License-Identifier: MIT
"""Reading a segment file by byte offsets, bad sectors included, and the index at its end."""

import errno
import logging
import os
import struct
import zlib
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Literal

from mcap.opcode import Opcode
from msgspec import Struct

from tsfusion.journal import locations
from tsfusion.journal.locations import RemoteFile
from tsfusion.journal.mcap_layout import END_OF_DATA, MAGIC

_SECTOR_BYTES = 1 << 16

log = logging.getLogger(__name__)


class SegmentFile:
    """A segment file at its present length: bytes that a writer adds later are not seen.

    Args:
        on_read: called before each read: a large file takes long.
        descriptor: of the file where it is open already; it is closed with this. None = open the path.

    Raises:
        OSError: as `open` does.
    """

    def __init__(
        self, path: Path, on_read: Callable[[], None] = lambda: None, *, descriptor: int | None = None
    ) -> None:
        self.path = path
        self._on_read = on_read
        self._file: FileIO | RemoteFile
        if descriptor is None and locations.is_url(path):
            self._file = RemoteFile(path)
            self.size = self._file.size
        else:
            self._file = path.open("rb", buffering=0) if descriptor is None else FileIO(descriptor, "rb")
            self.size = os.fstat(self._file.fileno()).st_size
        self.failed = False  # the disk could not read some part that was asked for
        self.answered = False  # the disk has read some part

    def __enter__(self) -> "SegmentFile":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self._file.close()

    def read(self, at: int, count: int, end: int | None = None) -> bytes:
        """Up to `count` bytes, none of them at or behind `end` (default: the file's).

        A part that the disk cannot read is zeros: the CRC of its record fails, and no other.
        """
        self._on_read()
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
        if isinstance(self._file, RemoteFile):
            content = self._file.read_at(at, count)
        else:
            content = os.pread(self._file.fileno(), count, at)
        self.answered = True
        return content


_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, start of its offsets, CRC
_RECORD = struct.Struct("<BQ")
_COUNT = struct.Struct("<Q")
_MAX_SUMMARY_BYTES = 1 << 28


class SegmentEnd(Struct, frozen=True):
    """The index at the end of a segment."""

    # `whole`; `open` = never closed, or cut off within the index; `broken` = closed, then damaged
    state: Literal["whole", "broken", "open"]
    data_end: int | None = None  # offset at which the last record ends
    keyframes: int | None = None  # number of keyframes in the segment when it was closed


def read_segment_end(source: SegmentFile) -> SegmentEnd:
    """Read the index at the end of a segment."""
    closing = (
        source.read(source.size - len(MAGIC), len(MAGIC)) == MAGIC if source.size > len(MAGIC) else False
    )
    at = source.size - len(MAGIC) - _FOOTER.size
    summary = _summary(source, at) if at > 0 else None
    if summary is None:
        return SegmentEnd("broken" if closing else "open")
    start, content = summary
    keyframes = _keyframes(content)
    return SegmentEnd("whole" if closing else "broken", start - len(END_OF_DATA), keyframes)


def _summary(source: SegmentFile, footer_at: int) -> tuple[int, bytes] | None:
    """Offset of the summary, and its bytes; None unless its CRC agrees."""
    footer = source.read(footer_at, _FOOTER.size)
    opcode, length, start, _, crc32 = _FOOTER.unpack(footer)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _RECORD.size):
        return None
    if not len(END_OF_DATA) + len(MAGIC) < start <= footer_at or footer_at - start > _MAX_SUMMARY_BYTES:
        return None
    content = source.read(start, footer_at - start)
    return (start, content) if zlib.crc32(footer[:-4], zlib.crc32(content)) == crc32 else None


def _keyframes(summary: bytes) -> int | None:
    """The keyframes that the statistics count: all messages but the segment's own first one."""
    at = 0
    while at + _RECORD.size + _COUNT.size <= len(summary):
        opcode, length = _RECORD.unpack_from(summary, at)
        if opcode == Opcode.STATISTICS:
            return int(_COUNT.unpack_from(summary, at + _RECORD.size)[0]) - 1
        at += _RECORD.size + length
    return None
