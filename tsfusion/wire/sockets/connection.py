# SPDX-License-Identifier: MIT
"""A connecting socket under watch: why it cannot connect, and when it is time for a new one."""

from collections.abc import Callable
from typing import Any

import zmq

from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection_monitor import ConnectionMonitor
from tsfusion.wire.sockets.curve import ClientKeys

_RETRY_INTERVAL = 2.0  # seconds; an allowed key is let in soon, a forbidden one is no burden
_MOST_PATIENCE = 16  # times the least: a link that takes so long for one keyframe still carries it


class ServerLink:
    """One connection to the server, over one socket after the other. For one thread.

    A name may stand for an IPv4 and an IPv6 address. Where nobody listens at the one, the other is tried.

    Raises:
        zmq.ZMQError: when no socket can be opened, here and where one is replaced: close it then.
    """

    def __init__(
        self,
        context: "zmq.Context[Any]",
        make: Callable[["zmq.Context[Any]", ClientKeys | None], sockets.AnySocket],
        address: str,
        keys: ClientKeys | None,
    ) -> None:
        self.problem = ""  # why there is no connection; empty = there is one, or nothing is known
        self.address = address
        self._context = context
        self._make = make
        self._keys = keys
        self._retry_due = 0.0
        self._made_before = 0  # connections of earlier sockets
        self._is_name = sockets.is_name(address)
        self._named_ipv6 = self._tried_both = False  # of a name
        self._open()

    def _open(self) -> None:
        self.socket = self._make(self._context, self._keys)
        try:
            self._monitor = ConnectionMonitor(self.socket, self.address, self._keys)
        except zmq.ZMQError:
            self.socket.close()
            raise
        self._cuts = 0  # connections that ended, and that were made after one
        sockets.connect(self.socket, self.address, named_ipv6=self._named_ipv6)

    @property
    def events(self) -> sockets.AnySocket:
        """The socket that is readable when `check` has news."""
        return self._monitor.socket

    @property
    def is_made(self) -> bool:
        return self._monitor.connected

    @property
    def made(self) -> int:
        """Number of connections made so far: what was sent over earlier ones may be lost."""
        return self._made_before + self._monitor.made

    @property
    def gave_up(self) -> bool:
        """True if ZeroMQ will not try again: `check` opens a new socket after a while."""
        return self._monitor.gave_up

    @property
    def made_at(self) -> float:
        """When it was made (`time.monotonic()`), where it stands."""
        return self._monitor.connected_since

    @property
    def finds_nobody(self) -> bool:
        """True if nobody listens, as far as the last attempt to connect shows."""
        return self._monitor.retrying and (self._tried_both or not self._is_name)

    @property
    def refused(self) -> bool:
        """True if the server has certainly refused this client's key."""
        return self._monitor.refused

    @property
    def due(self) -> float:
        """When `check` must be called next (`time.monotonic()`), without any event; 0 = only after one."""
        return self._retry_due

    def reopen(self) -> None:
        """Replace the socket; what the old connection held is lost."""
        self._retry_due = 0.0
        self._made_before = self.made
        self.close()
        self._open()

    def connect_to(self, address: str) -> None:
        """Connect to another address; what the old connection held is lost."""
        self.address, self.problem = address, ""
        self._is_name = sockets.is_name(address)
        self._named_ipv6 = self._tried_both = False
        self.reopen()

    def check(self, now: float) -> tuple[str | None, bool]:
        """Read the events, and connect anew when that is due.

        Returns:
            The problem, if that is a new one (empty = it is over, None = nothing new), and whether a
            connection ended, or another one stands after it: what was sent in between is lost, too.
        """
        news = self._monitor.problem()
        cuts = self._monitor.lost + max(self._monitor.made - 1, 0)
        ended, self._cuts = cuts > self._cuts, cuts
        if news == self.problem:
            news = None
        self.problem = self.problem if news is None else news
        if self._monitor.gave_up or (self._is_name and self._monitor.retrying):
            ended |= self._try_again(now)
        else:
            self._retry_due = 0.0
        return news, ended

    def _try_again(self, now: float) -> bool:
        """Open a new socket if its time has come. Returns True if the old one had been connected."""
        is_unknown = self._monitor.retrying and not self._tried_both
        if not is_unknown and now < (self._retry_due or now + 1):
            self._retry_due = self._retry_due or now + _RETRY_INTERVAL
            return False
        if self._monitor.retrying:
            self._tried_both |= self._named_ipv6
            self._named_ipv6 = not self._named_ipv6
        self.reopen()
        return self._made_before > 0

    def close(self, linger_ms: int = 0) -> None:
        """Close it; what was not sent has so long to leave."""
        self._monitor.close()
        self.socket.close(linger_ms)


class Patience:
    """Time to wait for a sign of life before a connection is made anew.

    TCP itself waits a quarter of an hour where a path is no more: the scanner roamed to another address, or a
    NAT forgot the connection. Each wait in vain doubles the next: a link may be slow, not dead, and what was
    under way is sent over it again.
    """

    def __init__(self, least: float) -> None:
        self._least = self._seconds = least
        self._ended = 0.0

    def has_ended(self, now: float, *, since: float, sign: float) -> bool:
        """True if the wait has ended; a new one begins then (all times: `time.monotonic()`).

        Args:
            since: when there was something to wait for.
            sign: when the last sign of life came.
        """
        if sign > self._ended:
            self._seconds = self._least
        if now - max(since, sign, self._ended) <= self._seconds:
            return False
        self._seconds = min(2 * self._seconds, _MOST_PATIENCE * self._least)
        self._ended = now
        return True
