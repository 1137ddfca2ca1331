# SPDX-License-Identifier: MIT
"""Which way is up in a map: as given, by an accelerometer, by the floor, or by how cameras are held."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry import se3

if TYPE_CHECKING:
    from tsfusion.geometry.mesh import Mesh

GRAVITY = 9.81  # m/s²
# Of the mean of how a sensor was held, in which the floor's normal is looked for. A wall is 90° from a floor:
# beyond half of that it would be taken for one.
_CONE = math.cos(math.radians(45))
_LEVEL = math.cos(math.radians(8))  # of a direction, in which a normal is one of a plane across it
_SAMPLE = 30_000  # vertices looked at
_UPRIGHT = 0.5  # least length of the mean of the cameras' unit up vectors: less, and they were turned about
_LEAST = 0.02  # share of the surface that a floor has at least
_APART = math.cos(math.radians(30))  # of two directions that are not the same
_SURE = 3.0  # how many times more surface faces up than any other way, where no camera is known
_USUAL = np.array(((0.0, 0, 1), (0, -1, 0), (0, 1, 0)))  # robots' and surveyors' up, that of a camera, glTF's
_SHORT = 0.1  # relative difference of a mean specific force from gravity
_FITS = 3  # of a plane, each to what the one before has found
_AXES = ("x", "y", "z")


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
        """(3, 3) rotation that takes up to +y by the shortest way, or half around x and on from there."""
        up = np.array(self.direction)
        half = np.diag((1.0, -1, -1)) if up[1] < 0 else np.eye(3)
        W = se3.hat(np.cross(half @ up, (0.0, 1, 0)))
        turn: NDArray[np.float64] = (np.eye(3) + W + W @ W / (1 + abs(up[1]))) @ half
        return turn

    def __str__(self) -> str:
        numbers = " ".join(f"{number:.4f}" for number in self.direction)
        return f"{self.axis} ({self.found_by}: {numbers})"


def parse(text: str) -> Up:
    """Read `x`, `-y` or three numbers such as `0,-0.9,0.1`.

    Raises:
        InvalidConfig: for anything else.
    """
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


def sensor_ups(poses: NDArray[np.float64], sensor: str) -> NDArray[np.float64]:
    """(n, 3) in the world: away from the ground, for sensors with (n, 4, 4) poses that are held upright.

    A LiDAR's own axes are x forward, y left, z up; a camera's are x right, y down, z forward.
    """
    return poses[:, :3, 2] if sensor == "lidar" else -poses[:, :3, 1]


def find(
    mesh: "Mesh",
    poses: Sequence[NDArray[np.float64]] = (),
    *,
    sensor: str = "kinect",
    forces: Sequence[NDArray[np.float64] | None] = (),
) -> Up | None:
    """Find up from a mesh and from what is known of the sensor that saw it.

    An accelerometer decides, where its mean over the scan is as long as gravity. Otherwise the plane with the
    largest surface does, among those seen from above by a sensor that was held upright within 45°; without
    such a plane the mean of how it was held. Without poses a direction counts only if three times as much
    surface faces there as any other way, and it is −y, +y or +z within 45°: walls look like a floor.

    Args:
        poses: (4, 4) T_world_sensor each.
        sensor: name of the sensor model: a LiDAR's z axis is up, a camera's −y.
        forces: (3,) each, what an accelerometer measured, in the axes of each pose; None = nothing.

    Returns:
        None where it cannot be told.
    """
    measured = _by_forces(poses, forces)
    if measured is not None:
        return measured
    surface = _Surface(mesh)
    T = np.array(poses).reshape(-1, 4, 4)
    held = sensor_ups(T, sensor).mean(axis=0) if len(T) else np.zeros(3)
    if np.linalg.norm(held) < _UPRIGHT:
        return surface.most_faced()
    held /= np.linalg.norm(held)
    floor = surface.floor(held, float((T[:, :3, 3] @ held).max()))
    return _up(held, "cameras") if floor is None else _up(floor, "floor")


class _Surface:
    """A sample of a mesh's vertices: positions (n, 3), unit normals (n, 3), area around each (n,), sum 1."""

    def __init__(self, mesh: "Mesh") -> None:
        vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        area = np.bincount(faces.ravel(), np.repeat(areas, 3), len(vertices))
        chosen = np.flatnonzero(area > 0)
        chosen = chosen[:: max(1, len(chosen) // _SAMPLE)]
        self.points, self.normals = vertices[chosen], mesh.normals[chosen].astype(np.float64)
        self.area = area[chosen] / max(float(area[chosen].sum()), 1e-12)
        # Within this a vertex belongs to a plane: two edges, which are about as long as a voxel
        self.thickness = 2 * float(np.median(np.linalg.norm(b - a, axis=1))) if len(a) else 1.0

    def floor(self, held: NDArray[np.float64], top: float) -> NDArray[np.float64] | None:
        """(3,) normal of the largest plane seen from the side of `held` and below `top` along it."""
        below = self.points @ held < top
        directions = _sphere()
        directions = directions[directions @ held > _CONE]
        shares = self._facing(directions, below)
        likely = directions[shares >= max(_LEAST, 0.5 * shares.max())]
        planes = [plane for d in likely if (plane := self._plane(d, below))[0] @ held > _CONE]
        normal, share = max(planes, key=lambda plane: plane[1], default=(held, 0.0))
        return normal if share >= _LEAST else None

    def most_faced(self) -> Up | None:
        """The direction that far more surface faces than any other, if maps are likely to have up there."""
        directions = _sphere()
        shares = self._facing(directions, np.ones(len(self.area), bool))
        best = directions[shares.argmax()]
        others = shares[directions @ best < _APART].max()
        if shares.max() < max(_SURE * others, _LEAST) or (_USUAL @ best).max() < _CONE:
            return None
        normal, share = self._plane(best, np.ones(len(self.area), bool))
        return _up(normal, "floor") if share >= _LEAST else None

    def _facing(self, directions: NDArray[np.float64], among: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(m,) share of the surface whose normal is near each of (m, 3) directions."""
        normals, area = self.normals[among], self.area[among]
        return np.array([area[normals @ direction > _LEVEL].sum() for direction in directions])

    def _plane(
        self, normal: NDArray[np.float64], among: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], float]:
        """The largest plane across a direction: its exact normal, and its share of the surface."""
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


def _by_forces(
    poses: Sequence[NDArray[np.float64]], forces: Sequence[NDArray[np.float64] | None]
) -> Up | None:
    """Gravity's opposite: over a scan, a sensor's own accelerations cancel out."""
    found = [T[:3, :3] @ force for T, force in zip(poses, forces, strict=False) if force is not None]
    if not found:
        return None
    mean = np.mean(found, axis=0)
    # In m/s², or in g as some drivers write. A wrong axis or pose makes the mean shorter.
    length = float(np.linalg.norm(mean))
    return _up(mean, "imu") if min(abs(length - GRAVITY) / GRAVITY, abs(length - 1)) < _SHORT else None


def _up(direction: NDArray[np.float64], found_by: str) -> Up:
    x, y, z = (direction / np.linalg.norm(direction)).tolist()
    return Up((x, y, z), found_by)


def _sphere(count: int = 1500) -> NDArray[np.float64]:
    """(count, 3) unit vectors, about 5° apart (Fibonacci's lattice)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - math.sqrt(5)) * np.arange(count)
    r = np.sqrt(1 - z * z)
    return np.stack((r * np.cos(turn), r * np.sin(turn), z), axis=1)
