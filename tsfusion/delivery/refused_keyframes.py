# SPDX-License-Identifier: MIT
"""Records that are given up, kept aside so that a person can see what was wrong with them."""

import logging

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.spool import Waiting

FOLDER = "refused"  # inside the spool; opens like any journal
MAX_BYTES = 64 << 20
_FILE_OVERHEAD = 2048

log = logging.getLogger(__name__)


class RefusedFolder:
    """A small journal inside the spool, one segment a record; the oldest go first.

    A temporary spool keeps nothing.
    """

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._folder = outbox.spool_folder / FOLDER
        self._journal: journal.Journal | None = None

    def give_up(self, entry: Waiting, reason: str, message: str, *, readable: bool = True) -> None:
        """Take a record out of the spool for good, and keep a copy when it can be read."""
        log.error("%s %d is lost (%s): %s", entry.kind, entry.seq, reason, message)
        if readable and not self._outbox.is_temporary and entry.nbytes + _FILE_OVERHEAD <= MAX_BYTES:
            try:
                self._keep(entry)
            except (JournalError, OSError) as error:
                log.warning("%s %d could not be kept aside: %s", entry.kind, entry.seq, error)
        self._outbox.refuse(entry, reason, message)

    def _keep(self, entry: Waiting) -> None:
        frames = self._outbox.read(entry)
        if self._journal is None:
            self._journal = journal.Journal(self._folder, 1, sync=False)
            self._journal.found = []
        for number in journal.segments(self._folder):
            if self._journal.nbytes + entry.nbytes + _FILE_OVERHEAD <= MAX_BYTES:
                break
            self._journal.forget(number)
        position = self._journal.append(frames, session=self._outbox.session, seq=entry.seq)
        path = journal.segment_path(self._folder, position.segment)
        log.info("%s %d is in %s", entry.kind, entry.seq, path)

    def close(self) -> None:
        """Finish; what was kept stays."""
        if self._journal is not None:
            self._journal.close()
