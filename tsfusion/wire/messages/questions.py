# SPDX-License-Identifier: MIT
"""Questions to a running server and their answers as messages: small structs, then arrays as raw frames.

The server checks the limits of a question (points, pixels, cells) before any work. An answer names the one
state of the map that it belongs to.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import DTypeLike, NDArray

from tsfusion.core.errors import DecodeError
from tsfusion.geometry.map_questions import AnswerArrays, Field, MapQuestion, Raycast, Sample, Slice, crc_of
from tsfusion.wire.records import array_encoding
from tsfusion.wire.records.record_header import Refused
from tsfusion.wire.sockets.sockets import CONTROL_MAX_BYTES

CELLS_AT_ONCE = 256  # of an answer
REFINED_AT_ONCE = 64  # of an answer with the refined surface
KEYFRAMES_AT_ONCE = 4096
LATE = "its time was over before the map came to it"
_POINTS_A_FRAME = CONTROL_MAX_BYTES // 12
_FARTHEST_BLOCK = 1 << 20
_CELL_BYTES, _KEYFRAME_BYTES = 1 << 15, 1 << 8  # of an answer, roughly
_PACKED = ("float32", "int8", "uint8", "int32")  # dtypes that `array_encoding.pack` takes
_PACKED_FROM = 4096  # bytes: smaller arrays travel as they are


class Cells(MapQuestion, frozen=True, tag="cells"):
    """Question for the triangles of the map's cells, sorted by x, y and z, some hundred cells at once.

    Attributes:
        first: block coordinates of the first cell to send; None starts with the map's first cell.
        since: only cells with changes after this version of the map (`mesh_updates.MeshUpdate`).
        surface: None takes the surface of the map's settings.
    """

    first: tuple[int, int, int] | None = None
    since: int | None = None
    surface: Literal["raw"] | None = "raw"

    @property
    def most_bytes(self) -> int:
        return _CELL_BYTES * CELLS_AT_ONCE

    def _problem(self) -> str:
        if any(not -_FARTHEST_BLOCK <= one < _FARTHEST_BLOCK for one in self.first or ()):
            return f"a map has blocks from {-_FARTHEST_BLOCK} to {_FARTHEST_BLOCK - 1}, got {self.first}"
        if self.since is not None and not 0 <= self.since < 1 << 31:
            return f"a version is from 0 to {(1 << 31) - 1}, got {self.since}"
        return ""


class Keyframes(MapQuestion, frozen=True, tag="keyframes"):
    """Where are the map's keyframes now? They come sorted by session and number.

    `session`, `after`: only keyframes after this one; empty starts with the first one.
    """

    session: Annotated[bytes, Meta(max_length=16)] = b""
    after: int = 0

    @property
    def most_bytes(self) -> int:
        return _KEYFRAME_BYTES * KEYFRAMES_AT_ONCE

    def _problem(self) -> str:
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


Question = Sample | Raycast | Slice | Field | Cells | Keyframes | Rewind


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
