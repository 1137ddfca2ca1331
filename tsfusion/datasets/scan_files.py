# SPDX-License-Identifier: MIT
"""A LiDAR's scans from files: raw floats, PCD, PLY, LAS and LAZ."""

import re
from collections.abc import Callable, Iterable
from io import BufferedReader, BytesIO
from math import isclose
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import read_limits
from tsfusion.core.errors import DatasetError, InvalidConfig, MissingDependency, TsfusionError
from tsfusion.datasets.point_times import Scan, time_field
from tsfusion.geometry import origin
from tsfusion.geometry.keyframe import are_far
from tsfusion.geometry.origin import System

SUFFIXES = (".bin", ".pcd", ".ply", ".las", ".laz")
USUAL_FIELDS = 4  # float32 a point of raw floats: x, y, z and the intensity
_HEADER_BYTES = 1 << 14
_WKT, _CODE, _GEOGRAPHIC, _UNIT, _HEIGHT, _HEIGHT_UNIT = 2112, 3072, 2048, 3076, 4096, 4099  # GeoTIFF's keys
_UNITS = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}  # metres, by EPSG's codes
_HEIGHTS = {6360: 9003, 8228: 9002}  # units of heights that are no metres


def read_scan(path: Path, *, fields: int = USUAL_FIELDS) -> Scan:
    """Read a scan, in the order of the file; float64 where the file has more digits than float32.

    Args:
        fields: float32 numbers a point in a `.bin` file, x, y and z first; other formats say it themselves.

    Raises:
        DatasetError: the file is missing, empty, cut off, damaged, or holds something else.
        InvalidConfig: its coordinates are degrees, or in a unit that is not known.
        MissingDependency: for PCD without pypcd4, for LAS without laspy, for its system without pyproj.
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
    except InvalidConfig as error:
        raise InvalidConfig(f"{path}: {error}") from error
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
    if scan.system is not None and scan.system.metres != System().metres and not are_far(points):
        unit = max(scan.system.metres, key=lambda one: abs(one - 1))
        raise DatasetError(
            f"{path} names a system with units of {unit:.9g} m, but its points lie near zero, as a "
            "sensor's do; expected metres there"
        )
    kind = np.float32 if points.dtype == np.float32 else np.float64
    return scan._replace(points=np.ascontiguousarray(points, kind))


def _raw(path: Path, fields: int) -> tuple[Scan, int]:
    expected = f"expected {fields} float32 a point, x, y and z first (of scans in a folder --option fields=N)"
    if (nbytes := path.stat().st_size) % (4 * fields):
        raise DatasetError(f"{path} has {nbytes} bytes, not {4 * fields} a point; {expected}")
    points = np.fromfile(path, "<f4").reshape(-1, fields)
    if fields == USUAL_FIELDS and (points[:, 3] < 0).any():
        raise DatasetError(f"{path} has intensities below 0; {expected}")
    return Scan(points[:, :3]), len(points)


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
    points = np.asarray(read.vertices, vertices["properties"]["x"])
    scan = _timed(points, vertices["properties"], vertices["data"])
    return scan, len(scan.points) if named is None else int(named[1])


def _las(path: Path) -> tuple[Scan, int]:
    try:
        import laspy
    except ImportError as error:
        raise MissingDependency("to read LAS or LAZ: pip install 'laspy[lazrs]' (or '.[mesh]')") from error
    with laspy.open(path) as opened:
        named = opened.header.point_count  # before it is told what was found
        read_limits.check(path, named * opened.header.point_format.size)
        system, read = _system_in(opened.header), opened.read()
        scan = _timed(np.asarray(read.xyz), read.point_format.dimension_names, read)
        return scan._replace(system=system), named


def _system_in(header: Any) -> System | None:
    """The coordinate reference system that the head of a LAS file names, as WKT or GeoTIFF; None = none."""
    named = [*header.vlrs, *(header.evlrs or [])]
    text = next((one.string for one in named if one.record_id == _WKT and getattr(one, "string", "")), "")
    keys = {key.id: key.value_offset for one in named for key in getattr(one, "geo_keys", ())}
    if text or not keys:
        return origin.system(text) if text else None
    known = origin.system(f"EPSG:{keys.get(_CODE, keys.get(_GEOGRAPHIC, 0))}")
    unit = _UNITS.get(keys.get(_UNIT, 0), known.metres[0])
    upward = _UNITS.get(keys.get(_HEIGHT_UNIT) or _HEIGHTS.get(keys.get(_HEIGHT, 0), 0), unit)
    return System(known.crs if isclose(unit, known.metres[0]) else "", (unit, unit, upward))


def _timed(points: NDArray[Any], names: Iterable[str], values: Any) -> Scan:
    """A scan with the times among named values, where there are some."""
    field = time_field(names)
    return Scan(points) if field is None else Scan(points, field, np.ravel(values[field]))


_READERS: dict[str, Callable[[Path], tuple[Scan, int]]] = {
    ".pcd": _pcd, ".ply": _ply, ".las": _las, ".laz": _las,
}  # fmt: skip
