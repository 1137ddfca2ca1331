# SPDX-License-Identifier: MIT
"""Base class of recordings that are a folder of files: it lists the frames, and finds their poses."""

import dataclasses
import inspect
from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import plugins
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
from tsfusion.datasets.trajectory_files import read_poses, read_timed
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import PoseAt, Trajectory


class FolderFrames(Frames):
    """Frames of the files in a folder, with the folder's own poses or given ones.

    A layout is a subclass: class attributes state what is usual, `_list` and `_recorded_poses` read a folder.
    A folder is in the layout if it holds, for each entry of `signs`, one of the files or folders (names
    without a dot). `_files` are the files of the frames that are kept, `_kept` their indices among all files.

    Args:
        path: the recording's folder.
        trajectory: file of poses, used instead of those in the folder; in TUM's, KITTI's or Redwood's format.
        max_gap_s: largest gap for interpolation between two poses, seconds; a longer gap has no pose.
        time_offset_s: added to a frame's time before its pose is looked up, seconds.
        sensor: name of the sensor model; default the layout's.
        posed: True leaves out frames without a pose; False keeps them, with `T_world_camera` None.

    Raises:
        DatasetError: there is no such folder, there are no frames, most files are missing, or poses are
            malformed.
    """

    layout = ""
    expected = ""
    signs: tuple[tuple[str, ...], ...] = ()
    usual_gap_s = 0.2
    guesses = False  # True if it finds a file of poses by the name alone
    _files: list[Any]

    def __init_subclass__(cls) -> None:
        """Show the options of base classes in the signature of a layout that passes on `**options`."""
        passes_on = "options" in inspect.signature(cls.__init__).parameters
        readers = cls.__mro__ if passes_on else cls.__mro__[:1]
        cls.__signature__ = plugins.signature_of(*(one.__init__ for one in readers))  # type: ignore

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
        """Return True for a folder in this layout, and for a file that stands for such a folder."""
        return all(any(_is_there(path, sign) for sign in either) for either in cls.signs)

    def _opened(self, path: str | Path, trajectory: str | Path | None) -> tuple[Path, Path | None]:
        """Return the folder, and the given file of poses, whose path may be relative to the folder."""
        root = require_folder(path, self.layout)
        given = None if trajectory is None else Path(trajectory).expanduser()
        return root, given if given is None or given.exists() else root / given

    @abstractmethod
    def _list(self, root: Path) -> tuple[list[Any], Times]:
        """Return the files of the frames in order, and their times, (n,) nanoseconds, if known."""

    @abstractmethod
    def _recorded_poses(self, root: Path, files: list[Any]) -> FramePoses:
        """Return the pose of each frame. Raises NoPoses if the folder has none."""

    def _poses_of(self, path: Path, files: list[Any]) -> FramePoses:
        """Return the poses of a trajectory: by time if both have times, else one for each frame."""
        self._why = WITHOUT_POSE if self._times is None else NO_POSE_IN_TIME
        where = {"max_gap_s": self._gap_s, "time_offset_s": self._offset_s}
        self._between = partial(poses_between, path, self._times, **where)
        return poses_of(path, len(files), self._times, posed=self._posed, **where)

    def _wanted(self) -> str:
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
    """Return (4, 4) T_world_camera of each of `count` frames, from a file that `read_poses` reads.

    Args:
        stamps_ns: times of the frames, nanoseconds; None = no times.
        posed: True raises an error if poses and frames have no time in common.
        max_gap_s: most seconds between two poses; longer gaps have no pose.
        time_offset_s: seconds to add to a frame's stamp before its pose is looked up.

    Raises:
        DatasetError: the file is missing or malformed, or no times meet; or times are missing and the numbers
            of poses and frames differ.
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
    trajectory, offset = read_timed(path), round(time_offset_s * 1e9)
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
    """Return a function from a time in nanoseconds to T_world_camera, also between frames.

    Args:
        stamps_ns: times of the frames, for poses without times. Other arguments are as for `poses_of`.
    """
    times, poses = read_poses(path)
    offset = 0 if times is None else round(time_offset_s * 1e9)
    times = stamps_ns if times is None else times
    if times is None or len(times) != len(poses) or (np.diff(times) <= 0).any():
        return lambda _: None
    trajectory, max_gap_ns = Trajectory.of(times, poses), round(max_gap_s * 1e9)
    return lambda stamp_ns: trajectory.at(stamp_ns + offset, max_gap_ns=max_gap_ns)


def pairs_by_time(path: Path, dataset: Dataset) -> bool:
    """Return True if a scan pairs poses and frames by time, because both have times.

    A scan gives nominal times to frames without times. As many poses as frames are paired in order.
    """
    times, poses = read_poses(path)
    return times is not None and (dataset.timestamps_ns is not None or len(poses) != len(dataset))


class WithTrajectory(Wrapped):
    """Another dataset's frames with the poses of a file.

    Args:
        posed: True leaves out frames without a pose; False keeps them, with `T_world_camera` None.
        where: `max_gap_s` and `time_offset_s`, as for `poses_of`.
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
