# SPDX-License-Identifier: MIT
"""Find the topics of images in a recording, and the cameras of these images."""

import re
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig, errors_as
from tsfusion.datasets.cameras import RecordedCamera, given_camera
from tsfusion.datasets.readers import checked_intrinsics, intrinsics_of
from tsfusion.datasets.rosbag import bag_messages
from tsfusion.datasets.rosbag.bag_messages import CAMERA, CameraInfo
from tsfusion.datasets.rosbag.reader import Message, Stream, TopicMessages, first_message, frame_id
from tsfusion.datasets.stereo_pairs import AlreadyRectified, PairRectifier
from tsfusion.geometry.calibration import MAX_NO_SKEW, Rectifier, Undistorter
from tsfusion.geometry.calibration import Camera as Lens
from tsfusion.geometry.calibration_files import read_rig, rig_of_camera_info
from tsfusion.geometry.keyframe import Intrinsics

_MAX_TRIED = 20  # messages of a topic
_TRANSPORT = re.compile(r"/(compressed|compressedDepth)$")
RECTIFIED = re.compile(r"(?<![a-z])rect")
REGISTERED = re.compile(r"(?<![a-z])(?<!not_)(aligned(?!_depth_to_infra)|registered)")
_NO_COLOR = re.compile(r"infra|(^|[/_])ir([/_\d]|$)|fisheye|confidence", re.IGNORECASE)
_UNDISTORTED = 1e-6  # largest coefficient of a camera without distortion
_NO_TURN = 1e-6
_CHANGED = 0.02  # share of the focal length, or change of a coefficient: more than autofocus gives


class ImageTopic(NamedTuple):
    """Topic of images, with the first of them that can be decoded."""

    stream: Stream
    base: str  # name of the topic without the transport
    first: Any  # first message that can be decoded
    size: tuple[int, int]  # height and width
    frame: str

    @property
    def is_depth(self) -> bool:
        """True for depth images, by their encoding."""
        return bag_messages.is_depth(self.first) and not _NO_COLOR.search(self.base)

    @property
    def is_color(self) -> bool:
        """True for images of visible light, in colour or grey."""
        return not bag_messages.is_depth(self.first) and not _NO_COLOR.search(self.base)

    @property
    def is_gray(self) -> bool:
        return bag_messages.encoding(self.first) in ("mono8", "8UC1")


def image_topic(recording: TopicMessages, stream: Stream) -> ImageTopic | None:
    """Describe a topic by its first readable image, or return None if the first few cannot be decoded."""
    for message in islice(recording.messages([stream]), _MAX_TRIED):
        if isinstance(message, Message):
            content = message.content
            with suppress(DatasetError):
                is_depth = bag_messages.is_depth(content)
                height, width = (
                    bag_messages.depth(content) if is_depth else bag_messages.gray(content)
                ).shape
                return ImageTopic(
                    stream, _TRANSPORT.sub("", stream.topic), content, (height, width), frame_id(content)
                )
    return None


class CameraWatch:
    """Watch that the cameras of some topics stay the same: the first CameraInfo is used for all images."""

    def __init__(self, streams: list[Stream]) -> None:
        self.streams = streams
        self._first: dict[tuple[Stream, str], tuple[CameraInfo, int]] = {}  # by topic and frame

    def add(self, message: Message) -> None:
        """Raise DatasetError if a CameraInfo differs from the first one of its topic."""
        found, now = bag_messages.camera(message.content), message.location.log_ns
        first, began = self._first.setdefault((message.stream, frame_id(message.content)), (found, now))
        if not (first.K[0, 0] and found.K[0, 0]):  # not calibrated
            return
        moved = np.abs(found.K - first.K).max() / first.K[0, 0]
        bent = first.D.shape == found.D.shape and np.abs(found.D - first.D).max(initial=0) > _CHANGED
        if moved > _CHANGED or bent or (found.width, found.height) != (first.width, first.height):
            seconds, lengths = (now - began) / 1e9, f"fx {first.K[0, 0]:.5g} to {found.K[0, 0]:.5g}"
            raise DatasetError(
                f"the camera of {message.stream.topic} changes {seconds:.1f} s after its start ({lengths}): "
                "cut the recording there, or give one for all its images (--intrinsics, --calibration)"
            )


class Cameras:
    """Find the CameraInfo of images.

    Args:
        info_topic: of all images; None = the one beside or above their topic, or the only one.
        intrinsics: of all images, instead of a CameraInfo.
        calibration: file of a camera or stereo camera, instead of a CameraInfo.
        rectified: True if images are already rectified; None = by the topic's name.
    """

    def __init__(
        self,
        recording: TopicMessages,
        info_topic: str | None,
        intrinsics: Intrinsics | None,
        calibration: str | Path | None,
        rectified: bool | None,
    ) -> None:
        self._recording, self._info_topic = recording, info_topic
        self._intrinsics, self._calibration, self._rectified = intrinsics, calibration, rectified
        self.used: list[Stream] = []  # the first CameraInfo of each is used for some images

    def find(self, images: ImageTopic) -> CameraInfo | None:
        """Return the CameraInfo of a topic of images, or None if there is none."""
        stream = self._info_stream(images)
        message = None if stream is None else first_message(self._recording, stream)
        return None if message is None else bag_messages.camera(message)

    def camera(self, images: ImageTopic) -> CameraInfo:
        """Return the CameraInfo of a topic of images. Raises DatasetError if there is none."""
        found = self.find(images)
        if found is None:
            raise DatasetError(
                f"{self._recording.path}: no CameraInfo of {images.stream.topic}: name one with --option "
                "info_topic=TOPIC, or give --intrinsics fx,fy,cx,cy or --calibration FILE; "
                f"{self._recording.listing()}"
            )
        return found

    def _info_stream(self, images: ImageTopic) -> Stream | None:
        found = {one.topic: one for one in self._recording.streams if one.kind == CAMERA}
        if self._info_topic is not None:
            return found.get(self._info_topic)
        place = images.base
        while place:
            for name in (f"{place}/camera_info", f"{place}/info/camera_info"):
                if name in found:
                    return found[name]
            place = place.rpartition("/")[0]
        return next((one for one in found.values() if len(found) == 1 and self._is_of(one, images)), None)

    def _is_of(self, info: Stream, images: ImageTopic) -> bool:
        """Return True if the only CameraInfo may belong to the images: it names no other frame."""
        message = first_message(self._recording, info)
        frame = "" if message is None else frame_id(message)
        return not frame or not images.frame or frame == images.frame or bool(REGISTERED.search(images.base))

    def view(self, images: ImageTopic) -> RecordedCamera:
        """Find the camera that took some images.

        Raises:
            DatasetError: the camera is missing, not calibrated, of another size, or of an unknown lens.
        """
        given = given_camera(images.size, intrinsics=self._intrinsics, calibration=self._calibration)
        return given or self._recorded_view(images)

    def _recorded_view(self, images: ImageTopic) -> RecordedCamera:
        camera, source = self._checked(images), self._source(images)
        if self._is_rectified(images):
            K = camera.P[:, :3] if camera.P[0, 0] else camera.K
            camera = camera._replace(K=K, D=np.zeros(0))
        if _is_pinhole(camera):
            return RecordedCamera(self._pinhole(images, camera.K), images.size, source)
        undistorter = Undistorter(self._lens(images, camera))
        return RecordedCamera(undistorter.intrinsics, images.size, source, undistorter)

    def _source(self, images: ImageTopic) -> str:
        """Add the topic of the images' CameraInfo to the used topics; return a text that names it."""
        stream = self._info_stream(images)
        if stream is None:
            return "from CameraInfo"
        self.used.append(stream)
        return f"from {stream.topic}"

    def own_view(self, images: ImageTopic) -> RecordedCamera | None:
        """Return the camera of colour images by a CameraInfo beside their topic, or None without one."""
        stream = None if self._info_topic is not None else self._info_stream(images)
        if stream is None or not _is_beside(stream.topic, images.base):
            return None
        return self._recorded_view(images)

    def pairs(self, left: ImageTopic, right: ImageTopic) -> tuple[PairRectifier, str]:
        """Return the rectifier of a stereo pair, and the source of its calibration.

        Raises:
            DatasetError: as for `view`.
        """
        if self._calibration is not None:
            return self._pairs_of_file(left, Path(self._calibration).expanduser())
        cameras = [self._checked(one) for one in (left, right)]
        shift = cameras[0].P[0, 3] - cameras[1].P[0, 3]
        if not shift > 0:
            raise DatasetError(
                f"{self._recording.path}: the CameraInfo of {right.stream.topic} has no baseline in P[0, 3]"
            )
        plain = all(_is_pinhole(one) and _turn(one) < _NO_TURN for one in cameras)
        if plain or (self._is_rectified(left) and self._is_rectified(right)):
            recorded, _ = (self._pinhole(left, one.P) for one in cameras)
            if self._intrinsics is None:
                return AlreadyRectified(recorded, float(shift), left.size), self._source(left)
            given = checked_intrinsics(self._intrinsics, "intrinsics")
            return AlreadyRectified(given, float(shift) * given.fx / recorded.fx, left.size), "as given"
        if self._intrinsics is not None:
            raise DatasetError(
                f"{self._recording.path}: pairs that are not rectified need the --calibration of both, not "
                "--intrinsics (rectified=True says that these images are)"
            )
        lenses = [self._lens(one, camera) for one, camera in zip((left, right), cameras, strict=True)]
        R, P = [one.R for one in cameras], [one.P for one in cameras]
        rig = rig_of_camera_info(lenses[0], lenses[1], R, P)
        return Rectifier(rig), self._source(left)

    def _pairs_of_file(self, left: ImageTopic, path: Path) -> tuple[PairRectifier, str]:
        with errors_as(DatasetError, path, InvalidConfig):
            rectifier = Rectifier(read_rig(path))
        if rectifier.size != left.size:
            raise DatasetError(
                f"{path} is of images of {rectifier.size[1]}×{rectifier.size[0]}, {left.stream.topic} is "
                f"{left.size[1]}×{left.size[0]}; expected the calibration of these images"
            )
        return rectifier, f"from the given {path.name}"

    def _is_rectified(self, images: ImageTopic) -> bool:
        return bool(RECTIFIED.search(images.base)) if self._rectified is None else self._rectified

    def _checked(self, images: ImageTopic) -> CameraInfo:
        """Return the CameraInfo of images, after a comparison of its size with the images' size."""
        camera = self.camera(images)
        height, width = images.size
        if camera.width and (camera.width, camera.height) != (width, height):
            raise DatasetError(
                f"{self._recording.path}: {images.stream.topic} is {width}×{height}, its CameraInfo says "
                f"{camera.width}×{camera.height}"
            )
        return camera

    def _pinhole(self, images: ImageTopic, matrix: NDArray[np.float64]) -> Intrinsics:
        return intrinsics_of(matrix, f"{self._recording.path}: CameraInfo of {images.stream.topic}")

    def _lens(self, images: ImageTopic, camera: CameraInfo) -> Lens:
        self._pinhole(images, camera.K * ((1, 0, 1), (1, 1, 1), (1, 1, 1)))  # skew is allowed here
        try:
            return Lens.named(camera.K, images.size, camera.model, camera.D)
        except InvalidConfig as error:
            raise DatasetError(
                f"{self._recording.path}: CameraInfo of {images.stream.topic}: {error} (a rectified topic, "
                "as image_proc makes, needs no lens; rectified=True says that these images are)"
            ) from error


def _is_beside(info_topic: str, base: str) -> bool:
    """Return True if a CameraInfo's topic is in the folder of the images' topic `base`, so only theirs."""
    place = base.rpartition("/")[0]
    return info_topic.startswith((f"{place}/", f"{base}/"))


def _is_pinhole(camera: CameraInfo) -> bool:
    return bool(np.abs(camera.D).max(initial=0) < _UNDISTORTED and abs(camera.K[0, 1]) < MAX_NO_SKEW)


def _turn(camera: CameraInfo) -> float:
    return float(np.abs(camera.R - np.eye(3)).max()) if camera.R.any() else 0.0
