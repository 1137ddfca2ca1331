# SPDX-License-Identifier: MIT
"""The `Source` protocol, the base of sources that wait for frames, and recordings as sources."""

import dataclasses
import math
import queue
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import islice
from types import TracebackType
from typing import Any, Protocol, TypeVar

from tsfusion.datasets.cameras import RecordedCamera
from tsfusion.datasets.dataset import NOMINAL_NS, Dataset, UnreadableFrame, frame_of
from tsfusion.geometry.frame import Frame


class Source(Protocol):
    """Frames in time order: a sensor, a folder that is being written to, a recording.

    Attributes:
        name: name for reports.
        sensor: name of the sensor model of its frames.
        live: whether frames are lost while nobody takes them; those of a recording or a folder wait.
        length: number of frames; None = unknown.
        skipped: number of frames left out so far, by reason.

    Examples:
        >>> with tsfusion.open_source("folder:incoming", idle=0.1) as source:
        ...     frames = sum(1 for frame in source)
        >>> frames, source.skipped
        (1, {})
    """

    name: str
    sensor: str
    live: bool
    length: int | None
    skipped: dict[str, int]

    def __iter__(self) -> Iterator[Frame]:
        """Yield each frame as soon as it arrives; end when the source does.

        Raises:
            SourceError: the sensor stopped; the message says what to do.
        """

    def close(self) -> None:
        """Release the sensor; may be called twice, and from another thread to end the iteration."""

    def __enter__(self) -> "Source": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


SECOND = 1_000_000_000  # nanoseconds
_Self = TypeVar("_Self", bound="LiveSource")


class CloseFlag:
    """Like `threading.Event`, but a signal handler may set it while its own thread waits."""

    def __init__(self) -> None:
        self._set = False
        self._wakeups: queue.SimpleQueue[None] = queue.SimpleQueue()  # its `put` is reentrant; a lock is not

    def set(self) -> None:
        """Set the flag and wake the waiting thread."""
        self._set = True
        self._wakeups.put(None)

    def is_set(self) -> bool:
        """True once the flag is set."""
        return self._set

    def wait(self, timeout: float) -> bool:
        """Wait up to `timeout` seconds for the flag, in one thread at a time. Returns True if it is set."""
        if not self._set:
            with suppress(queue.Empty):
                self._wakeups.get(timeout=timeout)
        return self._set


class LiveSource(ABC):
    """Base of sources: `close` ends the iteration, which checks `_closed` whenever it waits."""

    live = True
    length: int | None = None
    camera = ""  # intrinsics and where they came from, in one line; empty = its frames alone tell

    def __init__(self, name: str, sensor: str) -> None:
        self.name, self.sensor = name, sensor
        self.skipped: dict[str, int] = {}
        self._closed = CloseFlag()

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Yield each frame as soon as it arrives."""

    def waits_for(self) -> str:
        """Needs of a source, and its end, for a person; empty = nothing to say."""
        return ""

    def close(self) -> None:
        """End the iteration; may be called twice."""
        self._closed.set()

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _skip(self, reason: str, count: int = 1) -> None:
        """Count frames that are left out."""
        self.skipped[reason] = self.skipped.get(reason, 0) + count


def monotonic_of(wall_ns: int, *, oldest_s: float) -> int:
    """Convert a wall clock time to `time.monotonic_ns()`; now, if it is in the future or too old."""
    now, age = time.monotonic_ns(), time.time_ns() - wall_ns
    return now - age if 0 <= age <= oldest_s * SECOND else now


_POLL_S = 0.1  # between looks at what else there is to do while a time is waited for
_READ_AHEAD = 3  # times as long as the last frame took to be read: disks and images differ


class RecordedSource(LiveSource):
    """Play a dataset's frames in order, as if they came from a sensor.

    Args:
        dataset: opened with poses or without.
        rate: frames a second; None = as fast as they are taken.

    Attributes:
        attend: called again and again while a frame's time is waited for.
    """

    live = False
    attend: Callable[[], object] = staticmethod(lambda: None)

    def __init__(self, dataset: Dataset, *, rate: float | None = None) -> None:
        super().__init__(dataset.name, dataset.sensor)
        self.skipped = dataset.skipped
        self.length = len(dataset)
        self.usual: Mapping[str, Any] = getattr(dataset, "usual", {})
        self.origin = getattr(dataset, "origin", None)
        self._dataset, self._rate = dataset, rate
        camera = getattr(dataset, "camera", None)
        self.camera = str(camera) if isinstance(camera, RecordedCamera) else ""

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames with the recording's timestamps, or nominal ones where it has none.

        At a rate, a sensor that was late does not catch up, and a frame is read when its time is near: read
        at once it would take a core while the server fuses the last one, a third of the delay on two cores.
        """
        due, ahead = -math.inf, math.inf  # of the last frame; how long before its time the next one is read
        for index in range(len(self._dataset)):
            self._wait_until(self._after(due) - ahead)
            if self._closed.is_set():
                return
            began = time.monotonic()
            try:
                frame = frame_of(self._dataset, index)
            except UnreadableFrame:
                continue
            ahead = _READ_AHEAD * (time.monotonic() - began)
            due = max(self._after(due), time.monotonic())
            self._wait_until(due)
            stamp = frame.timestamp_ns
            if self._dataset.timestamps_ns is None and not stamp:
                stamp = (index + 1) * NOMINAL_NS
            yield dataclasses.replace(frame, timestamp_ns=stamp, captured_ns=time.monotonic_ns())

    def _after(self, due: float) -> float:
        """Time of the frame after one."""
        return -math.inf if self._rate is None else due + 1 / self._rate

    def _wait_until(self, due: float) -> None:
        while (left := due - time.monotonic()) > 0 and not self._closed.is_set():
            self.attend()
            self._closed.wait(min(left, _POLL_S))


class LimitedSource(LiveSource):
    """The first `limit` frames of a source; closes the source with itself."""

    def __init__(self, source: Source, limit: int) -> None:
        super().__init__(source.name, source.sensor)
        self.live, self.skipped = source.live, source.skipped
        self.origin = getattr(source, "origin", None)
        self.length = None if source.length is None else min(source.length, limit)
        self._source, self._limit = source, limit

    @property
    def camera(self) -> str:  # type: ignore[override]
        """The source's camera; a folder knows its own with the first frame."""
        return getattr(self._source, "camera", "")

    def __iter__(self) -> Iterator[Frame]:
        """Yield the source's frames, up to the limit."""
        return islice(iter(self._source), self._limit)

    def waits_for(self) -> str:
        """Needs of the source, and its end."""
        return self._source.waits_for() if isinstance(self._source, LiveSource) else ""

    def close(self) -> None:
        """Close the source."""
        self._source.close()
