# SPDX-License-Identifier: MIT
"""The sessions of a map, and how far each is."""

from array import array
from collections.abc import Iterator
from typing import Literal

from msgspec import Struct, field

from tsfusion.core.config import SERVER_SESSION
from tsfusion.wire.messages.messages import Hello
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
