# SPDX-License-Identifier: MIT
"""What a source of frames is."""

import queue
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from types import TracebackType
from typing import Protocol, TypeVar

from tsfusion.geometry.frame import Frame


class Source(Protocol):
    """Frames in time order: a sensor, a folder that is being written to, a recording.

    Attributes:
        name: what to call it in a report.
        sensor: name of the sensor model of its frames.
        live: whether frames pass by while nobody takes them; those of a recording or a folder wait.
        length: how many frames it has; None = nobody knows.
        skipped: frames that were not handed out, by reason, so far.
    """

    name: str
    sensor: str
    live: bool
    length: int | None
    skipped: dict[str, int]

    def __iter__(self) -> Iterator[Frame]:
        """Each frame as soon as it is there; ends when the source does.

        Raises:
            SourceError: the sensor stopped, with what to do about it.
        """

    def close(self) -> None:
        """Let go of the sensor; may be called twice, and from another thread to end the iteration."""

    def __enter__(self) -> "Source": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


SECOND = 1_000_000_000  # nanoseconds
_Self = TypeVar("_Self", bound="LiveSource")


class CloseFlag:
    """A `threading.Event` that a signal's handler may set while its own thread waits for it."""

    def __init__(self) -> None:
        self._set = False
        self._wakeups: queue.SimpleQueue[None] = queue.SimpleQueue()  # its `put` is reentrant; a lock is not

    def set(self) -> None:
        """From now on `is_set`, and whoever waits is woken."""
        self._set = True
        self._wakeups.put(None)

    def is_set(self) -> bool:
        """Whether it was set."""
        return self._set

    def wait(self, timeout: float) -> bool:
        """Whether it is set within `timeout` seconds; for one thread at a time."""
        if not self._set:
            with suppress(queue.Empty):
                self._wakeups.get(timeout=timeout)
        return self._set


class LiveSource(ABC):
    """A `Source`; `close` ends the iteration, which looks at `_closed` whenever it waits."""

    live = True
    length: int | None = None

    def __init__(self, name: str, sensor: str) -> None:
        self.name, self.sensor = name, sensor
        self.skipped: dict[str, int] = {}
        self._closed = CloseFlag()

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Each frame as soon as it is there."""

    def close(self) -> None:
        """End the iteration; more than once does no harm."""
        self._closed.set()

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _skip(self, reason: str, count: int = 1) -> None:
        """Count frames that are not handed out."""
        self.skipped[reason] = self.skipped.get(reason, 0) + count


def monotonic_of(wall_ns: int, *, oldest_s: float) -> int:
    """`time.monotonic_ns()` at a moment of the wall clock; now, where that lies ahead or too far back."""
    now, age = time.monotonic_ns(), time.time_ns() - wall_ns
    return now - age if 0 <= age <= oldest_s * SECOND else now
