# SPDX-License-Identifier: MIT
"""Keep track of a client's records and their outcomes, for the sending thread and the calling threads.

Every method takes the lock itself and returns copies, so callers never handle the lock. `Spool.write` and
`Spool.read` use the disk and run outside the lock.
"""

import threading
import time
from collections.abc import Callable
from typing import Literal

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.core.readable_numbers import count_of
from tsfusion.delivery.outcomes import (
    ClientStats,
    DeliveryProgress,
    KeyframeTimesTable,
    Lag,
    Outcomes,
    TakingRate,
)
from tsfusion.delivery.spool import Spool, Waiting
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.wire.messages.messages import KeyframeTimes, Stamps

LinkKind = Literal[
    "connecting", "connected", "held", "opening", "moved", "refused", "other_world", "locked_out", "silent"
]


class LinkState(Struct, frozen=True):
    """State of the link between client and server; each method returns the state after an event.

    An event after which the state does not depend on the one before has no method.

        connecting   no server has answered yet, or the client waits for the first Pong after a Welcome
        connected    the server answers and takes records
        held         the server answers but takes no records for now: full disk or used quota
        opening      the server answers, but the map is not open yet
        refused      the server refuses this client: other version, another's session, no such map
        moved        another server has the map, and the client goes to that server
        other_world  the map has keyframes of another session, in another coordinate frame
        locked_out   the server does not know the client's key, or asks for one
        silent       the server has answered before, but not for too long a time

    A client begins as `connecting`. A Welcome leads from any state except `connected` and `held` to
    `connecting`; the next Pong leads to `connected`. From there a Hold leads to `held`, and progress back to
    `connected`. A Denied leads to `opening`, `moved`, `refused` or `other_world`, a refused handshake to
    `locked_out`. These states last until a Welcome or another Denied; `locked_out` also ends with a
    successful handshake. Silence leads to `silent` from `connected`, `held`, `opening` and `moved`; the other
    states already give a reason.

    The client asks again for ever in every state, because a person may repair the cause at the server.
    `ControlSession` sees the events and replaces the state.
    """

    kind: LinkKind = "connecting"
    why: str = ""  # why no records are taken, for a person; empty = no known reason

    @property
    def is_connected(self) -> bool:
        """True if the server answers and has let this client in."""
        return self.kind in ("connected", "held")

    @property
    def is_refused(self) -> bool:
        return self.kind in ("refused", "other_world", "locked_out")

    # --- the transport ---

    def reachable(self, problem: str) -> "LinkState":
        """Return the state when a connection that had this problem works again."""
        return LinkState() if self.why == problem else self

    def silent(self, why: str = "") -> "LinkState":
        """Return the state after too long a silence of the server; `why` is empty if the connection works."""
        is_so = self.is_connected or self.kind in ("opening", "moved", "silent")
        return LinkState("silent", why) if is_so else self

    # --- the server's messages ---

    def misunderstood(self, why: str) -> "LinkState":
        """Return the state after an answer from a program that is no tsfusion server."""
        return self if self.why else LinkState(self.kind, why)

    def welcomed(self) -> "LinkState":
        """Return the state after a Welcome."""
        return LinkState("connected" if self.is_connected else "connecting")

    def answered(self) -> "LinkState":
        """Return the state after a Pong of the server that let this client in: `connected`."""
        return LinkState("connected") if self.kind in ("connecting", "silent") else self

    def held(self, why: str) -> "LinkState":
        """Return the state after a Hold: the server takes no record for some seconds."""
        return self if self.is_refused else LinkState("held", why)

    def moved(self) -> "LinkState":
        """Return the state after the server has taken a record: a hold is over."""
        return LinkState("connected") if self.kind == "held" else self


_CHECK_INTERVAL = 0.5  # seconds between two calls of what `wait` was given to check


class Outbox:
    """Spool, outcomes of records, and link state of one client, with a lock. For any thread."""

    def __init__(self, spool: Spool, clock: Callable[[], float] = time.monotonic) -> None:
        # The condition's own `with` may be left by Ctrl-C with the lock taken: it is written in Python.
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self.spool = spool  # only this class uses its queue; other calls use the disk, outside the lock
        self.clock = clock  # seconds, for the rates
        self._rate = TakingRate()
        # Only the sending thread replaces the state, always as a whole
        self.link_state = LinkState()
        self.state = "ok"  # state of the spool, as in `ClientStats`; set by its writing thread
        self.spool_problem = ""  # why the spool cannot keep new records; empty = it can
        self._outstanding = 0  # number of the spool's oldest records that are on their way
        self._progress = DeliveryProgress()  # progress of the durable records
        self._corrections_waiting = 0
        self._times = KeyframeTimesTable()
        self._outcomes = Outcomes()
        for _ in range(spool.damaged):
            self._outcomes.skip("damaged", "")
        # Any record of a dead scanner may have been sent, even one lost in a power cut.
        self._perhaps_sent = spool.waiting[-1].seq if spool.waiting else 0
        self._used_before = spool.next_seq - 1
        self._claimed = 0
        self._welcomed = False

    # --- waiting threads ---

    def wait(self, reached: Callable[[], bool], timeout: float | None, check: Callable[[], None]) -> bool:
        """Wait until `reached()` is true, checked at every change; return False after `timeout` seconds.

        Args:
            timeout: None = for ever.
            check: called in between; an exception from it ends the wait.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        try:
            with self._lock:
                while not reached():
                    check()
                    left = _CHECK_INTERVAL if deadline is None else deadline - time.monotonic()
                    if left <= 0:
                        return False
                    self._changed.wait(min(left, _CHECK_INTERVAL))
        except RuntimeError as error:  # Ctrl-C came while `wait` was taking the lock again: it is not taken
            if isinstance(error.__context__, KeyboardInterrupt):
                raise error.__context__ from None
            raise
        return True

    def wake_waiting(self) -> None:
        """Make every thread in `wait` check its condition again."""
        with self._lock:
            self._changed.notify_all()

    def change_link_state(self, state: LinkState) -> bool:
        """Replace the link's state; return True if the state differs from the old one."""
        with self._lock:
            is_new = state != self.link_state
            self.link_state = state
            if state.kind != "connected":
                self._rate.forget()
            if is_new:
                self._changed.notify_all()
            return is_new

    # --- into the spool ---

    @property
    def behind(self) -> int:
        """Number of keyframes that the map still lacks: in the spool, or on the server's disk and unfused."""
        with self._lock:
            return self.keyframes_waiting + self._progress.unfused_keyframes

    @property
    def lag(self) -> Lag:
        """Keyframes that the map lacks, and the rate at which it takes them."""
        with self._lock:
            return Lag(self.behind, self._rate.per_second)

    @property
    def keyframes_waiting(self) -> int:
        """Number of keyframes in the spool."""
        with self._lock:
            return len(self.spool.waiting) - self.spool.corrections

    def add(self, entry: Waiting, keyframe: Keyframe | None) -> None:
        """Queue for sending a record just written to the spool; `keyframe` is None for a correction."""
        with self._lock:
            if not self.behind:
                self._rate.rest()
            self.spool.add(entry)
            if keyframe is None:
                self._outcomes.corrections_sent += 1
                return
            self._outcomes.sent += 1
            self._times.add(entry.seq, timestamp_ns=keyframe.timestamp_ns, captured_ns=keyframe.captured_ns)

    def skip(self, reason: str, *, is_correction: bool = False) -> None:
        """Count a record that is not sent, under `reason`."""
        with self._lock:
            problem = self.spool_problem if reason in ("spool", "disk") else ""
            self._outcomes.skip(reason, problem, is_correction=is_correction)

    def usage(self) -> tuple[int, int, int]:
        """Return the spool's bytes on the disk, the number of waiting records, and their bytes."""
        with self._lock:
            return self.spool.used_bytes, len(self.spool.waiting), self.spool.waiting_bytes

    def tidy(self) -> None:
        """Delete spool files without waiting records. For the writing thread."""
        with self._lock:
            self.spool.tidy()

    def drop_oldest(self, newest: int | None = None) -> bool:
        """Drop the oldest unsent keyframe from the spool; return False if there is none, or only `newest`.

        A sent keyframe stays, because it may be in the server's journal without an answer. Corrections stay.
        """
        with self._lock:
            sent = max(self._perhaps_sent, self._claimed)
            for place, entry in enumerate(self.spool.waiting):
                if entry.seq > sent and not entry.is_correction:
                    if entry.seq == newest:
                        return False
                    self.spool.remove(place)
                    self._times.remove(entry.seq)
                    self._outcomes.skip("dropped", "")
                    self._changed.notify_all()
                    return True
        return False

    def drop_to(self, backlog: int, newest: int) -> None:
        """Drop the oldest unsent keyframes until the map lacks at most `backlog`; keyframe `newest` stays."""
        with self._lock:
            while self.behind > backlog and self.drop_oldest(newest):
                pass

    def check_known(self, seqs: NDArray[np.int64]) -> None:
        """Raise InvalidKeyframe if a number belongs to no record of this session, now or earlier."""
        with self._lock:
            known = (seqs <= self.spool.left) | ((seqs > self._used_before) & (seqs < self.spool.next_seq))
        if not known.all():
            raise InvalidKeyframe(f"keyframe {seqs[np.argmin(known)]} was never sent by this client")

    # --- on their way ---

    @property
    def outstanding(self) -> int:
        """Number of records that were sent and are not acknowledged yet."""
        with self._lock:
            return self._outstanding

    def claim(
        self, window_keyframes: int, window_bytes: int, ahead: int | None = None
    ) -> tuple[Waiting, int] | None:
        """Return the next record to send and the number sent before it; None if the server's window is full.

        One record on its way is always allowed. The record stays in the spool until `sent`, `unclaim` or
        `refuse` reports its outcome.

        Args:
            ahead: most records that may be on their way or unfused; None = any number.
        """
        with self._lock:
            waiting, count = self.spool.waiting, self._outstanding
            if count >= min(max(window_keyframes, 1), len(waiting)):
                return None
            if ahead is not None and count + self._progress.unfused >= ahead:
                return None
            entry = waiting[count]
            under_way = sum(waiting[i].nbytes for i in range(count))
            if count and under_way + entry.nbytes > window_bytes:
                return None
            self._claimed = entry.seq
            return entry, waiting[count - 1].seq if count else 0

    def unclaim(self) -> None:
        """Record that the record of the last `claim` was not sent, so that it is claimed again."""
        with self._lock:
            self._claimed = 0

    def sent(self, entry: Waiting, sent_ns: int) -> bool:
        """Record that a claimed record was sent; return True if it is the only one on its way."""
        with self._lock:
            self._outstanding += 1
            self._perhaps_sent = max(self._perhaps_sent, entry.seq)
            self._claimed = 0
            self._times.sent(entry.seq, sent_ns)
            return self._outstanding == 1

    def rewind(self) -> None:
        """Make all unacknowledged records unsent, so that they are sent once more."""
        with self._lock:
            self._outstanding = 0

    # --- at the server ---

    def welcome(self, durable: int, window_keyframes: int) -> str:
        """Record the server's progress as its Welcome tells it. Return a text about records it has lost.

        The text is empty unless the server lacks records that it had acknowledged. Of a dead scanner's
        records, at most one window can be sent and not durable. (If that window was larger, a record dropped
        now may still arrive.)
        """
        with self._lock:
            told = self._lose_beyond(durable)
            if not self._welcomed and self.spool.waiting:
                left = [entry.seq for entry in self.spool.waiting if entry.seq > durable]
                window = left[: max(window_keyframes, 1)]
                self._perhaps_sent = min(self._perhaps_sent, window[-1] if window else durable)
            self._welcomed = True
            self._rate.forget()  # it may be a new server, which fuses first what its last checkpoint lacks
            return told

    def _lose_beyond(self, durable: int) -> str:
        """Count acknowledged records above `durable` as lost; return a text about them. The lock is held."""
        keyframes, fused, corrections = self._progress.lose(durable)
        return self._outcomes.lose(keyframes, fused, corrections) if keyframes or corrections else ""

    def is_foreign(self, durable: int) -> bool:
        """Return True if the server has records of this session that this client never sent."""
        with self._lock:
            return durable > max(self._perhaps_sent, self._used_before)

    def acknowledge(
        self,
        durable: int,
        fused: int,
        stamps: tuple[Stamps, ...] = (),
        *,
        offset_ns: int = 0,
        bound_ns: int = 0,
    ) -> bool:
        """Record progress: remove records up to `durable` from the spool, and store the server's stamps.
        Return True if a record was removed.

        Args:
            offset_ns, bound_ns: the server's clock minus ours, and the largest error of that.
        """
        with self._lock:
            dropped = self.spool.drop(durable)
            self._outstanding = max(self._outstanding - len(dropped), 0)
            corrections = sum(entry.is_correction for entry in dropped)
            self._outcomes.corrections_durable += corrections
            self._outcomes.durable += len(dropped) - corrections
            self._progress.acknowledge(dropped)
            if taken := self._progress.answer(fused):
                self._outcomes.fused += sum(not self._outcomes.is_rejected(seq) for seq in taken)
                self._rate.note(self.clock(), len(taken), is_more_waiting=self.behind > 0)
            for one in stamps:
                if not self._outcomes.is_rejected(one.seq):
                    self._times.stamp(one, offset_ns, bound_ns)
                if one.meshed_ns:
                    self.note_meshed(one.seq)
            self._changed.notify_all()
            return bool(dropped)

    def note_meshed(self, seq: int) -> None:
        """Record that the mesh shows all keyframes up to `seq`."""
        with self._lock:
            self._progress.meshed = max(self._progress.meshed, seq)
            self._changed.notify_all()

    def note_moves(self, fused: int, waiting: int) -> None:
        """Record the number of keyframes that waited for their corrected pose when `fused` was reached."""
        with self._lock:
            self._corrections_waiting = waiting
            if not waiting:
                self._progress.settled = fused
            self._changed.notify_all()

    # --- turned away ---

    def reject(self, seq: int, reason: str, message: str = "") -> tuple[str, bool] | None:
        """Count a record that is on the server's disk but that the map could not take.

        If the map's answer was reported first, the record counted as fused; this call corrects that. Returns
        the kind of record, and True if it is the session's first for this reason; None if already counted.
        """
        with self._lock:
            entry = self.find_sent(seq)
            is_correction = entry.is_correction if entry is not None else self._progress.is_correction(seq)
            is_first = self._outcomes.reject(seq, reason, message, is_correction=is_correction)
            self._outcomes.fused -= (
                is_first is not None and not is_correction and self._progress.is_fused(seq)
            )
            return None if is_first is None else ("correction" if is_correction else "keyframe", is_first)

    @property
    def first_rejection(self) -> str:
        """Reason why the map rejected its first record; empty without rejections."""
        with self._lock:
            return self._outcomes.first_rejection

    def find_sent(self, seq: int) -> Waiting | None:
        """Return the record with this number if it was sent and is not acknowledged, else None."""
        with self._lock:
            if seq <= self._perhaps_sent:
                for entry in self.spool.waiting:
                    if entry.seq >= seq:
                        return entry if entry.seq == seq else None
            return None

    def refuse(self, entry: Waiting, reason: str, message: str) -> None:
        """Remove a refused record for good. Later records are sent again, because the server saw a gap."""
        with self._lock:
            place = self.spool.waiting.index(entry)
            self._outstanding = min(self._outstanding, place)
            self.spool.remove(place)
            self._claimed = 0
            self._outcomes.refuse(entry, reason, message)
            self._changed.notify_all()

    # --- snapshots ---

    @property
    def is_durable(self) -> bool:
        """True if every record given to the client is on the server's disk, or was given up."""
        with self._lock:
            return not self.spool.waiting

    @property
    def is_fused(self) -> bool:
        """True if every record that `send` took is fused, or rejected."""
        with self._lock:
            return not self.spool.waiting and not self._progress.unfused

    @property
    def is_settled(self) -> bool:
        """True if the map has every sent record, and each keyframe at its newest pose."""
        with self._lock:
            return self.is_fused and self._progress.settled >= self._progress.fused

    @property
    def is_meshed(self) -> bool:
        """True if the mesh shows every sent record."""
        with self._lock:
            return self.is_fused and self._progress.meshed >= self._progress.fused

    def describe_waiting(self) -> str:
        """Return the number of records in the spool as text: `3 keyframes and 1 correction`."""
        with self._lock:
            keyframes, corrections = self.keyframes_waiting, self.spool.corrections
        counts = [count_of(keyframes, "keyframe")] if keyframes or not corrections else []
        return " and ".join([*counts, *([count_of(corrections, "correction")] if corrections else [])])

    def take_refusals(self) -> str:
        """Return a text about records refused or not spooled since the last call; empty without any."""
        with self._lock:
            return self._outcomes.take_refusals()

    def times(self) -> list[KeyframeTimes]:
        """Return for each recent keyframe the times of its stages (sent … meshed), oldest first."""
        with self._lock:
            return self._times.copy()

    def newest_fused(self) -> KeyframeTimes | None:
        """Return the times of the newest keyframe that is in the map; None without one."""
        with self._lock:
            return self._times.newest_fused()

    def stats(self) -> ClientStats:
        """Return a copy of the counts of records by outcome."""
        with self._lock:
            return self._outcomes.stats(
                waiting=len(self.spool.waiting),
                waiting_bytes=self.spool.waiting_bytes,
                state=self.state,
                corrections_waiting=self._corrections_waiting,
            )

    def close(self) -> bool:
        """Close the spool; return True if a temporary spool still held records, which are then lost."""
        with self._lock:
            loses = self.spool.temporary and bool(self.spool.waiting)
            self.spool.close()
            return loses
