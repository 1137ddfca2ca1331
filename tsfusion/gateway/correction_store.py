# SPDX-License-Identifier: MIT
"""The corrections of one map: a file a session, whole or the one before, within limits."""

import logging
from pathlib import Path

from msgspec import Struct

from tsfusion.core import durable_files, logs
from tsfusion.core.errors import DecodeError, JournalError
from tsfusion.wire import corrections
from tsfusion.wire.corrections import SUFFIX, SessionCorrections
from tsfusion.wire.keyframe_header import Refused

log = logging.getLogger(__name__)

MAX_SESSIONS = 1000  # with corrections
MAX_BYTES = 256 << 20  # of all files


class Kept(Struct, frozen=True):
    """What a session's file holds: of the newest message its number, keyframes, and the file's bytes."""

    revision: int = 0
    keyframes: int = 0
    nbytes: int = 0


_NONE = Kept()


class Revisions:
    """Keeps in memory only what is in which file.

    Args:
        min_free_bytes: stay free on the disk.

    Attributes:
        taken: messages since this began.
        damaged: files that were set aside.

    Raises:
        JournalError: when a file cannot be read: what it holds would be lost with the next message.
    """

    def __init__(self, folder: Path, min_free_bytes: int) -> None:
        self.taken = self.damaged = 0
        self._folder = folder
        self._min_free_bytes = min_free_bytes
        self._kept: dict[bytes, Kept] = {}
        for path in sorted(folder.glob(f"*{SUFFIX}")):
            found = self._load(path)
            if found is not None:
                self._note(found)

    def of(self, session: bytes) -> Kept:
        """What there is of a session."""
        return self._kept.get(session, _NONE)

    def take(self, new: SessionCorrections) -> None:
        """Have a newer message of a session on the disk, and with it what was there of other keyframes.

        Raises:
            Refused: (`limits`) for more keyframes, sessions or bytes than a map may have.
            JournalError: when the disk refuses, or too little would stay free; what was there still is.
        """
        path = self._folder / f"{new.session.hex()}{SUFFIX}"
        before = self._load(path) if new.session in self._kept else None
        both = new if before is None else before.merged(new)
        self._check_limits(both)
        try:
            durable_files.make_folder(self._folder)
            free = durable_files.free_bytes(self._folder) - corrections.file_bytes(len(both))
        except OSError as error:
            raise JournalError(f"cannot write {self._folder}: {error.strerror or error}") from error
        if free < self._min_free_bytes:
            raise JournalError(
                f"cannot write {path}: {self._min_free_bytes} bytes of its disk must stay free"
            )
        corrections.write(path, both)
        self._note(both)
        self.taken += 1

    def _load(self, path: Path) -> SessionCorrections | None:
        """A file's content; None when it is damaged and was set aside."""
        try:
            return corrections.load(path)
        except DecodeError as error:
            aside = path.with_suffix(".damaged")
            try:
                path.replace(aside)
            except OSError as refusal:
                raise JournalError(f"{error}, and it cannot be set aside: {refusal.strerror}") from refusal
            log.error("%s; its corrections are lost; it is kept as %s", error, aside)
            self.damaged += 1
            return None

    def _check_limits(self, both: SessionCorrections) -> None:
        if len(both) > corrections.MAX_KEYFRAMES:
            most = corrections.MAX_KEYFRAMES
            raise Refused(
                "limits", f"at most {most} keyframes of a session can be corrected, not {len(both)}"
            )
        if both.session not in self._kept and len(self._kept) >= MAX_SESSIONS:
            raise Refused("limits", f"the map has corrections of {MAX_SESSIONS} sessions and takes no more")
        others = sum(one.nbytes for key, one in self._kept.items() if key != both.session)
        if others + corrections.file_bytes(len(both)) > MAX_BYTES:
            raise Refused("limits", f"the map's corrections may have {MAX_BYTES} bytes in all")

    def _note(self, found: SessionCorrections) -> None:
        nbytes = corrections.file_bytes(len(found))
        self._kept[found.session] = Kept(found.revision, len(found), nbytes)
        log.debug(
            "revision %d: %d corrections", found.revision, len(found), extra=logs.about(session=found.session)
        )
