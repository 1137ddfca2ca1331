# SPDX-License-Identifier: MIT
"""Take a saved map to any time of its journal, by adding and subtracting keyframes exactly.

Keyframes are in the order of the journal, which for each scanner is the order of capture. Each is at its
final pose. Keyframes of the map that the journal no longer has stay in the map at every time.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.errors import TsfusionError
from tsfusion.fuser.live_mesh import TouchedBy
from tsfusion.fuser.pose_mover import PoseMover
from tsfusion.geometry.keyframe_rows import KeyframeRows, square
from tsfusion.geometry.se3 import Poses
from tsfusion.journal import Position
from tsfusion.journal.state_folder import JOURNAL_FOLDER
from tsfusion.wire.messages.questions import Rewind
from tsfusion.wire.records import codec

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume

_READING = 20  # reading a saved map takes as long as fusing about so many keyframes


class MapRewinding:
    """The ways of a settled map to any number of its keyframes: the others leave it for a while.

    Args:
        file: the saved map.
        memory_bytes: as for the volume: bytes of memory for the blocks.
        mover: adds and removes the keyframes.
        note: called after another map took the place of the present one, and after clients were found.
    """

    def __init__(
        self,
        volume: "Volume",
        file: Path,
        mover: PoseMover,
        touched_by: TouchedBy,
        *,
        memory_bytes: int | None,
        note: Callable[[], None],
    ) -> None:
        self._volume, self._file, self._mover, self._note = volume, file, mover, note
        self._memory_bytes = memory_bytes
        self._touched_by, self._ledger = touched_by, mover.pending.ledger
        self._saved = self._ledger.fused()
        self._whole: KeyframeRows | None = None  # all keyframes at their final poses, once somebody asked
        self._target: int | None = None  # number of keyframes to go to
        self._next_client: int | None = 0  # next keyframe for `find_client`; None = all done

    def answer(self, asked: Rewind) -> dict[str, NDArray[Any]]:
        """Return how many keyframes the settled map has, and the newest of each session in the present map.

        `is_there`: False while keyframes are still added or removed. `ends`: places of the first and the last
        record.
        """
        self._whole = self._whole or self._ledger.newest().in_order()
        count = int(self._whole.in_map.sum())
        if asked.keyframes is not None:
            self._target = min(asked.keyframes, count)
        present = self._present()
        last = [np.flatnonzero(present.session == one)[-1] for one in np.unique(present.session)]
        newest = present[np.sort(np.array(last, np.int64))]
        return {
            "keyframes": np.asarray(count),
            "ends": np.column_stack([self._whole.segments, self._whole.offsets])[[0, -1] if count else []],
            "is_there": np.asarray(self._target is None and not self._mover.waiting),
            "sessions": np.frombuffer(b"".join(key for key, _ in newest), np.uint8).reshape(-1, 16),
            "seqs": newest.seqs,
            "segments": newest.segments,
            "offsets": newest.offsets,
            "poses": newest.poses,
        }

    def _present(self) -> KeyframeRows:
        rows = self._ledger.fused().in_order()
        return rows[rows.in_map]

    # --- keyframes ---

    def wait(self) -> float | None:
        """Return 0 if somebody wants another time than the present one; None = never."""
        return None if self._target is None else 0.0

    def begin(self) -> None:
        """Choose the fastest way to the wanted time. The mover then adds and removes keyframes."""
        whole = self._whole
        assert whole is not None
        goal = whole.poses.copy()
        goal[np.flatnonzero(whole.in_map)[self._target :]] = np.nan
        self._target = None
        starts = {"on": self._ledger.fused().in_order().poses}
        if set(self._saved) <= set(whole):
            starts["saved"] = self._poses_at_opening(whole)
        if self._volume.keyframes == len(self._present()):  # the journal has all of them
            starts["empty"] = np.full_like(goal, np.nan)
        if self._volume.model.regularizer != "off":
            # A map smoothed along rays depends on the order of keyframes: only add, if that is possible
            starts = {way: one for way, one in starts.items() if not _removals(one, goal)} or starts
        way = min(starts, key=lambda way: _steps(starts[way], goal) + _READING * (way == "saved"))
        if way != "on":
            self._replace(way, whole, starts[way])
        if _removals(starts[way], goal):
            self._next_client = 0  # whoever touched their blocks before them
        leaves = np.isnan(goal[:, 0])
        for row in [*np.flatnonzero(leaves)[::-1].tolist(), *np.flatnonzero(~leaves).tolist()]:
            session, seq = whole.sessions[whole.session[row]], int(whole.seqs[row])
            self._ledger.want(session, seq, goal[row])
            self._mover.pending.note(session, [seq])
        self._mover.say()

    def _poses_at_opening(self, whole: KeyframeRows) -> Poses:
        """Return the poses of all keyframes in the saved map, NaN for those that it lacks."""
        row_of = {keyframe: row for row, keyframe in enumerate(whole)}
        poses = np.full_like(whole.poses, np.nan)
        poses[[row_of[one] for one in self._saved]] = self._saved.poses
        return poses

    def _replace(self, way: str, whole: KeyframeRows, poses: Poses) -> None:
        """Begin with the saved map, or with an empty one."""
        from tsfusion.tsdf.volume import Volume

        self._volume.clear()
        if way == "saved":
            self._volume.merge(Volume.load(self._file, memory_bytes=self._memory_bytes))
        self._ledger.place(whole, poses)
        self._touched_by.clear()
        self._mover.moved += 1  # by which viewers know that paths have changed
        self._next_client = None if way == "empty" else 0
        self._note()

    # --- clients ---

    def clients_wait(self) -> float | None:
        """Return 0 if it is not known yet whose keyframe touched each block last, and can be found."""
        is_over = self._next_client is None or self._mover.waiting or self._volume.model.regularizer != "off"
        return None if is_over or len(self._ledger.fused().sessions) < 2 else 0.0

    def find_client(self) -> None:
        """Find the client that touched one more keyframe's blocks: remove the keyframe, then add it again.

        The map does not change, so viewers get the cells again only when all clients are found (`note`).
        """
        present, index = self._present(), self._next_client or 0
        if index >= len(present):
            self._next_client = None
            self._note()
            return
        self._next_client = index + 1
        session, _ = next(iter(present[[index]]))
        place = Position(int(present.segments[index]), int(present.offsets[index]))
        try:
            found = codec.decode_keyframe(journal.read(self._file.parent / JOURNAL_FOLDER, place).frames)
            found = replace(found, T_world_camera=square(present.poses[[index]])[0])
            self._volume.retract(found)
            self._touched_by.note(self._volume.version + 1, session)
            self._volume.integrate(found)
        except TsfusionError:  # its blocks stay without a client
            return


def _removals(start: Poses, goal: Poses) -> int:
    """Return the number of keyframes to take out of a map, on a way from start to goal."""
    return int((~np.isnan(start[:, 0]) & (start != goal).any(axis=1)).sum())


def _steps(start: Poses, goal: Poses) -> int:
    """Return the number of additions and removals on a way from start to goal."""
    return _removals(start, goal) + _removals(goal, start)
