# SPDX-License-Identifier: MIT
"""Layouts of watched folders: the files of a frame, and whether they are complete."""

import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import read_limits
from tsfusion.core.errors import DatasetError
from tsfusion.datasets.formats.image_folders import COLOR
from tsfusion.datasets.point_times import Scan
from tsfusion.datasets.readers import decode_image
from tsfusion.datasets.scan_files import SUFFIXES, read_scan

LayoutKind = Literal["depth", "pair", "points"]

EXPECTED = (
    "depth/NAME.png|tiff|exr|npy with color/, colour/, rgb/, image/ or images/NAME.png|jpg; "
    "frame-*.depth.png with frame-*.color.png|jpg; left/ and right/NAME.png|jpg; "
    "NAME.bin|pcd|ply|las|laz, there or in velodyne/"
)

_NOT_MEASURED = 65535  # 7-Scenes' value for pixels without depth
_IMAGES = r"\.(?:png|jpe?g)"
_ENDINGS = (_IMAGES, r"\.(?:png|tiff?|exr|npy)", r"\.(?:bin|pcd|ply|las|laz)")
_ANY_IMAGE, _DEPTH, _SCAN = (re.compile(rf"([^.].*){ending}") for ending in _ENDINGS)
_FLAT_DEPTH, _FLAT_COLOR = re.compile(r"(frame-.+)\.depth\.png"), re.compile(rf"(frame-.+)\.color{_IMAGES}")
_PNG_END, _JPEG_END = b"\0\0\0\0IEND\xaeB`\x82", b"\xff\xd9"
_POINT = 16  # bytes: x, y, z and intensity in float32


@dataclass(frozen=True)
class FolderLayout:
    """Folder and pattern of a frame's first and second file; the pattern's group is the frame's name.

    `files` are those of a frame in words.
    """

    kind: LayoutKind
    files: str
    first: tuple[Path, re.Pattern[str]]
    second: tuple[Path, re.Pattern[str]] | None = None

    def partner(self, name: str) -> Path | None:
        """Second file of a frame; None = not there."""
        if self.second is None:
            return None
        where, pattern = self.second
        middle = ".color" if pattern is _FLAT_COLOR else ""
        candidates = (where / f"{name}{middle}.{ending}" for ending in ("png", "jpg", "jpeg"))
        return next((path for path in candidates if path.exists()), None)


def layout_of(root: Path) -> FolderLayout | None:
    """Recognise the layout of the files so far; None = unknown."""
    if (root / "depth").is_dir():
        color = next((root / name for name in COLOR if (root / name).is_dir()), root / COLOR[0])
        return FolderLayout(
            "depth", f"depth/NAME.png|tiff|exr|npy with {color.name}/NAME.png|jpg", (root / "depth", _DEPTH),
            (color, _ANY_IMAGE),
        )  # fmt: skip
    if (root / "left").is_dir() and (root / "right").is_dir():
        return FolderLayout(
            "pair", "left/ and right/NAME.png|jpg", (root / "left", _ANY_IMAGE), (root / "right", _ANY_IMAGE)
        )
    if (root / "velodyne").is_dir():
        return FolderLayout("points", "velodyne/NAME.bin|pcd|ply|las|laz", (root / "velodyne", _SCAN))
    names = [path.name for path in root.iterdir()]
    if any(_FLAT_DEPTH.fullmatch(name) for name in names):
        return FolderLayout(
            "depth", "frame-*.depth.png with frame-*.color.png|jpg", (root, _FLAT_DEPTH), (root, _FLAT_COLOR)
        )
    for ending in SUFFIXES:  # a file of another may be no scan, such as a mesh
        if any(_SCAN.fullmatch(name) and name.endswith(ending) for name in names):
            return FolderLayout("points", f"NAME{ending}", (root, re.compile(rf"([^.].*)\{ending}")))
    return None


def whole_image(path: Path, flags: int) -> NDArray[Any] | None:
    """Decode an image with OpenCV's `flags`; None while it is incomplete, or if it is damaged."""
    raw = path.read_bytes() if path.stat().st_size <= read_limits.MAX_FILE_BYTES else b""
    if not raw.endswith(_PNG_END if path.suffix == ".png" else _JPEG_END):
        return None
    return decode_image(BytesIO(raw), flags)


def whole_scan(path: Path) -> Scan | None:
    """Read points; None while the file is incomplete, or if it is damaged.

    Raises:
        DatasetError: a `.bin` file holds no points of four numbers.
    """
    is_raw, nbytes = path.suffix == ".bin", path.stat().st_size
    try:
        return None if is_raw and (not nbytes or nbytes % _POINT) else read_scan(path)
    except DatasetError:
        if is_raw:
            raise
        return None


def depth_of(image: NDArray[Any]) -> NDArray[Any]:
    """Set pixels that were not measured to 0, in place."""
    if image.dtype == np.uint16:
        image[image == _NOT_MEASURED] = 0
    return image
