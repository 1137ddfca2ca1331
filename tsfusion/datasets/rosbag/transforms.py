# SPDX-License-Identifier: MIT
"""Poses of frames over time: the tree of ROS transforms, and topics of poses."""

import logging
from array import array
from collections import defaultdict
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.dataset import clock_parts
from tsfusion.datasets.rosbag.reader import frame_id, stamp_ns
from tsfusion.datasets.trajectory_files import twins
from tsfusion.geometry import se3
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import Trajectory, rigid

log = logging.getLogger(__name__)

TF = "tf2_msgs/msg/TFMessage"
OLD_TF = "tf/msg/tfMessage"
PATH = "nav_msgs/msg/Path"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_KINDS = (ODOMETRY, TRANSFORM, POSE, POSE_WITH_COVARIANCE, PATH)  # the preferred first
_SAME = 1e-9  # metres, and quaternion components: a transform that is sent again and again


class PoseSamples:
    """Poses with their times, 64 bytes each: a robot may send a thousand a second."""

    def __init__(self) -> None:
        self._stamps, self._values = array("q"), array("d")

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp: int, t: Any, q: Any) -> None:
        """A translation and a quaternion at a time; left out where they are not finite, or no rotation."""
        values = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
        length = float(np.linalg.norm(values[3:]))
        if np.isfinite(values).all() and 0.5 < length < 2:
            values[3:] /= length
            self._stamps.append(stamp)
            self._values.extend(values.tolist())

    def last(self) -> Trajectory:
        """The pose that was added last, which counts of a static transform."""
        table: NDArray[np.float64] = np.array(self._values[-7:]).reshape(1, 7)
        return Trajectory(np.array(self._stamps[-1:], np.int64), table[:, :3], table[:, 3:])

    def trajectory(self, part: int | None = None, of: str = "") -> Trajectory:
        """The poses in the order of time; of equal times the first.

        Args:
            part: number of the part to take where their clock stepped back, from 1; None = all.
            of: name for the warning about poses at one time that differ.
        """
        own = slice(None) if part is None else clock_parts(self._stamps)[:part][-1]
        stamps = np.array(self._stamps[own], np.int64)
        table: NDArray[np.float64] = np.array(self._values).reshape(-1, 7)[own]
        order = np.argsort(stamps, kind="stable")
        if words := twins(stamps[order], table[order]):
            log.warning("the recording has %s (%s); the first that came counts", words, of)
        stamps, first = np.unique(stamps, return_index=True)
        return Trajectory(stamps, table[first, :3], table[first, 3:])


class _Edge(NamedTuple):
    parent: str
    trajectory: Trajectory
    is_constant: bool

    def at(self, stamp: int, max_gap_ns: int) -> Transform | None:
        if self.is_constant:
            return rigid(self.trajectory.quaternions[0], self.trajectory.translations[0])
        return self.trajectory.at(stamp, max_gap_ns=max_gap_ns)


class TransformTree:
    """The tree of frames in /tf and /tf_static, each transform over time.

    A frame has one parent: of several, the one named most often.

    Args:
        max_gap_ns: between the two transforms interpolated; across a longer gap there is none.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self._max_gap_ns = max_gap_ns
        self._samples: dict[tuple[str, str], PoseSamples] = defaultdict(PoseSamples)
        self._dynamic: set[tuple[str, str]] = set()
        self._edges: dict[str, _Edge] = {}

    def add(self, message: Any, log_ns: int, *, static: bool) -> None:
        """Add the transforms of a TFMessage; those that are not finite are left out.

        Args:
            log_ns: when it was recorded: the time of those without a stamp.
        """
        for one in message.transforms:
            key = frame_id(one), str(one.child_frame_id).strip("/")
            if key[0] != key[1]:
                where = one.transform.translation, one.transform.rotation
                self._samples[key].add(stamp_ns(one) or log_ns, *where)
                if not static:
                    self._dynamic.add(key)

    def finish(self, part: int | None) -> None:
        """Build the tree, after the last `add`; `part` as of `PoseSamples.trajectory`."""
        for (parent, child), samples in sorted(self._samples.items(), key=lambda item: len(item[1])):
            if not samples:
                continue
            is_static = (parent, child) not in self._dynamic
            trajectory = samples.last() if is_static else samples.trajectory(part, f"{child} in {parent}")
            rows = np.hstack([trajectory.translations, trajectory.quaternions])
            constant = is_static or bool((np.ptp(rows, axis=0) < _SAME).all())
            self._edges[child] = _Edge(parent, trajectory, constant)
        self._samples.clear()

    def ancestors(self, frame: str) -> list[str]:
        """The frame itself, its parent, and so on to the root."""
        chain = [frame]
        while (edge := self._edges.get(chain[-1])) is not None and edge.parent not in chain:
            chain.append(edge.parent)
        return chain

    def moves(self, frame: str) -> bool:
        """True if a transform between the frame and its root changes."""
        return any(not self._edges[one].is_constant for one in self.ancestors(frame)[:-1])

    def is_dynamic(self, frame: str) -> bool:
        """True if a transform between the frame and its root was sent on /tf, not only on /tf_static."""
        chain = self.ancestors(frame)
        return any((parent, child) in self._dynamic for child, parent in pairwise(chain))

    def connected(self, one: str, other: str) -> bool:
        return self.ancestors(one)[-1] == self.ancestors(other)[-1]

    def at(self, target: str, source: str, stamp: int) -> Transform | None:
        """`T_target_source` at a time; None where it is not known."""
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
        """The pose of the first frame in the parent of the last."""
        T: Transform = np.eye(4)
        for frame in frames:
            step = self._edges[frame].at(stamp, self._max_gap_ns)
            if step is None:
                return None
            T = step @ T
        return T


class TransformTrack(NamedTuple):
    """Poses of one frame in another."""

    world: str
    body: str  # the frame whose pose it is; empty = the topic does not name it
    trajectory: Trajectory


class PoseTopic:
    """Poses of one topic, collected message by message."""

    def __init__(self) -> None:
        self.world, self.body = "", ""  # frames that the first message names; an empty body = it names none
        self._samples, self._began = PoseSamples(), False

    def add(self, message: Any, kind: str) -> None:
        """Add a message of one of `POSE_KINDS`."""
        for one in message.poses if kind == PATH else [message]:
            if not self._began:
                self.world, self._began = frame_id(one), True
                self.body = str(getattr(one, "child_frame_id", "")).strip("/")
            if kind == TRANSFORM:
                where = one.transform.translation, one.transform.rotation
            else:
                pose = one.pose if kind in (POSE, PATH) else one.pose.pose
                where = pose.position, pose.orientation
            self._samples.add(stamp_ns(one), *where)

    def track(self, part: int | None) -> TransformTrack | None:
        """The poses so far, `part` as of `PoseSamples.trajectory`; None = there is none."""
        return (
            TransformTrack(
                self.world, self.body, self._samples.trajectory(part, f"{self.body} in {self.world}")
            )
            if self._samples
            else None
        )
