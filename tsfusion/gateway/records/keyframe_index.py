# SPDX-License-Identifier: MIT
"""Index of a map's journal: place, session and time stamps of each record."""

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterable

from msgspec import Struct

from tsfusion.gateway.clients.sessions import Session, Sessions
from tsfusion.journal import Position, RecordEntry
from tsfusion.wire.messages.keyframe_times import Stamps


class IndexEntry(Struct, frozen=True):
    """One journaled keyframe or correction."""

    index: int
    position: Position
    session: int  # its number in `Sessions`
    stamps: Stamps
    captured_ns: int
    is_correction: bool


_COLUMNS = (
    *("segment", "offset", "session", "seq", "captured_ns", "is_correction"),
    *("received_ns", "durable_ns", "fuse_start_ns", "fused_ns"),  # as in Stamps
)


class KeyframeIndex:
    """Every record of the journal in order, 80 bytes each. Stamps are 0 for records of earlier runs.

    The index of a record stays the same when those before it are forgotten.
    """

    def __init__(self) -> None:
        self._columns = {name: array("q") for name in _COLUMNS}
        self._first = 0  # the lowest index that is not forgotten

    def __len__(self) -> int:
        return len(self._columns["seq"])

    def recover(self, found: Iterable[RecordEntry], sessions: Sessions) -> None:
        """Add the records that a scan of the journal found. One that was journaled twice counts once.

        (The disk refused, the client sent it again, and the first copy had been written after all.) Of one
        that was erased the number alone counts: it is not taken again.
        """
        for record in found:
            world = None if record.is_erased else record.world
            session = sessions.open(record.session, record.client, world)
            if record.is_erased:
                session.durable = max(session.durable, record.seq)
            elif record.seq > session.durable:
                session.durable = record.seq
                self.add(record.position, session, record.seq, is_correction=record.is_correction)

    def add(
        self,
        position: Position,
        session: Session,
        seq: int,
        *,
        captured_ns: int = 0,
        received_ns: int = 0,
        durable_ns: int = 0,
        is_correction: bool = False,
    ) -> int:
        """Append a record; its index."""
        session.corrections += is_correction
        session.keyframes += not is_correction
        place = (position.segment, position.offset, session.number, seq, captured_ns, is_correction)
        values = (*place, received_ns, durable_ns, 0, 0)
        for column, value in zip(self._columns.values(), values, strict=True):
            column.append(value)
        index = self._first + len(self) - 1
        session.entries.append(index)
        return index

    def forget(self, before_segment: int, sessions: Sessions, needed: Iterable[int] = ()) -> None:
        """Forget the records of deleted segments, up to the first that is still to be handed out.

        Args:
            needed: indices of records that must not be forgotten.
        """
        deleted = bisect_left(self._columns["segment"], before_segment)
        if not deleted:
            return
        stop = self._first + deleted
        waiting = (one.entries[one.handed] for one in sessions if one.handed < len(one.entries))
        stop = min(stop, min(waiting, default=stop), min(needed, default=stop))
        for session in sessions:
            forgotten = bisect_left(session.entries, stop)
            del session.entries[:forgotten]
            session.handed -= forgotten
        for column in self._columns.values():
            del column[: stop - self._first]
        self._first = stop

    def set_fused(self, index: int, fuse_start_ns: int, fused_ns: int) -> None:
        """Write down when the fuser took a record."""
        self._columns["fuse_start_ns"][index - self._first] = fuse_start_ns
        self._columns["fused_ns"][index - self._first] = fused_ns

    def __getitem__(self, index: int) -> IndexEntry:
        segment, offset, session, seq, captured, is_correction, *stamps = (
            column[index - self._first] for column in self._columns.values()
        )
        place, times = Position(segment, offset), Stamps(seq, *stamps)
        return IndexEntry(index, place, session, times, captured, bool(is_correction))

    def corrections(self, indices: Iterable[int]) -> int:
        """Number of corrections among these records."""
        column, first = self._columns["is_correction"], self._first
        return sum(column[index - first] for index in indices)

    def after(self, session: Session, seq: int) -> int:
        """Number of a session's records up to sequence number `seq`, without forgotten ones."""
        seqs, first = self._columns["seq"], self._first
        return bisect_right(session.entries, seq, key=lambda index: seqs[index - first])

    def keyframes_up_to(self, session: Session, seq: int) -> int:
        """Number of a session's keyframes up to sequence number `seq`, without forgotten ones."""
        entries = session.entries[: self.after(session, seq)]
        return len(entries) - self.corrections(entries)

    def segment(self, index: int) -> int:
        """The number of the segment that holds a record."""
        return self._columns["segment"][index - self._first]
