# SPDX-License-Identifier: MIT
"""Numbers of records in a queue of any length."""

from collections import deque
from collections.abc import Iterator


class NumberRuns:
    """Rising numbers in a queue, kept as runs without a gap: however many, they take the room of a few."""

    def __init__(self) -> None:
        self._runs: deque[range] = deque()
        self._count = 0

    def __contains__(self, number: int) -> bool:
        for run in reversed(self._runs):
            if run.start <= number:
                return number in run
        return False

    @property
    def first(self) -> int | None:
        """The lowest number; None = there is none."""
        return self._runs[0].start if self._runs else None

    def keep_newest(self, runs: int) -> None:
        """Forget the oldest numbers, down to so many runs."""
        while len(self._runs) > runs:
            self._count -= len(self._runs.popleft())

    def cut(self, most: int) -> list[int]:
        """Remove the numbers above `most`; returns them."""
        gone: list[int] = []
        while self._runs and self._runs[-1].stop > most + 1:
            run = self._runs.pop()
            if run.start <= most:
                self._runs.append(range(run.start, most + 1))
            gone += range(max(run.start, most + 1), run.stop)
        self._count -= len(gone)
        return gone

    def __len__(self) -> int:
        return self._count

    def append(self, number: int) -> None:
        """Put a number behind the others."""
        follows = bool(self._runs) and self._runs[-1].stop == number
        first = self._runs.pop().start if follows else number
        self._runs.append(range(first, number + 1))
        self._count += 1

    def take(self, most: int) -> Iterator[int]:
        """Remove the numbers up to `most`, and yield them."""
        while self._runs and self._runs[0].start <= most:
            run = self._runs.popleft()
            taken = range(run.start, min(run.stop, most + 1))
            if taken.stop < run.stop:
                self._runs.appendleft(range(taken.stop, run.stop))
            self._count -= len(taken)
            yield from taken
