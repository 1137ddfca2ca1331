# SPDX-License-Identifier: MIT
"""Read folders of a LiDAR's scans, one file each, from drivers, fusion programs and gtsam_points."""

import logging
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, FramePoses, NoPoses, Times
from tsfusion.datasets.file_names import in_order, in_time, numbers_in, series_of
from tsfusion.datasets.folder_frames import FolderFrames, poses_between
from tsfusion.datasets.scan_files import (
    SUFFIXES,
    USUAL_FIELDS,
    Scan,
    read_scan,
    say_labels_are_unused,
    times_on,
)
from tsfusion.datasets.trajectory_files import (
    has_times,
    read_graph,
    read_matrix,
    read_numbered,
    read_poses,
    read_timed,
)
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import are_far
from tsfusion.geometry.origin import System

EXPECTED = (
    "scans numbered or named by their times (.bin, .pcd, .ply, .las or .laz) in the folder, velodyne/, "
    "lidar/, scans/, points/ or clouds/; and poses of the LiDAR in poses.txt, *_kitti.txt, *_tum.txt, "
    "*pose*.txt, *pose*.csv or *.g2o, or with --trajectory; without, for a scan"
)
_PLACES = ("", "velodyne", "lidar", "scans", "Scans", "points", "clouds", "pcd")
_POSES = (
    "poses.txt", "*poses_kitti.txt", "*poses_tum.txt", "*_kitti.txt", "*_tum.txt", "optimized_poses.txt",
    "*[pP]ose*.txt", "*[pP]ose*.csv", "*.g2o",
)  # fmt: skip
_FEWEST = 2
_FEW_OTHERS = 4  # files of a series for each file with another name, at least
_IN_GRID = (
    "where the scanner was, in the grid of the points (--trajectory FILE): one pose a file in order, or "
    "TUM's format in the clock of the points' times (gps_time; --option time_offset_s is added to these)"
)
_LONE = "--trajectory FILE with the pose of the scan"
_TRIED = 10  # scans; the first readable one tells whether all are in a grid
_FASTEST_NS = 25_000_000  # between two scans
_COARSE = 0.01  # metres; numbers with larger steps are too coarse for points
_RUN = "run.json"  # in a folder with the meshes of a scan
_HEADER_BYTES = 1 << 14

log = logging.getLogger(__name__)
LIDAR_KEYFRAMES = "NNNNNN/points.bin (float32 x, y, z) and graph.txt (`vK tx ty tz qx qy qz qw` a line)"


class ScanFolder(FolderFrames):
    """Scans in the LiDAR's axes, each with the LiDAR's pose in the world if known.

    The layout is that of KITTI's `velodyne/`, and of folders for KISS-ICP's generic reader, with the poses
    that KISS-ICP writes. Names that are decimal seconds or nanoseconds are times. Other names only give the
    order; such scans have the times of the poses if these are as many. Points of PCD, PLY and LAS with times
    are moved to where they were measured. Clouds farther from zero than a LiDAR sees are in the frame of the
    poses, such as UTM. Each of them has a pose, or its rays start on a trajectory at the times of the points.

    Args:
        fields: float32 numbers for each point in `.bin` files, x, y and z first.
        deskew: False for points that are already corrected for the motion, though they have times.
        options: those of `FolderFrames`; default poses are `poses.txt`, `*_kitti.txt` or `*_tum.txt`.
    """

    layout, expected, sensor, guesses = "LiDAR scans", EXPECTED, "lidar", True
    _begins: Callable[[Scan], NDArray[np.float64]] | None = None  # start of rays; None = at the poses

    def __init__(
        self, path: str | Path, *, fields: int = USUAL_FIELDS, deskew: bool = True, **options: Any
    ) -> None:
        if not 3 <= fields <= 64:
            raise DatasetError(f"fields must be from 3 to 64 numbers a point, got {fields}")
        self._fields, self._deskew = fields, deskew
        super().__init__(path, **options)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return True for a folder with scans, and for a file that is a point cloud."""
        return is_cloud(path) or bool(_all_series(path))

    def _opened(self, path: str | Path, trajectory: str | Path | None) -> tuple[Path, Path | None]:
        is_lone = (whole := Path(path).expanduser()).is_file()
        root, given = super()._opened(whole.parent if is_lone else path, trajectory)
        self.expected = _LONE if is_lone else self.expected
        return (whole if is_lone else root), given

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        series = _series(root)
        say_labels_are_unused(root)
        if series.others:
            self.skipped["of another name"] = series.others
        files, times = in_time(series.files, [file.stem for file in series.files])
        first = next(filter(None, map(self._tried, files[:_TRIED])), Scan(np.zeros((0, 3))))
        self.in_world, self._named = are_far(first.points), first.system
        if self.in_world:
            self._posed, self.system, self.expected = True, first.system or System(), _IN_GRID
        return files, times

    def _recorded_poses(self, root: Path, files: list[Path]) -> FramePoses:
        return self._poses_of(_poses(root, self.expected), files)

    def _poses_of(self, path: Path, files: list[Path]) -> FramePoses:
        if self.in_world and self._times is None and has_times(path):
            self._times = self._follow(path, files)
        if self._times is None and (by_number := self._by_number(path, files)) is not None:
            return by_number
        found = super()._poses_of(path, files)
        times = read_poses(path)[0] if self._times is None else None
        if times is not None and (np.diff(times) > 0).all():  # one pose for each scan, in order
            self._times, self._offset_s = times, 0.0
            self._between = partial(poses_between, path, times, max_gap_s=self._gap_s)
        return found

    def _by_number(self, path: Path, files: list[Path]) -> FramePoses | None:
        """Return the poses of scans that are fewer than the poses, by the numbers in their names, from 0.

        Returns None if the numbers do not fit, or the poses follow each other faster than a LiDAR's scans.
        """
        poses, times = dict(read_numbered(path)), read_poses(path)[0]
        names = [numbers_in(file.stem) for file in files]
        wanted = [int(name[-1]) if name and name[-1].isdecimal() else -1 for name in names]
        fits = len(files) < len(poses) and {*wanted} <= poses.keys() and len({*wanted}) == len(wanted)
        if not fits or (times is not None and np.median(np.diff(times)) < _FASTEST_NS):
            return None
        if path.suffix != ".g2o":
            log.warning(
                "%s has %d poses for %d scans: a scan takes the pose of its number, counted from 0 (%s: %d)",
                path, len(poses), len(files), files[0].name, wanted[0],
            )  # fmt: skip
        if times is not None:
            self._times, self._offset_s = times[wanted], 0.0
        return [poses[number] for number in wanted]

    def _frame(self, index: int) -> Frame:
        scan = read_scan(self._files[index], fields=self._fields)
        return self._cloud(index, scan) if self.in_world else self._sweep(index, scan)

    def _tried(self, file: Path) -> Scan | None:
        """Return a scan, or None if it cannot be read; an error comes only when its frame is read."""
        with suppress(DatasetError):
            return read_scan(file, fields=self._fields)
        return None

    def _follow(self, path: Path, files: list[Path]) -> Times:
        """Start each ray on the trajectory at its own time; return the first time in each file, ns, -1 =
        none.

        Returns None if there is one pose for each file.
        """
        along = read_timed(path)
        if len(along.timestamps_ns) == len(files):
            return None
        along = replace(along, timestamps_ns=along.timestamps_ns - round(self._offset_s * 1e9))
        self._begins = lambda scan: along.positions(times_on(scan, along), max_gap_s=self._gap_s)
        times = (times_on(scan, along) if (scan := self._tried(file)) else np.zeros(0) for file in files)
        return np.array([np.append(each[np.isfinite(each)], -1)[0] for each in times], np.int64)

    def _cloud(self, index: int, scan: Scan) -> Frame:
        """Return a frame of points, given in the coordinates of the poses, in the LiDAR's axes."""
        file, T = self._files[index], self._poses[index]
        assert T is not None
        step = np.spacing(np.abs(scan.points[np.isfinite(scan.points)]).max(initial=0))
        if step > _COARSE:
            raise DatasetError(f"{file} has float32, here in steps of {step:.2g} m; expected float64 or LAS")
        if scan.system != self._named:
            raise DatasetError(f"{file} is in another coordinate reference system than the first cloud")
        points = se3.apply(se3.inverse(T), self._counted(scan.points))
        points[~scan.points.any(axis=1)] = np.nan  # drivers write 0, 0, 0
        if self._begins is None:
            return self._posed_frame(index, points=points)
        origins = se3.apply(se3.inverse(T), self._counted(self._begins(scan)))
        if (unknown := np.isnan(origins[:, 0])).any():
            log.warning("%s: %d points have no pose in time (--option max_gap_s)", file, unknown.sum())
            points[unknown], origins[unknown] = np.nan, 0
        return self._posed_frame(index, points=points, origins=origins)


class _Series(NamedTuple):
    """Sorted files whose names differ only in numbers, and the count of `others` with the same suffix."""

    files: list[Path]
    others: int


def _series(root: Path) -> _Series:
    """Return the scans of a folder, or the one scan of a file.

    Raises:
        DatasetError: there are none, or it is not clear which ones are meant.
    """
    found = [_Series([root], 0)] if root.is_file() else _all_series(root)
    if len(found) > 1:
        places = " and ".join(f"{one.files[0].parent}/*{one.files[0].suffix}" for one in found)
        raise DatasetError(f"{root} holds several series of scans ({places}); move the others away")
    if not found:
        raise DatasetError(f"no frames in {root}; expected {EXPECTED}")
    (series,) = found
    if _FEW_OTHERS * series.others > len(series.files):
        raise DatasetError(
            f"{series.files[0].parent} has {len(series.files)} scans named as {series.files[0].name}, and "
            f"{series.others} named otherwise; expected one series: move the others away"
        )
    return series


def _all_series(root: Path) -> list[_Series]:
    """Return the longest series of each kind of file, in each folder that may hold scans."""
    found = []
    for where in (root / place for place in _PLACES):
        if not where.is_dir() or (where / _RUN).is_file():
            continue
        files = [file for file in where.glob("[!.]*") if file.suffix.lower() in SUFFIXES]
        series = series_of(files)
        for suffix in SUFFIXES:
            ours = [one for one in series if one[0].suffix.lower() == suffix]
            longest = max(ours, key=len, default=[])
            fewest = _FEWEST if where == root else 1
            if len(longest) >= fewest and not _is_mesh(longest[0]):
                count = sum(file.suffix.lower() == suffix for file in files)
                found.append(_Series(longest, count - len(longest)))
    return found


def is_cloud(path: Path) -> bool:
    """Return True for a file that is a point cloud, by its name, and is no mesh."""
    return path.suffix.lower() in SUFFIXES and path.is_file() and not _is_mesh(path)


def clouds_in(root: Path) -> list[Path]:
    """Return the clouds of points in a folder that are surely clouds, in the order of their names."""
    if (root / _RUN).is_file():
        return []
    return [file for file in sorted(root.glob("[!.]*")) if file.suffix.lower() != ".bin" and is_cloud(file)]


def _is_mesh(file: Path) -> bool:
    """Return True for a PLY file whose header declares faces."""
    if file.suffix.lower() != ".ply":
        return False
    try:
        with file.open("rb") as opened:
            head = opened.read(_HEADER_BYTES).partition(b"end_header")[0]
    except OSError:
        return False
    return re.search(rb"^element\s+face\s+0*[1-9]", head, re.MULTILINE) is not None


def _poses(root: Path, expected: str) -> Path:
    """Return the file of poses in a folder, by preference of its name. Raises NoPoses without one."""
    named = (path for pattern in _POSES for path in sorted(root.glob(pattern)) if path.is_file())
    found = next((path for path in named if not path.name.startswith(".")), None)
    if found is None:
        raise NoPoses(f"{root} has no poses; expected {expected}" + f"; {SCAN}" * (expected != _IN_GRID))
    has_calibration = (root / "calib.txt").is_file()
    if has_calibration or root.resolve().parent.name == "sequences":
        why = "has KITTI's calib.txt" if has_calibration else "is a sequence of KITTI without calib.txt"
        raise DatasetError(
            f"{root} {why}, so {found.name} may be the camera's poses; open the benchmark's folder, which "
            "holds sequences/ with calib.txt, or name the LiDAR's poses with --trajectory"
        )
    return found


class ScanPair(ScanFolder):
    """Two scans A and B with the matrix of their relative pose, `T_A_B.txt`: p_A = T_A_B @ p_B.

    The world is that of A. Options are those of `ScanFolder`.
    """

    layout, expected = "LiDAR pair", "two scans A and B (.pcd, .ply, …) and T_A_B.txt, a 4×4 matrix"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return True for a folder with two scans and a matrix named by both."""
        return _pair(path) is not None

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        found = _pair(root)
        if found is None:
            raise DatasetError(f"{root} holds no pair; expected {self.expected}")
        self.in_world, self._named = False, None
        return [*found[1:]], None

    def _recorded_poses(self, root: Path, files: list[Path]) -> FramePoses:
        found = _pair(root)
        return [np.eye(4), read_matrix(found[0])] if found is not None else []


def _pair(root: Path) -> tuple[Path, Path, Path] | None:
    """Return the matrix and both scans of a folder with a pair, or None."""
    clouds = {file.stem: file for file in root.glob("[!.]*") if is_cloud(file)} if root.is_dir() else {}
    if len(clouds) != 2:
        return None
    (one, first), (other, second) = clouds.items()
    names = {f"T_{one}_{other}": (first, second), f"T_{other}_{one}": (second, first)}
    matrix = next((file for file in root.glob("T_*.txt") if file.stem in names), None)
    return None if matrix is None else (matrix, *names[matrix.stem])


class LidarDump(FolderFrames):
    """Clouds in the LiDAR's axes, each with its pose in the world.

    https://github.com/koide3/gtsam_points, `data/kitti_07_dump`. Folder K belongs to line `vK`; other lines
    (edges) are ignored. No timestamps. Options are those of `FolderFrames`.
    """

    layout, expected, sensor = "LiDAR keyframes", LIDAR_KEYFRAMES, "lidar"
    signs = (("[0-9]*/points.bin",),)
    quaternions = True

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        files = in_order(root.glob("*/points.bin"))
        return [file for file in files if file.parent.name.isdecimal()], None

    def _recorded_poses(self, root: Path, files: list[Path]) -> FramePoses:
        path = root / "graph.txt"
        if not path.exists():
            raise NoPoses(f"{path} is missing; expected {LIDAR_KEYFRAMES}; {SCAN}")
        numbered = dict(read_graph(path))
        return [numbered.get(int(file.parent.name)) for file in files]

    def _frame(self, index: int) -> Frame:
        return self._posed_frame(index, points=read_scan(self._files[index], fields=3).points)
