# SPDX-License-Identifier: MIT
"""Records that are given up, kept aside so that a person can see what was wrong with them."""

import logging

from tsfusion.core.errors import JournalError
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.spool import Waiting
from tsfusion.journal.quarantine import Quarantine

FOLDER = "refused"  # inside the spool; opens like any journal
MAX_BYTES = 64 << 20

log = logging.getLogger(__name__)


class RefusedFolder:
    """The refused records of a spool, in a folder inside it. A temporary spool keeps none."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._kept = Quarantine(outbox.spool_folder / FOLDER, MAX_BYTES)

    def give_up(self, entry: Waiting, reason: str, message: str, *, readable: bool = True) -> None:
        """Take a record out of the spool for good, and keep a copy when it can be read."""
        log.error("%s %d is lost (%s): %s", entry.kind, entry.seq, reason, message)
        if readable and not self._outbox.is_temporary:
            self._keep(entry, reason)
        self._outbox.refuse(entry, reason, message)

    def _keep(self, entry: Waiting, reason: str) -> None:
        try:
            frames = self._outbox.read(entry)
        except (JournalError, OSError) as error:
            log.warning("%s %d could not be kept aside: %s", entry.kind, entry.seq, error)
            return
        path = self._kept.keep(frames, session=self._outbox.session, seq=entry.seq, reason=reason)
        if path is not None:
            log.info("%s %d is in %s", entry.kind, entry.seq, path)
