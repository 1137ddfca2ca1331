# SPDX-License-Identifier: MIT
"""Whether the spool's disk takes another keyframe. A scanner goes on without it, and says so once."""

import logging
import time

from tsfusion import disk
from tsfusion.outbox import Outbox

log = logging.getLogger(__name__)

_LOOK_INTERVAL = 0.25  # seconds between questions for the free space
_RETRY_INTERVAL = 0.5  # seconds until a disk that refused is tried again: each try may take long
_MAX_WAITING = 1_000_000  # keyframes: some 200 bytes of memory each


class Room:
    """The limits of a spool. Call under `outbox.changed`; what it says stands in `outbox.state`.

    Args:
        spool_bytes: of the disk the spool may take.
        min_free_bytes: stay free on it.
    """

    def __init__(self, outbox: Outbox, spool_bytes: int, min_free_bytes: int) -> None:
        self._outbox = outbox
        self._spool_bytes = spool_bytes
        self._min_free_bytes = min_free_bytes
        self._free = self._written = 0
        self._look_due = self._retry_due = 0.0

    def full(self, nbytes: int) -> bool:
        """Whether the spool would pass its own limit with so many bytes more."""
        spool = self._outbox.spool
        if spool.used_bytes + nbytes > self._spool_bytes:
            spool.tidy()
        return spool.used_bytes + nbytes > self._spool_bytes or len(spool.waiting) >= _MAX_WAITING

    def is_full(self) -> None:
        """The spool is at its limit, and nothing could be dropped."""
        self._enter("spool", f"it has reached its limit of {self._spool_bytes} bytes (spool_bytes)")

    def disk_refuses(self, nbytes: int) -> bool:
        """Whether the disk has failed just now, or would have too little left with so many bytes more."""
        now = time.monotonic()
        if now < self._retry_due:
            return True
        if not self._min_free_bytes:
            return False
        wanted = self._min_free_bytes
        if self._outbox.state == "disk":
            wanted += wanted // 4  # else each keyframe that leaves the spool would end the state
        if now >= self._look_due or self._free - self._written - nbytes < wanted:
            self._look(now)
        free = self._free - self._written
        if free - nbytes >= wanted:
            return False
        self._retry_due = now + _RETRY_INTERVAL
        self._enter("disk", f"its disk has {free} bytes left, {self._min_free_bytes} must stay free")
        return True

    def failed(self, error: Exception) -> None:
        """The disk would not take a keyframe."""
        self._retry_due = time.monotonic() + _RETRY_INTERVAL
        self._enter("disk", str(error))

    def took(self, nbytes: int) -> None:
        """The disk took a keyframe."""
        self._written += nbytes
        state = self._outbox.state
        if state == "disk" or (state == "spool" and self._outbox.spool.used_bytes < 0.9 * self._spool_bytes):
            self._outbox.state = "ok"
            log.info("the spool %s takes every keyframe again", self._outbox.spool.folder)

    def _look(self, now: float) -> None:
        self._look_due, self._written = now + _LOOK_INTERVAL, 0
        try:
            self._free = disk.free_bytes(self._outbox.spool.folder)
        except OSError:  # the write will say why
            self._free = 1 << 62

    def _enter(self, state: str, why: str) -> None:
        if self._outbox.state != state:
            self._outbox.state = state
            log.error(
                "keyframes are lost from here on: the spool %s cannot keep them: %s",
                self._outbox.spool.folder, why,
            )  # fmt: skip
