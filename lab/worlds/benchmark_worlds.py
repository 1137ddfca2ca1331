# SPDX-License-Identifier: MIT
"""Worlds for accuracy benchmarks: corners and edges, thin parts, two more paths in the room."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.worlds import worlds
from tsfusion.datasets.worlds.worlds import (
    BOX,
    CYLINDER,
    INTERIOR,
    METAL,
    ROOM,
    WOOD,
    World,
    look_at,
    solid,
)

THIN = 0.03  # metres: legs, rod and plate; 1.5 voxels of 2 cm


def room() -> World:
    """The room of `Synthetic`, with two more paths: `wander`, and `still` (the same view every time)."""
    known = worlds.room()
    return World(known.name, known.solids, {**known.paths, "wander": _wander, "still": _still})


def corners() -> World:
    """Stairs, a turned box on another, and a gap of 6 cm between two: convex and concave edges."""
    solids = [solid(ROOM, (0, 0, 1.4), (2.4, 2.4, 1.4), INTERIOR)]
    for step in range(4):
        solids.append(solid(BOX, (0.2 * step, 0.6, 0.1 * (step + 1)), (0.1, 0.3, 0.1 * (step + 1)), WOOD))
    solids += [
        solid(BOX, (-0.6, -0.3, 0.2), (0.3, 0.3, 0.2), WOOD, yaw=0.3),
        solid(BOX, (-0.6, -0.3, 0.5), (0.15, 0.15, 0.1), METAL, yaw=1.0),
        solid(BOX, (0.35, -0.5, 0.3), (0.12, 0.2, 0.3), WOOD),
        solid(BOX, (0.65, -0.5, 0.3), (0.12, 0.2, 0.3), WOOD),
    ]
    return World("corners", np.array(solids), {"around": _around})


def thin() -> World:
    """A table on thin legs, a thin rod, and a thin plate that is seen from both sides."""
    half = THIN / 2
    solids = [
        solid(ROOM, (0, 0, 1.4), (2.4, 2.4, 1.4), INTERIOR),
        solid(BOX, (0, 0.35, 0.72), (0.5, 0.35, half), WOOD),
        solid(BOX, (0.1, -0.7, 0.35), (0.35, half, 0.35), METAL, yaw=0.4),
        solid(CYLINDER, (-0.8, -0.4, 0.5), (half, half, 0.5), METAL),
    ]
    for x in (-0.45, 0.45):
        for y in (0.05, 0.65):
            solids.append(solid(BOX, (x, y, 0.3525), (half, half, 0.3525), WOOD))
    return World("thin", np.array(solids), {"around": _around})


def _around(index: int, count: int) -> NDArray[np.float64]:
    """A circle around the middle, high and low by turns."""
    angle = 2 * np.pi * index / count
    position = np.array([1.7 * np.cos(angle), 1.7 * np.sin(angle), (0.6, 1.5)[index % 2]])
    return look_at(position, np.array([0.0, 0.0, 0.4]))


def _wander(index: int, count: int) -> NDArray[np.float64]:
    """A figure of eight above the things, at changing heights, looking down and around."""
    t = 2 * np.pi * index / count
    position = np.array([1.2 * np.sin(t), 0.9 * np.sin(2 * t), 1.75 + 0.35 * np.cos(3 * t)])
    return look_at(position, np.array([1.3 * np.cos(t + 2.2), 1.3 * np.sin(2 * t + 0.9), 0.45]))


def _still(index: int, count: int) -> NDArray[np.float64]:
    """The circle's first view: the sphere, the column and the floor between them."""
    path: NDArray[np.float64] = worlds.room().paths["circle"](0, 40)
    return path
