# SPDX-License-Identifier: MIT
"""ScanNet scenes exported to folders."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import Poses, Times
from tsfusion.datasets.formats.image_folders import (
    DepthImages,
    color_images,
    depth_images,
    resample_for_camera,
)
from tsfusion.datasets.readers import intrinsics_of, read_color, read_lines, read_numbers
from tsfusion.datasets.trajectory_files import read_matrix, usable
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

EXPECTED = "color/N.jpg, depth/N.png, pose/N.txt and intrinsic/intrinsic_{depth,color}.txt"
_PLACES = ("intrinsic/intrinsic_{}.txt", "intrinsics_{}.txt", "intrinsic_{}.txt")


def recognises(path: Path) -> bool:
    """True for a folder with `depth/` and the depth camera's 4×4 matrix in `intrinsic/` or beside `pose/`."""
    own = (path / "intrinsic").is_dir() or (path / "pose").is_dir()
    return own and (path / "depth").is_dir() and _camera_file(path, "depth") is not None


class ScanNet(DepthImages):
    """A scene as ScanNet's SensReader exports it, or one of `scannet_frames_25k`.

    http://www.scan-net.org. Depth in uint16 millimetres; the colour camera stands beside the depth camera
    and has other pixels: colour is resampled by both cameras' matrices, as if they stood in one place.
    Frames that the authors' tracker lost have poses of -inf: they count as frames without a pose. No
    timestamps (nominally 30 Hz). Options are those of `DepthImages`.
    """

    layout, expected = "ScanNet", EXPECTED

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        return depth_images(root / "depth", EXPECTED), None

    def _recorded_poses(self, root: Path, files: list[Path]) -> Poses:
        return usable(root / "pose", (root / "pose" / f"{file.stem}.txt" for file in files), _pose)

    def _colors(self, root: Path) -> list[Path]:
        self.color_intrinsics = _color_intrinsics(root)
        return color_images(self._files, root / "color", EXPECTED)

    def _known_camera(self, root: Path) -> dict[str, Any]:
        return {"files": filter(None, [_camera_file(root, "depth")])}

    def _registered(self, color: Path, depth: NDArray[Any]) -> NDArray[np.uint8]:
        if self.color_intrinsics is None:
            return super()._registered(color, depth)
        image, own = read_color(color, None), self.color_intrinsics
        height, width = image.shape[:2]
        if not (0.25 < own.cx / width < 0.75 and 0.25 < own.cy / height < 0.75):
            raise DatasetError(
                f"{color} is {width}×{height}, and the colour camera's matrix with cx {own.cx:g}, "
                f"cy {own.cy:g} is of images of another size: give that of these (intrinsic_color.txt), or "
                "leave colour out (--option color=false)"
            )
        return resample_for_camera(image, own, self.intrinsics, depth.shape)


def _camera_file(root: Path, camera: str) -> Path | None:
    return next((root / p.format(camera) for p in _PLACES if (root / p.format(camera)).is_file()), None)


def _color_intrinsics(root: Path) -> Intrinsics | None:
    path = _camera_file(root, "color")
    if path is None:
        return None
    K = read_numbers(path, "a 4×4 or 3×3 camera matrix")
    if K.shape not in ((4, 4), (3, 3)):
        raise DatasetError(f"{path} must hold a 4×4 or 3×3 camera matrix, got {K.shape[0]}×{K.shape[1]}")
    return intrinsics_of(K, path)


def _pose(path: Path) -> Transform | None:
    if not path.exists():
        return None
    lost = any("inf" in line.lower() for _, line in read_lines(path, "a 4×4 camera-to-world matrix"))
    return None if lost else read_matrix(path)
