# SPDX-License-Identifier: MIT
"""What the client knows of its keyframes: shared by the thread that sends and those that call."""

import threading
from collections import Counter, OrderedDict, deque

import msgspec
from msgspec import Struct

from tsfusion.keyframe import Keyframe
from tsfusion.spool import Spool, Waiting
from tsfusion.transport.messages import KeyframeTimes, Nack, Stamps

_MAX_RECORDS = 65536


class ClientStats(Struct, frozen=True):
    """Counts since the client began; leftovers of an earlier one count from `durable` on.

    Attributes:
        sent: taken by `send`.
        durable: on the server's disk.
        fused: in the server's map.
        refused: turned away by the server (or unreadable here) for good: reason → count.
        rejected: on the server's disk, but the map could not take it: reason → count.
    """

    sent: int
    durable: int
    fused: int
    refused: dict[str, int]
    rejected: dict[str, int]


class Outbox:
    """The spool and the fate of what passed through it. Hold `changed` around every call.

    Attributes:
        outstanding: how many of the spool's oldest keyframes are on their way.
        unfused: durable keyframes the map has not answered for.
        unmeshed: those the mesh does not show yet.
        refusals: what the next `flush` has to complain of.
        connected: the server answers.
        problem: why it does so in vain.
    """

    def __init__(self, spool: Spool) -> None:
        self.changed = threading.Condition()
        self.spool = spool
        self.outstanding = 0
        self.unfused: deque[int] = deque()
        self.unmeshed: deque[int] = deque()
        self.refusals: list[str] = []
        self.connected = False
        self.problem = ""
        self._sent = self._durable = self._fused = 0
        self._refused: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._rejected_seqs: set[int] = set()
        self._times: OrderedDict[int, KeyframeTimes] = OrderedDict()

    def add(self, entry: Waiting, keyframe: Keyframe) -> None:
        """A keyframe is in the spool."""
        self.spool.add(entry)
        self._sent += 1
        self._times[entry.seq] = KeyframeTimes(
            seq=entry.seq, timestamp_ns=keyframe.timestamp_ns, captured_ns=keyframe.captured_ns
        )
        if len(self._times) > _MAX_RECORDS:
            self._times.popitem(last=False)

    def next_entry(self, window_keyframes: int, window_bytes: int) -> Waiting | None:
        """The next keyframe to send, if the credit allows it (one is always allowed)."""
        waiting, count = self.spool.waiting, self.outstanding
        if count >= min(window_keyframes, len(waiting)):
            return None
        entry = waiting[count]
        under_way = sum(waiting[i].nbytes for i in range(count))
        return entry if count == 0 or under_way + entry.nbytes <= window_bytes else None

    @property
    def last_on_its_way(self) -> int:
        """The newest number that is on its way; 0 = none."""
        return self.spool.waiting[self.outstanding - 1].seq if self.outstanding else 0

    def sent(self, entry: Waiting, sent_ns: int) -> None:
        """The oldest keyframe that was not on its way is now."""
        self.outstanding += 1
        times = self._times.get(entry.seq)
        if times is not None:
            times.sent_ns = sent_ns

    def progress(self, durable: int, fused: int) -> bool:
        """The server has these; whether anything left the spool."""
        dropped = self.spool.drop(durable)
        self.outstanding = max(self.outstanding - len(dropped), 0)
        self._durable += len(dropped)
        self.unfused.extend(dropped)
        while self.unfused and self.unfused[0] <= fused:
            seq = self.unfused.popleft()
            self._fused += seq not in self._rejected_seqs
            self.unmeshed.append(seq)
        self.changed.notify_all()
        return bool(dropped)

    def meshed(self, seq: int) -> None:
        """The mesh shows everything up to `seq`."""
        while self.unmeshed and self.unmeshed[0] <= seq:
            self.unmeshed.popleft()
        self.changed.notify_all()

    def stamp(self, stamps: Stamps, offset_ns: int, bound_ns: int) -> None:
        """Note the server's stamps, on our clock."""
        times = self._times.get(stamps.seq)
        if times is not None and stamps.seq not in self._rejected_seqs:
            times.clock_bound_ns = bound_ns
            for name in ("received_ns", "durable_ns", "fuse_start_ns", "fused_ns", "meshed_ns"):
                if (value := getattr(stamps, name)) and not getattr(times, name):
                    setattr(times, name, value - offset_ns)
        if stamps.meshed_ns:
            self.meshed(stamps.seq)

    def nack(self, nack: Nack) -> None:
        """The server will never have this one in its map."""
        if nack.stage == "map":
            self._rejected[nack.reason] += 1
            self._rejected_seqs.add(nack.seq)
            return
        for place, entry in enumerate(self.spool.waiting):
            if entry.seq == nack.seq:
                self.outstanding -= place < self.outstanding
                self.refuse(entry, nack.reason, nack.message)
                return

    def refuse(self, entry: Waiting, reason: str, message: str) -> None:
        """Give a keyframe up."""
        self.spool.remove(entry)
        self._refused[reason] += 1
        self.refusals.append(f"{entry.seq} was refused ({reason}): {message}")
        self.changed.notify_all()

    def times(self) -> list[KeyframeTimes]:
        """A copy of the ledger."""
        return [msgspec.structs.replace(times) for times in self._times.values()]

    def stats(self) -> ClientStats:
        """A copy of the counts."""
        return ClientStats(self._sent, self._durable, self._fused, dict(self._refused), dict(self._rejected))
