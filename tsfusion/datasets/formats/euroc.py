# SPDX-License-Identifier: MIT
"""Read EuRoC drone recordings, and others in the ASL layout: stereo pairs with poses of the body."""

from pathlib import Path
from typing import Any

import numpy as np

from tsfusion.core.errors import DatasetError, InvalidConfig, InvalidKeyframe, errors_as
from tsfusion.datasets.cameras import RecordedCamera
from tsfusion.datasets.dataset import (
    NO_HALF,
    NO_POSE_IN_TIME,
    SCAN,
    FramePoses,
    NoPoses,
    Times,
    partners_in_time,
)
from tsfusion.datasets.folder_frames import FolderFrames
from tsfusion.datasets.readers import listed_file, read_lines
from tsfusion.datasets.stereo_pairs import PairedImages
from tsfusion.datasets.trajectory_files import read_euroc, read_table
from tsfusion.geometry.calibration import Rectifier
from tsfusion.geometry.calibration_files import read_rig, read_tree
from tsfusion.geometry.inertial_sensors import Accelerometer, Gyroscope
from tsfusion.geometry.keyframe import check_pose
from tsfusion.geometry.se3 import Transform

EXPECTED = "mav0/{cam0,cam1}/{data.csv,sensor.yaml,data/*.png} and mav0/state_groundtruth_estimate0/data.csv"
_TRUTH = "state_groundtruth_estimate0/data.csv"


class EuRoC(PairedImages, FolderFrames):
    """Stereo pairs in the ASL layout, undistorted and rectified by `sensor.yaml`.

    https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets. Frames are grey pairs in the
    axes of the rectified left camera, with `radial-tangential` or `equidistant` lenses. The ground truth is
    of the body. A frame's pose is T_world_body · T_BS · T_cam0_rectified, interpolated at the left image's
    stamp. Images without a partner (not listed, or listed but missing) are left out and counted.

    Args:
        path: the sequence's folder (it holds `mav0`), or `mav0`.
        max_difference_s: between the two stamps of a pair, seconds.
        options: those of `FolderFrames`.

    Raises:
        DatasetError: there is no such folder, there are no pairs, a line is malformed, or the calibration
            cannot be used.
    """

    layout, expected, sensor = "EuRoC", EXPECTED, "stereo"
    signs = (("mav0/cam0/data.csv", "cam0/data.csv"),)
    quaternions = True

    def __init__(
        self, path: str | Path, *, max_difference_s: float = 0.002, color: bool = True, **options: Any
    ) -> None:
        self._max_difference_ns, self._with_color = round(max_difference_s * 1e9), color
        super().__init__(path, **options)
        self.name = f"EuRoC {self._place.absolute().parent.name}"
        self._accelerometer, self._gyroscope = _inertial(self._place, self._T_body_camera)

    def _list(self, root: Path) -> tuple[list[tuple[Path, Path]], Times]:
        self._place = place = root / "mav0" if (root / "mav0").is_dir() else root
        pairs = _pairs(place, self._max_difference_ns, self.skipped)
        rectifier, self._T_body_camera = _calibrated(place)
        self._pairs, self.intrinsics = rectifier, rectifier.intrinsics
        self.camera = RecordedCamera(self.intrinsics, rectifier.size, "from sensor.yaml, rectified")
        return [pair[1:] for pair in pairs], np.array([stamp for stamp, _, _ in pairs], np.int64)

    def _recorded_poses(self, root: Path, files: object) -> FramePoses:
        path = self._place / _TRUTH
        if not path.exists():
            raise NoPoses(f"{path} is missing; expected `ns,px,py,pz,qw,qx,qy,qz,…` a line; {SCAN}")
        trajectory, self._why = read_euroc(path), NO_POSE_IN_TIME
        gap_ns, offset_ns = round(self._gap_s * 1e9), round(self._offset_s * 1e9)
        assert self._times is not None
        found = (trajectory.at(int(stamp) + offset_ns, max_gap_ns=gap_ns) for stamp in self._times)
        return [None if T is None else T @ self._T_body_camera for T in found]


def _pairs(place: Path, max_difference_ns: int, skipped: dict[str, int]) -> list[tuple[int, Path, Path]]:
    """Return (left stamp in ns, left, right) of images near in time; each right image is used once."""
    left, right = (_listed(place / camera) for camera in ("cam0", "cam1"))
    stamps, others = ([stamp for stamp, _ in images] for images in (left, right))
    pairs: dict[int, tuple[int, Path, Path]] = {}
    for (stamp, file), index in zip(left, partners_in_time(others, stamps, max_difference_ns), strict=True):
        if index is not None:
            pairs.setdefault(index, (stamp, file, right[index][1]))
    there = [pair for pair in pairs.values() if pair[1].is_file() and pair[2].is_file()]
    alone = max(len(left), len(right)) - len(there)
    if alone:
        skipped[NO_HALF] = alone
    return there


def _listed(camera: Path) -> list[tuple[int, Path]]:
    path, content = camera / "data.csv", "`ns,file` a line"
    images = []
    for number, line in read_lines(path, content):
        words = [word.strip() for word in line.split(",")]
        if len(words) != 2 or not words[0].isdecimal() or int(words[0]) >= 2**63:
            raise DatasetError(f"{path}:{number}: {line!r}; expected {content}")
        images.append((int(words[0]), listed_file(camera / "data", words[1])))
    return sorted(images)


def _calibrated(place: Path) -> tuple[Rectifier, Transform]:
    """Return the rectifier of the pair, and T_body_rectified of the left camera."""
    files = [place / camera / "sensor.yaml" for camera in ("cam0", "cam1")]
    for file in files:
        if file.is_file() and "distortion_model" not in read_tree(file):
            raise DatasetError(f"{file} has no distortion_model (is it cut?); rectified images have `none`")
    with errors_as(DatasetError, f"{files[0]} and cam1's", InvalidConfig):
        rectifier = Rectifier(read_rig(*files))
    return rectifier, _on_body(files[0]) @ rectifier.T_left_rectified


def _on_body(file: Path) -> Transform:
    """Return T_BS of a `sensor.yaml`: the sensor's pose in the body's axes."""
    with errors_as(
        DatasetError, f"{file}: T_BS", InvalidConfig, InvalidKeyframe, KeyError, TypeError, ValueError
    ):
        T_BS = np.array(read_tree(file)["T_BS"]["data"], dtype=np.float64)
        return check_pose(T_BS.reshape(4, 4))


def _inertial(place: Path, T_body_camera: Transform) -> tuple[Accelerometer, Gyroscope]:
    """Return the sensors of `imu0`, empty without it."""
    sensor = place / "imu0" / "sensor.yaml"
    R_body_imu = _on_body(sensor)[:3, :3] if sensor.is_file() else np.eye(3)
    table, content = place / "imu0" / "data.csv", "`ns,wx,wy,wz,ax,ay,az` a line"
    R_camera_imu = T_body_camera[:3, :3].T @ R_body_imu
    return (
        read_table(Accelerometer(R_camera_imu), table, content, separator=",", first=4),
        read_table(Gyroscope(R_camera_imu), table, content, separator=",", first=1),
    )
