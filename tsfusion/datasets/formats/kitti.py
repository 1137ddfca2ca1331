# SPDX-License-Identifier: MIT
"""Read KITTI odometry and raw: rectified stereo pairs or Velodyne scans, with poses.

Pykitti reads calibration and GPS packets; files are chosen here. Pykitti pairs files by their index in a
sorted list: one missing file would shift all later ones unnoticed. Here a file's name is its frame number,
and the frame's pose and time are on the lines of that number.
"""

from collections.abc import Mapping, Sequence
from functools import cache, partial
from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, MissingDependency
from tsfusion.datasets.cameras import RecordedCamera
from tsfusion.datasets.dataset import (
    SCAN,
    STREET,
    FramePoses,
    NoPoses,
    SeveralRecordings,
    poses_if_any,
    require_folder,
)
from tsfusion.datasets.file_names import in_order
from tsfusion.datasets.formats.image_folders import first_size
from tsfusion.datasets.readers import intrinsics_of, read_color, read_lines, read_numbers
from tsfusion.datasets.scan_files import read_scan, say_labels_are_unused
from tsfusion.datasets.stereo_pairs import AlreadyRectified, PairedImages, paired
from tsfusion.datasets.trajectory_files import checked_pose, nanoseconds, read_kitti, usable
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform, inverse, transform

EXPECTED = "sequences/NN/{calib.txt,times.txt,image_0,image_1,velodyne} and poses/NN.txt"
RAW_EXPECTED = "DATE/DATE_drive_NNNN_sync/{image_00..03,velodyne_points,oxts}/data and DATE/calib_*.txt"
_PAIRS = {"grey": ("00", "01"), "color": ("02", "03")}
_PACKET = 30  # numbers in an oxts line
_T = TypeVar("_T")
_ALONG = 0.9  # cosine of the angle between two axes that point forward, at least


def recognises(path: Path) -> bool:
    """Return True for the root of the odometry benchmark and for each of its sequences."""
    return any((path / "sequences").glob("*/calib.txt")) or _is_sequence(path)


class KITTIFrames(PairedImages):
    """Base class of both KITTI layouts: stereo pairs or Velodyne scans by frame number."""

    intrinsics: Intrinsics | None = None
    baseline_fx: float | None = None
    usual = STREET
    _frames: list[int]

    def _describe_camera(self, file: str) -> None:
        if self.intrinsics is not None and self.baseline_fx is not None:
            size = first_size([left for left, *_ in self._files], self._image)
            self.camera = RecordedCamera(self.intrinsics, size, f"from {file}")
            self._pairs = AlreadyRectified(self.intrinsics, self.baseline_fx, size)

    def __len__(self) -> int:
        return len(self._files)

    def _frame(self, index: int) -> Frame:
        if self.sensor == "lidar":
            return self._posed_frame(index, points=read_scan(self._files[index][0]).points)
        return super()._frame(index)


class KITTI(KITTIFrames):
    """One sequence as stereo disparity (`modality="stereo"`) or as Velodyne scans (`"lidar"`).

    Stereo: frames are the left camera's; disparity in 1/16 px comes from semi-global matching at each access.
    Colour is the grey image, or `image_2` if the calibration shows that it is of the left camera. LiDAR:
    points are in the Velodyne's axes (x forward, z up), with the pose inv(Tr)·P·Tr. Scans are as recorded,
    not corrected for the car's motion.

    Args:
        root: the benchmark's folder, with `sequences/` and `poses/`, or a sequence's own folder.
        sequence: "00" … "21"; default the only one with data.
        modality: default stereo if there are images.
        poses: another poses file in KITTI's format, relative to the current folder or to `root`; default
            `poses/NN.txt`.
        posed: True leaves out frames without a pose; False keeps them, with `T_world_camera` None.

    Raises:
        DatasetError: there is no such folder, file or calibration, a pair's images differ in size, or a line
            is malformed.
    """

    def __init__(
        self,
        root: str | Path,
        sequence: str | None = None,
        modality: str | None = None,
        poses: str | Path | None = None,
        *,
        color: bool = True,
        posed: bool = True,
    ) -> None:
        if modality not in (None, "stereo", "lidar"):
            raise DatasetError(f"modality of KITTI must be stereo or lidar, got {modality!r}")
        root = require_folder(root, "KITTI odometry")
        if sequence is None and _is_sequence(root):
            root, sequence = root.resolve().parents[1], root.resolve().name
        sequence = _only_sequence(root) if sequence is None else sequence
        place = require_folder(root / "sequences" / sequence, "KITTI odometry (sequences/NN)")
        if modality is None:
            modality = "stereo" if (place / "image_0").is_dir() else "lidar"
        self.name, self.sensor, self.skipped = f"KITTI {sequence} {modality}", modality, {}
        files = frames_of(
            place, ("image_0", "image_1") if modality == "stereo" else ("velodyne",), self.skipped
        )
        calibration = read_calibration(
            place / "calib.txt", dict.fromkeys(("P0", "P1") if modality == "stereo" else ("Tr",), 12)
        )
        trajectory = partial(_trajectory, root, sequence, poses, [*files])
        found = poses_if_any(trajectory, len(files), posed=posed)
        self._frames = self._keep([*files], found, (place, EXPECTED), posed=posed)
        self._files, self._colored = [files[number] for number in self._frames], {}
        self.timestamps_ns = _read_times(place / "times.txt", self._frames)
        self._with_color = color
        if modality == "stereo":
            both = [calibration[name].reshape(3, 4) for name in ("P0", "P1")]
            self.intrinsics, self.baseline_fx = _pair(place / "calib.txt", ("P0", "P1"), *both)
            if np.array_equal(calibration.get("P2", ()), calibration["P0"]):  # not in the benchmark itself
                self._colored = files_by_frame(place / "image_2", ".png")
            self._describe_camera("calib.txt")
        else:
            say_labels_are_unused(place)
            T_cam0_velo = checked_pose(calibration["Tr"].reshape(3, 4), f"{place / 'calib.txt'}: Tr")
            T_velo_cam0 = np.linalg.inv(T_cam0_velo)
            self._poses = [None if T is None else T_velo_cam0 @ T @ T_cam0_velo for T in self._poses]

    def _color(self, index: int, left: NDArray[np.uint8]) -> NDArray[np.uint8]:
        colored = self._colored.get(self._frames[index])
        return left if colored is None else read_color(colored, left.shape[:2])


def _is_sequence(path: Path) -> bool:
    return (path / "calib.txt").is_file() and path.resolve().parent.name == "sequences"


def _only_sequence(root: Path) -> str:
    places = sorted(path.parent for path in (root / "sequences").glob("*/calib.txt"))
    found = [path.name for path in places if (path / "image_0").is_dir() or (path / "velodyne").is_dir()]
    if len(found) != 1:
        raise (SeveralRecordings if found else DatasetError)(
            f"{root} holds {len(found)} KITTI sequences with data ({', '.join(found)}); "
            "name one with --sequence, or give its own path"
        )
    return found[0]


def files_by_frame(place: Path, suffix: str) -> dict[int, Path]:
    """Return the files in a folder by the frame number in their names, in order."""
    files = in_order(place.glob(f"*{suffix}"))
    for path in files:
        if not path.stem.isdigit():
            raise DatasetError(f"{path} is not named by a frame number; expected NNNNNN{suffix}")
    return {int(path.stem): path for path in files}


def frames_of(place: Path, folders: Sequence[str], skipped: dict[str, int]) -> dict[int, tuple[Path, ...]]:
    """Return the left and right image, or the scan, by frame number; count images without a partner."""
    if len(folders) == 1:
        return {number: (file,) for number, file in files_by_frame(place / folders[0], ".bin").items()}
    left, right = (files_by_frame(place / folder, ".png") for folder in folders)
    return {**paired(left, right, skipped)}


def _trajectory(root: Path, sequence: str, poses: str | Path | None, frames: list[int]) -> FramePoses:
    """Return the pose of each frame. The benchmark has no poses from sequence 11 on.

    SemanticKITTI has its own, of the same camera, in the sequence's folder.
    """
    own = root / "sequences" / sequence / "poses.txt"
    path = own if own.is_file() else root / "poses" / f"{sequence}.txt"
    if poses is not None:
        path = Path(poses) if Path(poses).is_file() else root / poses
    elif not path.exists():
        raise NoPoses(f"{path} is missing; expected 12 numbers a line; {SCAN}")
    found = read_kitti(path)
    return [found[number] if number < len(found) else None for number in frames]


@cache
def pykitti_utils() -> Any:
    """Load `pykitti.utils` without its package, which would load pandas and matplotlib: 0.3 s and 35 MB."""
    package = find_spec("pykitti")
    folders = None if package is None else package.submodule_search_locations
    spec = None if folders is None else PathFinder.find_spec("pykitti.utils", folders)
    if spec is None or spec.loader is None:
        raise MissingDependency("KITTI's layouts are read with pykitti; install it with: pip install pykitti")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def read_calibration(path: Path, wanted: dict[str, int]) -> Mapping[str, NDArray[np.float64]]:
    """Read lines of `name: numbers`. `wanted`: numbers by name; DatasetError unless as many and finite."""
    for number, line in read_lines(path, f"KITTI's calibration with the lines {', '.join(wanted)}"):
        if ":" not in line:
            raise DatasetError(f"{path}:{number}: {line!r}; expected `name: numbers`")
    try:
        found: dict[str, NDArray[np.float64]] = pykitti_utils().read_calib_file(path)
    except ValueError as error:
        raise DatasetError(f"{path}: {error}; expected `name: numbers` a line") from error
    for name, count in wanted.items():
        values = found.get(name)
        if values is None or len(values) != count or not np.isfinite(values).all():
            raise DatasetError(
                f"{path} has no usable line {name}; expected `{name}:` and {count} finite numbers"
            )
    return found


def _pair(
    path: Path, names: Sequence[str], left: NDArray[Any], right: NDArray[Any]
) -> tuple[Intrinsics, float]:
    """Return intrinsics and baseline_fx, metre · pixels, of two cameras with (3, 4) projections."""
    baseline_fx = float(left[0, 3] - right[0, 3])
    if baseline_fx <= 0:
        raise DatasetError(
            f"{path}: {names[1]} must lie to the right of {names[0]}, with a smaller number [0,3]: it is "
            f"larger by {-baseline_fx} px·m"
        )
    return intrinsics_of(left, path), baseline_fx


def _read_times(path: Path, frames: list[int]) -> NDArray[np.int64] | None:
    """Return the time of each frame, (n,) ns, on the line of its number, or None without the file."""
    if not path.exists():
        return None
    lines = read_lines(path, "seconds, one frame a line")
    return np.array(_of_frames(path, [nanoseconds(line, path, number) for number, line in lines], frames))


def _of_frames(path: Path, lines: list[_T], frames: list[int]) -> list[_T]:
    """Return the entries of some frames, from a file with one line for each frame."""
    if frames[-1] < len(lines):
        return [lines[number] for number in frames]
    raise DatasetError(
        f"{path} has {len(lines)} lines, but there is a frame {frames[-1]}; expected a line a frame"
    )


def recognises_raw(path: Path) -> bool:
    """Return True for a drive of KITTI raw, and for a day's folder that holds drives."""
    return _is_drive(path) or bool(_drives(path))


class KITTIRaw(KITTIFrames):
    """One synchronised and rectified drive (`…_sync`) as stereo disparity or as Velodyne scans.

    https://www.cvlibs.net/datasets/kitti/raw_data.php. A frame's pose comes from the GPS/IMU packet with the
    same number: east, north, up from the drive's first packet. It is the pose of the left camera, or of the
    Velodyne. Scans are as recorded, not corrected for the car's motion.

    Args:
        path: the drive's folder, or the day's folder if it holds one drive.
        modality: `stereo` or `lidar`; default stereo if there are images.
        cameras: `grey` (image_00, image_01) or `color` (image_02, image_03); default grey if it exists.
        posed: True leaves out frames without a pose; False keeps them, with `T_world_camera` None.

    Raises:
        DatasetError: there is no such folder, file or calibration, the drive is not synchronised, or a line
            is malformed.
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
        if modality not in (None, "stereo", "lidar") or cameras not in (None, *_PAIRS):
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
        T_imu_sensor, camera = _sensor_calibration(
            drive.parent, None if modality == "lidar" else chosen, imu=any(T is not None for T in body)
        )
        poses = [None if T is None else T @ T_imu_sensor for T in body]
        self._frames = self._keep([*files], poses, (drive, RAW_EXPECTED), posed=posed)
        self._files = [files[number] for number in self._frames]
        self._with_color = color
        self.intrinsics, self.baseline_fx = camera or (None, None)
        self._describe_camera("calib_cam_to_cam.txt")
        self.timestamps_ns = _read_dates(drive / sensors[0] / "timestamps.txt", self._frames)


def _sensor_calibration(
    day: Path, cameras: tuple[str, str] | None, *, imu: bool
) -> tuple[Transform, tuple[Intrinsics, float] | None]:
    """Return T_imu_sensor of a pair's left camera, and `_pair`; without `cameras` that of the Velodyne.

    Args:
        imu: True if this pose is needed. If False, the calibration of the GPS/IMU unit may be missing.
    """
    T_velo_imu = _rigid(day / "calib_imu_to_velo.txt", forward=0) if imu else np.eye(4)
    if cameras is None:
        return inverse(T_velo_imu), None
    T_cam0_velo = _rigid(day / "calib_velo_to_cam.txt", forward=2) if imu else np.eye(4)
    path, names = day / "calib_cam_to_cam.txt", [f"P_rect_{camera}" for camera in cameras]
    found = read_calibration(path, {"R_rect_00": 9, **dict.fromkeys(names, 12)})
    left, right = (found[name].reshape(3, 4) for name in names)
    rectified, shift = np.eye(4), np.eye(4)
    rectified[:3, :3] = found["R_rect_00"].reshape(3, 3)
    shift[0, 3] = left[0, 3] / left[0, 0]  # position relative to camera 0
    T_imu_camera = inverse(checked_pose(shift @ rectified @ T_cam0_velo @ T_velo_imu, path))
    return T_imu_camera, _pair(path, names, left, right)


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
    return _PAIRS[cameras]


def _imu_poses(place: Path, frames: list[int]) -> FramePoses:
    """Return T_world_imu of frames, by pykitti's Mercator projection. The first packet is the origin."""
    files = files_by_frame(place, ".txt")
    if not files:
        raise NoPoses(f"{place} has no packets (*.txt); expected {RAW_EXPECTED}")
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
    """Return a calibration file's transform; axis x must point along axis number `forward` of the target."""
    found = read_calibration(path, {"R": 9, "T": 3})
    T = checked_pose(transform(found["R"].reshape(3, 3), found["T"]), path)
    if T[forward, 0] < _ALONG:
        raise DatasetError(f"{path}: its axes are not those of KITTI's sensors; is it another file's copy?")
    return T


def _read_dates(path: Path, frames: list[int]) -> NDArray[np.int64] | None:
    """Return the time of each frame, ns since 1970, on the line of its number, or None without the file.

    The clock is the car's, in no time zone. A missing scan has an empty line.
    """
    if not path.exists():
        return None
    try:
        lines = _of_frames(path, path.read_text(encoding="ascii").splitlines(), frames)
        stamps = np.array([line.strip().replace(" ", "T") for line in lines], "datetime64[ns]")
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: {error}; expected `year-month-day hour:minute:second` a line") from error
    if np.isnat(stamps).any():
        empty = frames[int(np.isnat(stamps).argmax())]
        raise DatasetError(f"{path}:{empty + 1} is empty, but there is a frame {empty}")
    nanoseconds: NDArray[np.int64] = stamps.astype(np.int64)
    return nanoseconds
