# SPDX-License-Identifier: MIT
"""TUM RGB-D recordings, and what shares their layout: CoRBS (pre-registered) and ICL-NUIM."""

import re
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.base import (
    Frames,
    checked_intrinsics,
    folder,
    read_color,
    read_depth,
    read_intrinsics,
    read_lines,
    require_frames,
)
from tsfusion.datasets.poses import Pose, nanoseconds, read_tum
from tsfusion.errors import DatasetError
from tsfusion.frame import Frame
from tsfusion.keyframe import Intrinsics

EXPECTED = "depth.txt, groundtruth.txt and the images that depth.txt and rgb.txt list"
DEPTH_SCALE = 1 / 5000  # metres per unit
CALIBRATED_SIZE = (480, 640)  # height, width of the cameras below


@dataclass(frozen=True)
class _Camera:
    """Cameras of published recordings, told by the folder's name."""

    name: str
    folder: str  # regular expression, searched in the last two folder names
    intrinsics: Intrinsics
    sensor: str = "kinect"


_CORBS = _Camera(
    "CoRBS", r"corbs|pre[-_]?registered", Intrinsics(468.60, 468.61, 318.27, 243.99), sensor="tof"
)
_CAMERAS = (
    _CORBS,
    _Camera("ICL-NUIM", r"icl[-_]?nuim|(living|office)_room_traj", Intrinsics(481.2, -480.0, 319.5, 239.5)),
    _Camera("TUM", r"freiburg1", Intrinsics(517.3, 516.5, 318.6, 255.3)),
    _Camera("TUM", r"freiburg2", Intrinsics(520.9, 521.0, 325.1, 249.7)),
    _Camera("TUM", r"freiburg3", Intrinsics(535.4, 539.2, 320.1, 247.6)),
)
_UNKNOWN = _Camera("TUM", "", Intrinsics(525.0, 525.0, 319.5, 239.5))  # the benchmark's ROS default


def recognises(path: Path) -> bool:
    """Whether the folder has `depth.txt`."""
    return (path / "depth.txt").is_file()


class TUM(Frames):
    """Lists of time-stamped images and a trajectory, associated by time.

    Reads the benchmark's lists (`timestamp path`) and CoRBS's (backslashes, CRLF). Each depth image takes
    the nearest colour image and the pose interpolated at its own time; depth images without a pose are
    skipped and counted, those without a colour image are kept and counted in `uncolored`.

    Args:
        path: folder with `depth.txt`.
        trajectory: default `groundtruth.txt` in the folder, or in a sibling `*_Trajectory` folder (CoRBS).
        intrinsics: default `camera-intrinsics.txt` or `K.txt` in the folder; else by the folder's name
            (freiburg1-3, CoRBS, ICL-NUIM, scaled to the image size); else the benchmark's ROS default.
        depth_scale: metres per unit.
        max_difference_s: between a depth image and its colour image, seconds.
        max_gap_s: between the two poses interpolated, seconds; across a longer gap there is no pose.

    Raises:
        DatasetError: no such folder, no frames, a listed image is missing, a malformed line.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        trajectory: str | Path | None = None,
        intrinsics: Intrinsics | None = None,
        depth_scale: float = DEPTH_SCALE,
        max_difference_s: float = 0.02,
        max_gap_s: float = 0.1,
        sensor: str | None = None,
        color: bool = True,
    ) -> None:
        root = folder(path, "TUM RGB-D")
        listed, windows = _read_list(root / "depth.txt")
        camera = _camera(root, windows)
        self.name = f"{camera.name} {root.name}"
        self.sensor = sensor or camera.sensor
        self.depth_scale = depth_scale
        self.skipped: dict[str, int] = {}
        self._depth, self._poses, self.timestamps_ns = self._associate_poses(
            listed, _trajectory(root, trajectory), round(max_gap_s * 1e9)
        )
        require_frames(len(self._depth), root, EXPECTED, self.skipped)
        self._color = (
            _associate_color(root, self.timestamps_ns, round(max_difference_s * 1e9)) if color else []
        )
        self.uncolored = self._color.count(None)
        self.intrinsics = checked_intrinsics(
            intrinsics or _intrinsics(root, camera, read_depth(self._depth[0]).shape), "intrinsics"
        )

    def __len__(self) -> int:
        return len(self._depth)

    def _frame(self, index: int) -> Frame:
        depth = read_depth(self._depth[index])
        color = self._color[index] if self._color else None
        return Frame(
            depth=depth,
            depth_scale=self.depth_scale,
            color=None if color is None else read_color(color, depth.shape),
            intrinsics=self.intrinsics,
            T_world_camera=self._poses[index],
            sensor=self.sensor,
            timestamp_ns=self._stamp(index),
        )

    def _associate_poses(
        self, listed: list[tuple[int, Path]], trajectory: Path, max_gap_ns: int
    ) -> tuple[list[Path], list[Pose], NDArray[np.int64]]:
        poses = read_tum(trajectory)
        found = [(stamp, path, poses.at(stamp, max_gap_ns=max_gap_ns)) for stamp, path in listed]
        kept = [(stamp, path, pose) for stamp, path, pose in found if pose is not None]
        if len(kept) < len(found):
            self.skipped["without a pose in time"] = len(found) - len(kept)
        stamps = np.array([stamp for stamp, _, _ in kept], dtype=np.int64)
        return [path for _, path, _ in kept], [pose for _, _, pose in kept], stamps


def _associate_color(root: Path, stamps_ns: NDArray[np.int64], max_difference_ns: int) -> list[Path | None]:
    """The nearest colour image of each depth image, None where it is too far in time."""
    if not (root / "rgb.txt").exists():
        return []
    listed, _ = _read_list(root / "rgb.txt")
    stamps = np.array([stamp for stamp, _ in listed], dtype=np.int64)
    nearest = [int(np.abs(stamps - stamp).argmin()) for stamp in stamps_ns]
    near = np.abs(stamps[nearest] - stamps_ns) <= max_difference_ns
    return [listed[i][1] if ok else None for i, ok in zip(nearest, near, strict=True)]


def _read_list(path: Path) -> tuple[list[tuple[int, Path]], bool]:
    """(timestamp_ns, image) in time order, and whether the paths were Windows paths."""
    content = "`timestamp path` a line"
    images: list[tuple[int, Path]] = []
    windows = False
    for number, line in read_lines(path, content):
        words = line.split(maxsplit=1)
        if len(words) != 2:
            raise DatasetError(f"{path}:{number}: {line!r}; expected {content}")
        windows |= "\\" in words[1]
        relative = PureWindowsPath(words[1]).as_posix()
        images.append((nanoseconds(words[0], path, number), path.parent / relative))
    if not images:
        raise DatasetError(f"{path} lists no images; expected {content}")
    missing = [image for _, image in images if not image.is_file()]
    if missing:
        raise DatasetError(
            f"{missing[0]} is missing ({len(missing)} of {len(images)} images that {path} lists)"
        )
    return sorted(images), windows


def _trajectory(root: Path, given: str | Path | None) -> Path:
    if given is not None:
        return Path(given) if Path(given).exists() else root / given
    beside = sorted(root.parent.glob("*_Trajectory/groundtruth.txt"))
    # Several CoRBS recordings side by side: D1_pre_registereddata belongs to D1_Trajectory.
    beside = [path for path in beside if path.parent.name.split("_")[0] == root.name.split("_")[0]]
    found = [path for path in (root / "groundtruth.txt", *beside) if path.is_file()]
    if not found:
        raise DatasetError(
            f"{root / 'groundtruth.txt'} is missing; expected `timestamp tx ty tz qx qy qz qw` a line "
            "(one elsewhere: open_dataset(path, trajectory=FILE) in Python)"
        )
    return found[0]


def _camera(root: Path, windows: bool) -> _Camera:
    names = "/".join(root.resolve().parts[-2:]).lower()
    for camera in _CAMERAS:
        if re.search(camera.folder, names):
            return camera
    return _CORBS if windows else _UNKNOWN


def _intrinsics(root: Path, camera: _Camera, shape: tuple[int, ...]) -> Intrinsics:
    for name in ("camera-intrinsics.txt", "K.txt"):
        if (root / name).exists():
            return read_intrinsics(root / name)
    scale = shape[1] / CALIBRATED_SIZE[1]
    if shape[0] / CALIBRATED_SIZE[0] != scale:
        raise DatasetError(
            f"{root} has depth images of {shape[1]}×{shape[0]}, but the {camera.name} camera is known for "
            "640×480 only; expected that shape, or a 3×3 matrix in camera-intrinsics.txt"
        )
    return camera.intrinsics.scaled(scale)
