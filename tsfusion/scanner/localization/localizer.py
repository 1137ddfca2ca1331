# SPDX-License-Identifier: MIT
"""The `Localizer` protocol, and its results: a pose or a loss for each frame, and corrections of poses."""

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.sweeps import Motion

_KEYFRAME_ANGLE = math.radians(10)  # to the next tracking keyframe


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedPose:
    """Pose of the sensor at one frame.

    Attributes:
        T_world_camera: (4, 4) float64. The world's axes are those of a given trajectory, or those of the
            first camera since the start or the last `reset`. Corrections never make these poses jump.
        timestamp_ns: timestamp of the frame.
        anchor: number of the tracking keyframe that `T_anchor_camera` is relative to. Numbers grow, also
            across a `reset`.
        T_anchor_camera: (4, 4); the corrected pose is the corrected anchor times this.
        starts_anchor: True if this frame is itself that tracking keyframe.
        quality: 0 to 1, share of the compared points that agree; 1 for given poses.
        covariance: (6, 6), of the pose relative to the tracking keyframe that it was found from, as a twist
            in the camera's axes: m², rad². None = not known.
        color_delay_s: seconds by which colour is later than depth, as estimated so far; 0 = none.
        T_then_now: (4, 4) motion of the camera from depth to colour, in its axes; None = none, or not known.
        motion: motion of the sensor during the frame's points. None = not known, or all points have one time.
    """

    T_world_camera: Transform
    timestamp_ns: int
    anchor: int
    T_anchor_camera: Transform
    starts_anchor: bool = False
    quality: float = 1.0
    covariance: se3.Matrix6 | None = None
    color_delay_s: float = 0.0
    T_then_now: Transform | None = None
    motion: Motion | None = None

    @property
    def deviations(self) -> tuple[float, float]:
        """Root mean square errors to expect of place and turn, metres and radians; NaN where not known."""
        if self.covariance is None:
            return math.nan, math.nan
        place, turn = self.covariance.diagonal().reshape(2, 3).sum(axis=1).tolist()
        return math.sqrt(place), math.sqrt(turn)


@dataclass(frozen=True, kw_only=True)
class Lost:
    """Result for a frame without a pose. Such a frame must not be fused.

    Attributes:
        reason: text for the user, such as `12 of 300 points agree`.
        timestamp_ns: timestamp of the frame.
    """

    reason: str
    timestamp_ns: int


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseCorrections:
    """Earlier poses, corrected by loop closure. The newest ones replace all others.

    Attributes:
        anchors: tracking keyframe → corrected (4, 4) T_world_camera, for all since the last `reset`.
        T_corrected_world: (4, 4); `T_corrected_world @ T_world_camera` corrects poses after the last anchor.
        loops: number of loops closed so far.
    """

    anchors: dict[int, Transform]
    T_corrected_world: Transform
    loops: int


class Localizer(Protocol):
    """Tracker of a sensor. Frames come in time order, from one thread.

    A localizer that holds a socket also has a `close()`.

    Attributes:
        absolute: True if `reset` keeps the world (coordinate frame), as with poses from a file.
    """

    absolute: bool

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Find the sensor's pose. Return Lost when it is not known (then try the next frame, or `reset`).

        Raises:
            InvalidKeyframe: the frame lacks data that this localizer needs (colour, depth, a stereo pair).
        """

    def prepare(self) -> None:
        """Compute from the last frame what the next frame needs.

        This is apart from `track` so that the pose need not wait for it. Call it after the use of the pose;
        otherwise `track` does it first.
        """
        return

    def corrections(self) -> PoseCorrections | None:
        """Return the corrections that are new since the last call, or None if there are none."""
        return None

    def settle(self) -> None:
        """Finish the work in other threads. After it, `corrections` returns their results."""
        return

    def reset(self) -> None:
        """Forget the world. The next pose starts a new one, unrelated to the old."""


class TrackingKeyframes:
    """Make each pose relative to the last tracking keyframe. Far from it, make a new tracking keyframe."""

    distance = 0.5  # metres to the next keyframe; may be changed at any time

    def __init__(self) -> None:
        self._number = -1
        self._T_world_anchor: se3.Transform | None = None

    def pose(self, T_world_camera: se3.Transform, timestamp_ns: int, **known: Any) -> TrackedPose:
        """Return the result of a localizer with (4, 4) `T_world_camera`, relative to the tracking keyframe.

        Args:
            known: `quality` and `motion` as in `TrackedPose`.
        """
        T = np.eye(4) if self._T_world_anchor is None else se3.inverse(self._T_world_anchor) @ T_world_camera
        moved = se3.distance(T) > self.distance or se3.angle(T) > _KEYFRAME_ANGLE
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
        """Start again: the next frame becomes a tracking keyframe. Keyframe numbers go on."""
        self._T_world_anchor = None


class KnownPoses(Localizer):
    """Base class of localizers that are given the poses."""

    absolute = True

    def __init__(self) -> None:
        self._anchors = TrackingKeyframes()

    def reset(self) -> None:
        """Start a new tracking keyframe. The world stays that of the poses."""
        self._anchors.reset()
