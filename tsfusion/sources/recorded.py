# SPDX-License-Identifier: MIT
"""A recorded dataset as a source of frames."""

import dataclasses
import time
from collections.abc import Iterator

from tsfusion.datasets.base import Dataset, frame_of
from tsfusion.frame import Frame
from tsfusion.sources.live import Live

NOMINAL_NS = 33_333_333  # between frames of a recording without times: thirty a second


class Recorded(Live):
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
