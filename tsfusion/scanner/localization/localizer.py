# SPDX-License-Identifier: MIT
"""The `Localizer` protocol, and its answers: a pose or a loss a frame, and corrections of earlier poses."""

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.sweeps import Motion


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedPose:
    """Pose of the sensor at one frame.

    Attributes:
        T_world_camera: (4, 4) float64; the world is the first frame's camera since the start or the last
            `reset`, or the given trajectory's. Odometry: corrections never make it jump.
        timestamp_ns: the frame's.
        anchor: number of the tracking keyframe it is relative to; numbers grow, also across a `reset`.
        T_anchor_camera: (4, 4); the corrected pose is the corrected anchor times this.
        starts_anchor: whether this frame is that tracking keyframe.
        quality: 0 to 1, the share of what was compared that agrees; 1 where poses are given.
        motion: of the sensor in the time of the frame's points; None = not known, or all are of one time.
    """

    T_world_camera: Transform
    timestamp_ns: int
    anchor: int
    T_anchor_camera: Transform
    starts_anchor: bool = False
    quality: float = 1.0
    motion: Motion | None = None


@dataclass(frozen=True, kw_only=True)
class Lost:
    """Answer for a frame without a pose. Such a frame must not be fused.

    Attributes:
        reason: text for the user, such as `12 of 300 points agree`.
        timestamp_ns: the frame's.
    """

    reason: str
    timestamp_ns: int


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseCorrections:
    """Poses given before, corrected by loop closure. The newest revision replaces all others.

    Attributes:
        revision: counts up from 1 since the last `reset`.
        anchors: tracking keyframe → its corrected (4, 4) T_world_camera, for all since the last `reset`.
        T_corrected_world: (4, 4); `T_corrected_world @ T_world_camera` corrects poses after the last anchor.
        loops: loops closed so far.
    """

    revision: int
    anchors: dict[int, Transform]
    T_corrected_world: Transform
    loops: int


class Localizer(Protocol):
    """Tracker of a sensor. Frames come in time order, from one thread.

    A localizer that holds a socket has a `close()`, too.

    Attributes:
        absolute: whether its world stays the same after `reset`, as that of poses from elsewhere does.
    """

    absolute: bool

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Find the sensor's pose; Lost when it is not known (then try the next frame, or `reset`).

        Raises:
            InvalidKeyframe: when the frame lacks what this localizer needs (colour, depth, a stereo pair).
        """

    def prepare(self) -> None:
        """Do what the next frame needs of the last one, whose pose does not wait for it.

        Call it when the pose was used; otherwise `track` does it first.
        """
        return

    def corrections(self) -> PoseCorrections | None:
        """Return corrections that are new since the last call; None = there are none, as in odometry."""
        return None

    def settle(self) -> None:
        """Finish what is done beside `track`; then `corrections` has what comes of it."""
        return

    def reset(self) -> None:
        """Forget the world: the next pose begins a new one, unrelated to the old."""


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

    def pose(self, T_world_camera: se3.Transform, timestamp_ns: int, **known: Any) -> TrackedPose:
        """Make a localizer's answer of (4, 4) `T_world_camera`, relative to the tracking keyframe.

        Args:
            known: quality and motion, as of a `TrackedPose`.
        """
        T = np.eye(4) if self._T_world_anchor is None else se3.inverse(self._T_world_anchor) @ T_world_camera
        moved = se3.distance(T) > self.distance or se3.angle(T) > self._angle
        starts = self._T_world_anchor is None or moved
        if starts:
            self._number += 1
            self._T_world_anchor, T = T_world_camera, np.eye(4)
        return TrackedPose(
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
