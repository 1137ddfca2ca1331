# SPDX-License-Identifier: MIT
"""Read OAK-D and Orbbec cameras: depth registered to colour, through depthai and pyorbbecsdk."""

import os
import time
from abc import abstractmethod
from datetime import timedelta
from typing import Any

import numpy as np

from tsfusion.core.errors import SourceError
from tsfusion.geometry.calibration import Camera, Size, Undistorter
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.inertial_sensors import Gyroscope
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources.camera_source import (
    ADVICE,
    OLDEST_S,
    CameraSource,
    camera_library,
    chosen_camera,
)
from tsfusion.scanner.sources.source import monotonic_of

_QUEUE = 4  # exposures that are kept; the oldest is dropped
_STEREO_SIZE = 640, 400  # width and height of the images of an OAK's stereo pair
_GYROSCOPE_HZ = 200
_MILLI = 1e-3


class DepthCamera(CameraSource):
    """A camera whose maker's library gives depth and colour of one exposure.

    Args:
        camera: serial number (of an OAK also its address); by default the first camera found.
        size: (height, width) of its images.
        fps: frames a second.
        deadline: seconds without a frame after which it counts as stopped.
        sensor: sensor model; default `realsense` for stereo, `tof` for a camera without a baseline.

    Raises:
        SourceError: there is no such camera, or another program uses it, or it has no such images.
        MissingDependency: the library is not installed.
    """

    kind = ""
    _pipeline: Any

    def __init__(
        self,
        camera: str | None = None,
        *,
        size: Size = (480, 640),
        fps: int = 30,
        deadline: float = 5.0,
        sensor: str | None = None,
    ) -> None:
        super().__init__(f"{self.kind} {camera or ''}".strip(), "realsense", deadline)
        self._load()
        try:
            self._open(camera, size, fps)
        except self.failures as error:
            raise SourceError(f"{self.name} cannot be opened: {error}. {ADVICE}") from error
        self.sensor = sensor or ("tof" if self.baseline_fx is None else "realsense")

    @abstractmethod
    def _load(self) -> None:
        """Load the library."""

    @abstractmethod
    def _open(self, camera: str | None, size: Size, fps: int) -> None:
        """Start the camera, and read its baseline."""

    def close(self) -> None:
        """Stop the camera. A blocked iteration ends within a tenth of a second."""
        super().close()
        self._pipeline.stop()

    def _check_sizes(self, depth: tuple[int, ...], color: tuple[int, ...]) -> None:
        if depth != color:
            raise SourceError(f"{self.name} gives depth {depth} and colour {color}; choose another size")


class OakD(DepthCamera):
    """Frames of one OAK-D of Luxonis; see `DepthCamera`. Its stereo depth is made on the camera."""

    kind = "OAK"

    def _load(self) -> None:
        os.environ.setdefault("DEPTHAI_LEVEL", "off")  # it logs to stdout, and raises what is wrong
        self._dai = camera_library("depthai", "OAK-D", "pip install '.[oak]' in your clone of tsfusion")
        self.failures = RuntimeError, self._dai.MessageQueue.QueueException

    def _open(self, camera: str | None, size: Size, fps: int) -> None:
        dai = self._dai
        if camera is not None and "." in camera:  # an address on the network, where nobody looks by itself
            place = dai.DeviceInfo(camera)
        else:
            place = chosen_camera(
                self.kind, camera, {one.deviceId: one for one in dai.Device.getAllAvailableDevices()}
            )
        self._device = dai.Device(place)
        self._pipeline = dai.Pipeline(self._device)
        self._queue = oak_streams(dai, self._pipeline, self._device.getPlatform(), size, fps)
        if self._device.getConnectedIMU() not in ("", "NONE"):
            self._gyroscope = oak_gyroscope(dai, self._pipeline, self._device.readCalibration())
        left, right, unit = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C, dai.LengthUnit.METER
        calibration = self._device.readCalibration()
        fx = calibration.getCameraIntrinsics(left, *_STEREO_SIZE)[0][0]
        self.baseline_fx = fx * abs(calibration.getBaselineDistance(left, right, unit=unit))
        self._pipeline.start()

    def _wait(self, milliseconds: int) -> Any:
        return self._queue.get(timedelta(milliseconds=milliseconds))

    def _is_plugged_in(self) -> bool:
        return not self._device.isClosed()

    def _frame(self, images: Any) -> Frame | None:
        depth, color = images["depth"], images["color"]
        if not self._is_new(depth.getSequenceNum()):
            return None
        image, bgr = np.array(depth.getFrame()), color.getCvFrame()
        self._check_sizes(image.shape, bgr.shape[:2])
        K = color.getTransformation().getIntrinsicMatrix()
        captured_ns = round(depth.getTimestamp().total_seconds() * 1e9)  # of the host's monotonic clock
        return self._taken(
            (time.time_ns() - time.monotonic_ns() + captured_ns, captured_ns), captured_ns,
            depth=image, depth_scale=_MILLI, color=bgr,
            intrinsics=Intrinsics(K[0][0], K[1][1], K[0][2], K[1][2]),
        )  # fmt: skip


def oak_gyroscope(dai: Any, pipeline: Any, calibration: Any) -> Gyroscope:
    """Add to an OAK's pipeline its gyroscope, on the host's monotonic clock; empty if its axes are unknown.

    The accelerometer is left out, as many cameras state wrong axes. Localizers notice these of a gyroscope.
    """
    found = Gyroscope(live=True)
    try:
        T_color_imu = np.array(calibration.getImuToCameraExtrinsics(dai.CameraBoardSocket.CAM_A))
    except RuntimeError:
        return found
    found.R_sensor_imu = T_color_imu[:3, :3]

    def add(message: Any) -> None:
        for rate in (packet.gyroscope for packet in message.packets):
            found.add(round(rate.getTimestamp().total_seconds() * 1e9), (rate.x, rate.y, rate.z))

    imu = pipeline.create(dai.node.IMU)
    imu.enableIMUSensor(dai.IMUSensor.GYROSCOPE_RAW, _GYROSCOPE_HZ)
    imu.setBatchReportThreshold(1)
    imu.out.createOutputQueue(maxSize=_QUEUE, blocking=False).addCallback(add)
    return found


def oak_streams(dai: Any, pipeline: Any, platform: Any, size: Size, fps: int) -> Any:
    """Add to an OAK's pipeline depth and undistorted colour of one exposure; return the queue of both."""
    width, height = size[1], size[0]
    sockets, node = dai.CameraBoardSocket, dai.node
    color = (
        pipeline.create(node.Camera)
        .build(sockets.CAM_A)
        .requestOutput((width, height), dai.ImgFrame.Type.BGR888i, fps=fps, enableUndistortion=True)
    )
    left, right = (
        pipeline.create(node.Camera).build(socket).requestOutput(_STEREO_SIZE, fps=fps)
        for socket in (sockets.CAM_B, sockets.CAM_C)
    )
    stereo = pipeline.create(node.StereoDepth).build(left, right)
    stereo.setLeftRightCheck(True)
    stereo.setSubpixel(True)
    sync = pipeline.create(node.Sync)
    sync.setSyncThreshold(timedelta(seconds=0.5 / fps))
    if platform == dai.Platform.RVC4:  # whose StereoDepth does not align
        align = pipeline.create(node.ImageAlign)
        stereo.depth.link(align.input)
        color.link(align.inputAlignTo)
        align.outputAligned.link(sync.inputs["depth"])
    else:
        stereo.setOutputSize(width, height)
        color.link(stereo.inputAlignTo)
        stereo.depth.link(sync.inputs["depth"])
    color.link(sync.inputs["color"])
    return sync.out.createOutputQueue(maxSize=_QUEUE, blocking=False)


class Orbbec(DepthCamera):
    """Frames of one Orbbec camera (Gemini, Femto, Astra); see `DepthCamera`."""

    kind = "Orbbec"

    def _load(self) -> None:
        self._ob = camera_library(
            "pyorbbecsdk",
            "Orbbec",
            "pip install --no-deps pyorbbecsdk2 (its pinned NumPy is older than ours)",
        )
        self.failures = RuntimeError, self._ob.OBError

    def _open(self, camera: str | None, size: Size, fps: int) -> None:
        ob = self._ob
        ob.Context.set_logger_to_file(ob.OBLogLevel.NONE, "")  # else it makes a folder where it is started
        ob.Context.set_logger_to_console(ob.OBLogLevel.NONE)
        self._context = ob.Context()
        device = chosen_camera(self.kind, camera, self._devices())
        self._serial = device.get_device_info().get_serial_number()
        self._pipeline = ob.Pipeline(device)
        colors = self._pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR)
        depths = self._pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
        color = colors.get_video_stream_profile(size[1], size[0], ob.OBFormat.RGB, fps)
        depth = depths.get_video_stream_profile(0, 0, ob.OBFormat.Y16, fps)
        config = ob.Config()
        config.enable_stream(color)
        config.enable_stream(depth)
        config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
        self._align = ob.AlignFilter(align_to_stream=ob.OBStreamType.COLOR_STREAM)
        shown = orbbec_camera(color.get_intrinsic(), color.get_distortion(), size)
        self._undistorter = None if shown.is_pinhole else Undistorter(shown)
        self._intrinsics = (self._undistorter or shown).intrinsics
        baseline = abs(float(device.get_baseline().baseline))
        self.baseline_fx = baseline * _MILLI * depth.get_intrinsic().fx if baseline else None
        self._pipeline.enable_frame_sync()
        self._pipeline.start(config)

    def _devices(self) -> dict[str, Any]:
        """Connected cameras by serial number."""
        found = self._context.query_devices()
        devices = [found.get_device_by_index(index) for index in range(found.get_count())]
        return {one.get_device_info().get_serial_number(): one for one in devices}

    def _wait(self, milliseconds: int) -> Any:
        return self._pipeline.wait_for_frames(milliseconds)

    def _is_plugged_in(self) -> bool:
        return self._serial in self._devices()

    def _frame(self, images: Any) -> Frame | None:
        if not self._is_new(images.get_depth_frame().get_index()):
            return None
        aligned = self._align.process(images)
        aligned = None if aligned is None else aligned.as_frame_set()
        depth, color = (
            (None, None) if aligned is None else (aligned.get_depth_frame(), aligned.get_color_frame())
        )
        if depth is None or color is None:
            self._skip("incomplete")
            return None
        shape = depth.get_height(), depth.get_width()
        self._check_sizes(shape, (color.get_height(), color.get_width()))
        image = np.array(depth.get_data()).view(np.uint16).reshape(shape)
        bgr = np.ascontiguousarray(np.array(color.get_data()).reshape(*shape, 3)[:, :, ::-1])
        if self._undistorter is not None:
            image, bgr = self._undistorter.depth(image), self._undistorter.image(bgr)
        stamp_ns = depth.get_system_timestamp_us() * 1000
        return self._taken(
            (stamp_ns, monotonic_of(stamp_ns, oldest_s=OLDEST_S)), stamp_ns,
            depth=image, color=bgr, intrinsics=self._intrinsics,
            depth_scale=round(depth.get_depth_scale() * _MILLI, 9),  # it comes in single precision
        )  # fmt: skip


def orbbec_camera(camera: Any, lens: Any, size: Size) -> Camera:
    """Return the colour camera of an Orbbec, of its `OBCameraIntrinsic` and `OBCameraDistortion`."""
    K = camera.fx, camera.fy, camera.cx, camera.cy
    if lens.model.name == "KANNALA_BRANDT4":
        return Camera.named(K, size, "equidistant", (lens.k1, lens.k2, lens.k3, lens.k4))
    radial = lens.k3, lens.k4, lens.k5, lens.k6
    return Camera.named(K, size, "radtan", (lens.k1, lens.k2, lens.p1, lens.p2, *radial))
