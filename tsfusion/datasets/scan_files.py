# SPDX-License-Identifier: MIT
"""A LiDAR's scans from files: raw floats, PCD, PLY, LAS and LAZ."""

import re
from collections.abc import Callable, Iterable
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import read_limits
from tsfusion.core.errors import DatasetError, MissingDependency, TsfusionError
from tsfusion.datasets.point_times import Scan, time_field

SUFFIXES = (".bin", ".pcd", ".ply", ".las", ".laz")
USUAL_FIELDS = 4  # float32 a point of raw floats: x, y, z and the intensity
_HEADER_BYTES = 1 << 14


def read_scan(path: Path, *, fields: int = USUAL_FIELDS) -> Scan:
    """Read a scan, in the order of the file.

    Args:
        fields: float32 numbers a point in a `.bin` file, x, y and z first; other formats say it themselves.

    Raises:
        DatasetError: the file is missing, empty, cut off, damaged, or holds something else.
        MissingDependency: for PCD without pypcd4, for LAS and LAZ without laspy.
    """
    suffix = path.suffix.lower()
    try:
        read_limits.check(path, path.stat().st_size)
        if path.stat().st_size == 0:
            scan, promised = Scan(np.zeros((0, 3), np.float32)), 0
        elif suffix == ".bin":
            scan, promised = _raw(path, fields)
        else:
            scan, promised = _READERS[suffix](path)
    except TsfusionError:
        raise
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror or error}") from error
    except Exception as error:  # of a library, about what it found
        first = (str(error) or type(error).__name__).splitlines()[0]
        expected = f"{suffix[1:].upper()} with x, y and z of each point"
        raise DatasetError(f"{path} is damaged ({first}); expected {expected}") from error
    points = scan.points
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise DatasetError(f"{path} holds no points; expected x, y and z of a scan")
    if len(points) != promised:
        raise DatasetError(f"{path} was cut off: it has {len(points)} of the {promised} points that it names")
    return scan._replace(points=np.ascontiguousarray(points, np.float32))


def _raw(path: Path, fields: int) -> tuple[Scan, int]:
    more = {3: "", 4: " and the intensity"}.get(fields, f" and {fields - 3} more")
    hint = "" if fields == 3 else " (--option fields=3 for x, y, z alone)"
    expected = f"expected float32 x, y, z{more}{hint}"
    if (nbytes := path.stat().st_size) % (4 * fields):
        raise DatasetError(f"{path} has {nbytes} bytes, not {4 * fields} a point; {expected}")
    points = np.fromfile(path, "<f4").reshape(-1, fields)
    if fields == USUAL_FIELDS:
        check_intensities(points, path, expected)
    return Scan(points[:, :3]), len(points)


def check_intensities(points: NDArray[np.float32], path: Path, expected: str) -> None:
    """Refuse (n, 4) numbers of a file whose points are of three or five numbers.

    Raises:
        DatasetError: an intensity is below 0.
    """
    if (points[:, 3] < 0).any():
        raise DatasetError(f"{path} has intensities below 0; {expected}")


# Each reads the points, and how many the file's header names.


def _pcd(path: Path) -> tuple[Scan, int]:
    try:
        from pypcd4.pypcd4 import PointCloud
    except ImportError as error:
        raise MissingDependency("to read PCD: pip install pypcd4 (or '.[lidar]')") from error
    content = path.read_bytes()
    head = content[:_HEADER_BYTES]
    sizes = re.search(rb"^DATA binary_?s?compressed\r?\n....(.{4})", head, re.MULTILINE | re.DOTALL)
    read_limits.check(path, int.from_bytes(sizes[1], "little") if sizes else 0)
    whole = BytesIO(_without_empty_fields(head) + content[_HEADER_BYTES:])
    read = PointCloud.from_fileobj(BufferedReader(whole))
    points = np.asarray(read.numpy(("x", "y", "z")))
    return _timed(points, read.fields, read.pc_data), int(read.metadata.points)


def _without_empty_fields(head: bytes) -> bytes:
    """The start of a PCD file without fields of COUNT 0, which hold nothing."""
    counts = re.search(rb"^COUNT +([0-9 ]+)", head, re.MULTILINE)
    kept = [bool(int(count)) for count in counts[1].split()] if counts else []
    if all(kept):
        return head

    def without(line: re.Match[bytes]) -> bytes:
        words = line[2].split()
        return line[1] + b"".join(b" " + word for word, keep in zip(words, kept, strict=True) if keep)

    return re.sub(rb"^(FIELDS|SIZE|TYPE|COUNT) +([^\r\n]*[^\s])", without, head, count=4, flags=re.MULTILINE)


def _ply(path: Path) -> tuple[Scan, int]:
    import trimesh

    with path.open("rb") as file:
        named = re.search(rb"^element\s+vertex\s+([0-9]+)", file.read(_HEADER_BYTES), re.MULTILINE)
        file.seek(0)
        read = trimesh.load(file, file_type="ply", process=False)
    vertices = read.metadata["_ply_raw"]["vertex"]
    scan = _timed(np.asarray(read.vertices), vertices["properties"], vertices["data"])
    return scan, len(scan.points) if named is None else int(named[1])


def _las(path: Path) -> tuple[Scan, int]:
    try:
        import laspy
    except ImportError as error:
        raise MissingDependency("to read LAS or LAZ: pip install 'laspy[lazrs]' (or '.[mesh]')") from error
    with laspy.open(path) as opened:
        named = opened.header.point_count  # before it is told what was found
        read_limits.check(path, named * opened.header.point_format.size)
        read = opened.read()
        return _timed(np.asarray(read.xyz), read.point_format.dimension_names, read), named


def _timed(points: NDArray[Any], names: Iterable[str], values: Any) -> Scan:
    """A scan with the times among named values, where there are some."""
    field = time_field(names)
    return Scan(points) if field is None else Scan(points, field, np.asarray(values[field]))


_READERS: dict[str, Callable[[Path], tuple[Scan, int]]] = {
    ".pcd": _pcd, ".ply": _ply, ".las": _las, ".laz": _las,
}  # fmt: skip
