# SPDX-License-Identifier: MIT
"""A connecting socket that is watched: why it cannot connect, and when to replace it."""

import time
from collections.abc import Callable
from typing import Any

import zmq

from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection_monitor import ConnectionMonitor
from tsfusion.wire.sockets.curve import ClientKeys

_RETRY_INTERVAL = 2.0  # seconds; an allowed key is let in soon, a forbidden one is no burden
MOST_HOPS = 4  # from server to server, after a map that moved


class ServerLink:
    """One connection to the server, over one socket after another. For one thread.

    A host name may have an IPv4 and an IPv6 address. If nobody listens at one address, the link tries the
    other. If ZeroMQ gives up, `check` opens a new socket after a while.

    Attributes:
        socket: the present socket.
        monitor: its monitor, whose socket becomes readable when `check` has news.
        problem: why there is no connection; empty with one, or while nothing is known.
        due: time of the next `check` without any event (`time.monotonic()`); 0 if only events need one.

    Raises:
        zmq.ZMQError: when no socket can be opened, also later by `check`, `reopen` and `connect_to`: then
            call `close`.
    """

    def __init__(
        self,
        context: "zmq.Context[Any]",
        make: Callable[["zmq.Context[Any]", ClientKeys | None], sockets.AnySocket],
        address: str,
        keys: ClientKeys | None,
    ) -> None:
        self.problem = ""
        self.address = address
        self._context = context
        self._make = make
        self._keys = keys
        self.due = 0.0
        self._made_before = 0  # connections of earlier sockets
        self._is_name = sockets.is_name(address)
        self._named_ipv6 = self._tried_both = False  # addresses of a host name: IPv6 in use, both tried
        self._open()

    def _open(self) -> None:
        self.socket = self._make(self._context, self._keys)
        try:
            self.monitor = ConnectionMonitor(self.socket, self.address, self._keys)
        except zmq.ZMQError:
            self.socket.close()
            raise
        self._cuts = 0  # connections that ended, and connections made after them
        sockets.connect(self.socket, self.address, named_ipv6=self._named_ipv6)

    @property
    def made(self) -> int:
        """Number of connections made so far. Messages sent over earlier connections may be lost."""
        return self._made_before + self.monitor.made

    @property
    def finds_nobody(self) -> bool:
        """True if nobody listened at the last attempt to connect, on either address of a name."""
        return self.monitor.retrying and (self._tried_both or not self._is_name)

    def reopen(self) -> None:
        """Replace the socket. Unsent messages of the old one are lost."""
        self.due = 0.0
        self._made_before = self.made
        self.close()
        self._open()

    def connect_to(self, address: str) -> None:
        """Connect to another address. Unsent messages of the old connection are lost."""
        self.address, self.problem = address, ""
        self._is_name = sockets.is_name(address)
        self._named_ipv6 = self._tried_both = False
        self.reopen()

    def check(self, now: float) -> tuple[str | None, bool]:
        """Read the events, and connect again when that is due.

        Returns:
            The problem if it is a new one ("" when it is over, None without news). True if a connection
                ended, or was replaced, since the last call: messages sent in between may be lost.
        """
        news = self.monitor.problem()
        cuts = self.monitor.lost + max(self.monitor.made - 1, 0)
        ended, self._cuts = cuts > self._cuts, cuts
        if news == self.problem:
            news = None
        self.problem = self.problem if news is None else news
        if self.monitor.gave_up or (self._is_name and self.monitor.retrying):
            ended |= self._try_again(now)
        else:
            self.due = 0.0
        return news, ended

    def _try_again(self, now: float) -> bool:
        """Open a new socket if it is time. Return True if it was, and an earlier socket was connected."""
        is_unknown = self.monitor.retrying and not self._tried_both
        if not is_unknown and now < (self.due or now + 1):
            self.due = self.due or now + _RETRY_INTERVAL
            return False
        if self.monitor.retrying:
            self._tried_both |= self._named_ipv6
            self._named_ipv6 = not self._named_ipv6
        self.reopen()
        return self._made_before > 0

    def close(self, linger_ms: int = 0) -> None:
        """Close the link. Unsent messages have `linger_ms` milliseconds to leave."""
        self.monitor.close()
        self.socket.close(linger_ms)


class Whereabouts:
    """Server of a map, for a client that goes where the servers say that the map is now.

    Args:
        place: data and control address of the first server.
        has_keys: True if the client knows the servers by their keys.

    Attributes:
        place: data and control address of the server that has the map, as far as is known.
        hops: number of servers that sent the client on since one let it in.
    """

    def __init__(self, place: tuple[str, str], *, has_keys: bool) -> None:
        self.home = self.place = place
        self.hops = 0
        self._has_keys = has_keys
        self._since = 0.0  # time.monotonic(), when a server let the client in or sent it on

    def follow(self, data: str, control: str) -> tuple[str, str]:
        """Go to the server that another one names. An empty `control` is the port after that of `data`.

        Raises:
            TransportError: for malformed addresses. Without keys also for other machines: anybody may have
                sent them.
        """
        try:
            place = (
                sockets.connect_address(data),
                sockets.connect_address(sockets.control_address(data, control or None)),
            )
            for one in place:
                sockets.check_reachable(one, has_keys=self._has_keys)
        except InvalidConfig as error:
            raise TransportError(
                f"the server says that the map is at {data}, but this client cannot go there: {error}"
            ) from error
        self.place, self.hops, self._since = place, self.hops + 1, time.monotonic()
        return place

    def let_in(self) -> None:
        """Note that the server has let the client in."""
        self.hops, self._since = 0, time.monotonic()

    def is_locked_out(self, seconds: float) -> bool:
        """True if a server that the client was sent to has not let it in for so long."""
        return self.place != self.home and time.monotonic() - self._since > seconds

    def go_home(self) -> tuple[str, str]:
        """Go back to the first server, and return it."""
        self.place, self.hops = self.home, self.hops + 1
        return self.place
