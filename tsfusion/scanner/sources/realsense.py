# SPDX-License-Identifier: MIT
"""Read Intel RealSense cameras, their recordings, and software devices, with librealsense."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.geometry.calibration import Camera, Size, Undistorter
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.inertial_sensors import Accelerometer, Gyroscope
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources.camera_source import (
    ADVICE,
    OLDEST_S,
    CameraSource,
    camera_library,
    chosen_camera,
)
from tsfusion.scanner.sources.source import monotonic_of

log = logging.getLogger(__name__)
RECORDINGS = (".db3", ".bag")

_LENSES = {
    "brown_conrady": "radtan",
    "modified_brown_conrady": "radtan",
    "inverse_brown_conrady": "radtan",
    "kannala_brandt4": "equidistant",
}
_MAX_SKEW = 0.75  # share of a period: images with a larger time difference are not of one exposure
Images = Literal["depth", "infrared"]

_QUEUE = 4  # framesets that a syncer keeps; it drops the oldest


class PipelineStream:
    """Framesets (images of one moment) of a librealsense `config`: a camera (no `real_time`) or a recording.

    A recording is paused until the first `wait`. Librealsense starts the sensors one after the other; without
    the pause it would already read the file, and drop the data of sensors that are not started yet.
    """

    def __init__(self, rs: Any, config: Any, *, real_time: bool | None) -> None:
        self._stopped = rs.playback_status.stopped
        self._pipeline = rs.pipeline()
        self._playback = None
        if real_time is not None:  # before the start, or the first frames are lost
            resolved = config.resolve(rs.pipeline_wrapper(self._pipeline))
            self._playback = resolved.get_device().as_playback()
            self._playback.set_real_time(real_time)
            self._playback.pause()
        self._resuming: threading.Thread | None = None
        self._profile = self._pipeline.start(config)
        self.device = self._profile.get_device()

    def wait(self, milliseconds: int) -> Any:
        """Wait for the next frameset. Return None if no frameset comes in time."""
        if self._resuming is None and self._playback is not None:
            # In a thread: `resume` may return only after somebody takes frames.
            self._resuming = threading.Thread(target=self._playback.resume, daemon=True)
            self._resuming.start()
        there, frames = self._pipeline.try_wait_for_frames(milliseconds)
        return frames if there else None

    def over(self) -> bool:
        """Return True if no frameset will follow those in the queue."""
        if self._playback is None or self._resuming is None or self._resuming.is_alive():
            return False  # librealsense reports "stopped" also before it plays
        return bool(self._playback.current_status() == self._stopped)

    def profile(self, stream: Any, index: int = -1) -> Any:
        """Return librealsense's profile (format, intrinsics) of a video stream in use."""
        return self._profile.get_stream(stream, index).as_video_stream_profile()

    def stop(self) -> None:
        with suppress(RuntimeError):  # it was stopped already
            self._pipeline.stop()


class _OpenSensors:
    """Sensors of a device, and the profiles that they stream to a receiver.

    Args:
        choose: returns the profiles to stream, of those that a sensor offers.
    """

    def __init__(self, device: Any, choose: Callable[[list[Any]], list[Any]], receive: Any) -> None:
        self._sensors: list[Any] = []
        self._profiles: list[Any] = []
        for sensor in device.query_sensors():
            if chosen := choose(sensor.get_stream_profiles()):
                sensor.open(chosen)
                sensor.start(receive)
                self._sensors.append(sensor)
                self._profiles += chosen

    def stop(self) -> None:
        """Stop the sensors. It may be called twice."""
        while self._sensors:
            sensor = self._sensors.pop()
            with suppress(RuntimeError):  # it was unplugged
                sensor.stop()
                sensor.close()


class DeviceStream(_OpenSensors):
    """Streams of a device, which librealsense's syncer combines to framesets.

    Args:
        wanted: stream and index of each stream; index -1 means any.
    """

    def __init__(self, rs: Any, device: Any, wanted: list[tuple[Any, int]]) -> None:
        self.device, self._syncer = device, rs.syncer(_QUEUE)
        first: Callable[[list[Any]], dict[Any, Any]] = lambda offered: {  # noqa: E731
            want: profile for profile in offered[::-1] for want in wanted if _is(profile, *want)
        }
        super().__init__(device, lambda offered: [*first(offered).values()], self._syncer)
        if len(self._profiles) < len(wanted):
            self.stop()
            raise RuntimeError(f"the camera has {len(self._profiles)} of the {len(wanted)} streams wanted")

    def wait(self, milliseconds: int) -> Any:
        there, frames = self._syncer.try_wait_for_frames(milliseconds)
        return frames if there else None

    def over(self) -> bool:
        return False

    def profile(self, stream: Any, index: int = -1) -> Any:
        return next(p for p in self._profiles if _is(p, stream, index)).as_video_stream_profile()


class MotionStream(_OpenSensors):
    """Gyroscope and accelerometer of a device, if it has them; librealsense reads them in its own thread.

    Librealsense gives their values in the axes of the depth camera, or tells others by extrinsics, which its
    recordings lack.

    Args:
        depth: profile of the depth or of the left infrared images.
        images: profile of the images, in whose axes the values are.
    """

    def __init__(self, rs: Any, device: Any, depth: Any, images: Any) -> None:
        self.accelerometer, self.gyroscope = Accelerometer(live=True), Gyroscope(live=True)
        self._kinds = {rs.stream.accel: self.accelerometer, rs.stream.gyro: self.gyroscope}
        try:
            super().__init__(device, self._slowest, self._add)
            for profile in self._profiles:
                self._kinds[profile.stream_type()].R_sensor_imu = _rotation(profile, depth, images)
        except RuntimeError as error:  # for want of permission, or of extrinsics
            self.stop()
            self.accelerometer, self.gyroscope = Accelerometer(), Gyroscope()
            log.warning("the camera's gyroscope is not used: %s", error)

    def _slowest(self, offered: list[Any]) -> list[Any]:
        """Return one profile of each kind; it has 60 values a second and more."""
        ordered = sorted(offered, key=lambda profile: -profile.fps())
        return [*{p.stream_type(): p for p in ordered if p.stream_type() in self._kinds}.values()]

    def _add(self, frame: Any) -> None:
        value = frame.as_motion_frame().get_motion_data()
        sensor = self._kinds[frame.profile.stream_type()]
        sensor.add(round(frame.timestamp * 1e6), (value.x, value.y, value.z))  # from milliseconds


def _rotation(motion: Any, depth: Any, images: Any) -> NDArray[np.float64]:
    """Return R_images_motion, (3, 3)."""
    try:
        found = motion.get_extrinsics_to(images)
    except RuntimeError:
        found = depth.get_extrinsics_to(images)
    return np.asarray(np.reshape(found.rotation, (3, 3)).T)  # it comes by columns


def open_stream(
    rs: Any,
    *,
    camera: str | None,
    recording: Path | None,
    device: Any,
    images: Images,
    color: bool,
    size: Size,
    fps: int,
    real_time: bool,
) -> tuple[PipelineStream | DeviceStream, bool]:
    """Open the stream of a camera, a recording or a device. Return it, and True if it has colour.

    Raises:
        SourceError: there is no such camera.
    """
    found = device
    if found is None:
        found = (
            chosen_camera("RealSense", camera, _cameras(rs), "`rs-enumerate-devices` lists them; ")
            if recording is None
            else rs.context().load_device(str(recording))
        )
    color = color and images == "depth" and _has(found, rs.stream.color)
    wanted = [(rs.stream.infrared, 1), (rs.stream.infrared, 2)]
    if images == "depth":
        wanted = [(rs.stream.depth, -1), *([(rs.stream.color, -1)] if color else [])]
    if device is not None:
        return DeviceStream(rs, device, wanted), color
    config = rs.config()
    if recording is not None:
        del found  # the pipeline opens the file for itself
        config.enable_device_from_file(str(recording), repeat_playback=False)
        for stream, index in wanted:
            config.enable_stream(stream, index)
        return PipelineStream(rs, config, real_time=real_time), color
    config.enable_device(found.get_info(rs.camera_info.serial_number))
    formats = {rs.stream.depth: rs.format.z16, rs.stream.color: rs.format.bgr8}
    for stream, index in wanted:
        pixels = formats.get(stream, rs.format.y8)
        config.enable_stream(stream, index, size[1], size[0], pixels, fps)
    return PipelineStream(rs, config, real_time=None), color


def plugged_in(rs: Any, device: Any) -> bool:
    if not device.supports(rs.camera_info.serial_number):
        return bool(device.is_connected())
    return bool(device.is_connected()) or device.get_info(rs.camera_info.serial_number) in _cameras(rs)


def baseline_of(rs: Any, device: Any) -> float | None:
    """Return the baseline of the stereo cameras in metres, or None for other kinds of camera."""
    for sensor in device.query_sensors():
        if sensor.supports(rs.option.stereo_baseline):
            return abs(float(sensor.get_option(rs.option.stereo_baseline))) / 1000
    return None


def bgr(rs: Any, frame: Any) -> NDArray[np.uint8]:
    """Return a copy of a colour frame as (H, W, 3) uint8 BGR.

    Raises:
        SourceError: the pixel format is neither bgr8 nor rgb8.
    """
    order = {rs.format.bgr8: 1, rs.format.rgb8: -1}.get(frame.profile.format())
    if order is None:
        raise SourceError(
            f"colour frames come as {frame.profile.format().name}, expected bgr8 or rgb8; "
            "record them as one of these"
        )
    return np.array(np.asarray(frame.get_data())[:, :, ::order], order="C")


def _cameras(rs: Any) -> dict[str, Any]:
    """Connected devices by serial number."""
    key = rs.camera_info.serial_number
    return {device.get_info(key): device for device in rs.context().query_devices() if device.supports(key)}


def _has(device: Any, stream: Any) -> bool:
    return any(_is(p, stream, -1) for sensor in device.query_sensors() for p in sensor.get_stream_profiles())


def _is(profile: Any, stream: Any, index: int) -> bool:
    return profile.stream_type() == stream and index in (-1, profile.stream_index())


class RealSense(CameraSource):
    """Frames of one RealSense: depth registered to colour, or the rectified infrared pair.

    All options of the camera, also the projector, stay as set on the camera. A live camera yields its newest
    frames; frames that a slow consumer misses count as `dropped`. A recording yields all frames.

    Args:
        camera: serial number, or a file recorded by librealsense; by default the first camera found.
        device: a `pyrealsense2.device` of this process (a software device), instead of a camera.
        images: `depth`, or `infrared` for the pair of the stereo cameras. For `infrared`, switch the dot
            projector off: its dots move with the camera.
        color: True uses the colour camera if there is one. Otherwise depth keeps the depth camera's pixels.
        size: (height, width) of all images of a camera.
        fps: frames a second of a camera.
        real_time: True plays a recording at its own speed, which may drop frames.
        deadline: seconds without a frame after which a camera counts as stopped.
        sensor: sensor model; default `realsense`, `tof` for a camera without a baseline, `stereo` for the
            infrared pair.

    Raises:
        SourceError: there is no such camera, or another program uses it, or it has no such images, or the
            recording cannot be played.
        MissingDependency: pyrealsense2 is not installed, or the USB library that it loads.
    """

    def __init__(
        self,
        camera: str | Path | None = None,
        *,
        device: Any = None,
        images: Images = "depth",
        color: bool = True,
        size: Size = (480, 640),
        fps: int = 30,
        real_time: bool = False,
        deadline: float = 5.0,
        sensor: str | None = None,
    ) -> None:
        if images not in ("depth", "infrared"):
            raise InvalidConfig(f"images of a RealSense must be depth or infrared, got {images!r}")
        if camera is not None and device is not None:
            raise InvalidConfig("give a camera or a device of a RealSense")
        self._rs = camera_library(
            "pyrealsense2",
            "RealSense",
            "pip install '.[realsense]' in your clone of tsfusion",
            "on Debian and Ubuntu install its USB library with: apt-get install libusb-1.0-0",
        )
        camera = None if camera is None else str(camera)
        recording = Path(camera).expanduser() if camera and camera.endswith(RECORDINGS) else None
        name = f"RealSense {recording.name if recording else camera or ''}".strip()
        super().__init__(name, "realsense", deadline if recording is None else None)
        self.live, self._played = recording is None or real_time, recording is not None
        try:
            self._stream, self._color = open_stream(
                self._rs, camera=camera, recording=recording, device=device, images=images, color=color,
                size=size, fps=fps, real_time=real_time,
            )  # fmt: skip
        except RuntimeError as error:  # all that librealsense raises
            advice = f"expected a recording of librealsense at {recording}" if recording else ADVICE
            raise SourceError(f"{self.name} cannot be opened: {error}. {advice}") from error
        try:
            self._infrared = images == "infrared"
            self._prepare()
            self._motion = MotionStream(self._rs, self._stream.device, *self._profiles)
            self._accelerometer, self._gyroscope = self._motion.accelerometer, self._motion.gyroscope
        except BaseException:
            self._stream.stop()
            raise
        self.sensor = sensor or self.sensor

    def close(self) -> None:
        """Stop the camera. A blocked iteration ends within a tenth of a second."""
        super().close()
        self._motion.stop()
        self._stream.stop()

    def _wait(self, milliseconds: int) -> Any:
        return self._stream.wait(milliseconds)

    def _frame(self, images: Any) -> Frame | None:
        return self._infrared_pair(images) if self._infrared else self._depth(images)

    def _is_plugged_in(self) -> bool:
        return plugged_in(self._rs, self._stream.device)

    def _is_over(self) -> bool:
        return self._stream.over()

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
            baseline = baseline_of(self._rs, self._stream.device)
            self.sensor = "tof" if baseline is None else "realsense"
            self._align = self._rs.align(stream.color)
        self._profiles = left, shown
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
        stamps = self._stamps(depth)
        if self._color:
            aligned = self._align.process(frames)
            depth, color = (
                aligned.get_depth_frame(),
                bgr(self._rs, aligned.get_color_frame()),
            )
        image = np.array(depth.get_data())
        if self._undistorter is not None:
            image = self._undistorter.depth(image)
            color = None if color is None else self._undistorter.image(color)
        return self._taken(
            stamps, stamps[0], depth=image, color=color, intrinsics=self.intrinsics,
            depth_scale=round(depth.get_units(), 9),  # it comes in single precision
        )  # fmt: skip

    def _infrared_pair(self, frames: Any) -> Frame | None:
        left, right = frames.get_infrared_frame(1), frames.get_infrared_frame(2)
        if not self._is_complete(left, right, needed=True):
            return None
        grey = np.array(left.get_data())
        stamps = self._stamps(left)
        return self._taken(
            stamps, stamps[0], left=grey, right=np.array(right.get_data()), intrinsics=self.intrinsics,
            color=np.repeat(grey[:, :, None], 3, axis=2),
        )  # fmt: skip

    def _is_complete(self, first: Any, second: Any, *, needed: bool) -> bool:
        """Return True for a new first image with a second one of the same exposure. Count the missing images.

        A frameset may repeat an image beside the next image of the other stream.
        """
        if not first or not self._is_new(first.frame_number):
            return False
        if not needed:
            return True
        period_ms = 1000 / first.profile.fps()
        one_clock = second and first.frame_timestamp_domain == second.frame_timestamp_domain
        if not second or (one_clock and abs(first.timestamp - second.timestamp) > _MAX_SKEW * period_ms):
            self._skip("incomplete")
            return False
        return True

    def _stamps(self, frame: Any) -> tuple[int, int]:
        """Return a frameset's `timestamp_ns` and `captured_ns`."""
        stamp = round(frame.timestamp * 1e6)  # from milliseconds
        foreign = self._played or frame.frame_timestamp_domain == self._rs.timestamp_domain.hardware_clock
        captured = time.monotonic_ns() if foreign else monotonic_of(stamp, oldest_s=OLDEST_S)
        return stamp, captured


def _undistorter(profile: Any, name: str) -> Undistorter | None:
    """Return an undistorter for colour cameras with distorted images (D455, D405), or None for all others.

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
