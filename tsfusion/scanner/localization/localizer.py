# SPDX-License-Identifier: MIT
"""What a localizer is, and what it says of a frame."""

from dataclasses import dataclass
from typing import Protocol

from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform


@dataclass(frozen=True, eq=False, kw_only=True)
class Pose:
    """Where the sensor was at one frame.

    Attributes:
        T_world_camera: (4, 4) float64; the world is the first frame's camera since the start or the last
            `reset`, or the given trajectory's. Always the odometry's own: corrections never make it jump.
        timestamp_ns: of the frame.
        anchor: number of the tracking keyframe it hangs on, growing, never used twice, also after `reset`.
        T_anchor_camera: (4, 4); the corrected pose is the corrected anchor times this.
        starts_anchor: whether this frame is that tracking keyframe.
        quality: 0 to 1, the share of what was compared that agrees; 1 where poses are given.
    """

    T_world_camera: Transform
    timestamp_ns: int
    anchor: int
    T_anchor_camera: Transform
    starts_anchor: bool = False
    quality: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Lost:
    """The frame has no pose. Nothing of it may be fused.

    Attributes:
        reason: for a person, such as `12 of 300 points agree`.
        timestamp_ns: of the frame.
    """

    reason: str
    timestamp_ns: int


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseCorrections:
    """What loop closure found out about poses given before. The newest revision replaces all others.

    Attributes:
        revision: counts up from 1 since the last `reset`.
        anchors: tracking keyframe → its corrected (4, 4) T_world_camera; every one since the last `reset`.
        T_corrected_world: (4, 4); odometry poses after the last anchor, times this from the left.
        loops: loops closed so far.
    """

    revision: int
    anchors: dict[int, Transform]
    T_corrected_world: Transform
    loops: int


class Localizer(Protocol):
    """Follows a sensor. Frames come in time order, from one thread.

    One that holds a socket has `close()`, too.

    Attributes:
        absolute: whether its world outlasts `reset`: poses from elsewhere are in one world, however often
            there is none.
    """

    absolute: bool

    def track(self, frame: Frame) -> Pose | Lost:
        """Where the sensor was; Lost when that is not known (then try the next frame, or `reset`).

        Raises:
            InvalidKeyframe: when the frame lacks what this localizer needs (colour, depth, a stereo pair).
        """

    def corrections(self) -> PoseCorrections | None:
        """What is new since the last call; None = nothing."""

    def reset(self) -> None:
        """Forget the world: the next pose begins a new one, that has nothing to do with the old."""
