# SPDX-License-Identifier: MIT
"""Times of the points of a sweep, of fields whose unit and clock no file states."""

import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.origin import System
from tsfusion.geometry.sweeps import skewed
from tsfusion.geometry.trajectory import Trajectory

_FIELD = re.compile(
    r"(?:scalar_?)?(?:t|ts|time_?stamp|(?:gps|point|offset|rel|relative|delta)?_?time(?:_?offset)?)"
    r"(?:_(s|sec|ms|us|ns))?",
    re.IGNORECASE,
)
_UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SHORTEST_S, _LONGEST_S = 0.003, 0.6  # of a sweep; a packet of points takes less
_FRAMES = 3.0  # the longest sweep, in times between two frames: two sensors may take turns
_NEAR_S = 1.2  # within which a time is one of the stamp's clock
_COARSE = 0.01  # of a sweep: steps of numbers that are too coarse for its times


class Scan(NamedTuple):
    """Points of one sweep, and their times as they are written."""

    points: NDArray[np.floating]  # (N, 3) metres in the LiDAR's axes, or the file's system; NaN = no return
    time_field: str | None = None  # None = there are no times
    moments: NDArray[Any] | None = None  # (N,) of that field
    color: NDArray[np.uint8] | None = None  # (N, 3) BGR
    system: System | None = None  # that the file names


class PointTimes(NamedTuple):
    """Seconds of points after a stamp, (N,) float32; or in words why the recorded ones are of no use."""

    point_times_s: NDArray[np.float32] | None = None
    untimed: str = ""


def time_field(names: Iterable[str]) -> str | None:
    """The field that holds the times of points, as drivers and programs name it; None = there is none."""
    return next((name for name in names if _FIELD.fullmatch(name)), None)


def point_times(scan: Scan, stamp_ns: int, between_s: float = 1.0) -> PointTimes:
    """Read the times of a sweep's points.

    The unit is that of the field's name (`time_us`), else the largest of s, ms, µs and ns in which a sweep
    can be so long: drivers write Ouster `t` and Livox `offset_time` in ns, Velodyne `time` in s, Hesai
    `timestamp` in absolute s, Livox `timestamp` in absolute ns, LAS `gps_time` in s. Times of neither the
    stamp's clock nor the sweep count from the sweep's first point.

    Args:
        stamp_ns: of the frame; 0 = it has none.
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
    start_s = float(first) * unit
    if abs(start_s) > _NEAR_S:
        start_s -= stamp_ns * 1e-9
    start_s = start_s if abs(start_s) <= _NEAR_S else 0.0
    return PointTimes(np.where(known, start_s + (values - first) * unit, start_s).astype(np.float32))


def times_on(scan: Scan, trajectory: Trajectory) -> NDArray[np.float64]:
    """(N,) nanoseconds of points in the unit in which any is on a trajectory, NaN where it is not."""
    first, last = trajectory.timestamps_ns[[0, -1]]
    for unit_s in () if scan.moments is None else _UNITS_S.values():
        times = np.asarray(scan.moments) * (unit_s * 1e9)
        if (is_on := (times >= first) & (times <= last)).any():
            return np.where(is_on, times, np.nan)
    return np.full(len(scan.points), np.nan)
