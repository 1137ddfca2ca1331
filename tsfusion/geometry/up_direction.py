# SPDX-License-Identifier: MIT
"""Find the up direction of a map: given, by an accelerometer, by the floor, or by the cameras' attitudes."""

import math
from collections.abc import Sequence
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry import se3

GRAVITY = 9.81  # m/s²
# Largest angle between the floor's normal and the sensors' mean up vector. A wall is 90° from a floor:
# beyond 45° a wall could be taken for the floor.
_CONE = math.cos(math.radians(45))
_LEVEL = math.cos(math.radians(8))  # largest angle between a plane's normal and a triangle's normal
SAMPLE = 50_000  # largest number of examined triangles
_UPRIGHT = 0.5  # least length of the cameras' mean unit up vector; less: cameras were held in all ways
_LEAST = 0.02  # least share of the surface in a floor
_LARGE = 0.2  # least size of a floor, as a share of the largest level plane; mirrored floors are smaller
_APART = math.cos(math.radians(30))  # least angle between two different directions
_SURE = 3.0  # least ratio of the surface that faces up to that of any other way, without known cameras
_GRAIN = 2.0**-20  # step to which summed numbers are rounded: their sums are exact in any order
_USUAL = np.array(((0.0, 0, 1), (0, -1, 0), (0, 1, 0)))  # robots' and surveyors' up, that of a camera, glTF's
_SHORT = 0.1  # relative difference of a mean specific force from gravity
_FITS = 3  # successive fits of a plane
_AXES = ("x", "y", "z")


class SurfaceArrays(Protocol):
    """Arrays of a mesh: (n, 3) vertices in metres, (m, 3) faces, (n, 3) unit normals."""

    @property
    def vertices(self) -> NDArray[np.float32]: ...
    @property
    def faces(self) -> NDArray[np.int32]: ...
    @property
    def normals(self) -> NDArray[np.float32]: ...


class Up(msgspec.Struct, frozen=True):
    """Direction away from the ground, in the map's frame, and how it was found."""

    direction: tuple[float, float, float]  # of unit length
    found_by: str  # given, imu, floor or cameras

    @property
    def axis(self) -> str:
        """The nearest axis of the map, such as `+z` or `-y`."""
        index = int(np.argmax(np.abs(self.direction)))
        return ("-" if self.direction[index] < 0 else "+") + _AXES[index]

    def to_y(self) -> NDArray[np.float64]:
        """Return the (3, 3) shortest rotation of up to +y, after half a turn around x if up[1] < 0."""
        up = np.array(self.direction)
        half = np.diag((1.0, -1, -1)) if up[1] < 0 else np.eye(3)
        W = se3.hat(np.cross(half @ up, (0.0, 1, 0)))
        turn: NDArray[np.float64] = (np.eye(3) + W + W @ W / (1 + abs(up[1]))) @ half
        return turn

    def __str__(self) -> str:
        numbers = " ".join(f"{round(number, 4) + 0.0:.4f}" for number in self.direction)  # no -0.0
        return f"{self.axis} ({self.found_by}: {numbers})"


def parse(text: str) -> Up:
    """Read an up direction: `x`, `-y` or numbers such as `0,-0.9,0.1`. InvalidConfig for anything else."""
    sign, name = (-1.0, text[1:]) if text[:1] == "-" else (1.0, text.removeprefix("+"))
    if name in _AXES:
        return _up(sign * np.eye(3)[_AXES.index(name)], "given")
    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    length = float(np.linalg.norm(numbers))
    if numbers.shape != (3,) or not 1e-6 < length < math.inf:
        raise InvalidConfig(f"up must be x, y, z, -x, -y, -z or three numbers X,Y,Z, got {text!r}")
    return _up(numbers, "given")


class SensorPosture:
    """Attitudes of a map's sensors: sums over their poses and their accelerometers' values.

    `numbers`: the `numbers` of an earlier object, to continue from; None = start at zero.
    """

    def __init__(self, numbers: Sequence[float] | None = None) -> None:
        self._sums = np.zeros((3, 4)) if numbers is None else np.array(numbers, np.float64).reshape(3, 4)

    @property
    def numbers(self) -> list[float]:
        """The sums as 12 numbers, to be saved as JSON."""
        found: list[float] = self._sums.ravel().tolist()
        return found

    def add(
        self,
        T_world_sensor: NDArray[np.float64],
        sensor: str,
        force: NDArray[np.float64] | None = None,
        *,
        times: int = 1,
    ) -> None:
        """Add a keyframe to the sums.

        Args:
            T_world_sensor: (4, 4). A LiDAR's own axes are x forward, y left, z up; a camera's are x right, y
                down, z forward.
            sensor: name of the sensor model.
            force: (3,) specific force, in the sensor's axes; None = no value.
            times: -1 removes the keyframe again.
        """
        up = T_world_sensor[:3, 2] if sensor == "lidar" else -T_world_sensor[:3, 1]
        rows = np.ones((2 if force is None else 3, 4))
        rows[0, :3], rows[1, :3] = up, T_world_sensor[:3, 3]
        if force is not None:
            rows[2, :3] = T_world_sensor[:3, :3] @ force
        rows[:, :3] = np.rint(rows[:, :3] / _GRAIN) * _GRAIN
        self._sums[: len(rows)] += times * rows

    def merge(self, other: "SensorPosture") -> None:
        """Add the keyframes that another object has summed."""
        self._sums += other._sums

    @property
    def is_known(self) -> bool:
        return bool(self._sums[1, 3])

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) mean direction away from the ground, assuming upright sensors; length 0 to 1."""
        return self._mean(0)

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) mean position of the sensors, metres."""
        return self._mean(1)

    @property
    def force(self) -> NDArray[np.float64]:
        """(3,) mean specific force in the world, opposite to gravity: the sensors' own motion cancels out."""
        return self._mean(2)

    def _mean(self, row: int) -> NDArray[np.float64]:
        mean: NDArray[np.float64] = self._sums[row, :3] / max(self._sums[row, 3], 1.0)
        return mean


def find(mesh: SurfaceArrays, held: SensorPosture, *, given: Up | None = None) -> Up | None:
    """Find up from a mesh and from the attitudes of its sensors; return None if up is unknown.

    The accelerometer decides, if its mean over the scan is as long as gravity. Else the largest plane
    decides, among planes seen from above by sensors that were upright within 45°. Else the mean attitude
    decides. Without known attitudes, a direction needs three times as much surface as any other, and must be
    −y, +y or +z within 45°: walls look like a floor.

    `given`: a person's answer, which is returned.
    """
    if given is not None:
        return given
    # In m/s², or in g as some drivers write. A wrong axis or pose makes the mean shorter.
    force = float(np.linalg.norm(held.force))
    if min(abs(force - GRAVITY) / GRAVITY, abs(force - 1)) < _SHORT:
        return _up(held.force, "imu")
    surface = _FacingSurface(mesh)
    length = float(np.linalg.norm(held.up))
    if length < _UPRIGHT:
        return surface.most_faced()
    floor = surface.floor(held.up / length, held.position)
    return _up(held.up, "cameras") if floor is None else _up(floor, "floor")


def floor_height(mesh: SurfaceArrays, up: Up, held: SensorPosture) -> float | None:
    """Return the floor's height along `up` from the map's origin, metres; None without a large enough
    surface.

    The floor is the lowest of the large level surfaces that face up, below the sensors' mean position: at
    least a fifth as large as the largest. In a scan with a table but no floor, it is the table.
    """
    direction = np.array(up.direction)
    below = float(held.position @ direction) if held.is_known else np.inf
    return _FacingSurface(mesh).lowest_level(direction, below)


class _FacingSurface:
    """A sample of a mesh's triangles: centres (n, 3), unit normals (n, 3), areas (n,) of sum 1."""

    def __init__(self, mesh: SurfaceArrays) -> None:
        faces = mesh.faces[:: max(1, len(mesh.faces) // SAMPLE)]
        corners, normals = mesh.vertices[faces].astype(np.float64), mesh.normals[faces].astype(np.float64)
        edges = np.diff(corners, axis=1)
        area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        self.area = area / max(float(area.sum()), 1e-12)
        self.points, mean = corners.mean(axis=1), normals.sum(axis=1)
        self.normals = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
        # Largest distance of a plane's points: two edges, each about as long as a voxel
        self.thickness = 2 * float(np.median(np.linalg.norm(edges[:, 0], axis=1))) if len(faces) else 1.0

    def floor(self, held: NDArray[np.float64], camera: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the (3,) normal, near `held` (up), of the largest plane below a point `camera`; or None."""
        below = (self.points - camera) @ held < 0
        directions = _sphere()
        directions = directions[directions @ held > _CONE]
        shares = self._facing(directions, below)
        likely = directions[shares >= max(_LEAST, 0.5 * shares.max())]
        planes = [plane for d in likely if (plane := self._plane(d, below))[0] @ held > _CONE]
        normal, share = max(planes, key=lambda plane: plane[1], default=(held, 0.0))
        return normal if share >= _LEAST else None

    def most_faced(self) -> Up | None:
        """Return the direction that most surface faces, if it is clear and likely to be up; else None."""
        directions = _sphere()
        shares = self._facing(directions, np.ones(len(self.area), bool))
        best = directions[shares.argmax()]
        others = shares[directions @ best < _APART].max()
        if shares.max() < max(_SURE * others, _LEAST) or (_USUAL @ best).max() < _CONE:
            return None
        normal, share = self._plane(best, np.ones(len(self.area), bool))
        return _up(normal, "floor") if share >= _LEAST else None

    def lowest_level(self, up: NDArray[np.float64], below: float) -> float | None:
        """Return the height of the lowest large plane that faces up, if it lies below `below`; else None."""
        heights = self.points @ up
        facing = np.flatnonzero((self.normals @ up > _LEVEL) & (heights < below))
        if not len(facing):
            return None
        heights, area = heights[facing], self.area[facing]
        at = np.floor((heights - heights.min()) / self.thickness).astype(np.int64)
        # a plane at the border of two layers lies in both
        layers = np.convolve(np.bincount(at, area), (1, 1))
        if layers.max() < _LEAST:
            return None
        first = int(np.argmax(layers >= max(_LARGE * layers.max(), _LEAST)))
        first += int(layers[first + 1 : first + 2].sum() > layers[first])
        inside = np.flatnonzero((at == first) | (at == first - 1))
        order = inside[np.argsort(heights[inside])]
        middle = np.searchsorted(np.cumsum(area[order]), area[order].sum() / 2)
        return float(heights[order[middle]])

    def _facing(self, directions: NDArray[np.float64], among: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the (k,) shares of the surface whose normal is near each of (k, 3) directions."""
        normals, area = self.normals[among], self.area[among]
        return np.array([area[normals @ direction > _LEVEL].sum() for direction in directions])

    def _plane(
        self, normal: NDArray[np.float64], among: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], float]:
        """Return the normal of the largest plane that faces about `normal`, and its share of the surface."""
        share = 0.0
        for _ in range(_FITS):
            facing = np.flatnonzero(among & (self.normals @ normal > _LEVEL))
            if len(facing) < 3:
                break
            height = self.points[facing] @ normal
            at = np.floor((height - height.min()) / self.thickness).astype(np.int64)
            layers = np.bincount(at, self.area[facing])
            inside = facing[np.abs(at - layers.argmax()) <= 1]
            weights, points = self.area[inside], self.points[inside]
            share = float(weights.sum())
            offsets = points - weights @ points / share
            axis = np.linalg.eigh((weights[:, None] * offsets).T @ offsets)[1][:, 0]
            normal = axis if axis @ normal > 0 else -axis
        return normal, share


def _up(direction: NDArray[np.float64], found_by: str) -> Up:
    x, y, z = (direction / np.linalg.norm(direction)).tolist()
    return Up((x, y, z), found_by)


def _sphere(count: int = 1500) -> NDArray[np.float64]:
    """Return (count, 3) unit vectors, about 5° apart (Fibonacci's lattice)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - math.sqrt(5)) * np.arange(count)
    r = np.sqrt(1 - z * z)
    return np.stack((r * np.cos(turn), r * np.sin(turn), z), axis=1)
