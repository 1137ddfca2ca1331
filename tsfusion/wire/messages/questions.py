# SPDX-License-Identifier: MIT
"""Questions to the map of a running server, and their answers: small structs, then arrays as raw frames.

A question has bounds that the server checks before it spends anything: points, pixels, cells. An answer
belongs to one state of the map, and says which.
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
MOST_CELLS = 1 << 20  # of a slice, with those around it from which its distances come
MOST_VOXELS = 1 << 22  # of a distance field, likewise
FARTHEST_M = 100.0  # that a distance field reaches
CELLS_AT_ONCE = 256  # of an answer
REFINED_AT_ONCE = 64  # likewise, where the surface is not the raw one
KEYFRAMES_AT_ONCE = 4096
LONGEST_S = 60.0  # that a question may wait
LATE = "its time was over before the map came to it"
_POINTS_A_FRAME = CONTROL_MAX_BYTES // 12
_FARTHEST_BLOCK = 1 << 20
_CELL_BYTES, _KEYFRAME_BYTES = 1 << 15, 1 << 8  # of an answer, roughly
_PACKED = ("float32", "int8", "uint8", "int32")  # what `array_encoding.pack` takes
_PACKED_FROM = 4096  # bytes: smaller arrays travel as they are
Matrix16 = Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]


class Sample(Struct, frozen=True, tag="sample", omit_defaults=True):
    """How far is the surface from these points? They follow as (n, 3) float32 metres, little-endian.

    Attributes:
        points: n.
        crc: CRC-32 of their bytes.
        min_weight, surface: as of `Volume.sample`.
    """

    points: int
    crc: int
    min_weight: float | None = None
    surface: Surface | None = None

    @property
    def most_bytes(self) -> int:
        """Size of its answer, at the most."""
        return 20 * self.points

    def problem(self, frames: Sequence[Any]) -> str:
        """Reason why this is not to be asked; empty = it may be. `frames`: what came with it."""
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
    """Question for the view of a pinhole camera. Arguments as of `Volume.raycast`.

    Attributes:
        intrinsics: fx, fy, cx, cy, pixels.
        pose: the 16 numbers of T_world_camera, row by row.
        shape: height, width, pixels.
        max_age: seconds since which the state of the map that is shown may not be the newest any more.
        normals, colors: whether with them.
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
        """Size of its answer, at the most."""
        return (4 + 12 * self.normals + 3 * self.colors) * math.prod(self.shape)

    def problem(self, frames: Sequence[Any]) -> str:
        """Reason why this is not to be asked; empty = it may be. `frames`: what came with it."""
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
        """The pose T_world_camera, (4, 4)."""
        return np.array(self.pose, np.float64).reshape(4, 4)


class Slice(Struct, frozen=True, tag="slice", omit_defaults=True):
    """Question for what stands between two heights. Arguments as of `Volume.current_slice`.

    Attributes:
        kind: `occupancy`, or also distances.
        up: a direction in the map's frame. It is not looked for here: that takes the whole mesh.
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
        """Size of its answer, at the most."""
        return 5 * MOST_CELLS

    def problem(self, frames: Sequence[Any]) -> str:
        """Reason why this is not to be asked; empty = it may be. `frames`: what came with it."""
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
    """How far is the surface from each voxel of a box? Arguments as of `Volume.distance_field`."""

    box: tuple[float, float, float, float, float, float]
    max_distance: float
    subvoxel: bool = True
    min_weight: float | None = None

    @property
    def most_bytes(self) -> int:
        """Size of its answer, at the most."""
        return 5 * MOST_VOXELS

    def problem(self, frames: Sequence[Any]) -> str:
        """Reason why this is not to be asked; empty = it may be. `frames`: what came with it."""
        if frames or not all(map(math.isfinite, self.box)):
            return "a distance field has a box of finite numbers and no points"
        if not 0 < self.max_distance <= FARTHEST_M:
            return f"max_distance must be > 0 and up to {FARTHEST_M:g} m, got {self.max_distance}"
        return _problem_of_weight(self.min_weight)


class Cells(Struct, frozen=True, tag="cells", omit_defaults=True):
    """Question for the triangles of the map's cells, in the order of their x, y and z, some hundred at once.

    Attributes:
        first: block coordinates of where to begin; None = with the first cell.
        since: only cells that changes after this stamp of the map reach (`mesh_updates.MeshUpdate`).
        surface: None = the one that the map's settings say.
    """

    first: tuple[int, int, int] | None = None
    since: int | None = None
    surface: Literal["raw"] | None = "raw"

    @property
    def most_bytes(self) -> int:
        """Size of its answer, at the most."""
        return _CELL_BYTES * CELLS_AT_ONCE

    def problem(self, frames: Sequence[Any]) -> str:
        """Reason why this is not to be asked; empty = it may be. `frames`: what came with it."""
        if frames:
            return "cells are asked for without points"
        if any(not -_FARTHEST_BLOCK <= one < _FARTHEST_BLOCK for one in self.first or ()):
            return f"a map has blocks from {-_FARTHEST_BLOCK} to {_FARTHEST_BLOCK - 1}, got {self.first}"
        if self.since is not None and not 0 <= self.since < 1 << 31:
            return f"a stamp is from 0 to {(1 << 31) - 1}, got {self.since}"
        return ""


class Keyframes(Struct, frozen=True, tag="keyframes", omit_defaults=True):
    """Where are the map's keyframes now? They come in the order of their sessions and numbers.

    `session`, `after`: only those behind this one; empty = from the first one on.
    """

    session: Annotated[bytes, Meta(max_length=16)] = b""
    after: int = 0

    @property
    def most_bytes(self) -> int:
        """Size of its answer, at the most."""
        return _KEYFRAME_BYTES * KEYFRAMES_AT_ONCE

    def problem(self, frames: Sequence[Any]) -> str:
        """Reason why this is not to be asked; empty = it may be. `frames`: what came with it."""
        if frames:
            return "keyframes are asked for without points"
        good = 0 <= self.after < 1 << 63
        return "" if good else f"a keyframe has a number from 0 to {(1 << 63) - 1}, got {self.after}"


Question = Sample | Raycast | Slice | Field | Cells | Keyframes


class ArrayLayout(Struct, frozen=True, array_like=True):
    """One array of an answer, in the order of the frames. `packed`: as `array_encoding.pack` makes it."""

    name: str
    dtype: Literal["float32", "float64", "int8", "uint8", "int32", "int64", "bool"]
    shape: tuple[int, ...]
    packed: bool = False


class MapVersion(Struct, frozen=True, kw_only=True):
    """The one state of a map that an answer belongs to.

    Attributes:
        keyframes: in the map.
        changes: records and moves that the process `epoch` of the server has taken: where both are equal,
            the map is the same. An empty epoch is a file's.
        segment, offset: the newest record of the journal in the map; 0 = none since it was opened.
        waiting: keyframes whose corrected pose is not in the map yet.
    """

    keyframes: int
    changes: int = 0
    epoch: str = ""
    segment: int = 0
    offset: int = 0
    waiting: int = 0


class Answer(Struct, frozen=True, kw_only=True):
    """Answer of a map; its arrays follow as frames.

    Attributes:
        crc: CRC-32 of all frames.
        waited_s: from when the server got the question until it was looked at.
        took_s: to answer it.
        reach: of samples, metres before a surface up to which they are known.
    """

    arrays: tuple[ArrayLayout, ...]
    state: MapVersion
    crc: int
    waited_s: float = 0.0
    took_s: float = 0.0
    reach: float = 0.0


def crc_of(frames: Sequence[Any]) -> int:
    """CRC-32 of the bytes of all frames, one after the other."""
    crc = 0
    for frame in frames:
        crc = zlib.crc32(frame, crc)
    return crc


def point_frames(points: NDArray[np.float32]) -> list[memoryview]:
    """(n, 3) float32 points as frames that a server's control socket takes."""
    rows = np.ascontiguousarray(points, "<f4")
    return [rows[i : i + _POINTS_A_FRAME].data.cast("B") for i in range(0, len(rows), _POINTS_A_FRAME)]


def points_of(frames: Sequence[Any]) -> NDArray[np.float32]:
    """The (n, 3) points of frames whose sizes were checked."""
    joined = np.concatenate([np.frombuffer(frame, np.uint8) for frame in frames])
    return joined.view("<f4").reshape(-1, 3).astype(np.float32, copy=False)


def pack(arrays: dict[str, NDArray[Any]], *, compress: bool) -> tuple[tuple[ArrayLayout, ...], list[Any]]:
    """Arrays for the way: their layouts, and a frame each."""
    layouts, frames = [], []
    for name, array in arrays.items():
        packed = compress and array.nbytes >= _PACKED_FROM and array.dtype.name in _PACKED
        layouts.append(ArrayLayout(name, array.dtype.name, array.shape, packed))
        plain = np.ascontiguousarray(array).reshape(-1)
        frames.append(array_encoding.pack(array) if packed else plain.view(np.uint8).data)
    return tuple(layouts), frames


def unpack(answer: Answer, frames: Sequence[Any]) -> dict[str, NDArray[Any]]:
    """The arrays of an answer, by name.

    Raises:
        DecodeError: when the frames are not what the answer says.
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
    """Reason why a weight makes no sense; empty = it does."""
    good = min_weight is None or (math.isfinite(min_weight) and min_weight >= 0)
    return "" if good else f"min_weight must be 0 or more, got {min_weight}"
