# SPDX-License-Identifier: MIT
"""Write a journal: append records, wait for the disk, open new segments and delete old ones."""

import contextlib
import errno
import logging
import math
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError
from tsfusion.journal import erasing, mcap_layout
from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.record_scan import list_records
from tsfusion.journal.segments import (
    OpenSegment,
    RecordEntry,
    is_away,
    journal_error,
    journal_errors,
    segment_path,
    segments,
)

log = logging.getLogger(__name__)

_PARTS = r"\.[0-9]{6,9}\.mcap\.partial"  # files that a killed writer leaves
_KEPT_OPEN = 64  # segments
# Bytes read so far, bytes of the whole journal, and records so far
ReadingWatcher = Callable[[int, int, int], None]
_CHECK_BYTES = 16 << 20  # written between two checks of the disk, at most
_CHECK_S = 1.0


class FreeSpace:
    """The free space on a folder's disk, of which `min_free_bytes` must stay free."""

    def __init__(self, folder: Path, min_free_bytes: int) -> None:
        self._folder = folder
        self._kept = min_free_bytes
        self._left = 0  # bytes to write before the next check
        self._check_at = 0.0

    def reserve(self, nbytes: int) -> None:
        """Raise JournalError if writing this many bytes would leave too little space."""
        now = time.monotonic()
        if self._kept and (now >= self._check_at or nbytes > self._left):
            spare = self._measure() - self._kept
            self._left = min(spare, max(_CHECK_BYTES, nbytes))
            self._check_at = now + _CHECK_S
            if nbytes > spare:
                self._check_at = 0.0
                raise JournalError(f"cannot write {self._folder}: {lacking(spare + self._kept, self._kept)}")
        self._left -= nbytes

    def _measure(self) -> int:
        try:
            return shutil.disk_usage(self._folder).free
        except OSError as error:
            raise JournalError(
                f"cannot tell how full the disk of {self._folder} is: {error.strerror}", error.errno
            ) from error


def lacking(free: int, kept: int) -> str:
    """Return words for a disk with `free` bytes, of which `kept` must stay free."""
    return f"its disk has {free / 1e6:.1f} MB free, and {kept / 1e6:.1f} MB must stay so: free some space"


class Unwritten(NamedTuple):
    """A message to be written as a record."""

    frames: Sequence[Any]
    session: bytes
    seq: int
    client: str = ""  # name of the sender, at most 32 bytes of UTF-8


class Journal:
    """The only writer of a folder of segments.

    Args:
        folder: made if absent.
        segment_bytes: a segment larger than this is closed, and the next one is opened.
        sync: wait for the disk at each append (fdatasync); without this a power cut may lose the tail.
        min_free_bytes: bytes that `append` leaves free on the disk.
        keep_open: keep the files of closed segments open, so that `read_kept` finds their records after
            somebody deletes the folder.
        longest_wait: seconds that one call spends on putting back a removed segment. Then it raises
            JournalError, and the next call continues.
        watch: called often while the segments of earlier runs are read; an exception from it ends the
            reading.

    Attributes:
        found: records in the segments of earlier runs, in journal order; the caller may empty the list.
        damaged: number of their damaged records. A completely damaged segment counts as one.
        absent: number of segments missing at the start between existing ones.
        missing: numbers of segments that somebody has removed since, by the last check.
        put_back: number of times that the open segment was removed and written again.

    Raises:
        JournalError: the folder cannot be made or listed, or a segment cannot be read or is of another
            version. Ignoring such a segment would lose its records for ever.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        segment_bytes: int,
        *,
        sync: bool = True,
        min_free_bytes: int = 0,
        keep_open: bool = False,
        longest_wait: float = math.inf,
        watch: ReadingWatcher = lambda _done, _all, _records: None,
    ) -> None:
        self.folder = Path(folder)
        self._segment_bytes = segment_bytes
        self._sync = sync
        self._room = FreeSpace(self.folder, min_free_bytes)
        self._keep_open = keep_open
        self._longest_wait = longest_wait
        self._putting_back: Iterator[None] | None = None  # the open segment, piece by piece
        self._open: OpenSegment | None = None
        self._kept: dict[int, OpenSegment] = {}  # by number, oldest first; the open one among them
        self._closed: dict[int, int] = {}  # bytes by number, oldest first
        self.found: list[RecordEntry] = []
        self.damaged = self.put_back = 0
        self.missing: list[int] = []
        with journal_errors("create the journal", self.folder):
            durable_files.make_folder(self.folder)
            durable_files.sweep(self.folder, _PARTS)
            self._home = os.stat(self.folder)
        self._recover(watch)

    def _recover(self, watch: ReadingWatcher) -> None:
        numbers = segments(self.folder)
        total = sum(durable_files.size_of(segment_path(self.folder, number)) for number in numbers)
        done = 0

        def note(at: int, records: int) -> None:
            watch(done + at, total, len(self.found) + records)

        for number in numbers:
            path = segment_path(self.folder, number)
            self._closed[number] = 0
            try:
                found, damaged = list_records(path, note)
                self._closed[number] = path.stat().st_size
            except OSError as error:
                raise _advise(journal_error("read", path, error)) from error
            except JournalError as error:
                raise _advise(error) from error
            self.found += found
            self.damaged += damaged
            done += self._closed[number]
        self._number = numbers[-1] + 1 if numbers else 1
        self.absent = self._number - self.first - len(numbers)

    @property
    def nbytes(self) -> int:
        """Bytes of all segments."""
        return sum(self._closed.values()) + (self._open.nbytes if self._open else 0)

    @property
    def first(self) -> int:
        """The number of the oldest segment; more than 1 = older segments were deleted."""
        return next(iter(self._closed), self._number)

    @property
    def segment(self) -> int:
        """The number of the segment that is, or will be, written."""
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
        """Write one message; it is on the disk when this returns. See `append_all`.

        Args:
            client: name of the sender, at most 32 bytes of UTF-8.
            logged_ns: wall clock; None = now.

        Raises:
            JournalError: as `append_all`.
        """
        return self.append_all([Unwritten(frames, session, seq, client)], logged_ns=logged_ns)[0]

    def append_all(self, messages: Sequence[Unwritten], *, logged_ns: int | None = None) -> list[Position]:
        """Write messages into one segment; one wait puts them on the disk before this returns.

        Args:
            logged_ns: wall clock; None = now.

        Raises:
            JournalError: the disk refuses, or too little space would stay free. No message counts as written
                then.
        """
        self._room.reserve(sum(memoryview(frame).nbytes for one in messages for frame in one.frames))
        self._keep_place()
        now_ns = mcap_layout.wall_clock_ns() if logged_ns is None else logged_ns
        offsets = [0]
        try:
            segment = self._begin()
            offsets = []
            for one in messages:
                offsets.append(segment.nbytes)
                segment.write(*one, now_ns)
            segment.sync()
        except OSError as error:
            self._abandon(offsets[0])
            raise journal_error("write", self.folder, error) from error
        except BaseException:  # interrupted in between
            self._abandon(offsets[0] if offsets else None)
            raise
        positions = [Position(self._number, offset) for offset in offsets]
        try:
            self._keep_place()  # a record in a file that readers cannot find is not acknowledged
        except BaseException:
            segment.take_back(offsets[0])  # the sender sends these messages again
            raise
        if self._open is not None and segment.nbytes >= self._segment_bytes:
            self._rotate_or_abandon()
        return positions

    def _begin(self) -> OpenSegment:
        if self._open is not None and self._open.is_over:
            self._abandon()
        if self._open is None:
            self.look()
            while self._open is None:
                path = segment_path(self.folder, self._number)
                try:
                    self._open = self._kept[self._number] = OpenSegment(path, sync=self._sync)
                except FileExistsError:  # somebody has put a file there
                    self._number += 1
            self._open.begin()
        return self._open

    def _rotate_or_abandon(self) -> None:
        """Close the full segment; only log an error, as its records are on the disk even without an index."""
        try:
            self.rotate()
        except OSError as error:
            log.warning("%s", journal_error("close", segment_path(self.folder, self._number), error))
            self._abandon()

    def rotate(self) -> None:
        """Close the segment with its index; the next append opens another."""
        if self._open is None:
            return
        self._open.finish()
        self._abandon()

    def close(self) -> None:
        """Finish the segment. Afterwards the journal can be read but not written.

        Raises:
            JournalError: the disk refuses, or the open segment was removed and cannot be put back.
        """
        self._longest_wait = math.inf
        try:
            self._keep_place()
            self.rotate()
        except OSError as error:
            raise journal_error("close", self.folder, error) from error
        finally:
            self._abandon()
            for number in list(self._kept):
                self._kept.pop(number).close()

    # --- files that are taken away ---

    def check(self) -> None:
        """Raise JournalError unless a record could be written: the folder exists and the disk has space."""
        self._keep_place()
        self.look()
        self._room.reserve(0)

    def look(self) -> None:
        """Look for removed segments (`missing`); raise JournalError if the folder is missing or was replaced.

        A folder without the segments may be the mount point of a disk that is away: records there could get
        lost.
        """
        there = set(segments(self.folder))
        missing = [number for number in self._closed if number not in there]
        for number in set(missing).difference(self.missing):
            log.error("%s is not there any more", segment_path(self.folder, number))
        self.missing = missing
        if missing and self.is_away:
            raise self._strange_folder()

    @property
    def is_away(self) -> bool:
        """True if the folder is missing, or an empty folder has replaced it. Any thread may ask."""
        return is_away(self.folder, self._home)

    def _strange_folder(self) -> JournalError:
        return JournalError(
            f"cannot write {self.folder}: none of its segments is there; put them back (is its disk "
            "mounted?), or restart to go on without them",
            errno.ENOENT,
        )

    def _keep_place(self) -> None:
        """Put the open segment back at its path if somebody removed it.

        Raises:
            JournalError: this cannot be done now. The file stays open, and nothing is lost yet.
        """
        segment = self._open
        if segment is None:
            return
        try:
            if segment.is_in_place:
                self._putting_back = None
                return
            here = os.stat(self.folder)
            if not segment.is_deleted and self.is_away:
                raise self._strange_folder()  # the segment was moved together with its folder
            self._put_back_some(segment)
        except OSError as error:
            self._putting_back = None
            raise journal_error("write", self.folder, error) from error
        self._putting_back = None
        self._home = here
        self.put_back += 1
        log.error(
            "%s was taken away while it was written to: it is written again, with all of its records",
            segment.path,
        )
        self._abandon()

    def _put_back_some(self, segment: OpenSegment) -> None:
        """Continue to put a segment back; raise JournalError after `longest_wait`: the next call goes on."""
        until = time.monotonic() + self._longest_wait
        self._putting_back = self._putting_back or segment.put_back()
        for _ in self._putting_back:
            if time.monotonic() > until:
                raise JournalError(
                    f"{segment.path} was taken away and is being put back: records wait until it is whole",
                    errno.EAGAIN,
                )

    def read_kept(self, position: Position) -> Record | None:
        """Read a record from its open file, even if that was moved; None if it is not open. For any thread.

        Raises:
            JournalError: the disk has lost the record.
        """
        segment = self._kept.get(position.segment)
        return segment.read(position.segment, position.offset) if segment else None

    def forget(self, number: int) -> None:
        """Delete a closed segment whose keyframes are stored elsewhere, such as on the server.

        Raises:
            JournalError: the disk refuses.
        """
        path = segment_path(self.folder, number)
        with journal_errors("delete", path):
            path.unlink(missing_ok=self.folder.exists())
            if path.exists():  # a network file system may say that what is there is not
                raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
        self._closed.pop(number, None)
        if number in self._kept:
            self._kept.pop(number).close()

    def erase(self, positions: Iterable[Position]) -> Iterator[int]:
        """Erase the bytes of records, a piece at a time; all other records keep their positions.

        Yields:
            The number of records erased so far; records of a segment that no longer exists count as erased.

        Raises:
            JournalError: the disk refuses, or a position has no record.
        """
        offsets: dict[int, set[int]] = {}
        for position in positions:
            offsets.setdefault(position.segment, set()).add(position.offset)
        erased = 0
        for number, places in sorted(offsets.items()):
            if self._open is not None and number == self._number:
                self._rotate_or_abandon()
            path = segment_path(self.folder, number)
            if path.exists():
                for count in erasing.erase(path, places):
                    yield erased + count
                self._closed[number] = durable_files.size_of(path)
            erased += len(places)
        yield erased

    def retire(self, below: int, limit: int) -> int:
        """Delete the oldest closed segments until the journal is no larger than `limit`.

        Args:
            below: segments from this number on stay, because their keyframes are stored nowhere else.
            limit: bytes of all segments.

        Returns:
            The bytes freed. A segment that cannot be deleted is logged and skipped.
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

    def _abandon(self, end: int | None = None) -> None:
        """Stop using the open segment. Bytes from `end` on are cut off: they were reported as not written."""
        segment, number = self._open, self._number
        if segment is None:
            return
        self._open = None
        self._number += 1
        self._closed[number] = 0
        with contextlib.suppress(OSError):
            self._closed[number] = segment.end(end)
            if end is not None and end <= segment.first:
                segment.path.unlink()
                self._number = number
                del self._closed[number]
        if not self._keep_open or number not in self._closed:
            self._kept.pop(number).close()
        elif len(self._kept) > _KEPT_OPEN:
            self._kept.pop(next(iter(self._kept))).close()


def write_file(path: Path, frames: Sequence[Any], *, session: bytes, seq: int, client: str = "") -> None:
    """Write one message into a file of its own in the form of a segment, completely or not at all.

    Raises:
        JournalError: the disk refuses.
    """
    identity, now_ns = secrets.token_bytes(mcap_layout.IDENTITY_BYTES), mcap_layout.wall_clock_ns()
    with journal_errors("write", path), durable_files.replacing(path) as file:
        writer = mcap_layout.begin_segment(file, identity, now_ns)
        payload = mcap_layout.pack_record(frames, identity, session, seq, client)
        mcap_layout.write_record(writer, payload, seq, now_ns)
        writer.finish()


def _advise(error: JournalError) -> JournalError:
    return JournalError(f"{error}; make it readable, or move it away to go on without its keyframes")
