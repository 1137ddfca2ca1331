# SPDX-License-Identifier: MIT
"""Store keyframes that could not be used, one per file, so that a person can inspect them.

A server stores the keyframes that it could not fuse. A scanner stores those that the server refused.
"""

import logging
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from tsfusion import journal
from tsfusion.core import durable_files, logs
from tsfusion.core.errors import JournalError
from tsfusion.core.number_ranges import NumberRanges

log = logging.getLogger(__name__)

_MAX_FILES = 1000
_FILE_NAME = re.compile(r"([0-9a-f]{8})-([0-9]+)-([a-z0-9_]+)\.mcap")
_MAX_REASON_LENGTH = 32


class Quarantine:
    """A folder of `SESSION-SEQ-REASON.mcap` files. Beyond `max_bytes` or 1000 files, the oldest are deleted.

    The folder is read once, at the start: files removed later by hand still count.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self._max_bytes = max_bytes
        self.problem = ""  # why a keyframe was not kept, or old ones are deleted; empty = no problem
        durable_files.sweep(folder, rf"\.{_FILE_NAME.pattern}\.partial")  # of a writer that was killed
        self._files = dict(_by_age(folder))  # sizes, oldest first
        self._nbytes = sum(self._files.values())

    def __len__(self) -> int:
        return len(self._files)

    def keep(
        self, frames: Sequence[Any], *, session: bytes, seq: int, client: str = "", reason: str
    ) -> Path | None:
        """Write a keyframe's message to a file and return it, or None if the disk refuses (which is logged).

        Args:
            reason: a word for the file's name; characters that could lead out of the folder are replaced.
        """
        word = re.sub("[^a-z0-9]", "_", reason.lower())[:_MAX_REASON_LENGTH] or "unknown"
        path = self.folder / f"{session[:4].hex()}-{seq}-{word}.mcap"
        try:
            with suppress(FileExistsError):
                self.folder.mkdir()  # alone: the folder above may be away, and come back
                durable_files.sync_folder(self.folder.parent)
            journal.write_file(path, frames, session=session, seq=seq, client=client)
            size = path.stat().st_size
        except (JournalError, OSError) as error:
            subject = logs.about(session=session, seq=seq, client=client, reason=reason)
            log.error("a keyframe could not be put into quarantine: %s", error, extra=subject)
            self.problem = f"a keyframe could not be put into quarantine: {error}"
            return None
        self.problem = ""
        self._nbytes += size - self._files.pop(path, 0)
        self._files[path] = size
        self._prune()
        return path

    def drop(self, session: bytes, numbers: NumberRanges) -> int:
        """Delete the files of these keyframes of a session; return the number of files deleted.

        A file name holds only 8 hex digits of a session, so another session's file may go too.
        """
        count = 0
        for path in list(self._files):
            match = _FILE_NAME.fullmatch(path.name)
            if match and match[1] == session[:4].hex() and int(match[2]) in numbers:
                with suppress(OSError):
                    path.unlink(missing_ok=True)
                    self._nbytes -= self._files.pop(path)
                    count += 1
        return count

    def _prune(self) -> None:
        while len(self) > 1 and (self._nbytes > self._max_bytes or len(self) > _MAX_FILES):
            self.problem = f"the quarantine {self.folder} is full: the oldest keyframes in it are deleted"
            path = next(iter(self._files))
            self._nbytes -= self._files.pop(path)
            with suppress(OSError):
                path.unlink()


def quarantined_files(folder: Path) -> list[Path]:
    """Return the files that `Quarantine` has written into a folder, sorted by session and number."""
    found = [(match, path) for path in folder.iterdir() if (match := _FILE_NAME.fullmatch(path.name))]
    return [path for match, path in sorted(found, key=lambda one: (one[0][1], int(one[0][2]), one[0][3]))]


def _by_age(folder: Path) -> list[tuple[Path, int]]:
    """Return the quarantined files of a folder and their sizes, oldest first."""
    found = []
    with suppress(OSError):  # the folder is missing or unreadable: no old file is deleted then
        for path in folder.iterdir():
            with suppress(OSError):  # a person took it away just now
                stat = path.stat()
                if path.suffix == ".mcap":
                    found.append((stat.st_mtime_ns, path, stat.st_size))
    return [(path, size) for _, path, size in sorted(found)]
