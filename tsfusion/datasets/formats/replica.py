# SPDX-License-Identifier: MIT
"""Replica scenes as NICE-SLAM renders them."""

from pathlib import Path
from typing import Any

from tsfusion.datasets.cameras import DepthUnit, PublishedCamera
from tsfusion.datasets.dataset import SCAN, NoPoses, Poses, Times
from tsfusion.datasets.formats.image_folders import (
    DepthImages,
    color_images,
    depth_images,
    images,
    poses_by_number,
)
from tsfusion.datasets.trajectory_files import read_matrix_rows
from tsfusion.geometry.keyframe import Intrinsics

EXPECTED = "traj.txt, results/depthN.png and results/frameN.jpg, with cam_params.json there or one folder up"
_CAMERA = PublishedCamera("NICE-SLAM's Replica", Intrinsics(600.0, 600.0, 599.5, 339.5), (680, 1200))


def recognises(path: Path) -> bool:
    """True for a folder with `results/depth*.png`."""
    return any((path / "results").glob("depth*.png"))


class Replica(DepthImages):
    """A scene of Replica as distributed with NICE-SLAM (also used by many later SLAM systems).

    https://github.com/cvg/nice-slam. Line k of `traj.txt` is frame k's 4×4 camera-to-world matrix, OpenCV
    axes; depth is 6553.5 units a metre at 1200×680, K 600, 600, 599.5, 339.5, unless `cam_params.json` says
    otherwise. Rendered, without noise; no timestamps. Options are those of `DepthImages`.
    """

    layout, expected = "Replica", EXPECTED
    usual_unit = DepthUnit(1 / 6553.5, "usual for NICE-SLAM's Replica", is_stated=False)

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        return depth_images(root / "results", EXPECTED, "depth*"), None

    def _recorded_poses(self, root: Path, files: list[Path]) -> Poses:
        path = root / "traj.txt"
        if not path.exists():
            raise NoPoses(f"{path} is missing; expected 16 numbers a line; {SCAN}")
        return poses_by_number([file.stem for file in files], [*enumerate(read_matrix_rows(path))], path)

    def _colors(self, root: Path) -> list[Path]:
        """`frame000010.jpg` of `depth000010.png`; none where there are none."""
        there = images(root / "results", EXPECTED, "frame*")
        return color_images(self._files, root / "results", EXPECTED, "frame") if there else []

    def _known_camera(self, root: Path) -> dict[str, Any]:
        places = (up / "cam_params.json" for up in (root, root.absolute().parent))
        return {"files": [path for path in places if path.exists()][:1], "published": _CAMERA}
