# SPDX-License-Identifier: MIT
"""Stereo pairs of likely keyframes, matched in a thread of their own while the localizer tracks the frame."""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Keyframe

MOST_STEPS = 3.0  # times the last motion's duration that its velocity is believed


class EarlyMatching:
    """Makes keyframes of frames; a pair whose matching was begun early is not matched again.

    Matching takes longer than tracking, and both release Python's lock. Its result depends on the pair
    alone: a wrong guess costs time, and never changes a keyframe.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="matching")
        self._begun: tuple[Frame, Future[NDArray[np.uint16]]] | None = None

    def begin(self, frame: Frame) -> None:
        """Begin to match the pair of a frame; what was begun before and not asked for is dropped."""
        self.drop()
        self._begun = frame, self._thread.submit(frame.match)

    def keyframe(self, frame: Frame, T_world_camera: NDArray[np.float64]) -> Keyframe:
        """Make a keyframe of the frame at (4, 4) `T_world_camera`."""
        begun, self._begun = self._begun, None
        if begun is None or begun[0] is not frame:
            return frame.keyframe(T_world_camera)
        return frame.keyframe(T_world_camera, disparity=begun[1].result())

    def drop(self) -> None:
        """Forget what was begun."""
        if self._begun is not None:
            self._begun[1].cancel()  # where it has not begun
            self._begun = None


class ExpectedPose:
    """The pose that a steady motion leads to, by the last two."""

    def __init__(self) -> None:
        self._poses: list[tuple[int, se3.Transform]] = []

    def add(self, timestamp_ns: int, T_world_camera: se3.Transform) -> None:
        """Add the (4, 4) pose of a frame, the newest so far."""
        self._poses = [*self._poses[-1:], (timestamp_ns, T_world_camera)]

    def at(self, timestamp_ns: int) -> se3.Transform | None:
        """(4, 4) pose to expect at a time; None before the first pose."""
        if not self._poses:
            return None
        stamp, T = self._poses[-1]
        if len(self._poses) == 1:
            return T
        before, T_before = self._poses[0]
        steps = (timestamp_ns - stamp) / (stamp - before) if stamp > before else 1.0
        motion: Any = se3.log(se3.inverse(T_before) @ T)
        expected: se3.Transform = T @ se3.exp(motion * min(max(steps, 0.0), MOST_STEPS))
        return expected

    def reset(self) -> None:
        """Forget the poses: the sensor is lost."""
        self._poses = []
