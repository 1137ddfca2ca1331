# SPDX-License-Identifier: MIT
"""Accelerometers of recordings: they tell where up is."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.readers import numbers, read_lines

_AROUND_NS = 50_000_000  # on each side of a frame's time


class Accelerometer:
    """Specific forces over time.

    Args:
        stamps_ns: (n,) nanoseconds of the frames' clock.
        forces: (n, 3) m/s²; at rest they point away from the ground. Rows that are not finite are left out.
        R_sensor_imu: (3, 3) rotation from the accelerometer's axes into those of the camera or LiDAR.
    """

    def __init__(self, stamps_ns: ArrayLike, forces: ArrayLike, R_sensor_imu: NDArray[np.float64]) -> None:
        stamps, rows = np.asarray(stamps_ns, np.int64), np.asarray(forces, np.float64).reshape(-1, 3)
        kept = np.isfinite(rows).all(axis=1)
        order = np.argsort(stamps[kept], kind="stable")
        self._stamps, self._forces = stamps[kept][order], (rows[kept] @ R_sensor_imu.T)[order]

    def around(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """(3,) mean within 50 ms of a time, in the camera's or LiDAR's axes; None = nothing was measured."""
        begin, end = np.searchsorted(self._stamps, (stamp_ns - _AROUND_NS, stamp_ns + _AROUND_NS))
        return self._forces[begin:end].mean(axis=0) if end > begin else None


def read_table(
    path: Path, content: str, R_sensor_imu: NDArray[np.float64], *, separator: str | None, first: int
) -> Accelerometer | None:
    """Read a text table: a stamp, and from column `first` on three numbers; None where there is no file.

    Stamps are whole nanoseconds, or seconds where they have a point.

    Raises:
        DatasetError: for a malformed line.
    """
    if not path.is_file():
        return None
    stamps, rows = [], []
    for number, line in read_lines(path, content):
        words = line.split(separator)
        if len(words) < first + 3:
            raise DatasetError(f"{path}:{number}: {line!r}; expected {content}")
        (stamp,) = numbers(path, number, words[:1], 1, content)
        stamps.append(round(stamp * 1e9) if "." in words[0] else int(words[0]))
        rows.append(numbers(path, number, words[first : first + 3], 3, content))
    return Accelerometer(stamps, rows, R_sensor_imu)
