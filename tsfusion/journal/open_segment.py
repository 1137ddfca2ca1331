# SPDX-License-Identifier: MIT
"""The segment that is written to: it must stay where readers look for it.

Somebody may delete, move or replace the file under the process that writes it. Its descriptor then still has
every record, so the file can be put back.
"""

import errno
import os
import secrets
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError
from tsfusion.journal import mcap_layout
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.segment_file import SegmentFile
from tsfusion.journal.segments import record_at

_COPY_BYTES = 4 << 20


class OpenSegment:
    """A new segment file. `read` may be called by another thread; all else by the one that writes.

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
