# SPDX-License-Identifier: MIT
"""Take a saved map to any time of its journal, by adding and subtracting keyframes exactly.

Keyframes are in the order of the journal, which for each scanner is the order of capture. Each is at its
final pose. Keyframes of the map that the journal no longer has stay in the map at every time.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.errors import CheckpointError, DecodeError, InvalidKeyframe, JournalError, MapError
from tsfusion.fuser.live_mesh import TouchedBy
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.keyframe_rows import KeyframeRows, square
from tsfusion.geometry.se3 import Poses
from tsfusion.journal import Position, state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes, JournaledSession
from tsfusion.journal.mcap_layout import Record
from tsfusion.tsdf.files import checkpoint, map_history
from tsfusion.tsdf.volume import Volume
from tsfusion.wire.records import codec

_READING = 20  # reading a saved map takes as long as fusing about so many keyframes
_ABSENT, _THERE, _ELSEWHERE, _LEFT_OUT = 0, 1, 2, 3  # of a keyframe; elsewhere = not at its final pose


class RewoundMap:
    """A saved map that can be taken to any number of its keyframes.

    Args:
        file: the saved map.
        journaled: keyframes of its journal; None without a journal: then the map stays as it is.
        memory_bytes: see `Volume`.

    Attributes:
        sessions: sessions of the keyframes.
        rows: the keyframes that can be added or removed, at their final poses, in order; then those of the
            saved map that the journal's corrections remove, at their fused poses.
        count: number of these without those to be removed.
        fixed: the other keyframes.
        target: number of keyframes wanted in the map.
        left_out: reason → number of keyframes that could not be added or removed since the map was opened.

    Raises:
        CheckpointError, JournalError: when the map or its journal cannot be read.
    """

    def __init__(
        self, file: Path, journaled: JournaledKeyframes | None, *, memory_bytes: int | None = None
    ) -> None:
        self._file, self._memory_bytes = file, memory_bytes
        self._journal = file.parent / state_folder.JOURNAL_FOLDER
        with checkpoint.reading(file) as (self.header, _):
            pass
        self.sessions: dict[bytes, JournaledSession] = {} if journaled is None else journaled.sessions
        self.left_out = Counter[str]()
        self._volume: Volume | None = None
        self._way = "on"  # go on from the present map; else `step` begins from "empty" or "saved"
        self._touched_by = TouchedBy()
        self._touched_again: int | None = 0  # next for `find_clients`; None = all done
        self._list(journaled)
        self.target = self.count
        self._now: NDArray[np.int8] = self._saved.copy()

    def _list(self, journaled: JournaledKeyframes | None) -> None:
        """Find out which keyframes the saved map has, and at which poses."""
        histories = {bytes.fromhex(one.session): one for one in map_history.sessions(self.header.meta)}
        saved = map_history.rows(self.header.meta)
        row_of = {keyframe: row for row, keyframe in enumerate(saved)}
        self._files = [] if journaled is None else list(journaled.files)
        listed = saved[:0] if journaled is None else journaled.rows
        comes = [one in row_of or _may_come(histories.get(one[0]), one[1]) for one in listed]
        listed = listed[np.array(comes, np.bool_)]
        row = np.array([row_of.pop(one, -1) for one in listed], np.int64)
        is_in = row >= 0
        fused = listed.poses.copy()
        fused[is_in] = saved.poses[row[is_in]]
        is_moved = (fused != listed.poses).any(axis=1)
        others = saved[np.array([*row_of.values()], np.int64)]
        places = zip(others, others.segments.tolist(), others.offsets.tolist(), strict=True)
        is_there = [journaled is not None and self._has(key, Position(*place)) for key, *place in places]
        is_readable = np.array(is_there, np.bool_)
        self.fixed, removed = others[~is_readable], self._with_files(others[is_readable])
        self.count = len(listed)
        self.rows = listed.joined(removed)
        self._saved_poses = np.concatenate([fused, removed.poses])
        states = np.where(is_in, np.where(is_moved, _ELSEWHERE, _THERE), _ABSENT)
        self._saved: NDArray[np.int8] = np.append(states, np.full(len(removed), _THERE)).astype(np.int8)
        self._begins_empty = (
            int((self._saved != _ABSENT).sum()) >= self.header.keyframes
            and not len(self.fixed)
            and not any(one.unlisted for one in histories.values())
        )

    def _with_files(self, rows: KeyframeRows) -> KeyframeRows:
        """Return rows whose segments are indices into `_files`."""
        numbers, which = np.unique(rows.segments, return_inverse=True)
        first = len(self._files)
        self._files += [journal.segment_path(self._journal, number) for number in numbers.tolist()]
        return replace(rows, segments=first + which)

    def _has(self, keyframe: tuple[bytes, int], position: Position) -> bool:
        """Return True if the journal has a keyframe's record at a position."""
        try:
            record = journal.read(self._journal, position)
        except JournalError:
            return False
        return (record.session, record.seq) == keyframe

    @property
    def volume(self) -> Volume:
        """The map, read at the first use. It is another object after a `step` that returned True."""
        if self._volume is None:
            self._volume = self._load()
        return self._volume

    def _load(self) -> Volume:
        volume = Volume.load(self._file, memory_bytes=self._memory_bytes)
        if volume.meta.get("done") != self.header.meta.get("done"):
            raise CheckpointError(f"{self._file} was written anew while it was read: open it again")
        return volume

    @property
    def seconds(self) -> float | None:
        """Seconds from the first to the last record of the keyframes' sessions; None without sessions."""
        spans = [(one.first_ns, one.last_ns) for one in self.sessions.values()]
        if not spans:
            return None
        return (max(last for _, last in spans) - min(first for first, _ in spans)) / 1e9

    @property
    def place(self) -> int:
        """Number of keyframes in the map that can be removed."""
        return int(np.isin(self._now[: self.count], (_THERE, _ELSEWHERE)).sum())

    @property
    def behind(self) -> int:
        """Number of keyframes to add, remove or move until the saved map is settled."""
        return _steps(self._saved, self.count)

    @property
    def is_there(self) -> bool:
        """True if the map has exactly the first `target` keyframes at their final poses."""
        return self._way == "on" and not _steps(self._now, self.target)

    def keyframes_in(self) -> dict[bytes, tuple[NDArray[np.int64], Poses]]:
        """Return numbers and poses of the keyframes in the map, by session."""
        poses = np.where((self._now == _ELSEWHERE)[:, None], self._saved_poses, self.rows.poses)
        is_in = np.isin(self._now, (_THERE, _ELSEWHERE))
        present = replace(self.rows, poses=poses)[is_in].joined(self.fixed)
        present = present[np.argsort(present.seqs, kind="stable")]
        return {key: (each.seqs, each.matrices) for key, each in present.by_session()}

    def last_of_sessions(self) -> list[int]:
        """Return the index of each session's last keyframe in the map, in order."""
        there = np.flatnonzero(self._now[: self.count] == _THERE)
        last = dict(zip(self.rows.session[there].tolist(), there.tolist(), strict=True))
        return sorted(last.values())

    def seek(self, keyframes: int) -> None:
        """Set `target` to this number of keyframes, and choose the fastest way for `step`."""
        self.target = min(max(keyframes, 0), self.count)
        costs = {"on": self._cost("on")}
        costs["saved"] = self._cost("saved") + _READING
        if self._begins_empty:
            costs["empty"] = self._cost("empty")
        if self.header.config.checked_model().regularizer != "off":
            # A map smoothed along rays depends on the order of keyframes: only add, if that is possible
            costs = {way: cost for way, cost in costs.items() if self._only_adds(way)} or costs
        self._way = min(costs, key=costs.__getitem__)
        self._now = self._contents(self._way)

    def _contents(self, way: str) -> NDArray[np.int8]:
        """Return the states of keyframes at the start of a way."""
        empty = np.full(len(self._saved), _ABSENT, np.int8)
        begins: dict[str, NDArray[np.int8]] = {"on": self._now, "saved": self._saved, "empty": empty}
        return np.array(begins[way])

    def _cost(self, way: str) -> int:
        return _steps(self._contents(way), self.target)

    def _only_adds(self, way: str) -> bool:
        now = self._contents(way)
        return not (now == _ELSEWHERE).any() and not (now[self.target :] == _THERE).any()

    def step(self) -> bool:
        """Add or remove a keyframe, or begin from another map. Return True if `volume` is a new object.

        Raises:
            CheckpointError: when the saved map cannot be read any more.
        """
        if self._way != "on":
            self._volume = None  # there is memory for one volume only
            if self._way == "saved":
                self._volume = self._load()
            else:
                self._volume = Volume(self.header.config, memory_bytes=self._memory_bytes)
            self._touched_by = TouchedBy()
            self._touched_again = None if self._way == "empty" else 0
            self._way = "on"
            return True
        late = self.target + np.flatnonzero(self._now[self.target :] == _THERE)
        moved = np.flatnonzero(self._now == _ELSEWHERE)
        if len(moved) or len(late):
            index, poses = (moved[-1], self._saved_poses) if len(moved) else (late[-1], self.rows.poses)
            self._now[index] = _ABSENT if self._retract(int(index), poses) else _LEFT_OUT
        else:
            self._add(int(np.argmax(self._now[: self.target] == _ABSENT)))
        return False

    @property
    def knows_clients(self) -> bool:
        """True if the client that touched each block last is known, as far as the journal has it."""
        is_smoothed = self.header.config.checked_model().regularizer != "off"  # nothing may be taken away
        return self._touched_again is None or is_smoothed or len(self.sessions) < 2

    def find_clients(self) -> None:
        """Find the client that touched one more keyframe's blocks: remove the keyframe, then add it again."""
        index = self._touched_again or 0
        there = np.flatnonzero(self._now[index:] == _THERE)
        if not len(there):
            self._touched_again = None
            return
        index += int(there[0])
        if self._retract(index, self.rows.poses):
            self._add(index)
        self._touched_again = index + 1

    def clients_of(self, cells: NDArray[np.int32]) -> tuple[tuple[bytes, ...], NDArray[np.int32]]:
        """Return sessions, and for each of (n, 3) cells the row of its last session in them; −1 = unknown."""
        sessions, rows = self._touched_by.of(self.volume.surface.cell_versions(cells)[1])
        known = [row for row, session in enumerate(sessions) if session]
        new = np.full(len(sessions) + 1, -1, np.int32)  # the last stands for "not known"
        new[known] = np.arange(len(known))
        return tuple(sessions[row] for row in known), new[rows]

    def _add(self, index: int) -> None:
        session = b""
        try:
            self.volume.integrate(self._read(index, self.rows.poses))
            self._now[index], session = _THERE, self.rows.sessions[self.rows.session[index]]
        except (MapError, DecodeError, InvalidKeyframe, JournalError) as error:
            self.left_out[str(error)] += 1
            self._now[index] = _LEFT_OUT
        self._touched_by.note(self.volume.version, session)

    def _retract(self, index: int, poses: NDArray[np.float64]) -> bool:
        self._touched_again = 0
        try:
            self.volume.retract(self._read(index, poses))
            self._touched_by.note(self.volume.version, b"")
        except (MapError, DecodeError, InvalidKeyframe, JournalError) as error:
            self.left_out[str(error)] += 1
            return False
        return True

    def _read(self, index: int, poses: NDArray[np.float64]) -> Keyframe:
        found = codec.decode_keyframe(self.record(index).frames)
        return replace(found, T_world_camera=square(poses[[index]])[0])

    def record(self, index: int) -> Record:
        """Return the record of a keyframe. Raise JournalError if it can no longer be read."""
        return journal.read_at(self._files[self.rows.segments[index]], int(self.rows.offsets[index]))


def _may_come(history: map_history.SessionHistory | None, seq: int) -> bool:
    """True if a keyframe that is not in a saved map may be added: the map did not reject it."""
    return history is None or seq > history.last or seq in history.taken_out


def _steps(now: NDArray[np.int8], target: int) -> int:
    """Return the number of additions and removals until exactly the first `target` keyframes are in."""
    before, after = now[:target], now[target:]
    return int(
        (before == _ABSENT).sum() + (after == _THERE).sum() + 2 * (before == _ELSEWHERE).sum()
        + (after == _ELSEWHERE).sum()
    )  # fmt: skip
