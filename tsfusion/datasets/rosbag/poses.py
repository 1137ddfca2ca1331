# SPDX-License-Identifier: MIT
"""Find the pose of a bag's sensor at a time, from transforms or a pose topic; find its accelerometer."""

import logging
from array import array
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, clock_parts
from tsfusion.datasets.rosbag.reader import Message, Stream, TopicMessages, frame_id, stamp_ns
from tsfusion.datasets.rosbag.topics import ChosenTopics, SensorOptions
from tsfusion.datasets.trajectory_files import twins
from tsfusion.geometry import se3
from tsfusion.geometry.inertial_sensors import Accelerometer, Gyroscope
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import PoseAt, Trajectory, rigid

IMU = "sensor_msgs/msg/Imu"
_NOT_MEASURED = -1.0  # as first covariance; see sensor_msgs/Imu.msg
_LEAST, _MOST = 8.0, 12.0  # m/s²: bounds of an accelerometer's median, near gravity
log = logging.getLogger(__name__)

TF = "tf2_msgs/msg/TFMessage"
OLD_TF = "tf/msg/tfMessage"
TF_TOPIC = "/tf"
PATH = "nav_msgs/msg/Path"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_HISTORY_NS = 5_000_000_000  # of poses that still come
POSE_KINDS = (ODOMETRY, TRANSFORM, POSE, POSE_WITH_COVARIANCE, PATH)  # in order of preference
_SAME = 1e-9  # metres, and quaternion components: the transform does not change


class PoseSamples:
    """Poses with their times, in 64 bytes each: a robot may send a thousand a second."""

    def __init__(self) -> None:
        self._stamps, self._values, self._twins_told = array("q"), array("d"), False

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: int, t: Any, q: Any) -> None:
        """Add a translation and a quaternion at a time, if they are finite and a rotation."""
        values = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
        length = float(np.linalg.norm(values[3:]))
        if np.isfinite(values).all() and 0.5 < length < 2:
            values[3:] /= length
            self._stamps.append(stamp)
            self._values.extend(values.tolist())

    def forget(self, before: int) -> None:
        """Drop the poses before a time that were added first."""
        gone = next((i for i, stamp in enumerate(self._stamps) if stamp >= before), max(len(self) - 1, 0))
        del self._stamps[:gone], self._values[: 7 * gone]

    def last(self) -> Trajectory:
        """Return the pose that was added last: a static transform is valid as last sent."""
        table: NDArray[np.float64] = np.array(self._values[-7:]).reshape(1, 7)
        return Trajectory(np.array(self._stamps[-1:], np.int64), table[:, :3], table[:, 3:])

    def trajectory(self, part: int | None = None, of: str = "") -> Trajectory:
        """Return the poses in the order of time; the first of equal times.

        Args:
            part: number of the part to take if their clock stepped back, from 1; None = all.
            of: name for the warning about different poses at one time.
        """
        own = slice(None) if part is None else clock_parts(self._stamps)[:part][-1]
        stamps = np.array(self._stamps[own], np.int64)
        table: NDArray[np.float64] = np.array(self._values).reshape(-1, 7)[own]
        order = np.argsort(stamps, kind="stable")
        if not self._twins_told and (words := twins(stamps[order], table[order])):
            self._twins_told = True
            log.warning("the recording has %s (%s); the first one is used", words, of)
        stamps, first = np.unique(stamps, return_index=True)
        return Trajectory(stamps, table[first, :3], table[first, 3:])


class _Edge(NamedTuple):
    parent: str
    trajectory: Trajectory
    is_constant: bool  # as far as it is known
    is_whole: bool  # no other transform will come

    def at(self, stamp: int, max_gap_ns: int) -> Transform | None:
        first, last = self.trajectory.timestamps_ns[[0, -1]]
        if self.is_constant and (self.is_whole or first <= stamp <= last):
            return rigid(self.trajectory.quaternions[0], self.trajectory.translations[0])
        return self.trajectory.at(stamp, max_gap_ns=max_gap_ns)


class TransformTree:
    """Tree of the frames in /tf and /tf_static, with each transform over time.

    A frame has one parent. If messages name several, it is the one named most often.

    Args:
        max_gap_ns: largest gap between two transforms for interpolation; a longer gap has no transform.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self._max_gap_ns = max_gap_ns
        self._samples: dict[tuple[str, str], PoseSamples] = defaultdict(PoseSamples)
        self._dynamic: set[tuple[str, str]] = set()
        self._edges: dict[str, _Edge] = {}

    def add(self, message: Any, log_ns: int, *, static: bool) -> None:
        """Add the transforms of a TFMessage that are finite.

        Args:
            log_ns: time of recording, used for transforms without a stamp.
        """
        for one in message.transforms:
            key = frame_id(one), str(one.child_frame_id).strip("/")
            if key[0] != key[1]:
                where = one.transform.translation, one.transform.rotation
                self._samples[key].add(stamp_ns(one) or log_ns, *where)
                if not static:
                    self._dynamic.add(key)

    def forget(self, before: int) -> None:
        """Drop the changing transforms before a time."""
        for key in self._dynamic:
            self._samples[key].forget(before)

    def finish(self, part: int | None, *, keep: bool = False) -> None:
        """Build the tree. `part` is as for `PoseSamples.trajectory`; `keep`: more will be added."""
        for (parent, child), samples in sorted(self._samples.items(), key=lambda item: len(item[1])):
            if not samples:
                continue
            is_static = (parent, child) not in self._dynamic
            trajectory = samples.last() if is_static else samples.trajectory(part, f"{child} in {parent}")
            rows = np.hstack([trajectory.translations, trajectory.quaternions])
            constant = is_static or bool((np.ptp(rows, axis=0) < _SAME).all())
            self._edges[child] = _Edge(parent, trajectory, constant, is_static or not keep)
        if not keep:
            self._samples.clear()

    def ancestors(self, frame: str) -> list[str]:
        """Return the frame itself, its parent, and so on to the root."""
        chain = [frame]
        while (edge := self._edges.get(chain[-1])) is not None and edge.parent not in chain:
            chain.append(edge.parent)
        return chain

    def described(self, frame: str) -> str:
        """Return text that names the frame and those above it, and says where transforms go in a loop."""
        chain = self.ancestors(frame)
        above = self._edges.get(chain[-1])
        return " ← ".join(chain) + (f" ← {above.parent}, a loop of transforms" if above else "")

    def moves(self, frame: str) -> bool:
        """Return True if a transform between the frame and its root changes."""
        return any(not self._edges[one].is_constant for one in self.ancestors(frame)[:-1])

    def is_dynamic(self, frame: str) -> bool:
        """Return True if a transform between the frame and its root came on /tf, not only on /tf_static."""
        chain = self.ancestors(frame)
        return any((parent, child) in self._dynamic for child, parent in pairwise(chain))

    def connected(self, one: str, other: str) -> bool:
        return self.ancestors(one)[-1] == self.ancestors(other)[-1]

    def at(self, target: str, source: str, stamp: int) -> Transform | None:
        """Return `T_target_source` at a time, or None if unknown."""
        if target == source:
            return np.eye(4)
        up_target, up_source = self.ancestors(target), self.ancestors(source)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            return None
        T_common_source = self._down(up_source[: up_source.index(common)], stamp)
        T_common_target = self._down(up_target[: up_target.index(common)], stamp)
        if T_common_source is None or T_common_target is None:
            return None
        return se3.inverse(T_common_target) @ T_common_source

    def _down(self, frames: list[str], stamp: int) -> Transform | None:
        """Return the first frame's pose in the last one's parent; each is the parent of the one before."""
        T: Transform = np.eye(4)
        for frame in frames:
            step = self._edges[frame].at(stamp, self._max_gap_ns)
            if step is None:
                return None
            T = step @ T
        return T


class TransformTrack(NamedTuple):
    """Poses of the frame `body` in the frame `world`, over time."""

    world: str
    body: str  # the frame with these poses; empty = not named by the topic
    trajectory: Trajectory


class PoseTopic:
    """Poses of one topic, collected message by message."""

    def __init__(self) -> None:
        self.world, self.body = "", ""  # frames named by the first message; empty body = not named
        self._samples, self._began = PoseSamples(), False

    def add(self, message: Any, kind: str, log_ns: int) -> None:
        """Add a message whose type is one of `POSE_KINDS`; `log_ns`: its time, if it has no stamp."""
        for one in message.poses if kind == PATH else [message]:
            if not self._began:
                self.world, self._began = frame_id(one), True
                self.body = str(getattr(one, "child_frame_id", "")).strip("/")
            if kind == TRANSFORM:
                where = one.transform.translation, one.transform.rotation
            else:
                pose = one.pose if kind in (POSE, PATH) else one.pose.pose
                where = pose.position, pose.orientation
            self._samples.add(stamp_ns(one) or log_ns, *where)

    def forget(self, before: int) -> None:
        self._samples.forget(before)

    def track(self, part: int | None) -> TransformTrack | None:
        """Return the poses so far, or None without any. `part` is as for `PoseSamples.trajectory`."""
        return (
            TransformTrack(
                self.world, self.body, self._samples.trajectory(part, f"{self.body} in {self.world}")
            )
            if self._samples
            else None
        )


def pose_streams(recording: TopicMessages, pose_topic: str | None) -> list[Stream]:
    """Return the streams of transforms, and the named topic of poses, or all topics of poses.

    Raises:
        DatasetError: the named topic holds no poses.
    """
    transforms = [one for one in recording.streams if one.kind in (TF, OLD_TF)]
    poses = [one for one in recording.streams if one.kind in POSE_KINDS]
    if pose_topic is None:
        return transforms + poses
    named = [one for one in poses if one.topic.strip("/") == pose_topic.strip("/")]
    if not named:
        raise DatasetError(
            f"{recording.path}: pose_topic={pose_topic!r} is no topic of poses; {recording.listing()}"
        )
    return transforms + named[:1]


class PoseFinder:
    """Find the sensor's pose at any time, from the pose messages of a recording or a running system.

    Args:
        chosen: the sensor's topics. Poses of a stereo pair are those of its rectified left camera.
        given: of its options, those about poses. A topic that the user names is preferred to transforms.
        live: True for poses that still come.

    Attributes:
        streams: those to `add`: transforms, poses and inertial values.
        way: of poses that still come: /tf or a topic, once it is chosen.
    """

    way = ""
    _root = ""  # of transforms that still come
    _so_far: PoseAt | None = None

    def __init__(
        self, recording: TopicMessages, chosen: ChosenTopics, given: SensorOptions, *, live: bool = False
    ) -> None:
        self.imu = ImuTopics(recording, chosen, live=live)
        self.streams = [*pose_streams(recording, given.pose_topic), *self.imu.streams]
        self._path, self._frame = recording.path, chosen.frame
        self._given, self._world = given, given.world_frame
        self._max_gap_ns = round(given.max_gap_s * 1e9)
        self._turned = None if chosen.pairs is None else chosen.pairs.T_left_rectified
        self._transforms = TransformTree(self._max_gap_ns)
        self._pose_topics: dict[Stream, PoseTopic] = {}
        self._told: set[str] = set()
        self._is_live = live

    def add(self, message: Message) -> None:
        if message.stream.kind == IMU:
            self.imu.add(message)
            return
        self._so_far = None
        if message.stream.kind in (TF, OLD_TF):
            is_static = message.stream.topic.endswith("static")
            self._transforms.add(message.content, message.location.log_ns, static=is_static)
        else:
            if message.stream.kind == PATH or message.stream not in self._pose_topics:
                self._pose_topics[message.stream] = PoseTopic()  # each path message holds all earlier poses
            log_ns = message.location.log_ns
            self._pose_topics[message.stream].add(message.content, message.stream.kind, log_ns)

    def finish(self, *, required: bool, part: int | None = None) -> PoseAt:
        """Return a function from a frame's nanoseconds to `T_world_sensor`, or None if the pose is unknown.

        Args:
            part: number of the part of the poses to use if their clock stepped back, from 1; None = all.

        Raises:
            DatasetError: there are no poses but they are `required`, or no transforms connect the named
                frames.
        """
        self._transforms.finish(part)
        if not self._given.pose_topic and self._transforms.moves(self._frame):
            return self._of_frames(self._by_transforms())
        found = self._track(part)
        if found is not None:
            return self._of_frames(self._by_track(found))
        if self._transforms.is_dynamic(self._frame):
            return self._of_frames(self._by_transforms())
        if required:
            raise DatasetError(
                f"{self._path} has no poses of {self._frame!r}: no changing transform and no topic of "
                f"poses leads to it; {SCAN}"
            )
        return lambda _stamp: None

    def at(self, stamp_ns: int) -> Transform | None:
        """Return `T_world_sensor` at a frame's time, of poses that still come; None = not known, or not yet.

        Raises:
            DatasetError: several topics hold poses.
        """
        if self._so_far is None:
            self._so_far = self._of_frames(self._choose_so_far(stamp_ns - _HISTORY_NS))
        return self._so_far(stamp_ns)

    def _choose_so_far(self, forget_before: int) -> PoseAt:
        """Return what `finish` returns. What is chosen first stays; older poses are dropped.

        Transforms are chosen also while the robot stands, unless their root is the body of a topic of poses.
        """
        self._transforms.forget(forget_before)
        for topic in self._pose_topics.values():
            topic.forget(forget_before)
        self._transforms.finish(None, keep=True)
        if not self.way and not self._given.pose_topic and self._transforms.is_dynamic(self._frame):
            root = self._transforms.ancestors(self._frame)[-1]
            bodies = {topic.body for topic in self._pose_topics.values()}
            if root not in bodies or self._transforms.moves(self._frame):
                self.way = TF_TOPIC
        if self.way == TF_TOPIC:
            return self._by_kept_world()
        found = self._track(None)
        return (lambda _stamp: None) if found is None else self._by_track(found)

    def between(self, target: str, source: str, stamp: int) -> Transform | None:
        """Return `T_target_source` at a time from /tf and /tf_static, or None. Call it after `finish`."""
        if self._is_live:
            with suppress(DatasetError):  # of poses
                self.at(stamp)
        return self._transforms.at(target, source, stamp)

    def _of_frames(self, at: PoseAt) -> PoseAt:
        """Return poses at frames' times, of a pair's rectified camera."""
        offset_ns = round(self._given.time_offset_s * 1e9)

        def posed(stamp_ns: int) -> Transform | None:
            T = at(stamp_ns + offset_ns)
            return T if T is None or self._turned is None else T @ self._turned

        return posed

    def _by_transforms(self) -> PoseAt:
        world = self._transforms.ancestors(self._frame)[-1] if self._world is None else self._world
        if not self._transforms.connected(world, self._frame):
            ways = self._transforms.described(self._frame)
            raise DatasetError(f"{self._path}: no transforms lead from {world!r} to {self._frame!r} ({ways})")
        return lambda stamp: self._transforms.at(world, self._frame, stamp)

    def _by_kept_world(self) -> PoseAt:
        """Return poses in the world frame of the first pose, though another may come above it later."""
        chain = self._transforms.ancestors(self._frame)
        world = self._world or chain[-1]
        if self._root and self._root != chain[-1]:
            self._tell_once(
                f"{chain[-1]!r} now leads to {world!r}, in which poses stay (world_frame={chain[-1]} from "
                "the start takes the other)"
            )
        if not self._transforms.connected(world, self._frame):
            ways = self._transforms.described(self._frame)
            self._tell_once(f"no transforms lead from {world!r} to {self._frame!r} ({ways}): no poses yet")
            return lambda _stamp: None

        def at(stamp: int) -> Transform | None:
            T = self._transforms.at(world, self._frame, stamp)
            if T is not None and self._world is None:
                self._root = self._world = world
            return T

        return at

    def _tell_once(self, words: str) -> None:
        if words not in self._told:
            self._told.add(words)
            log.warning("%s: %s", self._path, words)

    def _track(self, part: int | None) -> TransformTrack | None:
        """Return the poses from the first kind of message in `POSE_KINDS` that leads to the sensor."""
        for kind in POSE_KINDS:
            tracks = {
                stream.topic: found
                for stream, topic in self._pose_topics.items()
                if stream.kind == kind
                and self.way in ("", stream.topic)
                and (found := topic.track(part)) is not None
            }
            fitting = {topic: one for topic, one in tracks.items() if self._leads(one)}
            if len(fitting) == 1:
                self.way, found = next(iter(fitting.items()))
                return found
            if fitting:
                raise DatasetError(
                    f"{self._path}: several topics hold poses ({', '.join(sorted(fitting))}); choose with "
                    "pose_topic"
                )
            if tracks and self._given.pose_topic:
                body = next(iter(tracks.values())).body
                raise DatasetError(
                    f"{self._path}: {next(iter(tracks))} holds poses of {body!r}, and no transforms lead "
                    f"from there to {self._frame!r}; body_frame={self._frame!r} takes them for the sensor's"
                )
        return None

    def _leads(self, found: TransformTrack) -> bool:
        body = self._given.body_frame or found.body
        return body in ("", self._frame) or self._transforms.connected(body, self._frame)

    def _by_track(self, found: TransformTrack) -> PoseAt:
        body = self._given.body_frame or found.body or self._frame
        world = self._world or found.world

        def at(stamp: int) -> Transform | None:
            T = found.trajectory.at(stamp, max_gap_ns=self._max_gap_ns)
            T_body_sensor = self._transforms.at(body, self._frame, stamp)
            T_world = np.eye(4) if world == found.world else self._transforms.at(world, found.world, stamp)
            if T is None or T_body_sensor is None or T_world is None:
                return None
            posed: Transform = T_world @ T @ T_body_sensor
            return posed

        return at


class ImuTopics:
    """Accelerometers and gyroscopes of every topic of IMU messages; live ones are filled at each message."""

    def __init__(self, recording: TopicMessages, chosen: ChosenTopics, *, live: bool = False) -> None:
        self.streams = [one for one in recording.streams if one.kind == IMU]
        self._frame, self._live = chosen.frame, live
        self._turned = np.eye(3) if chosen.pairs is None else chosen.pairs.T_left_rectified[:3, :3].T
        self._sensors: dict[Stream, tuple[str, Accelerometer, Gyroscope]] = {}  # with their frame
        self._kept: dict[Stream, tuple[array[int], array[float]]] = {}  # times and values not yet in them

    def add(self, message: Message) -> None:
        content, stamp = message.content, stamp_ns(message.content)
        if message.stream not in self._sensors:
            new = Accelerometer(live=self._live), Gyroscope(live=self._live)
            self._sensors[message.stream] = frame_id(content), *new
            self._kept[message.stream] = array("q"), array("d")
        stamps, values = self._kept[message.stream]
        stamps.append(stamp)
        for name in ("linear_acceleration", "angular_velocity"):
            found, covariance = getattr(content, name), getattr(content, f"{name}_covariance")
            values.extend((np.nan,) * 3 if covariance[0] == _NOT_MEASURED else (found.x, found.y, found.z))
        if self._live:
            self._fill(message.stream)

    def _fill(self, stream: Stream, part: int | None = None) -> None:
        """Add the values of a topic to its sensors. `part` is as for `PoseSamples.trajectory`."""
        (_, accelerometer, gyroscope), (stamps, values) = self._sensors[stream], self._kept[stream]
        own = slice(None) if part is None else clock_parts(stamps)[:part][-1]
        for stamp, row in zip(stamps[own], np.reshape(values, (-1, 6))[own].tolist(), strict=True):
            accelerometer.add(stamp, row[:3])
            gyroscope.add(stamp, row[3:])
        self._kept[stream] = array("q"), array("d")

    def sensors(
        self, between: Callable[[str, str], Transform | None], part: int | None = None
    ) -> tuple[Accelerometer, Gyroscope]:
        """Return the first accelerometer that measures gravity, and the first gyroscope that turns.

        Args:
            between: returns T_target_source of two frames, or None; sensors in unknown frames are left out.
            part: number of the part of a recording, as for `PoseSamples.trajectory`.
        """
        known = []
        for stream in () if self._live else self._kept:
            self._fill(stream, part)
        for frame, accelerometer, gyroscope in self._sensors.values():
            if (T := between(self._frame, frame)) is not None:
                accelerometer.R_sensor_imu = gyroscope.R_sensor_imu = self._turned @ T[:3, :3]
                known.append((accelerometer, gyroscope))
        return (
            next((one for one, _ in known if _LEAST < one.median_length() < _MOST), Accelerometer()),
            next((one for _, one in known if one.median_length() > 0), Gyroscope()),
        )
