# SPDX-License-Identifier: MIT
"""A desk in an office, after CoRBS' scene Desk 1, and the path of a hand that films it from around."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.worlds.synthetic import Synthetic
from tsfusion.datasets.worlds.worlds import (
    AXLE,
    BOX,
    CYLINDER,
    FACADE,
    INTERIOR,
    LEAVES,
    MARBLE,
    METAL,
    PAINT,
    PRISM,
    ROOM,
    SPHERE,
    STRIPES,
    WOOD,
    SyntheticCamera,
    World,
    look_at,
    solid,
)
from tsfusion.geometry.keyframe import Intrinsics

CAMERA = SyntheticCamera((480, 640), Intrinsics(468.60, 468.61, 318.27, 243.99), 0.12)  # CoRBS'
TOP = 0.74  # metres, of the desk
STEPS = 600  # frames of the whole path, at ten a second


class Desk(Synthetic):
    """Keyframes of the desk, with the options of `Synthetic`; its usual sensor is `tof`."""

    def __init__(
        self,
        world: str = "desk",
        sensor: str | None = None,
        *,
        count: int | None = None,
        seed: int = 0,
        noise: bool = True,
        width: int | None = None,
        color: bool = True,
        path: str | None = None,
    ) -> None:
        if world != "desk":
            raise DatasetError(f"world must be desk, got {world!r}")
        super().__init__(
            desk(), sensor, count=count, seed=seed, noise=noise, width=width, color=color, path=path
        )


def desk() -> World:
    """A 5×4.4×2.6 m room with a desk, what lies and stands on it, a chair, drawers and a shelf."""
    rows = [
        solid(ROOM, (0, 0.3, 1.3), (2.5, 2.2, 1.3), INTERIOR),
        solid(BOX, (0, 0.5, TOP - 0.015), (0.8, 0.4, 0.015), WOOD),
        *(
            solid(BOX, (x, y, 0.36), (0.025, 0.025, 0.365), METAL)
            for x in (-0.75, 0.75)
            for y in (0.15, 0.85)
        ),
        solid(BOX, (0.52, 0.52, 0.3), (0.2, 0.28, 0.3), PAINT, variant=12),
        *_on_the_desk(),
        *_chair(-0.2, 0.05, 0.3),
        *_shelf(),
    ]
    return World("desk", np.array(rows), {"hand": _hand}, steps=STEPS, sensor="tof", camera=CAMERA)


def _on_the_desk() -> list[list[float]]:
    """A screen, keyboard, mouse, books, cups, a lamp, a plant, boxes and a globe."""
    rng, rows = np.random.default_rng(51), []
    rows += [
        solid(BOX, (-0.1, 0.72, TOP + 0.27), (0.29, 0.018, 0.175), FACADE, yaw=0.08, variant=5),
        solid(BOX, (-0.1, 0.75, TOP + 0.06), (0.03, 0.02, 0.06), METAL),
        solid(CYLINDER, (-0.1, 0.74, TOP + 0.008), (0.12, 0.12, 0.008), METAL),
        solid(BOX, (-0.12, 0.36, TOP + 0.012), (0.22, 0.07, 0.012), STRIPES, yaw=0.05),
        solid(PRISM, (0.2, 0.36, TOP + 0.015), (0.055, 0.03, 0.015), PAINT, yaw=1.4, variant=7, top=0.6),
        solid(CYLINDER, (0.36, 0.28, TOP + 0.05), (0.04, 0.04, 0.05), STRIPES),
        solid(CYLINDER, (-0.5, 0.3, TOP + 0.06), (0.035, 0.035, 0.06), MARBLE),
        solid(SPHERE, (0.6, 0.3, TOP + 0.1), (0.1, 0.1, 0.1), MARBLE),
        solid(CYLINDER, (-0.66, 0.74, TOP + 0.015), (0.08, 0.08, 0.015), METAL),
        solid(CYLINDER, (-0.66, 0.74, TOP + 0.25), (0.012, 0.012, 0.24), METAL),
        solid(SPHERE, (-0.66, 0.66, TOP + 0.48), (0.07, 0.07, 0.07), PAINT, variant=31),
        solid(CYLINDER, (0.64, 0.74, TOP + 0.07), (0.07, 0.07, 0.07), WOOD),
        solid(AXLE, (0.3, 0.5, TOP + 0.03), (0.03, 0.1, 0.03), STRIPES, yaw=0.6),
    ]
    for _ in range(9):
        x, y, z = rng.normal((0.64, 0.74, TOP + 0.24), (0.05, 0.05, 0.06))
        size = float(rng.uniform(0.03, 0.07))
        rows.append(solid(SPHERE, (x, y, z), (size, size, size), LEAVES))
    height = TOP
    for number in range(5):  # a pile of books
        thick = rng.uniform(0.012, 0.022)
        center = (0.42 + rng.normal(0, 0.008), 0.72 + rng.normal(0, 0.008), height + thick)
        half = (rng.uniform(0.07, 0.09), rng.uniform(0.1, 0.13), thick)
        rows.append(solid(BOX, center, half, PAINT, yaw=rng.normal(0.2, 0.2), variant=40 + number))
        height += 2 * thick
    for number, (x, y) in enumerate(((-0.42, 0.55), (-0.62, 0.45), (0.08, 0.24))):
        half = (rng.uniform(0.05, 0.09), rng.uniform(0.03, 0.06), rng.uniform(0.01, 0.09))
        material = (MARBLE, WOOD, PAINT)[number]
        center = (x, y, TOP + half[2])
        rows.append(solid(BOX, center, half, material, yaw=rng.uniform(0, 3), variant=60 + number))
    return rows


def _chair(x: float, y: float, yaw: float) -> list[list[float]]:
    """An office chair: five feet, a column, a seat and a back."""
    rows = [
        solid(CYLINDER, (x, y, 0.25), (0.03, 0.03, 0.2), METAL),
        solid(BOX, (x, y, 0.46), (0.24, 0.23, 0.035), STRIPES, yaw=yaw),
        solid(BOX, (x + 0.25 * np.sin(yaw), y - 0.25 * np.cos(yaw), 0.74), (0.21, 0.03, 0.2), PAINT, yaw=yaw,
              variant=22),
    ]  # fmt: skip
    for foot in range(5):
        turn = yaw + foot * 2 * np.pi / 5
        center = (x + 0.15 * np.cos(turn), y + 0.15 * np.sin(turn), 0.05)
        rows.append(solid(BOX, center, (0.15, 0.025, 0.02), METAL, yaw=turn))
    return rows


def _shelf() -> list[list[float]]:
    """A shelf of books at the wall behind the desk, and pictures."""
    rng, rows = np.random.default_rng(52), []
    for z in (1.45, 1.85):
        rows.append(solid(BOX, (0.9, 2.37, z), (0.7, 0.13, 0.012), WOOD))
        x = 0.22
        while x < 1.5:
            wide, high = rng.uniform(0.012, 0.035), rng.uniform(0.09, 0.15)
            center = (x + wide, 2.38, z + 0.012 + high)
            rows.append(solid(BOX, center, (wide, 0.1, high), PAINT, variant=int(rng.integers(1, 900))))
            x += 2 * wide + (0.0 if rng.uniform() < 0.8 else rng.uniform(0.02, 0.12))
    rows.append(solid(BOX, (-1.1, 2.48, 1.5), (0.4, 0.02, 0.28), MARBLE))
    rows.append(solid(BOX, (2.1, 1.2, 0.5), (0.38, 0.5, 0.5), WOOD))
    rows.append(solid(SPHERE, (2.1, 1.2, 1.15), (0.15, 0.15, 0.15), STRIPES))
    return rows


def _hand(index: int, count: int) -> NDArray[np.float64]:
    """From side to side in front of the desk, near and far, looking at it with an unsteady hand."""
    t = STEPS * index / count * 0.1
    swing = 1.15 * np.sin(0.21 * t)
    away = 1.25 + 0.35 * np.sin(0.13 * t + 1)
    position = np.array([away * np.sin(swing), 0.5 - away * np.cos(swing), 1.3 + 0.25 * np.sin(0.29 * t + 2)])
    sway = 0.05 * np.sin([1.7 * t, 1.3 * t + 0.5, 1.9 * t + 2])
    target = np.array([0.25 * np.sin(0.37 * t), 0.55, TOP + 0.1]) + sway
    T, roll = look_at(position, target), 0.06 * np.sin(0.8 * t)
    turned = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    T[:3, :3] = T[:3, :3] @ turned
    return T
