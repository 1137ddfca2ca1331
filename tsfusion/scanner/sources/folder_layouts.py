# SPDX-License-Identifier: MIT
"""Layouts of watched folders: the files of a frame, and whether they are complete."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tsfusion.datasets.formats.image_folders import COLOR
from tsfusion.datasets.scan_files import SUFFIXES

LayoutKind = Literal["depth", "pair", "points"]

EXPECTED = (
    "depth/NAME.png|tiff|exr|npy with color/, colour/, rgb/, image/ or images/NAME.png|jpg; "
    "frame-*.depth.png with frame-*.color.png|jpg; left/ and right/NAME.png|jpg; "
    "NAME.bin|pcd|ply|las|laz, there or in velodyne/"
)

_ENDINGS = (r"\.(?:png|jpe?g)", r"\.(?:png|tiff?|exr|npy)", r"\.(?:bin|pcd|ply|las|laz)")
_ANY_IMAGE, _DEPTH, _SCAN = (re.compile(rf"([^.].*){ending}") for ending in _ENDINGS)
_FLAT_DEPTH = re.compile(r"(frame-.+)\.depth\.png")
_PNG_END, _JPEG_END = b"\0\0\0\0IEND\xaeB`\x82", b"\xff\xd9"
_ENDS = {".png": _PNG_END, ".jpg": _JPEG_END, ".jpeg": _JPEG_END}
_POINT = 16  # bytes: x, y, z and intensity in float32


@dataclass(frozen=True)
class FolderLayout:
    """Folder and pattern of a frame's first file, whose group is its name; of the second what follows it.

    `files` are those of a frame in words.
    """

    kind: LayoutKind
    files: str
    first: tuple[Path, re.Pattern[str]]
    second: tuple[Path, str] | None = None

    def partner(self, name: str) -> Path | None:
        """Second file of a frame; None = not there."""
        if self.second is None:
            return None
        where, middle = self.second
        candidates = (where / f"{name}{middle}.{ending}" for ending in ("png", "jpg", "jpeg"))
        return next((path for path in candidates if path.exists()), None)


def layout_of(root: Path) -> FolderLayout | None:
    """Recognise the layout of the files so far; None = unknown."""
    if (root / "depth").is_dir():
        color = next((root / name for name in COLOR if (root / name).is_dir()), root / COLOR[0])
        return FolderLayout(
            "depth", f"depth/NAME.png|tiff|exr|npy with {color.name}/NAME.png|jpg", (root / "depth", _DEPTH),
            (color, ""),
        )  # fmt: skip
    if (root / "left").is_dir() and (root / "right").is_dir():
        return FolderLayout(
            "pair", "left/ and right/NAME.png|jpg", (root / "left", _ANY_IMAGE), (root / "right", "")
        )
    if (root / "velodyne").is_dir():
        return FolderLayout("points", "velodyne/NAME.bin|pcd|ply|las|laz", (root / "velodyne", _SCAN))
    names = [path.name for path in root.iterdir()]
    if any(_FLAT_DEPTH.fullmatch(name) for name in names):
        return FolderLayout(
            "depth", "frame-*.depth.png with frame-*.color.png|jpg", (root, _FLAT_DEPTH), (root, ".color")
        )
    for ending in SUFFIXES:  # a file of another may be no scan, such as a mesh
        if any(_SCAN.fullmatch(name) and name.endswith(ending) for name in names):
            return FolderLayout("points", f"NAME{ending}", (root, re.compile(rf"([^.].*)\{ending}")))
    return None


def is_whole(path: Path, *, settled: bool) -> bool:
    """True if a file is complete, by the mark at its end; by its `settled` state where it has none."""
    if path.suffix.lower() in _ENDS:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - len(_PNG_END)))
            return file.read().endswith(_ENDS[path.suffix.lower()])
    nbytes = path.stat().st_size
    return settled and nbytes > 0 and not (path.suffix == ".bin" and nbytes % _POINT)
