# SPDX-License-Identifier: MIT
"""Keyframes of a LiDAR map with their pose graph, as gtsam_points has them."""

from functools import partial
from pathlib import Path

import numpy as np

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, Frames, NoPoses, Poses, poses_if_any, require_folder
from tsfusion.datasets.file_names import in_order
from tsfusion.datasets.readers import numbers, read_lines
from tsfusion.datasets.scan_files import read_scan
from tsfusion.datasets.trajectory_files import check_quaternion
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import rigid

EXPECTED = "NNNNNN/points.bin (float32 x, y, z) and graph.txt (`vK tx ty tz qx qy qz qw` a line)"


def recognises(path: Path) -> bool:
    """Whether the folder has numbered folders with `points.bin`."""
    return any(file.parent.name.isdecimal() for file in path.glob("*/points.bin"))


class LidarDump(Frames):
    """Clouds in the LiDAR's axes with the pose of each in the world's.

    https://github.com/koide3/gtsam_points, `data/kitti_07_dump`. Folder K belongs to line `vK`; other lines
    (edges) are ignored. No timestamps.

    Args:
        posed: leave out clouds without a pose; else they are kept, with `T_world_camera` None.

    Raises:
        DatasetError: no such folder, no clouds, a malformed line or file.
    """

    quaternions = True

    def __init__(self, path: str | Path, *, sensor: str = "lidar", posed: bool = True) -> None:
        root = require_folder(path, "LiDAR keyframes")
        self.name, self.sensor, self.skipped = f"LiDAR keyframes {root.name}", sensor, {}
        files = [file for file in in_order(root.glob("*/points.bin")) if file.parent.name.isdecimal()]
        poses = poses_if_any(partial(_poses, root / "graph.txt", files), len(files), posed=posed)
        self._files = self._keep(files, poses, (root, EXPECTED), posed=posed)

    def __len__(self) -> int:
        return len(self._files)

    def _frame(self, index: int) -> Frame:
        return self._posed_frame(index, points=read_scan(self._files[index], fields=3).points)


def _poses(path: Path, files: list[Path]) -> Poses:
    if not path.exists():
        raise NoPoses(f"{path} is missing; expected {EXPECTED}; {SCAN}")
    content = "`vK tx ty tz qx qy qz qw` a line"
    poses: dict[int, Transform] = {}
    for number, line in read_lines(path, content):
        name, *words = line.split()
        if not name.startswith("v"):
            continue
        if not name[1:].isdecimal():
            raise DatasetError(f"{path}:{number}: {name!r}; expected {content}")
        values = np.array(numbers(path, number, words, 7, content))
        check_quaternion(values[3:], path, number)
        poses[int(name[1:])] = rigid(values[3:] / np.linalg.norm(values[3:]), values[:3])
    return [poses.get(int(file.parent.name)) for file in files]
