# SPDX-License-Identifier: MIT
"""Folders of a LiDAR's scans, one file each: what drivers record, and what other fusion programs read."""

import logging
import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, NoPoses, Poses, Times
from tsfusion.datasets.file_names import in_time, series_of
from tsfusion.datasets.folder_frames import FolderFrames
from tsfusion.datasets.given_trajectory import poses_between
from tsfusion.datasets.scan_files import SUFFIXES, USUAL_FIELDS, read_scan
from tsfusion.datasets.trajectory_files import read_poses
from tsfusion.geometry.frame import Frame

EXPECTED = (
    "scans numbered or named by their times (.bin, .pcd, .ply, .las or .laz) in the folder, velodyne/, "
    "lidar/, scans/, points/ or clouds/; and poses of the LiDAR in poses.txt, *_kitti.txt or *_tum.txt, or "
    "with --trajectory; without, for a scan"
)
_PLACES = ("", "velodyne", "lidar", "scans", "points", "clouds")
_POSES = ("poses.txt", "*poses_kitti.txt", "*poses_tum.txt", "*_kitti.txt", "*_tum.txt")
_FEWEST = 2
_FEW_OTHERS = 4  # files of a series for each of another name, at least
_RUN = "run.json"  # beside the meshes of a scan
_HEADER_BYTES = 1 << 14

log = logging.getLogger(__name__)


def recognises(path: Path) -> bool:
    """Whether the folder has scans."""
    return bool(_all_series(path))


class ScanFolder(FolderFrames):
    """Scans in the LiDAR's axes, each with the LiDAR's pose in the world's where one is known.

    The layout of KITTI's `velodyne/`, and of the folders that KISS-ICP's generic reader takes, with the poses
    that it writes. Names that are decimal seconds or nanoseconds are times; others only give the order, and
    scans have the times of as many poses. Points of PCD, PLY and LAS with times are put where they were then.

    Args:
        fields: float32 numbers a point in `.bin` files, x, y and z first.
        deskew: False for points that are put right already, though they have times.
        options: those of `FolderFrames`; default poses are `poses.txt`, `*_kitti.txt` or `*_tum.txt`.
    """

    layout, expected, sensor, guesses = "LiDAR scans", EXPECTED, "lidar", True

    def __init__(
        self, path: str | Path, *, fields: int = USUAL_FIELDS, deskew: bool = True, **options: Any
    ) -> None:
        if not 3 <= fields <= 64:
            raise DatasetError(f"fields must be from 3 to 64 numbers a point, got {fields}")
        self._fields, self._deskew = fields, deskew
        super().__init__(path, **options)

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        series = _series(root)
        if series.others:
            self.skipped["of another name"] = series.others
        return in_time(series.files, [file.stem for file in series.files])

    def _recorded_poses(self, root: Path, files: list[Path]) -> Poses:
        return self._poses_of(_poses(root), files)

    def _poses_of(self, path: Path, files: list[Path]) -> Poses:
        found = super()._poses_of(path, files)
        times = read_poses(path)[0] if self._times is None else None
        if times is not None and (np.diff(times) > 0).all():  # one pose a scan, in order
            self._times, self._offset_s = times, 0.0
            self._between = partial(poses_between, path, times, max_gap_s=self._gap_s)
        return found

    def _frame(self, index: int) -> Frame:
        return self._sweep(index, read_scan(self._files[index], fields=self._fields))


class _Series(NamedTuple):
    """Files of a name but for its numbers, in their order; and how many of their kind have another name."""

    files: list[Path]
    others: int


def _series(root: Path) -> _Series:
    """The scans of a folder.

    Raises:
        DatasetError: there are none, or which ones are meant is not clear.
    """
    found = _all_series(root)
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
    """The longest series of each kind of file in each place where scans may be."""
    found = []
    for where in (root / place for place in _PLACES):
        if not where.is_dir() or (where / _RUN).is_file():
            continue
        files = [file for file in where.glob("[!.]*") if file.suffix.lower() in SUFFIXES]
        series = series_of(files)
        for suffix in SUFFIXES:
            ours = [one for one in series if one[0].suffix.lower() == suffix]
            longest = max(ours, key=len, default=[])
            if len(longest) >= _FEWEST and not _is_mesh(longest[0]):
                count = sum(file.suffix.lower() == suffix for file in files)
                found.append(_Series(longest, count - len(longest)))
    return found


def _is_mesh(file: Path) -> bool:
    """Whether a PLY file says at its start that it has faces."""
    if file.suffix.lower() != ".ply":
        return False
    try:
        with file.open("rb") as opened:
            head = opened.read(_HEADER_BYTES).partition(b"end_header")[0]
    except OSError:
        return False
    return re.search(rb"^element\s+face\s+0*[1-9]", head, re.MULTILINE) is not None


def _poses(root: Path) -> Path:
    """The file of poses in a folder, by preference; raises NoPoses where there is none."""
    named = (path for pattern in _POSES for path in sorted(root.glob(pattern)) if path.is_file())
    found = next((path for path in named if not path.name.startswith(".")), None)
    if found is None:
        raise NoPoses(f"{root} has no poses; expected {EXPECTED}; {SCAN}")
    if (root / "calib.txt").is_file():
        raise DatasetError(
            f"{root} has KITTI's calib.txt, so {found.name} may be the camera's poses; open the "
            "benchmark's folder, which holds sequences/, or name the LiDAR's poses with --trajectory"
        )
    return found
