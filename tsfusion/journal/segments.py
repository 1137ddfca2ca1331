# SPDX-License-Identifier: MIT
"""A folder of segments, the records in it, and the segment that is written to."""

import errno
import logging
import os
import re
import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from msgspec import Struct

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError
from tsfusion.core.readable_numbers import count_of
from tsfusion.journal import mcap_layout, record_scan
from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.record_scan import (
    Damage,
    Erased,
    SegmentFile,
    journal_error,
    scan_records,
    segment_number,
)

log = logging.getLogger(__name__)


class RecordEntry(Struct, frozen=True):
    """A record without its frames, as a list of a journal holds it."""

    position: Position
    session: bytes
    seq: int
    client: str
    nbytes: int
    is_correction: bool = False
    world: str = ""  # as its header names it
    is_erased: bool = False


def segments(folder: Path) -> list[int]:
    """The numbers of a folder's segments, oldest first. Files with other names are passed over.

    Raises:
        JournalError: when the folder cannot be listed.
    """
    try:
        names = [path.name for path in folder.iterdir()]
    except OSError as error:
        raise journal_error("list", folder, error) from error
    return sorted(
        int(name[:-5])
        for name in names
        if re.fullmatch(r"[0-9]{6}|[1-9][0-9]{6,8}", name[:-5]) and name.endswith(".mcap")
    )


def is_away(folder: Path, home: os.stat_result | None) -> bool:
    """True if a folder of segments is not to be found, or an empty one is in its place: it may come back.

    Args:
        home: of the folder as it was; None = it was not there.
    """
    try:
        return (home is None or not os.path.samestat(os.stat(folder), home)) and not segments(folder)
    except (JournalError, OSError):
        return True


def segment_path(folder: Path, number: int) -> Path:
    """The file of a segment."""
    return folder / f"{number:06d}.mcap"


def read(folder: Path, position: Position) -> Record:
    """One record by its position, also while its segment is being written.

    Raises:
        JournalError: when it is not there or its CRC differs.
    """
    return read_at(segment_path(folder, position.segment), position.offset)


def logged_ns(folder: Path, position: Position) -> int:
    """Wall clock of a record by its position; only the first bytes of it are read, and none is checked.

    Raises:
        JournalError: when it is not there.
    """
    path = segment_path(folder, position.segment)
    try:
        with SegmentFile(path) as source:
            head = mcap_layout.parse_head(source.read(position.offset, mcap_layout.HEAD_BYTES))
    except OSError as error:
        raise journal_error("read", path, error) from error
    if head is None:
        raise JournalError(f"{path} holds no whole keyframe at byte {position.offset}")
    return head.logged_ns


def read_at(path: Path, offset: int) -> Record:
    """One record of a segment file.

    Raises:
        JournalError: when it is not there or its CRC differs, or with an `errno` when the system refuses.
    """
    try:
        source = SegmentFile(path)
    except OSError as error:
        raise journal_error("read", path, error) from error
    with source:
        return record_at(source, segment_number(path), offset)


def has_another(folder: Path, session: bytes, seq: int, position: Position, *, until_ns: int) -> bool:
    """True if a journal has another record where it had this one. Damage and missing files show nothing.

    Args:
        until_ns: when the journal had it: one that was logged later begins a journal anew.
    """
    path = segment_path(folder, position.segment)
    with suppress(JournalError):
        found = read_at(path, position.offset)
        return (found.session, found.seq) != (session, seq) and found.logged_ns <= until_ns
    with suppress(JournalError):
        own = (one for one in scan_records(path) if 0 < position.offset - one.position.offset < one.nbytes)
        return any(
            isinstance(one, Erased) or (isinstance(one, Record) and one.logged_ns <= until_ns) for one in own
        )
    return False


class SegmentReader:
    """Records of segments, one after the other: a segment stays open until one of another is read."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._open = ExitStack()

    def __enter__(self) -> "SegmentReader":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def at(self, path: Path, offset: int) -> Record:
        """One record of a segment file; raises JournalError as `read_at`."""
        if path != self._path:
            self._open.close()
            self._path = None
            try:
                self._source = self._open.enter_context(SegmentFile(path))
            except OSError as error:
                raise journal_error("read", path, error) from error
            self._path = path
        return record_at(self._source, segment_number(path), offset)


def record_at(source: SegmentFile, number: int, offset: int) -> Record:
    """One record of the open segment file of this number; raises JournalError as `read_at`."""
    try:
        start = source.read(offset, mcap_layout.HEAD_BYTES)
        head = mcap_layout.parse_head(start)
        raw = b"" if head is None else source.read(offset, head.nbytes)
        record = mcap_layout.parse_record(raw, Position(number, offset))
        if record is None and source.failed:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
    except OSError as error:
        raise journal_error("read", source.path, error) from error
    if record is None and mcap_layout.parse_erased(start) is not None:
        raise JournalError(f"the keyframe at byte {offset} of {source.path} was erased", is_erased=True)
    if record is None:
        raise JournalError(f"{source.path} holds no whole keyframe at byte {offset}")
    return record


def list_records(
    path: Path,
    watch: Callable[[int, int], None] = lambda _at, _records: None,
    damaged: Callable[[Damage], None] = lambda _damage: None,
) -> tuple[list[RecordEntry], int]:
    """Every whole or erased record of a segment, and how many keyframes are lost to damage between them.

    A torn tail was never acknowledged and does not count as damage. Each damaged place is logged.

    Args:
        watch: called at each read with the byte that the list has come to, and its records so far.

    Raises:
        JournalError: when the file cannot be opened or read.
    """
    found: list[RecordEntry] = []
    at = lost = 0

    def note() -> None:
        watch(at, len(found))

    for step in scan_records(path, note):
        at = step.position.offset
        if isinstance(step, Erased):
            place = (step.position, step.session, step.seq, step.client)
            found.append(RecordEntry(*place, step.nbytes, is_erased=True))
            if not step.is_clear:
                log.warning("%s", describe(path, step))
        elif isinstance(step, Damage):
            lost += step.lost
            damaged(step)
            level = logging.ERROR if step.lost else logging.WARNING
            log.log(level, "%s", describe(path, step))
        else:
            place = (step.position, step.session, step.seq, step.client)
            found.append(RecordEntry(*place, step.nbytes, step.is_correction, step.world))
    return found, lost


def describe(path: Path, damage: Damage) -> str:
    """Describe a damaged place in one line."""
    if damage.torn:
        outcome = "; nothing that was acknowledged is lost"
    else:
        lost = count_of(damage.lost, "keyframe is", "keyframes are")
        outcome = f"; {lost} lost" if damage.lost else "; no keyframe is lost"
    return f"{path}, byte {damage.position.offset}: {damage.what}{outcome}"


def is_segment(path: Path) -> bool:
    """True for an `.mcap` file of a journal, damaged or not, and False for another program's recording."""
    if path.suffix != ".mcap":
        return False
    try:
        with SegmentFile(path) as file:
            opening = file.read(0, len(mcap_layout.OPENING))
    except OSError:  # to be reported by who reads it
        return True
    is_whole = len(opening) == len(mcap_layout.OPENING) and opening.startswith(mcap_layout.MAGIC)
    return opening == mcap_layout.OPENING or not is_whole


def is_closed(path: Path) -> bool:
    """True if a segment ends with an index, as normal MCAP readers need it; False when it cannot be read."""
    try:
        with SegmentFile(path) as source:
            return record_scan.read_segment_end(source).state == "whole"
    except OSError:
        return False


def records(path: Path) -> Iterator[Record]:
    """The whole records of one segment file.

    Raises:
        JournalError: when the file cannot be opened or read.
    """
    return (step for step in scan_records(path) if isinstance(step, Record))


_COPY_BYTES = 4 << 20


class OpenSegment:
    """A new segment file. `read` may be called by another thread; all else by the one that writes.

    Somebody may delete, move or replace the file under the process that writes it. Its descriptor then still
    has every record, so the file can be put back.

    Args:
        sync: wait for the disk at each append.

    Raises:
        FileExistsError: when there is such a file.
        OSError: when the disk refuses.
    """

    def __init__(self, path: Path, *, sync: bool) -> None:
        self.path = path
        self.first = 0  # where the first record starts; 0 = the segment is not begun
        self.is_over = False  # a record was taken back: another segment has to be begun
        self._sync = sync
        self._identity = secrets.token_bytes(mcap_layout.IDENTITY_BYTES)
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        self._closing = threading.Lock()  # a reader's descriptor must not become another file's
        self._file = open(self._descriptor, "wb", closefd=False)  # noqa: SIM115
        self._writer: Any = None
        self._is_known_by_inode = True

    def begin(self) -> None:
        """Write what comes before the first record; it is on the disk when this returns."""
        self._writer = mcap_layout.begin_segment(self._file, self._identity, mcap_layout.wall_clock_ns())
        # Before the first record: what a reader needs to find its way is never the end that a cut takes.
        self._flush()
        if self._sync:
            durable_files.sync_folder(self.path.parent)
        self.first = self._file.tell()
        # Some network file systems draw a new inode number at each look
        self._is_known_by_inode = os.path.samestat(os.stat(self.path), os.fstat(self._descriptor))

    @property
    def nbytes(self) -> int:
        """Bytes that were written."""
        return self._file.tell()

    def write(self, frames: Sequence[Any], session: bytes, seq: int, client: str, now_ns: int) -> None:
        """Write one record; it is on the disk after the next `sync`.

        Raises:
            OSError: when the disk refuses; a part of the record may be there.
        """
        payload = mcap_layout.pack_record(frames, self._identity, session, seq, client)
        mcap_layout.write_record(self._writer, payload, seq, now_ns)

    def sync(self) -> None:
        """Wait until the disk has every record; raises OSError as `write`."""
        self._flush()

    def take_back(self, at: int) -> None:
        """Cut off the records from this place on, as far as the disk allows. None can be written any more."""
        self.is_over = True
        with suppress(OSError):
            os.ftruncate(self._descriptor, at)
            os.fsync(self._descriptor)

    def finish(self) -> None:
        """Write the index; a segment from which a record was taken back has none."""
        if self.is_over:
            return
        self._writer.finish()
        self._flush()

    def _flush(self) -> None:
        self._file.flush()
        if self._sync:
            os.fdatasync(self._descriptor)

    # --- its place ---

    @property
    def is_in_place(self) -> bool:
        """True if the path leads to this file; raises OSError when the system does not say."""
        try:
            there = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return False
        return not self._is_known_by_inode or os.path.samestat(there, os.fstat(self._descriptor))

    @property
    def is_deleted(self) -> bool:
        """True if no path at all leads to this file any more."""
        return os.fstat(self._descriptor).st_nlink == 0

    def put_back(self) -> Iterator[None]:
        """Write the file again where it was, a piece a step. What lies there then is kept as NAME.replaced.

        Raises:
            OSError: when the disk refuses; nothing has changed then, and it can be tried again.
        """
        with durable_files.replacing(self.path) as copy:
            at = 0
            while part := os.pread(self._descriptor, _COPY_BYTES, at):
                copy.write(part)
                copy.flush()
                os.fdatasync(copy.fileno())  # so that the end has to wait for no more than a piece either
                at += len(part)
                yield
            copy.truncate(os.fstat(self._descriptor).st_size)  # a record may have been taken back meanwhile
            with suppress(FileNotFoundError):
                self.path.rename(self.path.with_name(f"{self.path.name}.replaced"))

    def read(self, number: int, offset: int) -> Record:
        """One record by its descriptor, wherever the file is.

        Raises:
            JournalError: when it is not there, or the file is closed.
        """
        with self._closing:
            if self._descriptor < 0:
                raise JournalError(f"{self.path} is closed", errno.EBADF)
            descriptor = os.dup(self._descriptor)
        with SegmentFile(self.path, descriptor=descriptor) as source:
            return record_at(source, number, offset)

    # --- its end ---

    def end(self, cut: int | None = None) -> int:
        """Write no more; its size. It can still be read.

        Args:
            cut: bytes behind this place go; they were reported as not written.
        """
        with suppress(OSError):  # a full disk fails here a second time
            self._file.close()
        with suppress(OSError):
            if cut is not None:
                os.ftruncate(self._descriptor, cut)
                os.fsync(self._descriptor)
        return os.fstat(self._descriptor).st_size

    def close(self) -> None:
        """Release the file."""
        with self._closing, suppress(OSError):
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)
