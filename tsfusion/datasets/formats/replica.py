# SPDX-License-Identifier: MIT
"""Replica scenes as NICE-SLAM renders them."""

from pathlib import Path

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import DepthUnit, PublishedCamera, find_camera
from tsfusion.datasets.dataset import SCAN, keep_posed, require_folder, require_frames
from tsfusion.datasets.formats.image_folders import DepthImages, depth_images, first_size, images
from tsfusion.datasets.readers import numbers
from tsfusion.datasets.trajectory_files import read_matrix_rows
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

EXPECTED = "traj.txt, results/depthN.png and results/frameN.jpg, with cam_params.json there or one folder up"
_CAMERA = PublishedCamera("NICE-SLAM's Replica", Intrinsics(600.0, 600.0, 599.5, 339.5), (680, 1200))
_UNIT = DepthUnit(1 / 6553.5, "usual for NICE-SLAM's Replica", is_stated=False)


def recognises(path: Path) -> bool:
    """Whether the folder has `results/depth*.png`."""
    return any((path / "results").glob("depth*.png"))


class Replica(DepthImages):
    """A scene of Replica as distributed with NICE-SLAM (also used by many later SLAM systems).

    https://github.com/cvg/nice-slam. Line k of `traj.txt` is frame k's 4×4 camera-to-world matrix, OpenCV
    axes; depth is 6553.5 units a metre at 1200×680, K 600, 600, 599.5, 339.5, unless `cam_params.json` says
    otherwise. Rendered, without noise; no timestamps.

    Args:
        intrinsics, calibration: instead of that camera.
        depth_scale: metres per unit, instead of those.
        posed: leave out frames without a pose; else they are kept, with `T_world_camera` None.

    Raises:
        DatasetError: no such folder, no frames, a missing image, a malformed trajectory or camera file.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        intrinsics: Intrinsics | None = None,
        calibration: str | Path | None = None,
        depth_scale: float | None = None,
        sensor: str = "kinect",
        color: bool = True,
        posed: bool = True,
    ) -> None:
        root = require_folder(path, "Replica")
        skipped: dict[str, int] = {}
        files = depth_images(root / "results", EXPECTED, "depth*")
        depth, poses = keep_posed(files, _poses(root, files, posed=posed), posed=posed, skipped=skipped)
        require_frames(len(depth), root / "results", EXPECTED, skipped)
        file = _camera_file(root)
        super().__init__(
            f"Replica {root.name}",
            sensor=sensor,
            depth=depth,
            color=_frames(root, depth) if color else [],
            poses=poses,
            camera=find_camera(
                root,
                first_size(depth),
                intrinsics=intrinsics,
                calibration=calibration,
                files=() if file is None else (file,),
                published=_CAMERA,
            ),
            skipped=skipped,
            depth_scale=depth_scale,
            usual_unit=_UNIT,
        )


def _frames(root: Path, depth: list[Path]) -> list[Path | None]:
    """`frame000010.jpg` of `depth000010.png`; none where there are none, else of some it may be missing."""
    there = images(root / "results", EXPECTED, "frame*")
    by_number = {path.stem[len("frame") :]: path for path in there}
    numbers_ = [path.stem[len("depth") :] for path in depth]
    missing = [number for number in numbers_ if number not in by_number]
    if there and 2 * len(missing) > len(depth):
        name = root / "results" / f"frame{missing[0]}.jpg"
        raise DatasetError(f"{name} is missing, but depth{missing[0]} is there")
    return [by_number.get(n, root / "results" / f"frame{n}.jpg") for n in numbers_] if there else []


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


def _camera_file(root: Path) -> Path | None:
    places = (up / "cam_params.json" for up in (root, root.absolute().parent))
    return next((path for path in places if path.exists()), None)
