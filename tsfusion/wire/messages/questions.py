# SPDX-License-Identifier: MIT
"""Questions to the map of a running server, and their answers: small structs, then arrays as raw frames.

The server checks the limits of a question (points, pixels, cells) before any work. An answer names the one
state of the map that it belongs to.
"""

import math
import zlib
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import DTypeLike, NDArray

from tsfusion.core.config import Surface
from tsfusion.core.errors import DecodeError, InvalidConfig
from tsfusion.geometry.map_answers import checked_camera
from tsfusion.wire.records import array_encoding
from tsfusion.wire.records.record_header import Refused
from tsfusion.wire.sockets.sockets import CONTROL_MAX_BYTES

MOST_POINTS = 20_000  # of a question
MOST_PIXELS = 1 << 20  # of a view
MOST_CELLS = 1 << 20  # of a slice, with the cells around it that its distances need
MOST_VOXELS = 1 << 22  # of a distance field, with the voxels around it
FARTHEST_M = 100.0  # largest `max_distance` of a distance field
CELLS_AT_ONCE = 256  # of an answer
REFINED_AT_ONCE = 64  # of an answer with the refined surface
KEYFRAMES_AT_ONCE = 4096
LONGEST_S = 60.0  # longest time that a question can wait
LATE = "its time was over before the map came to it"
_POINTS_A_FRAME = CONTROL_MAX_BYTES // 12
_FARTHEST_BLOCK = 1 << 20
_CELL_BYTES, _KEYFRAME_BYTES = 1 << 15, 1 << 8  # of an answer, roughly
_PACKED = ("float32", "int8", "uint8", "int32")  # dtypes that `array_encoding.pack` takes
_PACKED_FROM = 4096  # bytes: smaller arrays travel as they are
Matrix16 = Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]


class Sample(Struct, frozen=True, tag="sample", omit_defaults=True):
    """How far is the surface from these points? The points follow as (n, 3) float32 metres, little-endian.

    Attributes:
        points: n.
        crc: CRC-32 of the points' bytes.
        min_weight, surface: as for `Volume.sample`.
    """

    points: int
    crc: int
    min_weight: float | None = None
    surface: Surface | None = None

    @property
    def most_bytes(self) -> int:
        """Upper bound of the size of the answer."""
        return 20 * self.points

    def problem(self, frames: Sequence[Any]) -> str:
        """Return the reason why the question is invalid, or "". `frames`: frames that came with it."""
        if not 1 <= self.points <= MOST_POINTS:
            return f"a question may have 1 to {MOST_POINTS} points, got {self.points}: ask in parts"
        if sum(map(len, frames)) != 12 * self.points:
            return f"{self.points} points are {12 * self.points} bytes, others came"
        if crc_of(frames) != self.crc:
            return "its points were damaged on their way (CRC-32 differs)"
        if not np.isfinite(points_of(frames)).all():
            return "points must be finite"
        return _problem_of_weight(self.min_weight)


class Raycast(Struct, frozen=True, tag="raycast", omit_defaults=True):
    """Question for the view of a pinhole camera. Arguments as for `Volume.raycast`.

    Attributes:
        intrinsics: fx, fy, cx, cy, pixels.
        pose: the 16 numbers of T_world_camera, row by row.
        shape: height, width, pixels.
        max_age: seconds by which the shown state of the map may be older than the newest state.
        normals, colors: True to get them.
    """

    intrinsics: tuple[float, float, float, float]
    pose: Matrix16
    shape: tuple[int, int]
    min_weight: float | None = None
    surface: Surface | None = None
    max_age: float = 0.0
    normals: bool = True
    colors: bool = True

    @property
    def most_bytes(self) -> int:
        return (4 + 12 * self.normals + 3 * self.colors) * math.prod(self.shape)

    def problem(self, frames: Sequence[Any]) -> str:
        """Return the reason why the question is invalid, or "". `frames`: frames that came with it."""
        if frames:
            return "a view has no points"
        try:
            checked_camera(self.intrinsics, self.matrix, self.shape)
        except InvalidConfig as error:
            return str(error)
        if math.prod(self.shape) > MOST_PIXELS:
            return f"a view may have {MOST_PIXELS} pixels, got {self.shape[0]} × {self.shape[1]}"
        if not 0 <= self.max_age <= LONGEST_S:
            return f"max_age must be 0 to {LONGEST_S:g} s, got {self.max_age}"
        return _problem_of_weight(self.min_weight)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The pose T_world_camera, (4, 4) float64."""
        return np.array(self.pose, np.float64).reshape(4, 4)


class Slice(Struct, frozen=True, tag="slice", omit_defaults=True):
    """Question for the obstacles between two heights. Arguments as for `Volume.current_slice`.

    Attributes:
        kind: `occupancy`, or `distance` for distances too.
        up: up direction in the map's frame. The server does not find it: that takes the whole mesh.
    """

    kind: Literal["occupancy", "distance"]
    low: float
    high: float
    up: tuple[float, float, float]
    box: tuple[float, float, float, float] | None = None
    resolution: float | None = None
    max_distance: float = 2.0
    min_weight: float | None = None

    @property
    def most_bytes(self) -> int:
        return 5 * MOST_CELLS

    def problem(self, frames: Sequence[Any]) -> str:
        """Return the reason why the question is invalid, or "". `frames`: frames that came with it."""
        numbers = (self.low, self.high, *self.up, *(self.box or ()), self.resolution or 0, self.max_distance)
        if frames or not all(map(math.isfinite, numbers)):
            return "a slice has finite numbers and no points"
        if not 1e-6 <= math.hypot(*self.up) <= 1e6:
            return f"up must be a direction, got {self.up}"
        if self.box is not None and self.resolution is not None:
            u0, v0, u1, v1 = self.box
            if not (u1 - u0) * (v1 - v0) <= MOST_CELLS * self.resolution * self.resolution:
                return f"a slice may have {MOST_CELLS} cells: give a smaller box or a coarser resolution"
        return _problem_of_weight(self.min_weight)


class Field(Struct, frozen=True, tag="field", omit_defaults=True):
    """How far is the surface from each voxel of a box? Arguments as for `Volume.distance_field`."""

    box: tuple[float, float, float, float, float, float]
    max_distance: float
    subvoxel: bool = True
    min_weight: float | None = None

    @property
    def most_bytes(self) -> int:
        return 5 * MOST_VOXELS

    def problem(self, frames: Sequence[Any]) -> str:
        """Return the reason why the question is invalid, or "". `frames`: frames that came with it."""
        if frames or not all(map(math.isfinite, self.box)):
            return "a distance field has a box of finite numbers and no points"
        if not 0 < self.max_distance <= FARTHEST_M:
            return f"max_distance must be > 0 and up to {FARTHEST_M:g} m, got {self.max_distance}"
        return _problem_of_weight(self.min_weight)


class Cells(Struct, frozen=True, tag="cells", omit_defaults=True):
    """Question for the triangles of the map's cells, sorted by x, y and z, some hundred cells at once.

    Attributes:
        first: block coordinates of the first cell to send; None starts with the map's first cell.
        since: only cells with changes after this stamp of the map (`mesh_updates.MeshUpdate`).
        surface: None takes the surface of the map's settings.
    """

    first: tuple[int, int, int] | None = None
    since: int | None = None
    surface: Literal["raw"] | None = "raw"

    @property
    def most_bytes(self) -> int:
        return _CELL_BYTES * CELLS_AT_ONCE

    def problem(self, frames: Sequence[Any]) -> str:
        """Return the reason why the question is invalid, or "". `frames`: frames that came with it."""
        if frames:
            return "cells are asked for without points"
        if any(not -_FARTHEST_BLOCK <= one < _FARTHEST_BLOCK for one in self.first or ()):
            return f"a map has blocks from {-_FARTHEST_BLOCK} to {_FARTHEST_BLOCK - 1}, got {self.first}"
        if self.since is not None and not 0 <= self.since < 1 << 31:
            return f"a stamp is from 0 to {(1 << 31) - 1}, got {self.since}"
        return ""


class Keyframes(Struct, frozen=True, tag="keyframes", omit_defaults=True):
    """Where are the map's keyframes now? They come sorted by session and number.

    `session`, `after`: only keyframes after this one; empty starts with the first one.
    """

    session: Annotated[bytes, Meta(max_length=16)] = b""
    after: int = 0

    @property
    def most_bytes(self) -> int:
        return _KEYFRAME_BYTES * KEYFRAMES_AT_ONCE

    def problem(self, frames: Sequence[Any]) -> str:
        """Return the reason why the question is invalid, or "". `frames`: frames that came with it."""
        if frames:
            return "keyframes are asked for without points"
        good = 0 <= self.after < 1 << 63
        return "" if good else f"a keyframe has a number from 0 to {(1 << 63) - 1}, got {self.after}"


Question = Sample | Raycast | Slice | Field | Cells | Keyframes


class ArrayLayout(Struct, frozen=True, array_like=True):
    """One array of an answer, in the order of the frames. `packed`: encoded by `array_encoding.pack`."""

    name: str
    dtype: Literal["float32", "float64", "int8", "uint8", "int32", "int64", "bool"]
    shape: tuple[int, ...]
    packed: bool = False


class MapVersion(Struct, frozen=True, kw_only=True):
    """The one state of a map that an answer belongs to.

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
    """Answer of a map. Its arrays follow as frames.

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


def crc_of(frames: Sequence[Any]) -> int:
    """Return the CRC-32 of the bytes of all frames, in order."""
    crc = 0
    for frame in frames:
        crc = zlib.crc32(frame, crc)
    return crc


def point_frames(points: NDArray[np.float32]) -> list[memoryview]:
    """Return (n, 3) float32 points as frames that a server's control socket takes."""
    rows = np.ascontiguousarray(points, "<f4")
    return [rows[i : i + _POINTS_A_FRAME].data.cast("B") for i in range(0, len(rows), _POINTS_A_FRAME)]


def points_of(frames: Sequence[Any]) -> NDArray[np.float32]:
    """Return the (n, 3) points of frames whose sizes were checked."""
    joined = np.concatenate([np.frombuffer(frame, np.uint8) for frame in frames])
    return joined.view("<f4").reshape(-1, 3).astype(np.float32, copy=False)


def pack(arrays: dict[str, NDArray[Any]], *, compress: bool) -> tuple[tuple[ArrayLayout, ...], list[Any]]:
    """Encode the arrays of an answer. Return their layouts, and one frame for each."""
    layouts, frames = [], []
    for name, array in arrays.items():
        packed = compress and array.nbytes >= _PACKED_FROM and array.dtype.name in _PACKED
        layouts.append(ArrayLayout(name, array.dtype.name, array.shape, packed))
        plain = np.ascontiguousarray(array).reshape(-1)
        frames.append(array_encoding.pack(array) if packed else plain.view(np.uint8).data)
    return tuple(layouts), frames


def unpack(answer: Answer, frames: Sequence[Any]) -> dict[str, NDArray[Any]]:
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


def _problem_of_weight(min_weight: float | None) -> str:
    """Return the reason why a weight is invalid, or ""."""
    good = min_weight is None or (math.isfinite(min_weight) and min_weight >= 0)
    return "" if good else f"min_weight must be 0 or more, got {min_weight}"
