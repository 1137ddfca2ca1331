# SPDX-License-Identifier: MIT
"""Writing a journal: append, wait for the disk, begin the next segment, delete old ones."""

import contextlib
import logging
import os
import secrets
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError
from tsfusion.journal import mcap_layout
from tsfusion.journal.mcap_layout import Position
from tsfusion.journal.record_scan import journal_error
from tsfusion.journal.segments import RecordEntry, list_records, segment_path, segments

log = logging.getLogger(__name__)


class Journal:
    """The one writer of a folder of segments.

    Args:
        folder: made when absent.
        segment_bytes: a segment that has grown past this is closed and the next begun.
        sync: wait for the disk at each append (fdatasync); without it a power cut may lose the tail.
        min_free_bytes: what `append` leaves free on the disk.

    Attributes:
        found: records in the segments of earlier runs, in journal order; the caller may empty the list.
        damaged: number of their damaged records. A segment that is damaged from end to end counts as one.

    Raises:
        JournalError: when the folder cannot be made or listed, or one of its segments cannot be read or is
            of another version: its records would be passed over for ever.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        segment_bytes: int,
        *,
        sync: bool = True,
        min_free_bytes: int = 0,
    ) -> None:
        self.folder = Path(folder)
        self._segment_bytes = segment_bytes
        self._sync = sync
        self._room = FreeSpace(self.folder, min_free_bytes)
        self._file: BinaryIO | None = None
        self._writer: Any = None
        self._identity = b""
        self._first = 0  # where the open segment's first record starts
        self._closed: dict[int, int] = {}  # bytes by number, oldest first
        self.found: list[RecordEntry] = []
        self.damaged = 0
        try:
            durable_files.make_folder(self.folder)
        except OSError as error:
            raise journal_error("create the journal", self.folder, error) from error
        self._recover()

    def _recover(self) -> None:
        numbers = segments(self.folder)
        for number in numbers:
            path = segment_path(self.folder, number)
            self._closed[number] = 0
            try:
                found, damaged = list_records(path)
                self._closed[number] = path.stat().st_size
            except OSError as error:
                raise _advise(journal_error("read", path, error)) from error
            except JournalError as error:
                raise _advise(error) from error
            self.found += found
            self.damaged += damaged
        self._number = numbers[-1] + 1 if numbers else 1

    @property
    def nbytes(self) -> int:
        """Bytes of all segments."""
        return sum(self._closed.values()) + (self._file.tell() if self._file else 0)

    @property
    def free_bytes(self) -> int:
        """Room on the disk.

        Raises:
            JournalError: when the disk does not say.
        """
        return self._room.free_bytes

    @property
    def first(self) -> int:
        """The number of the oldest segment; more than 1 = older ones were deleted."""
        return next(iter(self._closed), self._number)

    @property
    def segment(self) -> int:
        """The number of the segment that is (or will be) written to."""
        return self._number

    def append(
        self,
        frames: Sequence[Any],
        *,
        session: bytes,
        seq: int,
        client: str = "",
        logged_ns: int | None = None,
    ) -> Position:
        """Write one message; it is on the disk when this returns.

        Args:
            client: name of the sender, at most 32 bytes of UTF-8.
            logged_ns: wall clock; None = now.

        Raises:
            JournalError: when the disk refuses, or too little would stay free. Nothing of the message
                counts then.
        """
        self._room.reserve(sum(memoryview(frame).nbytes for frame in frames))
        now_ns = mcap_layout.wall_clock_ns() if logged_ns is None else logged_ns
        position = Position(self._number, 0)
        try:
            file = self._open()
            position = Position(self._number, file.tell())
            payload = mcap_layout.pack_record(frames, self._identity, session, seq, client)
            mcap_layout.write_record(self._writer, payload, seq, now_ns)
            self._flush()
        except OSError as error:
            self._abandon(position.offset)
            raise journal_error("write", self.folder, error) from error
        except BaseException:  # interrupted in between
            self._abandon(position.offset)
            raise
        if file.tell() >= self._segment_bytes:
            self._rotate_or_abandon()
        return position

    def _flush(self) -> None:
        assert self._file is not None
        self._file.flush()
        if self._sync:
            os.fdatasync(self._file.fileno())

    def _rotate_or_abandon(self) -> None:
        """Close the segment; an error is only logged: the keyframe is on the disk, with or without index."""
        try:
            self.rotate()
        except OSError as error:
            log.warning("%s", journal_error("close", segment_path(self.folder, self._number), error))
            self._abandon()

    def rotate(self) -> None:
        """Close the segment with its index; the next append begins another."""
        if self._file is None:
            return
        self._writer.finish()
        self._flush()
        self._abandon()

    def close(self) -> None:
        """Finish the segment. The journal may be read, not written, from here on."""
        try:
            self.rotate()
        except OSError as error:
            self._abandon()
            raise journal_error("close", self.folder, error) from error

    def forget(self, number: int) -> None:
        """Delete a closed segment whose keyframes are safe elsewhere.

        Raises:
            JournalError: when the disk refuses.
        """
        path = segment_path(self.folder, number)
        try:
            path.unlink()
        except OSError as error:
            raise journal_error("delete", path, error) from error
        self._closed.pop(number, None)

    def retire(self, below: int, limit: int) -> int:
        """Delete the oldest closed segments until the journal is no larger than `limit`.

        Args:
            below: segments from this number on stay: their keyframes are nowhere else.
            limit: bytes of all segments.

        Returns:
            The bytes that this freed. A segment that cannot be deleted is logged and passed over.
        """
        before = self.nbytes
        for number in sorted(self._closed):
            if number >= below or self.nbytes <= limit:
                break
            try:
                self.forget(number)
            except JournalError as error:
                log.warning("%s", error)
        return before - self.nbytes

    def _open(self) -> BinaryIO:
        if self._file is None:
            self._first = 0
            self._file = segment_path(self.folder, self._number).open("xb")
            self._identity = secrets.token_bytes(mcap_layout.IDENTITY_BYTES)
            self._writer = mcap_layout.begin_segment(self._file, self._identity, mcap_layout.wall_clock_ns())
            # Before the first record: what a reader needs to find its way is never the end that a cut takes.
            self._flush()
            if self._sync:
                durable_files.sync_folder(self.folder)
            self._first = self._file.tell()
        return self._file

    def _abandon(self, end: int | None = None) -> None:
        """Leave the segment. Bytes behind `end` were reported as not written: nobody may find them later."""
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
                    _cut(path, end)
                self._closed[number] = path.stat().st_size


def write_file(path: Path, frames: Sequence[Any], *, session: bytes, seq: int, client: str = "") -> None:
    """Write one message into a file of its own that has the form of a segment, whole or not at all.

    Raises:
        JournalError: when the disk refuses.
    """
    identity, now_ns = secrets.token_bytes(mcap_layout.IDENTITY_BYTES), mcap_layout.wall_clock_ns()
    try:
        with durable_files.replacing(path) as file:
            writer = mcap_layout.begin_segment(file, identity, now_ns)
            payload = mcap_layout.pack_record(frames, identity, session, seq, client)
            mcap_layout.write_record(writer, payload, seq, now_ns)
            writer.finish()
    except OSError as error:
        raise journal_error("write", path, error) from error


def _advise(error: JournalError) -> JournalError:
    return JournalError(f"{error}; make it readable, or move it away to go on without its keyframes")


def _cut(path: Path, end: int) -> None:
    """Shorten a file; it is so on the disk when this returns."""
    with path.open("r+b") as file:
        file.truncate(end)
        os.fsync(file.fileno())


_CHECK_BYTES = 16 << 20  # written between two checks of the disk, at most
_CHECK_S = 1.0


class FreeSpace:
    """Room to write on a folder's disk, of which `min_free_bytes` stay free."""

    def __init__(self, folder: Path, min_free_bytes: int) -> None:
        self._folder = folder
        self._kept = min_free_bytes
        self._left = 0  # bytes to write before the next check
        self._check_at = 0.0

    def reserve(self, nbytes: int) -> None:
        """Raise JournalError when writing so much would leave too little."""
        now = time.monotonic()
        if self._kept and (now >= self._check_at or nbytes > self._left):
            spare = self.free_bytes - self._kept
            self._left = min(spare, max(_CHECK_BYTES, nbytes))
            self._check_at = now + _CHECK_S
            if nbytes > spare:
                self._check_at = 0.0
                raise JournalError(
                    f"cannot write {self._folder}: its disk has {_mb(spare + self._kept)} free, "
                    f"and {_mb(self._kept)} must stay so: free some space"
                )
        self._left -= nbytes

    @property
    def free_bytes(self) -> int:
        """Room on the disk.

        Raises:
            JournalError: when the disk does not say.
        """
        try:
            return durable_files.free_bytes(self._folder)
        except OSError as error:
            raise JournalError(
                f"cannot tell how full the disk of {self._folder} is: {error.strerror}", error.errno
            ) from error


def _mb(count: int) -> str:
    return f"{count / 1e6:.1f} MB"
