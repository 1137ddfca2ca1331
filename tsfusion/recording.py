# SPDX-License-Identifier: MIT
"""A journal, spool or segment as a dataset of keyframes: what was scanned live can be replayed offline."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion import codec, journal, maps
from tsfusion.config import VolumeConfig
from tsfusion.errors import DecodeError, JournalError
from tsfusion.keyframe import Keyframe


class Recording:
    """The keyframes of a state folder (of one map, or of the one named), a map's folder or its `journal`, a
    spool folder or one `.mcap` segment.

    Each once and in journal order, also when a crash left a second copy. Keyframes the map had to reject
    are among them.

    Raises:
        JournalError: when there is no keyframe.
    """

    def __init__(self, path: str | os.PathLike[str], map_name: str | None = None) -> None:
        path = maps.resolve(Path(path), map_name)
        if (path / maps.JOURNAL_FOLDER).is_dir():
            path = path / maps.JOURNAL_FOLDER
        self.name = str(path)
        self._places = _places(path)
        if not self._places:
            raise JournalError(f"no keyframes in {path} (a state folder, a spool folder or an .mcap file)")
        first = self[0]
        self.sensor = first.sensor or VolumeConfig().sensor
        self.timestamps_ns: NDArray[np.int64] | None = None
        self.skipped: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> Keyframe:
        """A keyframe; raises JournalError when it cannot be read any more."""
        path, offset = self._places[index]
        try:
            return codec.decode(journal.read_at(path, offset).frames)
        except DecodeError as error:
            raise JournalError(f"{path}: keyframe {index} is of no use: {error}") from error

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[index] for index in range(len(self)))


def read_keyframes(path: str | os.PathLike[str]) -> Iterator[Keyframe]:
    """The keyframes of a `Recording`, one after the other."""
    return iter(Recording(path))


def _places(path: Path) -> list[tuple[Path, int]]:
    """Segment file and offset of each keyframe."""
    if path.is_dir():
        files = [journal.segment_path(path, number) for number in journal.segments(path)]
    else:
        files = [path]
    places, last = [], dict[bytes, int]()
    for file in files:
        for found in journal.scan(file)[0]:
            if found.seq > last.get(found.session, 0):
                last[found.session] = found.seq
                places.append((file, found.position.offset))
    return places
