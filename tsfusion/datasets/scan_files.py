# SPDX-License-Identifier: MIT
"""Read scans of a LiDAR from files (raw floats, PCD, PLY, LAS, LAZ), with the times of their points.

No file states the unit and the clock of such times.
"""

import logging
import re
from collections.abc import Callable, Iterable
from io import BufferedReader, BytesIO
from math import isclose
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import limits
from tsfusion.core.errors import DatasetError, InvalidConfig, TsfusionError, needing
from tsfusion.geometry import origin
from tsfusion.geometry.keyframe import are_far
from tsfusion.geometry.origin import System
from tsfusion.geometry.sweeps import skewed
from tsfusion.geometry.trajectory import Trajectory

log = logging.getLogger(__name__)

SUFFIXES = (".bin", ".pcd", ".ply", ".las", ".laz")
USUAL_FIELDS = 4  # float32 numbers for each point of a raw file: x, y, z, intensity
_HEADER_BYTES = 1 << 14
_WKT, _CODE, _GEOGRAPHIC, _UNIT, _HEIGHT, _HEIGHT_UNIT = 2112, 3072, 2048, 3076, 4096, 4099  # GeoTIFF's keys
_UNITS = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}  # EPSG code → metres
_HEIGHTS = {6360: 9003, 8228: 9002}  # height system → unit, if not metres
_FIELD = re.compile(
    r"(?:scalar_?)?(?:t|ts|time_?stamp|(?:gps|point|offset|rel|relative|delta)?_?time(?:_?offset)?)"
    r"(?:_(s|sec|ms|us|ns))?",
    re.IGNORECASE,
)
_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SHORTEST_S, _LONGEST_S = 0.003, 0.6  # length of a sweep; a packet of points is shorter
_FRAMES = 3.0  # longest sweep, as a multiple of the frame interval: two sensors may alternate
_NEAR_S = 1.2  # a time nearer to the stamp is of the stamp's clock
_NO_COORDINATE, _FEW = 1e9, 0.1  # metres, of any unit; share of such numbers that may be broken
_FEWEST, _BACKWARDS = 8, -0.9  # points; correlation of times with the file's order
_COARSE = 0.01  # of a sweep; numbers with larger steps are too coarse for its times
_WIDTHS, _CLEARLY = range(3, 9), 0.5  # numbers a point; difference of logarithms
_NEXT = (11, 13, 17)  # points farther on, whose numbers are compared
_FEWEST_TRIED, _TRIED = 2000, 20_000  # numbers


class Scan(NamedTuple):
    """Points of one sweep, and their times as written in the file."""

    points: NDArray[np.floating]  # (N, 3) metres in the LiDAR's axes, or the file's system; NaN = no return
    time_field: str | None = None  # None = no times
    moments: NDArray[Any] | None = None  # (N,) values of the time field
    color: NDArray[np.uint8] | None = None  # (N, 3) BGR
    system: System | None = None  # named by the file


class PointTimes(NamedTuple):
    """Seconds of points after a stamp, (N,) float32; or the reason why recorded times are of no use."""

    point_times_s: NDArray[np.float32] | None = None
    untimed: str = ""


def say_labels_are_unused(place: Path) -> None:
    """Log a warning if a folder has labels of points (SemanticKITTI), which nothing here reads."""
    if (place / "labels").is_dir():
        log.warning("%s: the labels are not used; what moves is fused, too", place)


def time_field(names: Iterable[str]) -> str | None:
    """Return the name of the field with the times of points, as drivers and programs call it, or None."""
    return next((name for name in names if _FIELD.fullmatch(name)), None)


def point_times(scan: Scan, stamp_ns: int, between_s: float = 1.0) -> PointTimes:
    """Read the times of a sweep's points.

    The field's name may give the unit (`time_us`). Otherwise the unit is the largest of s, ms, µs and ns that
    gives a possible length of a sweep. Drivers write Ouster `t` and Livox `offset_time` in ns, Velodyne
    `time` in s, Hesai `timestamp` in absolute s, Livox `timestamp` in absolute ns, LAS `gps_time` in s. Times
    that count neither by the stamp's clock nor from the stamp are counted from the sweep's first point. Times
    that fall, or begin anew, in the order of the points are not used.

    Args:
        stamp_ns: stamp of the frame; 0 = no stamp.
        between_s: seconds between two frames.
    """
    points, field, moments = scan[:3]
    if field is None or moments is None:
        return PointTimes()
    values = moments.astype(np.float64 if moments.dtype.kind == "f" else np.int64)
    known = np.isfinite(values) & np.isfinite(points).all(axis=1) & points.any(axis=1)
    if not known.any():
        return PointTimes()
    first, last = values[known].min().item(), values[known].max().item()
    span, longest_s = float(last - first), min(_LONGEST_S, _FRAMES * between_s)
    step = np.spacing(np.abs([first, last]).astype(moments.dtype)).max() if moments.dtype.kind == "f" else 0
    named = _FIELD.fullmatch(field)
    units = [_UNITS_S[named[1].lower().replace("sec", "s")]] if named and named[1] else _UNITS_S.values()
    unit = next((unit for unit in units if span * unit <= longest_s), 0.0)
    if span <= 0:
        return PointTimes(untimed=skewed(f"{field} is the same for all points"))
    if step > _COARSE * span:
        return PointTimes(untimed=skewed(f"{moments.dtype.name} is too coarse for {field}"))
    if span * unit < _SHORTEST_S:
        sweep = f"{_SHORTEST_S:g} to {longest_s:.2g} s"
        return PointTimes(untimed=skewed(f"{field} spans {span:.6g}, in any unit no sweep of {sweep}"))
    if disorder := _disorder((values[known] - first).astype(np.float64), span):
        return PointTimes(untimed=skewed(f"{field} {disorder}; if it is right, sort the points by it"))
    start_s = float(first) * unit
    if abs(start_s) > _NEAR_S:
        start_s -= stamp_ns * 1e-9
    start_s = start_s if abs(start_s) <= _NEAR_S else 0.0
    return PointTimes(np.where(known, start_s + (values - first) * unit, start_s).astype(np.float32))


def _disorder(times: NDArray[np.float64], span: float) -> str:
    """Return a sign of wrong times, (N,) in the file's order, or "". A file may have ring after ring."""
    if len(times) > _FEWEST and np.corrcoef(np.arange(len(times)), times)[0, 1] < _BACKWARDS:
        return "falls from the first point to the last"
    wrapped = np.count_nonzero(np.diff(times) < -span / 2) == 1 and times[0] > times[-1]
    return "begins anew within the sweep" if wrapped else ""


def times_on(scan: Scan, trajectory: Trajectory) -> NDArray[np.float64]:
    """Return (N,) ns of a scan's points, in the first unit that puts any on a trajectory; NaN = not on it."""
    first, last = trajectory.timestamps_ns[[0, -1]]
    for unit_s in () if scan.moments is None else _UNITS_S.values():
        times = np.asarray(scan.moments) * (unit_s * 1e9)
        if (is_on := (times >= first) & (times <= last)).any():
            return np.where(is_on, times, np.nan)
    return np.full(len(scan.points), np.nan)


def read_scan(path: Path, *, fields: int = USUAL_FIELDS) -> Scan:
    """Read a scan, in the file's order. It is float64 if the file has more digits than float32.

    Args:
        fields: float32 numbers for each point of a `.bin` file, x, y and z first. Other formats tell it.

    Raises:
        DatasetError: the file is missing, empty, cut off, damaged, or holds something else.
        InvalidConfig: the coordinates are degrees, or in an unknown unit.
        MissingDependency: pypcd4 is missing for PCD, laspy for LAS, or pyproj for the reference system.
    """
    suffix = path.suffix.lower()
    try:
        limits.check(path, path.stat().st_size)
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
        raise DatasetError(f"{path} was cut off: it has {len(points)} of the {promised} points stated")
    if scan.system is not None and scan.system.metres != System().metres and not are_far(points):
        unit = max(scan.system.metres, key=lambda one: abs(one - 1))
        raise DatasetError(
            f"{path} has a coordinate reference system in units of {unit:.9g} m, but its points lie near "
            "zero, as in a sensor's frame; expected metres there"
        )
    kind = np.float32 if points.dtype == np.float32 else np.float64
    return scan._replace(points=np.ascontiguousarray(points, kind))


def _raw(path: Path, fields: int) -> tuple[Scan, int]:
    expected = f"expected {fields} float32 a point, x, y and z first (of scans in a folder --option fields=N)"
    if (nbytes := path.stat().st_size) % (4 * fields):
        raise DatasetError(f"{path} has {nbytes} bytes, not {4 * fields} a point; {expected}")
    numbers = np.fromfile(path, "<f4")
    if (width := _width(numbers, fields)) != fields:
        raise DatasetError(
            f"{path} seems to have {width} numbers a point, not {fields} (nuScenes has 5, of which the last "
            f"is the number of the laser): --option fields={width}"
        )
    points = numbers.reshape(-1, fields)
    if fields == USUAL_FIELDS and (points[:, 3] < 0).any():
        raise DatasetError(f"{path} has intensities below 0; {expected}")
    if (np.abs(points[:, :3]) > _NO_COORDINATE).mean() > _FEW:
        raise DatasetError(f"{path} holds no coordinates, but numbers above 1e9; {expected}, little-endian")
    return Scan(points[:, :3]), len(points)


def _width(numbers: NDArray[np.float32], fields: int) -> int:
    """Return the count of numbers a point: `fields`, unless another alone makes columns of like numbers."""
    some = np.nan_to_num(numbers[:_TRIED], nan=_NO_COORDINATE).astype(np.float64)
    if len(some) < _FEWEST_TRIED:
        return fields
    apart = {
        width: np.mean([np.log(np.abs(some[n * width :] - some[: -n * width]) + 1e-3).mean() for n in _NEXT])
        for width in {*_WIDTHS, fields}
    }
    best = min((width for width in apart if numbers.size % width == 0), key=apart.__getitem__)
    is_alike = apart[fields] > np.median([*apart.values()]) - _CLEARLY / 2  # as alike as by a wrong count
    return best if is_alike and apart[fields] - apart[best] > _CLEARLY else fields


# Each function returns the points, and the number of points in the file's header.


def _pcd(path: Path) -> tuple[Scan, int]:
    with needing("PCD files need pypcd4: pip install pypcd4 (or '.[lidar]')"):
        from pypcd4.pypcd4 import PointCloud
    content = path.read_bytes()
    head = content[:_HEADER_BYTES]
    sizes = re.search(rb"^DATA binary_?s?compressed\r?\n....(.{4})", head, re.MULTILINE | re.DOTALL)
    limits.check(path, int.from_bytes(sizes[1], "little") if sizes else 0)
    whole = BytesIO(_without_empty_fields(head) + content[_HEADER_BYTES:])
    read = PointCloud.from_fileobj(BufferedReader(whole))
    points = np.asarray(read.numpy(("x", "y", "z")))
    return _timed(points, read.fields, read.pc_data), int(read.metadata.points)


def _without_empty_fields(head: bytes) -> bytes:
    """Return the start of a PCD file without fields of COUNT 0, which are empty."""
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
    with needing("LAS, LAZ need laspy: pip install 'laspy[lazrs]' (or '.[mesh]')"):
        import laspy
    with laspy.open(path) as opened:
        named = opened.header.point_count  # read first: `read` changes it
        limits.check(path, named * opened.header.point_format.size)
        system, read = _system_in(opened.header), opened.read()
        scan = _timed(np.asarray(read.xyz), read.point_format.dimension_names, read)
        return scan._replace(system=system), named


def _system_in(header: Any) -> System | None:
    """Return the coordinate reference system in a LAS file's header, from WKT or GeoTIFF keys, or None."""
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
    """Return a scan of (N, 3) points; times come from the named columns, if one of them has times."""
    field = time_field(names)
    return Scan(points) if field is None else Scan(points, field, np.ravel(values[field]))


_READERS: dict[str, Callable[[Path], tuple[Scan, int]]] = {
    ".pcd": _pcd, ".ply": _ply, ".las": _las, ".laz": _las,
}  # fmt: skip
