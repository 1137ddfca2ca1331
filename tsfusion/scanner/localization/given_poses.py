# SPDX-License-Identifier: MIT
"""Localizers that take known poses, from a trajectory file (TUM or KITTI) or from the source."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.readers import read_lines
from tsfusion.datasets.trajectory_files import has_times, nanoseconds, read_poses, read_timed
from tsfusion.geometry import origin as origins
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.sweeps import motion_about
from tsfusion.geometry.trajectory import Trajectory
from tsfusion.scanner.localization.localizer import KnownPoses, Lost, TrackedPose


class TrajectoryFilePoses(KnownPoses):
    """`Localizer` that interpolates the poses of a file at each frame's timestamp.

    The times of a file in KITTI's format are read from `times.txt` (seconds, a line for each pose). It lies
    beside the file or, for `poses/NN.txt`, in `sequences/NN` as in the benchmark. Frames are not counted
    instead: a dropped frame would move all poses after it.

    Args:
        path: lines of `timestamp tx ty tz qx qy qz qw` or of 12 numbers. The poses are of the sensor that
            makes the frames, not of a robot's body.
        max_gap_s: most seconds between two poses; longer gaps have no pose.
        time_offset_s: seconds to add to a frame's stamp before its pose is looked up.
        origin: as for `origin.found`.

    Raises:
        DatasetError: the file is missing, malformed, or without times.
    """

    def __init__(
        self, path: str | Path, *, max_gap_s: float, time_offset_s: float = 0.0, origin: object = None
    ) -> None:
        super().__init__()
        self._trajectory = read_trajectory(Path(path).expanduser())
        known = self._trajectory.translations[np.isfinite(self._trajectory.translations[:, 0])]
        self.origin = origins.found([*known[:1]], origin)
        if self.origin is not None:
            moved = self._trajectory.translations - self.origin.position
            self._trajectory = replace(self._trajectory, translations=moved)
        self._max_gap_ns = round(max_gap_s * 1e9)
        self._offset_ns = round(time_offset_s * 1e9)
        self._begun = False

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Look up the pose at the frame's timestamp. Return Lost in gaps and outside the trajectory."""
        stamp = frame.timestamp_ns + self._offset_ns
        # Stamp 0 may be right for the first frame of a recording; a second 0 means a source without times.
        known = bool(frame.timestamp_ns) or not self._begun
        self._begun = True
        at = partial(self._trajectory.at, max_gap_ns=self._max_gap_ns)
        T = at(stamp) if known else None
        if T is None:
            return Lost(reason=self._missing(frame.timestamp_ns, stamp), timestamp_ns=frame.timestamp_ns)
        motion = motion_about(at, stamp, frame.point_times_s)
        return self._anchors.pose(T, frame.timestamp_ns, motion=motion)

    def _missing(self, own: int, stamp: int) -> str:
        stamps = self._trajectory.timestamps_ns
        first, last = int(stamps[0]), int(stamps[-1])
        if not own:
            return "the frame has no time, so that no pose can be looked up"
        if stamp < first or stamp > last:
            side, away = ("before", first - stamp) if stamp < first else ("after", stamp - last)
            end = "begins" if stamp < first else "ends"
            hint = ": are these the same clock?" if away > last - first else ""
            return f"the frame is {away / 1e9:.3f} s {side} the trajectory {end}{hint}"
        right = int(np.searchsorted(stamps, stamp))
        gap = (stamps[right] - stamps[right - 1]) / 1e9
        return (
            f"the trajectory has a gap of {gap:.3f} s here (at most {self._max_gap_ns / 1e9:g} s is bridged)"
        )


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory with its times, in KITTI's format from `times.txt`. Raises DatasetError."""
    if has_times(path):
        return read_timed(path)
    _, poses = read_poses(path)
    times_path = _times_of(path)
    lines = read_lines(times_path, "seconds, a pose a line")
    times = np.array([nanoseconds(line, times_path, number) for number, line in lines], np.int64)
    if len(times) < len(poses):
        raise DatasetError(f"{times_path} has {len(times)} lines, {path} has {len(poses)} poses")
    times = times[: len(poses)]
    if (np.diff(times) <= 0).any():
        line = int(np.argmax(np.diff(times) <= 0)) + 2
        raise DatasetError(f"{times_path}: time {line} is not after the one before it")
    return Trajectory.of(times, poses)


def _times_of(path: Path) -> Path:
    beside = path.with_name("times.txt")
    benchmark = path.parent.parent / "sequences" / path.stem / "times.txt"
    for candidate in (beside, benchmark):
        if candidate.is_file():
            return candidate
    raise DatasetError(
        f"{path} has no times (KITTI's format); put them beside it as {beside}, seconds, a line a pose, or "
        "give a trajectory in TUM's format"
    )


class GivenPoses(KnownPoses):
    """`Localizer` that takes `frame.T_world_camera`, the pose that the source gives."""

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Return the frame's own pose, or Lost if the frame has none."""
        if frame.T_world_camera is None:
            return Lost(reason="the source gives no pose for this frame", timestamp_ns=frame.timestamp_ns)
        return self._anchors.pose(frame.T_world_camera, frame.timestamp_ns, motion=frame.motion)
