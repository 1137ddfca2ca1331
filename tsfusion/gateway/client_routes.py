# SPDX-License-Identifier: MIT
"""Where the answers for a session go: the clients that said hello, and how they said they are doing."""

import time
from collections import OrderedDict
from collections.abc import Iterator

from msgspec import Struct, field

from tsfusion.wire.health import ClientHealth
from tsfusion.wire.messages import Ping

_MAX_ROUTES = 1024
_MAX_ROUTES_OF_A_NAME = 64  # where there are keys
_NEW_ROUTES = 16  # so many of a name always have a place without having sent anything
_TAKEN = 30.0  # seconds of silence after which another client may take a session that nothing came of
_LARGEST_OFFSET_NS = 10 * 366 * 86_400 * 10**9  # ten years; monotonic clocks begin when a machine does
_LARGEST_BOUND_NS = 3600 * 10**9


class ClientRoute(Struct, eq=False):
    """A live client.

    Attributes:
        session: its key.
        map: where the keyframes go.
        identity: of its connection to the control socket.
        client: the name its key is allowed under; empty = no keys.
        offset_ns: server clock minus client clock, as the client measured it; true to within `bound_ns`.
        waiting, skipped: as its last Ping said.
        scans: a keyframe of it is in the journal.
        heard: `time.monotonic()` of its last message.
        held_until: nothing is taken from it until then, because of `held`.
    """

    session: bytes
    map: str
    identity: bytes
    client: str = ""
    offset_ns: int | None = None
    bound_ns: int = 0
    waiting: int = 0
    skipped: dict[str, int] = field(default_factory=dict)
    received_bytes: int = 0
    scans: bool = False
    heard: float = 0.0
    held_until: float = 0.0
    held: str = ""

    @property
    def place(self) -> tuple[str, bytes]:
        """Map and session."""
        return self.map, self.session

    def open_to(self, client: str) -> bool:
        """Whether this client may go on with the session: it is its own, or its client is silent for long."""
        return self.client == client or time.monotonic() - self.heard >= _TAKEN

    def said(self, ping: Ping) -> None:
        """How the client is doing. A clock that cannot be is not believed."""
        self.waiting, self.skipped = ping.waiting, ping.skipped
        possible = abs(ping.offset_ns or 0) <= _LARGEST_OFFSET_NS and 0 <= ping.bound_ns <= _LARGEST_BOUND_NS
        self.offset_ns, self.bound_ns = (ping.offset_ns, ping.bound_ns) if possible else (None, 0)

    def health(self, now: float, progress: tuple[int, int], corrections: int) -> ClientHealth:
        """How the client is doing.

        Args:
            progress: the highest seq that is durable, and that is fused.
            corrections: records of corrected poses that the session has in the journal.
        """
        durable, fused = progress
        return ClientHealth(
            client=self.client,
            session=self.session.hex()[:8],
            map=self.map,
            heard_s=now - self.heard,
            durable=durable,
            fused=fused,
            received_bytes=self.received_bytes,
            waiting=self.waiting,
            skipped=self.skipped,
            held=self.held if now < self.held_until else "",
            corrections=corrections,
        )


class ClientRoutes:
    """The live clients, by session. When they are too many, the longest unheard of the largest name goes:
    nobody's greetings push out others. Within a name, those that never sent a keyframe go first."""

    def __init__(self) -> None:
        self._by_session: dict[bytes, ClientRoute] = {}
        self._names: dict[str, _NameRoutes] = {}

    def __iter__(self) -> Iterator[ClientRoute]:
        return iter(self._by_session.values())

    def connect(
        self, session: bytes, map_name: str, identity: bytes, client: str = "", *, scans: bool = False
    ) -> ClientRoute:
        """Answers for this session go to this connection from now on.

        Args:
            scans: there is something of it in the journal.
        """
        route = self._by_session.get(session)
        if route is None or route.client != client or route.map != map_name:
            self._drop(route)
            route = self._by_session[session] = ClientRoute(session, map_name, identity, client)
        route.identity = identity
        route.scans |= scans
        self.heard(route)
        crowd = self._names[client]
        if client and len(crowd) > _MAX_ROUTES_OF_A_NAME:
            self._drop(crowd.least())
        if len(self._by_session) > _MAX_ROUTES:
            self._drop(max(self._names.values(), key=len).least())
        return route

    def heard(self, route: ClientRoute, *, scans: bool = False) -> None:
        """It is alive: now the last of those that could be pushed out.

        Args:
            scans: it sent a keyframe.
        """
        route.heard = time.monotonic()
        crowd = self._names.setdefault(route.client, _NameRoutes())
        crowd.remove(route)
        route.scans |= scans
        crowd.add(route)

    def _drop(self, route: ClientRoute | None) -> None:
        if route is not None:
            del self._by_session[route.session]
            crowd = self._names[route.client]
            crowd.remove(route)
            if not len(crowd):
                del self._names[route.client]

    def get(self, session: bytes) -> ClientRoute | None:
        """The connection of a session's client, if it said hello here."""
        return self._by_session.get(session)

    def clear(self) -> None:
        """All connections are gone."""
        self._by_session.clear()
        self._names.clear()


class _NameRoutes:
    """The routes of one client name, longest unheard first."""

    def __init__(self) -> None:
        self._new: OrderedDict[bytes, ClientRoute] = OrderedDict()
        self._scan: OrderedDict[bytes, ClientRoute] = OrderedDict()

    def __len__(self) -> int:
        return len(self._new) + len(self._scan)

    def add(self, route: ClientRoute) -> None:
        """The last heard."""
        (self._scan if route.scans else self._new)[route.session] = route

    def remove(self, route: ClientRoute) -> None:
        """If it is here."""
        self._new.pop(route.session, None)
        self._scan.pop(route.session, None)

    def least(self) -> ClientRoute:
        """Which to do without. Some are always new ones: nobody is shut out by all who ever scanned."""
        crowd = self._new if len(self._new) > _NEW_ROUTES or not self._scan else self._scan
        return next(iter(crowd.values()))
