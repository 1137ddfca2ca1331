# SPDX-License-Identifier: MIT
"""Define the questions that a map answers: settings, limits on a server, and the arrays of an answer."""

import math
import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import ArrayLike, NDArray

from tsfusion.core.config import Surface, make_settings
from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.geometry import up_direction
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_answers import Samples, View, checked_camera
from tsfusion.geometry.map_grids import DistanceField, DistanceSlice, OccupancySlice, SliceGrid, blocked
from tsfusion.geometry.up_direction import Up

if TYPE_CHECKING:
    from typing_extensions import Unpack

MOST_POINTS = 20_000  # of a question
MOST_PIXELS = 1 << 20  # of a view
MOST_CELLS = 1 << 20  # of a slice, with the cells around it that its distances need
MOST_VOXELS = 1 << 22  # of a distance field, with the voxels around it
FARTHEST_M = 100.0  # largest `max_distance` of a distance field
LONGEST_S = 60.0  # longest time that a question can wait
_GRID = ("origin", "resolution", "heights", "axes")
Matrix16 = Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]
AnswerArrays = dict[str, NDArray[Any]]  # arrays of an answer by name


class ViewSettings(TypedDict, total=False):
    """Names and types of the settings of `Volume.raycast`; `Raycast` explains them."""

    min_weight: float | None
    surface: Surface | None
    normals: bool
    colors: bool


class SliceSettings(TypedDict, total=False):
    """Names and types of the settings of a slice of a map on a server, for type checkers."""

    box: Sequence[float] | None
    resolution: float | None
    max_distance: float
    min_weight: float | None


class OwnSliceSettings(SliceSettings, total=False):
    """Names and types of the settings of a slice of a map in this process, which can find up and floor."""

    up: Up | str | None
    above_floor: bool
    most_cells: int


class DistanceFieldSettings(TypedDict, total=False):
    """Names and types of the settings of `Volume.distance_field`, for type checkers."""

    max_distance: float
    subvoxel: bool
    min_weight: float | None


class MapQuestion(Struct, frozen=True, omit_defaults=True):
    """Question to a map. Subclasses have fields, and `most_bytes`, an upper bound of the answer's size."""

    def problem(self, frames: Sequence[Any]) -> str:
        """Return the reason why a question is invalid, or "". `frames`: bytes of the points sent with it."""
        if frames:
            return "this question is asked without points"
        return self._problem() or _problem_of_weight(getattr(self, "min_weight", None))

    def _problem(self) -> str:
        return ""

    def settings(self, kind: type) -> dict[str, Any]:
        """Return this question's values for the fields that `kind`, a TypedDict, declares, as arguments."""
        return {name: getattr(self, name) for name in kind.__annotations__}


class Sample(MapQuestion, frozen=True, tag="sample"):
    """Question for the surface's distance from points, sent with it: (n, 3) float32 metres, little-endian.

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
        return 20 * self.points

    def problem(self, frames: Sequence[Any]) -> str:
        if not 1 <= self.points <= MOST_POINTS:
            return f"a question may have 1 to {MOST_POINTS} points, got {self.points}: ask in parts"
        if sum(map(len, frames)) != 12 * self.points:
            return f"{self.points} points are {12 * self.points} bytes, got {sum(map(len, frames))}"
        if crc_of(frames) != self.crc:
            return "its points were damaged on their way (CRC-32 differs)"
        if not np.isfinite(points_of(frames)).all():
            return "points must be finite"
        return _problem_of_weight(self.min_weight)

    def result(self, arrays: AnswerArrays, reach: float) -> Samples:
        return Samples(**_exactly(arrays, "distance", "weight", "gradient"), reach=reach)


class Raycast(MapQuestion, frozen=True, tag="raycast"):
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

    @classmethod
    def of(
        cls,
        intrinsics: Intrinsics | ArrayLike,
        T_world_camera: ArrayLike,
        shape: tuple[int, int],
        max_age: float = 0.0,
        **how: "Unpack[ViewSettings]",
    ) -> "Raycast":
        camera, T, sides = checked_camera(intrinsics, T_world_camera, shape)
        own = (camera.fx, camera.fy, camera.cx, camera.cy), tuple(T.ravel().tolist()), sides
        return _checked(cls(*own, max_age=_number(max_age), **how))

    @property
    def most_bytes(self) -> int:
        return (4 + 12 * self.normals + 3 * self.colors) * math.prod(self.shape)

    def _problem(self) -> str:
        try:
            checked_camera(self.intrinsics, self.matrix, self.shape)
        except InvalidConfig as error:
            return str(error)
        if math.prod(self.shape) > MOST_PIXELS:
            return f"a view may have {MOST_PIXELS} pixels, got {self.shape[0]} × {self.shape[1]}"
        if not 0 <= self.max_age <= LONGEST_S:
            return f"max_age must be 0 to {LONGEST_S:g} s, got {self.max_age}"
        return ""

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The pose T_world_camera, (4, 4) float64."""
        return np.array(self.pose, np.float64).reshape(4, 4)

    def result(self, arrays: AnswerArrays) -> View:
        colors = arrays.pop("colors", None)  # some maps have none
        names = ["depth", "normals"] if self.normals else ["depth"]
        return View(**_exactly(arrays, *names), colors=colors)


class Slice(MapQuestion, frozen=True, tag="slice"):
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

    @classmethod
    def of(
        cls,
        kind: Literal["occupancy", "distance"],
        low: float,
        high: float,
        up: Up | str,
        **how: "Unpack[SliceSettings]",
    ) -> "Slice":
        x, y, z = map(float, (up_direction.parse(up) if isinstance(up, str) else up).direction)
        given: dict[str, Any] = {**how}
        if (box := how.get("box")) is not None:
            given["box"] = _numbers(box, 4)
        return _checked(cls(kind, float(low), float(high), (x, y, z), **given))

    @property
    def most_bytes(self) -> int:
        return 5 * MOST_CELLS

    def _problem(self) -> str:
        numbers = (self.low, self.high, *self.up, *(self.box or ()), self.resolution or 0, self.max_distance)
        if not all(map(math.isfinite, numbers)):
            return "a slice has finite numbers"
        if not 1e-6 <= math.hypot(*self.up) <= 1e6:
            return f"up must be a direction, got {self.up}"
        if self.box is not None and self.resolution is not None:
            u0, v0, u1, v1 = self.box
            if not (u1 - u0) * (v1 - v0) <= MOST_CELLS * self.resolution * self.resolution:
                return f"a slice may have {MOST_CELLS} cells: give a smaller box or a coarser resolution"
        return ""

    def occupancy(self, arrays: AnswerArrays) -> OccupancySlice:
        found = _exactly(arrays, "cells", "knows_free_space", *_GRID)
        return OccupancySlice(_grid(found), found["cells"], bool(found["knows_free_space"]))

    def distances(self, arrays: AnswerArrays, *, unseen_is_free: bool) -> DistanceSlice:
        found = _exactly(arrays, "cells", "distance", "max_distance", *_GRID)
        distance = blocked(found["distance"], found["cells"], unseen_is_free=unseen_is_free)
        return DistanceSlice(_grid(found), distance, found["cells"], float(found["max_distance"]))


class Field(MapQuestion, frozen=True, tag="field"):
    """Question for the distance of the surface from each voxel in a box, as `Volume.distance_field`."""

    box: tuple[float, float, float, float, float, float]
    max_distance: float
    subvoxel: bool = True
    min_weight: float | None = None

    @classmethod
    def of(cls, box: Sequence[float], **how: "Unpack[DistanceFieldSettings]") -> "Field":
        given: dict[str, Any] = {"max_distance": 0.5, **how}
        return _checked(cls(_numbers(box, 6), **given))

    @property
    def most_bytes(self) -> int:
        return 5 * MOST_VOXELS

    def _problem(self) -> str:
        if not all(map(math.isfinite, self.box)):
            return "a distance field has a box of finite numbers"
        if not 0 < self.max_distance <= FARTHEST_M:
            return f"max_distance must be > 0 and up to {FARTHEST_M:g} m, got {self.max_distance}"
        return ""

    def check_voxels(self, voxel_size: float) -> None:
        """Raise InvalidConfig if the field would have too many voxels. `voxel_size`: the map's, metres."""
        sides = np.diff(np.reshape(self.box, (2, 3)), axis=0)[0] + 2 * self.max_distance
        if not np.prod(np.maximum(sides / voxel_size, 1)) <= MOST_VOXELS:
            raise InvalidConfig(
                f"a distance field may have {MOST_VOXELS} voxels, including those within max_distance around "
                "the box: give a smaller box or max_distance"
            )

    def result(self, arrays: AnswerArrays, *, unseen_is_free: bool) -> DistanceField:
        found = _exactly(arrays, "distance", "occupancy", "origin", "voxel_size", "max_distance")
        distance = blocked(found["distance"], found["occupancy"], unseen_is_free=unseen_is_free)
        edge, farthest = float(found["voxel_size"]), float(found["max_distance"])
        return DistanceField(found["origin"], edge, distance, found["occupancy"], farthest)


def crc_of(frames: Sequence[Any]) -> int:
    """Return the CRC-32 of the bytes of all message frames, in order."""
    crc = 0
    for frame in frames:
        crc = zlib.crc32(frame, crc)
    return crc


def points_of(frames: Sequence[Any]) -> NDArray[np.float32]:
    """Return the (n, 3) points in message frames whose sizes were checked."""
    joined = np.concatenate([np.frombuffer(frame, np.uint8) for frame in frames])
    return joined.view("<f4").reshape(-1, 3).astype(np.float32, copy=False)


def _exactly(arrays: AnswerArrays, *names: str) -> AnswerArrays:
    """Return the arrays of an answer. Raise TransportError unless they have exactly these names."""
    if sorted(arrays) != sorted(names):
        raise TransportError(f"an answer has {', '.join(arrays) or 'nothing'} instead of {', '.join(names)}")
    return arrays


def _grid(found: AnswerArrays) -> SliceGrid:
    """Return the grid of a slice from the arrays of an answer."""
    rows, columns = found["cells"].shape
    u, v = found["origin"].tolist()
    low, high = found["heights"].tolist()
    return SliceGrid((u, v), float(found["resolution"]), (rows, columns), low, high, found["axes"])


AskedQuestion = TypeVar("AskedQuestion", bound=MapQuestion)


def _checked(question: AskedQuestion) -> AskedQuestion:
    """Return a question after a check of its fields' types. Raises InvalidConfig, naming the field."""
    return make_settings(type(question), msgspec.structs.asdict(question))


def _numbers(box: Sequence[float], count: int) -> Any:
    numbers = np.asarray(box, np.float64)
    if numbers.shape != (count,):
        raise InvalidConfig(f"a box must be {count} numbers in metres, got {box}")
    return tuple(numbers.tolist())


def _number(max_age: Any) -> float:
    try:
        return float("text" if isinstance(max_age, str | bytes) else max_age)
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidConfig(f"max_age must be a number, got {max_age!r}") from error


def _problem_of_weight(min_weight: float | None) -> str:
    """Return the reason why a `min_weight` is invalid, or ""."""
    good = min_weight is None or (math.isfinite(min_weight) and min_weight >= 0)
    return "" if good else f"min_weight must be 0 or more, got {min_weight}"
