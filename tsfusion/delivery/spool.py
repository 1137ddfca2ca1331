# SPDX-License-Identifier: MIT
"""Keep records in a spool on the scanner's disk until the server has them on its own disk.

A spool is one session. Records left by a dead scanner are sent again under the session and numbers that the
server may already know. An emptied spool starts a new session. Reading from the page cache costs less than a
queue in memory, and limits memory.
"""

import contextlib
import logging
import os
import secrets
import shutil
import tempfile
from collections import deque
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from msgspec import Struct

from tsfusion import journal
from tsfusion.core.config import DEFAULT_MAP
from tsfusion.core.durable_files import size_of
from tsfusion.core.errors import MISSING, DecodeError, JournalError, refusals_as
from tsfusion.core.folder_lock import lock_folder
from tsfusion.core.readable_numbers import count_of
from tsfusion.wire.records.record_header import RecordHeader, is_correction, unpack

TOMBSTONES = "gone"
_NUMBER = np.dtype("<u8")
_SESSION_BYTES = 16


def buried(folder: Path, session: bytes) -> set[int] | None:
    """Return the numbers in a spool's file of tombstones; None if the file belongs to another session."""
    try:
        content = (folder / TOMBSTONES).read_bytes()
    except OSError:
        return set()
    if content[:_SESSION_BYTES] != session:
        return None
    whole = (len(content) - _SESSION_BYTES) // _NUMBER.itemsize
    return set(np.frombuffer(content, _NUMBER, whole, _SESSION_BYTES).tolist())


def _whole_bytes(size: int) -> int:
    """Return `size` without an incomplete number at the end of the file of tombstones."""
    numbers = (size - _SESSION_BYTES) // _NUMBER.itemsize
    return _SESSION_BYTES + numbers * _NUMBER.itemsize if size >= _SESSION_BYTES else 0


class Tombstones:
    """Numbers of records that left a spool unsent or refused, while a spool file still holds them.

    Without them, a scanner that starts after a crash would find these records and send them again. The file
    is not synced: if a power cut takes a number, its record is sent again. Errors of the disk are ignored.
    """

    def __init__(self, folder: Path, session: bytes) -> None:
        self._path = folder / TOMBSTONES
        self._session = session
        self.numbers = self._read()  # numbers in the file at the start
        self.written = len(self.numbers)  # count of the numbers in the file

    def _read(self) -> set[int]:
        found = buried(self._path.parent, self._session)
        if found is None:  # the file belongs to an earlier spool in this folder
            self.clear()
        return found or set()

    def add(self, seq: int) -> None:
        """Append a number to the file."""
        self._write([seq])

    def keep(self, numbers: Iterable[int]) -> None:
        """Rewrite the file with these numbers alone: spool files with the other records are deleted."""
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
                file.truncate(whole)  # a partial last number (full disk) would shift all later ones
                head = b"" if whole else self._session
                file.write(head + added.tobytes())
        except OSError as error:
            log.debug("%s cannot be written: %s", self._path, error.strerror)
        self.written += len(added)


log = logging.getLogger(__name__)

# A restarted scanner skips numbers: numbers of records lost in a power cut must never be used again. The
# count is random, so that two scanners with copies of one spool do not use the same numbers. Else each would
# take the answer to the other's keyframe for its own, and silently lose a keyframe.
_RESTART_GAP = 1024
_RESTART_SPREAD = 1 << 24
_MANY_TOMBSTONES = 65536  # numbers before those of deleted files are forgotten
_LOOK_SECONDS = 0.2  # another process may hold the lock this long just to test it
_RECORD_OVERHEAD = 512  # what MCAP adds to a keyframe, its share of the index at the end included


class Waiting(Struct, frozen=True, gc=False):
    """Entry for a keyframe or correction in the spool, which the server does not have yet."""

    seq: int
    position: journal.Position
    nbytes: int
    is_correction: bool = False

    @property
    def kind(self) -> str:
        return "correction" if self.is_correction else "keyframe"


class Segment(Struct):
    """One file of the spool: its size and its number of waiting records."""

    nbytes: int = 0  # on the disk
    waiting: int = 0  # records in it that wait
    withdrawn: list[int] = []  # numbers of the records in it that left the spool unsent or refused


class Spool:
    """A folder of unacknowledged keyframes and corrections, oldest first. One process at a time.

    Threads: `write` and `tidy` may run in one thread while another calls anything else; the rest is not
    thread-safe.

    Args:
        folder: None = a temporary folder, deleted with its contents at `close`.
        world: name of the poses' coordinate frame, empty = poses given from elsewhere; None = the frame of
            the waiting records. Waiting records without a name take this name.
        same_frame: the frame is declared to be the map's; waiting records may have declared it before.
        elsewhere: send waiting records for another map to this map.

    Raises:
        JournalError: the folder cannot be used, another scanner uses it, or its waiting records are for
            another map or world.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str] | None,
        segment_bytes: int,
        *,
        map_name: str = DEFAULT_MAP,
        world: str | None = None,
        same_frame: bool = False,
        elsewhere: bool = False,
    ) -> None:
        self.temporary, self._pid = folder is None, os.getpid()
        self.map_name = map_name
        self.world, self.same_frame = world or "", same_frame
        self.folder = _temporary_folder() if folder is None else Path(folder)
        self._lock = lock_folder(self.folder, "spool", "scanner", wait=_LOOK_SECONDS)
        if os.path.exists(old := self.folder / "corrections.tsc"):
            log.warning(
                "%s holds corrected poses as an earlier development version kept them: it is not read; "
                "delete it to silence this",
                old,
            )
        try:
            self._open(segment_bytes)
            if (left := self._first_left()) is not None:
                self._take_over(left, world, elsewhere=elsewhere)
        except JournalError:
            self._lock.close()
            raise

    def _open(self, segment_bytes: int) -> None:
        self._journal = journal.Journal(self.folder, segment_bytes, sync=not self.temporary, keep_open=True)
        found, self._journal.found = self._journal.found, []
        self.damaged = self._journal.damaged  # waiting records that can no longer be read
        sessions = {record.session for record in found} or {secrets.token_bytes(_SESSION_BYTES)}
        if len(sessions) > 1:
            raise JournalError(f"{self.folder} holds keyframes of {len(sessions)} sessions: not one spool")
        self.session = sessions.pop()
        self._tombstones = Tombstones(self.folder, self.session)
        self._compact_at = 2 * self._tombstones.written + _MANY_TOMBSTONES
        numbers = {*journal.segments(self.folder), *(record.position.segment for record in found)}
        self._segments = {
            number: Segment(size_of(journal.segment_path(self.folder, number))) for number in sorted(numbers)
        }
        self.waiting: deque[Waiting] = deque()  # oldest first
        for record in found:
            segment = self._segments[record.position.segment]
            if record.seq in self._tombstones.numbers:
                segment.withdrawn.append(record.seq)
            else:
                segment.waiting += 1
                place = (record.seq, record.position, record.nbytes)
                self.waiting.append(Waiting(*place, record.is_correction))
        self.waiting_bytes = sum(entry.nbytes for entry in self.waiting)
        self.corrections = sum(entry.is_correction for entry in self.waiting)  # that wait
        self._newest: tuple[journal.Position, list[bytes]] | None = None  # the record that was just written
        last = max([record.seq for record in found] + [*self._tombstones.numbers], default=0)
        self.left = last  # the last number that an earlier scanner used; 0 = there was none
        self.next_seq = last + _RESTART_GAP + secrets.randbelow(_RESTART_SPREAD) if last else 1
        self._idle = {number for number, segment in self._segments.items() if not segment.waiting}
        # On the disk: records that have left the queue but share a file with others count
        self.used_bytes = sum(segment.nbytes for segment in self._segments.values())

    def _take_over(self, left: RecordHeader, world: str | None, *, elsewhere: bool) -> None:
        """Continue the session of a dead scanner's records. Raises JournalError for another map or world."""
        held = f"{self.folder} holds {count_of(len(self.waiting), 'keyframe')}"
        if left.map != self.map_name and not elsewhere:
            raise JournalError(
                f"{held} for the map {left.map}, not for {self.map_name}: send them first "
                f"(a client with map={left.map!r}), or use another spool folder"
            )
        if world is not None and left.world not in ("", world):
            raise JournalError(
                f"{held} of another world, {left.world}: send them first (`tsfusion spool send`), or use "
                "another spool folder"
            )
        self.world, self.same_frame = world or left.world, self.same_frame or left.same_frame

    def _first_left(self) -> RecordHeader | None:
        """Return the header of the first readable record of a dead scanner; None without one."""
        for entry in self.waiting:
            try:
                return unpack(self.read(entry)[0])
            except (JournalError, DecodeError, IndexError):
                continue  # found again and reported when it is sent
        return None

    def write(self, frames: list[bytes]) -> Waiting:
        """Write the encoded record number `next_seq` to the disk. It counts only after `add`.

        Raises:
            JournalError: the disk refuses. The number is not used again: if the disk still holds the failed
                record, that record must not stand for another.
        """
        seq = self.next_seq
        self.next_seq += 1
        try:
            position = self._journal.append(frames, session=self.session, seq=seq)
        except JournalError:
            self._tombstones.add(seq)
            raise
        self._newest = position, frames
        return Waiting(seq, position, sum(map(len, frames)), is_correction(frames[0]))

    def add(self, entry: Waiting) -> None:
        """Queue a record that `write` has written, so that it is sent."""
        self.waiting.append(entry)
        self.waiting_bytes += entry.nbytes
        self.corrections += entry.is_correction
        number = entry.position.segment
        segment = self._segments.setdefault(number, Segment())
        segment.waiting += 1
        end = entry.position.offset + entry.nbytes + _RECORD_OVERHEAD
        self.used_bytes += end - segment.nbytes
        segment.nbytes = end
        self._idle.discard(number)

    def read(self, entry: Waiting) -> list[memoryview]:
        """Return the frames of a record, even if this process has deleted its file since.

        Raises:
            JournalError: the disk has lost the record.
        """
        newest = self._newest
        if newest is not None and newest[0] == entry.position:
            return [memoryview(frame) for frame in newest[1]]
        try:
            return journal.read(self.folder, entry.position).frames
        except JournalError as error:
            kept = self._journal.read_kept(entry.position) if error.errno in MISSING else None
            if kept is None:
                raise
            return kept.frames

    @property
    def is_away(self) -> bool:
        """True if the folder is missing, or an empty folder has replaced it. From any thread."""
        return self._journal.is_away

    def drop(self, durable: int) -> list[Waiting]:
        """Remove all records up to number `durable` from the queue; return them."""
        dropped = []
        while self.waiting and self.waiting[0].seq <= durable:
            dropped.append(self._let_go(0))
        if dropped:
            self._delete_segments()
        return dropped

    def remove(self, place: int) -> None:
        """Remove one record that the server does not have, by its index in the queue."""
        entry = self._let_go(place)
        self._segments[entry.position.segment].withdrawn.append(entry.seq)
        self._tombstones.add(entry.seq)
        self._delete_segments()
        if self._tombstones.written > self._compact_at:
            self._tombstones.keep(seq for segment in self._segments.values() for seq in segment.withdrawn)
            self._compact_at = 2 * self._tombstones.written + _MANY_TOMBSTONES

    def tidy(self) -> None:
        """Delete files of removed records that could not be deleted at once. For the writing thread."""
        self._delete_segments(self._journal.segment)

    def _let_go(self, place: int) -> Waiting:
        entry = self.waiting[place]
        del self.waiting[place]
        self.waiting_bytes -= entry.nbytes
        self.corrections -= entry.is_correction
        segment = self._segments[entry.position.segment]
        segment.waiting -= 1
        if not segment.waiting:
            self._idle.add(entry.position.segment)
        return entry

    def _delete_segments(self, below: int | None = None) -> None:
        # The newest stays: it may hold a record that `write` has written and `add` has not queued yet.
        newest = next(reversed(self._segments), 0)
        self._forget(n for n in self._idle if n < (newest if below is None else below))

    def _forget(self, numbers: Iterable[int]) -> bool:
        """Delete segments (files), oldest first, up to one that cannot be deleted; return False in this case.

        Records of a kept segment are only sent once more, and the server recognises them. Deleting newer
        segments would give the next scanner a wrong last number.
        """
        for number in sorted(numbers):
            try:
                self._journal.forget(number)
            except JournalError as error:
                if error.errno not in MISSING:  # else the folder is missing and may come back
                    log.warning("%s", error)
                return False
            self.used_bytes -= self._segments.pop(number).nbytes
            self._idle.discard(number)
        return True

    def close(self) -> None:
        """Release the folder. Delete the files of an empty spool, so that the next scan starts a new session.

        Does nothing in a process forked from the one that opened the spool.
        """
        if os.getpid() != self._pid:
            return
        try:
            self._journal.close()
        except JournalError as error:
            if self.waiting and self.is_away:
                lost = count_of(len(self.waiting), "record is", "records are")
                log.error("%s not in the spool any more: %s", lost, error)
            else:  # the last file lacks only its index
                log.warning("%s", error)
        if self.temporary:
            shutil.rmtree(self.folder, ignore_errors=True)
        elif not self.waiting and self._forget(self._segments):
            self._tombstones.clear()
        self._lock.close()


def _temporary_folder() -> Path:
    with refusals_as(JournalError, "cannot make a temporary spool", "name a folder"):
        return Path(tempfile.mkdtemp(prefix="tsfusion-spool-"))
