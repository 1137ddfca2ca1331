# SPDX-License-Identifier: MIT
"""Read recordings of an Azure Kinect: Matroska files by k4arecorder, and others with the same tracks.

https://github.com/microsoft/Azure-Kinect-Sensor-SDK, `docs/` and `src/transformation`. Orbbec's viewer for
the Femto Bolt and Mega records the same.
"""

import json
import struct
import threading
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import limits
from tsfusion.core.errors import DatasetError, InvalidConfig, needing
from tsfusion.datasets.cameras import DepthUnit, RecordedCamera
from tsfusion.datasets.dataset import SCAN, Frames, NoPoses, partners_in_time, require_frames
from tsfusion.datasets.file_names import only_file
from tsfusion.datasets.readers import decode_image
from tsfusion.geometry.calibration import Camera, Size, Undistorter
from tsfusion.geometry.depth_registration import Registration
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.inertial_sensors import Accelerometer, Gyroscope
from tsfusion.geometry.se3 import Transform, inverse, transform

EXPECTED = "an Azure Kinect's .mkv with the tracks DEPTH and COLOR and the attachment calibration.json"
_ENDINGS = (".mkv",)
# (height, width) of depth images → side of the sensor's image in their pixels, column and row of their corner
_MODES = {(576, 640): (1024, 192, 180), (288, 320): (512, 96, 90), (512, 512): (512, 0, 0)}
_MODES |= {(1024, 1024): (1024, 0, 0)}
_TOGETHER_NS = 17_000_000  # between depth and colour of one moment, at most
_IMU = struct.Struct("<Q3fQ3f")  # nanoseconds and m/s² of the accelerometer, and rad/s of the gyroscope
_ORDER = (4, 5, 13, 12, 6, 7, 8, 9)  # k1 k2 p1 p2 k3 k4 k5 k6 among the parameters of a camera


def recognises(path: Path) -> bool:
    """Return True for a Matroska file, and for a folder with one."""
    return only_file(path, _ENDINGS) is not None


class AzureKinect(Frames):
    """Depth in millimetres with colour registered to it by the recorded calibration, and no poses.

    Lens distortion is removed from both. Opening reads the recording once.

    Args:
        path: the file, or the folder that holds it.
        color: True reads colour.
        posed: True is refused, as there are no poses; a scan finds them, or `--trajectory` gives them.

    Raises:
        MissingDependency: PyAV is not installed.
        DatasetError: the file is none of an Azure Kinect, cut before its first frame, or its calibration is
            malformed.
    """

    def __init__(
        self, path: str | Path, *, color: bool = True, sensor: str = "tof", posed: bool = True
    ) -> None:
        given = Path(path).expanduser()
        self._path = only_file(given, _ENDINGS) or given
        self.name, self.sensor, self.skipped = f"Azure Kinect {self._path.name}", sensor, {}
        self._lock = threading.Lock()
        self._file, self._depth, self._color = _tracks(self._path, color)
        self._depths, self._colors = self._index()
        self.timestamps_ns = np.array(sorted(self._depths), np.int64)
        require_frames(len(self._depths), self._path, EXPECTED, self.skipped)
        self._poses = [None] * len(self._depths)
        there = sorted(self._colors)
        partners = partners_in_time(there, self.timestamps_ns, _TOGETHER_NS)
        self._colored = [None if index is None else there[index] for index in partners]
        self.uncolored = self._colored.count(None) if self._color is not None else 0
        self._calibrate(_calibration(self._file, self._path))
        if posed:
            raise NoPoses(f"{self._path} has no poses; {SCAN}")

    def __len__(self) -> int:
        return len(self._poses)

    def _index(self) -> tuple[dict[int, int], dict[int, int]]:
        """Return the images of both tracks, time in nanoseconds → stamp in the file."""
        offset = int(self._file.metadata.get("K4A_START_OFFSET_NS", 0))
        depth: dict[int, int] = {}
        color: dict[int, int] = {}
        broken, nbytes = 0, 2 * self._depth.width * self._depth.height
        accelerometer, gyroscope = self._inertial = Accelerometer(), Gyroscope()
        imu = next((track for track in self._file.streams if track.metadata.get("title") == "IMU"), None)
        for packet in self._packets(self._depth, *filter(None, [self._color, imu])):
            is_depth = packet.stream.index == self._depth.index
            if imu is not None and packet.stream.index == imu.index:
                if packet.size == _IMU.size:
                    force_ns, *force, rate_ns, x, y, z = _IMU.unpack(bytes(packet))
                    accelerometer.add(force_ns, force)
                    gyroscope.add(rate_ns, (x, y, z))
            elif is_depth and packet.size != nbytes:
                broken += 1
            elif packet.pts is not None:
                time_ns = offset + round(packet.pts * packet.time_base * 10**9)
                (depth if is_depth else color)[time_ns] = packet.pts
        if broken:
            self.skipped["of depth that are broken"] = broken
        return depth, color

    def _packets(self, *tracks: Any) -> Any:
        """Yield the packets of some tracks that have content."""
        import av

        try:
            for packet in self._file.demux(*tracks):
                if packet.size:
                    yield packet
        except (av.FFmpegError, ValueError) as error:
            raise DatasetError(f"{self._path} is damaged ({error}); expected {EXPECTED}") from error

    def _calibrate(self, said: Any) -> None:
        size = self._depth.height, self._depth.width
        try:
            depth, T_depth = _camera(said, "D0", size, _MODES.get(size))
            flat = Undistorter(depth)
            self.camera = RecordedCamera(flat.intrinsics, size, "from its calibration.json", flat)
            self.depth_unit = DepthUnit(0.001, "as an Azure Kinect records it")
            for each in said["CalibrationInformation"].get("InertialSensors", ()):
                self._place(each["SensorType"], np.array(each["Rt"]["Rotation"], np.float64))
            if self._color is not None:
                size = self._color.height, self._color.width
                high = size[1] * 3 // 4
                color, T_color = _camera(said, "PV0", size, (size[1], 0, (high - size[0]) // 2), high)
                self._seen = Undistorter(color)
                self._registration = Registration(
                    flat.intrinsics, self._seen.intrinsics, T_color @ inverse(T_depth), flat.size,
                    color_size=size,
                )  # fmt: skip
        except (KeyError, IndexError, TypeError, ValueError, StopIteration) as error:
            raise DatasetError(f"{self._path}: its calibration is malformed ({error!r})") from error

    def _place(self, kind: str, R_imu_depth: NDArray[np.float64]) -> None:
        """Use an inertial sensor whose axes the calibration tells."""
        accelerometer, gyroscope = self._inertial
        if kind.endswith("Gyro"):
            self._gyroscope, gyroscope.R_sensor_imu = gyroscope, R_imu_depth.reshape(3, 3).T
        elif kind.endswith("Accelerometer"):
            self._accelerometer, accelerometer.R_sensor_imu = accelerometer, R_imu_depth.reshape(3, 3).T

    def _content(self, track: Any, stamp: int) -> Any:
        """Return the packet of a track with a stamp."""
        with self._lock:
            self._file.seek(stamp, stream=track)
            for packet in self._packets(track):
                if packet.pts == stamp:
                    return packet
                if packet.pts is not None and packet.pts > stamp:
                    break
        raise DatasetError(f"{self._path}: the image at {stamp} cannot be found again; did the file change?")

    def _frame(self, index: int) -> Frame:
        packet = self._content(self._depth, self._depths[self._stamp(index)])
        size = self._depth.height, self._depth.width
        depth = self.camera.depth(np.frombuffer(bytes(packet), ">u2").reshape(size).astype(np.uint16))
        color, moment = None, self._colored[index]
        if moment is not None:
            image = self._seen.image(self._image(self._colors[moment]))
            color = self._registration.color_of_depth(image, depth * np.float32(0.001))
        return self._posed_frame(index, depth=depth, color=color, intrinsics=self.camera.intrinsics)

    def _image(self, stamp: int) -> NDArray[np.uint8]:
        packet = self._content(self._color, stamp)
        if self._color.codec_context.name == "mjpeg":
            image = decode_image(BytesIO(bytes(packet)), cv2.IMREAD_COLOR)
        else:
            image = next((found.to_ndarray(format="bgr24") for found in packet.decode()), None)
        if image is None or image.shape[:2] != (self._color.height, self._color.width):
            raise DatasetError(f"{self._path}: the colour image at {stamp} cannot be decoded")
        return np.asarray(image, np.uint8)


def _tracks(path: Path, with_color: bool) -> tuple[Any, Any, Any]:
    """Return the opened file, its depth track, and its colour track or None."""
    with needing(f"{path}: an .mkv needs PyAV: pip install '.[azure]'"):
        import av
    try:
        file = av.open(str(path))
    except (av.FFmpegError, ValueError) as error:
        raise DatasetError(f"{path} cannot be read ({error}); expected {EXPECTED}") from error
    named = {track.metadata.get("title", "").upper(): track for track in file.streams.video}
    if "DEPTH" not in named:
        raise DatasetError(f"{path} has no track DEPTH; expected {EXPECTED}")
    depth = named["DEPTH"]
    limits.check(path, 2 * depth.width * depth.height)
    return file, depth, named.get("COLOR") if with_color else None


def _calibration(file: Any, path: Path) -> Any:
    """Return the values of the attached calibration, or of `calibration.json` beside the file."""
    attached = (getattr(track, "data", None) for track in file.streams if track.type == "attachment")
    beside = path.with_name("calibration.json")
    content = next(filter(None, attached), None) or (beside.read_bytes() if beside.is_file() else b"")
    try:
        return json.loads(bytes(content).rstrip(b"\0"))
    except ValueError as error:
        raise DatasetError(f"{path} has no calibration ({error}); expected {EXPECTED}") from error


def _camera(
    said: Any, name: str, size: Size, mode: tuple[int, int, int] | None, high: int = 0
) -> tuple[Camera, Transform]:
    """Return a camera of the calibration in pixels of its mode, and its pose: p_camera = T @ p_rig.

    Args:
        mode: width of the sensor's whole image, and the place of the images' corner in it.
        high: height of the whole image; 0 = as its width.
    """
    cameras = said["CalibrationInformation"]["Cameras"]
    found = next(one for one in cameras if str(one["Location"]).endswith(name))
    numbers = [float(value) for value in found["Intrinsics"]["ModelParameters"]]
    if mode is None:
        raise InvalidConfig(f"no mode of depth has {size[1]}×{size[0]} pixels")
    (wide, left, top), (cx, cy, fx, fy, *_) = mode, numbers
    high = high or wide
    K = fx * wide, fy * high, cx * wide - left - 0.5, cy * high - top - 0.5
    camera = Camera.named(K, size, "radtan", [numbers[place] for place in _ORDER])
    R, t = (np.array(found["Rt"][part], np.float64) for part in ("Rotation", "Translation"))
    return camera, transform(R.reshape(3, 3), t)
