# SPDX-License-Identifier: MIT
"""Count a client's records by outcome, and track their progress, their times and the clock offset."""

from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Iterator

import numpy as np
from msgspec import Struct

from tsfusion.core.readable_numbers import count_of
from tsfusion.delivery.spool import Waiting
from tsfusion.wire.messages.messages import KeyframeTimes, Stamps

_ANSWERED_RUNS = 4096  # runs of numbers remembered: the server may report more about them


class NumberRuns:
    """Set of rising sequence numbers, stored as runs without gaps: many numbers need little memory."""

    def __init__(self) -> None:
        self._runs: deque[range] = deque()

    def __contains__(self, number: int) -> bool:
        return number in next(self._above(number - 1), range(0))

    def __len__(self) -> int:
        return self.count(0)

    def append(self, number: int) -> None:
        """Add a number that is above all others in the set."""
        follows = bool(self._runs) and self._runs[-1].stop == number
        first = self._runs.pop().start if follows else number
        self._runs.append(range(first, number + 1))

    def _above(self, most: int) -> Iterator[range]:
        """Yield the runs of numbers above `most`, oldest first; a run that begins below is cut."""
        above: list[range] = []
        for run in reversed(self._runs):
            if run.stop <= most + 1:
                break
            above.append(range(max(run.start, most + 1), run.stop))
        return reversed(above)

    def count(self, most: int) -> int:
        """Return how many numbers are above `most`."""
        return sum(map(len, self._above(most)))

    def between(self, after: int, last: int) -> Iterator[int]:
        """Yield the numbers above `after`, up to and including `last`."""
        for run in self._above(after):
            yield from range(run.start, min(run.stop, last + 1))

    def cut(self, most: int) -> list[int]:
        """Remove the numbers above `most`; return them."""
        gone = [number for run in self._above(most) for number in run]
        while self._runs and self._runs[-1].stop > most + 1:
            run = self._runs.pop()
            if run.start <= most:
                self._runs.append(range(run.start, most + 1))
        return gone

    def keep_newest(self, runs: int, *, after: int) -> None:
        """Remove the oldest runs until `runs` are left; runs with numbers above `after` always stay."""
        while len(self._runs) > runs and self._runs[0].stop <= after + 1:
            self._runs.popleft()


class DeliveryProgress:
    """Records that the server has, and sequence numbers that only rise unless the server loses records.

    Attributes:
        fused: number up to which every record is fused or rejected.
        meshed: the mesh shows everything up to this number.
        settled: the map has everything up to this number, each keyframe at its newest pose.
    """

    def __init__(self) -> None:
        self.fused = self.meshed = self.settled = 0
        self._durable, self._corrections = (
            NumberRuns(),
            NumberRuns(),
        )  # all durable records, and the corrections among them

    def acknowledge(self, entries: Iterable[Waiting]) -> None:
        """Add records that are now on the server's disk (acknowledged)."""
        for entry in entries:
            self._durable.append(entry.seq)
            if entry.is_correction:
                self._corrections.append(entry.seq)
        for runs in (self._durable, self._corrections):
            runs.keep_newest(_ANSWERED_RUNS, after=self.fused)

    def answer(self, fused: int) -> list[int]:
        """Record that all records up to `fused` are fused or rejected; return the new keyframes of them."""
        answered = list(self._durable.between(self.fused, fused))
        self.fused = answered[-1] if answered else self.fused
        return [seq for seq in answered if seq not in self._corrections]

    def lose(self, durable: int) -> tuple[list[int], list[int], int]:
        """Record that the server has no record above `durable`, although it acknowledged some.

        Returns:
            The numbers of lost keyframes; those of them that had been fused or rejected; the number of lost
            corrections.
        """
        corrections = set(self._corrections.cut(durable))
        keyframes = [seq for seq in self._durable.cut(durable) if seq not in corrections]
        answered = [seq for seq in keyframes if seq <= self.fused]
        self.fused = min(self.fused, durable)
        return keyframes, answered, len(corrections)

    def is_correction(self, seq: int) -> bool:
        """Return True if record `seq` is on the server and is a correction, not a keyframe."""
        return seq in self._corrections

    def is_fused(self, seq: int) -> bool:
        """Return True if record `seq` is on the server and fused or rejected."""
        return seq <= self.fused and seq in self._durable

    @property
    def unfused(self) -> int:
        """Number of records on the server's disk that are neither fused nor rejected yet."""
        return self._durable.count(self.fused)

    @property
    def unfused_keyframes(self) -> int:
        """Number of keyframes among the unfused records."""
        return self.unfused - self._corrections.count(self.fused)


_MOST_REMEMBERED = 65536  # numbers of rejected records


class ClientStats(Struct, frozen=True):
    """Counts since the client began; records left by an earlier client count from `durable` on.

    Attributes:
        sent: keyframes that `send` took.
        durable: keyframes on the server's disk.
        fused: keyframes in the server's map.
        refused: keyframes that the server turned away for good, or that the spool cannot read: reason →
            count. `lost`: the server had them, and has them no more.
        rejected: keyframes on the server's disk that the map could not take: reason → count.
        skipped: keyframes that were never sent: reason → count. By the policy: `thinned` (the map was too far
            behind), `room` (the spool was nearly full), `dropped` (taken, then dropped). Else: `spool`
            (`spool_bytes` reached), `disk` (full, failing or read-only), `damaged` (an earlier client's,
            unreadable).
        waiting: keyframes and corrections in the spool.
        waiting_bytes: the bytes of those.
        state: state of the spool: `ok`, or why it cannot keep all new records: `spool` or `disk`.
        corrections_sent: corrections that `correct` took.
        corrections_acknowledged: corrections on the server's disk.
        corrections_refused: corrections that were skipped, refused or rejected: reason → count.
        corrections_waiting: keyframes of the map whose newest pose is not fused yet, by the last report.
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
    corrections_refused: dict[str, int] = {}
    corrections_waiting: int = 0

    @property
    def settled(self) -> int:
        """Number of sent keyframes that are in the map, or never will be."""
        turned_away = sum(self.rejected.values()) + sum(self.refused.values())
        return self.fused + turned_away + self.skipped.get("dropped", 0)

    @property
    def under_way(self) -> int:
        """Number of keyframes taken but not settled: in the spool, on their way, or waiting for the map."""
        return max(self.sent - self.settled, self.waiting)

    @property
    def left_out(self) -> dict[str, int]:
        """Number of keyframes that will never be in the map: reason → count."""
        return dict(Counter(self.refused) + Counter(self.rejected) + Counter(self.skipped))


class Outcomes:
    """Counts of a client's records by outcome. For one thread at a time."""

    def __init__(self) -> None:
        self.sent = self.durable = self.fused = 0  # keyframes
        self.corrections_sent = self.corrections_durable = 0
        self.first_rejection = ""  # why the map rejected its first record; empty = no rejection
        self._skipped: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._corrections_refused: Counter[str] = Counter()
        self._rejected_seqs: OrderedDict[int, None] = OrderedDict()
        self._refusal_count = 0  # refusals that `take_refusals` has not returned yet
        self._first_refusal = ""  # the first of these refusals, as text

    def skip(self, reason: str, problem: str, *, is_correction: bool = False) -> None:
        """Count a record that is not sent.

        Args:
            problem: why the spool cannot keep the record; empty = a policy skips it.
        """
        (self._corrections_refused if is_correction else self._skipped)[reason] += 1
        if problem:
            self._note_refusal(f"a {'correction' if is_correction else 'keyframe'} was never sent; {problem}")

    def refuse(self, entry: Waiting, reason: str, message: str) -> None:
        """Count a record that will never be in the map, because this client or the server refused it."""
        (self._corrections_refused if entry.is_correction else self._refused)[reason] += 1
        self._note_refusal(f"{entry.kind} {entry.seq} was refused ({reason}): {message}")

    def lose(self, keyframes: list[int], fused: list[int], corrections: int) -> str:
        """Count records that the server has lost; return a text about them.

        Args:
            keyframes: numbers of lost keyframes; `fused`: those of them that were fused.
            corrections: number of lost corrections.
        """
        self.durable -= len(keyframes)
        self.fused -= sum(not self.is_rejected(seq) for seq in fused)
        self.corrections_durable -= corrections
        # A rejected one was never in the map.
        self._refused["lost"] += sum(not self.is_rejected(seq) for seq in keyframes)
        self._corrections_refused["lost"] += corrections
        self._refused, self._corrections_refused = +self._refused, +self._corrections_refused
        had = [count_of(len(keyframes), "keyframe")] if keyframes else []
        had += [count_of(corrections, "correction")] if corrections else []
        told = (
            f"{' and '.join(had)} that the server had on its disk are not there any more; is its state "
            "folder another one, or an older copy?"
        )
        self._note_refusal(told)
        return told

    def _note_refusal(self, text: str) -> None:
        self._first_refusal = text if not self._refusal_count else self._first_refusal
        self._refusal_count += 1

    def take_refusals(self) -> str:
        """Return a text about records refused or not spooled since the last call; empty without any."""
        count, self._refusal_count = self._refusal_count, 0
        more = f" (and {count - 1} more)" if count > 1 else ""
        return f"{self._first_refusal}{more}" if count else ""

    def reject(self, seq: int, reason: str, message: str, *, is_correction: bool) -> bool | None:
        """Count a record that is on the server's disk but that the map could not take.

        Returns True if it is the first for this reason, None if it was counted before.
        """
        if seq in self._rejected_seqs:
            return None
        counts = self._corrections_refused if is_correction else self._rejected
        counts[reason] += 1
        self._rejected_seqs[seq] = None
        self.first_rejection = self.first_rejection or message or reason
        if len(self._rejected_seqs) > _MOST_REMEMBERED:
            self._rejected_seqs.popitem(last=False)
        return counts[reason] == 1

    def is_rejected(self, seq: int) -> bool:
        """Return True for one of the last records that the map could not take."""
        return seq in self._rejected_seqs

    def stats(self, *, waiting: int, waiting_bytes: int, state: str, corrections_waiting: int) -> ClientStats:
        """Return a copy of the counts, with the spool's state as given."""
        return ClientStats(
            sent=self.sent,
            durable=self.durable,
            fused=self.fused,
            refused=dict(self._refused),
            rejected=dict(self._rejected),
            skipped=dict(self._skipped),
            waiting=waiting,
            waiting_bytes=waiting_bytes,
            state=state,
            corrections_sent=self.corrections_sent,
            corrections_acknowledged=self.corrections_durable,
            corrections_refused=dict(self._corrections_refused),
            corrections_waiting=corrections_waiting,
        )


CAPACITY = 65536
_LARGEST = (1 << 63) - 1
_FIELDS = KeyframeTimes.__struct_fields__
_COLUMN = {name: place for place, name in enumerate(_FIELDS)}
_SERVER_STAMPS = ("received_ns", "durable_ns", "fuse_start_ns", "fused_ns", "meshed_ns")


class KeyframeTimesTable:
    """Times of the last `CAPACITY` keyframes, one row each; a new row replaces the oldest."""

    def __init__(self) -> None:
        self._rows = np.zeros((CAPACITY, len(_FIELDS)), np.int64)  # memory pages are only used once written
        self._newest_fused = 0

    def add(self, seq: int, *, timestamp_ns: int, captured_ns: int) -> None:
        """Begin the row of keyframe `seq` with its sensor time and the time of `send`."""
        row = self._rows[seq % CAPACITY]
        row[:] = 0
        row[:3] = seq, timestamp_ns, captured_ns

    def remove(self, seq: int) -> None:
        """Clear the row of a keyframe that was dropped unsent."""
        if self._has(seq):
            self._rows[seq % CAPACITY] = 0

    def sent(self, seq: int, sent_ns: int) -> None:
        """Store the time at which a keyframe was given to the socket."""
        if self._has(seq):
            self._rows[seq % CAPACITY, _COLUMN["sent_ns"]] = sent_ns

    def stamp(self, stamps: Stamps, offset_ns: int, bound_ns: int) -> None:
        """Store the server's stamps of a keyframe in the client's clock; a stamp stored before stays."""
        if self._has(stamps.seq):
            row = self._rows[stamps.seq % CAPACITY]
            bound = _COLUMN["clock_bound_ns"]
            row[bound] = max(row[bound], min(bound_ns, _LARGEST))  # stamps stored before have that of then
            for name in _SERVER_STAMPS:
                if (value := getattr(stamps, name)) and not row[_COLUMN[name]]:
                    row[_COLUMN[name]] = min(max(value - offset_ns, -_LARGEST), _LARGEST)
            if row[_COLUMN["fused_ns"]] > 0:
                self._newest_fused = max(self._newest_fused, stamps.seq)

    def newest_fused(self) -> KeyframeTimes | None:
        """Return the row of the newest keyframe in the map; None without one."""
        if not self._newest_fused or not self._has(self._newest_fused):
            return None
        row = self._rows[self._newest_fused % CAPACITY].tolist()
        return KeyframeTimes(**dict(zip(_FIELDS, row, strict=True)))

    def copy(self) -> list[KeyframeTimes]:
        """Return the times of all keyframes in the table, oldest first."""
        rows = self._rows[self._rows[:, 0] > 0]
        ordered = rows[np.argsort(rows[:, 0])].tolist()
        return [KeyframeTimes(**dict(zip(_FIELDS, row, strict=True))) for row in ordered]

    def _has(self, seq: int) -> bool:
        return bool(self._rows[seq % CAPACITY, 0] == seq)


_ANSWERS = 64  # answers of the map over which its rate is measured
_FEWEST_ANSWERS = 8  # before there is a rate


class TakingRate:
    """Measured number of keyframes a second that the map takes.

    Only time between two answers of the map counts, and only while keyframes wait: an idle map shows no rate.
    The longest pause is left out: a fuser may have died in it.
    """

    def __init__(self) -> None:
        self._answers: deque[tuple[float, int]] = deque(maxlen=_ANSWERS)  # seconds, keyframes taken in them
        self._since: float | None = None  # time of the map's last answer; None = no keyframe has waited since

    def note(self, now: float, taken: int, *, is_more_waiting: bool) -> None:
        """Record that the map took `taken` keyframes, and whether more wait."""
        if self._since is not None:
            self._answers.append((now - self._since, taken))
        self._since = now if is_more_waiting else None

    def rest(self) -> None:
        """Record that no keyframe waits, so that the idle time does not count."""
        self._since = None

    def forget(self) -> None:
        """Start the measurement anew after a break of the link, for which the map is not responsible."""
        self._answers.clear()
        self._since = None

    @property
    def per_second(self) -> float | None:
        """Keyframes a second; None before enough measurements."""
        if len(self._answers) < _FEWEST_ANSWERS:
            return None
        pause, taken_after = max(self._answers)
        seconds = sum(each for each, _ in self._answers) - pause
        taken = sum(each for _, each in self._answers) - taken_after
        return taken / seconds if seconds > 0 else None


SAMPLES = 16


class ClockOffset:
    """Server clock minus client clock, by the ping with the shortest round trip of the last 16.

    The true offset differs from the estimate by at most half that round trip. Queueing only lengthens round
    trips: an average would contain that error, the minimum avoids it.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int]] = deque(maxlen=SAMPLES)

    def add(self, sent_ns: int, received_ns: int, replied_ns: int, returned_ns: int) -> None:
        """Add one ping: sent and returned by the client's clock, received and replied by the server's."""
        round_trip = (returned_ns - sent_ns) - (replied_ns - received_ns)
        if round_trip >= 0:
            offset = ((received_ns - sent_ns) + (replied_ns - returned_ns)) // 2
            self._samples.append((round_trip, offset))

    def clear(self) -> None:
        """Remove all pings: the server is a new one, with another clock."""
        self._samples.clear()

    @property
    def count(self) -> int:
        """Number of pings in the estimate."""
        return len(self._samples)

    @property
    def offset_ns(self) -> int | None:
        """Nanoseconds to add to a client's stamp to get the server's; None before the first ping."""
        return min(self._samples)[1] if self._samples else None

    @property
    def bound_ns(self) -> int:
        """Largest error (±) of `offset_ns`; 0 before the first ping."""
        return (min(self._samples)[0] + 1) // 2 if self._samples else 0


class Lag(Struct, frozen=True):
    """Lag of the map behind the sensor: number of keyframes it lacks, and its rate."""

    keyframes: int  # that it has yet to get
    rate: float | None  # keyframes a second that it takes; None = not known, as while the link is down

    @property
    def seconds(self) -> float:
        """Time that the map needs for its waiting keyframes; 0 if the rate is unknown."""
        return self.keyframes / self.rate if self.rate else 0.0
