# SPDX-License-Identifier: MIT
"""A recorded dataset as a source of frames."""

import dataclasses
import time
from collections.abc import Iterator
from types import TracebackType

from tsfusion.datasets.base import Dataset, frame_of
from tsfusion.frame import Frame
from tsfusion.sources.live import Closed

NOMINAL_NS = 33_333_333  # between frames of a recording without times: thirty a second


class Recorded:
    """The frames of a dataset, in order.

    Args:
        dataset: opened without poses, or with.
        rate: frames a second; None = as fast as they are taken.
    """

    def __init__(self, dataset: Dataset, *, rate: float | None = None) -> None:
        self.name, self.sensor, self.skipped = dataset.name, dataset.sensor, dataset.skipped
        self.length: int | None = len(dataset)
        self._dataset, self._rate = dataset, rate
        self._closed = Closed()

    def __iter__(self) -> Iterator[Frame]:
        """Frames with the recording's times, or nominal ones where it has none."""
        due = time.monotonic()
        for index in range(len(self._dataset)):
            if self._rate is not None and index:
                due = max(due + 1 / self._rate, time.monotonic())  # a sensor that was late does not catch up
                self._closed.wait(due - time.monotonic())
            if self._closed.is_set():
                return
            frame = frame_of(self._dataset, index)
            stamp = frame.timestamp_ns
            if self._dataset.timestamps_ns is None and not stamp:
                stamp = (index + 1) * NOMINAL_NS
            yield dataclasses.replace(frame, timestamp_ns=stamp, captured_ns=time.monotonic_ns())

    def close(self) -> None:
        """End the iteration."""
        self._closed.set()

    def __enter__(self) -> "Recorded":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
