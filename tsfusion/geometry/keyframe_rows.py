# SPDX-License-Identifier: MIT
"""Hold a table of keyframes, one row each: session, number, place in a journal, and pose."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.se3 import Poses

POSE = 12  # numbers of a pose in a row: its upper three rows
COLUMNS = {"seqs": np.int64, "segments": np.int64, "offsets": np.int64, "fused": np.float64}  # as saved

FlatPose = NDArray[np.float64]  # (12,): the upper three rows of a pose; NaN = not in the map


def square(poses: NDArray[np.float64]) -> Poses:
    """Return (n, 4, 4) pose matrices from their upper three rows, (n, 12)."""
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3] = poses.reshape(-1, 3, 4)
    return T


@dataclass(frozen=True, eq=False)
class KeyframeRows:
    """Some keyframes of a map or a journal.

    Attributes:
        sessions: their sessions.
        session: (n,) int32, the index in `sessions` of each keyframe's session.
        seqs: (n,) int64 numbers.
        segments, offsets: (n,) int64, the file of each keyframe's record by number, and the byte in it.
        poses: (n, 12) float64: the upper three rows of `T_world_camera`; NaN for a keyframe not in the map.
    """

    sessions: tuple[bytes, ...]
    session: NDArray[np.int32]
    seqs: NDArray[np.int64]
    segments: NDArray[np.int64]
    offsets: NDArray[np.int64]
    poses: NDArray[np.float64]

    @classmethod
    def of_saved(cls, sessions: Mapping[bytes, Mapping[str, Any]]) -> "KeyframeRows":
        """Return the keyframes in a map file: for each session a dict of columns, as bytes or arrays."""
        parts = [
            [np.zeros(0, dtype), *(np.frombuffer(one[name], dtype) for one in sessions.values())]
            for name, dtype in COLUMNS.items()
        ]
        counts = np.array([len(part) for part in parts[0][1:]], np.int64)
        session = np.repeat(np.arange(len(sessions), dtype=np.int32), counts)
        seqs, segments, offsets, poses = map(np.concatenate, parts)
        return cls(tuple(sessions), session, seqs, segments, offsets, poses.reshape(-1, POSE))

    def __len__(self) -> int:
        return len(self.seqs)

    def __getitem__(self, chosen: Any) -> "KeyframeRows":
        """Return the rows that a mask, indices or a slice choose."""
        names = ("session", "seqs", "segments", "offsets", "poses")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def __iter__(self) -> Iterator[tuple[bytes, int]]:
        """Session and number of each keyframe."""
        names = self.sessions
        return ((names[row], seq) for row, seq in zip(self.session.tolist(), self.seqs.tolist(), strict=True))

    @property
    def in_map(self) -> NDArray[np.bool_]:
        """(n,) mask of the keyframes in the map, those with a pose."""
        found: NDArray[np.bool_] = ~np.isnan(self.poses[:, 0])
        return found

    @property
    def matrices(self) -> Poses:
        """(n, 4, 4) `T_world_camera`."""
        return square(self.poses)

    @classmethod
    def joined(cls, parts: Sequence["KeyframeRows"]) -> "KeyframeRows":
        """Return the rows of all parts, in their order. Raises ValueError, IndexError for malformed parts."""
        number = {
            key: at for at, key in enumerate(dict.fromkeys(key for one in parts for key in one.sessions))
        }
        session = [np.array([number[key] for key in one.sessions], np.int32)[one.session] for one in parts]
        columns = ([getattr(one, name) for one in parts] for name in ("seqs", "segments", "offsets", "poses"))
        return cls(tuple(number), np.concatenate(session), *map(np.concatenate, columns))

    def in_order(self) -> "KeyframeRows":
        """Return the rows in journal order."""
        return self[np.lexsort((self.offsets, self.segments))]

    def by_session(self) -> Iterable[tuple[bytes, "KeyframeRows"]]:
        """Return each session that has rows, with its rows."""
        for number in np.unique(self.session).tolist():
            yield self.sessions[number], self[self.session == number]
