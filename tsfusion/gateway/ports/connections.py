# SPDX-License-Identifier: MIT
"""Connections of a server's ports, counted and cut off, and the memory that they hold.

ZeroMQ accepts any number of connections, and does not tell their memory. The system's tables (Linux) show the
received bytes and the silence of each. Without Linux nothing is found, and only the memory guard protects the
server.
"""

import logging
import os
import resource
import socket
import stat
import struct
import time
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import zmq
from msgspec import Struct

from tsfusion.core import logs, process
from tsfusion.core.readable_numbers import count_of
from tsfusion.gateway.ports.access_control import AccessControl, file_of, peer_address, sender_of
from tsfusion.wire.sockets import sockets

log = logging.getLogger(__name__)

_CUT_HELPS_WITHIN = 1.0  # seconds until a cut frees memory: more memory after that is a new attack
_UNNOTICED = 4  # one quarter of the memory is reserved for messages that arrive before an alarm
_RETURN_INTERVAL = 1.0  # seconds
_MOST = 4096  # connections at once
_BYTES_EACH = 48 << 10  # of memory, roughly
_GREETING_BYTES = 64  # of ZMTP; a peer that has sent no more is not connected yet
_INTERVAL = 0.1  # seconds between two checks
_LONGEST_INTERVAL = 1.0
_SHARE = 20  # at most 1/20 of the time goes into full checks
_UNREAD_BYTES = 1 << 20  # incomplete bytes that a connection can always hold
_TCP_INFO = struct.Struct("=B51xI72xQ")  # linux/tcp.h: tcpi_state, tcpi_last_data_recv, tcpi_bytes_received
_TCP_LISTEN = 10
_FILES = "/proc/self/fd"


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
    """Large replies that have not left yet, one a reader: a reader that stops must not fill the memory.

    Attributes:
        max_bytes: limit for unread replies and answers still to come; a single one can be larger.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
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


class OpenConnection(Struct, frozen=True):
    """An established connection."""

    fd: int
    silent_ms: int
    received_bytes: int


class Connections:
    """The TCP connections to some ports of this process. Call `step` again and again.

    Attributes:
        ports: their numbers.
    """

    def __init__(self, memory_bytes: int) -> None:
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self.most = min(_MOST, files // 2, max(memory_bytes // 4 // _BYTES_EACH, 1))
        self.ports: Collection[int] = ()
        self._next_look = self._next_full_look = 0.0  # time.monotonic()
        self._others = 0  # files of this process that are no connections, at the last full check
        self._read: Counter[int] = Counter()  # fd → bytes of the messages that the gateway got

    def note_read(self, fd: int, nbytes: int) -> None:
        """Count the bytes of a message that came over a connection."""
        self._read[fd] += nbytes

    def step(self) -> int:
        """Cut off surplus connections. Return the number of cut ones.

        Those without a greeting go first, then those that are silent for longest.
        """
        now = time.monotonic()
        if now < self._next_look:
            return 0
        self._next_look = now + _INTERVAL
        files = len(_files())
        if files - self._others <= self.most and now < self._next_full_look:
            return 0
        began = time.thread_time()
        found = self._look()
        self._others = files - len(found)
        self._next_full_look = now + min(_SHARE * (time.thread_time() - began), _LONGEST_INTERVAL)
        if len(found) <= self.most:
            return 0
        found.sort(key=lambda one: (one.received_bytes > _GREETING_BYTES, -one.silent_ms))
        return sum(self.cut(one.fd) for one in found[: len(found) - self.most * 3 // 4])

    def cut_hoarders(self) -> list[tuple[str, int]]:
        """Cut off the connections with the most bytes of incomplete messages.

        Returns:
            Address of the other end, and these bytes, for each connection.
        """
        unread = [(one.fd, one.received_bytes - self._read[one.fd]) for one in self._look()]
        least = max(max((nbytes for _, nbytes in unread), default=0) // 2, _UNREAD_BYTES)
        hoarders = [(fd, _peer_of(fd), nbytes) for fd, nbytes in unread if nbytes > least]
        return [(peer, nbytes) for fd, peer, nbytes in hoarders if self.cut(fd)]

    def _look(self) -> list[OpenConnection]:
        """Return the established connections. Correct the counts of file numbers that were used again."""
        found = list(self._all())
        self._read = Counter({one.fd: min(self._read[one.fd], one.received_bytes) for one in found})
        return found

    def _all(self) -> Iterator[OpenConnection]:
        for fd in map(int, _files()):
            with suppress(OSError, struct.error):  # the second: a system that tells less, as old Linux
                if not stat.S_ISSOCK(os.fstat(fd).st_mode):
                    continue
                with _shared(fd) as link:
                    state, silent_ms, received = _TCP_INFO.unpack(
                        link.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size)
                    )
                    if state != _TCP_LISTEN and self._is_ours(link):
                        yield OpenConnection(fd, silent_ms, received)

    def cut(self, fd: int) -> bool:
        """Cut a connection off. Return False if the file is no connection (any more)."""
        with suppress(OSError), _shared(fd) as link:
            if self._is_ours(link):  # another file may have the number of an ended connection
                link.shutdown(socket.SHUT_RDWR)
                return True
        return False

    def _is_ours(self, link: socket.socket) -> bool:
        name = link.getsockname()
        return isinstance(name, tuple) and name[1] in self.ports


def _files() -> list[str]:
    """Return the numbers of this process's open files, or nothing where the system does not tell."""
    try:
        return os.listdir(_FILES)
    except OSError:
        return []


def _peer_of(fd: int) -> str:
    """Return the address of a connection's other end; empty after its end."""
    with suppress(OSError), socket.socket(fileno=os.dup(fd)) as link:
        return str(link.getpeername()[0]).removeprefix(sockets.MAPPED)
    return ""


def _shared(fd: int) -> socket.socket:
    """Return the socket of an open file, held open by a copy. Raise OSError if it is no socket.

    The socket counts as IPv4, which is faster than to ask. For other families only its ports are right.
    """
    copy = os.dup(fd)
    try:
        return socket.socket(socket.AF_INET, socket.SOCK_STREAM, fileno=copy)
    except OSError:
        os.close(copy)
        raise


class Flood(NamedTuple):
    """A message with many more frames than any valid one.

    ZeroMQ keeps all frames in memory, and delivers other messages of the socket only after the last frame.
    """

    first: zmq.Frame
    discarded: int  # number of frames that were read and dropped
    goes_on: bool  # True if there are more frames: only a new socket gets rid of them soon


class ConnectionLimits:
    """Limits of a gateway's connections. Call `step` and `all_must_go` again and again."""

    def __init__(self, connections: Connections, access: AccessControl, memory_bytes: int) -> None:
        self._connections = connections
        self._access, self._refused = access, access.refused
        self._memory = MemoryGuard(memory_bytes - memory_bytes // _UNNOTICED)
        self._hoarders_cut = -_CUT_HELPS_WITHIN  # time.monotonic()

    def step(self) -> None:
        """Cut off surplus connections."""
        if surplus := self._connections.step():
            self._refused["connection"] += surplus
            cut = count_of(surplus, "connection is", "connections are")
            log.warning("%s cut off: there are too many", cut)

    def on_flood(self, flood: Flood) -> None:
        """Cut off the sender of a message with endless frames. If it has a name, keep it out for a while."""
        self._refused["frames"] += 1
        client = self._access.keep_out(sender_of(flood.first))
        log.warning(
            "a message from %s has more than %d frames: its connection is cut off%s",
            peer_address(flood.first) or "somewhere",
            flood.discarded,
            ", and the others of that port are made anew" if flood.goes_on else "",
            extra=logs.about(client=client, reason="frames"),
        )
        if (fd := file_of(flood.first)) is not None:
            self._connections.cut(fd)

    def all_must_go(self, uncounted: int) -> bool:
        """True if every connection must be made anew: a key was revoked, or connections hold too much memory.

        ZeroMQ limits the size of a frame and the queue of complete messages, but not a message that never
        ends.

        Args:
            uncounted: bytes of this process that no connection causes.
        """
        if self._access.take_revoked():
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
        hoarders = self._connections.cut_hoarders()
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
