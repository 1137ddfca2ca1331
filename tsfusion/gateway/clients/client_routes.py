# SPDX-License-Identifier: MIT
"""The clients of a server: their sessions, where messages for these go, how each is doing, who may send."""

import time
from array import array
from collections import Counter, OrderedDict, deque
from collections.abc import Iterator
from typing import Literal

import zmq
from msgspec import Struct, field

from tsfusion.core.config import SERVER_SESSION
from tsfusion.gateway.health.problems import Problem
from tsfusion.gateway.ports.access_control import GUEST, AccessControl
from tsfusion.gateway.ports.ports import Ports
from tsfusion.wire.keys.key_folder import AllowedMaps
from tsfusion.wire.messages.health import ClientHealth, ClientState
from tsfusion.wire.messages.messages import Hello, Ping, ToClient
from tsfusion.wire.records.record_header import RecordHeader

_MAX_SESSIONS = 100_000  # of a map; each takes some 60 bytes of every checkpoint, for ever
SeqOrder = Literal["next", "duplicate", "gap"]


class Session(Struct, eq=False):
    """One client's stream of keyframes."""

    key: bytes  # 16 bytes that the client drew
    number: int  # position in `Sessions`
    client: str = ""  # the name that the owner's key is allowed under; empty = it came without keys
    durable: int = 0  # the highest seq that is journaled
    fused: int = 0  # the highest seq that the map has taken or rejected
    in_map: int = 0  # the same for the present fuser: one that takes over begins at the checkpoint again
    # Indices of its keyframes that are not forgotten
    entries: "array[int]" = field(default_factory=lambda: array("q"))
    handed: int = 0  # how many of these the fuser was given
    corrections: int = 0  # records of corrected poses that came
    keyframes: int = 0  # in the journal at the start, and journaled since
    answered: int = 0  # of these, the keyframes that the map has taken or rejected
    rejected: int = 0  # of these, rejected since the start
    world: str | None = None  # that its first record names; None = no record of it is in the journal

    @property
    def owner(self) -> str:
        """The name that gets a turn in the fair queue: the client, or where there are no keys the session."""
        return self.client or self.key.hex()

    def belongs_to(self, client: str) -> bool:
        """True if a client may go on with the session. One that came without keys is anyone's."""
        return not self.client or not client or self.client == client


class Sessions:
    """All sessions of a map's journal.

    A map has one coordinate frame. The first session to be journaled brings it; another is let in when it
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
        """The session of a key, or None when it has no keyframe in the journal."""
        return self._by_key.get(key)

    def room_for(self, key: bytes) -> bool:
        """True if a key has a session, or may still get one."""
        return key in self._by_key or len(self) < _MAX_SESSIONS

    def shares_frame(self, key: bytes, record: Hello | RecordHeader) -> bool:
        """True if a session's records are, or are declared to be, in the coordinate frame of this map."""
        is_known = not self._all or key in self._by_key or record.world in self._worlds
        return is_known or record.same_frame

    def open(self, key: bytes, client: str = "", world: str | None = None) -> Session:
        """The session of a key, made when new.

        Args:
            world: that its record names; None = it is opened for no record.
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
        """Order of keyframe `seq`, to be journaled if "next"; the client has none between `previous` and it.

        Args:
            taken: the highest seq of the session that is about to be journaled; 0 = none is.

        Keyframes are taken in order only, so one number a session is enough to know every keyframe that ever
        came: exact de-duplication in constant memory.
        """
        durable = max(self.progress(key)[0], taken)
        if seq <= durable:
            return "duplicate"
        return "next" if previous <= durable else "gap"

    def progress(self, key: bytes) -> tuple[int, int]:
        """The highest seq of a session that is durable, and that is fused."""
        session = self._by_key.get(key)
        return (session.durable, session.fused) if session else (0, 0)

    def numbered(self, number: int) -> Session:
        """A session by its number."""
        return self._all[number]


_STEP = 5.0  # seconds that one count covers
_STEPS = 12
_FEWEST = 3  # keyframes that say something about a client
_NEARLY_ALL = 0.9
_HELD_AFTER = 10.0  # seconds in which every keyframe was held off
_REASON_CHARACTERS = 200


class RecentFates:
    """Counts of the keyframes of one client: in the map, turned away for good, held off for now."""

    def __init__(self) -> None:
        self._counts: deque[tuple[int, int, int]] = deque(maxlen=_STEPS + 1)  # step, in the map, turned away
        self._why = ""
        self._held_since = self._held_last = 0.0  # `time.monotonic()`; 0 = the last keyframe was taken

    def fused(self) -> None:
        """Count a keyframe that came into the map."""
        self._count(1, 0)

    def turned_away(self, why: str) -> None:
        """Count a keyframe that was refused at the door, or that the map could not take."""
        self._why = why[:_REASON_CHARACTERS]
        self._count(0, 1)

    def _count(self, good: int, bad: int) -> None:
        step = int(time.monotonic() // _STEP)
        if self._counts and self._counts[-1][0] == step:
            _, good_before, bad_before = self._counts.pop()
            good, bad = good + good_before, bad + bad_before
        self._counts.append((step, good, bad))

    def held(self) -> None:
        """Note that a keyframe was held off."""
        self._held_last = time.monotonic()
        self._held_since = self._held_since or self._held_last

    def taken(self) -> None:
        """Note that a keyframe was taken into the journal."""
        self._held_since = 0.0

    def problem(self, hold: str = "") -> str:
        """Reason why next to none of the client's keyframes comes into the map; empty = they do.

        Args:
            hold: why the server held keyframes off the last time; empty = that is no problem of the client.
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
_MAX_ROUTES_OF_A_NAME = 64  # where there are keys
_MIN_NEW_ROUTES = 16  # places of a name for clients that have sent no keyframe yet
_SILENT_AFTER = 5.0  # seconds without a message; a client sends two a second
ABANDONED_AFTER = 30.0  # seconds of silence: the client is gone, and another may take over its session
_LARGEST_OFFSET_NS = 10 * 366 * 86_400 * 10**9  # ten years; monotonic clocks begin when a machine does
_LARGEST_BOUND_NS = 3600 * 10**9


class ClientRoute(Struct, eq=False):
    """A client that is connected."""

    session: bytes  # 16 bytes
    map: str  # that its keyframes go into
    identity: bytes  # of its connection to the control socket
    client: str = ""  # the name its key is allowed under; empty = no keys
    offset_ns: int | None = None  # server clock minus client clock, as the client measured it
    bound_ns: int = 0  # how wrong that may be
    waiting: int = 0  # this and `skipped`: figures of its last Ping
    skipped: dict[str, int] = field(default_factory=dict)
    received_bytes: int = 0
    refused: int = 0  # records that were turned away for good
    damaged: tuple[int, int] = (0, 0)  # seq of the record that came damaged last, and how often in a row
    address: str = ""  # of its machine; empty = not known
    left: bool = False  # whether it said goodbye
    scans: bool = False  # whether a keyframe of the session is in the journal
    last_message: float = 0.0  # `time.monotonic()`, as the next
    held_until: float = 0.0  # until then its keyframes are turned away, for `hold_reason`
    hold_reason: str = ""
    hold_message: str = ""
    fates: RecentFates = field(default_factory=RecentFates)

    @property
    def place(self) -> tuple[str, bytes]:
        """Map and session."""
        return self.map, self.session

    def open_to(self, client: str) -> bool:
        """True if a client may go on with the session: its own, or one whose client is long silent."""
        return self.client == client or time.monotonic() - self.last_message >= ABANDONED_AFTER

    def update(self, ping: Ping) -> None:
        """Note how the client is doing. A clock offset that is impossible is not believed."""
        self.waiting, self.skipped, self.left = ping.waiting, ping.skipped, ping.leaving
        possible = abs(ping.offset_ns or 0) <= _LARGEST_OFFSET_NS and 0 <= ping.bound_ns <= _LARGEST_BOUND_NS
        self.offset_ns, self.bound_ns = (ping.offset_ns, ping.bound_ns) if possible else (None, 0)

    def state(self, now: float) -> ClientState:
        """State of the client at `now` (`time.monotonic()`)."""
        silence = now - self.last_message
        if self.left or silence >= ABANDONED_AFTER:
            return "gone"
        return "silent" if silence >= _SILENT_AFTER else "connected"

    @property
    def problem(self) -> Problem | None:
        """Reason why next to none of its keyframes comes into the map; None = they do."""
        hold = "" if self.hold_reason == "disk" else self.hold_message  # of the disk its map tells already
        text = self.fates.problem(hold)
        who = self.client or f"at {self.address or 'an unknown address'}"
        return Problem(text, self.map, f"client {who}, session {self.session.hex()[:8]}") if text else None

    def health(self, now: float, session: Session | None) -> ClientHealth:
        """Health of the client."""
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
    """The connected clients, by session, and messages to them.

    When there are too many, the name with the most loses its client that is silent for longest: nobody's
    greetings push out the clients of others. Within a name, those that never sent a keyframe go first.
    """

    def __init__(self, ports: Ports) -> None:
        self._ports = ports
        self._by_session: dict[bytes, ClientRoute] = {}
        self._names: dict[str, _NameRoutes] = {}

    def __iter__(self) -> Iterator[ClientRoute]:
        return iter(self._by_session.values())

    def connect(
        self, session: bytes, map_name: str, identity: bytes, client: str = "", *, scans: bool = False
    ) -> ClientRoute:
        """Send messages for a session to this connection from now on."""
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
        """Note a message of a session's client; its route, or None when it is not connected.

        Args:
            scans: whether it was a good keyframe.
        """
        route = self._by_session.get(session)
        if route is None or route.client != client:
            return None
        self._refresh(route, scans=scans)
        return route

    def _refresh(self, route: ClientRoute, *, scans: bool) -> None:
        """Make a route the last of its name to be dropped."""
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
        """The route to a session's client; None when it is not connected."""
        return self._by_session.get(session)

    def send(self, session: bytes, message: ToClient) -> None:
        """Send a message to a session's client, if that is connected."""
        route = self._by_session.get(session)
        if route is not None:
            self._ports.reply(route.identity, message)

    def clear(self) -> None:
        """Forget all clients: every connection was dropped."""
        self._by_session.clear()
        self._names.clear()


class _NameRoutes:
    """The routes of one client name; the one that is silent for longest comes first."""

    def __init__(self) -> None:
        self._new: OrderedDict[bytes, ClientRoute] = OrderedDict()
        self._scan: OrderedDict[bytes, ClientRoute] = OrderedDict()

    def __len__(self) -> int:
        return len(self._new) + len(self._scan)

    def add(self, route: ClientRoute) -> None:
        """Add the route whose client sent the last message."""
        (self._scan if route.scans else self._new)[route.session] = route

    def remove(self, route: ClientRoute) -> None:
        """Remove a route, if it is one of the name's."""
        self._new.pop(route.session, None)
        self._scan.pop(route.session, None)

    def first_to_drop(self) -> ClientRoute:
        """The route to do without. Some places stay for new clients: old ones shut nobody out."""
        routes = self._new if len(self._new) > _MIN_NEW_ROUTES or not self._scan else self._scan
        return next(iter(routes.values()))


class Admission:
    """The checks that every socket of a server makes, and their counter."""

    def __init__(self, access: AccessControl, routes: ClientRoutes) -> None:
        self.refused: Counter[str] = Counter()  # messages that were not taken, by reason
        self._access = access
        self._routes = routes

    def client_of(self, frame: zmq.Frame) -> str | None:
        """The client that sent a frame, empty without keys; None when it has no access, which is counted."""
        client = self._access.client_of(frame)
        if client is None:
            self.refused["key"] += 1
        return client

    def maps_of(self, client: str) -> AllowedMaps:
        """The maps that a client may use."""
        return self._access.maps_of(client)

    def denial_of_map(self, client: str, map_name: str, *, sends: bool = False) -> str:
        """Reason why a client may not use a map, which is counted; empty = it may."""
        maps = self._access.maps_of(client)
        if map_name in maps and not (sends and client == GUEST):
            return ""
        self.refused["forbidden"] += 1
        return "this key may only watch" if client == GUEST else maps.denial(map_name)

    def owns(self, sessions: Sessions, key: bytes, client: str) -> bool:
        """True if a client may go on with a session: no other client has journaled it, or is connected."""
        session, route = sessions.get(key), self._routes.get(key)
        return (session is None or session.belongs_to(client)) and (route is None or route.open_to(client))
