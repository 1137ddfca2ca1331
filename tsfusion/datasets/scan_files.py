# SPDX-License-Identifier: MIT
"""A LiDAR's scans from files: raw floats, PCD, PLY, LAS and LAZ."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, MissingDependency

SUFFIXES = (".bin", ".pcd", ".ply", ".las", ".laz")
_HEADER_BYTES = 1 << 14
USUAL_FIELDS = 4  # float32 a point of raw floats: x, y, z and the intensity


def read_scan(path: Path, *, fields: int = USUAL_FIELDS) -> NDArray[np.float32]:
    """(n, 3) metres in the LiDAR's axes, in the order of the file.

    Args:
        fields: float32 numbers a point in a `.bin` file, x, y and z first; other formats say it themselves.

    Raises:
        DatasetError: the file is missing, empty, damaged, or holds something else.
        MissingDependency: for PCD without pypcd4, for LAS and LAZ without laspy.
    """
    suffix = path.suffix.lower()
    try:
        if path.stat().st_size == 0:
            raise DatasetError(f"{path} holds no points; expected x, y and z of a scan")
        points = _raw(path, fields) if suffix == ".bin" else _READERS[suffix](path)
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror or error}") from error
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise DatasetError(f"{path} holds no points; expected x, y and z of a scan")
    return np.ascontiguousarray(points, np.float32)


def _raw(path: Path, fields: int) -> NDArray[np.float32]:
    numbers = np.fromfile(path, "<f4")
    if path.stat().st_size % (4 * fields):
        raise DatasetError(
            f"{path} has {path.stat().st_size} bytes; expected {4 * fields} a point: {_float32(fields)} "
            "(--option fields=3 for x, y, z alone)"
        )
    points = numbers.reshape(-1, fields)
    if fields == USUAL_FIELDS and (points[:, 3] < 0).any():
        raise DatasetError(
            f"{path} has intensities below 0; expected {_float32(fields)} a point: say how many numbers a "
            "point has (--option fields=3 for x, y, z alone)"
        )
    return points[:, :3]


def _float32(fields: int) -> str:
    more = {3: "", 4: " and the intensity"}.get(fields, f" and {fields - 3} more")
    return f"float32 x, y, z{more}"


def _pcd(path: Path) -> NDArray[np.float32]:
    try:
        from pypcd4.pypcd4 import PointCloud
    except ImportError as error:
        raise MissingDependency("to read PCD: pip install pypcd4 (or '.[lidar]')") from error
    try:
        read = PointCloud.from_path(path)
        points = np.asarray(read.numpy(("x", "y", "z")))
        _check_count(path, len(points), int(read.metadata.points))
        return points
    except (OSError, DatasetError):
        raise
    except Exception as error:
        raise _broken(path, "PCD with the fields x, y and z", error) from error


def _ply(path: Path) -> NDArray[np.float32]:
    import trimesh

    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
            file.seek(0)
            read = trimesh.load(file, file_type="ply", process=False)
        points = np.asarray(read.vertices, np.float32)
        if promised := re.search(rb"^element\s+vertex\s+([0-9]+)", head, re.MULTILINE):
            _check_count(path, len(points), int(promised[1]))
        return points
    except (OSError, DatasetError):
        raise
    except Exception as error:
        raise _broken(path, "PLY with the vertices' x, y and z", error) from error


def _las(path: Path) -> NDArray[np.float32]:
    try:
        import laspy
    except ImportError as error:
        raise MissingDependency("to read LAS or LAZ: pip install 'laspy[lazrs]' (or '.[mesh]')") from error
    try:
        read = laspy.read(path)
        points = np.asarray(read.xyz, np.float32)
        with laspy.open(path) as opened:  # what was read has a header of its own
            _check_count(path, len(points), opened.header.point_count)
        return points
    except (OSError, DatasetError):
        raise
    except Exception as error:
        raise _broken(path, "LAS or LAZ", error) from error


def _check_count(path: Path, count: int, promised: int) -> None:
    if count != promised:
        raise DatasetError(f"{path} was cut off: it has {count} of the {promised} points that it names")


def _broken(path: Path, expected: str, error: Exception) -> DatasetError:
    first = (str(error) or type(error).__name__).splitlines()[0]
    return DatasetError(f"{path} is damaged ({first}); expected {expected}")


_READERS: dict[str, Callable[[Path], NDArray[np.float32]]] = {
    ".pcd": _pcd, ".ply": _ply, ".las": _las, ".laz": _las,
}  # fmt: skip
