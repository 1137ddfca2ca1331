# SPDX-License-Identifier: MIT
"""What the gateway knows of clients and keyframes: policy and bookkeeping, no sockets."""

from array import array
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Iterable
from typing import Literal

import numpy as np
from msgspec import Struct

from tsfusion import ledger
from tsfusion.journal import Position, Scan
from tsfusion.transport.messages import Spread, Stamps

_MAX_ROUTES = 1024
_DELAYS = 1024
Verdict = Literal["next", "duplicate", "gap"]


class Session(Struct):
    """One client's stream of keyframes.

    Attributes:
        number: its place in `Sessions`.
        durable: the highest seq that is journaled, or refused for good.
        fused: the highest that the map has taken or refused.
    """

    key: bytes
    number: int
    durable: int = 0
    fused: int = 0

    def admit(self, seq: int, previous: int) -> Verdict:
        """What to do with keyframe `seq` of a client that offers none between `previous` and it.

        Taking them only in order makes one number a session enough to know every keyframe that ever came:
        exact de-duplication in constant memory.
        """
        if seq <= self.durable:
            return "duplicate"
        return "next" if previous <= self.durable else "gap"


class Route(Struct):
    """A live client.

    Attributes:
        identity: of its connection to the control socket.
        offset_ns: server clock minus client clock, as the client measured it.
    """

    identity: bytes
    offset_ns: int | None = None


class Sessions:
    """All sessions of the journal, and the live connections of some."""

    def __init__(self) -> None:
        self._by_key: dict[bytes, Session] = {}
        self._all: list[Session] = []
        self._routes: OrderedDict[bytes, Route] = OrderedDict()  # by session key

    def __len__(self) -> int:
        return len(self._all)

    def get(self, key: bytes) -> Session | None:
        """A session that has something in the journal, or None."""
        return self._by_key.get(key)

    def open(self, key: bytes) -> Session:
        """The session of a key, made when new."""
        session = self._by_key.get(key)
        if session is None:
            session = self._by_key[key] = Session(key, len(self._all))
            self._all.append(session)
        return session

    def admit(self, key: bytes, seq: int, previous: int) -> Verdict:
        """As `Session.admit`, for a session that may not exist yet."""
        return (self._by_key.get(key) or Session(key, -1)).admit(seq, previous)

    def numbered(self, number: int) -> Session:
        """A session by its number."""
        return self._all[number]

    def connect(self, key: bytes, identity: bytes) -> Route:
        """Answers for this session go to this connection. Strangers push out the longest unheard only."""
        route = self._routes[key] = Route(identity)
        self._routes.move_to_end(key)
        while len(self._routes) > _MAX_ROUTES:
            self._routes.popitem(last=False)
        return route

    def heard(self, key: bytes) -> Route | None:
        """The connection of a session that is alive, now the last of those that strangers could push out."""
        if key in self._routes:
            self._routes.move_to_end(key)
        return self._routes.get(key)

    def route(self, key: bytes) -> Route | None:
        """The connection of a session's client, if it ever said hello here."""
        return self._routes.get(key)


class Entry(Struct, frozen=True):
    """One journaled keyframe."""

    index: int
    position: Position
    session: int
    stamps: Stamps
    captured_ns: int


_COLUMNS = (
    *("segment", "offset", "session", "seq", "captured_ns"),
    *("received_ns", "durable_ns", "fuse_start_ns", "fused_ns"),  # as in Stamps
)


class KeyframeIndex:
    """Every keyframe of the journal in order: 72 bytes each. Stamps are 0 for those of earlier runs."""

    def __init__(self) -> None:
        self._columns = {name: array("q") for name in _COLUMNS}

    def __len__(self) -> int:
        return len(self._columns["seq"])

    def recover(self, found: Iterable[Scan], sessions: Sessions) -> None:
        """Take over what the journal's scan found. A keyframe journaled twice counts once.

        (The disk refused, the client sent it again, and the first copy had been written after all.)
        """
        for record in found:
            session = sessions.open(record.session)
            if record.seq > session.durable:
                session.durable = record.seq
                self.add(record.position, session, record.seq)

    def add(
        self,
        position: Position,
        session: Session,
        seq: int,
        *,
        captured_ns: int = 0,
        received_ns: int = 0,
        durable_ns: int = 0,
    ) -> int:
        """Append a keyframe; its index."""
        place = (position.segment, position.offset, session.number, seq, captured_ns)
        values = (*place, received_ns, durable_ns, 0, 0)
        for column, value in zip(self._columns.values(), values, strict=True):
            column.append(value)
        return len(self) - 1

    def fused(self, index: int, fuse_start_ns: int, fused_ns: int) -> None:
        """Note when a keyframe entered the map."""
        self._columns["fuse_start_ns"][index] = fuse_start_ns
        self._columns["fused_ns"][index] = fused_ns

    def __getitem__(self, index: int) -> Entry:
        segment, offset, session, seq, captured, *stamps = (
            column[index] for column in self._columns.values()
        )
        return Entry(index, Position(segment, offset), session, Stamps(seq, *stamps), captured)

    def after(self, position: Position) -> int:
        """The index of the first keyframe behind a journal position."""
        return bisect_right(range(len(self)), position, key=lambda i: self[i].position)


class Delays:
    """Capture to fused of the last keyframes."""

    def __init__(self) -> None:
        self._recent_ms: deque[float] = deque(maxlen=_DELAYS)

    def add(self, captured_ns: int, fused_ns: int, offset_ns: int | None) -> None:
        """A keyframe captured at a client's time and fused at ours; skipped while either is unknown."""
        if captured_ns and offset_ns is not None:
            self._recent_ms.append((fused_ns - captured_ns - offset_ns) / 1e6)

    def summary(self) -> Spread:
        """Mean, percentiles and maximum."""
        return ledger.spread(np.array(self._recent_ms))
