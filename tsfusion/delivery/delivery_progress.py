# SPDX-License-Identifier: MIT
"""How far the records of a session are, from the server's disk to its map: runs of numbers, and marks."""

from collections import deque
from collections.abc import Iterable, Iterator

from tsfusion.delivery.spool import Waiting

_ANSWERED_RUNS = 4096  # of numbers without a gap, that are remembered: the server may say more of them


class NumberRuns:
    """Rising numbers, kept as runs without a gap: however many, they take the room of a few."""

    def __init__(self) -> None:
        self._runs: deque[range] = deque()

    def __contains__(self, number: int) -> bool:
        return number in next(self._above(number - 1), range(0))

    def __len__(self) -> int:
        return self.count(0)

    def append(self, number: int) -> None:
        """Put a number behind the others."""
        follows = bool(self._runs) and self._runs[-1].stop == number
        first = self._runs.pop().start if follows else number
        self._runs.append(range(first, number + 1))

    def _above(self, most: int) -> Iterator[range]:
        """The runs with numbers above `most`, as far as they are above it, oldest first."""
        above: list[range] = []
        for run in reversed(self._runs):
            if run.stop <= most + 1:
                break
            above.append(range(max(run.start, most + 1), run.stop))
        return reversed(above)

    def count(self, most: int) -> int:
        """Number of those above `most`."""
        return sum(map(len, self._above(most)))

    def between(self, after: int, last: int) -> Iterator[int]:
        """The numbers above `after` up to `last`."""
        for run in self._above(after):
            yield from range(run.start, min(run.stop, last + 1))

    def cut(self, most: int) -> list[int]:
        """Remove the numbers above `most`; returns them."""
        gone = [number for run in self._above(most) for number in run]
        while self._runs and self._runs[-1].stop > most + 1:
            run = self._runs.pop()
            if run.start <= most:
                self._runs.append(range(run.start, most + 1))
        return gone

    def keep_newest(self, runs: int, *, after: int) -> None:
        """Forget the oldest numbers, down to so many runs, but none above `after`."""
        while len(self._runs) > runs and self._runs[0].stop <= after + 1:
            self._runs.popleft()


class DeliveryProgress:
    """Records that the server has, and marks that only rise unless it has lost some.

    Attributes:
        fused: number of the last record that the map has answered.
        meshed: the mesh shows everything up to this number.
        settled: the map has everything up to this number, each keyframe at its newest pose.
    """

    def __init__(self) -> None:
        self.fused = self.meshed = self.settled = 0
        self._durable, self._corrections = (
            NumberRuns(),
            NumberRuns(),
        )  # and those of them that are corrections

    def acknowledge(self, entries: Iterable[Waiting]) -> None:
        """Note records that are on the server's disk."""
        for entry in entries:
            self._durable.append(entry.seq)
            if entry.is_correction:
                self._corrections.append(entry.seq)
        for runs in (self._durable, self._corrections):
            runs.keep_newest(_ANSWERED_RUNS, after=self.fused)

    def answer(self, fused: int) -> list[int]:
        """Note that the map has answered everything up to `fused`; the keyframes among that."""
        answered = list(self._durable.between(self.fused, fused))
        self.fused = answered[-1] if answered else self.fused
        return [seq for seq in answered if seq not in self._corrections]

    def lose(self, durable: int) -> tuple[list[int], list[int], int]:
        """Note that the server has nothing beyond a number.

        Returns:
            Numbers of the keyframes that are lost, of those that the map had answered; lost corrections.
        """
        corrections = set(self._corrections.cut(durable))
        keyframes = [seq for seq in self._durable.cut(durable) if seq not in corrections]
        answered = [seq for seq in keyframes if seq <= self.fused]
        self.fused = min(self.fused, durable)
        return keyframes, answered, len(corrections)

    def is_correction(self, seq: int) -> bool:
        """True if a record that the server has is a correction."""
        return seq in self._corrections

    def is_fused(self, seq: int) -> bool:
        """True if the map has answered a record that the server has."""
        return seq <= self.fused and seq in self._durable

    @property
    def unfused(self) -> int:
        """Number of records that the server has and the map has not answered."""
        return self._durable.count(self.fused)

    @property
    def unfused_keyframes(self) -> int:
        """Number of keyframes among them."""
        return self.unfused - self._corrections.count(self.fused)
