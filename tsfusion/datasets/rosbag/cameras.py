# SPDX-License-Identifier: MIT
"""The topics of images in a recording, and the cameras that took them."""

import re
from contextlib import suppress
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig
from tsfusion.datasets.readers import checked_intrinsics
from tsfusion.datasets.rosbag import messages
from tsfusion.datasets.rosbag.messages import CAMERA, CameraInfo
from tsfusion.datasets.rosbag.reader import BagRecording, Message, Stream, frame_id
from tsfusion.geometry.calibration import Camera as Lens
from tsfusion.geometry.calibration import Rectifier, StereoRig, Undistorter
from tsfusion.geometry.keyframe import Intrinsics

_TRIED = 20  # messages
_TRANSPORT = re.compile(r"/(compressed|compressedDepth)$")
RECTIFIED = re.compile(r"rect")
_NO_COLOR = re.compile(r"infra|(^|[/_])ir([/_\d]|$)|fisheye|confidence", re.IGNORECASE)
_UNDISTORTED = 1e-6  # largest coefficient of a camera without distortion
_NO_TURN = 1e-6


class ImagePair(NamedTuple):
    """A topic of images.

    Attributes:
        base: the topic without its transport.
        first: its first message that can be decoded.
        size: height and width.
    """

    stream: Stream
    base: str
    first: Any
    size: tuple[int, int]
    frame: str

    @property
    def is_depth(self) -> bool:
        """Whether these are depth images, by their encoding."""
        return messages.is_depth(self.first) and not _NO_COLOR.search(self.base)

    @property
    def is_color(self) -> bool:
        """Whether these are images of light that is seen."""
        return not messages.is_depth(self.first) and not _NO_COLOR.search(self.base)

    @property
    def is_gray(self) -> bool:
        """Whether these have one channel."""
        return messages.encoding(self.first) in ("mono8", "8UC1")


def picture(recording: BagRecording, stream: Stream) -> ImagePair | None:
    """A topic of images by the first one that can be decoded; None = none of the first few can."""
    for message in islice(recording.messages([stream]), _TRIED):
        if isinstance(message, Message):
            content = message.content
            with suppress(DatasetError):
                is_depth = messages.is_depth(content)
                height, width = (messages.depth(content) if is_depth else messages.gray(content)).shape
                return ImagePair(
                    stream, _TRANSPORT.sub("", stream.topic), content, (height, width), frame_id(content)
                )
    return None


class CameraView(NamedTuple):
    """The pinhole camera that images are turned into; `undistorter` None = they are its already."""

    intrinsics: Intrinsics
    undistorter: Undistorter | None


class CameraRig(NamedTuple):
    """The two that pairs are turned into; `rectifier` None = they are theirs already."""

    intrinsics: Intrinsics
    baseline_fx: float
    rectifier: Rectifier | None


class Cameras:
    """Finds the CameraInfo of images.

    Args:
        info_topic: of all images; None = the one beside or above their topic, or the only one.
        intrinsics: of all images, instead of a CameraInfo's.
        rectified: whether images have been rectified already; None = by the topic's name.
    """

    def __init__(
        self,
        recording: BagRecording,
        info_topic: str | None,
        intrinsics: Intrinsics | None,
        rectified: bool | None,
    ) -> None:
        self._recording, self._info_topic = recording, info_topic
        self._intrinsics, self._rectified = intrinsics, rectified

    def find(self, picture: ImagePair) -> CameraInfo | None:
        """The camera of some images; None = there is no CameraInfo."""
        stream = self._info_stream(picture)
        message = None if stream is None else self._recording.first(stream)
        return None if message is None else messages.camera(message)

    def camera(self, picture: ImagePair) -> CameraInfo:
        """The same; raises DatasetError where there is none."""
        found = self.find(picture)
        if found is None:
            raise DatasetError(
                f"{self._recording.path}: no CameraInfo of {picture.stream.topic}: name one with info_topic; "
                f"{self._recording.listing()}"
            )
        return found

    def _info_stream(self, picture: ImagePair) -> Stream | None:
        found = {one.topic: one for one in self._recording.streams if one.kind == CAMERA}
        if self._info_topic is not None:
            return found.get(self._info_topic)
        place = picture.base
        while place:
            for name in (f"{place}/camera_info", f"{place}/info/camera_info"):
                if name in found:
                    return found[name]
            place = place.rpartition("/")[0]
        return next(iter(found.values())) if len(found) == 1 else None

    def view(self, picture: ImagePair) -> CameraView:
        """How some images become those of a pinhole camera.

        Raises:
            DatasetError: the camera is missing, not calibrated, of another size, or of an unknown lens.
        """
        if self._intrinsics is not None:
            return CameraView(checked_intrinsics(self._intrinsics, "intrinsics"), None)
        camera = self._checked(picture)
        if self._is_rectified(picture):
            return CameraView(self._pinhole(picture, camera.P if camera.P[0, 0] else camera.K), None)
        if np.abs(camera.D).max(initial=0) < _UNDISTORTED:
            return CameraView(self._pinhole(picture, camera.K), None)
        undistorter = Undistorter(self._lens(picture, camera))
        return CameraView(undistorter.intrinsics, undistorter)

    def own_view(self, picture: ImagePair) -> CameraView | None:
        """The view of another camera than that of the depth; None where no CameraInfo of its own tells it."""
        if self._intrinsics is not None or self._info_topic is not None:
            return None
        stream = self._info_stream(picture)
        return None if stream is None or not _is_beside(stream.topic, picture.base) else self.view(picture)

    def rig(self, left: ImagePair, right: ImagePair) -> CameraRig:
        """How a pair's images become those of two equal cameras whose rows match; raises as `view` does."""
        cameras = [self._checked(one) for one in (left, right)]
        shift = cameras[0].P[0, 3] - cameras[1].P[0, 3]
        if not shift > 0:
            raise DatasetError(
                f"{self._recording.path}: the CameraInfo of {right.stream.topic} has no baseline in P[0, 3]"
            )
        plain = all(np.abs(one.D).max(initial=0) < _UNDISTORTED and _turn(one) < _NO_TURN for one in cameras)
        if plain or (self._is_rectified(left) and self._is_rectified(right)):
            return CameraRig(self._intrinsics or self._pinhole(left, cameras[0].P), float(shift), None)
        lenses = [self._lens(one, camera) for one, camera in zip((left, right), cameras, strict=True)]
        rectifier = Rectifier(StereoRig(lenses[0], lenses[1], _right_of(*cameras)))
        return CameraRig(rectifier.intrinsics, rectifier.baseline_fx, rectifier)

    def _is_rectified(self, picture: ImagePair) -> bool:
        return bool(RECTIFIED.search(picture.base)) if self._rectified is None else self._rectified

    def _checked(self, picture: ImagePair) -> CameraInfo:
        """The camera, once its size is that of the images."""
        camera = self.camera(picture)
        height, width = picture.size
        if camera.width and (camera.width, camera.height) != (width, height):
            raise DatasetError(
                f"{self._recording.path}: {picture.stream.topic} is {width}×{height}, its CameraInfo says "
                f"{camera.width}×{camera.height}"
            )
        return camera

    def _pinhole(self, picture: ImagePair, matrix: NDArray[np.float64]) -> Intrinsics:
        given = Intrinsics(*map(float, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])))
        return checked_intrinsics(given, f"{self._recording.path}: CameraInfo of {picture.stream.topic}")

    def _lens(self, picture: ImagePair, camera: CameraInfo) -> Lens:
        self._pinhole(picture, camera.K)
        try:
            return Lens.named(camera.K, picture.size, camera.model, camera.D)
        except InvalidConfig as error:
            raise DatasetError(
                f"{self._recording.path}: CameraInfo of {picture.stream.topic}: {error} (a rectified topic, "
                "as image_proc makes, needs no lens; rectified=True says that these images are)"
            ) from error


def _is_beside(info_topic: str, base: str) -> bool:
    """Whether a CameraInfo is of these images alone: in their topic's own folder."""
    place = base.rpartition("/")[0]
    return info_topic.startswith((f"{place}/", f"{base}/"))


def _turn(camera: CameraInfo) -> float:
    return float(np.abs(camera.R - np.eye(3)).max()) if camera.R.any() else 0.0


def _right_of(left: CameraInfo, right: CameraInfo) -> NDArray[np.float64]:
    """(4, 4) T_right_left: both turn by their `R` into rectified cameras, which stand side by side."""
    R_left, R_right = (one.R if one.R.any() else np.eye(3) for one in (left, right))
    T = np.eye(4)
    T[:3, :3] = R_right.T @ R_left
    T[:3, 3] = R_right.T @ np.array([right.P[0, 3] / right.P[0, 0] - left.P[0, 3] / left.P[0, 0], 0, 0])
    return T
