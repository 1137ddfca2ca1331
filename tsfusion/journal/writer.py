# SPDX-License-Identifier: MIT
"""Writing the log: append, wait for the disk, begin the next segment."""

import contextlib
import logging
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

from tsfusion.journal.segments import LAYOUT, Position, Scan, failed, pack, scan, segment_path, segments

TOPIC = "/keyframes"
ENCODING = "x-tsfusion"
_CHANNEL = 1

log = logging.getLogger(__name__)


class Journal:
    """The one writer of a folder of segments.

    Args:
        folder: made when absent.
        segment_bytes: a segment that has grown past this is closed and the next begun.
        sync: wait for the disk at each append (fdatasync); without it a power cut may lose the tail.

    Attributes:
        found: what the segments of earlier runs hold, in journal order; the caller may empty it.
        damaged: how many of their records could not be read.

    Raises:
        JournalError: when the folder cannot be read or written.
    """

    def __init__(self, folder: str | os.PathLike[str], segment_bytes: int, *, sync: bool = True) -> None:
        self.folder = Path(folder)
        self._segment_bytes = segment_bytes
        self._sync = sync
        self._file: BinaryIO | None = None
        self._writer: Any = None
        self._first = 0  # where the open segment's first record starts
        self.found: list[Scan] = []
        self.damaged = 0
        self.closed_bytes = 0
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise failed("create the journal", self.folder, error) from error
        self._recover()

    def _recover(self) -> None:
        numbers = segments(self.folder)
        for number in numbers:
            path = segment_path(self.folder, number)
            found, damaged = scan(path)
            self.found += found
            self.damaged += damaged
            self.closed_bytes += path.stat().st_size
        self._number = numbers[-1] + 1 if numbers else 1

    @property
    def nbytes(self) -> int:
        """Bytes of all segments."""
        return self.closed_bytes + (self._file.tell() if self._file else 0)

    @property
    def segment(self) -> int:
        """The number of the segment that is (or will be) written to."""
        return self._number

    def append(self, frames: Sequence[Any], *, session: bytes, seq: int, client: str = "") -> Position:
        """Write one message; it is on the disk when this returns.

        Args:
            client: the name of who sent it, at most 32 bytes of UTF-8.

        Raises:
            JournalError: when the disk refuses. Nothing of the message counts then.
        """
        payload = pack(frames, session, seq, client)
        position = Position(self._number, 0)
        try:
            file = self._open()
            position = Position(self._number, file.tell())
            _add(self._writer, payload, seq)
            file.flush()
            if self._sync:
                os.fdatasync(file.fileno())
        except OSError as error:
            self._abandon(position.offset)
            raise failed("write", self.folder, error) from error
        if file.tell() >= self._segment_bytes:
            self._rotate_or_abandon()
        return position

    def _rotate_or_abandon(self) -> None:
        """The keyframe is on the disk, whatever becomes of the index that readers can do without."""
        try:
            self.rotate()
        except OSError as error:
            log.warning("%s", failed("close", segment_path(self.folder, self._number), error))
            self._abandon()

    def begin_after(self, segment: int) -> None:
        """Number new segments above one that a map remembers, though its file may have been removed."""
        if self._file is None:
            self._number = max(self._number, segment + 1)

    def rotate(self) -> None:
        """Close the segment with its index; the next append begins another."""
        if self._file is None:
            return
        self._writer.finish()
        self._file.flush()
        if self._sync:
            os.fdatasync(self._file.fileno())
        self._abandon()

    def close(self) -> None:
        """Finish the segment. The journal may be read, not written, from here on."""
        try:
            self.rotate()
        except OSError as error:
            self._abandon()
            raise failed("close", self.folder, error) from error

    def forget(self, number: int) -> None:
        """Delete a closed segment whose keyframes are safe elsewhere."""
        path = segment_path(self.folder, number)
        try:
            self.closed_bytes -= path.stat().st_size
            path.unlink()
        except OSError as error:
            raise failed("delete", path, error) from error

    def _open(self) -> BinaryIO:
        if self._file is None:
            path = segment_path(self.folder, self._number)
            self._first = 0
            self._file = path.open("xb")
            self._writer = _started(self._file)
            if self._sync:
                _sync_folder(self.folder)
            self._first = self._file.tell()
        return self._file

    def _abandon(self, end: int | None = None) -> None:
        """Leave the segment. What lies behind `end` was told as failed: it must not be found later on."""
        if self._file is None:
            return
        path, number = segment_path(self.folder, self._number), self._number
        with contextlib.suppress(OSError):  # a full disk fails here a second time
            self._file.close()
        self._file = self._writer = None
        self._number += 1
        with contextlib.suppress(OSError):
            if end is not None and end <= self._first:
                path.unlink()
                self._number = number
            else:
                if end is not None:
                    os.truncate(path, end)
                self.closed_bytes += path.stat().st_size


def write_file(path: Path, frames: Sequence[Any], *, session: bytes, seq: int, client: str = "") -> None:
    """One message as a file of its own, in the form of a segment, whole or not at all.

    Raises:
        JournalError: when the disk refuses.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            writer = _started(file)
            _add(writer, pack(frames, session, seq, client), seq)
            writer.finish()
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise failed("write", path, error) from error


def _started(file: BinaryIO) -> Any:
    writer: Any = Writer(file, chunk_size=1, compression=CompressionType.NONE)
    writer.start()
    schema = writer.register_schema("tsfusion.keyframe", "", LAYOUT)
    writer.register_channel(TOPIC, ENCODING, schema)
    return writer


def _add(writer: Any, payload: bytes, seq: int) -> None:
    now = time.time_ns()
    writer.add_message(_CHANNEL, log_time=now, publish_time=now, data=payload, sequence=seq % 2**32)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
