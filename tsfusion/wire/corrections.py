# SPDX-License-Identifier: MIT
"""Corrected poses of keyframes that were sent before: as a message, and as a file.

A loop that closes shows where keyframes really were taken. They are named by their numbers; the newest
pose said of a keyframe stands in place of the ones before, and one that was never named keeps the pose that
it came with. So saying something twice changes nothing.

Message: `Corrections` as msgpack, then `count` numbers (int64, rising), then as many poses (12 float64 each:
the upper three rows of `T_world_camera`), little-endian, cut into frames of at most `FRAME_BYTES`.
File: magic, length of the head, head, numbers and poses, BLAKE2b of all of it.
"""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.config import DEFAULT_MAP, MapName
from tsfusion.core.errors import DecodeError, InvalidKeyframe, JournalError
from tsfusion.geometry.keyframe import MAX_TRANSLATION, check_pose
from tsfusion.wire.keyframe_header import Refused

MAX_KEYFRAMES = 100_000  # of a session
KEYFRAME_BYTES = 8 + 12 * 8
FRAME_BYTES = 48 << 10  # a control message's frames are at most 64 KiB, what keys add to them included
MAX_FRAMES = -(-MAX_KEYFRAMES * KEYFRAME_BYTES // FRAME_BYTES)
SUFFIX = ".tsc"
_MAGIC = b"TSFCOR\x00\x01"
_DIGEST_BYTES = 16
_EXACT = 1e-9  # |RᵀR - I|, as what `check_pose` gives
_MAX_NUMBER = (1 << 63) - 1

Rows = Annotated[tuple[float, ...], Meta(min_length=12, max_length=12)]
Poses = NDArray[np.float64]  # (n, 4, 4)


class Corrections(Struct, frozen=True, kw_only=True, tag="corrections", omit_defaults=True):
    """The head of the message.

    Attributes:
        revision: rising within the session.
        count: keyframes that are named.
        crc32: of the numbers and poses.
        T_map_odometry: the upper three rows, row by row, of what poses after the last keyframe are to be
            multiplied by from the left; None = as before.
    """

    session: Annotated[bytes, Meta(min_length=16, max_length=16)]
    revision: Annotated[int, Meta(ge=1, le=_MAX_NUMBER)]
    count: Annotated[int, Meta(ge=0, le=MAX_KEYFRAMES)]
    crc32: Annotated[int, Meta(ge=0, le=(1 << 32) - 1)]
    map: MapName = DEFAULT_MAP
    T_map_odometry: Rows | None = None


_HEAD = msgspec.msgpack.Decoder(Corrections)


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionCorrections:
    """What is known of one session's keyframes.

    Attributes:
        seqs: (n,) int64, rising: the numbers of the keyframes.
        poses: (n, 4, 4) float64, their `T_world_camera`.
        T_map_odometry: (4, 4) float64: p_map = T_map_odometry @ p_odometry, for the poses after the last
            keyframe; None = nothing was said of it.
        revision: of the newest message; 0 = of none.
    """

    session: bytes
    seqs: NDArray[np.int64]
    poses: Poses
    T_map_odometry: NDArray[np.float64] | None = None
    revision: int = 0
    map: str = DEFAULT_MAP

    def __len__(self) -> int:
        return len(self.seqs)

    def __bool__(self) -> bool:
        return len(self.seqs) > 0 or self.T_map_odometry is not None

    def merged(self, newer: "SessionCorrections") -> "SessionCorrections":
        """With what a newer one says in place of what this one does."""
        seqs, first = np.unique(np.concatenate([newer.seqs, self.seqs]), return_index=True)
        T = self.T_map_odometry if newer.T_map_odometry is None else newer.T_map_odometry
        poses = np.concatenate([newer.poses, self.poses])[first]
        return replace(newer, seqs=seqs, poses=poses, T_map_odometry=T)

    def up_to(self, seq: int) -> "SessionCorrections":
        """Without the keyframes after this number."""
        count = int(np.searchsorted(self.seqs, seq, side="right"))
        return replace(self, seqs=self.seqs[:count], poses=self.poses[:count])

    def without(self, said: "SessionCorrections") -> "SessionCorrections":
        """What is left of it when that was said."""
        at = np.searchsorted(said.seqs, self.seqs)
        known = at < len(said)
        known[known] = said.seqs[at[known]] == self.seqs[known]
        known[known] = (said.poses[at[known]] == self.poses[known]).all(axis=(1, 2))
        T = self.T_map_odometry
        if T is not None and said.T_map_odometry is not None and np.array_equal(T, said.T_map_odometry):
            T = None
        return replace(self, seqs=self.seqs[~known], poses=self.poses[~known], T_map_odometry=T)


def nothing(session: bytes, map_name: str = DEFAULT_MAP) -> SessionCorrections:
    """No corrections of a session."""
    return SessionCorrections(
        session=session, seqs=np.empty(0, np.int64), poses=np.empty((0, 4, 4)), map=map_name
    )


def checked(poses: Mapping[int, Any]) -> tuple[NDArray[np.int64], Poses]:
    """Numbers, rising, and their poses, each as `check_pose` gives it.

    Raises:
        InvalidKeyframe: naming the keyframe and what is wrong.
    """
    if len(poses) > MAX_KEYFRAMES:
        raise InvalidKeyframe(f"at most {MAX_KEYFRAMES} keyframes can be corrected, got {len(poses)}")
    for seq in poses:
        if not isinstance(seq, (int, np.integer)) or not 1 <= seq <= _MAX_NUMBER:
            raise InvalidKeyframe(f"a keyframe's number is an integer > 0, got {seq!r}")
    seqs = np.array(list(poses), dtype=np.int64)
    try:
        found = np.array(list(poses.values()), dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (len(seqs), 4, 4):
        each = [_pose(int(seq), pose) for seq, pose in zip(seqs, poses.values(), strict=True)]
        found = np.array(each).reshape(-1, 4, 4)
    for at in np.flatnonzero(~_exact(found)):
        found[at] = _pose(int(seqs[at]), found[at])
    order = np.argsort(seqs)
    return seqs[order], found[order]


def _pose(seq: int, pose: Any) -> NDArray[np.float64]:
    try:
        return check_pose(pose)
    except InvalidKeyframe as error:
        raise InvalidKeyframe(f"the corrected pose of keyframe {seq}: {error}") from error


def _exact(poses: Poses) -> NDArray[np.bool_]:
    """(n,): which are proper rigid transforms, as `check_pose` leaves them."""
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    with np.errstate(all="ignore"):  # NaN compares as wrong
        good = (np.abs(R) <= 2).all(axis=(1, 2)) & (np.abs(t) <= MAX_TRANSLATION).all(axis=1)
        good &= (poses[:, 3] == (0, 0, 0, 1)).all(axis=1)
        good[good] = np.abs(R[good].transpose(0, 2, 1) @ R[good] - np.eye(3)).max(axis=(1, 2)) <= _EXACT
        good[good] = np.linalg.det(R[good]) > 0
    found: NDArray[np.bool_] = good
    return found


# --- as a message ---


def pack(corrections: SessionCorrections) -> list[bytes]:
    """The frames of a message."""
    body = _body(corrections)
    return [
        _head(corrections, body),
        *(body[at : at + FRAME_BYTES] for at in range(0, len(body), FRAME_BYTES)),
    ]


def unpack(head: Corrections, frames: Sequence[Any]) -> SessionCorrections:
    """The content of a message, its head decoded. Nothing is allocated before the lengths agree.

    Raises:
        Refused: `size`, `crc` or `values`: numbers that do not rise from 1, a pose that is not finite, or
            whose rotation is not exact to 1e-9.
    """
    nbytes = sum(memoryview(frame).nbytes for frame in frames)
    if nbytes != head.count * KEYFRAME_BYTES:
        raise Refused(
            "size", f"{head.count} corrections have {head.count * KEYFRAME_BYTES} bytes, got {nbytes}"
        )
    body = b"".join(frames)
    if zlib.crc32(body) != head.crc32:
        raise Refused("crc", "corrections were damaged on their way (CRC-32 differs)")
    seqs = np.frombuffer(body, "<i8", head.count).astype(np.int64)
    rows = np.frombuffer(body, "<f8", offset=8 * head.count).reshape(-1, 3, 4)
    poses = np.concatenate([rows, np.broadcast_to((0.0, 0.0, 0.0, 1.0), (head.count, 1, 4))], axis=1)
    if head.count and (seqs[0] < 1 or (np.diff(seqs) <= 0).any()):
        raise Refused("values", "the numbers of corrected keyframes must rise from 1")
    if not (good := _exact(poses)).all():
        seq = int(seqs[np.argmin(good)])
        raise Refused(
            "values", f"the corrected pose of keyframe {seq} is no rigid transform, exact to {_EXACT}"
        )
    T = _transform(head.T_map_odometry)
    return SessionCorrections(
        session=head.session, seqs=seqs, poses=poses, T_map_odometry=T, revision=head.revision, map=head.map
    )


def _transform(rows: tuple[float, ...] | None) -> NDArray[np.float64] | None:
    if rows is None:
        return None
    T = np.array([*rows, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
    if not _exact(T[None]).all():
        raise Refused("values", f"T_map_odometry is not rigid to {_EXACT}")
    return T


def _body(corrections: SessionCorrections) -> bytes:
    return corrections.seqs.astype("<i8").tobytes() + corrections.poses[:, :3].astype("<f8").tobytes()


def _head(corrections: SessionCorrections, body: bytes) -> bytes:
    T = corrections.T_map_odometry
    return msgspec.msgpack.encode(
        Corrections(
            session=corrections.session,
            revision=corrections.revision,
            count=len(corrections),
            crc32=zlib.crc32(body),
            map=corrections.map,
            T_map_odometry=None if T is None else tuple(T[:3].ravel().tolist()),
        )
    )


# --- as a file ---


def file_bytes(count: int) -> int:
    """What a file of so many keyframes takes, at most."""
    return 1024 + count * KEYFRAME_BYTES


def write(path: Path, corrections: SessionCorrections) -> None:
    """Put them into a file that is there, on the disk, when this returns, in place of the one before.

    Raises:
        JournalError: when the disk refuses; the one before is still there.
    """
    body = _body(corrections)
    head = _head(corrections, body)
    parts = [_MAGIC, struct.pack("<I", len(head)), head, body]
    digest = blake2b(digest_size=_DIGEST_BYTES)
    for part in parts:
        digest.update(part)
    try:
        with durable_files.replacing(path) as file:
            file.writelines([*parts, digest.digest()])
    except OSError as error:
        raise JournalError(f"cannot write {path}: {error.strerror or error}") from error


def load(path: Path) -> SessionCorrections:
    """What a file holds.

    Raises:
        JournalError: when it cannot be read.
        DecodeError: when it is not as it was written.
    """
    try:
        stored = path.read_bytes()
    except OSError as error:
        raise JournalError(f"cannot read {path}: {error.strerror or error}") from error
    content, digest = stored[:-_DIGEST_BYTES], stored[-_DIGEST_BYTES:]
    if stored[:8] != _MAGIC or blake2b(content, digest_size=_DIGEST_BYTES).digest() != digest:
        raise DecodeError(f"{path} is damaged, or no file of corrections")
    try:
        (length,) = struct.unpack_from("<I", content, 8)
        return unpack(_HEAD.decode(content[12 : 12 + length]), [content[12 + length :]])
    except (struct.error, msgspec.DecodeError, Refused, ValueError, RecursionError) as error:
        raise DecodeError(f"{path} is malformed: {error}") from error


def read(folder: Path) -> dict[bytes, SessionCorrections]:
    """Those of a map, by session: what `STATE/maps/NAME/corrections` holds; {} when there is no such folder.

    Raises:
        JournalError: when a file cannot be read, or is damaged.
    """
    found = {}
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        try:
            one = load(path)
        except DecodeError as error:
            raise JournalError(str(error)) from error
        found[one.session] = one
    return found
