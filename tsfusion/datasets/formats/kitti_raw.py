# SPDX-License-Identifier: MIT
"""KITTI's raw recordings: rectified stereo pairs or Velodyne scans, with poses of the GPS/IMU unit.

Calibration and GPS packets are read by pykitti's functions; files are chosen here, by the frame number in
their names: `pykitti.raw` goes by their place in a sorted list, and several drives lack some scans.
"""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import FramePoses, NoPoses, SeveralRecordings, poses_if_any, require_folder
from tsfusion.datasets.formats.kitti import (
    KITTIFrames,
    files_by_frame,
    frames_of,
    pykitti_utils,
    read_calibration,
)
from tsfusion.datasets.readers import intrinsics_of, read_numbers
from tsfusion.datasets.trajectory_files import checked_pose, usable
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform, inverse, transform

EXPECTED = "DATE/DATE_drive_NNNN_sync/{image_00..03,velodyne_points,oxts}/data and DATE/calib_*.txt"
_CAMERAS = {"grey": ("00", "01"), "color": ("02", "03")}
_PACKET = 30  # numbers of an oxts line
_ALONG = 0.9  # cosine of the angle between axes that point forward


def recognises(path: Path) -> bool:
    """True for a drive, and for a day's folder that holds drives."""
    return _is_drive(path) or bool(_drives(path))


class KITTIRaw(KITTIFrames):
    """One synchronised and rectified drive (`…_sync`) as stereo disparity or as Velodyne scans.

    https://www.cvlibs.net/datasets/kitti/raw_data.php. A frame's pose comes from the GPS/IMU packet of its
    number: east, north, up from the drive's first packet; stereo is posed at the left camera, LiDAR at the
    Velodyne. Scans are as recorded, not corrected for the car's motion.

    Args:
        path: the drive's folder, or the day's where it holds one drive.
        modality: `stereo` or `lidar`; default stereo where there are images.
        cameras: `grey` (image_00, image_01) or `color` (image_02, image_03); default grey where it is there.
        posed: leave out frames without a pose; else they are kept, with `T_world_camera` None.

    Raises:
        DatasetError: no such folder, files or calibration; an unsynchronised drive; a malformed line.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        modality: str | None = None,
        cameras: str | None = None,
        color: bool = True,
        posed: bool = True,
    ) -> None:
        if modality not in (None, "stereo", "lidar") or cameras not in (None, *_CAMERAS):
            raise DatasetError(
                "modality of KITTI raw must be stereo or lidar, cameras grey or color, "
                f"got {modality!r} and {cameras!r}"
            )
        drive = _only_drive(require_folder(path, "KITTI raw"))
        chosen = _cameras(drive, cameras)
        if modality is None:
            modality = "stereo" if (drive / f"image_{chosen[0]}").is_dir() else "lidar"
        self.name, self.sensor, self.skipped = f"KITTI raw {drive.name} {modality}", modality, {}
        sensors = [f"image_{camera}" for camera in chosen] if modality == "stereo" else ["velodyne_points"]
        files = frames_of(drive, [f"{sensor}/data" for sensor in sensors], self.skipped)
        body = poses_if_any(partial(_imu_poses, drive / "oxts" / "data", [*files]), len(files), posed=posed)
        calibration = _sensor_calibration(
            drive.parent, None if modality == "lidar" else chosen, imu=any(T is not None for T in body)
        )
        poses = [None if T is None else T @ calibration.T_imu_sensor for T in body]
        self._frames = self._keep([*files], poses, (drive, EXPECTED), posed=posed)
        self._files = [files[number] for number in self._frames]
        self._with_color = color
        self.intrinsics, self.baseline_fx = calibration.intrinsics, calibration.baseline_fx
        self._describe_camera("calib_cam_to_cam.txt")
        self.timestamps_ns = _read_times(drive / sensors[0] / "timestamps.txt", self._frames)


class _SensorCalibration(NamedTuple):
    T_imu_sensor: Transform
    intrinsics: Intrinsics | None = None
    baseline_fx: float | None = None


def _sensor_calibration(day: Path, cameras: tuple[str, str] | None, *, imu: bool) -> _SensorCalibration:
    """The pinhole model of a pair, and the place of its left camera (without `cameras`, of the Velodyne).

    Args:
        imu: whether that place is needed; without, the calibration of the GPS/IMU unit may be missing.
    """
    T_velo_imu = _rigid(day / "calib_imu_to_velo.txt", forward=0) if imu else np.eye(4)
    if cameras is None:
        return _SensorCalibration(inverse(T_velo_imu))
    T_cam0_velo = _rigid(day / "calib_velo_to_cam.txt", forward=2) if imu else np.eye(4)
    path = day / "calib_cam_to_cam.txt"
    found = read_calibration(path, {"R_rect_00": 9, **{f"P_rect_{camera}": 12 for camera in cameras}})
    left, right = (found[f"P_rect_{camera}"].reshape(3, 4) for camera in cameras)
    rectified, shift = np.eye(4), np.eye(4)
    rectified[:3, :3] = found["R_rect_00"].reshape(3, 3)
    shift[0, 3] = left[0, 3] / left[0, 0]  # the camera's place beside camera 0
    T_imu_camera = inverse(checked_pose(shift @ rectified @ T_cam0_velo @ T_velo_imu, path))
    baseline_fx = float(left[0, 3] - right[0, 3])
    if baseline_fx <= 0:
        raise DatasetError(f"{path}: P_rect_{cameras[1]} must lie to the right of P_rect_{cameras[0]}")
    return _SensorCalibration(T_imu_camera, intrinsics_of(left, path), baseline_fx)


def _is_drive(path: Path) -> bool:
    sensors = ("image_00", "image_02", "velodyne_points")
    return "_drive_" in path.name and any((path / sensor / "data").is_dir() for sensor in sensors)


def _drives(day: Path) -> list[Path]:
    return sorted(path for path in day.glob("*_drive_*") if _is_drive(path))


def _only_drive(path: Path) -> Path:
    path = path.absolute()
    drives = [path] if _is_drive(path) else _drives(path)
    if len(drives) != 1:
        names = ", ".join(drive.name for drive in drives)
        kind = SeveralRecordings if drives else DatasetError
        raise kind(f"{path} holds {len(drives)} KITTI drives ({names}); give the path of one")
    if drives[0].name.endswith("_extract"):
        raise DatasetError(
            f"{drives[0]} is not rectified; expected the drive's synchronised and rectified …_sync"
        )
    return drives[0]


def _cameras(drive: Path, cameras: str | None) -> tuple[str, str]:
    if cameras is None:
        grey = (drive / "image_00").is_dir() or not (drive / "image_02").is_dir()
        cameras = "grey" if grey else "color"
    return _CAMERAS[cameras]


def _imu_poses(place: Path, frames: list[int]) -> FramePoses:
    """T_world_imu of frames, by pykitti's Mercator projection; the first packet is the origin."""
    files = files_by_frame(place, ".txt")
    if not files:
        raise NoPoses(f"{place} has no packets (*.txt); expected {EXPECTED}")
    pykitti = pykitti_utils()
    scale, origin = None, None

    def read(file: Path) -> Transform:
        nonlocal scale, origin
        packet = pykitti.OxtsPacket(*read_numbers(file, "30 numbers of a GPS/IMU packet", columns=_PACKET)[0])
        scale = np.cos(np.radians(packet.lat)) if scale is None else scale
        R, t = pykitti.pose_from_oxts_packet(packet, scale)
        origin = t if origin is None else origin
        return checked_pose(transform(R, t - origin), file)

    poses = dict(zip(files, usable(place, files.values(), read), strict=True))
    return [poses.get(number) for number in frames]


def _rigid(path: Path, forward: int) -> Transform:
    """The transform of a file, whose axis x points along the target's axis `forward`."""
    found = read_calibration(path, {"R": 9, "T": 3})
    T = checked_pose(transform(found["R"].reshape(3, 3), found["T"]), path)
    if T[forward, 0] < _ALONG:
        raise DatasetError(f"{path} turns forward elsewhere; expected KITTI's axes (is it another's file?)")
    return T


def _read_times(path: Path, frames: list[int]) -> NDArray[np.int64] | None:
    """Nanoseconds since 1970 of each frame, by line number; None where the file is absent.

    The clock is the car's, of no zone. A scan that is missing has an empty line.
    """
    if not path.exists():
        return None
    try:
        lines = path.read_text(encoding="ascii").splitlines()
        stamps = np.array([lines[number].strip().replace(" ", "T") for number in frames], "datetime64[ns]")
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: {error}; expected `year-month-day hour:minute:second` a line") from error
    except IndexError as error:
        raise DatasetError(
            f"{path} has {len(lines)} lines, but there is a frame {frames[-1]}; expected a line a frame"
        ) from error
    if np.isnat(stamps).any():
        empty = frames[int(np.isnat(stamps).argmax())]
        raise DatasetError(f"{path}:{empty + 1} is empty, but there is a frame {empty}")
    nanoseconds: NDArray[np.int64] = stamps.astype(np.int64)
    return nanoseconds
