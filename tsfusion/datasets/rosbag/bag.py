# SPDX-License-Identifier: MIT
"""Open ROS 1 bags, ROS 2 bags (SQLite or MCAP) and MCAP files as datasets, without ROS.

`Bag` finds topics and poses by type and name, or takes topics that the user names.
"""

import logging
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tsfusion.core import plugins
from tsfusion.core.errors import DatasetError, InvalidConfig
from tsfusion.datasets.dataset import CLOCK, NO_POSE_IN_TIME, Frames, clock_parts, partners_in_time
from tsfusion.datasets.rosbag import bag_messages
from tsfusion.datasets.rosbag.bag_cameras import CameraWatch
from tsfusion.datasets.rosbag.message_frames import MessageFrames
from tsfusion.datasets.rosbag.poses import PoseFinder
from tsfusion.datasets.rosbag.reader import ENDINGS, BagRecording, Message, MessageLocation, recording
from tsfusion.datasets.rosbag.topics import SensorOptions, TopicChooser, recorded_scale
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.trajectory import PoseAt
from tsfusion.journal import is_segment

log = logging.getLogger(__name__)

EXPECTED = "a .bag, .mcap or .db3 file, or a folder with metadata.yaml: depth, stereo or points, and poses"


def recognises(path: Path) -> bool:
    """Return True for a ROS recording or a folder with one; False for a tsfusion journal (also MCAP)."""
    return recording(path) is not None


class Bag(Frames):
    """Depth images, stereo pairs or point clouds of a ROS recording, in the order of their header stamps.

    Each depth image gets the colour image nearest in time. Colour counts as registered if it has the same
    frame, or if the depth topic's name has `aligned` or `registered`. Other colour is registered here, by
    /tf_static and its CameraInfo. Depth without colour is kept and counted in `uncolored`. Poses come from
    /tf if a transform between the sensor's frame and the root of its tree changes. Otherwise they come from
    odometry, transform, pose or path messages, and /tf_static carries them to the sensor. A time without
    poses around it has no pose. Broken messages, pairs without one image, and (`posed`) frames without a pose
    are counted in `skipped`. Opening reads the recording once. A frame is read from disk at each access.

    Args:
        path: a file, or a folder with exactly one recording.
        part: number of the part to read, from 1, if the clock stepped back; default the first. The other
            parts are counted in `skipped`.
        posed: True leaves out frames without a pose; otherwise they have `T_world_camera` None.
        options: those of `SensorOptions`.

    Raises:
        MissingDependency: rosbags is not installed.
        DatasetError: the recording cannot be read, or the topics cannot be chosen (the message lists them).
    """

    quaternions = True

    def __init__(
        self, path: str | Path, *, part: int | None = None, posed: bool = True, **options: Any
    ) -> None:
        path, given = _recording_path(Path(path).expanduser()), SensorOptions(**options)
        self._recording = BagRecording(path)
        chosen = self._chosen = TopicChooser(self._recording, given).choose()
        self.camera = chosen.camera
        self.name, self.sensor, self.skipped = f"ROS {path.name}", given.sensor or chosen.sensor, {}
        self._with_color, self._deskew = given.color, given.deskew
        self._made = MessageFrames(chosen, given, recorded_scale(self._recording, chosen.main))
        self.depth_unit = self._made.depth_unit
        self.depth_scale = self.depth_unit.metres
        self.uncolored = 0
        poses = PoseFinder(self._recording, chosen, given)
        mains, others, cut = self._index(poses, part)
        self._pair(mains, others, given.most_apart_ns(chosen.modality))
        self._pose(poses.finish(required=posed, part=cut), posed)
        at_first = partial(poses.between, stamp=self._stamp(0))
        if not self._made.register(at_first):
            self._others[:] = [None] * len(self)
        self._accelerometer, self._gyroscope = poses.imu.sensors(at_first, cut)

    def __len__(self) -> int:
        return len(self._mains)

    def _index(
        self, poses: PoseFinder, part: int | None
    ) -> tuple[dict[int, MessageLocation], dict[int, MessageLocation], int | None]:
        """Return time → location of the main messages (depth, left, points) and of others (colour, right).

        The last value is the number of their part, or None if the clock never stepped back.
        """
        chosen = self._chosen
        used = [chosen.main]
        if chosen.other and (self._with_color or chosen.modality == "stereo"):
            used.append(chosen.other)
        check = _CHECKS.get(chosen.main.kind)
        locations: dict[str, list[MessageLocation]] = {one.topic: [] for one in used}
        broken: Counter[str] = Counter()
        watch = CameraWatch([*chosen.infos])
        for message in self._recording.messages([*used, *poses.streams, *watch.streams]):
            if not isinstance(message, Message):
                broken[message.topic] += message in used
            elif message.stream in watch.streams:
                watch.add(message)
            elif message.stream in used:
                try:
                    if check is not None and message.stream.kind == chosen.main.kind:
                        check(message.content)
                        chosen.check_size(message.stream, (message.content.height, message.content.width))
                    locations[message.stream.topic].append(message.location)
                except DatasetError as error:
                    broken[message.stream.topic] += 1
                    log.debug("%s: %s %s", self._recording.path, message.stream.topic, error)
            else:
                poses.add(message)
        for topic, count in broken.items():
            if count:
                self.skipped[f"of {topic} that are broken"] = count
        cut = self._cut(locations, part)
        # Messages by their header's stamp, or by the recorder's clock if a header has no stamp
        found = [{each.stamp_ns or each.log_ns: each for each in locations[one.topic]} for one in used]
        if repeated := len(locations[chosen.main.topic]) - len(found[0]):
            self.skipped[f"of {chosen.main.topic} with another's time"] = repeated
        return found[0], found[1] if len(found) > 1 else {}, cut

    def _cut(self, locations: dict[str, list[MessageLocation]], part: int | None) -> int | None:
        """Keep one part of messages whose clock stepped back; return its number, or None if none did."""
        main = self._chosen.main.topic
        stamps = {topic: [one.stamp_ns or one.log_ns for one in own] for topic, own in locations.items()}
        parts = {topic: clock_parts(own) for topic, own in stamps.items()}
        if not 1 <= (part or 1) <= len(parts[main]):
            raise DatasetError(f"{self._recording.path} has {len(parts[main])} parts, got part={part}")
        if len(parts[main]) == 1:
            return None
        begin, count = parts[main][1].start, len(locations[main])
        back_s = (max(stamps[main][:begin]) - stamps[main][begin]) / 1e9
        for topic, own in parts.items():
            same: Counter[MessageLocation] = Counter()
            for number, one in enumerate(locations[topic]):
                locations[topic][number] = one._replace(earlier=same[one])
                same[one] += 1
            locations[topic] = locations[topic][own[: part or 1][-1]]
        reason = f"{CLOCK} of {main} stepped back by {back_s:.2f} s (--option part=2 reads them instead)"
        reason = reason if part is None else "of other parts"
        self.skipped[reason] = count - len(locations[main])
        return part or 1

    def _pair(
        self, mains: dict[int, MessageLocation], others: dict[int, MessageLocation], max_difference_ns: int
    ) -> None:
        """Pair each main message (depth, left) with the other one (colour, right) that is nearest in time."""
        stamps, there = sorted(mains), sorted(others)
        partners = partners_in_time(there, stamps, max_difference_ns)
        alone, pairs = partners.count(None), [*zip(stamps, partners, strict=True)]
        if self._chosen.modality == "stereo":
            if alone:
                self.skipped["without a right image in time"] = alone
            pairs = [pair for pair in pairs if pair[1] is not None]
        elif self._chosen.other is not None and self._with_color:
            self.uncolored = alone
        self.timestamps_ns = np.array([stamp for stamp, _ in pairs], np.int64)
        self._mains = [mains[stamp] for stamp, _ in pairs]
        self._others = [None if index is None else others[there[index]] for _, index in pairs]

    def _pose(self, at: PoseAt, posed: bool) -> None:
        """Find the pose of each frame. If `posed`, leave out frames without a pose."""
        assert self.timestamps_ns is not None
        self._poses = [*map(at, self.timestamps_ns.tolist())]
        where = self._recording.path, EXPECTED
        chosen = self._keep(range(len(self._poses)), self._poses, where, posed=posed, reason=NO_POSE_IN_TIME)
        self._between = lambda: at
        self.timestamps_ns = self.timestamps_ns[chosen]
        self._mains = [self._mains[i] for i in chosen]
        self._others = [self._others[i] for i in chosen]

    def _frame(self, index: int) -> Frame:
        chosen, location = self._chosen, self._mains[index]
        content = self._recording.read(location)
        try:
            if chosen.modality == "lidar":
                return self._sweep(index, self._made.scan(content))
            other = self._others[index]
            beside = None if other is None else self._recording.read(other)
            return self._posed_frame(index, **self._made.images(content, beside))
        except (DatasetError, InvalidConfig) as error:
            raise DatasetError(
                f"{self._recording.path}: message {index} of {chosen.main.topic} {error}"
            ) from error


Bag.__signature__ = plugins.signature_of(Bag.__init__, SensorOptions)  # type: ignore[attr-defined]
_CHECKS: dict[str, Callable[[Any], None]] = {
    bag_messages.IMAGE: bag_messages.check_image,
    bag_messages.CLOUD: bag_messages.check_cloud,
}


def _recording_path(path: Path) -> Path:
    found = recording(path)
    if found is not None:
        return found
    if not path.exists():
        raise DatasetError(f"{path} does not exist; expected {EXPECTED}")
    if path.is_file():
        hint = " (`tsfusion replay` reads a journal of tsfusion)" if is_segment(path) else ""
        raise DatasetError(f"{path} does not begin as a ROS recording{hint}; expected {EXPECTED}")
    several = sorted(str(child) for child in path.glob("*.*") if child.suffix in ENDINGS)
    holds = f"holds {len(several)} files ({', '.join(several[:8])})" if several else "holds no ROS recording"
    raise DatasetError(f"{path} {holds}; expected {EXPECTED}")
