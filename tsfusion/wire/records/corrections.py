# SPDX-License-Identifier: MIT
"""Corrections: new poses of keyframes that were sent before, and keyframes that leave the map.

A loop closure gives new poses. A correction is a record of the session with the next number, like a keyframe,
so it can only name keyframes with lower numbers. The newest pose of a keyframe counts.

A server that is told to forget keyframes writes such records, too. They are in a session of the server, and
their `target` is the session of the keyframes. A keyframe that such a record removes never comes back,
whatever corrections come before or after. No client has the right to send one.

Message: `CorrectionHeader`, then one body frame, little-endian: `count` numbers (int64, rising), as many
poses (12 float64 each: the upper three rows of `T_world_camera`), then `removed` numbers (int64, rising).
"""

import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry.keyframe import MAX_TRANSLATION, check_pose
from tsfusion.wire.records.record_header import CorrectionHeader, Damaged, Refused, packed

MAX_KEYFRAMES = 100_000  # limit for one correction
_NUMBER_BYTES, _POSE_BYTES = 8, 12 * 8
_EXACT = 1e-9  # bound of |RᵀR - I| after `check_pose`
_MAX_NUMBER = (1 << 63) - 1

Numbers = NDArray[np.int64]
Transforms = NDArray[np.float64]  # (n, 4, 4)


@dataclass(frozen=True, eq=False, kw_only=True)
class Correction:
    """Content of one correction: new poses of keyframes, and keyframes to remove from the map.

    Attributes:
        seqs: (n,) int64, rising: numbers of the keyframes that get another pose.
        poses: (n, 4, 4) float64, their `T_world_camera`.
        removed: (m,) int64, rising: numbers of the keyframes to take out of the map.
        T_map_odometry: (4, 4) float64: p_map = T_map_odometry @ p_odometry, for the poses after the last
            keyframe. None keeps the present one.
        target: session of the removed keyframes, which are removed for good. None: the record's own session.
    """

    seqs: Numbers
    poses: Transforms
    removed: Numbers
    T_map_odometry: NDArray[np.float64] | None = None
    target: bytes | None = None


def checked(
    poses: Mapping[int, Any], *, T_map_odometry: Any = None, removed: Iterable[int] = ()
) -> Correction:
    """Return a correction with these new poses by keyframe number, after `check_pose` of each.

    Raises:
        InvalidKeyframe: naming the keyframe and what is wrong.
    """
    removed = set(removed)
    if (count := len(poses) + len(removed)) > MAX_KEYFRAMES:
        raise InvalidKeyframe(f"at most {MAX_KEYFRAMES} keyframes can be corrected at a time, got {count}")
    for seq in (*poses, *removed):
        if not isinstance(seq, (int, np.integer)) or not 1 <= seq <= _MAX_NUMBER:
            raise InvalidKeyframe(f"a keyframe's number is an integer > 0, got {seq!r}")
    if both := poses.keys() & removed:
        raise InvalidKeyframe(f"keyframe {min(both)} cannot be both corrected and removed")
    seqs = np.array(list(poses), dtype=np.int64)
    order = np.argsort(seqs)
    return Correction(
        seqs=seqs[order],
        poses=_checked_poses(seqs, list(poses.values()))[order],
        removed=np.array(sorted(removed), dtype=np.int64),
        T_map_odometry=None if T_map_odometry is None else check_pose(T_map_odometry),
    )


def _checked_poses(seqs: Numbers, poses: list[Any]) -> Transforms:
    try:
        found = np.array(poses, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (len(seqs), 4, 4):
        each = [_checked_pose(int(seq), pose) for seq, pose in zip(seqs, poses, strict=True)]
        return np.array(each).reshape(-1, 4, 4)
    exact = _are_rigid(found[:, :3]) & (found[:, 3] == (0, 0, 0, 1)).all(axis=1)
    for at in np.flatnonzero(~exact):
        found[at] = _checked_pose(int(seqs[at]), found[at])
    return found


def _checked_pose(seq: int, pose: Any) -> NDArray[np.float64]:
    try:
        return check_pose(pose)
    except InvalidKeyframe as error:
        raise InvalidKeyframe(f"the corrected pose of keyframe {seq}: {error}") from error


def _are_rigid(rows: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (n,) bool: True where (3, 4) rows are a proper rigid transform, as `check_pose` makes it."""
    R, t = rows[:, :, :3], rows[:, :, 3]
    with np.errstate(all="ignore"):  # NaN compares as wrong
        good = np.ones(len(rows), np.bool_)
        good &= (np.abs(R) <= 2).all(axis=(1, 2))
        good &= (np.abs(t) <= MAX_TRANSLATION).all(axis=1)
        good[good] = np.abs(R[good].transpose(0, 2, 1) @ R[good] - np.eye(3)).max(axis=(1, 2)) <= _EXACT
        good[good] = np.linalg.det(R[good]) > 0
    return good


def forgetting(target: bytes, seqs: Numbers) -> Correction:
    """Return the correction by which a server removes these keyframes of session `target` for good."""
    none = checked({})
    return Correction(seqs=none.seqs, poses=none.poses, removed=np.unique(seqs), target=target)


def encode(correction: Correction, **address: Any) -> list[bytes]:
    """Encode a correction as header and body; `address`: as of `record_header.packed`."""
    T = correction.T_map_odometry
    parts = ((correction.seqs, "<i8"), (correction.poses[:, :3], "<f8"), (correction.removed, "<i8"))
    body = b"".join(array.astype(dtype).tobytes() for array, dtype in parts)
    header = packed(
        CorrectionHeader,
        **address,
        count=len(correction.seqs),
        removed=len(correction.removed),
        crc32=zlib.crc32(body),
        T_map_odometry=None if T is None else tuple(T[:3].ravel().tolist()),
        target=correction.target,
    )
    return [header, body]


def check(header: CorrectionHeader, frames: Sequence[Any]) -> None:
    """Check the body of a correction. Nothing is allocated before the length is right.

    Raises:
        Refused: `frames`, `limits`, `size`, `crc`, or `values`. `values`: numbers do not rise from 1, a
            number is both corrected and removed, or a pose is not finite or not a rotation exact to 1e-9.
    """
    if len(frames) != 1:
        raise Damaged("frames", f"a correction has 2 frames, got {1 + len(frames)}")
    count = header.count + header.removed
    if count > MAX_KEYFRAMES:
        raise Refused("limits", f"a correction names at most {MAX_KEYFRAMES} keyframes, got {count}")
    nbytes = memoryview(frames[0]).nbytes
    expected = count * _NUMBER_BYTES + header.count * _POSE_BYTES
    if nbytes != expected:
        raise Damaged("size", f"a correction of {count} keyframes has {expected} bytes, got {nbytes}")
    if zlib.crc32(frames[0]) != header.crc32:
        raise Damaged("crc", "the correction was damaged on its way (CRC-32 differs)")
    _check_values(header, *arrays(header, frames[0]))


def _check_values(
    header: CorrectionHeader, seqs: Numbers, rows: NDArray[np.float64], removed: Numbers
) -> None:
    if header.target is not None and (header.count or header.T_map_odometry is not None):
        raise Refused("values", "a record that forgets keyframes of another session gives no new poses")
    for numbers in (seqs, removed):
        if len(numbers) and (numbers[0] < 1 or (np.diff(numbers) <= 0).any()):
            raise Refused("values", "the numbers of corrected and of removed keyframes must rise from 1")
    if len(both := np.intersect1d(seqs, removed)):
        raise Refused("values", f"keyframe {both[0]} is both corrected and removed")
    if not (good := _are_rigid(rows)).all():
        seq = int(seqs[np.argmin(good)])
        raise Refused(
            "values", f"the corrected pose of keyframe {seq} is no rigid transform, exact to {_EXACT}"
        )
    T = header.T_map_odometry
    if T is not None and not _are_rigid(np.array(T).reshape(1, 3, 4)).all():
        raise Refused("values", f"T_map_odometry is no rigid transform, exact to {_EXACT}")


def arrays(header: CorrectionHeader, body: Any) -> tuple[Numbers, NDArray[np.float64], Numbers]:
    """Return views of the arrays in a correction's body; the body's size must be right.

    Returns:
        (n,) int64 numbers, (n, 3, 4) float64 upper rows of their poses, (m,) int64 numbers to remove.
    """
    count, poses_at = header.count, header.count * _NUMBER_BYTES
    seqs = np.frombuffer(body, "<i8", count)
    rows = np.frombuffer(body, "<f8", 12 * count, poses_at).reshape(-1, 3, 4)
    return seqs, rows, np.frombuffer(body, "<i8", header.removed, poses_at + count * _POSE_BYTES)


def unpack(header: CorrectionHeader, body: Any) -> Correction:
    """Decode a correction that passed `check`."""
    seqs, rows, removed = arrays(header, body)
    last_rows = np.broadcast_to((0.0, 0.0, 0.0, 1.0), (len(seqs), 1, 4))
    T = header.T_map_odometry
    return Correction(
        seqs=seqs.astype(np.int64),
        poses=np.concatenate([rows, last_rows], axis=1),
        removed=removed.astype(np.int64),
        T_map_odometry=None if T is None else np.array([*T, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4),
        target=header.target,
    )
