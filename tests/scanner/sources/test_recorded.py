# SPDX-License-Identifier: MIT
"""Recordings played like a sensor: when frames are read, and when they come."""

from typing import Any

import numpy as np
import pytest

from tsfusion.geometry.frame import Frame
from tsfusion.scanner.sources import source as recorded
from tsfusion.scanner.sources.source import RecordedSource


class Clock:
    """A recording whose reading takes time, and waits that end on the dot."""

    name, sensor, skipped, timestamps_ns = "a list", "lidar", {}, None

    def __init__(self, *reading: float) -> None:
        self.now, self.reads, self._reading = 0.0, [], reading

    def __len__(self) -> int:
        return len(self._reading)

    def frame(self, index: int) -> Frame:
        self.reads.append(round(self.now, 6))
        self.now += self._reading[index]
        return Frame(sensor="lidar", points=np.ones((1, 3), np.float32))

    def wait(self, seconds: float) -> None:
        self.now += seconds


@pytest.mark.parametrize(
    ("reading", "rate", "reads", "yielded"),
    [
        ((0.01,) * 4, 4, [0, 0.23, 0.48, 0.73], [0.01, 0.26, 0.51, 0.76]),  # when its time is near
        ((0.1,) * 4, 4, [0, 0.1, 0.35, 0.6], [0.1, 0.35, 0.6, 0.85]),  # a slow disk: at once
        # late once, never caught up
        ((0.01, 0.01, 0.1, 0.01), 4, [0, 0.23, 0.48, 0.58], [0.01, 0.26, 0.58, 0.83]),
        ((0.1,) * 4, None, [0, 0.1, 0.2, 0.3], [0.1, 0.2, 0.3, 0.4]),
    ],
)
def test_a_frame_at_a_rate_is_read_shortly_before_its_time(
    reading: tuple[float, ...],
    rate: float | None,
    reads: list[float],
    yielded: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock: Any = Clock(*reading)
    monkeypatch.setattr(recorded.time, "monotonic", lambda: clock.now)
    source = RecordedSource(clock, rate=rate)
    monkeypatch.setattr(source._closed, "wait", clock.wait)
    assert [round(clock.now, 6) for _ in source] == yielded
    assert clock.reads == reads
