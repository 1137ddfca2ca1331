# SPDX-License-Identifier: MIT
"""RGB-D folders with one pose file: HoloLens recordings and Redwood / Open3D reconstructions."""

import json
from pathlib import Path

from tsfusion.datasets.base import (
    Frames,
    checked_intrinsics,
    folder,
    read_color,
    read_depth,
    read_intrinsics,
    require_frames,
)
from tsfusion.datasets.poses import Pose, read_log, read_matrix_rows
from tsfusion.errors import DatasetError
from tsfusion.frame import Frame
from tsfusion.keyframe import Intrinsics

IMAGES = (".png", ".jpg", ".jpeg")
HOLOLENS_EXPECTED = "K.txt, poses.txt, depth/*.png and images/*.png"
REDWOOD_EXPECTED = "trajectory.log, depth/*.png and image/, color/ or rgb/"
PRIMESENSE = Intrinsics(525.0, 525.0, 319.5, 239.5)  # Open3D's PrimeSenseDefault


def recognises_hololens(path: Path) -> bool:
    """Whether the folder has `K.txt`, `poses.txt` and `depth/`."""
    return (path / "K.txt").is_file() and (path / "poses.txt").is_file() and (path / "depth").is_dir()


def recognises_redwood(path: Path) -> bool:
    """Whether the folder has `trajectory.log` and `depth/`."""
    return (path / "trajectory.log").is_file() and (path / "depth").is_dir()


class PosedFolders(Frames):
    """Depth and colour images in two folders, with a pose each; depth in uint16 millimetres."""

    def __init__(
        self,
        name: str,
        *,
        sensor: str,
        depth: list[Path],
        color: list[Path],
        poses: list[Pose],
        intrinsics: Intrinsics,
        skipped: dict[str, int],
    ) -> None:
        self.name, self.sensor, self.skipped, self.intrinsics = name, sensor, skipped, intrinsics
        self._depth, self._color, self._poses = depth, color, poses

    def __len__(self) -> int:
        return len(self._depth)

    def _frame(self, index: int) -> Frame:
        depth = read_depth(self._depth[index])
        color = read_color(self._color[index], depth.shape) if self._color else None
        return Frame(
            depth=depth,
            depth_scale=0.001,
            color=color,
            intrinsics=self.intrinsics,
            T_world_camera=self._poses[index],
            sensor=self.sensor,
        )


class HoloLens(PosedFolders):
    """HoloLens RGB-D as in deep-video-mvs: line k of `poses.txt` belongs to the k-th image by name.

    Time-of-flight depth in uint16 millimetres, registered to colour; no timestamps.

    Raises:
        DatasetError: no such folder, no frames, unequal numbers of images and poses, a malformed line.
    """

    def __init__(self, path: str | Path, *, sensor: str = "tof", color: bool = True) -> None:
        root = folder(path, "HoloLens")
        depth = _images(root / "depth", HOLOLENS_EXPECTED)
        require_frames(len(depth), root / "depth", HOLOLENS_EXPECTED, {})
        poses = read_matrix_rows(root / "poses.txt")
        if len(poses) != len(depth):
            raise DatasetError(
                f"{root / 'poses.txt'} has {len(poses)} poses for {len(depth)} depth images; "
                "expected as many: line k belongs to the k-th image"
            )
        super().__init__(
            f"HoloLens {root.name}",
            sensor=sensor,
            depth=depth,
            color=_matched(depth, root / "images", HOLOLENS_EXPECTED) if color else [],
            poses=poses,
            intrinsics=read_intrinsics(root / "K.txt"),
            skipped={},
        )


class Redwood(PosedFolders):
    """Redwood and Open3D reconstructions: `trajectory.log` with uint16 millimetre depth; no timestamps.

    With as many poses as images the k-th pose is the k-th image's; otherwise a pose's number is its image's
    file name. Images without a pose are skipped and counted, poses without an image ignored.

    Args:
        intrinsics: default `camera_intrinsic.json` (Open3D's) in the folder, else 525, 525, 319.5, 239.5.

    Raises:
        DatasetError: no such folder, no frames, a missing image, a malformed trajectory.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        intrinsics: Intrinsics | None = None,
        sensor: str = "kinect",
        color: bool = True,
    ) -> None:
        root = folder(path, "Redwood")
        images = _images(root / "depth", REDWOOD_EXPECTED)
        by_image = _assign(images, read_log(root / "trajectory.log"), root)
        depth = [image for image in images if image in by_image]
        skipped = {"without a pose": len(images) - len(depth)} if len(depth) < len(images) else {}
        require_frames(len(depth), root, REDWOOD_EXPECTED, skipped)
        where = next((root / name for name in ("image", "color", "rgb") if (root / name).is_dir()), None)
        if intrinsics is None:
            intrinsics = _open3d_intrinsics(root / "camera_intrinsic.json")
        super().__init__(
            f"Redwood {root.name}",
            sensor=sensor,
            depth=depth,
            color=_matched(depth, where, REDWOOD_EXPECTED) if color and where else [],
            poses=[by_image[image] for image in depth],
            intrinsics=checked_intrinsics(intrinsics, "intrinsics"),
            skipped=skipped,
        )


def _images(where: Path, expected: str) -> list[Path]:
    if not where.is_dir():
        raise DatasetError(f"{where} is missing; expected {expected}")
    return sorted(path for path in where.iterdir() if path.suffix.lower() in IMAGES)


def _matched(depth: list[Path], where: Path, expected: str) -> list[Path]:
    """The colour image of each depth image, by file name."""
    by_stem = {path.stem: path for path in _images(where, expected)}
    for image in depth:
        if image.stem not in by_stem:
            raise DatasetError(
                f"{where / image.stem}.png or .jpg is missing, but {image} is there; expected {expected}"
            )
    return [by_stem[image.stem] for image in depth]


def _assign(images: list[Path], poses: list[tuple[int, Pose]], root: Path) -> dict[Path, Pose]:
    if len(images) == len(poses):
        return {image: pose for image, (_, pose) in zip(images, poses, strict=True)}
    if not all(image.stem.isdigit() for image in images):
        raise DatasetError(
            f"{root / 'trajectory.log'} has {len(poses)} poses for {len(images)} depth images, "
            "whose names are not frame numbers; "
            "expected as many poses as images, or images named by frame number"
        )
    by_number = dict(poses)
    return {image: by_number[int(image.stem)] for image in images if int(image.stem) in by_number}


def _open3d_intrinsics(path: Path) -> Intrinsics:
    if not path.exists():
        return PRIMESENSE
    try:
        K = json.loads(path.read_text(encoding="utf-8"))["intrinsic_matrix"]  # column-major
        return checked_intrinsics(Intrinsics(float(K[0]), float(K[4]), float(K[6]), float(K[7])), path)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise DatasetError(
            f"{path} must be an Open3D camera with a 9-number intrinsic_matrix: {error}"
        ) from error
