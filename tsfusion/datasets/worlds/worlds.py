# SPDX-License-Identifier: MIT
"""Define the synthetic worlds: tables of solids with a known signed distance, and paths of the sensor.

A world is the union of its solids. The renderer casts rays at the same table.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics

# (m, 12): kind, centre xyz, half sizes xyz, cos yaw, sin yaw, material, variant, top
Solids = NDArray[np.float64]

# Equal to those of kernels/worlds/synthetic_raycast.py, which needs Taichi; a test compares them.
# AXLE: a cylinder along y. PRISM: a box whose length in x shrinks upwards to the share `top`.
ROOM, BOX, SPHERE, CYLINDER, GROUND, AXLE, PRISM = range(7)
INTERIOR, WOOD, MARBLE, STRIPES, ROAD, PAVEMENT, FACADE, PAINT, METAL, BARK, LEAVES, GLASS, PLAIN = range(13)

_CHUNK = 1 << 16  # points measured together
LAPS = 2
ROOMS = 8
PITCH = 4.0  # metres from room to room

_HALF = (5.0, 3.6)  # metres, half sizes of the outer walls
_WIDTH = 1.8
_HEIGHT = 2.6
_RADIUS = 0.7  # metres, radius of the path round a corner


@dataclass(frozen=True)
class SyntheticCamera:
    """Pinhole camera of a synthetic recording; `baseline` in metres, for stereo."""

    size: tuple[int, int]  # height, width
    intrinsics: Intrinsics
    baseline: float


@dataclass(frozen=True, eq=False)
class World:
    """A synthetic world: its solids, the sensor's paths, and the usual sensor."""

    name: str
    solids: Solids  # (m, 12) float64, metres
    # `paths[name](index, count)` → (4, 4) T_world_camera, OpenCV axes; the first is the usual one
    paths: dict[str, Callable[[int, int], NDArray[np.float64]]]
    # Frames on the whole usual path at walking speed: close enough for a scanner to follow
    steps: int = 40
    sensor: str = "kinect"
    camera: SyntheticCamera = SyntheticCamera((240, 320), Intrinsics(292.5, 292.5, 159.5, 119.5), 0.12)

    def distance(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the signed distance to the nearest surface: (n, 3) metres → (n,) float64, negative inside.

        It is exact outside solids, and inside where solids do not overlap.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        result = np.full(len(points), np.inf)
        for start in range(0, len(points), _CHUNK):
            part = slice(start, start + _CHUNK)
            for solid in self.solids:
                np.minimum(result[part], _distance(solid, points[part]), out=result[part])
        return result

    def near(self, position: NDArray[np.float64], reach: float) -> Solids:
        """Return the solids with a part within `reach` metres of `position`."""
        half = np.linalg.norm(self.solids[:, 4:7], axis=1)
        away = np.linalg.norm(self.solids[:, 1:4] - position, axis=1) - half
        endless = np.isin(self.solids[:, 0], (ROOM, GROUND))
        return np.ascontiguousarray(self.solids[endless | (away < reach)])


def room(name: str = "room") -> World:
    """Return a 4×4×2.8 m room with a sphere, a box and a column. The usual path is a closed circle.

    Three variants are hard for trackers: `room-untextured` (one colour everywhere), `room-plain` (walls of
    one colour), `room-bare` (only coloured walls: one to three planes in view).
    """
    walls = solid(ROOM, (0, 0, 1.4), (2, 2, 1.4), INTERIOR)
    things = [
        solid(SPHERE, (0.6, 0.3, 0.5), (0.5, 0.5, 0.5), MARBLE),
        solid(BOX, (-0.7, 0.6, 0.4), (0.4, 0.3, 0.4), WOOD),
        solid(CYLINDER, (0, -0.8, 0.6), (0.15, 0.15, 0.6), STRIPES),
    ]
    solids = np.array([walls] if name == "room-bare" else [walls, *things])
    if name == "room-untextured":
        solids[:, 9] = PLAIN
    elif name == "room-plain":
        solids[0, 9] = PLAIN
    return World(name, solids, {"circle": _circle, "tour": _tour, "handheld": _handheld})


def street(length: float = 80.0, *, seed: int = 20) -> World:
    """Return a street along x: road, pavements, facades, parked cars, lamp posts, trees and bins.

    It is built piece by piece from x = -16 m on: a longer street starts like a shorter one.
    """
    rng = {side: np.random.default_rng(seed + side) for side in (-1, 1)}
    solids = [
        solid(GROUND, (0, 0, 0), (0, 0, 0), ROAD),
        solid(BOX, (length / 2, 7.5, 0.0), (length / 2 + 200, 3.0, 0.14), PAVEMENT),
        solid(BOX, (length / 2, -7.5, 0.0), (length / 2 + 200, 3.0, 0.14), PAVEMENT),
    ]
    for side in (-1, 1):
        solids += _houses(rng[side], side, length)
        solids += _kerbside(rng[side], side, length)
    camera = SyntheticCamera((188, 620), Intrinsics(353.5, 353.5, 309.5, 91.5), 0.54)
    return World("street", np.array(solids), {"drive": _drive}, camera=camera)


def solid(
    kind: int,
    center: tuple[float, ...],
    half: tuple[float, ...],
    material: int,
    *,
    yaw: float = 0.0,
    variant: int = 0,
    top: float = 1.0,
) -> list[float]:
    """Return one row, 12 numbers, of the table of solids. `center`, `half`: centre and half sizes, metres."""
    return [kind, *center, *half, np.cos(yaw), np.sin(yaw), material, variant, top]


def look_at(position: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (4, 4) T_world_camera at `position` with the optical axis through `target`; z is up."""
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return se3.transform(np.stack([right, np.cross(forward, right), forward], axis=1), position)


def _circle(index: int, count: int) -> NDArray[np.float64]:
    angle = 2.5 + 2 * np.pi * index / count
    position = np.array([0.9 * np.cos(angle), 0.9 * np.sin(angle), 1.5])
    return look_at(position, np.array([1.2 * np.cos(angle - 2.5), 1.2 * np.sin(angle - 2.5), 0.6]))


def _tour(index: int, count: int) -> NDArray[np.float64]:
    """Return a pose of three rounds through the room: objects, foot of the walls, upper walls."""
    first, second = 2 * count // 5, 7 * count // 10
    start, end = next(part for part in ((0, first), (first, second), (second, count)) if index < part[1])
    angle = 2.5 + 2 * np.pi * (index - start) / (end - start)
    toward = np.array([np.cos(angle), np.sin(angle), 0.0])
    wall = 2 * toward / np.abs(toward).max()
    if index < first:
        height, ahead = ((1.1, 0.0), (2.1, 0.7))[index % 2]  # the things, and the floor behind them
        return look_at(1.66 * toward + (0, 0, height), ahead * toward + (0, 0, 0.4))
    if index < second:
        return look_at(0.8 * toward + (0, 0, 2.1), wall + (0, 0, 0.4))
    return look_at(0.03 * toward + (0, 0, 1.31), wall + (0, 0, 1.7))


def _handheld(index: int, _count: int) -> NDArray[np.float64]:
    """Return a pose of a walking person's camera at ten frames a second: 0.4 m/s, 20 to 40 degrees/s."""
    t = index * 0.1
    angle = 2.5 + 0.4 * t + 0.12 * np.sin(0.9 * t)
    radius = 0.9 + 0.15 * np.sin(0.7 * t + 1)
    position = np.array([radius * np.cos(angle), radius * np.sin(angle), 1.5 + 0.12 * np.sin(1.1 * t)])
    sway = 0.12 * np.sin([1.7 * t, 1.3 * t + 0.5, 1.9 * t + 2])
    target = np.array([1.2 * np.cos(angle - 2.5), 1.2 * np.sin(angle - 2.5), 0.6]) + sway
    T, roll = look_at(position, target), 0.07 * np.sin(0.8 * t)
    turned = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    T[:3, :3] = T[:3, :3] @ turned
    return T


def _drive(index: int, count: int) -> NDArray[np.float64]:
    """Return a pose of a car in the right lane: one metre for each keyframe, with a slight sway."""
    x = float(index)
    position = np.array([x, -1.15 + 0.25 * np.sin(0.11 * x), 1.65 + 0.02 * np.sin(0.7 * x)])
    ahead = np.array([x + 10, -1.15 + 0.25 * np.sin(0.11 * (x + 10)), 1.6 + 0.03 * np.sin(0.9 * x)])
    return look_at(position, ahead)


# Annotations with `np.random` are quoted: the bare name would load the module, which takes 2 MB.
def _houses(rng: "np.random.Generator", side: int, length: float) -> list[list[float]]:
    """Return rows of the table of solids: houses side by side with some alleys, door steps, balconies."""
    solids, x, number = [], -16.0, 0
    while x < length + 60:
        width, height, front = rng.uniform(7, 13), rng.uniform(6.5, 12.0), rng.uniform(8.6, 9.4)
        number += 1
        middle = x + width / 2
        solids.append(
            solid(
                BOX,
                (middle, side * (front + 4), height / 2),
                (width / 2, 4, height / 2),
                FACADE,
                variant=number,
            )
        )
        solids.append(solid(BOX, (middle, side * (front - 0.25), 0.1), (0.8, 0.25, 0.25), PAVEMENT))
        if rng.uniform() < 0.6:
            solids.append(solid(BOX, (middle, side * (front - 0.4), 3.35), (1.3, 0.4, 0.5), METAL))
        x += width + (rng.uniform(2.0, 3.5) if rng.uniform() < 0.3 else 0.0)
    return solids


def _kerbside(rng: "np.random.Generator", side: int, length: float) -> list[list[float]]:
    """Return rows of the table of solids: parked cars, and on the pavement posts, trees and bins in turn."""
    solids, x, number = [], -13.0, 0
    while x < length + 50:
        number += 1
        if rng.uniform() < 0.7:
            solids += _car(rng, x, side * 3.45, number)
        along = x + rng.uniform(2.6, 3.4)
        if number % 3 == 0:
            solids.append(solid(CYLINDER, (along, side * 4.9, 2.6), (0.08, 0.08, 2.6), METAL))
            solids.append(solid(BOX, (along, side * 4.4, 5.15), (0.12, 0.55, 0.06), METAL))
        elif number % 3 == 1:
            crown = rng.uniform(0.9, 1.35)
            solids.append(solid(CYLINDER, (along, side * 5.4, 1.3), (0.15, 0.15, 1.3), BARK))
            solids.append(solid(SPHERE, (along, side * 5.4, 2.2 + crown), (crown,) * 3, LEAVES))
        else:
            solids.append(
                solid(BOX, (along, side * 6.6, 0.65), (0.5, 0.35, 0.55), PAINT, variant=90 + number)
            )
        x += rng.uniform(5.6, 7.5)
    return solids


def _car(rng: "np.random.Generator", x: float, y: float, number: int) -> list[list[float]]:
    yaw = rng.normal(0, 0.025)
    long, wide = rng.uniform(1.95, 2.3), rng.uniform(0.82, 0.9)
    body = solid(BOX, (x, y, 0.53), (long, wide, 0.33), PAINT, yaw=yaw, variant=number)
    cabin = solid(BOX, (x - 0.25, y, 1.12), (0.52 * long, 0.88 * wide, 0.27), GLASS, yaw=yaw)
    roof = solid(BOX, (x - 0.25, y, 1.42), (0.5 * long, 0.86 * wide, 0.03), PAINT, yaw=yaw, variant=number)
    return [body, cabin, roof]


def _distance(row: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    kind, half, (cosine, sine) = int(row[0]), row[4:7], row[7:9]
    p = points - row[1:4]
    p = np.stack([cosine * p[:, 0] + sine * p[:, 1], cosine * p[:, 1] - sine * p[:, 0], p[:, 2]], axis=1)
    q = np.abs(p) - half
    if kind == CYLINDER:
        q = np.stack([np.hypot(p[:, 0], p[:, 1]) - half[0], q[:, 2]], axis=1)
    elif kind == AXLE:
        q = np.stack([np.hypot(p[:, 0], p[:, 2]) - half[0], q[:, 1]], axis=1)
    elif kind == PRISM:
        q = np.stack([_trapezoid(np.abs(p[:, 0]), p[:, 2], half, row[11]), q[:, 1]], axis=1)
    result: NDArray[np.float64] = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    if kind == GROUND:
        result = p[:, 2]
    elif kind == SPHERE:
        result = np.linalg.norm(p, axis=1) - half[0]
    elif kind == ROOM:
        result = -q.max(axis=1)
    return result


def _trapezoid(
    x: NDArray[np.float64], z: NDArray[np.float64], half: NDArray[np.float64], top: float
) -> NDArray[np.float64]:
    """Return the signed distance to a trapezoid symmetric in x, at x >= 0, with half sizes `half` below."""
    length = half[0] * np.where(z < 0, 1.0, top)
    ends = np.stack([x - np.minimum(x, length), np.abs(z) - half[2]])
    corner = np.array([half[0] * top, half[2]])
    side = np.array([half[0] * (top - 1), 2 * half[2]])
    share = np.clip((corner[0] - x) * side[0] + (corner[1] - z) * side[1], 0, side @ side) / (side @ side)
    slope = np.stack([x - corner[0] + side[0] * share, z - corner[1] + side[1] * share])
    away = np.sqrt(np.minimum((ends**2).sum(axis=0), (slope**2).sum(axis=0)))
    result: NDArray[np.float64] = np.where((slope[0] < 0) & (ends[1] < 0), -away, away)
    return result


def ring() -> World:
    """Return a corridor 1.8 m wide around a block of 6.4×3.6 m. The path `laps` goes round twice, 26 m each.

    The second lap is a little more to the side, and looks in a slightly different direction.
    """
    rng = np.random.default_rng(40)
    inner = (_HALF[0] - _WIDTH, _HALF[1] - _WIDTH)
    solids = [
        solid(ROOM, (0, 0, _HEIGHT / 2), (*_HALF, _HEIGHT / 2), INTERIOR),
        solid(BOX, (0, 0, _HEIGHT / 2), (*inner, _HEIGHT / 2), FACADE, variant=3),
    ]
    for outward, half in ((1, _HALF), (-1, inner)):
        for side in range(4):
            solids += _along_a_wall(rng, side, half, outward)
    return World("corridor", np.array(solids), {"laps": _laps}, steps=520)


def rooms(*, identical: bool = True) -> World:
    """Return eight rooms of 4 m in a row with wide doorways; if `identical`, equal to the last pixel.

    The path `walk` passes all rooms and looks at their long wall. `return` also comes back, with the same
    view.
    """
    rng = np.random.default_rng(41)
    module = _room(rng)
    solids = [solid(ROOM, ((ROOMS - 1) * PITCH / 2, 0, 1.3), (ROOMS * PITCH / 2 + 1, 3, 1.6), INTERIOR)]
    for number in range(ROOMS):
        shifted = np.array(module if identical else _room(np.random.default_rng(50 + number)))
        shifted[:, 1] += number * PITCH
        solids += shifted.tolist()
    name = "rooms" if identical else "distinct rooms"
    return World(name, np.array(solids), {"walk": _walk, "return": _return}, steps=160)


def _along_a_wall(
    rng: "np.random.Generator", side: int, half: tuple[float, float], outward: int
) -> list[list[float]]:
    """Return solids at one wall of the ring: panels, pictures, cupboards, columns, all of different size."""
    turn = side * np.pi / 2
    length, away = (half[1], half[0]) if side % 2 == 0 else (half[0], half[1])
    solids, at = [], -length + 0.3
    while at < length - 0.6:
        wide, deep, high = rng.uniform(0.25, 0.55), rng.uniform(0.02, 0.12), rng.uniform(0.25, 0.6)
        kind = int(rng.integers(0, 5))
        middle = at + wide
        material = (PAINT, MARBLE, WOOD, STRIPES, FACADE)[kind]
        up = rng.uniform(1.2, 1.7) if kind != 2 else high
        distance = away - outward * deep
        center = _turned(turn, distance, middle, up)
        if kind == 3:
            radius = rng.uniform(0.06, 0.1)
            center = _turned(turn, away - outward * radius, middle, high)
            solids.append(solid(CYLINDER, center, (radius, radius, high), material))
        else:
            size = (deep, wide, high)
            variant = int(rng.integers(1, 90))
            solids.append(solid(BOX, center, size, material, yaw=turn, variant=variant))
        at = middle + wide + rng.uniform(0.15, 0.5)
    return solids


def _room(rng: "np.random.Generator") -> Solids:
    """Return the solids of one room around x = 0: floor, ceiling, walls, doorway and furniture."""
    half = PITCH / 2
    solids = [
        solid(BOX, (0, 0, -0.1), (half, 2, 0.1), PAVEMENT),
        solid(BOX, (0, 0, 2.6), (half, 2, 0.1), WOOD),
        solid(BOX, (0, 2.1, 1.2), (half, 0.2, 1.3), FACADE, variant=int(rng.integers(1, 60))),
        solid(BOX, (0, -2.1, 1.2), (half, 0.2, 1.3), MARBLE),
        solid(BOX, (half - 0.1, 1.6, 1.2), (0.1, 0.4, 1.3), WOOD),
        solid(BOX, (half - 0.1, -1.6, 1.2), (0.1, 0.4, 1.3), WOOD),
    ]
    for _ in range(7):  # pictures at the long wall
        at = (rng.uniform(-1.6, 1.6), 1.88, rng.uniform(0.7, 2.1))
        size = (rng.uniform(0.1, 0.3), 0.03, rng.uniform(0.1, 0.25))
        material = (PAINT, MARBLE, METAL)[int(rng.integers(0, 3))]
        solids.append(solid(BOX, at, size, material, variant=int(rng.integers(1, 90))))
    for _ in range(3):  # cupboards below
        at = (rng.uniform(-1.6, 1.2), 1.6, 0.3)
        size = (rng.uniform(0.15, 0.35), 0.28, rng.uniform(0.2, 0.35))
        solids.append(solid(BOX, at, size, WOOD, variant=1))
    ball = rng.uniform(0.15, 0.3)
    solids.append(solid(SPHERE, (rng.uniform(-1, 1), 1.2, ball), (ball,) * 3, MARBLE))
    return np.array(solids)


def _turned(turn: float, forward: float, left: float, up: float) -> tuple[float, float, float]:
    cosine, sine = float(np.cos(turn)), float(np.sin(turn))
    return (cosine * forward - sine * left, sine * forward + cosine * left, up)


def _laps(index: int, count: int) -> NDArray[np.float64]:
    """Return a pose on the corridor's middle, counter-clockwise, with a view ahead and slightly down."""
    progress = LAPS * index / count
    lap, share = divmod(progress, 1.0)
    here, ahead = _centre(share), _centre(share + 0.045)
    direction = (ahead - here) / np.linalg.norm(ahead - here)
    left = np.array([-direction[1], direction[0]])
    sway = 0.06 * np.sin(9 * progress) + 0.12 * lap
    position = np.array([*(here + sway * left), 1.35 + 0.03 * np.sin(23 * progress)])
    target = np.array([*(ahead - (0.1 + 0.2 * lap) * left), 1.15])
    return look_at(position, target)


def _centre(share: float) -> NDArray[np.float64]:
    """Return the (2,) point at `share` of a lap on the corridor's middle line, which has round corners."""
    a, b = (half - _WIDTH / 2 - _RADIUS for half in _HALF)
    arc = _RADIUS * np.pi / 2
    way = (share % 1.0) * (4 * (a + b) + 4 * arc)
    for turn, (along, across) in enumerate(((b, a), (a, b), (b, a), (a, b))):
        cosine, sine = np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)
        if way <= 2 * along:
            x, y = across + _RADIUS, way - along
        elif way <= 2 * along + arc:
            angle = (way - 2 * along) / _RADIUS
            x, y = across + _RADIUS * np.cos(angle), along + _RADIUS * np.sin(angle)
        else:
            way -= 2 * along + arc
            continue
        return np.array([cosine * x - sine * y, sine * x + cosine * y])
    return _centre(0.0)


def _walk(index: int, count: int) -> NDArray[np.float64]:
    """Return a pose on a walk along x, with a view of the left wall and slightly ahead."""
    x = -PITCH / 4 + (ROOMS - 0.5) * PITCH * index / count
    phase = 2 * np.pi * x / PITCH  # equal in every room
    position = np.array([x, -0.6 + 0.1 * np.sin(phase), 1.35 + 0.02 * np.cos(phase)])
    return look_at(position, position + (1.0, 2.0 + 0.3 * np.sin(phase), -0.3))


def _return(index: int, count: int) -> NDArray[np.float64]:
    there = (count + 1) // 2
    if index < there:
        return _walk(index, there)
    T = _walk(count - 1 - index, there)
    T[:3, 3] += (0.05, 0.1, 0.03)
    return T
