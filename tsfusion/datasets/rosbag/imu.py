# SPDX-License-Identifier: MIT
"""Accelerometers of ROS recordings: topics of sensor_msgs/Imu."""

from array import array
from collections import defaultdict
from collections.abc import Callable

import numpy as np

from tsfusion.datasets.accelerometer import Accelerometer
from tsfusion.datasets.rosbag.reader import BagRecording, Message, Stream, frame_id, stamp_ns
from tsfusion.geometry.se3 import Transform

IMU = "sensor_msgs/msg/Imu"
_NOT_MEASURED = -1.0  # as first covariance: sensor_msgs/Imu.msg
_LEAST, _MOST = 8.0, 12.0  # m/s²: the median length of what an accelerometer at rest measures


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
