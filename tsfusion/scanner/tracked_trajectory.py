# SPDX-License-Identifier: MIT
"""Store the poses of a trajectory that may grow for hours, in about 300 bytes a frame."""

import math
from array import array

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.se3 import Poses, Transform
from tsfusion.scanner.localization.localizer import PoseCorrections, TrackedPose

_NONE = -1
_BOTTOM = (0.0, 0.0, 0.0, 1.0)
_ROWS = 12  # numbers of a pose: the upper three rows
_COLUMNS = 4  # other numbers of a frame


class TrackedTrajectory:
    """Tracked frames in order, each with its pose.

    A frame that is no keyframe, or whose keyframe was dropped, has the keyframe number -1.
    """

    def __init__(self) -> None:
        self._numbers = array("q")  # timestamp, anchor, seq, index of the reference
        self._poses = array("d")  # T_world_camera, T_anchor_camera
        self._references = array("d")
        self._forces = array("d")  # NaN = nothing was measured
        self._deviations = array("d")  # metres, radians; NaN = not known

    def add(
        self,
        pose: TrackedPose,
        reference: Transform | None,
        seq: int | None,
        specific_force: NDArray[np.float64] | None = None,
    ) -> None:
        """Append a frame.

        Args:
            pose: pose found by the localizer.
            reference: (4, 4) pose that the source gives; None if it gives none.
            seq: keyframe number; None for a frame that is no keyframe.
            specific_force: as in `Frame`; None if nothing was measured.
        """
        at = _NONE
        if reference is not None:
            at = len(self._references) // _ROWS
            self._references.frombytes(_bytes(reference))
        self._poses.frombytes(_bytes(pose.T_world_camera) + _bytes(pose.T_anchor_camera))
        self._forces.extend((math.nan,) * 3 if specific_force is None else specific_force.tolist())
        self._deviations.extend(pose.deviations)
        self._numbers.extend((pose.timestamp_ns, pose.anchor, _NONE if seq is None else seq, at))

    def __len__(self) -> int:
        return len(self._numbers) // _COLUMNS

    @property
    def stamps_ns(self) -> list[int]:
        """Timestamps of the frames, nanoseconds."""
        return self._numbers[::_COLUMNS].tolist()

    @property
    def seqs(self) -> NDArray[np.int64]:
        """Keyframe numbers of the frames, (n,); -1 for frames that are no keyframes."""
        return np.array(self._numbers[2::_COLUMNS], dtype=np.int64)

    def forces(self) -> list[NDArray[np.float64] | None]:
        """Return the specific force of each frame, (3,) m/s² in its sensor's axes; None = not measured."""
        rows = np.array(self._forces).reshape(-1, 3)
        return [None if np.isnan(row).any() else row for row in rows]

    def deviations(self) -> NDArray[np.float64]:
        """Return `TrackedPose.deviations` of the frames, (n, 2) metres and radians."""
        return np.array(self._deviations).reshape(-1, 2)

    @property
    def last_seq(self) -> int:
        """Number of the last keyframe; -1 if there is none."""
        return int(self.seqs.max(initial=_NONE))

    def poses(self, corrections: PoseCorrections | None = None) -> Poses:
        """Return the poses of all frames, (n, 4, 4) T_world_camera: as tracked, or corrected."""
        return self._corrected(corrections, np.arange(len(self)))

    def keyframes(self, corrections: PoseCorrections | None = None) -> tuple[NDArray[np.int64], Poses]:
        """Return keyframe numbers, (m,), and T_world_camera, (m, 4, 4): as tracked, or corrected."""
        chosen = np.flatnonzero(self.seqs != _NONE)
        return self.seqs[chosen], self._corrected(corrections, chosen)

    def with_reference(self) -> tuple[NDArray[np.int64], Poses]:
        """Return the indices of frames with a reference pose from the source, (m,), and these, (m, 4, 4)."""
        references = np.array(self._references).reshape(-1, 3, 4)
        return np.flatnonzero(self._columns[:, 3] != _NONE), _matrices(references)

    def _corrected(self, corrections: PoseCorrections | None, chosen: NDArray[np.int64]) -> Poses:
        pairs = np.array(self._poses).reshape(-1, 2, 3, 4)[chosen]
        poses = _matrices(pairs[:, 0])
        if corrections is None:
            return poses
        poses = corrections.T_corrected_world @ poses
        numbers, which = np.unique(self._columns[chosen, 1], return_inverse=True)
        known = np.array([number in corrections.anchors for number in numbers.tolist()], dtype=bool)
        anchors = np.array([corrections.anchors.get(number, np.eye(4)) for number in numbers.tolist()])
        anchored = known[which]
        poses[anchored] = anchors.reshape(-1, 4, 4)[which[anchored]] @ _matrices(pairs[anchored, 1])
        return poses

    @property
    def _columns(self) -> NDArray[np.int64]:
        return np.array(self._numbers, dtype=np.int64).reshape(-1, _COLUMNS)


def _bytes(T: Transform) -> bytes:
    return np.asarray(T, dtype=np.float64)[:3].tobytes()


def _matrices(rows: NDArray[np.float64]) -> Poses:
    """Append the row 0 0 0 1 to pose matrices: (…, 3, 4) → (…, 4, 4)."""
    bottom = np.broadcast_to(np.array(_BOTTOM), (*rows.shape[:-2], 1, 4))
    return np.concatenate([rows, bottom], axis=-2)
