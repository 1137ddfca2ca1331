# SPDX-License-Identifier: MIT
"""Worlds for loop closure: a corridor around a block, walked twice, and a row of rooms all alike."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.worlds import worlds
from tsfusion.datasets.worlds.worlds import Solids, World, look_at, solid

LAPS = 2
ROOMS = 8
PITCH = 4.0  # metres from room to room

_HALF = (5.0, 3.6)  # metres, of the outer walls
_WIDTH = 1.8
_HEIGHT = 2.6
_RADIUS = 0.7  # of the way round a corner


def ring() -> World:
    """A corridor 1.8 m wide around a block of 6.4×3.6 m; `laps` goes round it twice, 26 m each.

    The second lap keeps a little more to the side and looks a little elsewhere.
    """
    rng = np.random.default_rng(40)
    inner = (_HALF[0] - _WIDTH, _HALF[1] - _WIDTH)
    solids = [
        solid(worlds.ROOM, (0, 0, _HEIGHT / 2), (*_HALF, _HEIGHT / 2), worlds.INTERIOR),
        solid(worlds.BOX, (0, 0, _HEIGHT / 2), (*inner, _HEIGHT / 2), worlds.FACADE, variant=3),
    ]
    for outward, half in ((1, _HALF), (-1, inner)):
        for side in range(4):
            solids += _along_a_wall(rng, side, half, outward)
    return World("corridor", np.array(solids), {"laps": _laps}, steps=520)


def rooms(*, identical: bool = True) -> World:
    """Eight rooms of 4 m in a row with wide doorways between; where `identical`, equal to the last pixel.

    Path `walk` passes them all and looks at their long wall; `return` comes back, looking the same way.
    """
    rng = np.random.default_rng(41)
    module = _room(rng)
    solids = [
        solid(
            worlds.ROOM, ((ROOMS - 1) * PITCH / 2, 0, 1.3), (ROOMS * PITCH / 2 + 1, 3, 1.6), worlds.INTERIOR
        )
    ]
    for number in range(ROOMS):
        shifted = np.array(module if identical else _room(np.random.default_rng(50 + number)))
        shifted[:, 1] += number * PITCH
        solids += shifted.tolist()
    name = "rooms" if identical else "distinct rooms"
    return World(name, np.array(solids), {"walk": _walk, "return": _return}, steps=160)


def _along_a_wall(
    rng: "np.random.Generator", side: int, half: tuple[float, float], outward: int
) -> list[list[float]]:
    """Things at one wall of the ring: panels, pictures, cupboards and columns, no two of equal size."""
    turn = side * np.pi / 2
    length, away = (half[1], half[0]) if side % 2 == 0 else (half[0], half[1])
    solids, at = [], -length + 0.3
    while at < length - 0.6:
        wide, deep, high = rng.uniform(0.25, 0.55), rng.uniform(0.02, 0.12), rng.uniform(0.25, 0.6)
        kind = int(rng.integers(0, 5))
        middle = at + wide
        material = (worlds.PAINT, worlds.MARBLE, worlds.WOOD, worlds.STRIPES, worlds.FACADE)[kind]
        up = rng.uniform(1.2, 1.7) if kind != 2 else high
        distance = away - outward * deep
        center = _turned(turn, distance, middle, up)
        if kind == 3:
            radius = rng.uniform(0.06, 0.1)
            center = _turned(turn, away - outward * radius, middle, high)
            solids.append(solid(worlds.CYLINDER, center, (radius, radius, high), material))
        else:
            size = (deep, wide, high)
            variant = int(rng.integers(1, 90))
            solids.append(solid(worlds.BOX, center, size, material, yaw=turn, variant=variant))
        at = middle + wide + rng.uniform(0.15, 0.5)
    return solids


def _room(rng: "np.random.Generator") -> Solids:
    """One room around x = 0: floor, ceiling, walls, a doorway at its end, and furniture."""
    half = PITCH / 2
    solids = [
        solid(worlds.BOX, (0, 0, -0.1), (half, 2, 0.1), worlds.PAVEMENT),
        solid(worlds.BOX, (0, 0, 2.6), (half, 2, 0.1), worlds.WOOD),
        solid(worlds.BOX, (0, 2.1, 1.2), (half, 0.2, 1.3), worlds.FACADE, variant=int(rng.integers(1, 60))),
        solid(worlds.BOX, (0, -2.1, 1.2), (half, 0.2, 1.3), worlds.MARBLE),
        solid(worlds.BOX, (half - 0.1, 1.6, 1.2), (0.1, 0.4, 1.3), worlds.WOOD),
        solid(worlds.BOX, (half - 0.1, -1.6, 1.2), (0.1, 0.4, 1.3), worlds.WOOD),
    ]
    for _ in range(7):  # pictures at the long wall
        at = (rng.uniform(-1.6, 1.6), 1.88, rng.uniform(0.7, 2.1))
        size = (rng.uniform(0.1, 0.3), 0.03, rng.uniform(0.1, 0.25))
        material = (worlds.PAINT, worlds.MARBLE, worlds.METAL)[int(rng.integers(0, 3))]
        solids.append(solid(worlds.BOX, at, size, material, variant=int(rng.integers(1, 90))))
    for _ in range(3):  # cupboards below
        at = (rng.uniform(-1.6, 1.2), 1.6, 0.3)
        size = (rng.uniform(0.15, 0.35), 0.28, rng.uniform(0.2, 0.35))
        solids.append(solid(worlds.BOX, at, size, worlds.WOOD, variant=1))
    ball = rng.uniform(0.15, 0.3)
    solids.append(solid(worlds.SPHERE, (rng.uniform(-1, 1), 1.2, ball), (ball,) * 3, worlds.MARBLE))
    return np.array(solids)


def _turned(turn: float, forward: float, left: float, up: float) -> tuple[float, float, float]:
    cosine, sine = float(np.cos(turn)), float(np.sin(turn))
    return (cosine * forward - sine * left, sine * forward + cosine * left, up)


def _laps(index: int, count: int) -> NDArray[np.float64]:
    """Counter-clockwise along the middle of the corridor, looking ahead and a little down."""
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
    """(2,) point of the corridor's middle line, a rectangle with round corners; `share` of a lap."""
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
    """Along x, looking at the wall on the left and a little ahead."""
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
