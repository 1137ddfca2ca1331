# SPDX-License-Identifier: MIT
"""The scanner's own disk: every keyframe waits here until the server has it on its disk.

A spool is one session: what a dead scanner left in it is resent under the session and numbers that the
server may already know, and a spool that was emptied starts a new session. Reading back from the page
cache costs less than holding the queue in memory, and bounds it.
"""

import fcntl
import logging
import os
import secrets
import shutil
import tempfile
from collections import deque
from pathlib import Path
from typing import BinaryIO

from msgspec import Struct

from tsfusion import journal
from tsfusion.errors import JournalError

log = logging.getLogger(__name__)

# A restarted scanner skips numbers: those of records that a power cut took must never be used again.
_RESTART_GAP = 1024
_SESSION_BYTES = 16


class Waiting(Struct, frozen=True):
    """A keyframe the server does not have yet."""

    seq: int
    position: journal.Position
    nbytes: int


class Spool:
    """A folder of unacknowledged keyframes, oldest first. One process at a time.

    Threads: `write` may run in one while another does anything else; the rest is not thread-safe.

    Args:
        folder: None = a temporary folder that goes away at `close`, with what is still in it.

    Raises:
        JournalError: when the folder cannot be used, or another scanner uses it.
    """

    def __init__(self, folder: str | os.PathLike[str] | None, segment_bytes: int) -> None:
        self.temporary = folder is None
        self.folder = Path(tempfile.mkdtemp(prefix="tsfusion-spool-")) if folder is None else Path(folder)
        self._lock = lock_folder(self.folder, "spool", "scanner")
        self._journal = journal.Journal(self.folder, segment_bytes, sync=not self.temporary)
        found, self._journal.found = self._journal.found, []
        sessions = {record.session for record in found} or {secrets.token_bytes(_SESSION_BYTES)}
        if len(sessions) > 1:
            raise JournalError(f"{self.folder} holds keyframes of {len(sessions)} sessions: not one spool")
        self.session = sessions.pop()
        self.waiting = deque(Waiting(record.seq, record.position, record.nbytes) for record in found)
        self.next_seq = self.waiting[-1].seq + _RESTART_GAP if self.waiting else 1
        self._segments = deque(journal.segments(self.folder))

    def write(self, frames: list[bytes]) -> Waiting:
        """Put the keyframe that was encoded as `next_seq` on the disk; `add` then makes it count.

        Raises:
            JournalError: when the disk refuses.
        """
        position = self._journal.append(frames, session=self.session, seq=self.next_seq)
        return Waiting(self.next_seq, position, sum(map(len, frames)))

    def add(self, entry: Waiting) -> None:
        """Queue a written keyframe."""
        self.next_seq = entry.seq + 1
        self.waiting.append(entry)
        if not self._segments or self._segments[-1] != entry.position.segment:
            self._segments.append(entry.position.segment)

    def read(self, entry: Waiting) -> list[memoryview]:
        """The frames of a keyframe.

        Raises:
            JournalError: when the disk has lost it.
        """
        return journal.read(self.folder, entry.position).frames

    def drop(self, durable: int) -> list[int]:
        """Let go of everything up to `durable`; the numbers of what was waiting."""
        dropped = []
        while self.waiting and self.waiting[0].seq <= durable:
            dropped.append(self.waiting.popleft().seq)
        self._delete_segments()
        return dropped

    def remove(self, entry: Waiting) -> None:
        """Let go of one keyframe."""
        self.waiting.remove(entry)
        self._delete_segments()

    def _delete_segments(self) -> None:
        # The newest stays: a keyframe that `write` has just put there may not be queued yet.
        while len(self._segments) > 1 and not (
            self.waiting and self.waiting[0].position.segment <= self._segments[0]
        ):
            self._forget(self._segments.popleft())

    def _forget(self, segment: int) -> None:
        """Delete a segment; one that stays is only sent once more, and recognised."""
        try:
            self._journal.forget(segment)
        except JournalError as error:
            log.warning("%s", error)

    def close(self) -> None:
        """Release the folder. An empty spool takes its files with it: the next starts a new session."""
        self._journal.close()
        if self.temporary:
            shutil.rmtree(self.folder, ignore_errors=True)
        elif not self.waiting:
            for segment in self._segments:
                self._forget(segment)
        self._lock.close()


def lock_folder(folder: Path, kind: str, owner: str) -> BinaryIO:
    """Make a folder and hold it for this process until the returned file is closed.

    Raises:
        JournalError: when it cannot be written, or another process holds it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / "lock").open("ab")
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        raise JournalError(
            f"cannot write the {kind} folder {folder}: {getattr(error, 'strerror', error)}"
        ) from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise JournalError(f"the {kind} folder {folder} is in use by another {owner}") from error
    return file
