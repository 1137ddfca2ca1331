# SPDX-License-Identifier: MIT
"""Keep an index of a map's journaled records, and the backlog of records that the fuser has yet to answer.

The backlog is handed out in a fair order.
"""

import time
from array import array
from bisect import bisect_left, bisect_right
from collections import OrderedDict, deque
from collections.abc import Iterable, Mapping

import numpy as np
from msgspec import Struct

from tsfusion.core.config import SERVER_SESSION
from tsfusion.fuser.fuser_messages import Find, FoundKeyframes, Fuse, SessionProgress
from tsfusion.gateway.clients.client_routes import Session, Sessions
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.journal import Position, RecordEntry
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.messages import Stamps


class IndexEntry(Struct, frozen=True):
    index: int
    position: Position
    session: int  # its number in `Sessions`
    stamps: Stamps
    captured_ns: int
    is_correction: bool


_COLUMNS = {  # and their types; the last four as in Stamps
    "segment": "i", "offset": "q", "session": "i", "seq": "q", "captured_ns": "q", "kind": "b", "client": "i",
    "logged_ns": "q", "received_ns": "q", "durable_ns": "q", "fuse_start_ns": "q", "fused_ns": "q",
}  # fmt: skip
# Kinds. A second copy of a keyframe, or one that is half erased, is never handed out, but it can be erased
_KEYFRAME, _CORRECTION, _COPY, _ERASED = range(4)


class KeyframeIndex:
    """Every record of the journal in order, 77 bytes each. Stamps are 0 for records of earlier runs.

    The index of a record stays the same when earlier records are removed.
    """

    def __init__(self) -> None:
        self._columns = {name: array(code) for name, code in _COLUMNS.items()}
        self._clients: dict[str, int] = {}  # number of each name in the column `client`
        self._first = 0  # the lowest index that is still held

    def __len__(self) -> int:
        return len(self._columns["seq"])

    def recover(self, found: Iterable[RecordEntry], sessions: Sessions) -> None:
        """Add the records found in the journal at the start. A record that was journaled twice counts once.

        (The disk refused it, the client sent it again, and the first copy was written after all.) The number
        of an erased record counts, so it is not taken again.
        """
        for record in found:
            world = None if record.is_erased else record.world
            session = sessions.open(record.session, record.client, world)
            is_copy = record.is_erased or record.seq <= session.durable
            session.durable = max(session.durable, record.seq)
            if not (record.is_clear or (is_copy and record.is_correction)):
                how = {name: getattr(record, name) for name in ("client", "logged_ns", "is_correction")}
                self.add(record.position, session, record.seq, is_copy=is_copy, **how)

    def add(
        self,
        position: Position,
        session: Session,
        seq: int,
        *,
        client: str = "",
        captured_ns: int = 0,
        logged_ns: int = 0,
        received_ns: int = 0,
        durable_ns: int = 0,
        is_correction: bool = False,
        is_copy: bool = False,
    ) -> int:
        """Append a journaled record, at `position` in the journal. Return its index."""
        kind = _COPY if is_copy else _CORRECTION if is_correction else _KEYFRAME
        sender = self._clients.setdefault(client, len(self._clients))
        place = (position.segment, position.offset, session.number, seq, captured_ns, kind, sender, logged_ns)
        values = (*place, received_ns, durable_ns, 0, 0)
        for column, value in zip(self._columns.values(), values, strict=True):
            column.append(value)
        index = self._first + len(self) - 1
        if not is_copy:
            session.corrections += is_correction
            session.keyframes += not is_correction
            session.entries.append(index)
        return index

    def forget(self, before_segment: int, sessions: Sessions, needed: Iterable[int] = ()) -> None:
        """Remove the records of deleted segments, up to the first one that is still to be handed out.

        Args:
            needed: indices of records that must stay.
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
        """Store the times at which the fuser began to fuse a record and had fused it."""
        self._columns["fuse_start_ns"][index - self._first] = fuse_start_ns
        self._columns["fused_ns"][index - self._first] = fused_ns

    def __getitem__(self, index: int) -> IndexEntry:
        segment, offset, session, seq, captured, kind, _, _, *stamps = (
            column[index - self._first] for column in self._columns.values()
        )
        place, times = Position(segment, offset), Stamps(seq, *stamps)
        return IndexEntry(index, place, session, times, captured, kind == _CORRECTION)

    def corrections(self, indices: Iterable[int]) -> int:
        """Return the number of corrections among these records."""
        column, first = self._columns["kind"], self._first
        return sum(column[index - first] == _CORRECTION for index in indices)

    def after(self, session: Session, seq: int) -> int:
        """Return how many of a session's records in the index have a number up to `seq`."""
        seqs, first = self._columns["seq"], self._first
        return bisect_right(session.entries, seq, key=lambda index: seqs[index - first])

    def keyframes_up_to(self, session: Session, seq: int) -> int:
        """Return how many of a session's keyframes in the index have a number up to `seq`."""
        entries = session.entries[: self.after(session, seq)]
        return len(entries) - self.corrections(entries)

    def segment(self, index: int) -> int:
        """Return the number of the segment that holds a record."""
        return self._columns["segment"][index - self._first]

    # --- selections ---

    def select(self, number: int, selection: Selection, sessions: Sessions) -> Find:
        """Return an order to find the keyframes of a selection, with all that may be meant."""
        columns = ("segment", "offset", "session", "seq", "kind", "client", "logged_ns")
        segments, offsets, session, seqs, kinds, clients, logged = (
            np.array(self._columns[name], np.int64) for name in columns
        )
        is_timed = (logged > 0) & (kinds != _ERASED)  # half-erased records have no time
        if selection.counts_from_end:
            own = sessions.get(SERVER_SESSION)
            of_scanners = is_timed & (session != (-1 if own is None else own.number))
            newest = segments == max(segments[of_scanners].tolist()[-1:], default=0)
            selection = selection.at_end(int(logged[of_scanners & newest].max(initial=0)))
        named = [one.number for one in sessions if one.key.hex().startswith(selection.session)]
        chosen = ((kinds == _KEYFRAME) | (kinds == _COPY)) & np.isin(session, named)
        chosen &= selection.mask(seqs, logged)
        if selection.client is not None:
            chosen &= clients == self._clients.get(selection.client, -1)
        rows = np.flatnonzero(chosen)
        rows = rows[np.argsort(session[rows], kind="stable")]
        table, names = np.stack([seqs, segments, offsets, 0 * seqs], axis=1), list(self._clients)
        found = [
            FoundKeyframes(
                sessions.numbered(int(session[own[0]])).key, names[clients[own[0]]], table[own].tobytes()
            )
            for own in np.split(rows, np.flatnonzero(np.diff(session[rows])) + 1)
            if len(own)
        ]
        since, timed = selection.since_ns, logged[is_timed]
        reaches_back = since is None or not len(timed) or since < int(timed[0])
        return Find(number, selection, tuple(found), reaches_back)

    def set_erased(self, positions: Iterable[Position]) -> None:
        """Record that the bytes of records were deleted: no selection has them any more."""
        erased = {(one.segment, one.offset) for one in positions}
        for row, place in enumerate(zip(self._columns["segment"], self._columns["offset"], strict=True)):
            if place in erased:
                self._columns["kind"][row] = _ERASED


_AHEAD = 0.1  # seconds of work in the fuser's queue: the next client waits so long
_FADING = 0.8  # factor of the expected seconds of a record, after each record that took less
_MAX_CLIENTS = 4096


class _Account(Struct):
    taken: float  # seconds of the fuser, counted as if the client had always been there
    expected: float = _AHEAD  # seconds that its next record is expected to take


class FuserTime:
    """Account of a fuser's time by client: the client that took least time is next.

    Start-time fair queueing (Goyal, Vin and Cheng 1996), in seconds. A record is charged to its client with
    its expected time and, after the fuser's answer, with its true time. A client that was away has saved
    nothing: it starts where the client that was served last had started. A new client starts later, by the
    longest of the last records: without keys each session counts as a client, and many new sessions must not
    go before all others.
    """

    def __init__(self) -> None:
        self._accounts: OrderedDict[str, _Account] = OrderedDict()
        self._charged: dict[int, tuple[str, float]] = {}  # index of a record under way → client, seconds
        self._now = 0.0  # seconds that the client served last had taken before
        self._longest = 0.0  # seconds of the longest of the last records

    def next_of(self, clients: Iterable[str]) -> str:
        """Return the client that took least time; among equals, the one with the shortest expected record."""
        return min(clients, key=self._place_of)

    def _place_of(self, client: str) -> tuple[float, float]:
        account = self._account(client)
        return max(account.taken, self._now), account.expected

    def has_room_for(self, client: str) -> bool:
        """True if the fuser's queue is short enough for another record of this client."""
        ahead = sum(seconds for _, seconds in self._charged.values())
        return not self._charged or ahead + self._account(client).expected <= _AHEAD

    def charge(self, client: str, index: int) -> None:
        """Charge a client with the expected time of a record that was handed to the fuser."""
        account = self._account(client)
        self._now = max(account.taken, self._now)
        account.taken = self._now + account.expected
        self._charged[index] = client, account.expected

    def settle(self, index: int, seconds: float) -> None:
        """Replace a record's expected time by the `seconds` that the fuser took."""
        client, charged = self._charged.pop(index, (None, 0.0))
        if client is not None:
            account = self._account(client)
            account.taken += seconds - charged
            account.expected = max(seconds, _FADING * account.expected)
            self._longest = max(seconds, _FADING * self._longest)

    def restart(self) -> None:
        """Remove the records handed to a fuser that has ended. Their clients stay charged."""
        self._charged.clear()

    def _account(self, client: str) -> _Account:
        account = self._accounts.get(client)
        if account is None:
            account = self._accounts[client] = _Account(self._now + self._longest)
            if len(self._accounts) > _MAX_CLIENTS:
                self._accounts.popitem(last=False)
        self._accounts.move_to_end(client)
        return account


class FuserBacklog:
    """Queue of records for the fuser, fair by the time that each client took; its sessions take turns.

    Attributes:
        leaving: number of keyframes that a record forgets, by its index.
        last_progress: last time when the fuser answered, or had nothing to answer (`time.monotonic()`).
    """

    def __init__(self, index: KeyframeIndex, sessions: Sessions) -> None:
        self._index = index
        self._sessions = sessions
        self._queues: OrderedDict[str, deque[Session]] = OrderedDict()  # by owner; the last served is last
        self._time = FuserTime()
        self.leaving: dict[int, int] = {}
        self.last_progress = 0.0
        self._count()

    @property
    def is_empty(self) -> bool:
        return not self.keyframes and not self.corrections

    def _count(self) -> None:
        """Count the keyframes and corrections that the fuser has neither fused nor rejected."""
        waiting = [session.entries[session.handed :] for session in self._sessions]
        self.corrections = sum(map(self._index.corrections, waiting))
        self.keyframes = sum(map(len, waiting)) - self.corrections

    def add(self, session: Session, *, is_correction: bool = False) -> None:
        """Queue the newest record of a session, which was just journaled."""
        if self.is_empty:
            self.last_progress = time.monotonic()
        self.keyframes += not is_correction
        self.corrections += is_correction
        self._enqueue(session)

    def on_done(self, index: int, seconds: float) -> None:
        """Remove a record that the fuser has fused or rejected, after `seconds` of work."""
        self.last_progress = time.monotonic()
        self.leaving.pop(index, None)
        self._time.settle(index, seconds)
        is_correction = self._index[index].is_correction
        self.keyframes -= not is_correction
        self.corrections -= is_correction

    def _enqueue(self, session: Session) -> None:
        if session.handed < len(session.entries):
            queue = self._queues.setdefault(session.owner, deque())
            if session not in queue:
                queue.append(session)

    def restart(self, done: Mapping[bytes, SessionProgress]) -> None:
        """Queue for a new fuser all records that it lacks; `done` is its progress by session."""
        self._queues.clear()
        self._time.restart()
        for session in self._sessions:
            progress = done.get(session.key)
            session.in_map = progress.seq if progress else 0
            session.handed = self._index.after(session, progress.seq) if progress else 0
            self._enqueue(session)
        self._count()

    def hand_out(self, fuser: FuserSupervisor) -> None:
        """Send the fuser as many records as it wants, in a fair order of clients."""
        while self._queues and fuser.wants_work:
            owner = self._time.next_of(self._queues)
            if not self._time.has_room_for(owner):
                return
            queue = self._queues[owner]
            session = queue[0]
            entry = self._index[session.entries[session.handed]]
            order = Fuse(
                entry.index,
                entry.position,
                session.key,
                entry.stamps.seq,
                session.client,
                session.world or "",
                is_correction=entry.is_correction,
                more=len(self._queues) > 1 or session.handed + 1 < len(session.entries) or len(queue) > 1,
            )
            if not fuser.fuse(order):
                return
            self._time.charge(owner, entry.index)
            session.handed += 1
            queue.popleft()
            if session.handed < len(session.entries):
                queue.append(session)
            self._queues.move_to_end(owner)
            if not queue:
                del self._queues[owner]
