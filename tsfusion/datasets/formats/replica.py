# SPDX-License-Identifier: MIT
"""Replica scenes as NICE-SLAM renders them."""

import json
from pathlib import Path

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, keep_posed, require_folder, require_frames
from tsfusion.datasets.formats.image_folders import DepthImages, images
from tsfusion.datasets.readers import checked_intrinsics, numbers, read_depth
from tsfusion.datasets.trajectory_files import read_matrix_rows
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

EXPECTED = "traj.txt, results/depthN.png and results/frameN.jpg, with cam_params.json there or one folder up"
SIZE = (680, 1200)  # height, width
CAMERA = Intrinsics(600.0, 600.0, 599.5, 339.5)
DEPTH_SCALE = 1 / 6553.5  # metres per unit


def recognises(path: Path) -> bool:
    """Whether the folder has `results/depth*.png`."""
    return any((path / "results").glob("depth*.png"))


class Replica(DepthImages):
    """A scene of Replica as distributed with NICE-SLAM (also used by many later SLAM systems).

    https://github.com/cvg/nice-slam. Line k of `traj.txt` is frame k's 4×4 camera-to-world matrix, OpenCV
    axes; depth is 6553.5 units a metre at 1200×680, K 600, 600, 599.5, 339.5, unless `cam_params.json` says
    otherwise. Rendered, without noise; no timestamps.

    Args:
        posed: leave out frames without a pose; else they are kept, with `T_world_camera` None.

    Raises:
        DatasetError: no such folder, no frames, a missing image, a malformed trajectory or camera file.
    """

    def __init__(
        self, path: str | Path, *, sensor: str = "kinect", color: bool = True, posed: bool = True
    ) -> None:
        root = require_folder(path, "Replica")
        skipped: dict[str, int] = {}
        files = images(root / "results", EXPECTED, "depth*")
        depth, poses = keep_posed(files, _poses(root, files, posed=posed), posed=posed, skipped=skipped)
        require_frames(len(depth), root / "results", EXPECTED, skipped)
        intrinsics, size, scale = _camera(root)
        super().__init__(
            f"Replica {root.name}",
            sensor=sensor,
            depth=depth,
            color=_frames(root, depth) if color else [],
            poses=poses,
            intrinsics=_scaled_to_depth(intrinsics, size, depth[0]),
            skipped=skipped,
            depth_scale=scale,
        )


def _frames(root: Path, depth: list[Path]) -> list[Path | None]:
    """`frame000010.jpg` of `depth000010.png`; all or none."""
    by_number = {path.stem[len("frame") :]: path for path in images(root / "results", EXPECTED, "frame*")}
    if not by_number:
        return []
    for path in depth:
        number = path.stem[len("depth") :]
        if number not in by_number:
            raise DatasetError(f"{path.with_name(f'frame{number}.jpg')} is missing, but {path} is there")
    return [by_number[path.stem[len("depth") :]] for path in depth]


def _poses(root: Path, files: list[Path], *, posed: bool) -> list[Transform | None]:
    path = root / "traj.txt"
    if not path.exists():
        if posed:
            raise DatasetError(f"{path} is missing; expected 16 numbers a line; {SCAN}")
        return [None] * len(files)
    poses = read_matrix_rows(path)
    if len(poses) == len(files):
        return [*poses]
    lines = [int(numbers(file, 0, [file.stem[len("depth") :]], 1, "depthN.png")[0]) for file in files]
    return [poses[line] if line < len(poses) else None for line in lines]


def _camera(root: Path) -> tuple[Intrinsics, tuple[int, int], float]:
    """Camera, (height, width) and metres per unit."""
    path = next(
        (
            up / "cam_params.json"
            for up in (root, root.absolute().parent)
            if (up / "cam_params.json").exists()
        ),
        None,
    )
    if path is None:
        return CAMERA, SIZE, DEPTH_SCALE
    try:
        camera = json.loads(path.read_text(encoding="utf-8"))["camera"]
        intrinsics = Intrinsics(*(float(camera[key]) for key in ("fx", "fy", "cx", "cy")))
        size, scale = (int(camera["h"]), int(camera["w"])), 1 / float(camera["scale"])
        if min(size) < 1:
            raise ValueError(f"w and h must be >= 1, got {size[1]} and {size[0]}")
    except (OSError, ValueError, LookupError, TypeError, ArithmeticError, RecursionError) as error:
        raise DatasetError(
            f"{path} must hold camera: w, h, fx, fy, cx, cy, scale; {type(error).__name__}: {error}"
        ) from error
    return checked_intrinsics(intrinsics, path), size, scale


def _scaled_to_depth(intrinsics: Intrinsics, size: tuple[int, int], depth: Path) -> Intrinsics:
    shape = read_depth(depth).shape
    if shape[0] * size[1] != shape[1] * size[0]:
        raise DatasetError(
            f"{depth} is {shape[1]}×{shape[0]}, its camera {size[1]}×{size[0]}; expected that shape, or the "
            "camera in cam_params.json"
        )
    return intrinsics.scaled(shape[1] / size[1])
