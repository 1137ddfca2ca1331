# SPDX-License-Identifier: MIT
"""What the gateway knows of sessions and keyframes: policy and bookkeeping, no sockets."""

from array import array
from bisect import bisect_left, bisect_right
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np
from msgspec import Struct, field

from tsfusion import ledger
from tsfusion.journal import Position, Scan
from tsfusion.transport.messages import Spread, Stamps

_DELAYS = 1024
_MAX_SESSIONS = 100_000  # of a map; each takes some 60 bytes of every checkpoint, for ever
_LONGEST_DELAY_NS = 86_400 * 10**9  # a day
Verdict = Literal["next", "duplicate", "gap"]


class Session(Struct, eq=False):
    """One client's stream of keyframes.

    Attributes:
        number: its place in `Sessions`.
        client: whose it is: the name that its key is allowed under; empty = it came without keys.
        durable: the highest seq that is journaled.
        fused: the highest that the map has taken or refused.
        in_map: the same of the fuser that lives: after a death it begins at the checkpoint again.
        entries: the indices of its keyframes that are not forgotten.
        handed: how many of these the fuser was given.
    """

    key: bytes
    number: int
    client: str = ""
    durable: int = 0
    fused: int = 0
    in_map: int = 0
    entries: "array[int]" = field(default_factory=lambda: array("q"))
    handed: int = 0

    @property
    def owner(self) -> str:
        """Whom to be fair to: the client, or where there are no keys the session."""
        return self.client or self.key.hex()

    def belongs_to(self, client: str) -> bool:
        """Whether this client may go on with it. What came without keys is anyone's."""
        return not self.client or not client or self.client == client

    def admit(self, seq: int, previous: int) -> Verdict:
        """What to do with keyframe `seq` of a client that offers none between `previous` and it.

        Taking them only in order makes one number a session enough to know every keyframe that ever came:
        exact de-duplication in constant memory.
        """
        if seq <= self.durable:
            return "duplicate"
        return "next" if previous <= self.durable else "gap"


class Sessions:
    """All sessions of a map's journal."""

    def __init__(self) -> None:
        self._by_key: dict[bytes, Session] = {}
        self._all: list[Session] = []

    def __iter__(self) -> Iterator[Session]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)

    def get(self, key: bytes) -> Session | None:
        """A session that has something in the journal, or None."""
        return self._by_key.get(key)

    def room_for(self, key: bytes) -> bool:
        """Whether it is one of them, or may become one."""
        return key in self._by_key or len(self) < _MAX_SESSIONS

    def open(self, key: bytes, client: str = "") -> Session:
        """The session of a key, made when new."""
        session = self._by_key.get(key)
        if session is None:
            session = self._by_key[key] = Session(key, len(self._all), client)
            self._all.append(session)
        return session

    def admit(self, key: bytes, seq: int, previous: int) -> Verdict:
        """As `Session.admit`, for a session that may not exist yet."""
        return (self._by_key.get(key) or Session(key, -1)).admit(seq, previous)

    def progress(self, key: bytes) -> tuple[int, int]:
        """The highest seq of a session that is durable, and that is fused."""
        session = self._by_key.get(key)
        return (session.durable, session.fused) if session else (0, 0)

    def numbered(self, number: int) -> Session:
        """A session by its number."""
        return self._all[number]


class Turns:
    """Whose keyframe the fuser gets next: one of each client in turn, and of its sessions in turn."""

    def __init__(self) -> None:
        self._owners: OrderedDict[str, deque[Session]] = OrderedDict()

    def add(self, session: Session) -> None:
        """It has something to hand out (again)."""
        queue = self._owners.setdefault(session.owner, deque())
        if session not in queue:
            queue.append(session)

    def next(self) -> Session | None:
        """The one whose turn it is; it stays so until `served`."""
        for queue in self._owners.values():
            return queue[0]
        return None

    def served(self) -> None:
        """The next one got its turn; if it has more, it gets another when the others had theirs."""
        owner, queue = self._owners.popitem(last=False)
        session = queue.popleft()
        if session.handed < len(session.entries):
            queue.append(session)
        if queue:
            self._owners[owner] = queue

    def clear(self) -> None:
        """Nothing is to be handed out."""
        self._owners.clear()


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
    """Every keyframe of the journal in order: 72 bytes each. Stamps are 0 for those of earlier runs.

    An index stays what it is when the keyframes before it are forgotten.
    """

    def __init__(self) -> None:
        self._columns = {name: array("q") for name in _COLUMNS}
        self._first = 0  # index that is not forgotten

    def __len__(self) -> int:
        return len(self._columns["seq"])

    def recover(self, found: Iterable[Scan], sessions: Sessions) -> None:
        """Take over what the journal's scan found. A keyframe journaled twice counts once.

        (The disk refused, the client sent it again, and the first copy had been written after all.)
        """
        for record in found:
            session = sessions.open(record.session, record.client)
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
        index = self._first + len(self) - 1
        session.entries.append(index)
        return index

    def forget(self, before_segment: int, sessions: Sessions, needed: Iterable[int] = ()) -> None:
        """Let go of the keyframes whose segment is gone, up to the first that is still to be handed out.

        Args:
            needed: indices that somebody will ask for.
        """
        if not bisect_left(self._columns["segment"], before_segment):
            return
        stop = self._first + bisect_left(self._columns["segment"], before_segment)
        waiting = (one.entries[one.handed] for one in sessions if one.handed < len(one.entries))
        stop = min(stop, min(waiting, default=stop), min(needed, default=stop))
        for session in sessions:
            gone = bisect_left(session.entries, stop)
            del session.entries[:gone]
            session.handed -= gone
        for column in self._columns.values():
            del column[: stop - self._first]
        self._first = stop

    def fused(self, index: int, fuse_start_ns: int, fused_ns: int) -> None:
        """Note when a keyframe entered the map."""
        self._columns["fuse_start_ns"][index - self._first] = fuse_start_ns
        self._columns["fused_ns"][index - self._first] = fused_ns

    def __getitem__(self, index: int) -> Entry:
        segment, offset, session, seq, captured, *stamps = (
            column[index - self._first] for column in self._columns.values()
        )
        return Entry(index, Position(segment, offset), session, Stamps(seq, *stamps), captured)

    def after(self, session: Session, seq: int) -> int:
        """How many keyframes of a session, of those not forgotten, have a number up to `seq`."""
        seqs, first = self._columns["seq"], self._first
        return bisect_right(session.entries, seq, key=lambda index: seqs[index - first])

    def segment(self, index: int) -> int:
        """The segment that holds a keyframe."""
        return self._columns["segment"][index - self._first]


class Delays:
    """Capture to fused of the last keyframes."""

    def __init__(self) -> None:
        self._recent_ms: deque[tuple[float, float]] = deque(maxlen=_DELAYS)

    def add(self, delay_ns: int, bound_ns: int) -> bool:
        """A keyframe took so long, give or take the bound. False when that cannot be: it does not count."""
        if not -bound_ns <= delay_ns <= _LONGEST_DELAY_NS:
            return False
        self._recent_ms.append((delay_ns / 1e6, bound_ns / 1e6))
        return True

    @property
    def bound_ms(self) -> float:
        """The most that any of them can be wrong."""
        return max((bound for _, bound in self._recent_ms), default=0.0)

    def summary(self) -> Spread:
        """Mean, percentiles and maximum."""
        return ledger.spread(np.array([delay for delay, _ in self._recent_ms]))
