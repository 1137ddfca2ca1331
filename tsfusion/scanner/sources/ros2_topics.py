# SPDX-License-Identifier: MIT
"""Read the topics of a running ROS 2 robot, over DDS or Zenoh, without ROS."""

import logging
import time
from collections import deque
from collections.abc import Iterator
from functools import partial
from typing import Any

from tsfusion.core import plugins, process
from tsfusion.core.errors import DatasetError, InvalidConfig, InvalidKeyframe, SourceError
from tsfusion.core.readable_numbers import count_of
from tsfusion.datasets.dataset import CLOCK as CLOCK_STEP
from tsfusion.datasets.dataset import partners_in_time
from tsfusion.datasets.ros2.live_messages import LiveMessage, LiveMessages
from tsfusion.datasets.rosbag import bag_messages
from tsfusion.datasets.rosbag.bag_cameras import CameraWatch
from tsfusion.datasets.rosbag.message_frames import MessageFrames
from tsfusion.datasets.rosbag.poses import IMU, POSE_KINDS, TF, PoseFinder, pose_streams
from tsfusion.datasets.rosbag.reader import Message
from tsfusion.datasets.rosbag.topics import ChosenTopics, SensorOptions, TopicChooser
from tsfusion.datasets.scan_files import PointTimes, point_times
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.inertial_sensors import inertial_fields
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.sweeps import motion_about
from tsfusion.scanner.sources.source import SECOND, LiveSource

log = logging.getLogger(__name__)

CLOCK = "rosgraph_msgs/msg/Clock"
_MEASURED = (bag_messages.IMAGE, bag_messages.COMPRESSED, bag_messages.CLOUD)
_KINDS = (*_MEASURED, bag_messages.CAMERA, TF, *POSE_KINDS, CLOCK, IMU)
_SETTLED_S = 1.0  # without a new topic, before topics are chosen
_FIRST_S = 3.0  # to wait for the first message of each topic
_LOOK_S = 0.5  # between two looks at the topics
_SILENT_S = 5.0  # without a message, before the user is told
_PARTNER_S = 0.5  # longest wait of a frame for its colour, its right image, and its pose
_GONE_S = 1.0  # silence of a publisher after which another one of its topic is followed
_TAKE_S = 0.05
_MOST_OTHERS = 10  # colour images that are kept for each depth image, and while none comes


class MessagePairs:
    """Messages of a sensor that wait for the message nearest in time of another topic.

    Args:
        most_ns: nanoseconds between two messages of a pair, at most.
        expects: False if there is no other topic.
    """

    def __init__(self, most_ns: int, *, expects: bool) -> None:
        self._most_ns, self._expects = most_ns, expects
        self.waiting: deque[LiveMessage] = deque()
        self._others: dict[int, Any] = {}  # by time

    def add_other(self, message: Message) -> None:
        self._others[message_time(message)] = message.content
        if len(self._others) > _MOST_OTHERS * (1 + len(self.waiting)):
            del self._others[min(self._others)]

    def partner(self, stamp_ns: int) -> tuple[Any, bool]:
        """Return the other message of a pair, or None, and whether none nearer can come."""
        if not self._expects:
            return None, True
        if not self._others:
            return None, False
        times = sorted(self._others)
        (index,) = partners_in_time(times, [stamp_ns], self._most_ns)
        return None if index is None else self._others[times[index]], times[-1] >= stamp_ns

    def pop(self) -> LiveMessage:
        """Take the first message that waits, and drop what is too old for those behind it."""
        first = self.waiting.popleft()
        oldest = message_time(first.message) - self._most_ns
        self._others = {stamp: each for stamp, each in self._others.items() if stamp >= oldest}
        return first


class Ros2Topics(LiveSource):
    """Frames of a depth camera, a stereo pair or a LiDAR of a running ROS 2 system.

    Topics are found by type and name, paired and posed as `Bag` does it with a recording; the quality of
    service is what the publishers offer. A publisher that ends is waited for. The source ends after `idle`
    seconds without a frame, or when it is closed.

    Args:
        place: number of the ROS domain; default ROS_DOMAIN_ID, or 0.
        transport: `dds` or `zenoh`; default both, as far as they are installed.
        router: endpoint of Zenoh's router; default tcp/localhost:7447.
        wait: seconds until the topics must be there.
        idle: seconds; None = wait for ever.
        posed: True lets a frame wait for its pose, half a second at most.
        topics: those of `SensorOptions`.

    Raises:
        MissingDependency: neither transport is installed, or rosbags is not.
        SourceError: no topics fit in `wait` seconds; the message says what is missing and lists the topics.
    """

    def __init__(
        self,
        place: str | None = None,
        *,
        transport: str | None = None,
        router: str | None = None,
        wait: float = 30.0,
        idle: float | None = None,
        posed: bool = False,
        **topics: Any,
    ) -> None:
        if place is not None and not place.isdecimal():
            raise InvalidConfig(f"ros2 takes the number of a domain, as in ros2:7; got {place!r}")
        if not wait >= 0:
            raise InvalidConfig(f"wait={wait:g}: expected seconds, 0 or more")
        given = plugins.call(SensorOptions, topics, name="source ros2", error=InvalidConfig)
        domain = None if place is None else int(place)
        self._live = LiveMessages(_KINDS, transport=transport, domain=domain, router=router)
        super().__init__(self._live.path, "kinect")
        try:
            chosen = self._chosen = self._choose(given, wait)
        except BaseException:
            self._live.close()
            raise
        self._made = MessageFrames(chosen, given)
        self._poses = PoseFinder(self._live, chosen, given, live=True)
        most_ns = given.most_apart_ns(chosen.modality)
        self._pairs = MessagePairs(most_ns, expects=self._other is not None)
        self._watch = CameraWatch([*chosen.infos])
        self._posed, self._idle, self._deskew = posed, idle, given.deskew
        self._clock_ns, self._last = 0, (0, 0.1)  # stamp of the last frame, seconds since the one before
        self._followed: dict[str, tuple[bytes, float]] = {}  # topic → publisher, and when it was heard
        self._told: set[object] = set()
        self.sensor = given.sensor or chosen.sensor
        self.camera = "" if chosen.camera is None else str(chosen.camera)

    def waits_for(self) -> str:
        chosen = self._chosen
        topics = " with ".join(one.topic for one in (chosen.main, self._other) if one is not None)
        idle = "" if self._idle is None else f"after {self._idle:g} s without a frame, or "
        return f"{self.name}: {topics}; ends {idle}with Ctrl-C"

    # --- topics ---

    def _choose(self, given: SensorOptions, wait: float) -> ChosenTopics:
        """Wait for topics that fit, and choose among them. Raises SourceError."""
        began = told = time.monotonic()
        while True:
            self._live.look()
            why = self._unsettled()
            try:
                if not why:
                    return self._choose_now(given)
            except DatasetError as error:
                why = str(error)
            now = time.monotonic()
            if now - began > wait:
                raise SourceError(f"{why} (waited {wait:g} s: option `wait`)")
            if now - told > _SILENT_S:
                log.warning("%s; it goes on waiting", why)
                told = now
            self._closed.wait(_LOOK_S)

    def _unsettled(self) -> str:
        """Return why it is too early to choose: topics still appear, or are silent; empty = it is not."""
        live = self._live
        measured = [topic.name for topic in live.topics if topic.kind in _MEASURED]
        if not measured:
            return f"{live.path}: no images and no point clouds; {live.listing()}"
        age = time.monotonic() - live.changed
        silent = [topic for topic in measured if topic not in live.heard]
        if age < _SETTLED_S or (silent and age < _FIRST_S):
            return f"{live.path}: no message yet on {', '.join(silent) or 'new topics'}"
        return ""

    def _choose_now(self, given: SensorOptions) -> ChosenTopics:
        chosen = TopicChooser(self._live, given).choose()
        poses = {one.topic for one in pose_streams(self._live, given.pose_topic)}
        paired = given.color or chosen.modality == "stereo"
        self._other = chosen.other if paired else None
        used = {one.topic for one in (chosen.main, self._other, *chosen.infos) if one is not None}
        kinds = (TF, CLOCK, IMU) if given.pose_topic else (TF, CLOCK, IMU, *POSE_KINDS)
        self._live.narrow(lambda topic: topic.name in used | poses or topic.kind in kinds)
        return chosen

    # --- frames ---

    def __iter__(self) -> Iterator[Frame]:
        last = looked = time.monotonic()
        try:
            while not self._closed.is_set():
                for each in self._live.take(_TAKE_S):
                    self._add(each)
                for frame in self._ready():
                    yield frame
                    last = time.monotonic()
                now = time.monotonic()
                if now - looked > _LOOK_S:
                    self._live.look()
                    self._tell_silence(now)
                    process.give_back_memory()  # of messages, which are large and come from several threads
                    looked = now
                if self._idle is not None and now - last > self._idle:
                    return
        finally:
            self._count()
            self._live.close()

    def __exit__(self, *of: Any) -> None:
        super().__exit__(*of)
        self._live.close()

    def _add(self, each: LiveMessage) -> None:
        """Put a message where it belongs. Raises DatasetError if the camera changes."""
        message, stream = each.message, each.message.stream
        if stream.kind == CLOCK:
            self._clock_ns = message.content.clock.sec * SECOND + message.content.clock.nanosec
            return
        if self._clock_ns:  # simulated time, which a stamp that is left out would have had
            message = message._replace(location=message.location._replace(log_ns=self._clock_ns))
        if stream in self._watch.streams:
            self._watch.add(message)
        elif stream in (self._chosen.main, self._other):
            if not self._follows(each):
                self._skip(f"of another publisher of {stream.topic}")
            elif stream == self._other:
                self._pairs.add_other(message)
            else:
                self._pairs.waiting.append(each._replace(message=message))
        else:
            self._poses.add(message)

    def _follows(self, each: LiveMessage) -> bool:
        """Return True for messages of the publisher that was first, and of the next once it is silent."""
        topic, now = each.message.stream.topic, each.captured_ns / SECOND
        publisher, heard = self._followed.get(topic, (each.publisher, now))
        if publisher != each.publisher:
            if now - heard < _GONE_S:
                words = "%s has several publishers; messages of the first one are taken"
                self._tell_once(f"two {topic}", words, topic)
                return False
            log.info("another publisher of %s goes on", topic)
        self._followed[topic] = each.publisher, now
        return True

    def _ready(self) -> Iterator[Frame]:
        """Yield the frames that wait for nothing more."""
        while self._pairs.waiting:
            first = self._pairs.waiting[0]
            stamp = message_time(first.message)
            other, is_sure = self._pairs.partner(stamp)
            if time.monotonic_ns() - first.captured_ns < _PARTNER_S * SECOND:
                end = stamp + (round(self._last[1] * SECOND) if self._chosen.modality == "lidar" else 0)
                if not is_sure or (self._posed and self._pose(end) is None):
                    return
            self._pairs.pop()
            frame = self._frame(first, other, stamp)
            if frame is not None:
                yield frame

    def _frame(self, first: LiveMessage, other: Any, stamp: int) -> Frame | None:
        topic, before = first.message.stream.topic, self._last[0]
        if stamp <= before:
            stepped = f"{CLOCK_STEP} of {topic} stepped back"
            self._skip(f"of {topic} with another's time" if stamp == before else stepped)
            if before - stamp > SECOND:
                back_s, words = (before - stamp) / SECOND, "the clock of %s stepped back by %.1f s: scan anew"
                self._tell_once(f"clock {topic}", words, topic, back_s)
            return None
        if self._chosen.modality == "stereo" and other is None:
            self._skip("without a right image in time")
            return None
        T = self._pose(stamp)
        try:
            frame = Frame(
                sensor=self.sensor, timestamp_ns=stamp, captured_ns=first.captured_ns,
                T_world_camera=T, **self._measured(first.message.content, other, stamp),
                **inertial_fields(*self._poses.imu.sensors(partial(self._poses.between, stamp=stamp)), stamp),
            )  # fmt: skip
        except (DatasetError, InvalidConfig, InvalidKeyframe) as error:
            self._live.count_broken(topic, str(error))
            return None
        self._last = stamp, (stamp - before) / SECOND if before else self._last[1]
        return frame

    def _pose(self, stamp_ns: int) -> Transform | None:
        """Return T_world_sensor, or None if unknown. Raises DatasetError if it is needed and ambiguous."""
        try:
            return self._poses.at(stamp_ns)
        except DatasetError as error:
            if self._posed:
                raise
            self._tell_once("poses", "frames are taken without poses: %s", error)
            return None

    def _measured(self, content: Any, other: Any, stamp: int) -> dict[str, Any]:
        """Return a frame's measurement. Raises DatasetError."""
        chosen, made = self._chosen, self._made
        if chosen.modality == "lidar":
            scan = made.scan(content)
            times = point_times(scan, stamp, self._last[1]) if self._deskew else PointTimes()
            motion = motion_about(self._pose, stamp, times.point_times_s)
            return {"points": scan.points, "color": scan.color, "motion": motion, **times._asdict()}
        is_registered = other is None or made.register(partial(self._poses.between, stamp=stamp))
        return made.images(content, other if is_registered else None)

    def _tell_once(self, key: str, words: str, *of: object) -> None:
        if key not in self._told:
            self._told.add(key)
            log.warning(words, *of)

    def _tell_silence(self, now: float) -> None:
        """Say which topic is silent, and that it is back."""
        for stream in (self._chosen.main, self._other):
            if stream is None:
                continue
            topic, silent_s = stream.topic, now - self._live.heard.get(stream.topic, now)
            if silent_s < _SILENT_S:
                if topic in self._told:
                    self._told.discard(topic)
                    log.info("there are messages on %s again", topic)
                continue
            count = self._live.publishers(topic)
            there = f"{count_of(count, 'publisher')}, silent" if count else "its publisher is gone"
            words = "no message on %s for %.0f s: %s; the scan goes on when there is one"
            self._tell_once(topic, words, topic, silent_s, there)

    def _count(self) -> None:
        """Add what never became a frame to `skipped`."""
        live, main = self._live, self._chosen.main.topic
        for reason, counts in (("that are broken", live.broken), ("that came too fast", live.dropped)):
            if count := counts[main]:
                self.skipped[f"of {main} {reason}"] = count


def message_time(message: Message) -> int:
    """Return the stamp of a message in nanoseconds; without one, when it came."""
    return message.location.stamp_ns or message.location.log_ns
