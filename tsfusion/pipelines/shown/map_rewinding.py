# SPDX-License-Identifier: MIT
"""Take a saved map to any time of its journal, by adding and subtracting keyframes exactly.

Keyframes are in the order of the journal, which for each scanner is the order of capture. Each is at its
final pose. Keyframes of the map that the journal no longer has stay in the map at every time.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.errors import CheckpointError, DecodeError, InvalidKeyframe, JournalError, MapError
from tsfusion.fuser.live_mesh import TouchedBy
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.se3 import Poses
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes, JournaledSession, KeyframePlace
from tsfusion.journal.mcap_layout import Record
from tsfusion.tsdf.files import checkpoint, map_history
from tsfusion.tsdf.volume import Volume
from tsfusion.wire.records import codec

_READING = 20  # reading a saved map takes as long as fusing about so many keyframes
_ABSENT, _THERE, _ELSEWHERE, _LEFT_OUT = 0, 1, 2, 3  # of a keyframe; elsewhere = not at its final pose


class _Removed(NamedTuple):
    """A keyframe in the saved map that the journal's corrections remove, and the pose where it was fused."""

    place: KeyframePlace
    T: NDArray[np.float64]


class RewoundMap:
    """A saved map that can be taken to any number of its keyframes.

    Args:
        file: the saved map.
        journaled: keyframes of its journal; None without a journal: then the map stays as it is.
        memory_bytes: see `Volume`.

    Attributes:
        sessions: sessions of the keyframes.
        places, poses: the n keyframes that can be added or removed, in order; their final (n, 4, 4) poses.
        fixed: poses of the other keyframes, by session and number.
        target: number of keyframes wanted in the map.
        left_out: reason → number of keyframes that could not be added or removed since the map was opened.

    Raises:
        CheckpointError, JournalError: when the map or its journal cannot be read.
    """

    def __init__(
        self, file: Path, journaled: JournaledKeyframes | None, *, memory_bytes: int | None = None
    ) -> None:
        self._file, self._memory_bytes = file, memory_bytes
        with checkpoint.reading(file) as (self.header, _):
            pass
        self.sessions: dict[bytes, JournaledSession] = {} if journaled is None else journaled.sessions
        self.left_out = Counter[str]()
        self._volume: Volume | None = None
        self._way = "on"  # go on from the present map; else `step` begins from "empty" or "saved"
        self._touched_by = TouchedBy()
        self._touched_again: int | None = 0  # next for `find_clients`; None = all done
        self._list(journaled)
        self.target = len(self.places)
        self._now = self._saved.copy()
        self._to_remove = list(self._removed)

    def _list(self, journaled: JournaledKeyframes | None) -> None:
        """Find out which keyframes the saved map has, and at which poses."""
        histories = {bytes.fromhex(one.session): one for one in map_history.sessions(self.header.meta)}
        fused = {
            (key, seq): (T, position)
            for key, one in histories.items()
            for seq, T, position in zip(one.seqs.tolist(), _square(one.poses), one.positions, strict=True)
        }
        listed = [] if journaled is None else zip(journaled.places(), journaled.poses(), strict=True)
        found: list[tuple[KeyframePlace, NDArray[np.float64], NDArray[np.float64], int]] = []
        for place, T in listed:
            there = fused.pop((place.session, place.seq), None)
            if there is not None:
                is_moved = not np.array_equal(there[0], T)
                found.append((place, T, there[0], _ELSEWHERE if is_moved else _THERE))
            elif _may_come(histories.get(place.session), place.seq):
                found.append((place, T, T, _ABSENT))
        self.places = [one[0] for one in found]
        self.poses = np.array([one[1] for one in found]).reshape(-1, 4, 4)
        self._saved_poses = np.array([one[2] for one in found]).reshape(-1, 4, 4)
        self._saved = np.array([one[3] for one in found], np.int8)
        self._removed: list[_Removed] = []
        self.fixed: dict[tuple[bytes, int], NDArray[np.float64]] = {}
        for (key, seq), (T, (segment, offset)) in fused.items():
            place = KeyframePlace(key, seq, self._segment(int(segment)), int(offset))
            if journaled is not None and _is_readable(place):
                self._removed.append(_Removed(place, T))
            else:
                self.fixed[key, seq] = T
        known = len(self._removed) + int((self._saved != _ABSENT).sum())
        self._begins_empty = (
            known >= self.header.keyframes
            and not self.fixed
            and not any(one.unlisted for one in histories.values())
        )

    def _segment(self, number: int) -> Path:
        return journal.segment_path(self._file.parent / state_folder.JOURNAL_FOLDER, number)

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
        return int(np.isin(self._now, (_THERE, _ELSEWHERE)).sum())

    @property
    def behind(self) -> int:
        """Number of keyframes to add, remove or move until the saved map is settled."""
        return _steps(self._saved, len(self._saved)) + len(self._removed)

    @property
    def is_there(self) -> bool:
        """True if the map has exactly the first `target` keyframes at their final poses."""
        return self._way == "on" and not self._to_remove and not _steps(self._now, self.target)

    def keyframes_in(self) -> dict[bytes, tuple[NDArray[np.int64], Poses]]:
        """Return numbers and poses of the keyframes in the map, by session."""
        poses = np.where((self._now == _ELSEWHERE)[:, None, None], self._saved_poses, self.poses)
        present = dict(self.fixed)
        present.update({one.place[:2]: one.T for one in self._to_remove})
        for index in np.flatnonzero(np.isin(self._now, (_THERE, _ELSEWHERE))).tolist():
            present[self.places[index][:2]] = poses[index]
        found: dict[bytes, list[tuple[int, NDArray[np.float64]]]] = {}
        for (session, seq), T in present.items():
            found.setdefault(session, []).append((seq, T))
        return {key: _columns(sorted(each, key=lambda one: one[0])) for key, each in found.items()}

    def last_of_sessions(self) -> list[int]:
        """Return the index of each session's last keyframe in the map, in order."""
        last = {self.places[index].session: index for index in np.flatnonzero(self._now == _THERE).tolist()}
        return sorted(last.values())

    def seek(self, keyframes: int) -> None:
        """Set `target` to this number of keyframes, and choose the fastest way for `step`."""
        self.target = min(max(keyframes, 0), len(self.places))
        costs = {"on": self._cost("on")}
        costs["saved"] = self._cost("saved") + _READING
        if self._begins_empty:
            costs["empty"] = self._cost("empty")
        if self.header.config.checked_model().regularizer != "off":
            # A map smoothed along rays depends on the order of keyframes: only add, if that is possible
            costs = {way: cost for way, cost in costs.items() if self._only_adds(way)} or costs
        self._way = min(costs, key=costs.__getitem__)
        self._now, self._to_remove = self._contents(self._way)

    def _contents(self, way: str) -> tuple[NDArray[np.int8], list[_Removed]]:
        """Return the states of keyframes at the start of a way, and the keyframes to be removed."""
        if way == "empty":
            return np.full_like(self._saved, _ABSENT), []
        return (self._now, self._to_remove) if way == "on" else (self._saved.copy(), list(self._removed))

    def _cost(self, way: str) -> int:
        now, to_remove = self._contents(way)
        return _steps(now, self.target) + len(to_remove)

    def _only_adds(self, way: str) -> bool:
        now, to_remove = self._contents(way)
        return not to_remove and not (now == _ELSEWHERE).any() and not (now[self.target :] == _THERE).any()

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
        late = np.flatnonzero(self._now[self.target :] == _THERE)
        moved = np.flatnonzero(self._now == _ELSEWHERE)
        if self._to_remove:
            one = self._to_remove.pop()
            self._retract(one.place, one.T)
        elif len(moved):
            index = int(moved[-1])
            is_gone = self._retract(self.places[index], self._saved_poses[index])
            self._now[index] = _ABSENT if is_gone else _LEFT_OUT
        elif len(late):
            index = self.target + int(late[-1])
            is_gone = self._retract(self.places[index], self.poses[index])
            self._now[index] = _ABSENT if is_gone else _LEFT_OUT
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
        if self._retract(self.places[index], self.poses[index]):
            self._now[index] = _ABSENT
            self._add(index)
        self._touched_again = index + 1

    def clients_of(self, cells: NDArray[np.int32]) -> tuple[tuple[bytes, ...], NDArray[np.int32]]:
        """Return sessions, and for each of (n, 3) cells the row of its last session in them; −1 = unknown."""
        sessions, rows = self._touched_by.of(self.volume.surface.cell_stamps(cells)[1])
        known = [row for row, session in enumerate(sessions) if session]
        new = np.full(len(sessions) + 1, -1, np.int32)  # the last stands for "not known"
        new[known] = np.arange(len(known))
        return tuple(sessions[row] for row in known), new[rows]

    def _add(self, index: int) -> None:
        session = b""
        try:
            self.volume.integrate(_read(self.places[index], self.poses[index]))
            self._now[index], session = _THERE, self.places[index].session
        except (MapError, DecodeError, InvalidKeyframe, JournalError) as error:
            self.left_out[str(error)] += 1
            self._now[index] = _LEFT_OUT
        self._touched_by.note(self.volume.stamp, session)

    def _retract(self, place: KeyframePlace, T: NDArray[np.float64]) -> bool:
        self._touched_again = 0
        try:
            self.volume.retract(_read(place, T))
            self._touched_by.note(self.volume.stamp, b"")
        except (MapError, DecodeError, InvalidKeyframe, JournalError) as error:
            self.left_out[str(error)] += 1
            return False
        return True

    def record(self, index: int) -> Record:
        """Return the record of a keyframe. Raise JournalError if it can no longer be read."""
        place = self.places[index]
        return journal.read_at(place.file, place.offset)


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


def _read(place: KeyframePlace, T: NDArray[np.float64]) -> Keyframe:
    found = codec.decode_keyframe(journal.read_at(place.file, place.offset).frames)
    return replace(found, T_world_camera=T)


def _is_readable(place: KeyframePlace) -> bool:
    try:
        record = journal.read_at(place.file, place.offset)
    except JournalError:
        return False
    return (record.session, record.seq) == place[:2]


def _square(rows: NDArray[np.float64]) -> Poses:
    """Return (n, 4, 4) poses from their (n, 12) upper rows."""
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows.reshape(-1, 3, 4)
    return T


def _columns(keyframes: list[tuple[int, Any]]) -> tuple[NDArray[np.int64], Poses]:
    seqs = np.array([seq for seq, _ in keyframes], np.int64)
    return seqs, np.array([T for _, T in keyframes]).reshape(-1, 4, 4)
