# SPDX-License-Identifier: MIT
"""Poses of another SLAM for a recording: by time where both have times, else one a frame, in order."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import NO_POSE_IN_TIME, Dataset, Wrapped
from tsfusion.datasets.trajectory_files import read_poses, read_tum
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import PoseAt, Trajectory

EXPECTED = "poses at the times of its frames"


def poses_of(
    path: Path,
    count: int,
    stamps_ns: Sequence[int] | NDArray[np.int64] | None,
    *,
    posed: bool,
    max_gap_s: float = 0.2,
    time_offset_s: float = 0.0,
) -> list[Transform | None]:
    """The (4, 4) T_world_camera of each of `count` frames, from a TUM, KITTI or Redwood `.log` file.

    Args:
        stamps_ns: times of the frames, nanoseconds; None = they have none.
        posed: whether it is an error that the poses end before the frames begin, or the other way round.
        max_gap_s: seconds between two poses at most; there is no pose in longer gaps.
        time_offset_s: seconds to add to a frame's stamp before its pose is looked up.

    Raises:
        DatasetError: a missing or malformed file, times that do not meet, or without times in one
            of both another number of poses than of frames.
    """
    times, poses = read_poses(path)
    if times is None or stamps_ns is None:
        if len(poses) != count:
            timeless = path.name if times is None else "the recording"
            raise DatasetError(
                f"{path} has {len(poses)} poses for {count} frames, and {timeless} has no times to pair them "
                "by: give one pose a frame, or times in both (TUM's format; images named by seconds; in a "
                "grid points with gps_time)"
            )
        return [T if np.isfinite(T).all() else None for T in poses]
    trajectory, offset = read_tum(path), round(time_offset_s * 1e9)
    found = [trajectory.at(int(stamp) + offset, max_gap_ns=round(max_gap_s * 1e9)) for stamp in stamps_ns]
    if posed and (times[-1] < stamps_ns[0] + offset or times[0] > stamps_ns[-1] + offset):
        raise DatasetError(
            f"{path} has no pose at the time of any frame: it covers {_span(times)}, the frames "
            f"{_span(stamps_ns)}; expected one clock (--option time_offset_s=SECONDS is added to the frames)"
        )
    return found


def poses_between(
    path: Path, stamps_ns: NDArray[np.int64] | None, *, max_gap_s: float = 0.2, time_offset_s: float = 0.0
) -> PoseAt:
    """Make the function that gives T_world_camera at a time of the frames' clock, also between frames.

    Args:
        stamps_ns: times of the frames, for poses without times; other arguments are as of `poses_of`.
    """
    times, poses = read_poses(path)
    offset = 0 if times is None else round(time_offset_s * 1e9)
    times = stamps_ns if times is None else times
    if times is None or len(times) != len(poses) or (np.diff(times) <= 0).any():
        return lambda _: None
    trajectory, max_gap_ns = Trajectory.of(times, poses), round(max_gap_s * 1e9)
    return lambda stamp_ns: trajectory.at(stamp_ns + offset, max_gap_ns=max_gap_ns)


def pairs_by_time(path: Path, dataset: Dataset) -> bool:
    """True if a scan pairs poses and frames by their times: both have times.

    Frames without times have a scan's nominal ones; as many poses as frames are theirs in order.
    """
    times, poses = read_poses(path)
    return times is not None and (dataset.timestamps_ns is not None or len(poses) != len(dataset))


class WithTrajectory(Wrapped):
    """Another dataset's frames with the poses of a file.

    Args:
        posed: leave out frames without a pose; else they are kept, with `T_world_camera` None.
        where: as of `poses_of`.
    """

    def __init__(self, dataset: Dataset, path: Path, *, posed: bool = True, **where: float) -> None:
        super().__init__(dataset, range(len(dataset)))
        self.skipped, self.quaternions = dict(dataset.skipped), False
        found = poses_of(path, len(dataset), dataset.timestamps_ns, posed=posed, **where)
        self._choose(self._keep(self._indices, found, (path, EXPECTED), posed=posed, reason=NO_POSE_IN_TIME))
        self._between = partial(poses_between, path, dataset.timestamps_ns, **where)

    def _frame(self, index: int) -> Frame:
        measured = super()._frame(index)
        motion = self._motion(index, measured.point_times_s)
        return dataclasses.replace(measured, T_world_camera=self._poses[index], motion=motion)


def _span(stamps_ns: Sequence[int] | NDArray[np.int64]) -> str:
    return f"{stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s"
