# SPDX-License-Identifier: MIT
"""Correct sweeps: move points that a moving sensor measures one by one to one common time."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry import se3
from tsfusion.geometry.trajectory import PoseAt

_LOOKED_UP = 32  # poses read from a trajectory for each duration of a sweep
_STEPS = 256  # pieces of a motion in which points move along straight lines
_AT_ONCE = 1 << 16  # points
_OFF = 0.1  # metres and radians: largest motion at time 0


class Motion(NamedTuple):
    """Motion of a sensor during a frame, around the frame's timestamp.

    Attributes:
        times_s: (k,) float64 seconds after the timestamp, rising, k >= 2.
        poses: (k, 4, 4) float64, poses of the sensor at these times, in its own axes at the timestamp.
    """

    times_s: NDArray[np.float64]
    poses: se3.Transform


def motion_about(at: PoseAt, stamp_ns: int, times_s: NDArray[np.float32] | None) -> Motion | None:
    """Return a sensor's motion during a sweep, from its trajectory; extrapolated beyond its ends.

    Args:
        at: T_world_sensor by time, from the trajectory.
        times_s: (N,) seconds of the points after the stamp; None = points without times.

    Returns None without a pose at the stamp, or if the poses around it span less than half of the sweep.
    """
    if times_s is None:
        return None
    first, last = min(0.0, float(times_s.min())), max(0.0, float(times_s.max()))
    span = last - first
    times = np.union1d(np.linspace(first - span, last + span, 3 * _LOOKED_UP + 1), 0.0)
    found = [at(stamp_ns + round(t * 1e9)) for t in times]
    unknown = np.array([index for index, T in enumerate(found) if T is None], np.int64)
    zero = int(np.searchsorted(times, 0))
    begin = int(unknown[unknown < zero].max(initial=-1)) + 1
    known = slice(begin, int(unknown[unknown >= zero].min(initial=len(times))))
    times = times[known]
    if len(times) <= zero - begin or times[-1] - times[0] < span / 2:
        return None
    poses = np.array(found[known])
    twists = se3.log(se3.inverse(poses[zero - begin]) @ poses)
    count = min(len(times) - 1, _LOOKED_UP // 2)
    before, after = times[0] - 2 * span, times[-1] + 2 * span
    begins = twists[0] + (before - times[0]) / (times[count] - times[0]) * (twists[count] - twists[0])
    ends = twists[-1] + (after - times[-1]) / (times[-1] - times[~count]) * (twists[-1] - twists[~count])
    return Motion(np.hstack([before, times, after]), se3.exp(np.vstack([begins, twists, ends])))


def steady(twist: NDArray[np.float64], times_s: NDArray[np.floating]) -> Motion:
    """Return the motion over (N,) times with one constant twist, (6,) metres and radians a second."""
    times = np.array([min(0.0, times_s.min()), max(1e-9, times_s.max())], np.float64)
    return Motion(times, se3.exp(times[:, None] * twist))


def skewed(why: str) -> str:
    """Return the notice that motion within sweeps (scans of a LiDAR) is not corrected. `why`: the reason."""
    return f"motion within sweeps is not taken out: {why}"


def at_stamp(
    points: NDArray[np.floating], times_s: NDArray[np.floating], motion: Motion
) -> NDArray[np.float32]:
    """Return the points of a sweep, (N, 3) metres, in the sensor's axes at the timestamp.

    Args:
        points: each in the sensor's axes at its own time.
        times_s: (N,) seconds after the timestamp.

    Raises InvalidKeyframe if the motion does not cover these times, or is not zero at the timestamp.
    """
    rises = len(motion.times_s) > 1 and (np.diff(motion.times_s) > 0).all()
    if not rises or not np.isfinite(motion.times_s).all() or not np.isfinite(motion.poses).all():
        raise InvalidKeyframe(f"motion must have finite poses at rising times, got {motion.times_s} s")
    (first, last), twists = motion.times_s[[0, -1]], se3.log(motion.poses)
    if len(times_s) and max(first - times_s.min(), times_s.max() - last) > (last - first) / 2:
        raise InvalidKeyframe(
            f"motion must cover point_times_s, {times_s.min():g} to {times_s.max():g} s, got {first:g} to "
            f"{last:g} s"
        )
    if first <= 0 <= last and np.abs([np.interp(0, motion.times_s, one) for one in twists.T]).max() > _OFF:
        raise InvalidKeyframe(
            "motion must hold poses in the sensor's axes at timestamp_ns, so none at time 0: "
            "np.linalg.inv(T_world_camera) @ T_world_then"
        )
    ticks = np.linspace(first, last, _STEPS + 1)
    table = se3.exp(np.stack([np.interp(ticks, motion.times_s, one) for one in twists.T], axis=1))[:, :3]
    place = (times_s - first) * (_STEPS / (last - first))
    left = np.clip(place.astype(np.int64), 0, _STEPS - 1)
    found = np.empty((len(points), 3), np.float32)
    for part in (slice(begin, begin + _AT_ONCE) for begin in range(0, len(points), _AT_ONCE)):
        T, T_next = table[left[part]], table[left[part] + 1]
        T += (place - left)[part, None, None] * (T_next - T)
        with np.errstate(invalid="ignore", over="ignore"):  # no return
            found[part] = np.einsum("nij,nj->ni", T[:, :, :3], points[part]) + T[:, :, 3]
    return found
