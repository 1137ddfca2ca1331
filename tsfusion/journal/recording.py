# SPDX-License-Identifier: MIT
"""A journal, spool or segment as a dataset of keyframes: live scans can be replayed offline."""

import logging
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import DecodeError, JournalError
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.journal import state_folder
from tsfusion.journal.forgotten_numbers import ForgottenNumbers
from tsfusion.wire import codec

LOST = "lost to damage"  # reason of `JournalRecording.skipped`

log = logging.getLogger(__name__)


class JournalRecording:
    """The keyframes of a state folder (of one map, or of the one named), a map's folder or its `journal`, a
    spool folder or one `.mcap` segment.

    Each once and in journal order, also when a crash left a second copy. Keyframes the map had to reject
    are among them; corrections are left out, so poses are those that the keyframes came with. Keyframes that
    the server was told to forget are left out, too, and counted in `skipped`, as are those that damage cost.

    Raises:
        JournalError: when there is no keyframe.
    """

    usual: Mapping[str, Any] = MappingProxyType({})  # settings of the map whose journal it is, if known

    def __init__(self, path: str | os.PathLike[str], map_name: str | None = None) -> None:
        place = state_folder.find_journal(Path(path), map_name)
        self.name = str(place.path)
        self._places, self.skipped = _places(place)
        if not self._places:
            raise JournalError(
                f"no keyframes in {place.path}; expected a state folder, a spool folder or an .mcap file"
            )
        first = self[0]
        self.sensor = first.sensor or VolumeConfig().sensor
        self.timestamps_ns: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> Keyframe:
        """A keyframe; raises JournalError when it cannot be read any more."""
        path, offset = self._places[index]
        try:
            return codec.decode_keyframe(journal.read_at(path, offset).frames)
        except DecodeError as error:
            raise JournalError(f"{path}: keyframe {index} cannot be used: {error}") from error

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[index] for index in range(len(self)))


def _places(place: state_folder.JournalPlace) -> tuple[list[tuple[Path, int]], dict[str, int]]:
    """Segment file and offset of each keyframe; how many are left out, by reason."""
    found: list[tuple[bytes, int, Path, int]] = []
    lost = 0
    last, forgotten = dict[bytes, int](), ForgottenNumbers()
    for file, step in place.steps():
        if isinstance(step, journal.Erased):
            last[step.session] = max(step.seq, last.get(step.session, 0))
        elif isinstance(step, journal.Damage):
            log.log(logging.WARNING if step.torn else logging.ERROR, "%s: %s", file, step.what)
            lost += step.lost
        elif step.seq > last.get(step.session, 0):
            last[step.session] = step.seq
            if not step.is_correction:
                found.append((step.session, step.seq, file, step.position.offset))
            else:
                forgotten.note(step)
    kept = [(file, at) for session, seq, file, at in found if (session, seq) not in forgotten]
    skipped = {"forgotten": len(found) - len(kept), LOST: lost}
    return kept, {reason: count for reason, count in skipped.items() if count}
