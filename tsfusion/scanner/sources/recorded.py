# SPDX-License-Identifier: MIT
"""A recorded dataset as a source of frames."""

import dataclasses
import time
from collections.abc import Iterator
from itertools import islice
from types import TracebackType

from tsfusion.datasets.dataset import NOMINAL_NS, Dataset, frame_of
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.sources.source import LiveSource, Source


class RecordedSource(LiveSource):
    """The frames of a dataset, in order; as if they came from a sensor.

    Args:
        dataset: opened without poses, or with.
        rate: frames a second; None = as fast as they are taken.
    """

    live = False

    def __init__(self, dataset: Dataset, *, rate: float | None = None) -> None:
        super().__init__(dataset.name, dataset.sensor)
        self.skipped = dataset.skipped
        self.length = len(dataset)
        self._dataset, self._rate = dataset, rate

    def __iter__(self) -> Iterator[Frame]:
        """Frames with the recording's times, or nominal ones where it has none."""
        due = time.monotonic()
        for index in range(len(self._dataset)):
            if self._rate is not None and index:
                due = max(due + 1 / self._rate, time.monotonic())  # a sensor that was late does not catch up
                self._closed.wait(max(0.0, due - time.monotonic()))
            if self._closed.is_set():
                return
            frame = frame_of(self._dataset, index)
            stamp = frame.timestamp_ns
            if self._dataset.timestamps_ns is None and not stamp:
                stamp = (index + 1) * NOMINAL_NS
            yield dataclasses.replace(frame, timestamp_ns=stamp, captured_ns=time.monotonic_ns())


class LimitedSource:
    """At most `limit` frames of a source, which is closed with it."""

    def __init__(self, source: Source, limit: int) -> None:
        self.name, self.sensor, self.skipped = source.name, source.sensor, source.skipped
        self.live = source.live
        self.length = None if source.length is None else min(source.length, limit)
        self._source, self._limit = source, limit

    def __iter__(self) -> Iterator[Frame]:
        """Its frames, as they come."""
        return islice(iter(self._source), self._limit)

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def __enter__(self) -> "LimitedSource":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
