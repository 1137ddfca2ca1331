# SPDX-License-Identifier: MIT
"""Keyframes put aside, each in a file of its own, so that a person can see what was wrong with them.

A server keeps those that it could not fuse, a scanner those that the server refused.
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
    """A folder of `SESSION-SEQ-REASON.mcap` files; the oldest go beyond `max_bytes`, or a thousand.

    The folder is read once: what a person takes away later counts until it would have gone anyway.
    """

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self._max_bytes = max_bytes
        self.problem = ""  # why the last keyframe could not be kept, or older ones go; empty = neither
        durable_files.sweep(folder, rf"\.{_FILE_NAME.pattern}\.partial")  # of a writer that was killed
        self._files = dict(_by_age(folder))  # sizes, oldest first
        self._nbytes = sum(self._files.values())

    def __len__(self) -> int:
        return len(self._files)

    def keep(
        self, frames: Sequence[Any], *, session: bytes, seq: int, client: str = "", reason: str
    ) -> Path | None:
        """Put a keyframe message aside; its file, or None when the disk refuses (which is logged).

        Args:
            reason: a word; it becomes a part of the file's name without what could lead out of the folder.
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
        """Delete the keyframes of these numbers of a session; how many files that were.

        The first eight digits of the session stand in a file's name, so another one's may go with them.
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
    """The files that `Quarantine` has put into a folder, by session and number."""
    found = [(match, path) for path in folder.iterdir() if (match := _FILE_NAME.fullmatch(path.name))]
    return [path for match, path in sorted(found, key=lambda one: (one[0][1], int(one[0][2]), one[0][3]))]


def _by_age(folder: Path) -> list[tuple[Path, int]]:
    """The files of a folder and their sizes, oldest first."""
    found = []
    with suppress(OSError):  # none is there, or they are not known: none of them is deleted for room then
        for path in folder.iterdir():
            with suppress(OSError):  # a person took it away just now
                stat = path.stat()
                if path.suffix == ".mcap":
                    found.append((stat.st_mtime_ns, path, stat.st_size))
    return [(path, size) for _, path, size in sorted(found)]
