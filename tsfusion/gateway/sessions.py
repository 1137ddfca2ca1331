# SPDX-License-Identifier: MIT
"""What the gateway knows of sessions and keyframes: policy and bookkeeping, no sockets."""

from array import array
from collections import OrderedDict, deque
from collections.abc import Iterator
from typing import Literal

from msgspec import Struct, field

_MAX_SESSIONS = 100_000  # of a map; each takes some 60 bytes of every checkpoint, for ever
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
        corrections: records of corrected poses that came.
    """

    key: bytes
    number: int
    client: str = ""
    durable: int = 0
    fused: int = 0
    in_map: int = 0
    entries: "array[int]" = field(default_factory=lambda: array("q"))
    handed: int = 0
    corrections: int = 0

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


class FairQueue:
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
