# SPDX-License-Identifier: MIT
"""Text lists of time-stamped images, as TUM's tools write them, matched by time."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import nearest_in_time, require_one_clock
from tsfusion.datasets.readers import listed_file, read_lines
from tsfusion.datasets.trajectory_files import nanoseconds

ASSOCIATIONS = ("associations.txt", "association.txt", "associated.txt")


class ImageList(NamedTuple):
    """Images of a recording in time order."""

    timestamps_ns: list[int]  # nanoseconds of each depth image
    depth: list[Path]  # files of the depth images
    # As many files, None where none is near in time; empty where the recording has no colour
    color: list[Path | None]


def read_recording(root: Path, *, max_difference_ns: int) -> ImageList:
    """`depth.txt` with `rgb.txt` where it exists, or a list of pairs in one of `ASSOCIATIONS` alone.

    Raises:
        DatasetError: a malformed line, an empty list, most listed images are missing.
    """
    pairs = next((root / name for name in ASSOCIATIONS if (root / name).is_file()), None)
    if pairs is not None and not (root / "depth.txt").exists():
        return _read_pairs(pairs)
    depth = _read_list(root / "depth.txt")
    stamps, files = [stamp for stamp, _ in depth], [path for _, path in depth]
    if not (root / "rgb.txt").exists():
        return ImageList(stamps, files, [])
    color = _nearest_images(_read_list(root / "rgb.txt"), stamps, max_difference_ns)
    return ImageList(stamps, files, color)


def _nearest_images(
    listed: list[tuple[int, Path]], stamps_ns: list[int], max_difference_ns: int
) -> list[Path | None]:
    """The image nearest to each stamp, None where it is too far in time."""
    own, wanted = np.array([stamp for stamp, _ in listed], np.int64), np.array(stamps_ns, np.int64)
    nearest = nearest_in_time(own, wanted)
    near = np.abs(own[nearest] - wanted) <= max_difference_ns
    return [listed[i][1] if ok else None for i, ok in zip(nearest, near, strict=True)]


def _read_list(path: Path) -> list[tuple[int, Path]]:
    """(timestamp_ns, image) in time order."""
    content = "`timestamp path` a line"
    images: list[tuple[int, Path]] = []
    for number, line in read_lines(path, content):
        words = line.split(maxsplit=1)
        if len(words) != 2:
            raise DatasetError(f"{path}:{number}: {line!r}; expected {content}")
        images.append((nanoseconds(words[0], path, number), listed_file(path.parent, words[1])))
    _check(path, [image for _, image in images], content)
    require_one_clock([stamp for stamp, _ in images], path)
    return sorted(set(images))  # a line may be there twice


def _read_pairs(path: Path) -> ImageList:
    """`stamp path stamp path` (ICL-NUIM, TUM's `associate.py`); `depth` in a path tells which it is."""
    content = "`timestamp depth/… timestamp rgb/…` a line, in either order"
    rows: list[tuple[int, Path, Path]] = []
    for number, line in read_lines(path, content):
        words = line.split()
        if len(words) != 4 or ("depth" in words[1].lower()) == ("depth" in words[3].lower()):
            raise DatasetError(f"{path}:{number}: {line!r}; expected {content}")
        depth, color = (0, 2) if "depth" in words[1].lower() else (2, 0)
        stamp = nanoseconds(words[depth], path, number)
        rows.append(
            (stamp, listed_file(path.parent, words[depth + 1]), listed_file(path.parent, words[color + 1]))
        )
    _check(path, [file for row in rows for file in row[1:]], content)
    require_one_clock([row[0] for row in rows], path)
    rows = sorted(set(rows))
    return ImageList([row[0] for row in rows], [row[1] for row in rows], [row[2] for row in rows])


def _check(path: Path, images: list[Path], content: str) -> None:
    if not images:
        raise DatasetError(f"{path} lists no images; expected {content}")
    missing = [image for image in images if not image.is_file()]
    if 2 * len(missing) > len(images):
        raise DatasetError(
            f"{missing[0]} is missing ({len(missing)} of {len(images)} images that {path} lists)"
        )
