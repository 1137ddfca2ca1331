# SPDX-License-Identifier: MIT
"""The topics of images in a recording, and the cameras that took them."""

import re
from typing import Any, NamedTuple

import numpy as np

from tsfusion.datasets import bag_messages
from tsfusion.datasets.bag_messages import CAMERA, IMAGE, Camera
from tsfusion.datasets.bag_reader import Recording, Stream
from tsfusion.datasets.base import checked_intrinsics
from tsfusion.errors import DatasetError
from tsfusion.keyframe import Intrinsics

RECTIFIED = re.compile(r"rect")
_NO_COLOR = re.compile(r"infra|(^|[/_])ir([/_\d]|$)|fisheye|confidence")
_UNDISTORTED = 1e-6  # largest coefficient of a camera without distortion
_NO_TURN = 1e-6


class Picture(NamedTuple):
    """A topic of images.

    Attributes:
        base: the topic without its transport.
        first: its first message.
    """

    stream: Stream
    base: str
    first: Any
    frame: str

    @property
    def is_depth(self) -> bool:
        """Whether these are depth images, by their encoding."""
        return bag_messages.is_depth(self.first) and not _NO_COLOR.search(self.base)

    @property
    def is_color(self) -> bool:
        """Whether these are images of light that is seen."""
        return not bag_messages.is_depth(self.first) and not _NO_COLOR.search(self.base)

    @property
    def is_gray(self) -> bool:
        """Whether these have one channel."""
        return bag_messages.encoding(self.first) in ("mono8", "8UC1")


class Cameras:
    """Finds the CameraInfo of images.

    Args:
        info_topic: of all images; None = the one beside or above their topic, or the only one.
        intrinsics: of all images, instead of a CameraInfo's.
        rectified: whether images have been rectified already; None = by the topic's name.
    """

    def __init__(
        self,
        recording: Recording,
        info_topic: str | None,
        intrinsics: Intrinsics | None,
        rectified: bool | None,
    ) -> None:
        self._recording, self._info_topic = recording, info_topic
        self._intrinsics, self._rectified = intrinsics, rectified

    def find(self, picture: Picture) -> Camera | None:
        """The camera of some images; None = there is no CameraInfo."""
        stream = self._info_stream(picture)
        message = None if stream is None else self._recording.first(stream)
        return None if message is None else bag_messages.camera(message)

    def camera(self, picture: Picture) -> Camera:
        """The same; raises DatasetError where there is none."""
        found = self.find(picture)
        if found is None:
            raise DatasetError(
                f"{self._recording.path}: no CameraInfo of {picture.stream.topic}: name one with info_topic; "
                f"{self._recording.listing()}"
            )
        return found

    def _info_stream(self, picture: Picture) -> Stream | None:
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

    def pinhole(self, picture: Picture, *, pair: bool = False) -> Intrinsics:
        """The intrinsics of images that need no rectification.

        Raises:
            DatasetError: when they do, or the camera is not calibrated, or of another size.
        """
        if self._intrinsics is not None:
            return checked_intrinsics(self._intrinsics, "intrinsics")
        camera, topic = self.camera(picture), picture.stream.topic
        first = picture.first
        if picture.stream.kind == IMAGE and camera.width and (camera.width, camera.height) != (
            first.width, first.height,
        ):  # fmt: skip
            raise DatasetError(
                f"{self._recording.path}: {topic} is {first.width}×{first.height}, its CameraInfo says "
                f"{camera.width}×{camera.height}"
            )
        rectified = self._rectified
        if rectified is None:
            rectified = bool(RECTIFIED.search(picture.base))
        distortion = float(np.abs(camera.D).max(initial=0))
        turn = float(np.abs(camera.R - np.eye(3)).max()) if camera.R.any() else 0.0
        plain = distortion < _UNDISTORTED and (not pair or turn < _NO_TURN)
        if not rectified and not plain:
            raise DatasetError(
                f"{self._recording.path}: {topic} is not rectified ({camera.model} distortion up to "
                f"{distortion:.3g}); "
                "expected a rectified topic (image_proc makes image_rect), or rectified=True where the "
                "images have been rectified under this name"
            )
        matrix = camera.P[:, :3] if (rectified or pair) and camera.P[0, 0] else camera.K
        given = Intrinsics(*map(float, (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])))
        return checked_intrinsics(given, f"{self._recording.path}: CameraInfo of {topic}")
