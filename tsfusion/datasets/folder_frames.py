# SPDX-License-Identifier: MIT
"""Recordings that are a folder of files: which frames there are, and their poses, recorded or given."""

import dataclasses
import inspect
from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import (
    NO_POSE_IN_TIME,
    WITHOUT_POSE,
    Dataset,
    FramePoses,
    Frames,
    Times,
    Wrapped,
    poses_if_any,
    require_folder,
    require_frames,
)
from tsfusion.datasets.trajectory_files import read_poses, read_tum
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import PoseAt, Trajectory


class FolderFrames(Frames):
    """Frames of the files in a folder, with the poses that it has or that somebody gave.

    A layout is a class: its attributes say what is usual there, `_list` and `_recorded_poses` what its folder
    holds. A folder with one file or folder (a name without a dot) of each of its `signs` is in the layout.
    `_files` are the files of the frames that stay, `_kept` their places among all.

    Args:
        path: the recording's folder.
        trajectory: poses instead of those in the folder; in TUM's, KITTI's or Redwood's format.
        max_gap_s: between two poses that are interpolated, seconds; across a longer gap there is no pose.
        time_offset_s: added to a frame's time before its pose is looked up, seconds.
        sensor: name of the sensor model; default the layout's.
        posed: leave out frames without a pose; else they are kept, with `T_world_camera` None.

    Raises:
        DatasetError: no such folder, no frames, most files missing, malformed poses.
    """

    layout = ""
    expected = ""
    signs: tuple[tuple[str, ...], ...] = ()
    usual_gap_s = 0.2
    guesses = False  # whether it finds a file of poses by its name alone
    _files: list[Any]

    def __init_subclass__(cls) -> None:
        """Name the options of the bases where a layout adds some of its own and passes on `**options`."""
        named = dict(inspect.signature(cls.__init__).parameters)
        for base in cls.__mro__[1:] if named.pop("options", None) else ():
            named = {**inspect.signature(base.__init__).parameters, **named}  # type: ignore[misc]
        without = {"self", "options", "args", "kwargs"}
        order = sorted((one for one in named.values() if one.name not in without), key=lambda one: one.kind)
        cls.__signature__ = inspect.Signature(order)  # type: ignore[attr-defined]

    def __init__(
        self,
        path: str | Path,
        *,
        trajectory: str | Path | None = None,
        max_gap_s: float | None = None,
        time_offset_s: float = 0.0,
        sensor: str | None = None,
        posed: bool = True,
    ) -> None:
        self.skipped = {}
        root, given = self._opened(path, trajectory)
        self._gap_s = self.usual_gap_s if max_gap_s is None else max_gap_s
        self._offset_s, self._posed, self._why = time_offset_s, posed, WITHOUT_POSE
        files, self._times = self._list(root)
        require_frames(len(files), root, self.expected, self.skipped)
        read = self._recorded_poses if given is None else self._poses_of
        own = partial(read, given or root, files)
        found = poses_if_any(own, len(files), posed=self._posed, guessed=self.guesses and given is None)
        where = root, self._wanted()
        self._kept = self._keep(range(len(files)), found, where, posed=self._posed, reason=self._why)
        self._files = [files[index] for index in self._kept]
        self.timestamps_ns = None if self._times is None else self._times[self._kept]
        self.name, self.sensor = f"{self.layout} {root.name}", sensor or self.sensor
        self._root = root

    def __len__(self) -> int:
        return len(self._files)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """True for a folder in this layout, and for a file that stands for one."""
        return all(any(_is_there(path, sign) for sign in either) for either in cls.signs)

    def _opened(self, path: str | Path, trajectory: str | Path | None) -> tuple[Path, Path | None]:
        """The folder, and the file of poses that was given, which may be named from there."""
        root = require_folder(path, self.layout)
        given = None if trajectory is None else Path(trajectory).expanduser()
        return root, given if given is None or given.exists() else root / given

    @abstractmethod
    def _list(self, root: Path) -> tuple[list[Any], Times]:
        """Files of the frames in order, and their times, (n,) nanoseconds, where they are known."""

    @abstractmethod
    def _recorded_poses(self, root: Path, files: list[Any]) -> FramePoses:
        """The pose of each frame; raises NoPoses where the folder has none."""

    def _poses_of(self, path: Path, files: list[Any]) -> FramePoses:
        """Poses of a trajectory: by time where both have times, else one for each frame."""
        self._why = WITHOUT_POSE if self._times is None else NO_POSE_IN_TIME
        where = {"max_gap_s": self._gap_s, "time_offset_s": self._offset_s}
        self._between = partial(poses_between, path, self._times, **where)
        return poses_of(path, len(files), self._times, posed=self._posed, **where)

    def _wanted(self) -> str:
        """Files or times that frames with poses need, in words."""
        if self._why == WITHOUT_POSE:
            return self.expected
        return (
            f"poses at most {self._gap_s:g} s apart around the frames' times (--option max_gap_s=SECONDS "
            "takes longer gaps, time_offset_s=SECONDS is added to these times)"
        )


def _is_there(root: Path, sign: str) -> bool:
    return any(path.is_file() if path.suffix else path.is_dir() for path in root.glob(sign))


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
        expected = path, "poses at the times of its frames"
        self._choose(self._keep(self._indices, found, expected, posed=posed, reason=NO_POSE_IN_TIME))
        self._between = partial(poses_between, path, dataset.timestamps_ns, **where)

    def _frame(self, index: int) -> Frame:
        measured = super()._frame(index)
        motion = self._motion(index, measured.point_times_s)
        return dataclasses.replace(measured, T_world_camera=self._poses[index], motion=motion)


def _span(stamps_ns: Sequence[int] | NDArray[np.int64]) -> str:
    return f"{stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s"
