# SPDX-License-Identifier: MIT
"""Questions to a running server and their answers as messages: small structs, then arrays as raw frames.

The server checks the limits of a question (points, pixels, cells) before any work. An answer names the one
state of the map that it belongs to.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import DTypeLike, NDArray

from tsfusion.core.errors import DecodeError
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_questions import AnswerArrays, Field, MapQuestion, Raycast, Sample, Slice, crc_of
from tsfusion.wire.records import array_encoding
from tsfusion.wire.records.record_header import Refused, SessionId, TransformRows
from tsfusion.wire.sockets.sockets import CONTROL_MAX_BYTES

LONGEST_WAIT_S = 1.0
CELLS_AT_ONCE = 1024  # of an answer
ANSWER_BYTES = 2 << 20  # of triangles or pictures, at most
SCANS_BYTES = 1 << 20  # of the largest picture
KEYFRAMES_AT_ONCE = 4096
LATE = "its time was over before the map came to it"
_POINTS_A_FRAME = CONTROL_MAX_BYTES // 12
_KEYFRAME_BYTES = 1 << 8  # of an answer, roughly
_PACKED = ("float32", "int8", "uint8", "int32")  # dtypes that `array_encoding.pack` takes
_PACKED_FROM = 4096  # bytes: smaller arrays travel as they are


class Following(MapQuestion, frozen=True):
    """Question for what is new. The answer comes as soon as there is something, or when the wait ends.

    Attributes:
        since: `until` of the last answer; 0 before the first one.
        epoch: epoch of that answer. Another process begins anew, whatever `since` is.
        wait_s: seconds.
        most_bytes: of triangles or pictures in the answer, except for a single cell's.
    """

    since: int = 0
    epoch: Annotated[str, Meta(max_length=32)] = ""
    wait_s: float = -1.0
    most_bytes: int = ANSWER_BYTES

    def _problem(self) -> str:
        if self.wait_s == -1.0:
            return "a viewer of an earlier version asks for cells without `wait_s`: update it"
        if not 0 <= self.wait_s <= LONGEST_WAIT_S:
            return f"a question for news may wait {LONGEST_WAIT_S:g} s, got wait_s = {self.wait_s:g}"
        if self.most_bytes < 1:
            return f"an answer has at least one byte, got most_bytes = {self.most_bytes}"
        return "" if 0 <= self.since < 1 << 63 else f"since is from 0 to {(1 << 63) - 1}, got {self.since}"


class Cells(Following, frozen=True, tag="cells"):
    """Question for the triangles of the map's cells that have changed (`Following`).

    Arrays of the answer:
        cells, first_face: (n, 3) and (n + 1,) int32: block coordinates; the cell in row i has the faces
            `first_face[i]` to `first_face[i + 1]`, which replace all its earlier ones.
        vertices, faces, normals, colors: their mesh; without `colors` if the map has none.
        is_refined: (n,) bool: True for the surface of the map's settings, False for the raw one.
        sessions, client: (m, 16) uint8 and (n,) int32: row of the session that saw the cell last, or −1.
        voxel_size: metres.
        until, more: all changes up to `until` are in this answer or earlier ones; True if there are more.
        begins: True if this is the first answer about the map: all earlier cells are to be dropped.
    """


class Scans(Following, frozen=True, tag="scans"):
    """Question for the keyframes that scanners have sent (`Following`). The server answers it, not the map.

    The answer has one array, `scans`: a `ScansFound` as msgpack.
    """


class Scanned(Struct, frozen=True, omit_defaults=True):
    """A keyframe that a scanner sent, and that the server has. Its picture comes now, later, or never.

    Attributes:
        session, seq: session and number of the keyframe.
        pose: upper three rows of `T_world_camera`, row by row, as the scanner sent it.
        intrinsics, shape: of the keyframe's images, in pixels; None without images.
        client: name under which the scanner's key is allowed; empty without keys.
        picture: JPEG as the scanner sent it; empty without one.
        late: True if the keyframe came before, without its picture.
    """

    session: SessionId
    seq: int
    pose: TransformRows
    intrinsics: Intrinsics | None = None
    shape: tuple[int, int] | None = None
    client: str = ""
    picture: bytes = b""
    late: bool = False


class ScansFound(Struct, frozen=True):
    """Keyframes up to number `until` of the server's `epoch`; `missed`: earlier ones are forgotten."""

    epoch: str
    until: int
    scans: tuple[Scanned, ...] = ()
    missed: bool = False


class Keyframes(MapQuestion, frozen=True, tag="keyframes"):
    """Where are the map's keyframes now? They come sorted by session and number.

    Attributes:
        session, after: only keyframes after this one; empty starts with the first one.
        most_bytes: of the answer, roughly; it has one keyframe at least.
    """

    session: Annotated[bytes, Meta(max_length=16)] = b""
    after: int = 0
    most_bytes: int = _KEYFRAME_BYTES * KEYFRAMES_AT_ONCE

    @property
    def count(self) -> int:
        """Number of keyframes in the answer, at most."""
        return min(max(self.most_bytes // _KEYFRAME_BYTES, 1), KEYFRAMES_AT_ONCE)

    def _problem(self) -> str:
        if not 1 <= self.most_bytes <= ANSWER_BYTES:
            return f"an answer has 1 to {ANSWER_BYTES} bytes, got most_bytes = {self.most_bytes}"
        good = 0 <= self.after < 1 << 63
        return "" if good else f"a keyframe has a number from 0 to {(1 << 63) - 1}, got {self.after}"


class Rewind(MapQuestion, frozen=True, tag="rewind"):
    """Take a saved map to the first `keyframes` of its journal; None = only tell where it is.

    The answer comes at once; the map follows.
    """

    keyframes: Annotated[int, Meta(ge=0)] | None = None

    @property
    def most_bytes(self) -> int:
        return _KEYFRAME_BYTES * KEYFRAMES_AT_ONCE


Question = Sample | Raycast | Slice | Field | Cells | Scans | Keyframes | Rewind


class ArrayLayout(Struct, frozen=True, array_like=True):
    """One array of an answer, in the order of the frames. `packed`: encoded by `array_encoding.pack`."""

    name: str
    dtype: Literal["float32", "float64", "int8", "uint8", "int32", "int64", "bool"]
    shape: tuple[int, ...]
    packed: bool = False


class MapVersion(Struct, frozen=True, kw_only=True):
    """Identification of the one state of a map that an answer belongs to.

    Attributes:
        keyframes: number of keyframes in the map.
        changes: number of records and moves that the server's process `epoch` has taken. Two answers with
            equal `changes` and `epoch` are of the same map. The epoch of a map from a file is empty.
        segment, offset: position of the map's newest record in the journal; 0 before the first one.
        waiting: number of keyframes whose corrected pose is not in the map yet.
    """

    keyframes: int
    changes: int = 0
    epoch: str = ""
    segment: int = 0
    offset: int = 0
    waiting: int = 0


class Answer(Struct, frozen=True, kw_only=True):
    """Header of a map's answer to a question. The arrays follow as frames.

    Attributes:
        crc: CRC-32 of all frames.
        waited_s: seconds from the question's arrival at the server until the fuser began with it.
        took_s: seconds to compute the answer.
        reach: for samples, metres in front of a surface up to which distances are known.
    """

    arrays: tuple[ArrayLayout, ...]
    state: MapVersion
    crc: int
    waited_s: float = 0.0
    took_s: float = 0.0
    reach: float = 0.0


def scans_of(arrays: AnswerArrays) -> ScansFound:
    """Return the content of an answer to `Scans`. Raise DecodeError for anything else."""
    try:
        return msgspec.msgpack.decode(arrays["scans"].tobytes(), type=ScansFound)
    except (KeyError, msgspec.MsgspecError) as error:
        raise DecodeError(f"an answer about scanners is malformed: {error!r}") from error


def point_frames(points: NDArray[np.float32]) -> list[memoryview]:
    """Return (n, 3) float32 points as frames of a question, each small enough for the control socket."""
    rows = np.ascontiguousarray(points, "<f4")
    return [rows[i : i + _POINTS_A_FRAME].data.cast("B") for i in range(0, len(rows), _POINTS_A_FRAME)]


def pack(arrays: AnswerArrays, *, compress: bool) -> tuple[tuple[ArrayLayout, ...], list[Any]]:
    """Encode the arrays of an answer. Return their layouts, and one frame for each."""
    layouts, frames = [], []
    for name, array in arrays.items():
        packed = compress and array.nbytes >= _PACKED_FROM and array.dtype.name in _PACKED
        layouts.append(ArrayLayout(name, array.dtype.name, array.shape, packed))
        plain = np.ascontiguousarray(array).reshape(-1)
        frames.append(array_encoding.pack(array) if packed else plain.view(np.uint8).data)
    return tuple(layouts), frames


def unpack(answer: Answer, frames: Sequence[Any]) -> AnswerArrays:
    """Return the arrays of an answer, by name.

    Raises:
        DecodeError: when the frames do not match the answer.
    """
    if len(frames) != len(answer.arrays) or crc_of(frames) != answer.crc:
        raise DecodeError("an answer was damaged on its way (CRC-32 differs)")
    return {one.name: _array(one, frame) for one, frame in zip(answer.arrays, frames, strict=True)}


def _array(layout: ArrayLayout, frame: Any) -> NDArray[Any]:
    dtype: DTypeLike = np.dtype(layout.dtype)
    size = math.prod(layout.shape) * np.dtype(dtype).itemsize
    if min(layout.shape, default=1) < 0 or (not layout.packed and memoryview(frame).nbytes != size):
        raise DecodeError(f"an array {layout.shape} of {layout.dtype} was announced, got {len(frame)} bytes")
    try:
        if layout.packed:
            return array_encoding.unpack(frame, np.dtype(dtype), layout.shape)
    except Refused as error:
        raise DecodeError(f"an answer is malformed: {error}") from error
    return np.frombuffer(frame, dtype).reshape(layout.shape)
