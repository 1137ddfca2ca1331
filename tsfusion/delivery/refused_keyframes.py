# SPDX-License-Identifier: MIT
"""Keyframes that are given up, kept aside so that a person can see what was wrong with them."""

import logging

from tsfusion.core.errors import JournalError
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.spool import Waiting
from tsfusion.journal.quarantine import Quarantine

FOLDER = "refused"  # inside the spool; opens like any journal
MAX_BYTES = 64 << 20

log = logging.getLogger(__name__)


class RefusedFolder:
    """The refused keyframes of a spool, in a folder inside it. A temporary spool keeps none."""

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._kept = Quarantine(outbox.spool.folder / FOLDER, MAX_BYTES)

    def give_up(self, entry: Waiting, reason: str, message: str, *, readable: bool = True) -> None:
        """Take a keyframe out of the queue for good. Not while holding `changed`: this uses the disk."""
        log.error("keyframe %d is lost (%s): %s", entry.seq, reason, message)
        if readable and not self._outbox.spool.temporary:
            self._keep(entry, reason)
        with self._outbox.changed:
            self._outbox.refuse(entry, reason, message)

    def _keep(self, entry: Waiting, reason: str) -> None:
        spool = self._outbox.spool
        try:
            frames = spool.read(entry)
        except (JournalError, OSError) as error:
            log.warning("keyframe %d could not be kept aside: %s", entry.seq, error)
            return
        path = self._kept.keep(frames, session=spool.session, seq=entry.seq, reason=reason)
        if path is not None:
            log.info("keyframe %d is in %s", entry.seq, path)
