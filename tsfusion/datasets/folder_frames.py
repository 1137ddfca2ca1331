# SPDX-License-Identifier: MIT
"""Base of recordings that are a folder of files: which frames there are, and where they were."""

import inspect
from abc import abstractmethod
from functools import partial
from pathlib import Path
from typing import Any

from tsfusion.datasets.dataset import (
    NO_POSE_IN_TIME,
    WITHOUT_POSE,
    FramePoses,
    Frames,
    Times,
    poses_if_any,
    require_folder,
    require_frames,
)
from tsfusion.datasets.given_trajectory import poses_between, poses_of


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
