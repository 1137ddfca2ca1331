# SPDX-License-Identifier: MIT
"""Sources that play a recorded dataset, or the first frames of another source."""

import dataclasses
import time
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any

from tsfusion.datasets.cameras import RecordedCamera
from tsfusion.datasets.dataset import NOMINAL_NS, Dataset, UnreadableFrame, frame_of
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.sources.source import LiveSource, Source


class RecordedSource(LiveSource):
    """Play a dataset's frames in order, as if they came from a sensor.

    Args:
        dataset: opened with poses or without.
        rate: frames a second; None = as fast as they are taken.
    """

    live = False

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
        """Yield frames with the recording's timestamps, or nominal ones where it has none."""
        due = time.monotonic()
        for index in range(len(self._dataset)):
            if self._rate is not None and index:
                due = max(due + 1 / self._rate, time.monotonic())  # a sensor that was late does not catch up
                self._closed.wait(max(0.0, due - time.monotonic()))
            if self._closed.is_set():
                return
            try:
                frame = frame_of(self._dataset, index)
            except UnreadableFrame:
                continue
            stamp = frame.timestamp_ns
            if self._dataset.timestamps_ns is None and not stamp:
                stamp = (index + 1) * NOMINAL_NS
            yield dataclasses.replace(frame, timestamp_ns=stamp, captured_ns=time.monotonic_ns())


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
