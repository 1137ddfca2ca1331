# SPDX-License-Identifier: MIT
"""Keep the values of accelerometers and gyroscopes, integrate these to attitudes, and judge them by poses."""

import logging
import math
import sys
import threading
from array import array
from bisect import bisect_right
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Attitude, Frame
from tsfusion.geometry.trajectory import rigid

_AROUND_NS = 50_000_000  # on each side of a frame's time
_GAP_S = 0.1  # between two values; the turn in a longer one is not known
_MOST_LIVE = 8192  # values: eight seconds and more
_MOST_LENGTH = 1e4  # m/s² or rad/s; no sensor measures more
_WINDOW_NS, _FEWEST = 500_000_000, 10  # in which a gyroscope must stand still to show its bias, and values
_STILL, _MOST_BIAS = 0.01, 0.1  # rad/s: deviation and mean of a gyroscope that stands still
_SAME = np.eye(3)
_Components = Sequence[float]
_JUDGED = math.radians(1)  # a smaller turn tells nothing about a gyroscope
_DIFFERENT, _MOST_DIFFERENT = 0.5, 4  # share of a turn, and more turns that differ than agree
_REFUSED = (
    "the gyroscope is not used any more: it turned by %.1f°, the sensor by %.1f°, with %.1f° between them; "
    "are its axes and its clock those of the sensor?"
)
log = logging.getLogger(__name__)


class _InertialSensor:
    """Values of one kind over time; `add` may be called in a thread of its own.

    Args:
        R_sensor_imu: (3, 3) rotation from the sensor's axes to those of the camera or LiDAR.
        live: True keeps the last values alone.
    """

    _width = 3  # numbers kept of each time

    def __init__(self, R_sensor_imu: NDArray[np.float64] = _SAME, *, live: bool = False) -> None:
        self.R_sensor_imu, self._most = R_sensor_imu, _MOST_LIVE if live else sys.maxsize
        self._lock = threading.Lock()
        self._stamps, self._rows = array("q"), array("d")

    def add(self, stamp_ns: int, values: _Components) -> None:
        """Add three values at a time, nanoseconds of the frames' clock, if it is later than the last.

        The last value is removed if its time was more than half a second ahead of this one's, as a wrong one.
        """
        if not (math.hypot(*values) < _MOST_LENGTH and stamp_ns < 2**63):
            return
        with self._lock:
            before_ns, last_ns = [-1, -1, *self._stamps[-2:]][-2:]
            if before_ns < stamp_ns < last_ns - _WINDOW_NS:
                del self._stamps[-1], self._rows[-self._width :]
                last_ns = before_ns
            if last_ns < stamp_ns:
                self._rows.extend(self._row(stamp_ns, values))
                self._stamps.append(stamp_ns)
            if len(self._stamps) > self._most:
                gone = self._most // 2
                del self._stamps[:gone], self._rows[: gone * self._width]

    def _row(self, stamp_ns: int, values: _Components) -> _Components:
        """Return the numbers to keep."""
        return values

    def table(self, begin_ns: int = 0, end_ns: int = 2**63 - 1) -> NDArray[np.float64]:
        """Return what was kept from after one time until another, (n, 3 or more)."""
        with self._lock:
            first, end = (bisect_right(self._stamps, each) * self._width for each in (begin_ns, end_ns))
            return np.array(self._rows[first:end]).reshape(-1, self._width)

    def median_length(self) -> float:
        """Return the median length of the values; 0 without any."""
        found = self.table()[:, :3]
        return float(np.median(np.linalg.norm(found, axis=1))) if len(found) else 0.0


class Accelerometer(_InertialSensor):
    """Specific forces over time, m/s²; at rest they point away from the ground."""

    def around(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return the (3,) mean force within 50 ms of a time, m/s², in the frame's axes, or None."""
        found = self.table(stamp_ns - _AROUND_NS - 1, stamp_ns + _AROUND_NS)
        return self.R_sensor_imu @ found.mean(axis=0) if len(found) else None


class Gyroscope(_InertialSensor):
    """Angular velocities over time, rad/s, and the attitude at each: a quaternion x, y, z, w.

    Between two times the velocity is linear. Its bias is the mean of the last half second in which the
    gyroscope stood still, and 0 before. After a gap, attitudes begin anew.
    """

    _width = 8  # velocity, quaternion, count of gaps
    _window = list[_Components]()  # values until `_end_ns`
    _end_ns, _bias = -1, [0.0, 0.0, 0.0]

    def attitude(self, stamp_ns: int) -> Attitude | None:
        """Return the rotation since the first value, or since a gap; None if values are missing for 50 ms."""
        with self._lock:
            last = bisect_right(self._stamps, stamp_ns) - 1
            stamps, rows = self._stamps[max(last, 0) : last + 2], self._rows[8 * last : 8 * last + 16]
        if last < 0 or stamp_ns - stamps[0] > _AROUND_NS:
            return None
        rate, gaps, since_ns = rows[:3], rows[7], stamp_ns - stamps[0]
        ahead = rows[-8:-5] if rows[-1] == gaps else rate
        share = since_ns / (stamps[1] - stamps[0]) if len(stamps) > 1 else 0.0
        now = [a + share * (b - a) for a, b in zip(rate, ahead, strict=True)]
        R = rigid(np.array(_turned(rows[3:7], rate, now, since_ns / 1e9)), np.zeros(3))[:3, :3]
        return Attitude(self.R_sensor_imu @ R @ self.R_sensor_imu.T, int(gaps))

    def _row(self, stamp_ns: int, values: _Components) -> _Components:
        if not self._end_ns - _WINDOW_NS <= stamp_ns <= self._end_ns:
            window = np.array(self._window).reshape(-1, 3)
            if len(window) >= _FEWEST and window.std(axis=0).max() < _STILL:
                bias = window.mean(axis=0)
                self._bias = bias.tolist() if np.linalg.norm(bias) < _MOST_BIAS else self._bias
            self._window, self._end_ns = [], stamp_ns + _WINDOW_NS
        self._window.append(values)
        rate = [value - bias for value, bias in zip(values, self._bias, strict=True)]
        if not self._stamps:
            return [*rate, 0.0, 0.0, 0.0, 1.0, 0.0]
        before, seconds = self._rows[-8:], (stamp_ns - self._stamps[-1]) / 1e9
        if seconds > _GAP_S:
            return [*rate, 0.0, 0.0, 0.0, 1.0, before[7] + 1]
        return [*rate, *_turned(before[3:7], before[:3], rate, seconds), before[7]]


SomeInertialSensor = TypeVar("SomeInertialSensor", Accelerometer, Gyroscope)


def inertial_fields(accelerometer: Accelerometer, gyroscope: Gyroscope, stamp_ns: int) -> dict[str, Any]:
    """Return the fields of a `Frame` at a time that inertial sensors tell."""
    return {"specific_force": accelerometer.around(stamp_ns), "attitude": gyroscope.attitude(stamp_ns)}


class GyroscopeTrust:
    """Turns by a gyroscope, as long as those of the poses agree: its axes or its clock may be others."""

    def __init__(self) -> None:
        self._different = 0

    def turn(self, frame: Frame, attitude: Attitude | None) -> NDArray[np.float64] | None:
        """Return R_before_now, (3, 3), since a frame with this attitude; None = no gyroscope to trust."""
        return frame.turn_since(attitude) if self._different < _MOST_DIFFERENT else None

    def judge(self, turn: NDArray[np.float64] | None, T_before_now: se3.Transform) -> None:
        """Compare a turn with the one that was found. Report once a gyroscope that is refused."""
        if turn is None:
            return
        R = T_before_now[:3, :3]
        turned, found, apart = (np.linalg.norm(se3.rotation_vector(each)) for each in (turn, R, turn.T @ R))
        if max(turned, found) > _JUDGED:
            differs = apart > _DIFFERENT * max(turned, found)
            self._different = max(self._different + (1 if differs else -1), 0)
        if self._different == _MOST_DIFFERENT:
            log.warning(_REFUSED, *np.degrees((turned, found, apart)))


def _turned(q: _Components, rate: _Components, ahead: _Components, seconds: float) -> _Components:
    """Return a quaternion x, y, z, w, turned on for a time in which the velocity changes evenly."""
    half = [(a + b) * seconds / 4 for a, b in zip(rate, ahead, strict=True)]
    angle = math.hypot(*half)
    x, y, z = (each * (math.sin(angle) / angle if angle else 1.0) for each in half)
    (a, b, c, d), w = q, math.cos(angle)
    return (
        a * w + d * x + b * z - c * y, b * w + d * y + c * x - a * z,
        c * w + d * z + a * y - b * x, d * w - a * x - b * y - c * z,
    )  # fmt: skip
