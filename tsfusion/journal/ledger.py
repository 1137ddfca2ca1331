# SPDX-License-Identifier: MIT
"""Keep the ledger of a map: its keyframes, the pose at which each is fused, and the pose that it is to have.

The map is settled when the two poses of every keyframe agree. Then it equals, to the bit, a fresh map of
these keyframes at their final poses. A keyframe's newest pose is in the newest correction that names it.
Without a correction, it is the sent pose, multiplied from the left by the newest earlier `T_map_odometry` of
its session.

The settled map has no forgotten keyframe, whatever corrections say and in whatever order records arrive.
"""

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import DecodeError
from tsfusion.core.number_ranges import NumberRanges
from tsfusion.geometry.keyframe import Keyframe, check_pose
from tsfusion.geometry.keyframe_rows import COLUMNS, POSE, FlatPose, KeyframeRows, square
from tsfusion.journal import Position, Record
from tsfusion.wire.records import codec
from tsfusion.wire.records.corrections import Correction

_ABSENT = np.full(POSE, np.nan)  # instead of the pose of a keyframe that is not in the map
_WIDTHS = {name: POSE if name == "fused" else 1 for name in COLUMNS}


class _SessionColumns:
    """The keyframes of one session in the map, in the order of their numbers, one array for each property."""

    def __init__(self) -> None:
        self.seqs = array("q")
        self.segments = array("q")
        self.offsets = array("q")
        self.fused = array("d")  # 12 numbers each
        self.T_map_odometry: NDArray[np.float64] | None = None  # (4, 4)
        self.unknown = 0  # no poses are known up to this number: an earlier version fused these keyframes,
        # or the journal has them no more
        self.missed: set[int] = set()  # numbers of unknown keyframes that corrections name
        self.forgotten = NumberRanges()

    def pose(self, at: int) -> FlatPose:
        return np.array(self.fused[POSE * at : POSE * (at + 1)])

    def find(self, seq: int) -> int | None:
        """Return the index of a keyframe; None if it is unknown."""
        at = bisect_left(self.seqs, seq)
        return at if at < len(self.seqs) and self.seqs[at] == seq else None

    def part(self, start: int = 0, stop: int | None = None) -> dict[str, "array[Any]"]:
        """Return the columns of the keyframes from index `start` to before `stop`."""
        stop = len(self.seqs) if stop is None else stop
        return {name: getattr(self, name)[width * start : width * stop] for name, width in _WIDTHS.items()}

    def drop(self, start: int, stop: int) -> None:
        """Remove the keyframes from index `start` to before `stop`."""
        for name, width in _WIDTHS.items():
            del getattr(self, name)[width * start : width * stop]

    def saved(self) -> dict[str, Any]:
        T = self.T_map_odometry
        return {
            **{name: column.tobytes() for name, column in self.part().items()},
            "T": b"" if T is None else T.tobytes(),
            "unknown": self.unknown,
            "missed": sorted(self.missed),
            "forgotten": list(self.forgotten),
        }

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> "_SessionColumns":
        found = cls()
        for name in COLUMNS:
            getattr(found, name).frombytes(saved[name])
        if saved["T"]:
            found.T_map_odometry = np.frombuffer(saved["T"]).reshape(4, 4).copy()
        found.unknown, found.missed = saved["unknown"], set(saved["missed"])
        found.forgotten = NumberRanges(tuple(one) for one in saved.get("forgotten", ()))
        return found


class Ledger:
    """A map's keyframes, 120 bytes each, and the poses that some are still to get.

    Args:
        saved: the dict of `saved`, from the map's file.
        done: session → highest number in the map; used for a map file without `saved`.

    Attributes:
        wanted: session and number → newest pose of each keyframe that is fused at another one, oldest first.
        removed: number of keyframes that corrections took out of the map.
        forgotten: number of these that the server took out, for good.
    """

    def __init__(
        self, saved: Mapping[str, Any] | None = None, done: Mapping[bytes, int] | None = None
    ) -> None:
        self._sessions: dict[bytes, _SessionColumns] = {}
        for key, seq in ({} if saved else done or {}).items():
            self._session(key).unknown = seq
        saved = saved or {}
        for name, one in saved.get("sessions", {}).items():
            self._sessions[bytes.fromhex(name)] = _SessionColumns.of(one)
        self.removed: int = saved.get("removed", 0)
        self.forgotten: int = saved.get("forgotten", 0)
        self.wanted: dict[tuple[bytes, int], FlatPose] = {
            (bytes.fromhex(name), seq): np.frombuffer(pose) for name, seq, pose in saved.get("waiting", ())
        }

    def saved(self) -> dict[str, Any]:
        """Return the ledger's whole state for the file of a map: dicts, lists, numbers and bytes."""
        return {
            "sessions": {key.hex(): one.saved() for key, one in self._sessions.items()},
            "waiting": [(key.hex(), seq, pose.tobytes()) for (key, seq), pose in self.wanted.items()],
            "removed": self.removed,
            "forgotten": self.forgotten,
        }

    @property
    def unavailable(self) -> int:
        """Number of keyframes that a correction names but that the journal no longer has."""
        return sum(len(one.missed) for one in self._sessions.values())

    @property
    def first_segment(self) -> int:
        """The lowest number of a segment with a keyframe of the map; 0 without keyframes."""
        return min((one.segments[0] for one in self._sessions.values() if one.segments), default=0)

    def forgotten_of(self, session: bytes) -> NumberRanges:
        """Return the numbers of a session's keyframes that the server was told to forget."""
        return self._sessions[session].forgotten if session in self._sessions else NumberRanges()

    def unknown(self) -> Iterator[tuple[bytes, int]]:
        """Yield each session with keyframes of unknown pose (of older versions), and their highest number."""
        return ((key, one.unknown) for key, one in self._sessions.items() if one.unknown)

    # --- keyframes ---

    def placed(self, session: bytes, keyframe: Keyframe) -> Keyframe:
        """Return an arriving keyframe at the pose at which it is to be fused.

        Raises:
            InvalidKeyframe: that pose is farther away than any pose may be.
        """
        one = self._sessions.get(session)
        if one is None or one.T_map_odometry is None:
            return keyframe
        return replace(keyframe, T_world_camera=check_pose(one.T_map_odometry @ keyframe.T_world_camera))

    def add(self, session: bytes, seq: int, position: Position, keyframe: Keyframe) -> None:
        """Record that a session's next keyframe was fused."""
        one = self._session(session)
        one.seqs.append(seq)
        one.segments.append(position.segment)
        one.offsets.append(position.offset)
        one.fused.extend(keyframe.T_world_camera[:3].ravel())

    def leave_out(self) -> None:
        """Count a forgotten keyframe that arrived and was not fused."""
        self.removed += 1
        self.forgotten += 1

    def pose_of(self, session: bytes, seq: int) -> NDArray[np.float64] | None:
        """Return a keyframe's newest pose, (4, 4) float64; None if it is not in the map or unknown."""
        one = self._sessions.get(session)
        at = None if one is None else one.find(seq)
        if one is None or at is None:
            return None
        pose = self.wanted.get((session, seq), one.pose(at))
        return None if np.isnan(pose[0]) else square(pose[None])[0]

    def place_of(self, session: bytes, seq: int) -> tuple[Position, FlatPose]:
        """Return the position of a known keyframe's record, and its fused pose."""
        one, at = self._known(session, seq)
        return Position(one.segments[at], one.offsets[at]), one.pose(at)

    # --- selections ---

    def fused(self) -> KeyframeRows:
        """Return all known keyframes, at their fused poses."""
        return KeyframeRows.of_saved({key: one.part() for key, one in self._sessions.items()})

    def newest(self) -> KeyframeRows:
        """Return all known keyframes, at their newest poses."""
        return self._moved(self.fused(), self.wanted)

    def kept(self) -> KeyframeRows:
        """Return the keyframes in the map that are not forgotten, at their newest poses.

        A keyframe that a correction takes out counts, at its fused pose, until it has left.
        """
        rows = self.fused()
        forgotten = [one.forgotten.mask(np.array(one.seqs)) for one in self._sessions.values()]
        stays = rows.in_map & ~np.concatenate([np.zeros(0, np.bool_), *forgotten])
        moved = {key: pose for key, pose in self.wanted.items() if not np.isnan(pose[0])}
        return self._moved(rows, moved)[stays]

    def _moved(self, rows: KeyframeRows, poses: Mapping[tuple[bytes, int], FlatPose]) -> KeyframeRows:
        starts = np.cumsum([0, *(len(one.seqs) for one in self._sessions.values())]).tolist()
        start_of = dict(zip(self._sessions, starts, strict=False))
        for (key, seq), pose in poses.items():
            rows.poses[start_of[key] + self._known(key, seq)[1]] = pose
        return rows

    def fused_after(
        self, session: bytes, seq: int, most: int
    ) -> tuple[KeyframeRows, NDArray[np.float64], tuple[bytes, int] | None]:
        """Return fused poses of up to `most` keyframes that come after number `seq` of `session`.

        The order is that of sessions, then numbers; later sessions come after this one.

        Returns:
            The keyframes in the map; (k, 4, 4) `T_map_odometry` of each of their sessions, the factor from
            the left for the poses of its next keyframes; and session and number of the last keyframe
            examined, or None if there are no more.
        """
        parts: dict[bytes, dict[str, array[Any]]] = {}
        last: tuple[bytes, int] | None = None
        for key in sorted(key for key in self._sessions if key >= session):
            one = self._sessions[key]
            start = bisect_right(one.seqs, seq) if key == session else 0
            parts[key] = one.part(start, min(start + most, len(one.seqs)))
            most -= len(parts[key]["seqs"])
            if start + len(parts[key]["seqs"]) < len(one.seqs):
                last = key, parts[key]["seqs"][-1] if parts[key]["seqs"] else seq if key == session else 0
                break
        rows = KeyframeRows.of_saved(parts)
        moved = [self._sessions[key].T_map_odometry for key in parts]
        T = np.array([np.eye(4) if one is None else one for one in moved]).reshape(-1, 4, 4)
        return rows[rows.in_map], T, last

    # --- corrections ---

    def correct(self, session: bytes, correction: Correction) -> list[int]:
        """Record new poses of keyframes; return the numbers of those that are in the map.

        Keyframes that the map rejected or forgot stay out of it.
        """
        one = self._session(session)
        if correction.T_map_odometry is not None:
            one.T_map_odometry = correction.T_map_odometry
        poses = [*correction.poses[:, :3].reshape(-1, POSE), *[_ABSENT] * len(correction.removed)]
        numbers = [*correction.seqs.tolist(), *correction.removed.tolist()]
        moves = [move for move in zip(numbers, poses, strict=True) if move[0] not in one.forgotten]
        return [seq for seq, pose in moves if self.want(session, seq, pose)]

    def forget(self, session: bytes, seqs: NDArray[np.int64]) -> list[int]:
        """Record that keyframes leave the map for good, including those that arrive later.

        Return the numbers of those that are in the map.
        """
        one = self._session(session)
        one.forgotten.add(seqs)
        known = [seq for seq in seqs.tolist() if self.want(session, seq, _ABSENT)]
        for seq in known:
            if (session, seq) not in self.wanted:
                self._drop_forgotten(session, seq)
        return known

    def take_forgetting(self, record: Record) -> None:
        """Forget the keyframes that a record of the server names; ignore any other or damaged record."""
        if record.session == SERVER_SESSION and record.is_correction:
            with suppress(DecodeError):  # `tsfusion journal verify` tells of it
                found = codec.decode(record.frames)
                if isinstance(found, Correction) and found.target is not None:
                    self.forget(found.target, found.removed)

    def want(self, session: bytes, seq: int, wanted: FlatPose) -> bool:
        """Record the newest pose of a keyframe; return False if the ledger does not know the keyframe."""
        one = self._sessions[session]
        at = one.find(seq)
        if at is None:
            if seq <= one.unknown:
                one.missed.add(seq)
            return False
        self.wanted.pop((session, seq), None)
        if not np.array_equal(one.pose(at), wanted, equal_nan=True):
            self.wanted[session, seq] = wanted.copy()  # by it the mover knows the newest wish
        return True

    def place(self, rows: KeyframeRows, poses: NDArray[np.float64]) -> None:
        """Record that another map took the place of the present one: keyframes are fused at these poses."""
        for key, each in replace(rows, poses=poses).by_session():
            one = self._sessions[key]
            one.fused = array("d", each[np.argsort(each.seqs)].poses.ravel())
        self.wanted.clear()

    def set_fused(self, session: bytes, seq: int) -> None:
        """Record that a keyframe is now fused at its newest pose, or out of the map."""
        one, at = self._known(session, seq)
        wanted = self.wanted.pop((session, seq))
        self.removed += int(np.isnan(wanted[0])) - int(np.isnan(one.fused[POSE * at]))
        one.fused[POSE * at : POSE * (at + 1)] = array("d", wanted)
        if seq in one.forgotten:
            self._drop_forgotten(session, seq)

    def _drop_forgotten(self, session: bytes, seq: int) -> None:
        one, at = self._known(session, seq)
        one.drop(at, at + 1)
        self.forgotten += 1

    def drop_deleted(self, before_segment: int) -> None:
        """Remove the keyframes whose records were deleted from the journal: they can no longer be moved."""
        for key, one in self._sessions.items():
            if count := bisect_left(one.segments, before_segment):
                gone = one.seqs[:count]
                one.unknown = gone[-1]
                one.missed.update(seq for seq in gone if self.wanted.pop((key, seq), None) is not None)
                one.drop(0, count)

    def _session(self, key: bytes) -> _SessionColumns:
        if key not in self._sessions:
            self._sessions[key] = _SessionColumns()
        return self._sessions[key]

    def _known(self, session: bytes, seq: int) -> tuple[_SessionColumns, int]:
        """Return the columns of a known keyframe's session, and the keyframe's index in them."""
        one = self._sessions[session]
        return one, bisect_left(one.seqs, seq)
