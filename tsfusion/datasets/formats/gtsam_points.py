# SPDX-License-Identifier: MIT
"""Keyframes of a LiDAR map with their pose graph, as gtsam_points has them."""

from pathlib import Path

import numpy as np

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, FramePoses, NoPoses, Times
from tsfusion.datasets.file_names import in_order
from tsfusion.datasets.folder_frames import FolderFrames
from tsfusion.datasets.readers import numbers, read_lines
from tsfusion.datasets.scan_files import read_scan
from tsfusion.datasets.trajectory_files import check_quaternion, usable
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import rigid

EXPECTED = "NNNNNN/points.bin (float32 x, y, z) and graph.txt (`vK tx ty tz qx qy qz qw` a line)"


class LidarDump(FolderFrames):
    """Clouds in the LiDAR's axes with the pose of each in the world's.

    https://github.com/koide3/gtsam_points, `data/kitti_07_dump`. Folder K belongs to line `vK`; other lines
    (edges) are ignored. No timestamps. Options are those of `FolderFrames`.
    """

    layout, expected, sensor = "LiDAR keyframes", EXPECTED, "lidar"
    signs = (("[0-9]*/points.bin",),)
    quaternions = True

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        files = in_order(root.glob("*/points.bin"))
        return [file for file in files if file.parent.name.isdecimal()], None

    def _recorded_poses(self, root: Path, files: list[Path]) -> FramePoses:
        path, content = root / "graph.txt", "`vK tx ty tz qx qy qz qw` a line"
        if not path.exists():
            raise NoPoses(f"{path} is missing; expected {EXPECTED}; {SCAN}")
        lines = [line for line in read_lines(path, content) if line[1].startswith("v")]
        numbered: dict[int, Transform] = {}

        def read(line: tuple[int, str]) -> Transform:
            name, *words = line[1].split()
            if not name[1:].isdecimal():
                raise DatasetError(f"{path}:{line[0]}: {name!r}; expected {content}")
            values = np.array(numbers(path, line[0], words, 7, content))
            check_quaternion(values[3:], path, line[0])
            numbered[int(name[1:])] = T = rigid(values[3:] / np.linalg.norm(values[3:]), values[:3])
            return T

        usable(path, lines, read)
        return [numbered.get(int(file.parent.name)) for file in files]

    def _frame(self, index: int) -> Frame:
        return self._posed_frame(index, points=read_scan(self._files[index], fields=3).points)
