# SPDX-License-Identifier: MIT
"""Microsoft 7-Scenes, and the 3DMatch data sets that share its layout."""

import re
from functools import lru_cache
from pathlib import Path

import numpy as np

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import PublishedCamera, find_camera
from tsfusion.datasets.dataset import WITHOUT_DEPTH, Frames, keep_posed, require_folder, require_frames
from tsfusion.datasets.depth_files import read_depth
from tsfusion.datasets.file_names import in_order
from tsfusion.datasets.formats.image_folders import first_size
from tsfusion.datasets.readers import read_color
from tsfusion.datasets.trajectory_files import read_matrix, usable
from tsfusion.geometry.depth_registration import Registration
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

EXPECTED = (
    "frame-XXXXXX.{depth.png,pose.txt,color.png|jpg}, in the folder or in its seq-XX folders, and "
    "camera-intrinsics.txt unless it is a scene of 7-Scenes"
)
KINECT = Intrinsics(585.0, 585.0, 320.0, 240.0)  # the release's own figure
# The colour camera is not in the release: measured on RedKitchen by bringing depth edges onto colour edges
# (mean gradient under them 2.34 times the image's; 1.24 as released).
KINECT_COLOR = Intrinsics(527.0, 527.0, 320.0, 237.5)
KINECT_BASELINE = -0.025  # metres, x of the depth camera's origin in the colour camera's axes
_SCENES = re.compile(r"chess|fire|heads|office|pumpkin|redkitchen(_\w+)?|stairs")
_RELEASE = re.compile(r"7[-_]?scenes|seven[-_]?scenes", re.IGNORECASE)
_RELEASED = ("TrainSplit.txt", "TestSplit.txt")  # beside the sequences of every scene
NOT_MEASURED = 65535  # the original release marks invalid depth so; 0 in re-encoded copies


def recognises(path: Path) -> bool:
    """Whether the folder, or a sequence in it, holds `frame-*.depth.png`."""
    return any(_frames(sequence, "depth.png") for sequence in _sequences(path))


class SevenScenes(Frames):
    """A scene (every `seq-*` in it, one world) or a single sequence.

    Depth is uint16 millimetres. 7-Scenes colour has the depth's size but comes from another camera, up to
    35 pixels off: it is registered to the depth here. There are no timestamps (nominally 30 Hz).

    Args:
        path: the scene's or the sequence's folder.
        intrinsics, calibration: default a file of the camera (`cameras.FILES`) beside the frames or up to
            two folders up; for a scene of 7-Scenes (by its name and `TrainSplit.txt`, or in a folder
            `7scenes`) at 640×480 else 585, 585, 320, 240.
        color: read colour images.
        register: move colour onto depth; default: for a scene of 7-Scenes with its own depth camera
            (3DMatch's colour is registered already).
        posed: leave out frames without a pose; else they are kept, with `T_world_camera` None.

    Raises:
        DatasetError: no such folder, no frames, a missing image, a malformed pose or camera file.
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
        register: bool | None = None,
        posed: bool = True,
    ) -> None:
        root = require_folder(path, "7-Scenes")
        self.name, self.sensor, self.skipped = f"7-Scenes {root.name}", sensor, {}
        stems: list[Path] = []
        for sequence in _sequences(root):
            depth = _frames(sequence, "depth.png")
            alone = _frames(sequence, "pose.txt") - depth
            if len(alone) > len(depth):
                raise DatasetError(
                    f"{sequence / min(alone)}.depth.png is missing, but its pose.txt is there; "
                    f"expected {EXPECTED}"
                )
            if alone:
                self.skipped[WITHOUT_DEPTH] = self.skipped.get(WITHOUT_DEPTH, 0) + len(alone)
            stems += in_order(sequence / stem for stem in depth)
        poses = usable(root, stems, _pose)
        self._stems, self._poses = keep_posed(stems, poses, posed=posed, skipped=self.skipped)
        require_frames(len(self._stems), root, EXPECTED, self.skipped)
        self._suffix = _color_suffix(self._stems[0]) if color else None
        folder, own = self._stems[0].parent, _is_own(root)
        self.camera = find_camera(
            root, first_size([_file(stem, "depth.png") for stem in self._stems]),
            intrinsics=intrinsics, calibration=calibration, places=(folder, root, root.absolute().parent),
            published=PublishedCamera("7-Scenes", KINECT) if own else None,
        )  # fmt: skip
        self.intrinsics = self.camera.intrinsics
        self.depth_unit = self.camera.depth_unit(depth_scale)
        self._register = own and self.intrinsics == KINECT if register is None else register

    def __len__(self) -> int:
        return len(self._stems)

    def _frame(self, index: int) -> Frame:
        stem = self._stems[index]
        depth = read_depth(_file(stem, "depth.png"), invalid=NOT_MEASURED)
        if depth.shape != self.camera.size:
            raise DatasetError(f"{stem}.depth.png has shape {depth.shape}, others {self.camera.size}")
        depth = self.camera.depth(depth)
        color = None if self._suffix is None else read_color(_file(stem, self._suffix), depth.shape)
        if color is not None and self._register:
            registration = _registration(self.intrinsics, depth.shape)
            color = registration.color_of_depth(color, depth * np.float32(self.depth_unit.metres))
        elif color is not None:
            color = np.asarray(self.camera.color(color), np.uint8)
        return self._posed_frame(
            index, depth=depth, depth_scale=self.depth_unit.metres, color=color, intrinsics=self.intrinsics
        )


@lru_cache(maxsize=1)
def _registration(depth: Intrinsics, size: tuple[int, int]) -> Registration:
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = KINECT_BASELINE
    return Registration(depth, KINECT_COLOR, T_color_depth, size)


def _sequences(root: Path) -> list[Path]:
    """The folder itself when it holds frames, else its `seq-*` folders."""
    if _frames(root, "depth.png") or _frames(root, "pose.txt"):
        return [root]
    return in_order(path for path in root.glob("seq-*") if path.is_dir())


def _frames(sequence: Path, suffix: str) -> set[str]:
    return {path.name[: -len(suffix) - 1] for path in sequence.glob(f"frame-*.{suffix}")}


def _file(stem: Path, suffix: str) -> Path:
    return stem.with_name(f"{stem.name}.{suffix}")


def _pose(stem: Path) -> Transform | None:
    path = _file(stem, "pose.txt")
    return read_matrix(path) if path.exists() else None


def _color_suffix(stem: Path) -> str | None:
    """The colour file's ending in this data set, None when it has no colour."""
    for suffix in ("color.png", "color.jpg"):
        if any(stem.parent.glob(f"frame-*.{suffix}")):
            return suffix
    return None


def _is_own(root: Path) -> bool:
    """Whether it is a scene of 7-Scenes, or a sequence of one; their names alone are anybody's."""
    root = root.resolve()
    names = root.parts[-3:]
    scene = next((place for place in (root, root.parent) if _SCENES.fullmatch(place.name)), None)
    if scene is None:
        return False
    return any(map(_RELEASE.search, names)) or any((scene / name).is_file() for name in _RELEASED)
