# SPDX-License-Identifier: MIT
"""Keyframes that could not be fused, each a file of its own, so that a person can look into why.

They are in the journal too, but that may be pruned; and a file here can be sent to whoever can help.
"""

import logging
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from tsfusion import disk, journal, logs
from tsfusion.errors import JournalError

log = logging.getLogger(__name__)


class Quarantine:
    """A folder of `SESSION-SEQ-REASON.mcap` files; the oldest go when they are more than `max_bytes`."""

    def __init__(self, folder: Path, max_bytes: int) -> None:
        self.folder = folder
        self._max_bytes = max_bytes

    def __len__(self) -> int:
        return sum(1 for _ in self.folder.glob("*.mcap"))

    def keep(
        self, frames: Sequence[Any], *, session: bytes, seq: int, client: str = "", reason: str
    ) -> Path | None:
        """Put a keyframe message aside; its file, or None when the disk refuses (which is logged)."""
        path = self.folder / f"{session[:4].hex()}-{seq}-{reason}.mcap"
        try:
            disk.make_folder(self.folder)
            journal.write_file(path, frames, session=session, seq=seq, client=client)
            self._prune(path)
        except (JournalError, OSError) as error:
            subject = logs.about(session=session, seq=seq, client=client, reason=reason)
            log.error("a keyframe could not be put into quarantine: %s", error, extra=subject)
            return None
        return path

    def _prune(self, newest: Path) -> None:
        found = sorted((path.stat().st_mtime_ns, path) for path in self.folder.glob("*.mcap"))
        total = sum(path.stat().st_size for _, path in found)
        for _, path in found:
            if total <= self._max_bytes or path == newest:
                return
            size = path.stat().st_size
            with suppress(OSError):
                path.unlink()
                total -= size
