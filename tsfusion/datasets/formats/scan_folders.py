# SPDX-License-Identifier: MIT
"""Folders of a LiDAR's scans, one file each: what drivers record, and what other fusion programs read."""

import re
from decimal import Decimal
from pathlib import Path

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, Frames, keep_posed, require_folder, require_frames
from tsfusion.datasets.formats.image_folders import times_of_names
from tsfusion.datasets.given_trajectory import poses_of
from tsfusion.datasets.scan_files import SUFFIXES, USUAL_FIELDS, read_scan
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform

EXPECTED = (
    "scans numbered or named by their times (.bin, .pcd, .ply, .las or .laz) in the folder, velodyne/, "
    "lidar/, scans/, points/ or clouds/; and poses of the LiDAR in poses.txt, *_kitti.txt or *_tum.txt, or "
    "with --trajectory; without, for a scan"
)
_PLACES = ("", "velodyne", "lidar", "scans", "points", "clouds")
_NAME = re.compile(r"(.*?)([0-9]+(?:\.[0-9]+)?)", re.DOTALL)  # what all names begin with, a number or a time
_POSES = ("poses.txt", "*poses_kitti.txt", "*poses_tum.txt", "*_kitti.txt", "*_tum.txt", "*poses.txt")
_FEWEST = 2
_RUN = "run.json"  # beside the meshes of a scan


def recognises(path: Path) -> bool:
    """Whether the folder has scans."""
    return bool(_scans(path)[0])


class ScanFolder(Frames):
    """Scans in the LiDAR's axes, each with the LiDAR's pose in the world's where one is known.

    The layout of KITTI's `velodyne/`, and of the folders that KISS-ICP's generic reader takes, with the poses
    that it writes. Scans are as recorded, not corrected for the sensor's motion. Names that are decimal
    seconds or nanoseconds are times; others only give the order.

    Args:
        trajectory: default `poses.txt`, `*_kitti.txt` or `*_tum.txt` in the folder.
        fields: float32 numbers a point in `.bin` files, x, y and z first.
        max_gap_s, time_offset_s: as of `given_trajectory.poses_of`.
        posed: leave out scans without a pose; else they are kept, with `T_world_camera` None.

    Raises:
        DatasetError: no such folder, no scans, no or malformed poses.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        trajectory: str | Path | None = None,
        sensor: str = "lidar",
        fields: int = USUAL_FIELDS,
        max_gap_s: float = 0.2,
        time_offset_s: float = 0.0,
        posed: bool = True,
    ) -> None:
        root = require_folder(path, "LiDAR scans")
        if not 3 <= fields <= 64:
            raise DatasetError(f"fields must be from 3 to 64 numbers a point, got {fields}")
        self.name, self.sensor, self.skipped, self._fields = f"LiDAR scans {root.name}", sensor, {}, fields
        files, others = _scans(root)
        require_frames(len(files), root, EXPECTED, self.skipped)
        if others:
            self.skipped["of another name"] = others
        stamps = times_of_names([_number(file) for file in files])
        poses: list[Transform | None] = [None] * len(files)
        where = _poses(root) if trajectory is None else Path(trajectory).expanduser()
        if trajectory is None and where is not None and (root / "calib.txt").is_file():
            raise DatasetError(
                f"{root} has KITTI's calib.txt, so {where.name} may be the camera's poses; open the "
                "benchmark's folder, which holds sequences/, or name the LiDAR's poses with --trajectory"
            )
        if where is None and posed:
            raise DatasetError(f"{root} has no poses; expected {EXPECTED}; {SCAN}")
        if where is not None:
            poses = poses_of(
                where, len(files), stamps, posed=posed, max_gap_s=max_gap_s, time_offset_s=time_offset_s
            )
        kept, self._poses = keep_posed(
            range(len(files)), poses, posed=posed, skipped=self.skipped, reason="without a pose in time"
        )
        require_frames(len(kept), root, EXPECTED, self.skipped)
        self._files = [files[index] for index in kept]
        self.timestamps_ns = None if stamps is None else stamps[kept]

    def __len__(self) -> int:
        return len(self._files)

    def _frame(self, index: int) -> Frame:
        return self._posed_frame(index, points=read_scan(self._files[index], fields=self._fields))


def _scans(root: Path) -> tuple[list[Path], int]:
    """The scans of a folder in their order, and the number of files of their kind that have another name."""
    for place in _PLACES:
        where = root / place
        if not where.is_dir() or (where / _RUN).is_file():
            continue
        for suffix in SUFFIXES:
            found = [file for file in where.glob("[!.]*") if file.suffix.lower() == suffix]
            series: dict[str, list[Path]] = {}
            for file in found:
                if match := _NAME.fullmatch(file.stem):
                    series.setdefault(match[1], []).append(file)
            longest = max(series.values(), key=len, default=[])
            if len(longest) >= _FEWEST:
                return sorted(longest, key=lambda file: Decimal(_number(file))), len(found) - len(longest)
    return [], 0


def _number(file: Path) -> str:
    match = _NAME.fullmatch(file.stem)
    assert match is not None
    return match[2]


def _poses(root: Path) -> Path | None:
    """The file of poses in a folder, by preference."""
    named = (path for pattern in _POSES for path in sorted(root.glob(pattern)) if path.is_file())
    return next((path for path in named if not path.name.startswith(".")), None)
