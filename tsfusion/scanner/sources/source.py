# SPDX-License-Identifier: MIT
"""The `Source` protocol, the base class of live sources, the source that plays a recording, and all by name.

Another package adds a source with an entry point of the group `tsfusion.sources`. The entry point is a
function that returns a `Source`. It takes the text after the colon (None without a colon) and keyword
options.
"""

import dataclasses
import math
import queue
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from types import TracebackType
from typing import Any, Protocol, TypeVar

from tsfusion.core import plugins
from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.datasets.cameras import recorded_camera
from tsfusion.datasets.dataset import NOMINAL_NS, Dataset, UnreadableFrame, frame_of
from tsfusion.geometry.frame import Frame

GROUP = "tsfusion.sources"
# Name → module of this package, and class
_BUILT_IN = {
    "realsense": "realsense:RealSense",
    "oak": "depth_cameras:OakD",
    "orbbec": "depth_cameras:Orbbec",
    "camera": "stereo_video:StereoVideo",
    "folder": "watched_folder:WatchedFolder",
    "ros2": "ros2_topics:Ros2Topics",
}
_FORMS = (
    "realsense, realsense:SERIAL, realsense:FILE.db3, oak[:SERIAL|ADDRESS], orbbec[:SERIAL], "
    "camera:NUMBER|DEVICE|URL|FILE, folder:PATH, ros2"
)


class Source(Protocol):
    """Frames in time order, from a sensor, a folder that is being written to, or a recording.

    Attributes:
        name: name for reports.
        sensor: name of the sensor model of the frames.
        live: True if frames are lost while nobody takes them. Frames of a recording or a folder wait.
        length: number of frames; None = unknown.
        skipped: reason → number of frames left out so far.

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
        """Yield each frame as soon as it arrives, until the source ends.

        Raises:
            SourceError: the sensor stopped; the message says what to do.
        """

    def close(self) -> None:
        """Release the sensor. It may be called twice, and from another thread to end the iteration."""

    def __enter__(self) -> "Source": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


SECOND = 1_000_000_000  # nanoseconds
_Self = TypeVar("_Self", bound="LiveSource")


class CloseFlag:
    """Flag like `threading.Event`, but a signal handler may set it while the same thread waits for it."""

    def __init__(self) -> None:
        self._set = False
        self._wakeups: queue.SimpleQueue[None] = queue.SimpleQueue()  # its `put` is reentrant, unlike a lock

    def set(self) -> None:
        """Set the flag and wake the waiting thread."""
        self._set = True
        self._wakeups.put(None)

    def is_set(self) -> bool:
        return self._set

    def wait(self, timeout: float) -> bool:
        """Wait up to `timeout` seconds for the flag, in one thread at a time. Return True if it is set."""
        if not self._set:
            with suppress(queue.Empty):
                self._wakeups.get(timeout=timeout)
        return self._set


class LiveSource(ABC):
    """Base class of sources. `close` sets the flag `_closed`, which ends an iteration that waits."""

    live = True
    length: int | None = None
    camera = ""  # intrinsics and their origin, in one line; empty if only the frames have them

    def __init__(self, name: str, sensor: str) -> None:
        self.name, self.sensor = name, sensor
        self.skipped: dict[str, int] = {}
        self._closed = CloseFlag()

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Yield each frame as soon as it arrives."""

    def waits_for(self) -> str:
        """Return text for the user: what the source waits for, and when it ends; empty = nothing to say."""
        return ""

    def close(self) -> None:
        """End the iteration. It may be called twice."""
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
    """Convert a wall clock time to `time.monotonic_ns()`. If it is too old or in the future, return now."""
    now, age = time.monotonic_ns(), time.time_ns() - wall_ns
    return now - age if 0 <= age <= oldest_s * SECOND else now


_POLL_S = 0.1  # seconds between two calls of `attend` during a wait
_READ_AHEAD = 3  # multiple of the last frame's reading time: disks and images differ


class RecordedSource(LiveSource):
    """Play a dataset's frames in order, as if they came from a sensor.

    Args:
        dataset: an open dataset, with or without poses.
        rate: frames a second; None = as fast as the caller takes them.

    Attributes:
        attend: called again and again while the source waits for a frame's time.
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
        self.camera = recorded_camera(dataset)

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames with the recording's timestamps, or with nominal ones if it has none.

        With a rate, a late frame delays all later frames, as with a sensor. Each frame is read shortly before
        its time. Reading at once would take a core while the server fuses the previous frame: on two cores
        that adds a third to the delay.
        """
        due, ahead = -math.inf, math.inf  # the last frame's time; seconds from reading a frame to its time
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
        return -math.inf if self._rate is None else due + 1 / self._rate

    def _wait_until(self, due: float) -> None:
        while (left := due - time.monotonic()) > 0 and not self._closed.is_set():
            self.attend()
            self._closed.wait(min(left, _POLL_S))


def is_live(spec: str) -> bool:
    """Return True if `spec` names a live source of tsfusion or of an installed package, False for a path."""
    name = spec.partition(":")[0]
    return name in _BUILT_IN or name in entry_points(group=GROUP).names


def open_source(spec: str, /, **options: object) -> Source:
    """Open `realsense`, `oak`, `orbbec`, `camera`, `folder`, `ros2` or a package's source: `name[:PLACE]`.

    Args:
        spec: name and address of the source, as for `tsfusion scan`.
        options: keyword arguments of the source's class; None means the default of the class.

    Raises:
        InvalidConfig: there is no such source, or it has no such option, or an option has the wrong type.
        SourceError: the source cannot be opened.
        MissingDependency: the source's optional package is not installed.

    Examples:
        >>> with tsfusion.open_source("folder:incoming", idle=0.1) as source:  # or "realsense", "camera:0"
        ...     kinds = [frame.kind for frame in source]
        >>> kinds
        ['depth']
    """
    name, _, place = spec.partition(":")
    others = entry_points(group=GROUP)
    if name in _BUILT_IN:
        point = EntryPoint(name, f"{__package__}.{_BUILT_IN[name]}", GROUP)
    elif name in others.names:
        point = others[name]
    else:
        there = "".join(f", {other}" for other in sorted(others.names))
        raise InvalidConfig(f"source must be one of {_FORMS}{there}, got {spec!r}")
    if name == "folder" and not place:
        raise SourceError("folder needs the path of one: folder:PATH")
    source: Callable[..., Source] = partial(plugins.load(point, SourceError), place or None)
    return plugins.call(source, options, name=f"source {name}", error=InvalidConfig)
