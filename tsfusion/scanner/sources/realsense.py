# SPDX-License-Identifier: MIT
"""Intel RealSense through librealsense: a camera, a recording of one, or a device made by a program."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tsfusion.core.errors import InvalidConfig, MissingDependency, SourceError
from tsfusion.geometry.calibration import Camera, Size, Undistorter
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources import realsense_frames
from tsfusion.scanner.sources.source import LiveSource, monotonic_of

RECORDINGS = (".db3", ".bag")

_LENSES = {
    "brown_conrady": "radtan",
    "modified_brown_conrady": "radtan",
    "inverse_brown_conrady": "radtan",
    "kannala_brandt4": "equidistant",
}
_ADVICE = "Close other programs that use it, or try another cable and USB 3 port"
_WAIT_MS = 100  # between two checks whether the source was closed
_MAX_SKEW = 0.75  # of a period: images further apart are not of one exposure
_MAX_REORDERED = 16  # framesets that librealsense may have under way
_OLDEST_S = 1.0  # timestamps of frames that seem older are of another clock


class RealSense(LiveSource):
    """Depth registered to colour, or the rectified infrared pair, of one RealSense.

    The projector and all other options stay as they are on the camera. A live camera yields its newest
    frames; those that a slow consumer misses count as `dropped`. A recording yields all of them.

    Args:
        camera: serial number; default the first one found.
        recording: a file instead of a camera, as librealsense records it.
        device: a `pyrealsense2.device` of this process instead (a software device).
        images: `depth`, or `infrared`: the pair of the stereo cameras. Switch the dot projector off for it:
            its dots move with the camera.
        color: whether to use the colour camera, where there is one; without it depth keeps its own pixels.
        size: (height, width) of all images of a camera.
        fps: frames a second of a camera.
        real_time: whether to play a recording at its own speed, which may drop frames.
        deadline: seconds without a frame after which a camera counts as stopped.
        sensor: sensor model; default `realsense`, `tof` for a camera without a baseline, `stereo` for the
            infrared pair.

    Raises:
        SourceError: no such camera, it is in use or lacks such images; the recording cannot be played.
        MissingDependency: without pyrealsense2, or without the USB library that it loads.
    """

    def __init__(
        self,
        camera: str | None = None,
        *,
        recording: str | Path | None = None,
        device: Any = None,
        images: realsense_frames.Images = "depth",
        color: bool = True,
        size: Size = (480, 640),
        fps: int = 30,
        real_time: bool = False,
        deadline: float = 5.0,
        sensor: str | None = None,
    ) -> None:
        if images not in ("depth", "infrared"):
            raise InvalidConfig(f"images of a RealSense must be depth or infrared, got {images!r}")
        if sum(given is not None for given in (camera, recording, device)) > 1:
            raise InvalidConfig("give one of camera, recording and device of a RealSense")
        self._rs = _pyrealsense2()
        recording = None if recording is None else Path(recording).expanduser()
        super().__init__(f"RealSense {camera or (recording.name if recording else '')}".strip(), "realsense")
        self.live = recording is None or real_time
        self._played, self._deadline, self._number = recording is not None, deadline, -_MAX_REORDERED
        try:
            self._stream, self._color = realsense_frames.open_stream(
                self._rs, camera=camera, recording=recording, device=device, images=images, color=color,
                size=size, fps=fps, real_time=real_time,
            )  # fmt: skip
        except RuntimeError as error:  # all that librealsense raises
            advice = f"expected a recording of librealsense at {recording}" if recording else _ADVICE
            raise SourceError(f"{self.name} cannot be opened: {error}. {advice}") from error
        try:
            self._infrared = images == "infrared"
            self._prepare()
        except BaseException:
            self._stream.stop()
            raise
        self.sensor = sensor or self.sensor

    def __iter__(self) -> Iterator[Frame]:
        last = time.monotonic()
        while not self._closed.is_set():
            over = self._stream.over()
            frames = self._next()
            frame = None
            if frames is not None:
                frame = self._infrared_pair(frames) if self._infrared else self._depth(frames)
            if frame is not None:
                yield frame
                last = time.monotonic()
            elif over and frames is None:
                return
            elif not self._played and time.monotonic() - last > self._deadline:
                raise self._stopped()

    def close(self) -> None:
        """Stop the camera; a blocked iteration ends within a tenth of a second."""
        super().close()
        self._stream.stop()

    def _next(self) -> Any:
        try:
            return self._stream.wait(_WAIT_MS)
        except RuntimeError as error:
            if self._closed.is_set():
                return None
            raise SourceError(f"{self.name} stopped: {error}. {_ADVICE}") from error

    def _stopped(self) -> SourceError:
        if not realsense_frames.plugged_in(self._rs, self._stream.device):
            return SourceError(f"{self.name} was unplugged; plug it in and start again")
        return SourceError(f"{self.name} delivered no complete frames for {self._deadline:g} s. {_ADVICE}")

    def _prepare(self) -> None:
        """Read the calibration of the streams."""
        stream = self._rs.stream
        if self._infrared:
            left, right = (self._stream.profile(stream.infrared, index) for index in (1, 2))
            self.sensor, shown = "stereo", left
            baseline: float | None = abs(float(left.get_extrinsics_to(right).translation[0]))
        else:
            left = self._stream.profile(stream.depth)
            shown = self._stream.profile(stream.color) if self._color else left
            baseline = realsense_frames.baseline(self._rs, self._stream.device)
            self.sensor = "tof" if baseline is None else "realsense"
            self._align = self._rs.align(stream.color)
        self._undistorter = _undistorter(shown, self.name)
        if self._undistorter is None:
            camera = shown.get_intrinsics()
            self.intrinsics = Intrinsics(camera.fx, camera.fy, camera.ppx, camera.ppy)
        else:
            self.intrinsics = self._undistorter.intrinsics
        self.baseline_fx = None if baseline is None else baseline * left.get_intrinsics().fx

    def _depth(self, frames: Any) -> Frame | None:
        depth = frames.get_depth_frame()
        color = frames.get_color_frame() if self._color else None
        if not self._is_complete(depth, color, needed=self._color):
            return None
        timestamp_ns, captured_ns = self._stamps(depth)
        if self._color:
            aligned = self._align.process(frames)
            depth, color = (
                aligned.get_depth_frame(),
                realsense_frames.bgr(self._rs, aligned.get_color_frame()),
            )
        image = np.array(depth.get_data())
        if self._undistorter is not None:
            image = self._undistorter.depth(image)
            color = None if color is None else self._undistorter.image(color)
        return Frame(
            sensor=self.sensor,
            depth=image,
            depth_scale=round(depth.get_units(), 9),  # it comes in single precision
            color=color,
            intrinsics=self.intrinsics,
            baseline_fx=self.baseline_fx,
            timestamp_ns=timestamp_ns,
            captured_ns=captured_ns,
        )

    def _infrared_pair(self, frames: Any) -> Frame | None:
        left, right = frames.get_infrared_frame(1), frames.get_infrared_frame(2)
        if not self._is_complete(left, right, needed=True):
            return None
        timestamp_ns, captured_ns = self._stamps(left)
        grey = np.array(left.get_data())
        return Frame(
            sensor=self.sensor,
            left=grey,
            right=np.array(right.get_data()),
            color=np.repeat(grey[:, :, None], 3, axis=2),
            intrinsics=self.intrinsics,
            baseline_fx=self.baseline_fx,
            timestamp_ns=timestamp_ns,
            captured_ns=captured_ns,
        )

    def _is_complete(self, first: Any, second: Any, *, needed: bool) -> bool:
        """Check a frameset for a new first image and a second of the same exposure; count those without.

        Missing frame numbers were dropped; a set may repeat an image beside the next one of the other stream;
        a number that is much smaller comes from a camera that was restarted.
        """
        if not first or 0 <= self._number - first.frame_number < _MAX_REORDERED:
            return False
        if 0 <= self._number < first.frame_number - 1:
            self._skip("dropped", first.frame_number - 1 - self._number)
        self._number = first.frame_number
        if not needed:
            return True
        period_ms = 1000 / first.profile.fps()
        one_clock = second and first.frame_timestamp_domain == second.frame_timestamp_domain
        if not second or (one_clock and abs(first.timestamp - second.timestamp) > _MAX_SKEW * period_ms):
            self._skip("incomplete")
            return False
        return True

    def _stamps(self, frame: Any) -> tuple[int, int]:
        """`timestamp_ns` and `captured_ns`."""
        stamp = round(frame.timestamp * 1e6)  # from milliseconds
        foreign = self._played or frame.frame_timestamp_domain == self._rs.timestamp_domain.hardware_clock
        captured = time.monotonic_ns() if foreign else monotonic_of(stamp, oldest_s=_OLDEST_S)
        return stamp, captured


def _undistorter(profile: Any, name: str) -> Undistorter | None:
    """Undistorter of colour cameras whose images are distorted (D455, D405); None for all others.

    Librealsense projects with the forward polynomial in all three Brown-Conrady models (`rs2_project`).
    """
    camera = profile.get_intrinsics()
    if not any(camera.coeffs):
        return None
    model = _LENSES.get(camera.model.name)
    if model is None or profile.stream_type().name == "infrared":
        raise SourceError(
            f"{name}: the {profile.stream_type().name} images are distorted ({camera.model.name} "
            f"{list(camera.coeffs)}), which is not expected of a RealSense's depth or infrared images"
        )
    K = (camera.fx, camera.fy, camera.ppx, camera.ppy)
    coefficients = camera.coeffs[:4] if model == "equidistant" else camera.coeffs
    return Undistorter(Camera.named(K, (camera.height, camera.width), model, coefficients))


def _pyrealsense2() -> Any:
    try:
        import pyrealsense2
    except ModuleNotFoundError as error:
        raise MissingDependency(
            "RealSense needs pyrealsense2; install it with: pip install '.[realsense]' "
            "in your clone of tsfusion"
        ) from error
    except ImportError as error:  # a shared library that the wheel does not bring along
        raise MissingDependency(
            f"RealSense needs pyrealsense2, which is installed but cannot be loaded ({error}); "
            "on Debian and Ubuntu install its USB library with: apt-get install libusb-1.0-0"
        ) from error
    return pyrealsense2
