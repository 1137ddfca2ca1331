# SPDX-License-Identifier: MIT
"""The difference of two monotonic clocks, from four-timestamp pings (as NTP does it)."""

from collections import deque

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
        """Forget everything: the clock at the other end is another one."""
        self._samples.clear()

    @property
    def count(self) -> int:
        """How many pings the estimate stands on."""
        return len(self._samples)

    @property
    def offset_ns(self) -> int | None:
        """Add to a client stamp to get the server's; None before the first ping."""
        return min(self._samples)[1] if self._samples else None

    @property
    def bound_ns(self) -> int:
        """The estimate is right to within ± this; 0 before the first ping."""
        return (min(self._samples)[0] + 1) // 2 if self._samples else 0
