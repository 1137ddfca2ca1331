# SPDX-License-Identifier: MIT
"""Read and write trajectory files in the usual text formats."""

import logging
import re
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidKeyframe, errors_as
from tsfusion.core.readable_numbers import count_of
from tsfusion.datasets.dataset import require_one_clock
from tsfusion.datasets.readers import numbers, read_lines, read_numbers
from tsfusion.geometry.calibration_files import read_text
from tsfusion.geometry.inertial_sensors import SomeInertialSensor
from tsfusion.geometry.keyframe import check_pose
from tsfusion.geometry.origin import FARTHEST
from tsfusion.geometry.se3 import Transform, inverse, transform
from tsfusion.geometry.trajectory import Trajectory, quaternion, rigid

_T = TypeVar("_T")
_R = TypeVar("_R")
_RTABMAP_COLUMNS = 9
_EUROC_COLUMNS, _LONGEST_S = 8, 10  # at least; digits of whole seconds, at most
_VERTEX = "VERTEX_SE3:QUAT"
_SAME_M, _SAME_DEG = 0.01, 1.0  # two poses at one time with a smaller difference are one
_PART = re.compile(r"\b(?:q|quat|rot|orient)(?:[a-z_.]*[_.])?([wxyz])\b", re.IGNORECASE)  # of a quaternion

log = logging.getLogger(__name__)


def usable(
    source: object, items: Iterable[_T], read: Callable[[_T], _R | None], kind: str = "poses"
) -> list[_R | None]:
    """Return the pose that `read` makes of each item, None for a broken one. Log the first broken one.

    Args:
        kind: what they are, for the log, if not poses.

    Raises:
        DatasetError: most items are broken; the error is that of the first one.
    """
    poses: list[_R | None] = []
    broken: list[DatasetError] = []
    for item in items:
        try:
            poses.append(read(item))
        except DatasetError as error:
            broken.append(error)
            poses.append(None)
    if 2 * len(broken) > len(poses):
        raise broken[0]
    if broken:
        _warn_once(f"{source}: {len(broken)} of {len(poses)} {kind} are broken, the first: {broken[0]}")
    return poses


@lru_cache(maxsize=64)
def _warn_once(line: str) -> None:
    """Log a warning once, even if the same file is read again."""
    log.warning("%s", line)


def write_tum(path: Path, timestamps_ns: Sequence[int], poses: Sequence[Transform]) -> None:
    """Write lines of `timestamp tx ty tz qx qy qz qw`, nine decimals, for `read_tum` and common tools."""
    lines = ["# timestamp tx ty tz qx qy qz qw (T_world_camera)\n"]
    for stamp, T in zip(timestamps_ns, poses, strict=True):
        numbers_ = " ".join(f"{value:.9f}" for value in (*T[:3, 3], *quaternion(T[:3, :3])))
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {numbers_}\n")
    path.write_text("".join(lines), encoding="utf-8")


def nanoseconds(seconds: str, path: Path, line: int) -> int:
    """Convert decimal seconds to exact integer nanoseconds (a double holds a Unix stamp only to 0.2 µs)."""
    whole, _, fraction = seconds.partition(".")
    if not whole.isdigit() or (fraction and not fraction.isdigit()):
        try:
            stamp = round(float(seconds) * 1e9)
        except (ValueError, OverflowError) as error:
            raise DatasetError(f"{path}:{line}: timestamp must be seconds, got {seconds!r}") from error
    else:
        stamp = int(whole) * 1_000_000_000 + int((fraction + "000000000")[:9])
    if not 0 <= stamp < 2**63:
        raise DatasetError(f"{path}:{line}: timestamp must be seconds >= 0, got {seconds!r}")
    return stamp


def read_tum(path: Path) -> Trajectory:
    """Read lines of `timestamp tx ty tz qx qy qz qw` (TUM RGB-D and most SLAM systems); RTAB-Map adds an id.

    A header that names the quaternion's parts states their order. A line without a rigid pose makes a gap:
    poses are not interpolated across it.

    Raises:
        DatasetError: most lines are no poses, or two poses at one time differ.
    """
    content = "`timestamp tx ty tz qx qy qz qw` a line, or with RTAB-Map's id after it"

    def values(words: list[str], number: int) -> list[float]:
        has_id = len(words) == _RTABMAP_COLUMNS and words[-1].isdecimal()
        return _by_parts(numbers(path, number, words[:-1] if has_id else words, 8, content)[1:], order)

    order = _order(path, content) or "xyzw"
    return _read(path, content, None, partial(nanoseconds, path=path), values)


def read_euroc(path: Path) -> Trajectory:
    """Read EuRoC / ASL ground truth, T_world_body: lines of `ns, px, py, pz, qw, qx, qy, qz, …`.

    A header that names the quaternion's parts states their order.
    """
    content = "`ns,px,py,pz,qw,qx,qy,qz,…` a line"

    def stamp(word: str, line: int) -> int:
        if not word.isdecimal() or int(word) >= 2**63:
            raise DatasetError(f"{path}:{line}: timestamp must be nanoseconds, got {word!r}")
        return int(word)

    def values(words: list[str], number: int) -> list[float]:
        return _by_parts(numbers(path, number, words[1:8], 7, content), order)

    order = _order(path, content) or "wxyz"
    return _read(path, content, ",", stamp, values)


def read_axis_angles(path: Path) -> Trajectory:
    """Read lines of seconds, a rotation vector and a translation, world to camera (ARKitScenes)."""
    content = "`seconds rx ry rz x y z` a line, world to camera"

    def values(words: list[str], number: int) -> list[float]:
        row = np.array(numbers(path, number, words[1:], 6, content))
        T = inverse(transform(cv2.Rodrigues(row[:3])[0], row[3:]))
        return [*T[:3, 3], *quaternion(T[:3, :3])]

    return _read(path, content, None, partial(nanoseconds, path=path), values)


def _read(
    path: Path,
    content: str,
    separator: str | None,
    stamp_of: Callable[..., int],
    values_of: Callable[[list[str], int], list[float]],
) -> Trajectory:
    """Return the poses of a file's lines in time order; a broken line with a readable time gives NaN."""
    stamps: list[int] = []

    def read(line: tuple[int, str]) -> NDArray[np.float64]:
        stamps.append(-1)
        text = line[1] if separator else line[1].replace(",", " ")
        words = [word.strip() for word in text.split(separator)]
        stamps[-1] = stamp_of(words[0], line=line[0])
        values = np.array(values_of(words, line[0]))
        check_quaternion(values[3:], path, line[0])
        values[3:] /= np.linalg.norm(values[3:])
        return values

    rows = usable(path, _without_names(path, content), read)
    if not rows:
        raise DatasetError(f"{path} holds no poses; expected {content}")
    require_one_clock([stamp for stamp in stamps if stamp >= 0], path)
    times = np.array(stamps, np.int64)
    table = np.array([np.full(7, np.nan) if row is None else row for row in rows])
    order = np.argsort(times, kind="stable")[np.count_nonzero(times < 0) :]
    times, table = times[order], table[order]
    if words := twins(times, table):  # it is not known which one is right
        raise DatasetError(f"{path} has {words}; expected one pose at each time")
    first = np.unique(times, return_index=True)[1]
    return Trajectory(times[first], table[first, :3], table[first, 3:])


def _order(path: Path, content: str) -> str:
    """Return the order of a quaternion's parts, such as `wxyz`, as a header names it; empty without."""
    return next(filter(None, map(_parts_in, read_text(path, content).splitlines()[:30])), "")


def _parts_in(text: str) -> str:
    """Return the names of a quaternion's four parts in a line, in their order; empty if it names others."""
    found = "".join(_PART.findall(text)).lower()
    return found if sorted(found) == [*"wxyz"] else ""


def _by_parts(row: list[float], order: str) -> list[float]:
    """Return x y z qx qy qz qw of a row whose quaternion has another order."""
    return [*row[:3], *(row[3 + order.index(part)] for part in "xyzw")]


def _without_names(path: Path, content: str) -> list[tuple[int, str]]:
    """Return a file's numbered lines without a first one that names the quaternion's parts."""
    lines = read_lines(path, content)
    return lines[1:] if lines and _parts_in(lines[0][1]) else lines


def twins(times: NDArray[np.int64], table: NDArray[np.float64]) -> str:
    """Return text that describes different poses at one time; empty if there are none.

    Args:
        times: (n,) nanoseconds, in order.
        table: (n, 7) x y z qx qy qz qw.
    """
    one, other = table[:-1], table[1:]
    apart = np.linalg.norm(one[:, :3] - other[:, :3], axis=1)
    turned = 2 * np.degrees(np.arccos(np.minimum(np.abs((one[:, 3:] * other[:, 3:]).sum(axis=1)), 1)))
    found = np.flatnonzero((np.diff(times) == 0) & ((apart > _SAME_M) | (turned > _SAME_DEG)))
    if not len(found):
        return ""
    return (
        f"two poses at one time, {count_of(len(found), 'time')}, the first at {times[found[0]] / 1e9:.6f} s: "
        f"they are {apart[found].max():.3f} m and {turned[found].max():.2f}° apart at most"
    )


def check_quaternion(quaternion: Sequence[float] | NDArray[np.float64], path: Path, line: int) -> None:
    """Raise DatasetError, naming file and line, unless a quaternion's length is 1 ± 0.01."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 0.01:
        raise DatasetError(f"{path}:{line}: quaternion must have length 1, got {norm:.4g}")


def read_kitti(path: Path) -> list[Transform | None]:
    """Read lines of 3×4 row-major matrices: the pose of each frame, in order; None = a broken line."""
    return _read_rows(path, "12 numbers a line, a 3×4 row-major camera-to-world matrix", 12)


def read_matrix(path: Path) -> Transform:
    """Read the 4×4 camera-to-world matrix of a file (7-Scenes)."""
    table = read_numbers(path, "a 4×4 camera-to-world matrix", columns=4)
    if table.shape != (4, 4):
        raise DatasetError(f"{path} must hold 4 rows of 4 numbers, got {len(table)} rows")
    return checked_pose(table, path)


def read_matrix_rows(path: Path) -> list[Transform | None]:
    """Read 4×4 matrices from lines of 16 numbers (HoloLens folders); None = a broken line."""
    return _read_rows(path, "16 numbers a line, a 4×4 row-major camera-to-world matrix", 16)


def _read_rows(path: Path, content: str, columns: int) -> list[Transform | None]:
    lines = read_lines(path, content)
    if not lines:
        raise DatasetError(f"{path} is empty; expected {content}")

    def read(numbered: tuple[int, tuple[int, str]]) -> Transform:
        index, (line, text) = numbered
        row = np.array(numbers(path, line, _words(text), columns, content))
        return checked_pose(row.reshape(-1, 4), f"{path}, pose {index}")

    return usable(path, enumerate(lines), read)


def read_log(path: Path) -> list[tuple[int, Transform | None]]:
    """Read a Redwood / Open3D `.log`: for each pose three integers, then a 4×4 matrix; None = broken."""
    lines = read_lines(path, "a Redwood trajectory: three integers, then a 4×4 matrix, repeated")
    if len(lines) < 5:
        raise DatasetError(
            f"{path} has {len(lines)} lines; expected five a pose: three integers, then a 4×4 matrix"
        )
    heads = []
    for start in range(0, len(lines), 5):
        number, head = lines[start]
        words = head.split()
        if len(words) != 3 or not words[0].isdigit():
            raise DatasetError(f"{path}:{number}: three integers expected before each matrix, got {head!r}")
        heads.append(int(words[0]))

    def read(start: int) -> Transform:
        rows = [numbers(path, n, text.split(), 4, "a 4×4 matrix") for n, text in lines[start + 1 : start + 5]]
        if len(rows) < 4:
            raise DatasetError(f"{path}:{lines[-1][0]}: the file ends inside a pose; expected a 4×4 matrix")
        return checked_pose(np.array(rows), f"{path}:{lines[start][0]}")

    return list(zip(heads, usable(path, range(0, len(lines), 5), read), strict=True))


def read_blocks(path: Path) -> tuple[NDArray[np.int64] | None, list[Transform | None]]:
    """Read 4×4 matrices of four lines each, separated by spaces or commas.

    The last number of each is 1, or its time in seconds, as BALM and programs like it write it.
    """
    content = "four lines of four numbers a pose, with 1 or the time in seconds as the last number"
    rows = [(line, _words(text)) for line, text in read_lines(path, content)]
    if len(rows) % 4:
        raise DatasetError(f"{path} has {len(rows)} lines; expected {content}")
    corners = [rows[start + 3] for start in range(0, len(rows), 4)]
    is_timed = any(float(words[-1]) != 1 for _, words in corners if _is_number(words[-1]))
    stamps = [nanoseconds(words[-1], path, line) for line, words in corners] if is_timed else []

    def read(start: int) -> Transform:
        lines = rows[start : start + 4]
        T = np.array([numbers(path, line, words, 4, content) for line, words in lines])
        T[3, 3] = 1 if is_timed else T[3, 3]
        return checked_pose(T, f"{path}:{lines[0][0]}")

    poses = usable(path, range(0, len(rows), 4), read)
    if (np.diff(stamps) <= 0).any():
        raise DatasetError(f"{path}: times must rise from pose to pose; expected {content}")
    return np.array(stamps, np.int64) if is_timed else None, poses


def read_graph(path: Path) -> list[tuple[int, Transform | None]]:
    """Read the number and pose of each vertex of a pose graph, in g2o's format or gtsam_points'."""
    content = f"`{_VERTEX} id x y z qx qy qz qw` (g2o) or `vID x y z qx qy qz qw` a line"
    lines = [(line, text) for line, text in read_lines(path, content) if text.startswith((_VERTEX, "v"))]
    words = [re.sub(r"^v(?=\d)", "", text.removeprefix(_VERTEX)).split() for _, text in lines]
    found: list[int] = []

    def read(each: tuple[int, list[str]]) -> Transform:
        line, (name, *rest) = each
        found.append(-1)
        if not name.isdecimal():
            raise DatasetError(f"{path}:{line}: {name!r}; expected {content}")
        values = np.array(numbers(path, line, rest[:7], 7, content))
        check_quaternion(values[3:], path, line)
        found[-1] = int(name)
        return rigid(values[3:] / np.linalg.norm(values[3:]), values[:3])

    poses = usable(path, [(line, row or [""]) for (line, _), row in zip(lines, words, strict=True)], read)
    if not poses:
        raise DatasetError(f"{path} has no vertices; expected {content}")
    return [(number, T) for number, T in zip(found, poses, strict=True) if T is not None]


def read_poses(path: Path) -> tuple[NDArray[np.int64] | None, NDArray[np.float64]]:
    """Read a trajectory file, whose format is known by its first line.

    It is TUM (8 numbers, with RTAB-Map's ids 9), KITTI (12), 4×4 matrices in one line (16) or four, EuRoC's
    CSV, g2o's pose graph or Redwood's `.log` (3). Poses of the last two are sorted by their numbers.

    Returns:
        (n,) timestamps in nanoseconds, or None if the format has none; (n, 4, 4) poses, NaN for broken ones.

    Raises:
        DatasetError: the file is missing, or has another format.
    """
    kind, times = _kind(path), None
    if kind in ("tum", "euroc"):
        along = read_timed(path)
        poses = [rigid(q, t) for q, t in zip(along.quaternions, along.translations, strict=True)]
        return along.timestamps_ns, np.array(poses)
    if kind == "blocks":
        times, found = read_blocks(path)
    else:
        found = [T for _, T in sorted(read_numbered(path), key=lambda one: one[0])]
    return times, np.array([np.full((4, 4), np.nan) if T is None else T for T in found])


def read_numbered(path: Path) -> list[tuple[int, Transform | None]]:
    """Read the poses with the numbers that a `.log` or a pose graph states, else with their places from 0."""
    kind = _kind(path)
    if kind in _NUMBERED:
        return _NUMBERED[kind](path)
    if kind in _IN_ORDER:
        return [*enumerate(_IN_ORDER[kind](path))]
    if kind == "blocks":
        return [*enumerate(read_blocks(path)[1])]
    if kind in ("tum", "euroc"):
        return [(n, T if np.isfinite(T).all() else None) for n, T in enumerate(read_poses(path)[1])]
    raise DatasetError(
        f"{path} is no trajectory: expected 8 numbers a line (TUM), 9 (RTAB-Map), 12 (KITTI), 16 or 4 (4×4), "
        f"EuRoC's CSV, a pose graph (.g2o) or a Redwood .log, got {kind}"
    )


def read_timed(path: Path) -> Trajectory:
    """Read a trajectory with times: TUM's, EuRoC's, or 4×4 matrices with times."""
    kind = _kind(path)
    if kind == "blocks":
        times, poses = read_poses(path)
        if times is not None:
            return Trajectory.of(times, poses)
    return read_euroc(path) if kind == "euroc" else read_tum(path)


def has_times(path: Path) -> bool:
    """Return True for a trajectory with times, in a format of `read_timed`."""
    kind = _kind(path)
    return kind in ("tum", "euroc") or (kind == "blocks" and read_blocks(path)[0] is not None)


def is_log(path: Path) -> bool:
    """Return True for a Redwood `.log` trajectory, and for a file that `read_poses` cannot read."""
    return _kind(path) not in ("tum", "euroc", "blocks", "graph", *_IN_ORDER)


def _kind(path: Path) -> str:
    """Return the name of a trajectory's format, or the count of numbers in its first line."""
    lines = _without_names(path, "a trajectory: TUM, KITTI or .log")
    text = lines[0][1] if lines else ""
    words = _words(text)
    if words and (
        words[0].startswith(("VERTEX_", "EDGE_", "FIX", "PARAMS_")) or re.fullmatch(r"[ve]\d+", words[0])
    ):
        return "graph"
    if "," in text and len(words) >= _EUROC_COLUMNS and words[0].isdecimal() and len(words[0]) > _LONGEST_S:
        return "euroc"
    return _KINDS.get(len(words), str(len(words)))


def _words(text: str) -> list[str]:
    return text.replace(",", " ").split()


def _is_number(word: str) -> bool:
    return word.lstrip("+-").replace(".", "", 1).isdecimal()


def checked_pose(matrix: NDArray[np.float64], source: object) -> Transform:
    """Return a (3, 4) or (4, 4) matrix as a rigid (4, 4), or raise an error that names the `source`."""
    T = np.eye(4)
    T[: len(matrix)] = matrix
    with errors_as(DatasetError, source, InvalidKeyframe):
        return check_pose(T, farthest=FARTHEST)


_KINDS = {3: "log", 4: "blocks", 8: "tum", 9: "tum", 12: "kitti", 16: "rows"}  # by numbers in the first line
_NUMBERED = {"log": read_log, "graph": read_graph}
_IN_ORDER = {"kitti": read_kitti, "rows": read_matrix_rows}


def read_table(
    sensor: SomeInertialSensor, path: Path, content: str, *, separator: str | None, first: int
) -> SomeInertialSensor:
    """Add a table, if there is one, to an inertial sensor: a stamp, and three values from column `first` on.

    Stamps are integer nanoseconds, or seconds if they contain a decimal point. A first line of names is left
    out. Broken lines are left out with a warning, and so is a table of which most lines are broken.
    """

    def row(numbered: tuple[int, str]) -> tuple[int, list[float]]:
        number, words = numbered[0], numbered[1].split(separator)
        if len(words) < first + 3:
            raise DatasetError(f"{path}:{number}: {numbered[1]!r}; expected {content}")
        stamp = words[0].strip()
        stamp_ns = int(stamp) if stamp.isdecimal() else nanoseconds(stamp, path, number)
        return stamp_ns, numbers(path, number, words[first : first + 3], 3, content)

    if not path.is_file():
        return sensor
    try:
        lines = read_lines(path, content)
        is_named = bool(lines) and lines[0][1].split(separator)[0].isalpha()
        rows = usable(path, lines[is_named:], row, "lines")
    except DatasetError as error:
        log.warning("the values of an inertial sensor are not used: %s", error)
        return sensor
    for each in filter(None, rows):
        sensor.add(*each)
    return sensor
