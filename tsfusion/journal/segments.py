# SPDX-License-Identifier: MIT
"""List and write the segment files of a journal, and read single records of them."""

import errno
import logging
import os
import re
import secrets
import stat
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any

from msgspec import Struct

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError, reason_of
from tsfusion.journal import mcap_layout
from tsfusion.journal.locations import RemoteFile
from tsfusion.journal.mcap_layout import Position, Record

log = logging.getLogger(__name__)

_SECTOR_BYTES = 1 << 16


def _at_once(path: str, flags: int) -> int:
    """Open a file as `open` does, but refuse a pipe, which would be waited for without end."""
    if stat.S_ISFIFO(os.stat(path).st_mode):
        raise OSError(errno.EINVAL, "it is a pipe, not a file")
    return os.open(path, flags)


class SegmentFile:
    """A segment file at its present length: bytes that a writer adds later are not seen.

    Args:
        on_read: called before each read, because a large file takes long.
        descriptor: an open descriptor of the file, closed together with this object; None = open the path.

    Raises:
        OSError: as `open` raises it.
    """

    def __init__(
        self, path: Path, on_read: Callable[[], None] = lambda: None, *, descriptor: int | None = None
    ) -> None:
        self.path = path
        self._on_read = on_read
        self._file: FileIO | RemoteFile
        is_here = descriptor is not None or isinstance(path, Path)  # a URL's path only has the methods of one
        if not is_here:
            self._file = RemoteFile(path)
            self.size = self._file.size
        else:
            self._file = (
                FileIO(path, "rb", opener=_at_once) if descriptor is None else FileIO(descriptor, "rb")
            )
            self.size = os.fstat(self._file.fileno()).st_size
        self.failed = False  # a read of some bytes failed
        self.answered = False  # a read of some bytes succeeded

    def __enter__(self) -> "SegmentFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, at: int, count: int, end: int | None = None) -> bytes:
        """Return up to `count` bytes from offset `at` that lie before offset `end` (default: the file's end).

        Bytes that the disk cannot read are returned as zeros: then only the CRC of their record fails.
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


def segment_number(path: Path) -> int:
    """Return the number in a segment file's name, or 0 for any other name."""
    return int(path.stem) if re.fullmatch(r"[0-9]{6,9}", path.stem) else 0


def journal_error(verb: str, path: Path, error: OSError) -> JournalError:
    """Return a JournalError for an error of the disk: `cannot read FILE: reason`."""
    return JournalError(f"cannot {verb} {path}: {reason_of(error)}", error.errno or errno.EIO)


@contextmanager
def journal_errors(verb: str, path: Path) -> Iterator[None]:
    """Raise an OSError of the block as `journal_error`."""
    try:
        yield
    except OSError as error:
        raise journal_error(verb, path, error) from error


class RecordEntry(Struct, frozen=True):
    """Facts about a record without its content, for a list in memory."""

    position: Position
    session: bytes
    seq: int
    client: str
    nbytes: int
    is_correction: bool = False
    world: str = ""  # coordinate frame, by the record's header
    is_erased: bool = False
    is_clear: bool = False  # erased, and none of its old bytes is left
    logged_ns: int = 0  # wall clock; 0 for an erased record


def segments(folder: Path) -> list[int]:
    """Return the numbers of a folder's segments, oldest first; files with other names are ignored.

    Raises:
        JournalError: the folder cannot be listed.
    """
    with journal_errors("list", folder):
        names = [path.name for path in folder.iterdir()]
    return sorted(
        int(name[:-5])
        for name in names
        if re.fullmatch(r"[0-9]{6}|[1-9][0-9]{6,8}", name[:-5]) and name.endswith(".mcap")
    )


def is_away(folder: Path, home: os.stat_result | None) -> bool:
    """Return True if a folder of segments is missing, or an empty folder has replaced it; it may come back.

    Args:
        home: the `stat` of the original folder; None = there was no folder.
    """
    try:
        return (home is None or not os.path.samestat(os.stat(folder), home)) and not segments(folder)
    except (JournalError, OSError):
        return True


def segment_path(folder: Path, number: int) -> Path:
    """Return the file of a segment."""
    return folder / f"{number:06d}.mcap"


def read(folder: Path, position: Position) -> Record:
    """Return one record by its position, even while its segment is being written.

    Raises:
        JournalError: there is no record, or its CRC differs.
    """
    return read_at(segment_path(folder, position.segment), position.offset)


def logged_ns(folder: Path, position: Position) -> int:
    """Return the wall clock time of a record by its position; only its head is read, and no CRC is checked.

    Raises:
        JournalError: there is no record.
    """
    path = segment_path(folder, position.segment)
    with journal_errors("read", path), SegmentFile(path) as source:
        head = mcap_layout.parse_head(source.read(position.offset, mcap_layout.HEAD_BYTES))
    if head is None:
        raise JournalError(f"{path} holds no whole keyframe at byte {position.offset}")
    return head.logged_ns


def read_at(path: Path, offset: int) -> Record:
    """Return one record of a segment file.

    Raises:
        JournalError: there is no record, or its CRC differs; with an `errno` if the system refuses.
    """
    with journal_errors("read", path):
        source = SegmentFile(path)
    with source:
        return record_at(source, segment_number(path), offset)


class SegmentReader:
    """Reads records of segments. A segment stays open until a record of another segment is read."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._open = ExitStack()

    def __enter__(self) -> "SegmentReader":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def at(self, path: Path, offset: int) -> Record:
        """Return one record of a segment file; raises JournalError like `read_at`."""
        if path != self._path:
            self._open.close()
            self._path = None
            with journal_errors("read", path):
                self._source = self._open.enter_context(SegmentFile(path))
            self._path = path
        return record_at(self._source, segment_number(path), offset)


def record_at(source: SegmentFile, number: int, offset: int) -> Record:
    """Return one record of an open segment file of this number; raises JournalError like `read_at`."""
    with journal_errors("read", source.path):
        start = source.read(offset, mcap_layout.HEAD_BYTES)
        head = mcap_layout.parse_head(start)
        raw = b"" if head is None else source.read(offset, head.nbytes)
        record = mcap_layout.parse_record(raw, Position(number, offset))
        if record is None and source.failed:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
    if record is None and mcap_layout.parse_erased(start) is not None:
        raise JournalError(f"the keyframe at byte {offset} of {source.path} was erased", is_erased=True)
    if record is None:
        raise JournalError(f"{source.path} holds no whole keyframe at byte {offset}")
    return record


def is_segment(path: Path) -> bool:
    """Return True for an `.mcap` file of a journal, damaged or not; False for another program's recording."""
    if path.suffix != ".mcap":
        return False
    try:
        with SegmentFile(path) as file:
            opening = file.read(0, len(mcap_layout.OPENING))
    except OSError:  # whoever reads the file reports the error
        return True
    is_whole = len(opening) == len(mcap_layout.OPENING) and opening.startswith(mcap_layout.MAGIC)
    return opening == mcap_layout.OPENING or not is_whole


_COPY_BYTES = 4 << 20


class OpenSegment:
    """A new segment file. Any thread may call `read`; only the writing thread calls the other methods.

    Another process may delete, move or replace the file during the writing. The open descriptor then still
    has every record, so the file can be put back.

    Args:
        sync: wait for the disk at each append.

    Raises:
        FileExistsError: the file exists already.
        OSError: the disk refuses.
    """

    def __init__(self, path: Path, *, sync: bool) -> None:
        self.path = path
        self.first = 0  # offset of the first record; 0 = nothing is written yet
        self.is_over = False  # a record was taken back: the writer must open another segment
        self._sync = sync
        self._identity = secrets.token_bytes(mcap_layout.IDENTITY_BYTES)
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        self._closing = threading.Lock()  # else a reader's descriptor number could be reused for another file
        self._file = open(self._descriptor, "wb", closefd=False)  # noqa: SIM115
        self._writer: Any = None
        self._is_known_by_inode = True

    def begin(self) -> None:
        """Write the bytes before the first record; they are on the disk when this returns."""
        self._writer = mcap_layout.begin_segment(self._file, self._identity, mcap_layout.wall_clock_ns())
        # Flushed before the first record: a cut of the file's end then never loses the identity.
        self._flush()
        if self._sync:
            durable_files.sync_folder(self.path.parent)
        self.first = self._file.tell()
        # Some network file systems give a new inode number at each `stat`
        self._is_known_by_inode = os.path.samestat(os.stat(self.path), os.fstat(self._descriptor))

    @property
    def nbytes(self) -> int:
        """Number of bytes written."""
        return self._file.tell()

    def write(self, frames: Sequence[Any], session: bytes, seq: int, client: str, now_ns: int) -> None:
        """Write one record; it is on the disk after the next `sync`.

        Raises:
            OSError: the disk refuses; the file may then hold a part of the record.
        """
        payload = mcap_layout.pack_record(frames, self._identity, session, seq, client)
        mcap_layout.write_record(self._writer, payload, seq, now_ns)

    def sync(self) -> None:
        """Wait until the disk has every record; raises OSError like `write`."""
        self._flush()

    def take_back(self, at: int) -> None:
        """Cut off the records from offset `at` on, if the disk allows it, and end the writing."""
        self.is_over = True
        with suppress(OSError):
            os.ftruncate(self._descriptor, at)
            os.fsync(self._descriptor)

    def finish(self) -> None:
        """Write the index, unless `take_back` was called."""
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
        """True if the path leads to this file; raises OSError if the system cannot tell."""
        try:
            there = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return False
        return not self._is_known_by_inode or os.path.samestat(there, os.fstat(self._descriptor))

    @property
    def is_deleted(self) -> bool:
        """True if no path leads to this file any more."""
        return os.fstat(self._descriptor).st_nlink == 0

    def put_back(self) -> Iterator[None]:
        """Write the file again at its path, one piece per step. A file found at the path is kept as
        NAME.replaced.

        Raises:
            OSError: the disk refuses; nothing has changed then, and the caller may try again.
        """
        with durable_files.replacing(self.path) as copy:
            at = 0
            while part := os.pread(self._descriptor, _COPY_BYTES, at):
                copy.write(part)
                copy.flush()
                os.fdatasync(copy.fileno())  # so that the final sync waits for one piece only
                at += len(part)
                yield
            copy.truncate(os.fstat(self._descriptor).st_size)  # a record may have been taken back meanwhile
            with suppress(FileNotFoundError):
                self.path.rename(self.path.with_name(f"{self.path.name}.replaced"))

    def read(self, number: int, offset: int) -> Record:
        """Return one record by the open descriptor, even if the file was moved or deleted.

        Raises:
            JournalError: there is no record, or the file is closed.
        """
        with self._closing:
            if self._descriptor < 0:
                raise JournalError(f"{self.path} is closed", errno.EBADF)
            descriptor = os.dup(self._descriptor)
        with SegmentFile(self.path, descriptor=descriptor) as source:
            return record_at(source, number, offset)

    # --- its end ---

    def end(self, cut: int | None = None) -> int:
        """Stop writing; return the size of the file, which can still be read.

        Args:
            cut: bytes from this offset on are cut off; they were reported as not written.
        """
        with suppress(OSError):  # a full disk fails here a second time
            self._file.close()
        with suppress(OSError):
            if cut is not None:
                os.ftruncate(self._descriptor, cut)
                os.fsync(self._descriptor)
        return os.fstat(self._descriptor).st_size

    def close(self) -> None:
        """Close the file."""
        with self._closing, suppress(OSError):
            descriptor, self._descriptor = self._descriptor, -1
            os.close(descriptor)
