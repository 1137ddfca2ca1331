# SPDX-License-Identifier: MIT
"""Define and decode the messages of a pose feed.

A message is one ZeroMQ frame. It holds a map, in JSON or MessagePack, with the keys:

- `stamp_ns`: integer, by the clock that stamps the frames.
- `pose`: `[tx, ty, tz, qx, qy, qz, qw]`, or the 16 numbers of T_world_camera row by row. It is the pose of
  the sensor that makes the frames, with OpenCV axes (a LiDAR: its own). Poses are odometry: they must not
  jump when a loop is closed.
- `lost`: true instead of a pose: the sender does not know the pose.
- `corrections`: result of loop closure, alone or beside a pose. The newest replaces all others. It is a map
  of `stamps_ns`, timestamps of poses sent before; `poses`, the corrected poses for them; `loops`, the number
  of loops closed so far (optional); and `T_corrected_world`, in the form of a pose, which moves odometry
  poses from now on (optional; RTAB-Map's map_to_odom).

Unknown keys are ignored.
"""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct

from tsfusion.core.errors import DecodeError, InvalidKeyframe
from tsfusion.geometry.keyframe import check_pose
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import rigid

MAX_BYTES = 1 << 20  # for a message: it holds corrections of 5,000 poses in JSON, 15,000 in MessagePack
MAX_DISTANCE = 1e7  # metres from the origin

Stamp = Annotated[int, Meta(ge=1, le=2**63 - 1)]
PoseNumbers = Annotated[list[float], Meta(min_length=7, max_length=16)]


class _RawCorrections(Struct):
    stamps_ns: list[Stamp]
    poses: list[PoseNumbers]
    T_corrected_world: PoseNumbers | None = None
    loops: Annotated[int, Meta(ge=0, le=2**31)] = 0


class _RawMessage(Struct):
    stamp_ns: Stamp | None = None
    pose: PoseNumbers | None = None
    lost: bool = False
    corrections: _RawCorrections | None = None


class FeedCorrections(Struct, frozen=True, kw_only=True):
    """Corrected poses in order of their timestamps."""

    stamps_ns: list[int]
    poses: list[Transform]
    T_corrected_world: Transform | None
    loops: int


class FeedMessage(Struct, frozen=True, kw_only=True):
    """One message. A message with a timestamp but without a pose means that the sender is lost."""

    stamp_ns: int | None
    pose: Transform | None
    corrections: FeedCorrections | None


_json = msgspec.json.Decoder(_RawMessage)
_msgpack = msgspec.msgpack.Decoder(_RawMessage)


def decode(message: bytes) -> FeedMessage:
    """Decode a message in JSON or MessagePack.

    Raises:
        DecodeError: the message has another form than described above.
    """
    try:
        # A map never begins with `{` in MessagePack.
        raw = (_json if message.lstrip()[:1] == b"{" else _msgpack).decode(message)
        if raw.stamp_ns is None and (raw.pose is not None or raw.lost):
            raise DecodeError("stamp_ns is missing")
        if raw.stamp_ns is None and raw.corrections is None:
            raise DecodeError("neither a pose nor corrections")
        if raw.stamp_ns is not None and (raw.pose is None) != raw.lost:
            raise DecodeError("either a pose or lost must be given with a stamp")
        pose = None if raw.pose is None else _matrix(raw.pose)
        corrections = None if raw.corrections is None else _corrections(raw.corrections)
    except (msgspec.DecodeError, UnicodeDecodeError, InvalidKeyframe, RecursionError) as error:
        raise DecodeError(str(error)) from error
    return FeedMessage(stamp_ns=raw.stamp_ns, pose=pose, corrections=corrections)


def _corrections(raw: _RawCorrections) -> FeedCorrections:
    if len(raw.stamps_ns) != len(raw.poses):
        raise DecodeError(f"{len(raw.stamps_ns)} stamps with {len(raw.poses)} corrected poses")
    by_stamp = dict(
        sorted(zip(raw.stamps_ns, map(_matrix, raw.poses), strict=True), key=lambda item: item[0])
    )
    T = None if raw.T_corrected_world is None else _matrix(raw.T_corrected_world)
    return FeedCorrections(
        stamps_ns=[*by_stamp], poses=[*by_stamp.values()], T_corrected_world=T, loops=raw.loops
    )


def _matrix(numbers: list[float]) -> Transform:
    """Convert 7 or 16 numbers to a (4, 4) pose. Raises DecodeError or InvalidKeyframe."""
    values = np.array(numbers, dtype=np.float64)
    if len(values) == 16:
        T = values.reshape(4, 4)
    elif len(values) == 7:
        norm = float(np.linalg.norm(values[3:]))
        if not abs(norm - 1) <= 0.01:
            raise DecodeError(f"the quaternion must have length 1, got {norm:.4g}")
        T = rigid(values[3:] / norm, values[:3])
    else:
        raise DecodeError(f"a pose has 7 or 16 numbers, got {len(values)}")
    if not np.abs(T).max() <= MAX_DISTANCE:
        raise DecodeError(f"a pose must lie within {MAX_DISTANCE:g} m")
    return check_pose(T)
