# SPDX-License-Identifier: MIT
"""A stereo camera that shows both images side by side in one: through OpenCV's VideoCapture, or in a file."""

import logging
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.geometry.calibration import Size
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources.source import LiveSource
from tsfusion.scanner.sources.stereo_pairs import AlreadyRectified, PairRectifier, frame_of, read_rectifier

log = logging.getLogger(__name__)

_SLICE_S = 0.1  # between two looks at whether the source was closed
_JOIN_S = 2.0  # a driver that hangs is left to its own thread


class StereoVideo(LiveSource):
    """Left and right halves of one picture, as rectified pairs.

    Of a camera or a network stream the newest picture is handed out, and those in between count as
    `dropped`; of a file every one.

    Args:
        place: the camera's number or device (`0`, `/dev/video0`), a stream's URL, or a file (or a pattern of
            files, `%06d.png`).
        calibration: file or folder, as `pairs.rectifier` reads it.
        intrinsics, baseline: instead, for pictures that are rectified already; pixels, metres.
        size: (height, width) of one half, asked of the camera; default the calibration's, else the camera's.
        fps: pictures a second asked of the camera; default its own.
        deadline: seconds without a picture after which a camera counts as stopped.

    Raises:
        SourceError: it cannot be opened or the calibration cannot be read.
        InvalidConfig: neither calibration nor intrinsics with baseline are given.
    """

    def __init__(
        self,
        place: str | Path,
        *,
        calibration: str | Path | None = None,
        intrinsics: Intrinsics | None = None,
        baseline: float | None = None,
        size: Size | None = None,
        fps: float | None = None,
        deadline: float = 5.0,
        sensor: str = "stereo",
    ) -> None:
        rectified = intrinsics is not None and baseline is not None
        if rectified == (calibration is not None):
            raise InvalidConfig(
                f"camera {place} needs a calibration file (--calibration), "
                "or intrinsics and baseline if its pictures are rectified"
            )
        super().__init__(f"camera {place}", sensor)
        self._place, self._deadline = str(place), deadline
        self._file, self._reading = _is_file(self._place), threading.RLock()
        pairs = None if calibration is None else _when_it_says(calibration, size)
        wanted = size or (None if pairs is None else pairs.size)
        self._capture = _open(self._place, self._file, wanted, fps, deadline)
        try:
            shown = _shown(self._capture)
            if calibration is None:
                assert intrinsics is not None
                assert baseline is not None
                self._pairs: PairRectifier = AlreadyRectified(intrinsics, baseline, size or shown)
            else:
                self._pairs = pairs or read_rectifier(calibration, size=size or shown)
        except BaseException:
            self._capture.release()
            raise
        count = self._capture.get(cv2.CAP_PROP_FRAME_COUNT) if self._file else 0
        self.length = int(count) if count > 0 else None
        self.live = not self._file
        self._grabber = None if self._file else CameraThread(self._capture)

    def __iter__(self) -> Iterator[Frame]:
        for picture in self._all() if self._grabber is None else self._newest(self._grabber):
            yield self._frame(picture)

    def close(self) -> None:
        """Let go of the camera; a blocked iteration ends within a tenth of a second."""
        super().close()
        if self._grabber is not None:
            self._grabber.close()
        else:
            with self._reading:
                self._capture.release()

    def _all(self) -> Iterator["VideoPicture"]:
        count, fps = 0, self._capture.get(cv2.CAP_PROP_FPS)
        period = round(1e9 / fps) if fps > 0 else 1  # a time of 0 would mean that it is unknown
        while not self._closed.is_set():
            with self._reading:
                there, image = self._capture.read()
                since_start = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            if not there:
                break
            count += 1
            yield VideoPicture(image, since_start + period, time.monotonic_ns())
        if not count and not self._closed.is_set():
            raise SourceError(f"{self._place} holds no pictures that can be decoded; expected a video")

    def _newest(self, grabber: "CameraThread") -> Iterator["VideoPicture"]:
        last = time.monotonic()
        while not self._closed.is_set():
            picture = grabber.take(_SLICE_S)
            if grabber.dropped:
                self.skipped["dropped"] = grabber.dropped
            if picture is not None:
                yield picture
                last = time.monotonic()
            elif self._closed.is_set():
                return
            elif grabber.ended or time.monotonic() - last > self._deadline:
                how = "stopped" if grabber.ended else f"delivered no picture for {self._deadline:g} s"
                raise SourceError(
                    f"{self.name} {how}; is it still plugged in, "
                    "and is the USB port fast enough for its pictures?"
                )

    def _frame(self, picture: "VideoPicture") -> Frame:
        height, width = self._pairs.size
        if picture.image.shape[:2] != (height, 2 * width):
            raise SourceError(
                f"{self.name} shows {picture.image.shape[1]}×{picture.image.shape[0]} pixels; expected two "
                f"images of {width}×{height} side by side, as calibrated: {2 * width}×{height}"
            )
        left, right = picture.image[:, :width], picture.image[:, width:]
        return frame_of(
            left,
            right,
            self._pairs,
            sensor=self.sensor,
            timestamp_ns=picture.timestamp_ns,
            captured_ns=picture.captured_ns,
        )


@dataclass(frozen=True, eq=False)
class VideoPicture:
    """One image as captured."""

    image: NDArray[np.uint8]
    timestamp_ns: int
    captured_ns: int


class CameraThread:
    """A thread that keeps a camera's newest picture, so that none waits in the driver's queue.

    Attributes:
        dropped: pictures that a newer one replaced.
        ended: the camera gives no more.
    """

    def __init__(self, capture: Any) -> None:
        self.dropped, self.ended = 0, False
        self._capture = capture
        self._newest: VideoPicture | None = None
        self._changed, self._closed = threading.Condition(), False
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def take(self, timeout: float) -> VideoPicture | None:
        """The newest picture nobody took yet; None if there is none in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest or self.ended or self._closed, timeout)
            picture, self._newest = self._newest, None
            return picture

    def close(self) -> None:
        """The thread releases the camera: while it reads, nobody else may."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            while not self._closed and self._capture.grab():
                captured_ns, timestamp_ns = time.monotonic_ns(), time.time_ns()
                there, image = self._capture.retrieve()
                if there:
                    self._put(VideoPicture(image, timestamp_ns, captured_ns))
        except cv2.error as error:
            log.warning("a camera's picture cannot be read: %s", error)
        finally:
            with self._changed:
                self.ended = True
                self._changed.notify_all()
            self._capture.release()

    def _put(self, picture: VideoPicture) -> None:
        with self._changed:
            self.dropped += self._newest is not None
            self._newest = picture
            self._changed.notify_all()


def _when_it_says(calibration: str | Path, size: Size | None) -> PairRectifier | None:
    """The rectifier, unless the file leaves the size of its images to the camera."""
    try:
        return read_rectifier(calibration, size=size)
    except SourceError:
        if size is not None or not Path(calibration).expanduser().exists():
            raise
        return None


def _is_file(place: str) -> bool:
    return not (place.isdigit() or place.startswith("/dev/") or "://" in place)


def _open(place: str, file: bool, size: Size | None, fps: float | None, deadline: float) -> Any:
    if file:
        if "%" not in place and not Path(place).expanduser().is_file():
            raise SourceError(
                f"{place} does not exist; expected a camera's number, a device, a URL or a video"
            )
        capture = cv2.VideoCapture(str(Path(place).expanduser()))
    elif "://" in place:
        limit = round(deadline * 1000)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit]
        capture = cv2.VideoCapture(place, cv2.CAP_FFMPEG, limits)
    else:
        capture = cv2.VideoCapture(int(place)) if place.isdigit() else cv2.VideoCapture(place, cv2.CAP_V4L2)
    if not capture.isOpened():
        raise SourceError(f"camera {place} cannot be opened: {_why(place, file)}")
    if not file and "://" not in place:
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, 2 * size[1])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[0])
        if fps is not None:
            capture.set(cv2.CAP_PROP_FPS, fps)
    return capture


def _why(place: str, file: bool) -> str:
    if file:
        return "expected a video that OpenCV can decode"
    if "://" in place:
        return "nobody answers there, or with no video; expected an address that OpenCV's FFmpeg can play"
    device = Path(f"/dev/video{place}" if place.isdigit() else place)
    if not device.exists():
        there = ", ".join(sorted(map(str, Path("/dev").glob("video*"))))
        return f"there is no {device}; " + (
            f"expected one of {there}" if there else "no camera is plugged in"
        )
    if not os.access(device, os.R_OK | os.W_OK):
        return f"no permission for {device}; add the user to its group (sudo usermod -aG video $USER)"
    return (
        f"another program uses {device}, or it takes no pictures (a camera has several; try the next number)"
    )


def _shown(capture: Any) -> Size:
    """(height, width) of one half."""
    width, height = (capture.get(p) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    return int(height), int(width) // 2
