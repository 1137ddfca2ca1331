# SPDX-License-Identifier: MIT
"""What the client knows of its keyframes: shared by the thread that sends and those that call."""

import threading
from collections import Counter, OrderedDict, deque
from typing import Literal

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.delivery.spool import Spool, Waiting
from tsfusion.delivery.timing import KeyframeTimesTable
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.wire.keyframe_times import Stamps

_MOST = 65536  # numbers that are remembered: rejected ones, and fused ones that no mesh shows yet


class ClientStats(Struct, frozen=True):
    """Counts since the client began; leftovers of an earlier one count from `durable` on.

    Attributes:
        sent: taken by `send`.
        durable: on the server's disk.
        fused: in the server's map.
        refused: turned away by the server (or unreadable here) for good, corrections too: reason → count.
        rejected: on the server's disk, but the map could not take it: reason → count.
        skipped: never sent: reason → count. `thinned` and `dropped` by the policy (a dropped one was taken
            before), `spool` (it has reached `spool_bytes`), `disk` (full, failing or read-only).
        waiting: keyframes and corrections in the spool.
        waiting_bytes: the bytes of those.
        state: of the spool: `ok`, or the reason why it cannot keep all that comes: `spool` or `disk`.
        corrections_sent: taken by `correct`.
        corrections_acknowledged: on the server's disk.
    """

    sent: int
    durable: int
    fused: int
    refused: dict[str, int]
    rejected: dict[str, int]
    skipped: dict[str, int]
    waiting: int
    waiting_bytes: int
    state: str
    corrections_sent: int = 0
    corrections_acknowledged: int = 0


class Outbox:
    """The spool and the fate of what passed through it. Hold `changed` around every call.

    Attributes:
        outstanding: how many of the spool's oldest keyframes are on their way.
        unfused: durable keyframes the map has not answered for.
        unmeshed: those the mesh does not show yet.
        refusals: how many keyframes the next `flush` has to complain of, and the `first_refusal` in words.
        connected: the server answers.
        problem: why it does so in vain.
        turned_away: who will not have us: the `server`, or the `keys` on its connection; empty = nobody.
        opening: it answers, but the map is not open yet.
        skipped: see `ClientStats`.
        state: see `ClientStats`.
        times: of the keyframes, as far as they are known.
        durable: the highest number that is on the server's disk, as far as it said; 0 = none.
    """

    def __init__(self, spool: Spool) -> None:
        self.changed = threading.Condition()
        self.spool = spool
        self.outstanding = 0
        self.unfused: deque[int] = deque()
        self.unmeshed: deque[int] = deque(maxlen=_MOST)
        self.refusals = 0
        self.first_refusal = ""
        self.connected = False
        self.problem = ""
        self.turned_away: Literal["", "server", "keys"] = ""
        self.opening = False
        self.skipped: Counter[str] = Counter()
        self.state = "ok"
        self.times = KeyframeTimesTable()
        self.durable = 0
        self._sent = self._durable = self._fused = 0
        self._corrections_sent = self._corrections_durable = 0
        self._corrections = {entry.seq for entry in spool.waiting if entry.is_correction}  # not noted yet
        self._refused: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._rejected_seqs: OrderedDict[int, None] = OrderedDict()
        # Of what a dead scanner left, any may have been sent; and what a power cut took of it, too.
        self._perhaps_sent = spool.waiting[-1].seq if spool.waiting else 0
        self._used_before = spool.next_seq - 1
        self._claimed = 0
        self._welcomed = False

    # --- into the spool ---

    @property
    def behind(self) -> int:
        """How many keyframes the map has yet to get: those in the spool and the server's unfused ones."""
        return len(self.spool.waiting) + len(self.unfused) - len(self._corrections)

    def add(self, entry: Waiting, keyframe: Keyframe | None) -> None:
        """Queue a keyframe, or a correction (None), that was written to the spool."""
        self.spool.add(entry)
        if keyframe is None:
            self._corrections_sent += 1
            self._corrections.add(entry.seq)
            return
        self._sent += 1
        self.times.add(entry.seq, timestamp_ns=keyframe.timestamp_ns, captured_ns=keyframe.captured_ns)

    def drop_oldest_unsent(self, newest: int | None = None) -> bool:
        """Take the oldest keyframe that was never sent out of the spool; False = there is none.

        One that was sent may be in the server's journal by now, whatever was heard of it: it stays.

        Args:
            newest: this one stays too.
        """
        sent = max(self._perhaps_sent, self._claimed)
        for place, entry in enumerate(self.spool.waiting):
            if entry.seq > sent and not entry.is_correction:
                if entry.seq == newest:
                    return False
                self.spool.remove(place)
                self.times.remove(entry.seq)
                self.skipped["dropped"] += 1
                self.changed.notify_all()
                return True
        return False

    # --- on their way ---

    def claim(self, window_keyframes: int, window_bytes: int, ahead: int | None = None) -> Waiting | None:
        """The next keyframe to send, if the credit allows it (one is always allowed).

        It stays in the spool until `sent`, `unclaim` or `refuse` says what became of it.

        Args:
            ahead: so many keyframes may be on their way or unfused; None = any number.
        """
        waiting, count = self.spool.waiting, self.outstanding
        if count >= min(max(window_keyframes, 1), len(waiting)):
            return None
        if ahead is not None and count + len(self.unfused) >= ahead:
            return None
        entry = waiting[count]
        under_way = sum(waiting[i].nbytes for i in range(count))
        if count and under_way + entry.nbytes > window_bytes:
            return None
        self._claimed = entry.seq
        return entry

    def unclaim(self) -> None:
        """The claimed keyframe was not sent after all."""
        self._claimed = 0

    @property
    def last_on_its_way(self) -> int:
        """The newest number that is on its way; 0 = none."""
        return self.spool.waiting[self.outstanding - 1].seq if self.outstanding else 0

    def sent(self, entry: Waiting, sent_ns: int) -> None:
        """The claimed keyframe is on its way."""
        self.outstanding += 1
        self._perhaps_sent = max(self._perhaps_sent, entry.seq)
        self._claimed = 0
        self.times.sent(entry.seq, sent_ns)

    # --- at the server ---

    def welcomed(self, durable: int, window_keyframes: int) -> None:
        """Of what a dead scanner left, only a window's worth can have been sent and not be durable yet.

        (Were that server's window larger, one that is dropped now might be in the journal all the same.)
        """
        if not self._welcomed and self.spool.waiting:
            left = [entry.seq for entry in self.spool.waiting if entry.seq > durable]
            window = left[: max(window_keyframes, 1)]
            self._perhaps_sent = min(self._perhaps_sent, window[-1] if window else durable)
        self._welcomed = True

    def foreign(self, durable: int) -> bool:
        """Whether the server has keyframes of this session that were never sent from here."""
        return durable > max(self._perhaps_sent, self._used_before)

    def progress(self, durable: int, fused: int) -> bool:
        """The server has these; whether anything left the spool."""
        self.durable = max(self.durable, durable)
        dropped = self.spool.drop(durable)
        self.outstanding = max(self.outstanding - len(dropped), 0)
        corrections = len(self._corrections.intersection(dropped))
        self._corrections_durable += corrections
        self._durable += len(dropped) - corrections
        self.unfused.extend(dropped)
        while self.unfused and self.unfused[0] <= fused:
            seq = self.unfused.popleft()
            if seq in self._corrections:
                self._corrections.remove(seq)
            else:
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
        if stamps.seq not in self._rejected_seqs:
            self.times.stamp(stamps, offset_ns, bound_ns)
        if stamps.meshed_ns:
            self.meshed(stamps.seq)

    def check_taken(self, seqs: NDArray[np.int64]) -> None:
        """Raise InvalidKeyframe unless each is the number of a keyframe of this session, now or before."""
        known = (seqs <= self.spool.left) | ((seqs > self._used_before) & (seqs < self.spool.next_seq))
        if not known.all():
            raise InvalidKeyframe(f"keyframe {seqs[np.argmin(known)]} was never sent from here")

    # --- turned away ---

    def reject(self, seq: int, reason: str) -> None:
        """The server has it, the map will not."""
        if seq in self._rejected_seqs:
            return
        self._rejected[reason] += 1
        self._rejected_seqs[seq] = None
        if len(self._rejected_seqs) > _MOST:
            self._rejected_seqs.popitem(last=False)

    def kind(self, seq: int) -> str:
        """Whether the record of a number that is not in the map yet is a `keyframe` or a `correction`."""
        return "correction" if seq in self._corrections else "keyframe"

    def find(self, seq: int) -> Waiting | None:
        """The keyframe of this number, if it waits and was sent."""
        if seq <= self._perhaps_sent:
            for entry in self.spool.waiting:
                if entry.seq >= seq:
                    return entry if entry.seq == seq else None
        return None

    def refuse(self, entry: Waiting, reason: str, message: str) -> None:
        """Give a keyframe up. What was sent behind it has to be sent again: the server saw a gap there."""
        place = self.spool.waiting.index(entry)
        self.outstanding = min(self.outstanding, place)
        self.spool.remove(place)
        self._corrections.discard(entry.seq)
        self._claimed = 0
        self._refused[reason] += 1
        self.refusals += 1
        if self.refusals == 1:
            self.first_refusal = f"{entry.kind} {entry.seq} was refused ({reason}): {message}"
        self.changed.notify_all()

    # --- told ---

    def take_refusals(self) -> tuple[int, str]:
        """How many keyframes were given up since this was asked last, and the first of them in words."""
        refusals, self.refusals = self.refusals, 0
        return refusals, self.first_refusal

    def stats(self) -> ClientStats:
        """A copy of the counts."""
        return ClientStats(
            sent=self._sent,
            durable=self._durable,
            fused=self._fused,
            refused=dict(self._refused),
            rejected=dict(self._rejected),
            skipped=dict(self.skipped),
            waiting=len(self.spool.waiting),
            waiting_bytes=self.spool.waiting_bytes,
            state=self.state,
            corrections_sent=self._corrections_sent,
            corrections_acknowledged=self._corrections_durable,
        )
