# SPDX-License-Identifier: MIT
"""Limits on the gateway's memory: what connections hold in all, and large replies that nobody reads."""

import time
from collections.abc import Sequence

import zmq

from tsfusion.core import process

_RETURN_INTERVAL = 1.0  # seconds


class MemoryGuard:
    """The check whether connections hold too much memory, so that they have to be dropped.

    Dropping them frees memory, but not at once (ZeroMQ's threads do it) and perhaps not all (this process may
    need some). So after an alarm the bound rises above what is held then; otherwise it would never end.

    Args:
        max_bytes: of this process.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = self._bound = max_bytes
        self._next_return = 0.0  # time.monotonic()

    def excess(self, uncounted: int) -> int:
        """Bytes that this process holds, when they are too many; otherwise 0.

        Args:
            uncounted: bytes of this process that are no connection's fault.
        """
        held = process.rss_bytes() - uncounted
        now = time.monotonic()
        # Perhaps freed already, and only kept for later.
        if held > self._bound or (held > self._max_bytes and now >= self._next_return):
            self._next_return = now + _RETURN_INTERVAL
            process.give_back_memory()
            held = process.rss_bytes() - uncounted
        exceeded = held > self._bound
        above = held + self._max_bytes // 8
        self._bound = max(self._max_bytes, above if exceeded else min(self._bound, above))
        return held if exceeded else 0


class PendingReplies:
    """Large replies that have not left yet, one a reader: one that stops reading must not fill the memory."""

    def __init__(self) -> None:
        self._trackers: dict[bytes, tuple[zmq.MessageTracker, int]] = {}

    def pending(self, reader: bytes) -> bool:
        """True if an earlier reply still waits for this reader. None waits for a reader that disconnected."""
        self._forget()
        return reader in self._trackers

    def of(self, owner: bytes) -> tuple[int, int]:
        """Number of replies that wait for readers whose keys begin so, and their bytes."""
        self._forget()
        own = [nbytes for key, (_, nbytes) in self._trackers.items() if key.startswith(owner)]
        return len(own), sum(own)

    @property
    def nbytes(self) -> int:
        """Bytes of all replies that wait."""
        self._forget()
        return sum(nbytes for _, nbytes in self._trackers.values())

    @property
    def largest(self) -> int:
        """Bytes of the largest reply that waits."""
        self._forget()
        return max((nbytes for _, nbytes in self._trackers.values()), default=0)

    def _forget(self) -> None:
        self._trackers = {key: kept for key, kept in self._trackers.items() if not kept[0].done}

    def wrap(self, reader: bytes, frames: Sequence[zmq.Frame]) -> list[zmq.Frame]:
        """Copies of the frames that share their memory, and show when the last frame has left."""
        *others, last = (frame.buffer for frame in frames)
        tracked = zmq.Frame(last, track=True, copy=False, copy_threshold=0)
        nbytes = sum(other.nbytes for other in others) + last.nbytes
        self._trackers[reader] = (tracked.tracker, nbytes)
        return [*(zmq.Frame(other, copy=False) for other in others), tracked]
