# SPDX-License-Identifier: MIT
"""Times at both ends: of each keyframe at each stage, the rate at which the map takes them, two clocks."""

from collections import deque

import numpy as np
from msgspec import Struct

from tsfusion.wire.messages.keyframe_times import KeyframeTimes, Stamps

CAPACITY = 65536
_LARGEST = (1 << 63) - 1
_FIELDS = KeyframeTimes.__struct_fields__
_COLUMN = {name: place for place, name in enumerate(_FIELDS)}
_SERVER_STAMPS = ("received_ns", "durable_ns", "fuse_start_ns", "fused_ns", "meshed_ns")


class KeyframeTimesTable:
    """One row a keyframe; a new one takes the place of the one that came `CAPACITY` numbers before."""

    def __init__(self) -> None:
        self._rows = np.zeros((CAPACITY, len(_FIELDS)), np.int64)  # pages are taken when they are written to
        self._newest_fused = 0

    def add(self, seq: int, *, timestamp_ns: int, captured_ns: int) -> None:
        """Begin the row of a keyframe."""
        row = self._rows[seq % CAPACITY]
        row[:] = 0
        row[:3] = seq, timestamp_ns, captured_ns

    def remove(self, seq: int) -> None:
        """Empty the row of a keyframe that was never sent."""
        if self._has(seq):
            self._rows[seq % CAPACITY] = 0

    def sent(self, seq: int, sent_ns: int) -> None:
        """Note when a keyframe was handed to the socket."""
        if self._has(seq):
            self._rows[seq % CAPACITY, _COLUMN["sent_ns"]] = sent_ns

    def stamp(self, stamps: Stamps, offset_ns: int, bound_ns: int) -> None:
        """Note the server's stamps, on our clock; the first of each counts."""
        if self._has(stamps.seq):
            row = self._rows[stamps.seq % CAPACITY]
            row[_COLUMN["clock_bound_ns"]] = min(bound_ns, _LARGEST)
            for name in _SERVER_STAMPS:
                if (value := getattr(stamps, name)) and not row[_COLUMN[name]]:
                    row[_COLUMN[name]] = min(max(value - offset_ns, -_LARGEST), _LARGEST)
            if row[_COLUMN["fused_ns"]] > 0:
                self._newest_fused = max(self._newest_fused, stamps.seq)

    def newest_fused(self) -> KeyframeTimes | None:
        """The row of the newest keyframe that is in the map; None = there is none yet."""
        if not self._newest_fused or not self._has(self._newest_fused):
            return None
        row = self._rows[self._newest_fused % CAPACITY].tolist()
        return KeyframeTimes(**dict(zip(_FIELDS, row, strict=True)))

    def copy(self) -> list[KeyframeTimes]:
        """All rows, oldest first."""
        rows = self._rows[self._rows[:, 0] > 0]
        ordered = rows[np.argsort(rows[:, 0])].tolist()
        return [KeyframeTimes(**dict(zip(_FIELDS, row, strict=True))) for row in ordered]

    def _has(self, seq: int) -> bool:
        return bool(self._rows[seq % CAPACITY, 0] == seq)


_ANSWERS = 64  # of the map, over which its rate is measured
_FEWEST_ANSWERS = 8  # before there is a rate


class TakingRate:
    """Keyframes a second that the map takes, as far as that was seen.

    Time counts from one answer of the map to the next, and only while keyframes wait for it: what a map that
    waits could take, nobody knows. The longest pause does not count: a fuser may have died in it.
    """

    def __init__(self) -> None:
        self._answers: deque[tuple[float, int]] = deque(maxlen=_ANSWERS)  # seconds, keyframes taken in them
        self._since: float | None = None  # the map's last answer; None = it had nothing to do since

    def note(self, now: float, taken: int, *, is_more_waiting: bool) -> None:
        """Note that the map took so many keyframes, and whether others wait."""
        if self._since is not None:
            self._answers.append((now - self._since, taken))
        self._since = now if is_more_waiting else None

    def rest(self) -> None:
        """Note that no keyframe waits any more, whatever became of the last."""
        self._since = None

    def forget(self) -> None:
        """Begin anew: the link was down, and that is not the map's fault."""
        self._answers.clear()
        self._since = None

    @property
    def per_second(self) -> float | None:
        """The rate; None = not known."""
        if len(self._answers) < _FEWEST_ANSWERS:
            return None
        pause, taken_after = max(self._answers)
        seconds = sum(each for each, _ in self._answers) - pause
        taken = sum(each for _, each in self._answers) - taken_after
        return taken / seconds if seconds > 0 else None


SAMPLES = 16


class ClockOffset:
    """Server clock minus client clock, by the ping with the shortest round trip of the last 16.

    The true offset lies within half that round trip of the estimate: queueing can only lengthen a round
    trip, so averaging over pings adds error where the minimum sheds it.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int]] = deque(maxlen=SAMPLES)

    def add(self, sent_ns: int, received_ns: int, replied_ns: int, returned_ns: int) -> None:
        """One ping: sent and returned by the client's clock, received and replied by the server's."""
        round_trip = (returned_ns - sent_ns) - (replied_ns - received_ns)
        if round_trip >= 0:
            offset = ((received_ns - sent_ns) + (replied_ns - returned_ns)) // 2
            self._samples.append((round_trip, offset))

    def clear(self) -> None:
        """Forget all pings: the clock at the other end is another one."""
        self._samples.clear()

    @property
    def count(self) -> int:
        """Number of pings that the estimate stands on."""
        return len(self._samples)

    @property
    def offset_ns(self) -> int | None:
        """Add to a client stamp to get the server's; None before the first ping."""
        return min(self._samples)[1] if self._samples else None

    @property
    def bound_ns(self) -> int:
        """The estimate is right to within ± this; 0 before the first ping."""
        return (min(self._samples)[0] + 1) // 2 if self._samples else 0


class Lag(Struct, frozen=True):
    """Lag of the map behind the sensor."""

    keyframes: int  # that it has yet to get
    rate: float | None  # keyframes a second that it takes; None = not known, as while the link is down

    @property
    def seconds(self) -> float:
        """Time to catch up with what was sent up to now; 0 where the rate is not known."""
        return self.keyframes / self.rate if self.rate else 0.0
