# SPDX-License-Identifier: MIT
"""Localizer that receives poses from another process, such as a SLAM program, over a ZeroMQ socket.

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

Unknown keys are ignored. contrib/pose_sender.py is an example of a sender.
"""

import logging
import re
import time
import weakref
from array import array
from bisect import bisect_left, bisect_right
from collections import Counter
from functools import partial
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct

from tsfusion.core.errors import DecodeError, InvalidConfig, InvalidKeyframe, TransportError
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import check_pose
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.sweeps import motion_about
from tsfusion.geometry.trajectory import Trajectory, quaternion, rigid
from tsfusion.scanner.localization.localizer import KnownPoses, Lost, PoseCorrections, TrackedPose
from tsfusion.wire.sockets import sockets

log = logging.getLogger(__name__)

WAIT = 0.1  # seconds to wait for a pose; also in docs/localization.md
MAX_RECEIVE = 0.1  # seconds spent on messages for one frame: a flood must not block it
RECONNECT_AFTER = 5.0  # seconds of silence; libzmq does not reconnect in all cases
ANOTHER_CLOCK = 3600.0  # seconds between pose and frame that mean another clock
MAX_REASONS = 20  # that are counted separately
_NS = 1_000_000_000  # nanoseconds a second
_NUMBERS = 7  # translation and quaternion of a pose; all NaN for a loss of the sender
MAX_BYTES = 1 << 20  # for a message: it holds corrections of 5,000 poses in JSON, 15,000 in MessagePack
MAX_DISTANCE = 1e7  # metres from the origin
Stamp = Annotated[int, Meta(ge=1, le=2**63 - 1)]
PoseNumbers = Annotated[list[float], Meta(min_length=7, max_length=16)]


class PoseFeed(KnownPoses):
    """`Localizer` that receives poses on a ZeroMQ SUB socket and interpolates them at the frame's timestamp.

    Malformed messages are counted and dropped. Corrections are interpolated from their timestamps to the
    tracking keyframes.

    Args:
        address: `tcp://host:port` of a bound PUB socket, to connect to; or `@tcp://127.0.0.1:port` to bind a
            socket here, for senders that connect. It has no keys, so only local addresses can be bound.
        max_gap_s: most seconds between two poses; longer gaps have no pose.
        time_offset_s: seconds to add to a frame's stamp before its pose is looked up.
        wait_s: seconds that a frame waits for the pose after it.

    Raises:
        InvalidConfig: the address is malformed, or open to other machines.
        TransportError: the address cannot be bound.
    """

    def __init__(
        self, address: str, *, max_gap_s: float, time_offset_s: float = 0.0, wait_s: float = WAIT
    ) -> None:
        super().__init__()
        self.received = 0  # number of valid messages
        self.dropped: Counter[str] = Counter()  # number of malformed messages, by reason
        self._max_gap_ns, self._offset_ns = round(max_gap_s * _NS), round(time_offset_s * _NS)
        self._wait = wait_s
        self._socket = _FeedSocket(address)
        self._closing = weakref.finalize(self, self._socket.close)
        self._history = PoseHistory()
        self._deformation = MapDeformation()

    @property
    def address(self) -> str:
        """Address that the socket is connected to, or bound to with the real port."""
        return self._socket.endpoint

    def close(self) -> None:
        self._closing()

    def __enter__(self) -> "PoseFeed":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Interpolate the feed's poses at the frame's timestamp. Wait up to `wait_s` for the next pose.

        A frame with point times waits for the pose after its last point.
        """
        if not frame.timestamp_ns:
            return Lost(reason="the frame has no time, so that no pose can be looked up", timestamp_ns=0)
        stamp, times = frame.timestamp_ns + self._offset_ns, frame.point_times_s
        last = stamp if times is None else stamp + max(0, round(float(times.max()) * _NS))
        deadline = time.monotonic() + self._wait
        self._receive(0)
        while not self._history.decided(last, max_gap_ns=self._max_gap_ns):
            left = deadline - time.monotonic()
            if left <= 0:
                break
            self._receive(left)
        at = partial(self._history.at, max_gap_ns=self._max_gap_ns)
        T = at(stamp)
        if T is None:
            return Lost(reason=self._missing(stamp), timestamp_ns=frame.timestamp_ns)
        pose = self._anchors.pose(T, frame.timestamp_ns, motion=motion_about(at, stamp, times))
        if pose.starts_anchor:
            self._deformation.add(pose.anchor, stamp, T)
        return pose

    def corrections(self) -> PoseCorrections | None:
        """Return the sender's corrections that are new since the last call, or None."""
        return self._deformation.new_corrections()

    def reset(self) -> None:
        """Forget the tracking keyframes. The world stays that of the sender."""
        super().reset()
        self._deformation.reset()

    def _receive(self, seconds: float) -> None:
        """Process all messages that arrived. Wait at most `seconds` for the first one."""
        parts = self._socket.receive(seconds)
        enough = time.monotonic() + MAX_RECEIVE
        while parts is not None:
            self._process(parts)
            if time.monotonic() > enough:
                return
            parts = self._socket.receive(0)

    def _process(self, parts: list[bytes]) -> None:
        try:
            if len(parts) != 1:
                raise DecodeError(f"a message has 1 frame, got {len(parts)}")
            message = decode(parts[0])
        except DecodeError as error:
            self._drop(str(error))
            return
        self.received += 1
        if message.stamp_ns is not None:
            self._history.add(message.stamp_ns, message.pose)
        if message.corrections is not None:
            unknown = self._deformation.apply(message.corrections, self._history, self._max_gap_ns)
            if unknown:
                log.warning("%d corrected poses are of moments that no pose was sent of", unknown)

    def _drop(self, reason: str) -> None:
        kind = re.split(r",| \(| - ", reason)[0]
        self.dropped[kind if kind in self.dropped or len(self.dropped) < MAX_REASONS else "others"] += 1
        if self.dropped.total() == 1:
            log.warning("a message from %s is no pose and was dropped: %s", self.address, reason)

    def _missing(self, stamp: int) -> str:
        where = f"from {self.address}"
        if not len(self._history):
            if self._socket.binds:
                return f"no pose has come yet to @{self.address}, where it listens: senders connect to it"
            return f"no pose has come {where} yet"
        away = (stamp - self._history.last_ns) / _NS
        if abs(away) > ANOTHER_CLOCK:
            return (
                f"the last pose {where} is {abs(away):.0f} s away from the frame: are these the same clock?"
            )
        if away > 0:
            return (
                f"the pose comes too late or not at all: the newest {where} is {away:.3f} s older than the "
                f"frame, after {self._wait:g} s of waiting"
            )
        return f"{where}, there is no pose within {self._max_gap_ns / _NS:g} s on both sides of the frame"


class _FeedSocket:
    """SUB socket that is opened again after a silence."""

    def __init__(self, address: str) -> None:
        self.binds = address.startswith("@")
        plain = address.removeprefix("@")
        if self.binds:
            sockets.check_own_machine(plain)
        self._target = plain if self.binds else sockets.connect_address(plain)
        self._context = sockets.open_context()
        self._socket = sockets.pose_feed(self._context, MAX_BYTES)
        self.endpoint = self._target
        try:
            self._open()
        except (InvalidConfig, TransportError):
            self.close()
            raise

    def receive(self, seconds: float) -> list[bytes] | None:
        """Return the frames of the next message, or None if none comes in time."""
        if self._socket.poll(round(seconds * 1000)):
            self._last_received = time.monotonic()
            return self._socket.recv_multipart()
        if not self.binds and time.monotonic() - self._last_received > RECONNECT_AFTER:
            self._socket.close()
            self._socket = sockets.pose_feed(self._context, MAX_BYTES)
            self._open()
        return None

    def close(self) -> None:
        self._context.destroy(linger=0)

    def _open(self) -> None:
        self._last_received = time.monotonic()
        if self.binds:
            self.endpoint = sockets.bind_socket(self._socket, self._target)
        else:
            sockets.connect(self._socket, self._target)


class PoseHistory:
    """Poses and losses of the sender, sorted by timestamp: the newest `limit`, 64 bytes each."""

    def __init__(self, limit: int = 100_000) -> None:
        self._limit = limit
        self._stamps = array("q")
        self._numbers = array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def last_ns(self) -> int:
        """Latest timestamp. The history must not be empty."""
        return self._stamps[-1]

    def add(self, stamp_ns: int, T: Transform | None) -> None:
        """Add a pose, or None for a loss. It replaces an entry with the same timestamp."""
        row = array("d", [np.nan] * _NUMBERS if T is None else [*T[:3, 3], *quaternion(T[:3, :3])])
        at = bisect_left(self._stamps, stamp_ns)
        if at < len(self) and self._stamps[at] == stamp_ns:
            self._numbers[_NUMBERS * at : _NUMBERS * (at + 1)] = row
            return
        self._stamps.insert(at, stamp_ns)
        self._numbers[_NUMBERS * at : _NUMBERS * at] = row
        if len(self) > self._limit:
            oldest = self._limit // 10 or 1
            del self._stamps[:oldest], self._numbers[: _NUMBERS * oldest]

    def at(self, stamp_ns: int, *, max_gap_ns: int) -> Transform | None:
        """Return the pose at a time, interpolated as by `Trajectory.at`, or None if it is unknown."""
        right = bisect_left(self._stamps, stamp_ns)
        neighbours = [k for k in (right - 1, right) if 0 <= k < len(self)]
        rows = np.array([self._numbers[_NUMBERS * k : _NUMBERS * (k + 1)] for k in neighbours])
        known = [not np.isnan(row).any() for row in rows]
        if not any(known):
            return None
        stamps = np.array([self._stamps[k] for k in neighbours], dtype=np.int64)
        return Trajectory(stamps[known], rows[known, :3], rows[known, 3:]).at(stamp_ns, max_gap_ns=max_gap_ns)

    def decided(self, stamp_ns: int, *, max_gap_ns: int) -> bool:
        """Return True if later messages cannot change the pose: an entry is at the time or soon after it."""
        right = bisect_left(self._stamps, stamp_ns)
        return right < len(self) and self._stamps[right] - stamp_ns <= max_gap_ns


class MapDeformation:
    """Motion of odometry's world by corrected poses, as a function of time.

    At each corrected timestamp, the motion is the corrected pose times the inverse of the pose sent before.
    Between two timestamps it is interpolated. Before the first and after the last timestamp it is constant.
    """

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._moves: list[se3.Transform] = []
        self._T_corrected_world = np.eye(4)
        self._loops = 0
        self._is_new = False
        self._anchors: dict[int, tuple[int, se3.Transform]] = {}

    def add(self, anchor: int, stamp_ns: int, T_world_camera: se3.Transform) -> None:
        self._anchors[anchor] = stamp_ns, T_world_camera

    def apply(self, corrected: "FeedCorrections", history: PoseHistory, max_gap_ns: int) -> int:
        """Apply new corrections. Return the number of their timestamps without a known pose."""
        before = [history.at(stamp, max_gap_ns=max_gap_ns) for stamp in corrected.stamps_ns]
        known = [
            (stamp, after @ se3.inverse(T))
            for stamp, after, T in zip(corrected.stamps_ns, corrected.poses, before, strict=True)
            if T is not None
        ]
        unknown = len(corrected.stamps_ns) - len(known)
        if known or corrected.T_corrected_world is not None:
            self._stamps, self._moves = [stamp for stamp, _ in known], [move for _, move in known]
            last = self._moves[-1] if known else np.eye(4)
            self._T_corrected_world = (
                last if corrected.T_corrected_world is None else corrected.T_corrected_world
            )
            self._loops, self._is_new = corrected.loops, True
        return unknown

    def new_corrections(self) -> PoseCorrections | None:
        """Return corrected poses of all tracking keyframes since `reset`, or None without new corrections."""
        if not self._is_new:
            return None
        self._is_new = False
        return PoseCorrections(
            anchors={
                number: se3.nearest(self._move(stamp) @ T) for number, (stamp, T) in self._anchors.items()
            },
            T_corrected_world=self._T_corrected_world,
            loops=self._loops,
        )

    def reset(self) -> None:
        """Forget the tracking keyframes, but not the corrections."""
        self._anchors.clear()

    def _move(self, stamp_ns: int) -> se3.Transform:
        if not self._moves:
            return self._T_corrected_world
        right = bisect_right(self._stamps, stamp_ns)
        if right == len(self._stamps):
            return self._T_corrected_world if stamp_ns > self._stamps[-1] else self._moves[-1]
        if right == 0:
            return self._moves[0]
        begin, end = self._stamps[right - 1], self._stamps[right]
        share = (stamp_ns - begin) / (end - begin)
        step = se3.log(self._moves[right] @ se3.inverse(self._moves[right - 1]))
        return se3.exp(share * step) @ self._moves[right - 1]


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
