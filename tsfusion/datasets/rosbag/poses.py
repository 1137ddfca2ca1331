# SPDX-License-Identifier: MIT
"""The pose of a recording's sensor at a time, from transforms or a topic of poses; its accelerometer."""

from array import array
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, Accelerometer
from tsfusion.datasets.rosbag.reader import BagRecording, Message, Stream, frame_id, stamp_ns
from tsfusion.datasets.rosbag.transforms import (
    OLD_TF,
    PATH,
    POSE_KINDS,
    TF,
    PoseTopic,
    TransformTrack,
    TransformTree,
)
from tsfusion.geometry.se3 import Transform

IMU = "sensor_msgs/msg/Imu"
_NOT_MEASURED = -1.0  # as first covariance: sensor_msgs/Imu.msg
_LEAST, _MOST = 8.0, 12.0  # m/s²: the median length of what an accelerometer at rest measures


def pose_streams(recording: BagRecording, pose_topic: str | None) -> list[Stream]:
    """The streams of transforms, and the named topic of poses, or all such topics.

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
    """The sensor's pose at any time, by the pose messages of a recording.

    Args:
        frame: name of the sensor's frame.
        streams: those of `pose_streams`.
        topic_named: the user named the topic of poses: it is preferred to the transforms.
    """

    def __init__(
        self,
        path: Path,
        frame: str,
        streams: list[Stream],
        *,
        topic_named: bool,
        world_frame: str | None,
        body_frame: str | None,
        max_gap_s: float,
    ) -> None:
        self.streams = streams
        self._path, self._frame, self._topic_named = path, frame, topic_named
        self._world, self._body = world_frame, body_frame
        self._max_gap_ns = round(max_gap_s * 1e9)
        self._transforms = TransformTree(self._max_gap_ns)
        self._pose_topics: dict[Stream, PoseTopic] = {}

    def add(self, message: Message) -> None:
        """Take a message of one of `streams` into account."""
        if message.stream.kind in (TF, OLD_TF):
            is_static = message.stream.topic.endswith("static")
            self._transforms.add(message.content, message.location.log_ns, static=is_static)
        else:
            if message.stream.kind == PATH or message.stream not in self._pose_topics:
                self._pose_topics[message.stream] = PoseTopic()  # each path holds all that were before
            self._pose_topics[message.stream].add(message.content, message.stream.kind)

    def finish(self, *, required: bool, part: int | None = None) -> Callable[[int], Transform | None]:
        """A function from nanoseconds to `T_world_sensor`, None where the pose is not known.

        Args:
            part: number of the part that counts of poses whose clock stepped back, from 1; None = all.

        Raises:
            DatasetError: `required` and there are no poses; or no transforms connect the named frames.
        """
        self._transforms.finish(part)
        if not self._topic_named and self._transforms.moves(self._frame):
            return self._by_transforms()
        found = self._track(part)
        if found is not None:
            return self._by_track(found)
        if self._transforms.is_dynamic(self._frame):
            return self._by_transforms()
        if required:
            raise DatasetError(
                f"{self._path} has no poses of {self._frame!r}: no changing transform and no topic of "
                f"poses leads to it; {SCAN}"
            )
        return lambda _stamp: None

    def between(self, target: str, source: str, stamp: int) -> Transform | None:
        """`T_target_source` at a time by the transforms, after `finish`; None where it is not known."""
        return self._transforms.at(target, source, stamp)

    def _by_transforms(self) -> Callable[[int], Transform | None]:
        world = self._transforms.ancestors(self._frame)[-1] if self._world is None else self._world
        if not self._transforms.connected(world, self._frame):
            chain = " ← ".join(self._transforms.ancestors(self._frame))
            raise DatasetError(
                f"{self._path}: no transforms lead from {world!r} to {self._frame!r} ({chain})"
            )
        return lambda stamp: self._transforms.at(world, self._frame, stamp)

    def _track(self, part: int | None) -> TransformTrack | None:
        """The poses of the first kind in `POSE_KINDS` that leads to the sensor."""
        for kind in POSE_KINDS:
            tracks = {
                stream.topic: found
                for stream, topic in self._pose_topics.items()
                if stream.kind == kind and (found := topic.track(part)) is not None
            }
            fitting = {topic: one for topic, one in tracks.items() if self._leads(one)}
            if len(fitting) == 1:
                return next(iter(fitting.values()))
            if fitting:
                raise DatasetError(
                    f"{self._path}: several topics hold poses ({', '.join(fitting)}); choose with pose_topic"
                )
            if tracks and self._topic_named:
                body = next(iter(tracks.values())).body
                raise DatasetError(
                    f"{self._path}: {next(iter(tracks))} holds poses of {body!r}, and no transforms lead "
                    f"from there to {self._frame!r}; body_frame={self._frame!r} takes them for the sensor's"
                )
        return None

    def _leads(self, found: TransformTrack) -> bool:
        body = self._body or found.body
        return body in ("", self._frame) or self._transforms.connected(body, self._frame)

    def _by_track(self, found: TransformTrack) -> Callable[[int], Transform | None]:
        body = self._body or found.body or self._frame
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
    """Linear accelerations of every topic of IMU messages, collected message by message."""

    def __init__(self, recording: BagRecording) -> None:
        self.streams = [one for one in recording.streams if one.kind == IMU]
        self._frames: dict[Stream, str] = {}
        self._stamps: defaultdict[Stream, array[int]] = defaultdict(lambda: array("q"))
        self._forces: defaultdict[Stream, array[float]] = defaultdict(lambda: array("d"))

    def add(self, message: Message) -> None:
        """Take a message of one of `streams` into account."""
        content, stream = message.content, message.stream
        if content.linear_acceleration_covariance[0] == _NOT_MEASURED:
            return
        self._frames.setdefault(stream, frame_id(content))
        force = content.linear_acceleration
        self._stamps[stream].append(stamp_ns(content))
        self._forces[stream].extend((force.x, force.y, force.z))

    def accelerometer(self, leads: Callable[[str], Transform | None]) -> Accelerometer | None:
        """The first topic that measures gravity, and whose frame's place is known.

        Args:
            leads: gives the transform from a frame to the camera or LiDAR; None = not known.
        """
        for stream, stamps in self._stamps.items():
            forces = np.array(self._forces[stream]).reshape(-1, 3)
            T_sensor_imu = leads(self._frames[stream])
            if T_sensor_imu is not None and _LEAST < np.median(np.linalg.norm(forces, axis=1)) < _MOST:
                return Accelerometer(stamps, forces, T_sensor_imu[:3, :3])
        return None
