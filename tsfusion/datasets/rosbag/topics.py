# SPDX-License-Identifier: MIT
"""Choose the topics of a depth camera, a stereo pair or a LiDAR: as named, or by type and name."""

import logging
import re
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from msgspec import Struct

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import RecordedCamera
from tsfusion.datasets.rosbag import bag_messages
from tsfusion.datasets.rosbag.bag_cameras import (
    RECTIFIED,
    REGISTERED,
    Cameras,
    ImageTopic,
    image_topic,
)
from tsfusion.datasets.rosbag.bag_messages import CAMERA, CLOUD, COMPRESSED, IMAGE
from tsfusion.datasets.rosbag.reader import Stream, TopicMessages, first_message, frame_id
from tsfusion.datasets.stereo_pairs import PairRectifier
from tsfusion.geometry.keyframe import Intrinsics

log = logging.getLogger(__name__)

Modality = Literal["depth", "stereo", "lidar"]
_OF_MODALITY: dict[Modality, tuple[str, ...]] = {
    "depth": ("depth_topic", "color_topic"),
    "stereo": ("left_topic", "right_topic"),
    "lidar": ("points_topic",),
}
_MAX_DIFFERENCE_S = {"depth": 0.02, "stereo": 0.005, "lidar": 0.0}
_LEFT_OF = (("right", "left"), ("infra2", "infra1"), ("infra_2", "infra_1"), ("cam1", "cam0"),
            ("image_1", "image_0"), ("image_3", "image_2"), ("camera_1", "camera_0"))  # fmt: skip
_SENSORS = (
    (r"realsense|aligned_depth|d4[0-9]5|l515|^/device_\d+/sensor_\d+/", "realsense"),
    (r"k4a|kinect2|azure|tof", "tof"),
)


class SensorOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options that say which topics are read, and how, of a recording or a running system.

    Attributes:
        modality: `depth`, `stereo` or `lidar`; default the first of them that there is.
        info_topic: CameraInfo of the images; default the one beside or above their topic.
        pose_topic: default by type.
        world_frame: default the root of the sensor's tree, or the frame of the pose topic.
        body_frame: frame that the poses of the pose topic belong to; default its `child_frame_id`, or the
            sensor's frame.
        intrinsics, calibration: of the depth camera, instead of a CameraInfo; for a stereo pair, the
            calibration of both cameras.
        depth_scale: metres per unit; default for 16-bit depth 0.001 (REP 118), or as a RealSense recorded it,
            and 1 for floats.
        rectified: True if the images are rectified, and `P` describes them; default True if the topic's name
            has `rect`. Other images are undistorted or rectified here (colour by its depth's camera).
        max_difference_s: between a depth image and its colour (default 20 ms), or left and right (5 ms).
        max_gap_s: largest gap between two poses for interpolation, seconds.
        time_offset_s: added to a frame's stamp before its pose is looked up, seconds.
        deskew: True moves points with times to where they were measured; False for points already corrected.
    """

    modality: Modality | None = None
    depth_topic: str | None = None
    color_topic: str | None = None
    info_topic: str | None = None
    points_topic: str | None = None
    left_topic: str | None = None
    right_topic: str | None = None
    pose_topic: str | None = None
    world_frame: str | None = None
    body_frame: str | None = None
    intrinsics: Intrinsics | None = None
    calibration: str | Path | None = None
    depth_scale: float | None = None
    rectified: bool | None = None
    max_difference_s: float | None = None
    max_gap_s: float = 0.25
    time_offset_s: float = 0.0
    sensor: str | None = None
    color: bool = True
    deskew: bool = True

    def __post_init__(self) -> None:
        """Raise DatasetError for an unknown modality."""
        known = get_args(Modality)
        if self.modality not in (None, *known):
            raise DatasetError(
                f"modality of a ROS recording must be {', '.join(known)}; got {self.modality!r}"
            )

    def most_apart_ns(self, modality: Modality) -> int:
        """Return the largest difference in time of two messages that belong together, nanoseconds."""
        given = self.max_difference_s
        return round((_MAX_DIFFERENCE_S[modality] if given is None else given) * 1e9)


class ColorCamera(NamedTuple):
    """Colour camera that is not the depth camera: its frame and its model."""

    frame: str
    camera: RecordedCamera


class ChosenTopics(NamedTuple):
    """The topics to read: of a depth camera, a stereo pair or a LiDAR, with their cameras."""

    modality: Modality
    main: Stream  # depth images, left images or point clouds
    other: Stream | None  # colour images for the depth, or right images; None without either
    sensor: str
    frame: str  # of `main`; empty if its messages name none
    size: tuple[int, int]  # height and width of an image of `main`
    camera: RecordedCamera | None = None  # of depth images, or the left camera of rectified pairs
    pairs: PairRectifier | None = None
    infos: tuple[Stream, ...] = ()  # the first CameraInfo of each is used for all images
    color_camera: ColorCamera | None = None  # of `other`, if its images must be registered to the depth

    def check_size(self, stream: Stream, size: tuple[int, ...]) -> None:
        """Raise DatasetError if an image's size is not that of the first image of its stream."""
        own = self.color_camera if stream == self.other else None
        expected = self.size if own is None else own.camera.size
        if self.modality != "lidar" and size != expected:
            raise DatasetError(f"is {size[1]}×{size[0]}, the first {expected[1]}×{expected[0]}")


class TopicChooser:
    """Choose among the topics of one recording, as the options say."""

    def __init__(self, recording: TopicMessages, given: SensorOptions) -> None:
        self._recording, self._given = recording, given
        info = self._named("info_topic", (CAMERA,))
        camera = given.intrinsics, given.calibration, given.rectified
        self._cameras = Cameras(recording, info and info.topic, *camera)
        self._found: list[ImageTopic] | None = None

    def choose(self) -> ChosenTopics:
        """Return the topics of the sensor to read: depth if there is any, else stereo, else LiDAR.

        Raises:
            DatasetError: there is none, or several fit. The message lists the topics.
        """
        modality = self._given.modality
        named = [
            kind for kind, names in _OF_MODALITY.items() if any(getattr(self._given, name) for name in names)
        ]
        if len(named) > 1 or (modality and named and modality != named[0]):
            raise DatasetError(f"{self._path}: topics of {' and '.join(named)} given; expected one sensor's")
        wanted = modality or (named[0] if named else None)
        for kind, find in (("depth", self._depth), ("stereo", self._stereo), ("lidar", self._lidar)):
            if wanted in (None, kind) and (chosen := find()) is not None:
                return chosen._replace(infos=tuple(self._cameras.used))
        raise self._error(f"no {wanted or 'depth images, stereo pair or point clouds'} found")

    @property
    def _path(self) -> object:
        return self._recording.path

    def _error(self, what: str) -> DatasetError:
        return DatasetError(f"{self._path}: {what}; {self._recording.listing()}")

    def _named(self, option: str, kinds: tuple[str, ...]) -> Stream | None:
        """Return the stream named by an option, or None if the option is not given."""
        topic = getattr(self._given, option)
        if topic is None:
            return None
        for stream in self._recording.streams:
            if stream.topic.strip("/") == topic.strip("/") and stream.kind in kinds:
                return stream
        wanted = " or ".join(kind.rpartition("/")[2] for kind in kinds)
        raise self._error(f"{option}={topic!r} is no topic of {wanted}")

    def _image_topics(self) -> list[ImageTopic]:
        """Return every topic of readable images."""
        if self._found is None:
            streams = [one for one in self._recording.streams if one.kind in (IMAGE, COMPRESSED)]
            found = [image_topic(self._recording, one) for one in streams]
            self._found = [one for one in found if one is not None]
        return self._found

    def _named_images(self, option: str) -> ImageTopic | None:
        stream = self._named(option, (IMAGE, COMPRESSED))
        if stream is None:
            return None
        found = next((one for one in self._image_topics() if one.stream == stream), None)
        if found is None:
            raise self._error(f"the images of {stream.topic} cannot be decoded")
        return found

    def _depth(self) -> ChosenTopics | None:
        main = self._named_images("depth_topic") or self._only(
            [one for one in self._image_topics() if one.is_depth],
            lambda one: (bool(REGISTERED.search(one.base)), bool(RECTIFIED.search(one.base))),
            "depth_topic",
        )
        if main is None:
            return None
        other, own_camera = self._color_of(main)
        sensor = next((name for pattern, name in _SENSORS if re.search(pattern, main.base)), "kinect")
        camera = self._cameras.view(main)
        return ChosenTopics(
            "depth", main.stream, other, sensor, main.frame, main.size, camera, color_camera=own_camera
        )

    def _color_of(self, depth: ImageTopic) -> tuple[Stream | None, ColorCamera | None]:
        """Return the colour images for a depth camera, and their own camera if they are not registered.

        Images count as registered if they have the depth's size, and its frame or a depth topic that says so.
        """
        given = self._named_images("color_topic")
        found = [one for one in self._image_topics() if one.is_color]
        best = given or max(found, key=lambda one: _closeness(one, depth), default=None)
        if best is None:
            return None, None
        fits = best.frame == depth.frame or bool(REGISTERED.search(depth.base))
        if fits and best.size == depth.size:
            return best.stream, None
        if (view := self._cameras.own_view(best)) is not None:
            return best.stream, ColorCamera(best.frame, view)
        if given is not None and best.size == depth.size:
            return best.stream, None
        sizes = (
            f"{best.stream.topic} is {best.size[1]}×{best.size[0]}, its depth {depth.size[1]}×{depth.size[0]}"
        )
        if given is not None:
            raise DatasetError(f"{self._path}: {sizes}; expected equal sizes, or a CameraInfo of each")
        log.warning("%s: %s has no CameraInfo and is left out (%s)", self._path, best.stream.topic, sizes)
        return None, None

    def _stereo(self) -> ChosenTopics | None:
        left, right = self._named_images("left_topic"), self._named_images("right_topic")
        if left is None and right is None:
            pairs = [pair for one in self._image_topics() if (pair := self._pair(one)) is not None]
            right = self._only(
                [pair[1] for pair in pairs],
                lambda one: (bool(RECTIFIED.search(one.base)), not one.is_color or one.is_gray),
                "left_topic and right_topic",
            )
            left = next((pair[0] for pair in pairs if pair[1] == right), None)
        if left is None and right is None:
            return None
        if left is None or right is None:
            raise self._error("left_topic and right_topic go together")
        rectifier, source = self._cameras.pairs(left, right)
        camera = RecordedCamera(rectifier.intrinsics, left.size, source)
        return ChosenTopics(
            "stereo", left.stream, right.stream, "stereo", left.frame, left.size, camera, rectifier
        )

    def _pair(self, right: ImageTopic) -> tuple[ImageTopic, ImageTopic] | None:
        """Return the left and right images if these are images of a right camera, else None."""
        if bag_messages.is_depth(right.first):
            return None
        camera = self._cameras.find(right)
        if camera is None or not camera.P[0, 3] < 0:
            return None
        for word, other in _LEFT_OF:
            if word in right.stream.topic:
                topic = other.join(right.stream.topic.rsplit(word, right.stream.topic.count(word)))
                for left in self._image_topics():
                    if left.stream.topic == topic:
                        return left, right
        return None

    def _lidar(self) -> ChosenTopics | None:
        stream = self._named("points_topic", (CLOUD,))
        if stream is None:
            found = [one for one in self._recording.streams if one.kind == CLOUD]
            if len(found) > 1:
                raise self._error("several topics of point clouds: choose one with points_topic")
            stream = found[0] if found else None
        if stream is None:
            return None
        if self._given.intrinsics is not None or self._given.calibration is not None:
            raise DatasetError(f"{self._path}: point clouds have no camera: leave out --intrinsics")
        first = first_message(self._recording, stream)
        if first is None:
            raise self._error(f"no point cloud of {stream.topic} can be read")
        return ChosenTopics("lidar", stream, None, "lidar", frame_id(first), (0, 0))

    def _only(self, found: list[ImageTopic], rank: Any, option: str) -> ImageTopic | None:
        """Return the topic of highest rank; of raw and compressed images, the one with more messages."""
        if not found:
            return None
        highest = max(map(rank, found))
        best = [one for one in found if rank(one) == highest]
        if len({one.base for one in best}) > 1:
            topics = ", ".join(sorted({one.base for one in best}))
            raise self._error(f"several topics fit ({topics}): choose one with {option}")
        return max(best, key=lambda one: (one.stream.messages, one.stream.kind == IMAGE))


def recorded_scale(recording: TopicMessages, depth: Stream) -> float | None:
    """Return the metres per unit of depth in a recording by librealsense, or None for other recordings."""
    device = re.match(r"/device_\d+/sensor_\d+", depth.topic)
    for stream in recording.streams if device else ():
        if re.fullmatch(rf"{device and device[0]}/option/Depth[_ ]Units/value", stream.topic):
            try:
                return float(first_message(recording, stream).data)
            except (AttributeError, TypeError, ValueError):
                return None
    return None


def _closeness(color: ImageTopic, depth: ImageTopic) -> tuple[object, ...]:
    """Return a sort key: how well colour images go with depth images, by frame, name and rectification."""
    return (
        color.frame == depth.frame,
        bool(re.search(r"colou?r|rgb", color.base)),
        not color.is_gray,
        _shared(color.base, depth.base),
        bool(RECTIFIED.search(color.base)) == bool(RECTIFIED.search(depth.base)),
        color.stream.messages,
        color.stream.kind == IMAGE,
    )


def _shared(one: str, other: str) -> int:
    """Return the number of leading parts that two topics' names have in common."""
    pairs = zip(one.split("/"), other.split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
