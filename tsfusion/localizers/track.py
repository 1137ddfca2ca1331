# SPDX-License-Identifier: MIT
"""A trajectory that grows for hours: its frames' poses in plain numbers, some 300 bytes each."""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.localizers.base import Corrections, Matrix, Pose

_NONE = -1
_BOTTOM = (0.0, 0.0, 0.0, 1.0)
_ROWS = 12  # numbers of a pose: the upper three rows

Poses = NDArray[np.float64]  # (n, 4, 4)


@dataclass(frozen=True, eq=False)
class Located:
    """One frame that has a pose.

    Attributes:
        reference: (4, 4), what the source itself said of the pose; None = nothing.
        seq: its number as a keyframe; None = it is none, or was left out.
    """

    pose: Pose
    reference: Matrix | None
    seq: int | None


class Track:
    """Frames that have a pose, in order. Poses are kept but for their quality."""

    def __init__(self) -> None:
        self._numbers = array("q")  # stamp, anchor, whether it starts it, seq, place of the reference
        self._poses = array("d")  # T_world_camera, T_anchor_camera
        self._references = array("d")

    def add(self, pose: Pose, reference: Matrix | None, seq: int | None) -> None:
        """The next frame."""
        at = _NONE
        if reference is not None:
            at = len(self._references) // _ROWS
            self._references.frombytes(_bytes(reference))
        self._poses.frombytes(_bytes(pose.T_world_camera) + _bytes(pose.T_anchor_camera))
        self._numbers.extend(
            (pose.timestamp_ns, pose.anchor, pose.starts_anchor, _NONE if seq is None else seq, at)
        )

    def __len__(self) -> int:
        return len(self._numbers) // 5

    def __getitem__(self, index: int) -> Located:
        place = range(len(self))[index]
        stamp, anchor, starts, seq, at = self._numbers[5 * place : 5 * (place + 1)]
        pair = np.array(self._poses[2 * _ROWS * place : 2 * _ROWS * (place + 1)])
        T_world_camera, T_anchor_camera = _matrices(pair.reshape(2, 3, 4))
        pose = Pose(
            T_world_camera=T_world_camera,
            timestamp_ns=stamp,
            anchor=anchor,
            T_anchor_camera=T_anchor_camera,
            starts_anchor=bool(starts),
        )
        rows = np.array(self._references[_ROWS * at : _ROWS * (at + 1)])
        reference = None if at == _NONE else _matrices(rows.reshape(3, 4))
        return Located(pose, reference, None if seq == _NONE else seq)

    def __iter__(self) -> Iterator[Located]:
        return (self[index] for index in range(len(self)))

    @property
    def stamps_ns(self) -> list[int]:
        """Of the frames."""
        return self._numbers[::5].tolist()

    @property
    def seqs(self) -> NDArray[np.int64]:
        """(n,): numbers of keyframes; -1 where a frame is none."""
        return np.array(self._numbers[3::5], dtype=np.int64)

    @property
    def last_seq(self) -> int:
        """Number of the last keyframe; -1 = there is none."""
        return int(self.seqs.max(initial=_NONE))

    def poses(self, corrections: Corrections | None = None) -> Poses:
        """(n, 4, 4) T_world_camera, as tracked, or after loop closure."""
        return self._corrected(corrections, np.arange(len(self)))

    def keyframes(self, corrections: Corrections | None = None) -> tuple[NDArray[np.int64], Poses]:
        """The numbers of the keyframes, (m,), and (m, 4, 4) T_world_camera."""
        chosen = np.flatnonzero(self.seqs != _NONE)
        return self.seqs[chosen], self._corrected(corrections, chosen)

    def with_reference(self) -> tuple[NDArray[np.int64], Poses]:
        """Which frames the source itself said a pose of, (m,), and (m, 4, 4) those."""
        references = np.array(self._references).reshape(-1, 3, 4)
        return np.flatnonzero(self._columns[:, 4] != _NONE), _matrices(references)

    def _corrected(self, corrections: Corrections | None, chosen: NDArray[np.int64]) -> Poses:
        pairs = self._pairs[chosen]
        poses = _matrices(pairs[:, 0])
        if corrections is None:
            return poses
        poses = corrections.T_corrected_world @ poses
        numbers, which = np.unique(self._columns[chosen, 1], return_inverse=True)
        known = np.array([number in corrections.anchors for number in numbers.tolist()], dtype=bool)
        anchors = np.array([corrections.anchors.get(number, np.eye(4)) for number in numbers.tolist()])
        hang = known[which]
        poses[hang] = anchors.reshape(-1, 4, 4)[which[hang]] @ _matrices(pairs[hang, 1])
        return poses

    @property
    def _columns(self) -> NDArray[np.int64]:
        return np.array(self._numbers, dtype=np.int64).reshape(-1, 5)

    @property
    def _pairs(self) -> NDArray[np.float64]:
        return np.array(self._poses).reshape(-1, 2, 3, 4)


def _bytes(T: Matrix) -> bytes:
    return np.asarray(T, dtype=np.float64)[:3].tobytes()


def _matrices(rows: NDArray[np.float64]) -> Poses:
    """(…, 4, 4) from (…, 3, 4)."""
    bottom = np.broadcast_to(np.array(_BOTTOM), (*rows.shape[:-2], 1, 4))
    return np.concatenate([rows, bottom], axis=-2)
