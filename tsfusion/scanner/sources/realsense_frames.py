# SPDX-License-Identifier: MIT
"""Streams of framesets from librealsense: its pipeline, or the sensors of a device in this process.

Every function raises RuntimeError where librealsense does.
"""

import threading
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import SourceError
from tsfusion.geometry.calibration import Size

Images = Literal["depth", "infrared"]

_QUEUE = 4  # framesets a syncer keeps; the oldest goes first


class RealSenseStream(Protocol):
    """Stream of framesets."""

    device: Any  # `pyrealsense2.device`

    def wait(self, milliseconds: int) -> Any:
        """Wait for the next frameset; None if there is none in time."""

    def over(self) -> bool:
        """True if no frameset will follow those that are queued."""

    def profile(self, stream: Any, index: int = -1) -> Any:
        """Video stream profile in use."""

    def stop(self) -> None:
        """Stop streaming; may be called twice and from another thread."""


class PipelineStream:
    """Camera or recording of a librealsense `config`; `real_time` is None for a camera.

    A recording stands still until the first `wait`: librealsense reads on while it starts one sensor after
    the other, and would drop what it reads for those that are not started yet.
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
        if self._resuming is None and self._playback is not None:
            # In a thread: `resume` may return only after somebody takes frames.
            self._resuming = threading.Thread(target=self._playback.resume, daemon=True)
            self._resuming.start()
        there, frames = self._pipeline.try_wait_for_frames(milliseconds)
        return frames if there else None

    def over(self) -> bool:
        if self._playback is None or self._resuming is None or self._resuming.is_alive():
            return False  # one that has not begun to play counts as stopped, too
        return bool(self._playback.current_status() == self._stopped)

    def profile(self, stream: Any, index: int = -1) -> Any:
        return self._profile.get_stream(stream, index).as_video_stream_profile()

    def stop(self) -> None:
        try:
            self._pipeline.stop()
        except RuntimeError:  # it was stopped already
            return


class DeviceStream:
    """Streams of a device, matched by librealsense's syncer.

    Args:
        wanted: (stream, index or -1) of each.
    """

    def __init__(self, rs: Any, device: Any, wanted: list[tuple[Any, int]]) -> None:
        self.device, self._syncer = device, rs.syncer(_QUEUE)
        self._sensors, self._profiles = [], []
        for sensor in device.query_sensors():
            chosen = [
                next(p for p in sensor.get_stream_profiles() if _is(p, stream, index))
                for stream, index in wanted
                if any(_is(p, stream, index) for p in sensor.get_stream_profiles())
            ]
            if chosen:
                sensor.open(chosen)
                sensor.start(self._syncer)
                self._sensors.append(sensor)
                self._profiles += chosen
        if len(self._profiles) < len(wanted):
            self.stop()
            raise RuntimeError(f"it has {len(self._profiles)} of the {len(wanted)} streams wanted")

    def wait(self, milliseconds: int) -> Any:
        there, frames = self._syncer.try_wait_for_frames(milliseconds)
        return frames if there else None

    def over(self) -> bool:
        return False

    def profile(self, stream: Any, index: int = -1) -> Any:
        return next(p for p in self._profiles if _is(p, stream, index)).as_video_stream_profile()

    def stop(self) -> None:
        while self._sensors:
            sensor = self._sensors.pop()
            sensor.stop()
            sensor.close()


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
) -> tuple[RealSenseStream, bool]:
    """Open the stream; also return whether it has colour.

    Raises:
        SourceError: there is no such camera.
    """
    found = device
    if found is None:
        found = _camera(rs, camera) if recording is None else rs.context().load_device(str(recording))
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


def baseline(rs: Any, device: Any) -> float | None:
    """Baseline of the stereo cameras, metres; None for other kinds of camera."""
    for sensor in device.query_sensors():
        if sensor.supports(rs.option.stereo_baseline):
            return abs(float(sensor.get_option(rs.option.stereo_baseline))) / 1000
    return None


def bgr(rs: Any, frame: Any) -> NDArray[np.uint8]:
    """Copy a colour frame as (H, W, 3) uint8 BGR.

    Raises:
        SourceError: a pixel format other than bgr8 and rgb8.
    """
    order = {rs.format.bgr8: 1, rs.format.rgb8: -1}.get(frame.profile.format())
    if order is None:
        raise SourceError(
            f"colour frames come as {frame.profile.format().name}, expected bgr8 or rgb8; "
            "record them as one of these"
        )
    return np.array(np.asarray(frame.get_data())[:, :, ::order], order="C")


def _camera(rs: Any, serial: str | None) -> Any:
    cameras = _cameras(rs)
    if not cameras:
        raise SourceError(
            "no RealSense camera found; expected one on a USB 3 port "
            "(`rs-enumerate-devices` lists them; on Linux librealsense's udev rules let users open them)"
        )
    if serial is not None and serial not in cameras:
        raise SourceError(f"no RealSense camera {serial}; there is {', '.join(cameras)}")
    return cameras[serial or next(iter(cameras))]


def _cameras(rs: Any) -> dict[str, Any]:
    """Connected devices by serial number."""
    key = rs.camera_info.serial_number
    return {device.get_info(key): device for device in rs.context().query_devices() if device.supports(key)}


def _has(device: Any, stream: Any) -> bool:
    return any(_is(p, stream, -1) for sensor in device.query_sensors() for p in sensor.get_stream_profiles())


def _is(profile: Any, stream: Any, index: int) -> bool:
    return profile.stream_type() == stream and index in (-1, profile.stream_index())
