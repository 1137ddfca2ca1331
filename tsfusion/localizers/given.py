# SPDX-License-Identifier: MIT
"""Poses that the source itself gives: ground truth, or a sensor with tracking of its own."""

from tsfusion.frame import Frame
from tsfusion.localizers.anchors import Anchors
from tsfusion.localizers.base import Corrections, Lost, Pose


class Given:
    """`Localizer` that believes `frame.T_world_camera`."""

    absolute = True

    def __init__(self) -> None:
        self._anchors = Anchors()

    def track(self, frame: Frame) -> Pose | Lost:
        """The frame's own pose; Lost where it has none."""
        if frame.T_world_camera is None:
            return Lost(reason="the source gives no pose for this frame", timestamp_ns=frame.timestamp_ns)
        return self._anchors.pose(frame.T_world_camera, frame.timestamp_ns)

    def corrections(self) -> Corrections | None:
        """None: what is given is not corrected."""
        return None

    def reset(self) -> None:
        """The world stays the source's."""
        self._anchors.reset()
