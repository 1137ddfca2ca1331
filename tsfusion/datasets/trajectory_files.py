# SPDX-License-Identifier: MIT
"""Trajectory files: the text formats of the field, read and written."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidKeyframe
from tsfusion.datasets.dataset import require_one_clock
from tsfusion.datasets.readers import numbers, read_lines, read_numbers
from tsfusion.geometry.keyframe import check_pose
from tsfusion.geometry.origin import FARTHEST
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import Trajectory, quaternion, rigid


def write_tum(path: Path, timestamps_ns: Sequence[int], poses: Sequence[Transform]) -> None:
    """`timestamp tx ty tz qx qy qz qw` a line, nine decimals: what `read_tum` and the field's tools read."""
    lines = ["# timestamp tx ty tz qx qy qz qw (T_world_camera)\n"]
    for stamp, T in zip(timestamps_ns, poses, strict=True):
        numbers_ = " ".join(f"{value:.9f}" for value in (*T[:3, 3], *quaternion(T[:3, :3])))
        lines.append(f"{stamp // 10**9}.{stamp % 10**9:09d} {numbers_}\n")
    path.write_text("".join(lines), encoding="utf-8")


def nanoseconds(seconds: str, path: Path, line: int) -> int:
    """Decimal seconds as exact integer nanoseconds (a double holds a Unix stamp only to 0.2 µs)."""
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
    """`timestamp tx ty tz qx qy qz qw` a line (TUM RGB-D, CoRBS, most SLAM systems)."""
    content = "`timestamp tx ty tz qx qy qz qw` a line"
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in read_lines(path, content):
        words = line.replace(",", " ").split()
        rows.append(numbers(path, number, words, 8, content)[1:])
        check_quaternion(rows[-1][3:], path, number)
        stamps.append(nanoseconds(words[0], path, number))
    return _in_order(stamps, rows, path, content)


def read_euroc(path: Path) -> Trajectory:
    """EuRoC / ASL ground truth: `ns, px, py, pz, qw, qx, qy, qz, …` a line, T_world_body."""
    content = "`ns,px,py,pz,qw,qx,qy,qz,…` a line"
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in read_lines(path, content):
        words = [word.strip() for word in line.split(",")]
        if not words[0].isdecimal() or int(words[0]) >= 2**63:
            raise DatasetError(f"{path}:{number}: timestamp must be nanoseconds, got {words[0]!r}")
        px, py, pz, qw, qx, qy, qz = numbers(path, number, words[1:8], 7, content)
        check_quaternion([qx, qy, qz, qw], path, number)
        stamps.append(int(words[0]))
        rows.append([px, py, pz, qx, qy, qz, qw])
    return _in_order(stamps, rows, path, content)


def check_quaternion(quaternion: Sequence[float] | NDArray[np.float64], path: Path, line: int) -> None:
    """Raise a DatasetError unless its length is 1 to a hundredth."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 0.01:
        raise DatasetError(f"{path}:{line}: quaternion must have length 1, got {norm:.4g}")


def _in_order(stamps: list[int], rows: list[list[float]], path: Path, content: str) -> Trajectory:
    if not rows:
        raise DatasetError(f"{path} holds no poses; expected {content}")
    require_one_clock(stamps, path)
    order = np.unique(np.array(stamps, dtype=np.int64), return_index=True)[1]
    table = np.array(rows)[order]
    quaternions = table[:, 3:] / np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    return Trajectory(np.array(stamps, dtype=np.int64)[order], table[:, :3], quaternions)


def read_kitti(path: Path) -> list[Transform]:
    """3×4 row-major matrices, one a line; the line number is the frame number."""
    table = read_numbers(path, "12 numbers a line, a 3×4 row-major camera-to-world matrix", columns=12)
    return [checked_pose(row.reshape(3, 4), f"{path}, pose {index}") for index, row in enumerate(table)]


def read_matrix(path: Path) -> Transform:
    """One 4×4 camera-to-world matrix in a file (7-Scenes)."""
    table = read_numbers(path, "a 4×4 camera-to-world matrix", columns=4)
    if table.shape != (4, 4):
        raise DatasetError(f"{path} must hold 4 rows of 4 numbers, got {len(table)} rows")
    return checked_pose(table, path)


def read_matrix_rows(path: Path) -> list[Transform]:
    """4×4 matrices, one a line of 16 numbers (HoloLens folders)."""
    table = read_numbers(path, "16 numbers a line, a 4×4 row-major camera-to-world matrix", columns=16)
    return [checked_pose(row.reshape(4, 4), f"{path}, pose {index}") for index, row in enumerate(table)]


def read_log(path: Path) -> list[tuple[int, Transform]]:
    """Redwood / Open3D `.log`: a line of three integers, then a 4×4 camera-to-world matrix; repeated."""
    lines = read_lines(path, "a Redwood trajectory: three integers, then a 4×4 matrix, repeated")
    if not lines or len(lines) % 5:
        raise DatasetError(
            f"{path} has {len(lines)} lines; expected five a pose: three integers, then a 4×4 matrix"
        )
    poses = []
    for start in range(0, len(lines), 5):
        number, head = lines[start]
        words = head.split()
        if len(words) != 3 or not words[0].isdigit():
            raise DatasetError(f"{path}:{number}: three integers expected before each matrix, got {head!r}")
        rows = [numbers(path, n, line.split(), 4, "a 4×4 matrix") for n, line in lines[start + 1 : start + 5]]
        poses.append((int(words[0]), checked_pose(np.array(rows), f"{path}:{number}")))
    return poses


def read_poses(path: Path) -> tuple[NDArray[np.int64] | None, NDArray[np.float64]]:
    """Read a trajectory file: TUM (8 numbers in the first line), KITTI (12), 4×4 matrices (16) or Redwood's
    `.log` (3), whose poses come in the order of their numbers.

    Returns:
        (n,) timestamps in nanoseconds, None where the format has none; (n, 4, 4) poses.

    Raises:
        DatasetError: for a missing file, or one of another format.
    """
    columns = _columns(path)
    if columns == 8:
        tum = read_tum(path)
        poses = [rigid(q, t) for q, t in zip(tum.quaternions, tum.translations, strict=True)]
        return tum.timestamps_ns, np.array(poses)
    if columns == 12:
        return None, np.array(read_kitti(path))
    if columns == 16:
        return None, np.array(read_matrix_rows(path))
    if columns == 3:
        return None, np.array([T for _, T in sorted(read_log(path), key=lambda one: one[0])])
    raise DatasetError(
        f"{path} is no trajectory: expected 8 numbers a line (TUM), 12 (KITTI), 16 (4×4) or a Redwood .log, "
        f"got {columns}"
    )


def is_log(path: Path) -> bool:
    """Whether a trajectory is a Redwood `.log`, or nothing that `read_poses` reads."""
    return _columns(path) not in (8, 12, 16)


def _columns(path: Path) -> int:
    lines = read_lines(path, "a trajectory: TUM, KITTI or .log")
    return len(lines[0][1].replace(",", " ").split()) if lines else 0


def checked_pose(matrix: NDArray[np.float64], source: object) -> Transform:
    """(3, 4) or (4, 4) as a rigid (4, 4), or an error that names where it came from."""
    T = np.eye(4)
    T[: len(matrix)] = matrix
    try:
        return check_pose(T, farthest=FARTHEST)
    except InvalidKeyframe as error:
        raise DatasetError(f"{source}: {error}") from error
