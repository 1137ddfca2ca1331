# SPDX-License-Identifier: MIT
"""Todo."""

from collections.abc import Sequence

import zmq

from tsfusion.core import process


class MemoryGuard:
    """When what connections hold in memory is too much, so that they have to be dropped.

    That frees it, but not at once (threads of ZeroMQ's do it) and perhaps not all (this process may need
    it): who was told counts from what is held then, or would be told for ever.
    """

    def __init__(self, most: int) -> None:
        self._most = self._bound = most

    def excess(self, elsewhere: int) -> int:
        """What this process holds, bytes, when that is too much; else 0.

        Args:
            elsewhere: bytes that do not count.
        """
        held = process.rss_bytes() - elsewhere
        if held > self._bound:  # perhaps freed already, and only kept for later
            process.give_back_memory()
            held = process.rss_bytes() - elsewhere
        told = held if held > self._bound else 0
        reached = held + self._most // 8
        self._bound = max(self._most, reached if told else min(self._bound, reached))
        return told


class PendingReplies:
    """Large answers that have not left yet, one a reader: who does not read must not fill our memory."""

    def __init__(self) -> None:
        self._trackers: dict[bytes, tuple[zmq.MessageTracker, int]] = {}

    def pending(self, reader: bytes) -> bool:
        """Whether an earlier one still waits for its reader. One whose reader is gone does not."""
        self._forget()
        return reader in self._trackers

    @property
    def nbytes(self) -> int:
        """What waits for readers."""
        self._forget()
        return sum(nbytes for _, nbytes in self._trackers.values())

    @property
    def largest(self) -> int:
        """The largest of them."""
        self._forget()
        return max((nbytes for _, nbytes in self._trackers.values()), default=0)

    def _forget(self) -> None:
        self._trackers = {key: kept for key, kept in self._trackers.items() if not kept[0].done}

    def wrap(self, reader: bytes, frames: Sequence[zmq.Frame]) -> list[zmq.Frame]:
        """The frames anew, so that it shows when the last has left."""
        *others, last = (frame.buffer for frame in frames)
        tracked = zmq.Frame(last, track=True, copy=False, copy_threshold=0)
        nbytes = sum(other.nbytes for other in others) + last.nbytes
        self._trackers[reader] = (tracked.tracker, nbytes)
        return [*(zmq.Frame(other, copy=False) for other in others), tracked]
