# SPDX-License-Identifier: MIT
"""Read stereo pairs from a camera, a stream or a video file whose pictures hold both images side by side."""

import logging
import os
import queue
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig, SourceError
from tsfusion.datasets.stereo_pairs import AlreadyRectified, PairRectifier, pair_of, read_rectifier
from tsfusion.geometry.calibration import Size
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources.camera_source import CameraSource

log = logging.getLogger(__name__)

_JOIN_S = 2.0  # seconds to wait for a driver that hangs


class StereoVideo(CameraSource):
    """Rectified pairs from the left and right halves of pictures, read by OpenCV.

    A camera or a network stream yields its newest picture; the pictures missed in between count as `dropped`.
    A file yields every picture.

    Args:
        place: number or device of a camera (`/dev/video0`; default 0), URL of a stream, or a video file (or
            a pattern of image files, `%06d.png`).
        calibration: file or folder, as for `stereo_pairs.read_rectifier`.
        intrinsics, baseline: pixels, metres; instead of a calibration, for pictures that are rectified.
        size: (height, width) of one half, set on the camera; default the calibration's or the camera's.
        fps: pictures a second, set on the camera; default the camera's.
        deadline: seconds without a picture after which a camera counts as stopped.

    Raises:
        SourceError: the camera, stream or file cannot be opened, or the calibration cannot be read.
        InvalidConfig: neither a calibration nor intrinsics with a baseline are given.
    """

    def __init__(
        self,
        place: str | Path | None = None,
        *,
        calibration: str | Path | None = None,
        intrinsics: Intrinsics | None = None,
        baseline: float | None = None,
        size: Size | None = None,
        fps: float | None = None,
        deadline: float = 5.0,
        sensor: str = "stereo",
    ) -> None:
        place = "0" if place is None else place
        rectified = intrinsics is not None and baseline is not None
        if rectified == (calibration is not None):
            raise InvalidConfig(
                f"camera {place} needs a calibration file (--calibration), "
                "or intrinsics and baseline if its pictures are rectified"
            )
        self._place, self._file, self._reading = str(place), _is_file(str(place)), threading.RLock()
        super().__init__(f"camera {place}", sensor, None if self._file else deadline)
        pairs = None if calibration is None else _rectifier(calibration, size, required=size is not None)
        wanted = size or (None if pairs is None else pairs.size)
        self._capture = _open(self._place, self._file, wanted, fps, deadline)
        try:
            shown = _half_size(self._capture)
            if calibration is None:
                assert intrinsics is not None
                assert baseline is not None
                self._pairs: PairRectifier = AlreadyRectified(
                    intrinsics, baseline * intrinsics.fx, size or shown
                )
            else:
                self._pairs = pairs or _rectifier(calibration, size or shown)
        except BaseException:
            self._capture.release()
            raise
        count, fps = (self._capture.get(one) for one in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
        self.length = int(count) if self._file and count > 0 else None
        self._period_ns = round(1e9 / fps) if fps > 0 else 1  # timestamp 0 means "unknown"
        self._count, self._ended = 0, False  # of a file
        self.live = not self._file
        self._thread = None if self._file else CameraThread(self._capture)

    def close(self) -> None:
        """Release the camera. A blocked iteration ends within a tenth of a second."""
        super().close()
        if self._thread is not None:
            self._thread.close()
        else:
            with self._reading:
                self._capture.release()

    def _wait(self, milliseconds: int) -> "VideoPicture | None":
        if self._thread is None:
            return self._next_of_file()
        picture = self._thread.newest(milliseconds / 1000)
        if self._thread.dropped:
            self.skipped["dropped"] = self._thread.dropped
        if picture is None and self._thread.ended and not self._closed.is_set():
            raise self._stopped("stopped")
        return picture

    def _next_of_file(self) -> "VideoPicture | None":
        with self._reading:
            there, image = self._capture.read()
            since_start = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        if there:
            self._count += 1
            return VideoPicture(image, since_start + self._period_ns, time.monotonic_ns())
        if not self._count and not self._closed.is_set():
            raise SourceError(f"{self._place} holds no pictures that can be decoded; expected a video")
        self._ended = True
        return None

    def _is_over(self) -> bool:
        return self._ended

    def _stopped(self, why: str) -> SourceError:
        return SourceError(
            f"{self.name} {why}; is it still plugged in, and is the USB port fast enough for its pictures?"
        )

    def _frame(self, picture: "VideoPicture") -> Frame:
        height, width = self._pairs.size
        if picture.image.shape[:2] != (height, 2 * width):
            raise SourceError(
                f"{self.name} shows {picture.image.shape[1]}×{picture.image.shape[0]} pixels; expected two "
                f"images of {width}×{height} side by side, as calibrated: {2 * width}×{height}"
            )
        left, right = picture.image[:, :width], picture.image[:, width:]
        return Frame(
            sensor=self.sensor,
            timestamp_ns=picture.timestamp_ns,
            captured_ns=picture.captured_ns,
            **pair_of(left, right, self._pairs),
        )


@dataclass(frozen=True, eq=False)
class VideoPicture:
    """One picture of a video (left and right image side by side) with its times."""

    image: NDArray[np.uint8]
    timestamp_ns: int
    captured_ns: int


class CameraThread:
    """Thread that keeps only a camera's newest picture, so that none grows old in the driver's queue."""

    def __init__(self, capture: Any) -> None:
        self.dropped = 0  # pictures replaced by a newer one
        self.ended = False  # the camera has stopped
        self._capture = capture
        # Holds the newest picture, or None to wake the reader. Ctrl-C cannot damage this queue; a
        # `Condition` is written in Python, and may be left locked.
        self._pictures: queue.SimpleQueue[VideoPicture | None] = queue.SimpleQueue()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def newest(self, timeout: float) -> VideoPicture | None:
        """Remove and return the newest picture, or return None if none comes in time."""
        with suppress(queue.Empty):
            return self._pictures.get(timeout=timeout)
        return None

    def close(self) -> None:
        """Stop the thread. Only the thread itself releases the camera, because it may be reading."""
        self._closed = True
        self._pictures.put(None)
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
            self.ended = True
            self._pictures.put(None)
            self._capture.release()

    def _put(self, picture: VideoPicture) -> None:
        with suppress(queue.Empty):
            self.dropped += self._pictures.get_nowait() is not None
        self._pictures.put(picture)


def _rectifier(calibration: str | Path, size: Size | None, *, required: bool = True) -> Any:
    """Read a calibration. Return None if the file has no image size and `size` is None, unless `required`."""
    try:
        return read_rectifier(calibration, size=size)
    except DatasetError as error:
        if required or not Path(calibration).expanduser().exists():
            raise SourceError(str(error)) from error
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
        raise SourceError(f"camera {place} cannot be opened: {_cause(place, file)}")
    if not file and "://" not in place:
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, 2 * size[1])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[0])
        if fps is not None:
            capture.set(cv2.CAP_PROP_FPS, fps)
    return capture


def _cause(place: str, file: bool) -> str:
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


def _half_size(capture: Any) -> Size:
    """Return the size of one of the two images in a picture, (height, width)."""
    width, height = (capture.get(p) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    return int(height), int(width) // 2
