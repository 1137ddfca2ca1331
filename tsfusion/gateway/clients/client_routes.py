# SPDX-License-Identifier: MIT
"""Keep track of a server's clients: their sessions, message routes and health."""

import time
from array import array
from collections import OrderedDict, deque
from collections.abc import Iterator
from typing import Literal

from msgspec import Struct, field

from tsfusion.core.config import SERVER_SESSION
from tsfusion.gateway.health.problems import Problem
from tsfusion.gateway.ports.ports import OutgoingAnswer
from tsfusion.wire.messages.health import ClientHealth, ClientState
from tsfusion.wire.messages.messages import Hello, Ping, ToClient
from tsfusion.wire.records.record_header import RecordHeader

_MAX_SESSIONS = 100_000  # of a map; each takes some 60 bytes in every later checkpoint
SeqOrder = Literal["next", "duplicate", "gap"]


class Session(Struct, eq=False):
    """Progress of one session: the records of one spool, from one client, in one map's journal."""

    key: bytes  # 16 bytes that the client drew
    number: int  # position in `Sessions`
    client: str = ""  # name under which the owner's key is allowed; empty without keys
    durable: int = 0  # the highest seq that is journaled
    fused: int = 0  # the highest seq that the map has taken or rejected
    in_map: int = 0  # the same for the present fuser: a new fuser begins at the checkpoint again
    # Indices of its keyframes that are not forgotten
    entries: "array[int]" = field(default_factory=lambda: array("q"))
    handed: int = 0  # number of these that were handed to the fuser
    corrections: int = 0  # records of corrected poses that came
    keyframes: int = 0  # in the journal at the start, and journaled since
    answered: int = 0  # number of `keyframes` that the map has taken or rejected
    rejected: int = 0  # number of `answered` that were rejected since the start
    world: str | None = None  # world of its first record; None without a record in the journal

    @property
    def owner(self) -> str:
        """Client's name, or the session's id where there are no keys: who shares in the fuser's time."""
        return self.client or self.key.hex()

    def belongs_to(self, client: str) -> bool:
        """True if a client has the right to continue the session. A session without keys is open to all."""
        return not self.client or not client or self.client == client


class Sessions:
    """All sessions in a map's journal.

    A map has one coordinate frame, that of its first journaled session. Another session is let in when it
    names a world that the map has, or when its client declares that it shares the frame.
    """

    def __init__(self) -> None:
        self._by_key: dict[bytes, Session] = {}
        self._all: list[Session] = []
        self._worlds: set[str] = set()

    def __iter__(self) -> Iterator[Session]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    @property
    def of_clients(self) -> int:
        return len(self) - (SERVER_SESSION in self._by_key)

    def get(self, key: bytes) -> Session | None:
        """Return the session with this id (`key`), or None if it has no record in the journal."""
        return self._by_key.get(key)

    def room_for(self, key: bytes) -> bool:
        """True if the session with this id (`key`) exists, or the map may have one more."""
        return key in self._by_key or len(self) < _MAX_SESSIONS

    def shares_frame(self, key: bytes, record: Hello | RecordHeader) -> bool:
        """True if a session's poses are in this map's coordinate frame, by world or by declaration.

        Every record is checked, not only the greeting: two sessions may greet a map that does not exist yet.
        The map then has the world of the first record.
        """
        is_known = not self._all or key in self._by_key or record.world in self._worlds
        return is_known or record.same_frame

    def open(self, key: bytes, client: str = "", world: str | None = None) -> Session:
        """Return the session with this id (`key`). Make it if it is new.

        Args:
            world: world of its record; None opens it without a record.
        """
        session = self._by_key.get(key)
        if session is None:
            session = self._by_key[key] = Session(key, len(self._all), client)
            self._all.append(session)
        if session.world is None and world is not None and key != SERVER_SESSION:
            session.world = world
            self._worlds.add(world)
        return session

    def admit(self, key: bytes, seq: int, previous: int, taken: int = 0) -> SeqOrder:
        """Return "next" if record `seq` is to be journaled, else "duplicate" or "gap".

        Args:
            previous: the number before `seq` that the client still has.
            taken: highest seq of the session that is about to be journaled; 0 without one.

        Keyframes are journaled in order, so one number for each session identifies every earlier keyframe.
        Duplicates are found exactly, in constant memory.
        """
        durable = max(self.progress(key)[0], taken)
        if seq <= durable:
            return "duplicate"
        return "next" if previous <= durable else "gap"

    def progress(self, key: bytes) -> tuple[int, int]:
        """Return the highest durable seq and the highest fused seq of a session."""
        session = self._by_key.get(key)
        return (session.durable, session.fused) if session else (0, 0)

    def numbered(self, number: int) -> Session:
        return self._all[number]


_STEP = 5.0  # seconds that one count covers
_STEPS = 12
_FEWEST = 3  # fewer keyframes tell nothing about a client
_NEARLY_ALL = 0.9
_HELD_AFTER = 10.0  # a client without one accepted keyframe for so many seconds has a problem
_REASON_CHARACTERS = 200


class RecentFates:
    """Outcomes of one client's keyframes in the last minute: fused, refused or rejected, held."""

    def __init__(self) -> None:
        self._counts: deque[tuple[int, int, int]] = deque(maxlen=_STEPS + 1)  # step, fused, refused
        self._why = ""
        self._held_since = self._held_last = 0.0  # `time.monotonic()`; 0 if the last keyframe was journaled

    def fused(self) -> None:
        """Count a keyframe that is now in the map."""
        self._count(1, 0)

    def turned_away(self, why: str) -> None:
        """Count a keyframe that was refused or rejected, for the reason `why`."""
        self._why = why[:_REASON_CHARACTERS]
        self._count(0, 1)

    def _count(self, good: int, bad: int) -> None:
        step = int(time.monotonic() // _STEP)
        if self._counts and self._counts[-1][0] == step:
            _, good_before, bad_before = self._counts.pop()
            good, bad = good + good_before, bad + bad_before
        self._counts.append((step, good, bad))

    def held(self) -> None:
        """Record that a keyframe was not accepted for now (a hold), because of a quota or a full disk."""
        self._held_last = time.monotonic()
        self._held_since = self._held_since or self._held_last

    def taken(self) -> None:
        """Record that a keyframe was journaled, which ends a hold."""
        self._held_since = 0.0

    def problem(self, hold: str = "") -> str:
        """Return the reason why hardly any keyframe of the client reaches the map; empty without a problem.

        Args:
            hold: reason of the last hold; empty if it does not concern the client.
        """
        now = time.monotonic()
        recent = [one for one in self._counts if one[0] > now // _STEP - _STEPS]
        good, bad = (sum(one[column] for one in recent) for column in (1, 2))
        if bad >= _FEWEST and bad >= _NEARLY_ALL * (good + bad):
            which = "none" if not good else "next to none"
            return f"{which} of its {good + bad} keyframes of the last minute came into the map: {self._why}"
        if hold and self._held_since and now - self._held_since > _HELD_AFTER > now - self._held_last:
            return f"every keyframe is held off: {hold}"
        return ""


_MAX_ROUTES = 1024
_MAX_ROUTES_OF_A_NAME = 64  # limit for a server with keys
_MIN_NEW_ROUTES = 16  # routes of a name reserved for clients that have sent no keyframe yet
_SILENT_AFTER = 5.0  # seconds without a message; a client sends two a second
ABANDONED_AFTER = 30.0  # seconds of silence: the client is gone, and another one can take its session
_LARGEST_OFFSET_NS = 10 * 366 * 86_400 * 10**9  # ten years; monotonic clocks start with their machine
_LARGEST_BOUND_NS = 3600 * 10**9


class ClientRoute(Struct, eq=False):
    """Connected client with one session, and the connection over which messages reach it."""

    session: bytes  # 16 bytes
    map: str  # name of the map that its keyframes go into
    identity: bytes  # of its connection to the control socket
    client: str = ""  # name under which its key is allowed; empty without keys
    offset_ns: int | None = None  # server clock minus client clock, as the client measured it
    bound_ns: int = 0  # error bound of the offset
    waiting: int = 0  # this and `skipped`: figures of its last Ping
    skipped: dict[str, int] = field(default_factory=dict)
    received_bytes: int = 0
    refused: int = 0  # records that were refused for good
    damaged: tuple[int, int] = (0, 0)  # seq of the last record that came damaged, and how often in a row
    address: str = ""  # address of its machine; empty if not known
    left: bool = False  # True after its goodbye
    scans: bool = False  # True if a keyframe of the session is in the journal
    last_message: float = 0.0  # `time.monotonic()`
    held_until: float = 0.0  # until this time its keyframes are not accepted, for `hold_reason`
    hold_reason: str = ""
    hold_message: str = ""
    fates: RecentFates = field(default_factory=RecentFates)

    def open_to(self, client: str) -> bool:
        """True if `client` may take over the session: it is its own, or the present client is silent."""
        return self.client == client or time.monotonic() - self.last_message >= ABANDONED_AFTER

    def update(self, ping: Ping) -> None:
        """Store the counts and clock offset of the client's Ping; an impossible offset is ignored."""
        self.waiting, self.skipped, self.left = ping.waiting, ping.skipped, ping.leaving
        possible = abs(ping.offset_ns or 0) <= _LARGEST_OFFSET_NS and 0 <= ping.bound_ns <= _LARGEST_BOUND_NS
        self.offset_ns, self.bound_ns = (ping.offset_ns, ping.bound_ns) if possible else (None, 0)

    def state(self, now: float) -> ClientState:
        """Return the state of the client at `now` (`time.monotonic()`)."""
        silence = now - self.last_message
        if self.left or silence >= ABANDONED_AFTER:
            return "gone"
        return "silent" if silence >= _SILENT_AFTER else "connected"

    @property
    def problem(self) -> Problem | None:
        """Problem of a client whose keyframes hardly ever reach the map; None without one."""
        hold = "" if self.hold_reason == "disk" else self.hold_message  # its map reports the disk already
        text = self.fates.problem(hold)
        who = self.client or f"at {self.address or 'an unknown address'}"
        return Problem(text, self.map, f"client {who}, session {self.session.hex()[:8]}") if text else None

    def health(self, now: float, session: Session | None) -> ClientHealth:
        own = session or Session(self.session, -1)
        return ClientHealth(
            client=self.client,
            session=self.session.hex()[:8],
            map=self.map,
            heard_s=now - self.last_message,
            durable=own.keyframes,
            fused=own.answered - own.rejected,
            received_bytes=self.received_bytes,
            waiting=self.waiting,
            skipped=self.skipped,
            held=self.hold_reason if now < self.held_until else "",
            corrections=own.corrections,
            state=self.state(now),
            address=self.address,
            refused=self.refused,
            rejected=own.rejected,
        )


class ClientRoutes:
    """Connected clients by session, to send messages to them.

    When there are too many routes, the client name with the most routes loses the one that is silent for
    longest. So nobody's greetings push out the clients of others. Within a name, clients without a keyframe
    go first.
    """

    def __init__(self, out: list[OutgoingAnswer]) -> None:
        self._out = out
        self._by_session: dict[bytes, ClientRoute] = {}
        self._names: dict[str, _NameRoutes] = {}

    def __iter__(self) -> Iterator[ClientRoute]:
        return iter(self._by_session.values())

    def connect(
        self, session: bytes, map_name: str, identity: bytes, client: str = "", *, scans: bool = False
    ) -> ClientRoute:
        """Use this connection for messages to a session's client from now on. Return its route."""
        route = self._by_session.get(session)
        if route is None or route.client != client or route.map != map_name:
            self._drop(route)
            route = self._by_session[session] = ClientRoute(session, map_name, identity, client)
        route.identity, route.left = identity, False
        self._refresh(route, scans=scans)
        of_name = self._names[client]
        if client and len(of_name) > _MAX_ROUTES_OF_A_NAME:
            self._drop(of_name.first_to_drop())
        if len(self._by_session) > _MAX_ROUTES:
            self._drop(max(self._names.values(), key=len).first_to_drop())
        return route

    def mark_alive(self, session: bytes, client: str, *, scans: bool = False) -> ClientRoute | None:
        """Record that a session's client sent a message. Return its route, or None if it has none.

        Args:
            scans: True if the message was a good keyframe.
        """
        route = self._by_session.get(session)
        if route is None or route.client != client:
            return None
        self._refresh(route, scans=scans)
        return route

    def _refresh(self, route: ClientRoute, *, scans: bool) -> None:
        """Record that a route's client is alive: of its name's routes it is dropped last."""
        route.last_message = time.monotonic()
        of_name = self._names.setdefault(route.client, _NameRoutes())
        of_name.remove(route)
        route.scans |= scans
        of_name.add(route)

    def _drop(self, route: ClientRoute | None) -> None:
        if route is not None:
            del self._by_session[route.session]
            of_name = self._names[route.client]
            of_name.remove(route)
            if not len(of_name):
                del self._names[route.client]

    def get(self, session: bytes) -> ClientRoute | None:
        """Return the route to a session's client, or None if it is not connected."""
        return self._by_session.get(session)

    def may_continue(self, session: bytes, client: str, sessions: Sessions) -> bool:
        """True if a client may continue a session: no other client journaled into it, or holds it."""
        known, route = sessions.get(session), self.get(session)
        return (known is None or known.belongs_to(client)) and (route is None or route.open_to(client))

    def send(self, session: bytes, message: ToClient) -> None:
        """Send a message to a session's client if it is connected."""
        route = self._by_session.get(session)
        if route is not None:
            self._out.append(OutgoingAnswer(route.identity, message))

    def clear(self) -> None:
        """Remove all routes, after every connection was dropped."""
        self._by_session.clear()
        self._names.clear()


class _NameRoutes:
    """Routes of the clients that share one name. The client that is silent for longest comes first."""

    def __init__(self) -> None:
        self._new: OrderedDict[bytes, ClientRoute] = OrderedDict()
        self._scan: OrderedDict[bytes, ClientRoute] = OrderedDict()

    def __len__(self) -> int:
        return len(self._new) + len(self._scan)

    def add(self, route: ClientRoute) -> None:
        """Add a route at the end, because its client sent the last message."""
        (self._scan if route.scans else self._new)[route.session] = route

    def remove(self, route: ClientRoute) -> None:
        self._new.pop(route.session, None)
        self._scan.pop(route.session, None)

    def first_to_drop(self) -> ClientRoute:
        """Return the route to drop. Some routes are reserved for new clients: old ones shut nobody out."""
        routes = self._new if len(self._new) > _MIN_NEW_ROUTES or not self._scan else self._scan
        return next(iter(routes.values()))
