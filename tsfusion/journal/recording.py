# SPDX-License-Identifier: MIT
"""A journal, spool or segment as a dataset of keyframes: live scans can be replayed offline."""

import copy
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import DecodeError, InvalidKeyframe, JournalError
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.object_cards import ShownRecording
from tsfusion.geometry.origin import Origin
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes

LOST = "lost to damage"  # reason of `JournalRecording.skipped`


class JournalRecording(ShownRecording):
    """The keyframes of a state folder (of one map, or of the one named), a map's folder or its `journal`, a
    spool folder or one `.mcap` segment: each once, at its final pose, in journal order.

    Keyframes the map had to reject are among them. Those that the server was told to forget, that
    corrections removed, or that damage cost are left out and counted in `skipped`.

    Raises:
        JournalError: when there is no keyframe.
    """

    usual: Mapping[str, Any] = MappingProxyType({})  # settings of the map whose journal it is, if known
    absent: int = 0  # keyframes of that map that it no longer has, if known

    def __init__(self, path: str | os.PathLike[str], map_name: str | None = None) -> None:
        place = state_folder.find_journal(Path(path), map_name)
        self.name = str(place.path)
        self.keyframes = found = JournaledKeyframes(place)
        self._chosen = range(len(found))
        removed = len(found.left_out) - found.forgotten
        left_out = {"forgotten": found.forgotten, "removed by corrections": removed, LOST: found.lost}
        self.skipped = {reason: count for reason, count in {**found.unreadable, **left_out}.items() if count}
        if not len(found):
            raise JournalError(
                f"no keyframes in {place.path}; expected a state folder, a spool folder or an .mcap file"
            )
        self._poses = found.poses()
        first = self[0]
        self.sensor = first.sensor or VolumeConfig().sensor
        self.timestamps_ns: NDArray[np.int64] | None = None
        worlds = [*found.worlds]
        self.origin = Origin.of_world(worlds[0]) if len(worlds) == 1 else None

    def __len__(self) -> int:
        return len(self._chosen)

    @overload
    def __getitem__(self, index: int) -> Keyframe: ...

    @overload
    def __getitem__(self, index: slice) -> "JournalRecording": ...

    def __getitem__(self, index: int | slice) -> "Keyframe | JournalRecording":
        """A keyframe, or some; raises JournalError when it cannot be read any more."""
        if isinstance(index, slice):
            some = copy.copy(self)
            some._chosen = self._chosen[index]
            return some
        try:
            return self.keyframes[self._chosen[index]].keyframe
        except (DecodeError, InvalidKeyframe) as error:
            raise JournalError(f"{self.name}: keyframe {index} cannot be used: {error}") from error

    def _first(self) -> Keyframe:
        return self[0]

    def pose(self, index: int) -> NDArray[np.float64]:
        """(4, 4) final T_world_camera of a keyframe, which is not read for it."""
        return np.asarray(self._poses[index])

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[index] for index in range(len(self)))
