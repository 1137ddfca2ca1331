# SPDX-License-Identifier: MIT
"""Microsoft 7-Scenes, and the 3DMatch data sets that share its layout."""

import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import PublishedCamera
from tsfusion.datasets.dataset import WITHOUT_DEPTH, Poses, Times
from tsfusion.datasets.file_names import in_order
from tsfusion.datasets.formats.image_folders import DepthImages
from tsfusion.datasets.readers import read_color
from tsfusion.datasets.trajectory_files import read_matrix, usable
from tsfusion.geometry.depth_registration import Registration
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
    """True for a folder that holds `frame-*.depth.png`, itself or in a sequence."""
    return any(_frames(sequence, "depth.png") for sequence in _sequences(path))


class SevenScenes(DepthImages):
    """A scene (every `seq-*` in it, one world) or a single sequence.

    Depth is uint16 millimetres. 7-Scenes colour has the depth's size but comes from another camera, up to
    35 pixels off: it is registered to the depth here. There are no timestamps (nominally 30 Hz).

    Args:
        path: the scene's or the sequence's folder. A file of the camera may lie beside the frames or up to
            two folders up; a scene of 7-Scenes (by its name and `TrainSplit.txt`, or in a folder `7scenes`)
            at 640×480 has 585, 585, 320, 240 without one.
        register: move colour onto depth; default: for a scene of 7-Scenes with its own depth camera
            (3DMatch's colour is registered already).
        options: those of `DepthImages`.
    """

    layout, expected, not_measured = "7-Scenes", EXPECTED, NOT_MEASURED

    def __init__(self, path: str | Path, *, register: bool | None = None, **options: Any) -> None:
        super().__init__(path, **options)
        is_known = _is_own(Path(path).expanduser()) and self.intrinsics == KINECT
        self._register = is_known if register is None else register

    def _list(self, root: Path) -> tuple[list[Path], Times]:
        files: list[Path] = []
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
            files += in_order(sequence / f"{stem}.depth.png" for stem in depth)
        return files, None

    def _recorded_poses(self, root: Path, files: list[Path]) -> Poses:
        return usable(root, files, _pose)

    def _colors(self, root: Path) -> list[Path]:
        folder = self._files[0].parent
        kinds = [kind for kind in ("color.png", "color.jpg") if any(folder.glob(f"frame-*.{kind}"))]
        return [_beside(file, kinds[0]) for file in self._files] if kinds else []

    def _known_camera(self, root: Path) -> dict[str, Any]:
        published = PublishedCamera("7-Scenes", KINECT) if _is_own(root) else None
        places = (self._files[0].parent, root, root.absolute().parent)
        return {"places": places, "published": published}

    def _registered(self, color: Path, depth: NDArray[Any]) -> NDArray[np.uint8]:
        if not self._register:
            return super()._registered(color, depth)
        registration = _registration(self.intrinsics, depth.shape)
        metres = depth * np.float32(self.depth_scale)
        return registration.color_of_depth(read_color(color, depth.shape), metres)


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


def _beside(depth: Path, kind: str) -> Path:
    return depth.with_name(depth.name.removesuffix("depth.png") + kind)


def _pose(depth: Path) -> Transform | None:
    path = _beside(depth, "pose.txt")
    return read_matrix(path) if path.exists() else None


def _is_own(root: Path) -> bool:
    """True for a scene of 7-Scenes or a sequence of one; names alone, free for anybody, decide nothing."""
    root = root.resolve()
    names = root.parts[-3:]
    scene = next((place for place in (root, root.parent) if _SCENES.fullmatch(place.name)), None)
    if scene is None:
        return False
    return any(map(_RELEASE.search, names)) or any((scene / name).is_file() for name in _RELEASED)
