# SPDX-License-Identifier: MIT
"""Choice of tracking keyframes by distance and angle, for localizers that keep no map of their own."""

import math
from typing import Any

import numpy as np

from tsfusion.geometry import se3
from tsfusion.scanner.localization.localizer import Pose


class TrackingKeyframes:
    """Make every pose relative to the last tracking keyframe; begin a new one when the sensor has moved away.

    Args:
        angle: degrees to the next keyframe.
    """

    def __init__(self, *, distance: float = 0.5, angle: float = 10.0) -> None:
        self.distance = distance  # metres to the next keyframe; may be changed at any time
        self._angle = math.radians(angle)
        self._number = -1
        self._T_world_anchor: se3.Transform | None = None

    def pose(self, T_world_camera: se3.Transform, timestamp_ns: int, **known: Any) -> Pose:
        """Make a localizer's answer of (4, 4) `T_world_camera`, relative to the tracking keyframe.

        Args:
            known: quality and motion, as of a `Pose`.
        """
        T = np.eye(4) if self._T_world_anchor is None else se3.inverse(self._T_world_anchor) @ T_world_camera
        moved = se3.distance(T) > self.distance or se3.angle(T) > self._angle
        starts = self._T_world_anchor is None or moved
        if starts:
            self._number += 1
            self._T_world_anchor, T = T_world_camera, np.eye(4)
        return Pose(
            T_world_camera=T_world_camera,
            timestamp_ns=timestamp_ns,
            anchor=self._number,
            T_anchor_camera=T,
            starts_anchor=starts,
            **known,
        )

    def reset(self) -> None:
        """Make the next pose a tracking keyframe. Numbers go on."""
        self._T_world_anchor = None
