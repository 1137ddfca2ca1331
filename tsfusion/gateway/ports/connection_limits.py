# SPDX-License-Identifier: MIT
"""Limits for connections: those that flood, fill memory, leave replies unread or are too many are cut."""

import logging
import time
from collections import Counter
from collections.abc import Sequence

import zmq

from tsfusion.core import logs, process
from tsfusion.core.readable_numbers import count_of
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.ports import Flood, Ports
from tsfusion.wire.sockets import sockets

_RETURN_INTERVAL = 1.0  # seconds


class MemoryGuard:
    """Detects that connections hold too much memory, and must be dropped.

    Dropping them frees memory, but not at once (ZeroMQ's threads do it) and perhaps not all (this process may
    need some). So an alarm raises the limit above the memory in use; otherwise the alarm would never end.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = self._bound = max_bytes
        self._next_return = 0.0  # time.monotonic()

    def excess(self, uncounted: int) -> int:
        """Return the bytes that this process holds if they are too many, else 0."""
        held = process.rss_bytes() - uncounted
        now = time.monotonic()
        # The memory may be free already, and only kept by the allocator.
        if held > self._bound or (held > self._max_bytes and now >= self._next_return):
            self._next_return = now + _RETURN_INTERVAL
            process.give_back_memory()
            held = process.rss_bytes() - uncounted
        exceeded = held > self._bound
        above = held + self._max_bytes // 8
        self._bound = max(self._max_bytes, above if exceeded else min(self._bound, above))
        return held if exceeded else 0


class PendingReplies:
    """Large replies that have not left yet, one a reader: a reader that stops must not fill the memory."""

    def __init__(self) -> None:
        self._trackers: dict[bytes, tuple[zmq.MessageTracker, int]] = {}

    def of(self, owner: bytes) -> tuple[int, int]:
        """Return number and bytes of the replies that wait for readers whose keys begin with `owner`.

        Replies to disconnected readers do not count.
        """
        self._forget()
        own = [nbytes for key, (_, nbytes) in self._trackers.items() if key.startswith(owner)]
        return len(own), sum(own)

    @property
    def nbytes(self) -> int:
        """Bytes of all waiting replies."""
        self._forget()
        return sum(nbytes for _, nbytes in self._trackers.values())

    @property
    def largest(self) -> int:
        """Bytes of the largest waiting reply."""
        self._forget()
        return max((nbytes for _, nbytes in self._trackers.values()), default=0)

    def _forget(self) -> None:
        self._trackers = {key: kept for key, kept in self._trackers.items() if not kept[0].done}

    def wrap(self, reader: bytes, frames: Sequence[zmq.Frame]) -> list[zmq.Frame]:
        """Return copies of the frames that share their memory. The last one shows when all have left."""
        *others, last = (frame.buffer for frame in frames)
        tracked = zmq.Frame(last, track=True, copy=False, copy_threshold=0)
        nbytes = sum(other.nbytes for other in others) + last.nbytes
        self._trackers[reader] = (tracked.tracker, nbytes)
        return [*(zmq.Frame(other, copy=False) for other in others), tracked]


log = logging.getLogger(__name__)

_CUT_HELPS_WITHIN = 1.0  # seconds until a cut frees memory: more memory after that is a new attack
_UNNOTICED = 4  # one quarter of the memory is reserved for messages that arrive before an alarm


class ConnectionLimits:
    """Limits of a gateway's connections. Call `step` and `all_must_go` again and again."""

    def __init__(self, ports: Ports, access: AccessControl, refused: Counter[str], memory_bytes: int) -> None:
        self._ports = ports
        self._access = access
        self._refused = refused
        self._memory = MemoryGuard(memory_bytes - memory_bytes // _UNNOTICED)
        self._hoarders_cut = -_CUT_HELPS_WITHIN  # time.monotonic()

    def step(self) -> None:
        """Cut off surplus connections."""
        if surplus := self._ports.connections.step():
            self._refused["connection"] += surplus
            cut = count_of(surplus, "connection is", "connections are")
            log.warning("%s cut off: there are too many", cut)

    def on_flood(self, socket: sockets.AnySocket, flood: Flood) -> None:
        """Cut off the sender of a message with endless frames. If the flood goes on, make its port anew.

        Other clients of the port are back at once. The sender, if it has a name, is kept out for a while.
        """
        self._refused["frames"] += 1
        client = self._access.keep_out(flood.first)
        log.warning(
            "a message from %s has more than %d frames: its connection is cut off%s",
            sockets.peer_address(flood.first) or "somewhere",
            flood.discarded,
            ", and the others of that port are made anew" if flood.goes_on else "",
            extra=logs.about(client=client, reason="frames"),
        )
        self._ports.cut_off(flood.first)
        if flood.goes_on:
            self._ports.renew(socket)

    def all_must_go(self, uncounted: int) -> bool:
        """True if every connection must be made anew: a key was revoked, or connections hold too much memory.

        ZeroMQ limits the size of a frame and the queue of complete messages, but not a message that never
        ends.

        Args:
            uncounted: bytes of this process that no connection causes.
        """
        if self._access.step():
            log.warning("a key was revoked, or may use other maps: every connection is made anew")
            self._refused["revoked"] += 1
            return True
        held = self._memory.excess(uncounted)
        if not held or self._cut_hoarders(held):
            return False
        log.error(
            "the gateway holds %d MB, too near to memory_bytes: every connection is made anew", held >> 20
        )
        self._refused["memory"] += 1
        return True

    def _cut_hoarders(self, held: int) -> bool:
        """Cut off connections that fill the memory. Return False without any, or if a cut did not help."""
        now = time.monotonic()
        if now - self._hoarders_cut < _CUT_HELPS_WITHIN:
            return False
        hoarders = self._ports.connections.cut_hoarders()
        for peer, nbytes in hoarders:
            self._hoarders_cut = now
            self._refused["memory"] += 1
            log.warning(
                "the gateway holds %d MB, too near to memory_bytes: the connection from %s, with %.1f MB of "
                "messages that are not whole, is cut off",
                held >> 20,
                peer,
                nbytes / 1e6,
            )
        return bool(hoarders)
