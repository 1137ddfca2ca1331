# SPDX-License-Identifier: MIT
"""Track the pose at which each keyframe of a map is fused, and the newest pose that corrections give it.

The map is settled when the two poses of every keyframe agree. Then it equals, to the bit, a fresh map of
these keyframes at their final poses. A keyframe's newest pose is in the newest correction that names it.
Without a correction, it is the sent pose, multiplied from the left by the newest earlier `T_map_odometry` of
its session.

The settled map has no forgotten keyframe, whatever corrections say and in whatever order records arrive.
"""

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import replace
from heapq import heapify, heappop, heappush
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import NumberRanges
from tsfusion.geometry.keyframe import Keyframe, check_pose
from tsfusion.journal import Position
from tsfusion.wire.records.corrections import Correction

_POSE = 12  # numbers: the upper three rows
_LEVER = 2.0  # metres from a sensor at which a turn of it counts
_ABSENT = np.full(_POSE, np.nan)  # instead of the pose of a keyframe that is not in the map
_SPARE = 1024

FlatPose = NDArray[np.float64]  # (12,): the upper three rows of a pose; NaN = not in the map


class Move(NamedTuple):
    """A keyframe to be fused at another pose, taken out of the map, or put back.

    `fused`, `wanted`: (4, 4) float64 `T_world_camera`; None = not in the map.
    """

    session: bytes
    seq: int
    position: Position
    fused: NDArray[np.float64] | None
    wanted: NDArray[np.float64] | None


class KeptKeyframes(NamedTuple):
    """The keyframes that are in a map and stay in it.

    Attributes:
        sessions: their sessions.
        session: (n,) int64, the index in `sessions` of each keyframe's session.
        seqs, segments, offsets: (n,) int64, number and position of each.
        centers: (n, 3) float64 metres, the positions of the sensor.
    """

    sessions: list[bytes]
    session: NDArray[np.int64]
    seqs: NDArray[np.int64]
    segments: NDArray[np.int64]
    offsets: NDArray[np.int64]
    centers: NDArray[np.float64]


class FusedKeyframes(NamedTuple):
    """Some of a map's keyframes, and their fused poses.

    Attributes:
        sessions: their sessions.
        session: (n,) int32, the index in `sessions` of each keyframe's session.
        seqs: (n,) int64 numbers.
        poses: (n, 12) float64: the upper three rows of `T_world_camera`.
        T_map_odometry: (k, 4, 4) float64: factor from the left for the poses of each session's next
            keyframes.
        last: session and number of the last keyframe examined; None = there are no more.
    """

    sessions: list[bytes]
    session: NDArray[np.int32]
    seqs: NDArray[np.int64]
    poses: NDArray[np.float64]
    T_map_odometry: NDArray[np.float64]
    last: tuple[bytes, int] | None


class _SessionPoses:
    """The keyframes of one session that the map took, in the order of their numbers."""

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

    def rows(self, at: int) -> FlatPose:
        return np.array(self.fused[_POSE * at : _POSE * (at + 1)])

    def place_of(self, seq: int) -> int:
        """Return the index of a known keyframe."""
        return bisect_left(self.seqs, seq)

    def find(self, seq: int) -> int | None:
        """Return the index of a keyframe; None if it is unknown."""
        at = self.place_of(seq)
        return at if at < len(self.seqs) and self.seqs[at] == seq else None

    def drop(self, start: int, stop: int) -> None:
        """Remove the keyframes with indices from `start` to before `stop`."""
        for column in (self.seqs, self.segments, self.offsets):
            del column[start:stop]
        del self.fused[_POSE * start : _POSE * stop]

    def drop_deleted(self, before_segment: int) -> "array[int]":
        """Remove the keyframes of segments below this number; return their numbers."""
        count = bisect_left(self.segments, before_segment)
        gone = self.seqs[:count]
        if count:
            self.unknown = gone[-1]
            self.drop(0, count)
        return gone

    def kept(self) -> NDArray[np.bool_]:
        """Return an (n,) mask of the keyframes that are in the map and not forgotten."""
        first = np.array(self.fused).reshape(-1, _POSE)[:, 0]
        found: NDArray[np.bool_] = ~np.isnan(first) & ~self.forgotten.mask(np.array(self.seqs))
        return found

    def saved(self) -> dict[str, Any]:
        T = self.T_map_odometry
        columns = {name: getattr(self, name).tobytes() for name in ("seqs", "segments", "offsets", "fused")}
        return {
            **columns,
            "T": b"" if T is None else T.tobytes(),
            "unknown": self.unknown,
            "missed": sorted(self.missed),
            "forgotten": list(self.forgotten),
        }

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> "_SessionPoses":
        poses = cls()
        for name in ("seqs", "segments", "offsets", "fused"):
            getattr(poses, name).frombytes(saved[name])
        if saved["T"]:
            poses.T_map_odometry = np.frombuffer(saved["T"]).reshape(4, 4).copy()
        poses.unknown, poses.missed = saved["unknown"], set(saved["missed"])
        poses.forgotten = NumberRanges(tuple(one) for one in saved.get("forgotten", ()))
        return poses


class KeyframePoses:
    """The poses of a map's keyframes, 120 bytes each, and the moves still to be done.

    Args:
        saved: the dict of `saved`, from the map's file.
        done: session → highest number in the map; used for a map file without `saved`.
    """

    def __init__(self, saved: Mapping[str, Any] | None, done: Mapping[bytes, int]) -> None:
        self._sessions: dict[bytes, _SessionPoses] = {}
        self._waiting: dict[tuple[bytes, int], tuple[int, FlatPose]] = {}  # session, number → ticket, wanted
        self._heap: list[tuple[float, int, bytes, int]] = []  # minus metres, ticket, session, number
        self._tickets = 0
        self._stuck: set[tuple[bytes, int]] = set()  # waiting keyframes that cannot be moved
        for key, seq in ({} if saved else done).items():
            self._session(key).unknown = seq
        for name, one in (saved or {}).get("sessions", {}).items():
            self._sessions[bytes.fromhex(name)] = _SessionPoses.of(one)
        self.removed = (saved or {}).get("removed", 0)  # keyframes that corrections took out of the map
        self.forgotten = (saved or {}).get("forgotten", 0)  # of these, by the server, for good
        for name, seq, rows in (saved or {}).get("waiting", ()):
            self._want(bytes.fromhex(name), seq, np.frombuffer(rows))

    def saved(self) -> dict[str, Any]:
        """Return the whole state for the file of a map: dicts, lists, numbers and bytes."""
        sessions = {key.hex(): poses.saved() for key, poses in self._sessions.items()}
        waiting = [(key.hex(), seq, rows.tobytes()) for (key, seq), (_, rows) in self._waiting.items()]
        return {
            "sessions": sessions,
            "waiting": waiting,
            "removed": self.removed,
            "forgotten": self.forgotten,
        }

    @property
    def waiting(self) -> int:
        """Number of keyframes whose newest pose is not fused yet."""
        return len(self._waiting) - len(self._stuck)

    @property
    def unavailable(self) -> int:
        """Number of keyframes that a correction names but that cannot be moved."""
        return len(self._stuck) + sum(len(poses.missed) for poses in self._sessions.values())

    def placed(self, session: bytes, keyframe: Keyframe) -> Keyframe:
        """Return an arriving keyframe at its pose in the map.

        Raises:
            InvalidKeyframe: that pose is farther away than any pose may be.
        """
        poses = self._sessions.get(session)
        if poses is None or poses.T_map_odometry is None:
            return keyframe
        return replace(keyframe, T_world_camera=check_pose(poses.T_map_odometry @ keyframe.T_world_camera))

    def add(self, session: bytes, seq: int, position: Position, keyframe: Keyframe) -> None:
        """Record that the session's next keyframe was fused."""
        poses = self._session(session)
        poses.seqs.append(seq)
        poses.segments.append(position.segment)
        poses.offsets.append(position.offset)
        poses.fused.extend(keyframe.T_world_camera[:3].ravel())

    def fused_after(self, session: bytes, seq: int, most: int) -> "FusedKeyframes":
        """Return fused poses of up to `most` keyframes that come after number `seq` of `session`.

        The order is that of sessions, then numbers; later sessions come after this one.
        """
        sessions = sorted(key for key in self._sessions if key >= session)
        chosen: list[bytes] = []
        numbers, poses, rows = [np.zeros(0, np.int64)], [np.zeros((0, _POSE))], [np.zeros(0, np.int32)]
        last, left = (session, seq), most
        for key in sessions:
            one = self._sessions[key]
            start = bisect_right(one.seqs, seq) if key == session else 0
            stop = min(start + left, len(one.seqs))
            seqs = np.array(one.seqs[start:stop], np.int64)
            fused = np.array(one.fused[_POSE * start : _POSE * stop]).reshape(-1, _POSE)
            is_in_map = ~np.isnan(fused[:, 0])
            numbers.append(seqs[is_in_map])
            poses.append(fused[is_in_map])
            rows.append(np.full(len(numbers[-1]), len(chosen), np.int32))
            chosen.append(key)
            left -= stop - start
            last = (key, int(seqs[-1]) if len(seqs) else seq if key == session else 0)
            if stop < len(one.seqs):
                break
        is_end = not sessions or (key == sessions[-1] and stop == len(one.seqs))
        moved = [self._sessions[key].T_map_odometry for key in chosen]
        return FusedKeyframes(
            chosen,
            np.concatenate(rows),
            np.concatenate(numbers),
            np.concatenate(poses),
            np.array([np.eye(4) if T is None else T for T in moved]).reshape(-1, 4, 4),
            None if is_end else last,
        )

    def pose_of(self, session: bytes, seq: int) -> NDArray[np.float64] | None:
        """Return a keyframe's newest pose, (4, 4) float64; None if it is not in the map or unknown."""
        poses = self._sessions.get(session)
        at = None if poses is None else poses.find(seq)
        if poses is None or at is None:
            return None
        _, rows = self._waiting.get((session, seq), (0, poses.rows(at)))
        return _pose(rows)

    def kept(self) -> KeptKeyframes:
        """Return the keyframes in the map that are not forgotten, with the centres of their newest poses."""
        keys, all_ = list(self._sessions), list(self._sessions.values())
        masks = [one.kept() for one in all_]
        numbers = [np.full(int(mask.sum()), number) for number, mask in enumerate(masks)]

        def columns(name: str) -> NDArray[np.int64]:
            found = [np.array(getattr(one, name))[mask] for one, mask in zip(all_, masks, strict=True)]
            return np.concatenate([np.zeros(0, np.int64), *found])

        return KeptKeyframes(
            keys,
            np.concatenate([np.zeros(0, np.int64), *numbers]),
            columns("seqs"),
            columns("segments"),
            columns("offsets"),
            self._centers(masks),
        )

    def _centers(self, masks: list[NDArray[np.bool_]]) -> NDArray[np.float64]:
        centers = {
            key: np.array(poses.fused).reshape(-1, 3, 4)[:, :, 3].copy()
            for key, poses in self._sessions.items()
        }
        for (key, seq), (_, rows) in self._waiting.items():
            if not np.isnan(rows[0]):
                centers[key][self._sessions[key].place_of(seq)] = rows[3::4]
        kept = [found[mask] for found, mask in zip(centers.values(), masks, strict=True)]
        return np.concatenate([np.zeros((0, 3)), *kept])

    @property
    def first_segment(self) -> int:
        """The lowest number of a segment with a keyframe of the map; 0 without keyframes."""
        return min((one.segments[0] for one in self._sessions.values() if one.segments), default=0)

    def is_forgotten(self, session: bytes, seq: int) -> bool:
        """Return True if the server was told to forget a keyframe."""
        return session in self._sessions and seq in self._sessions[session].forgotten

    def unknown(self) -> Iterator[tuple[bytes, int]]:
        """Yield each session with keyframes of unknown pose, and the highest number of these keyframes."""
        return ((key, poses.unknown) for key, poses in self._sessions.items() if poses.unknown)

    def forget(self, session: bytes, seqs: NDArray[np.int64]) -> None:
        """Record that keyframes leave the map for good, including those that arrive later."""
        poses = self._session(session)
        poses.forgotten.add(seqs)
        for seq in seqs.tolist():
            at = poses.find(seq)
            if at is None:
                if seq <= poses.unknown:
                    poses.missed.add(seq)
                continue
            is_in_map = not np.isnan(poses.fused[_POSE * at])
            self._want(session, seq, _ABSENT)
            if not is_in_map:
                self._drop_forgotten(poses, at)
        self._tidy_heap()

    def leave_out(self) -> None:
        """Record that a forgotten keyframe arrived and was not fused."""
        self.removed += 1
        self.forgotten += 1

    def _drop_forgotten(self, poses: _SessionPoses, at: int) -> None:
        poses.drop(at, at + 1)
        self.forgotten += 1

    def correct(self, session: bytes, correction: Correction) -> None:
        """Record new poses of keyframes. Keyframes that the map rejected or forgot stay out of it."""
        poses = self._session(session)
        if correction.T_map_odometry is not None:
            poses.T_map_odometry = correction.T_map_odometry
        rows = correction.poses[:, :3].reshape(-1, _POSE)
        for seqs, wanted in (
            (correction.seqs, rows),
            (correction.removed, np.tile(_ABSENT, (len(correction.removed), 1))),
        ):
            known = np.array(poses.seqs)
            places = np.searchsorted(known, seqs)
            for at, seq, one in zip(places.tolist(), seqs.tolist(), wanted, strict=True):
                if seq in poses.forgotten:
                    continue
                if at < len(known) and known[at] == seq:
                    self._want(session, seq, one)
                elif seq <= poses.unknown:
                    poses.missed.add(seq)
        self._tidy_heap()

    def _tidy_heap(self) -> None:
        if len(self._heap) > 2 * len(self._waiting) + _SPARE:
            self._heap = [one for one in self._heap if self._is_valid(one)]
            heapify(self._heap)

    def next(self) -> Move | None:
        """Return the move over the largest distance, removals first; None without moves."""
        while self._heap and not self._is_valid(self._heap[0]):
            heappop(self._heap)
        if not self._heap:
            return None
        _, _, session, seq = self._heap[0]
        poses = self._sessions[session]
        at = poses.place_of(seq)
        position = Position(poses.segments[at], poses.offsets[at])
        _, wanted = self._waiting[session, seq]
        return Move(session, seq, position, _pose(poses.rows(at)), _pose(wanted))

    def moved(self) -> None:
        """Record that the move returned by `next` is done."""
        _, _, session, seq = heappop(self._heap)
        _, wanted = self._waiting.pop((session, seq))
        poses = self._sessions[session]
        at, fused = poses.place_of(seq), poses.fused
        self.removed += int(np.isnan(wanted[0])) - int(np.isnan(fused[_POSE * at]))
        fused[_POSE * at : _POSE * (at + 1)] = array("d", wanted)
        if seq in poses.forgotten:
            self._drop_forgotten(poses, at)

    def give_up(self) -> None:
        """Record that the move returned by `next` cannot be done: the keyframe stays at its fused pose."""
        _, _, session, seq = heappop(self._heap)
        self._stuck.add((session, seq))

    def drop_deleted(self, before_segment: int) -> None:
        """Remove the keyframes that were deleted from the journal: they can no longer be moved."""
        for key, poses in self._sessions.items():
            gone = poses.drop_deleted(before_segment)
            for seq in gone:
                if self._waiting.pop((key, seq), None) is not None:
                    self._stuck.discard((key, seq))
                    poses.missed.add(seq)

    def _session(self, key: bytes) -> _SessionPoses:
        return self._sessions.setdefault(key, _SessionPoses())

    def _want(self, session: bytes, seq: int, wanted: FlatPose) -> None:
        poses = self._sessions[session]
        fused = poses.rows(poses.place_of(seq))
        self._waiting.pop((session, seq), None)
        self._stuck.discard((session, seq))
        if np.array_equal(fused, wanted, equal_nan=True):
            return
        self._tickets += 1
        self._waiting[session, seq] = self._tickets, wanted
        heappush(self._heap, (-_metres(fused, wanted), self._tickets, session, seq))

    def _is_valid(self, entry: tuple[float, int, bytes, int]) -> bool:
        _, ticket, session, seq = entry
        waits = self._waiting.get((session, seq))
        return waits is not None and waits[0] == ticket


def _metres(fused: FlatPose, wanted: FlatPose) -> float:
    """Return roughly how far a keyframe's surface moves; infinite if it enters or leaves the map."""
    apart = (fused - wanted).reshape(3, 4)
    metres = float(np.linalg.norm(apart[:, 3]) + _LEVER * np.linalg.norm(apart[:, :3]) / np.sqrt(2))
    return metres if np.isfinite(metres) else np.inf


def _pose(rows: FlatPose) -> NDArray[np.float64] | None:
    return None if np.isnan(rows[0]) else np.vstack([rows.reshape(3, 4), (0.0, 0.0, 0.0, 1.0)])
