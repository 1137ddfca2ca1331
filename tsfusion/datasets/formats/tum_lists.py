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
        rows = _read(pairs, "`timestamp depth/… timestamp rgb/…` a line, in either order", 2)
        return ImageList(
            [row[0][0] for row in rows], [row[0][1] for row in rows], [row[1][1] for row in rows]
        )
    depth = [row[0] for row in _read(root / "depth.txt", "`timestamp path` a line", 1)]
    stamps, files = [stamp for stamp, _ in depth], [path for _, path in depth]
    if not (root / "rgb.txt").exists():
        return ImageList(stamps, files, [])
    listed = [row[0] for row in _read(root / "rgb.txt", "`timestamp path` a line", 1)]
    own, wanted = np.array([stamp for stamp, _ in listed], np.int64), np.array(stamps, np.int64)
    nearest = nearest_in_time(own, wanted)
    near = np.abs(own[nearest] - wanted) <= max_difference_ns
    color: list[Path | None] = [listed[i][1] if ok else None for i, ok in zip(nearest, near, strict=True)]
    return ImageList(stamps, files, color)


def _read(path: Path, content: str, images: int) -> list[tuple[tuple[int, Path], ...]]:
    """(timestamp_ns, image) of each line, in time order; of a pair depth first, as its path says."""
    rows: list[tuple[tuple[int, Path], ...]] = []
    for number, line in read_lines(path, content):
        words = line.split(maxsplit=1) if images == 1 else line.split()
        deep = ["depth" in name.lower() for name in words[1::2]]
        if len(words) != 2 * images or (images == 2 and deep[0] == deep[1]):
            raise DatasetError(f"{path}:{number}: {line!r}; expected {content}")
        pairs = zip(words[::2], words[1::2], strict=True)
        row = [(nanoseconds(stamp, path, number), listed_file(path.parent, name)) for stamp, name in pairs]
        rows.append(tuple(row if deep[0] or images == 1 else reversed(row)))
    if not rows:
        raise DatasetError(f"{path} lists no images; expected {content}")
    listed = [file for row in rows for _, file in row]
    missing = [file for file in listed if not file.is_file()]
    if 2 * len(missing) > len(listed):
        raise DatasetError(
            f"{missing[0]} is missing ({len(missing)} of {len(listed)} images that {path} lists)"
        )
    require_one_clock([row[0][0] for row in rows], path)
    return sorted(set(rows))  # a line may be there twice
