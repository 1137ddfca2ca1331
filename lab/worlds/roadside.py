# SPDX-License-Identifier: MIT
"""Things beside a street along a path: houses, parked cars, trees, lamps, signs, hedges, fences, bins.

The path is walked once. Whatever is put down must leave room around every part of the path and must not stand
in what is there already: a path that comes back finds its own street again.
"""

import numpy as np
from numpy.typing import NDArray

from lab.worlds.road_ground import KERB, STEP, Floats, RoadGround
from tsfusion.datasets.worlds.worlds import AXLE, BOX, CYLINDER, PRISM, SPHERE, Solids, solid

# As in worlds/kernels/street_things.py
HOUSE, TILES, BODY, CABIN, TYRE, POLE, TRUNK, CROWN, HEDGE, SIGN, FENCE, BIN = range(20, 32)
SUNK = 2.0  # metres of a house below the ground
SUN = np.array([0.42, 0.56, 0.714])  # direction to it

HOUSE_CLEARANCE, CAR_CLEARANCE, CLEARANCE = 7.4, 2.3, 4.6  # metres from the path
_CELL = 0.25  # metres, of the raster of taken places
_SHADOW = 0.8  # of the light that a shadow takes

Rows = list[list[float]]


def roadside(ground: RoadGround, seed: int) -> Solids:
    """The solids along a course; casts their shadows on the ground."""
    plot = _Plot(ground, np.random.default_rng(seed))
    for row in (0, 1):
        for side in (-1, 1):
            plot.houses(side, row)
    for side in (-1, 1):
        plot.parked(side)
    for side in (-1, 1):
        plot.kerbside(side)
        plot.gardens(side)
    plot.woods()
    return np.array(plot.rows)


class _Plot:
    """A street that is being furnished."""

    def __init__(self, ground: RoadGround, rng: "np.random.Generator") -> None:
        self.rows: Rows = []
        self._ground, self._rng, self._number = ground, rng, 0
        self._taken = np.zeros(ground.shade.shape, dtype=bool)
        self._low = ground.layout[:2]

    def houses(self, side: int, row: int) -> None:
        """Houses side by side, with alleys and gardens between; the second row higher and farther away."""
        rng, at, end = self._rng, 0.0, self._ground.course[-1, 2]
        while at < end:
            wide, deep = rng.uniform(8, 16) * (1 + 0.5 * row), rng.uniform(8, 11)
            front = rng.uniform(8.4, 10.5) if row == 0 else rng.uniform(26, 34)
            for back in (0.0, 2.5, 5.0):
                place = self._beside(at + wide / 2, side * (front + back + deep / 2))
                if self._free(place, (wide / 2 + 0.3, deep / 2), HOUSE_CLEARANCE if row == 0 else 20.0):
                    self._house(place, wide, deep, rng.uniform(5.5, 9.5) + 5 * row * rng.uniform())
                    at += wide
                    gap = rng.uniform()
                    at += 0.7 if gap < 0.45 else rng.uniform(2.5, 4.5) if gap < 0.8 else rng.uniform(7, 14)
                    break
            else:
                at += 1.5

    def parked(self, side: int) -> None:
        """Cars at the kerb in short rows, heading as the traffic does."""
        rng, at, end = self._rng, 4.0, self._ground.course[-1, 2]
        while at < end:
            if rng.uniform() < 0.3:
                at += rng.uniform(6, 36)  # nobody parks here
            place = self._beside(at, side * (KERB - 1.05), yaw=rng.normal(0, 0.02) + np.pi * (side > 0))
            if self._free(place, (2.4, 0.95), CAR_CLEARANCE, least_road=False):
                self._car(place)
            at += rng.uniform(5.3, 6.8)

    def kerbside(self, side: int) -> None:
        """Lamps, trees, signs, bollards and bins on the pavement next to the kerb."""
        rng, at, end, turn = self._rng, 2.0, self._ground.course[-1, 2], 0
        while at < end:
            turn += 1
            place = self._beside(at, side * (KERB + rng.uniform(0.45, 0.9)))
            if self._free(place, (0.3, 0.3), CLEARANCE):
                kind = rng.uniform()
                if turn % 4 == 0:
                    self._lamp(place, side)
                elif kind < 0.5:
                    self._tree(place, rng.uniform(0.75, 1.15))
                elif kind < 0.75:
                    self._sign(place, side)
                elif kind < 0.9:
                    self._bollards(place)
                else:
                    self._bin(place)
            at += rng.uniform(4.0, 7.5)

    def gardens(self, side: int) -> None:
        """Hedges, fences, low walls, shrubs and bins between pavement and houses, and trees behind."""
        rng, at, end = self._rng, 0.0, self._ground.course[-1, 2]
        while at < end:
            long = rng.uniform(2.0, 6.5)
            place = self._beside(at + long / 2, side * (KERB + rng.uniform(2.7, 3.0)))
            if self._free(place, (long / 2, 0.35), KERB + 2.2):
                kind = rng.uniform()
                if kind < 0.7:
                    self._border(place, long, (HEDGE, FENCE, 0)[int(kind / 0.24) % 3])
                elif kind < 0.85:
                    self._bin(place)
                else:
                    self._shrub(place)
            place = self._beside(at + rng.uniform(0, 4), side * rng.uniform(10, 22))
            if rng.uniform() < 0.5 and self._free(place, (0.8, 0.8), 8.0):
                self._tree(place, rng.uniform(1.0, 1.9))
            at += long + rng.uniform(0.3, 2.5)

    def woods(self) -> None:
        """Trees far behind the houses, where gaps show them."""
        course = self._ground.course
        for _ in range(int(course[-1, 2] / 6)):
            at, away = self._rng.uniform(0, course[-1, 2]), self._rng.uniform(20, 55)
            place = self._beside(at, away * self._rng.choice((-1, 1)))
            if self._free(place, (1.5, 1.5), 16.0):
                self._tree(place, self._rng.uniform(1.6, 2.8))

    def _beside(self, arc: float, left: float, *, yaw: float = 0.0) -> Floats:
        """(x, y, yaw) beside the course, heading along it."""
        course = self._ground.course
        here, ahead = (
            np.array([np.interp(a, course[:, 2], course[:, k]) for k in (0, 1)]) for a in (arc - 1, arc + 1)
        )
        along = (ahead - here) / max(np.linalg.norm(ahead - here), 1e-9)
        x, y = (here + ahead) / 2 + left * np.array([-along[1], along[0]])
        return np.array([x, y, np.arctan2(along[1], along[0]) + yaw])

    def _free(
        self, place: Floats, half: tuple[float, float], clearance: float, *, least_road: bool = True
    ) -> bool:
        """Take a rectangle if nothing stands there and it is clear of the path."""
        x, y = (np.arange(-h, h + 0.2, 0.2).clip(-h, h) for h in half)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        points = place[:2] + grid @ _turn(place[2]).T
        away = self._ground.away(points)
        cells = np.rint((points - self._low) / _CELL).astype(int)
        inside = (cells >= 0).all() and (cells < np.array(self._taken.shape)[::-1]).all()
        if not inside or away.min() < clearance or (not least_road and away.max() > KERB + 0.1):
            return False
        if self._taken[cells[:, 1], cells[:, 0]].any():
            return False
        self._taken[cells[:, 1], cells[:, 0]] = True
        self._number += 1
        return True

    def _add(
        self, kind: int, place: Floats, local: tuple[float, float, float], half: tuple[float, float, float],
        material: int, *, yaw: float = 0.0, top: float = 1.0, shadow: bool = True,
    ) -> None:  # fmt: skip
        """Add a solid at `local` metres from a place; `local[2]` above the pavement there."""
        x, y = place[:2] + _turn(place[2]) @ local[:2]
        base = float(self._ground.height(place[None, :2])[0])
        turned = float(place[2] + yaw)
        z = base + STEP + local[2]
        row = solid(kind, (x, y, z), half, material, yaw=turned, variant=self._number, top=top)
        self.rows.append(row)
        if shadow:
            flat = np.array([(a * half[0], b * half[1]) for a in (-1, 1) for b in (-1, 1)])
            if kind in (SPHERE, CYLINDER):
                flat = half[0] * np.array([(np.cos(t), np.sin(t)) for t in np.arange(0, 6.28, 0.52)])
            foot = np.array([x, y]) + flat @ _turn(turned).T
            ends = [foot - SUN[:2] / SUN[2] * max(local[2] + e * half[2], 0.0) for e in (-1, 1)]
            self._ground.cast_shadow(np.concatenate(ends), _SHADOW)

    def _house(self, place: Floats, wide: float, deep: float, high: float) -> None:
        half_high = (high + SUNK) / 2
        self._add(BOX, place, (0, 0, high - half_high), (wide / 2, deep / 2, half_high), HOUSE)
        if self._rng.uniform() < 0.75:  # a roof whose ridge runs along the street
            pitch = deep * self._rng.uniform(0.28, 0.42)
            half = (deep / 2 + 0.35, wide / 2 + 0.15, pitch / 2)
            self._add(PRISM, place, (0, 0, high + pitch / 2), half, TILES, yaw=np.pi / 2, top=0.02)
            chimney = (self._rng.uniform(-0.3, 0.3) * wide, 0.15 * deep, high + pitch * 0.8)
            self._add(BOX, place, chimney, (0.3, 0.3, 0.9), HOUSE, shadow=False)
        if wide > 10 and self._rng.uniform() < 0.5:  # balconies to the street
            outward = -np.sign(float((place[:2] - self._nearest(place)) @ _turn(place[2])[:, 1]))
            for storey in (3.2, 6.0):
                if storey < high - 2:
                    local = (wide * 0.22, outward * (deep / 2 + 0.45), storey)
                    self._add(BOX, place, local, (1.3, 0.45, 0.5), FENCE)

    def _nearest(self, place: Floats) -> Floats:
        column, row = np.rint((place[:2] - self._low) / self._ground.layout[3]).astype(int)
        found: Floats = self._ground.course[self._ground.nearest[row, column], :2]
        return found

    def _car(self, place: Floats) -> None:
        rng, drop = self._rng, -STEP
        long, wide, high = rng.uniform(1.8, 2.3), rng.uniform(0.8, 0.9), rng.uniform(0.29, 0.36)
        self._add(PRISM, place, (0, 0, drop + 0.2 + high), (long, wide, high), BODY, top=0.96)
        van = rng.uniform() < 0.25
        cabin = (long * (0.92 if van else 0.66), 0.93 * wide, 0.42 if van else 0.3)
        local = (-0.06 * long if van else -0.14 * long, 0.0, drop + 0.2 + 2 * high + cabin[2])
        self._add(PRISM, place, local, cabin, CABIN, top=0.82 if van else 0.64)
        for end in (-0.62, 0.62):
            self._add(
                AXLE, place, (end * long, 0, drop + 0.31), (0.31, wide + 0.015, 0.31), TYRE, shadow=False
            )

    def _lamp(self, place: Floats, side: int) -> None:
        high = self._rng.uniform(5.0, 7.5)
        self._add(CYLINDER, place, (0, 0, high / 2 - 0.2), (0.075, 0.075, high / 2 + 0.2), POLE)
        self._add(BOX, place, (0, -side * 0.5, high), (0.09, 0.6, 0.05), POLE, shadow=False)

    def _sign(self, place: Floats, side: int) -> None:
        high = self._rng.uniform(2.2, 2.8)
        self._add(CYLINDER, place, (0, 0, high / 2 - 0.1), (0.035, 0.035, high / 2 + 0.1), POLE)
        size = self._rng.uniform(0.25, 0.38)
        turned = float(self._rng.normal(np.pi / 2, 0.15))
        self._add(BOX, place, (-0.05, 0, high - size), (size, 0.02, size), SIGN, yaw=turned)

    def _bollards(self, place: Floats) -> None:
        for along in (-1.4, 0.0, 1.4):
            self._add(CYLINDER, place, (along, 0, 0.4), (0.06, 0.06, 0.5), POLE)

    def _bin(self, place: Floats) -> None:
        for along in (-0.35, 0.35)[: 1 + int(self._rng.uniform() < 0.5)]:
            self._add(BOX, place, (along, 0, 0.5), (0.29, 0.31, 0.55), BIN)

    def _border(self, place: Floats, long: float, material: int) -> None:
        high = {HEDGE: self._rng.uniform(0.8, 1.7), FENCE: self._rng.uniform(0.8, 1.3)}.get(material, 0.6)
        thick = {HEDGE: 0.32, FENCE: 0.04}.get(material, 0.14)
        self._add(BOX, place, (0, 0, high / 2 - 0.2), (long / 2, thick, high / 2 + 0.2), material)

    def _shrub(self, place: Floats) -> None:
        for _ in range(3):
            size = self._rng.uniform(0.3, 0.6)
            local = (*self._rng.uniform(-0.4, 0.4, 2), size * 0.8)
            self._add(SPHERE, place, local, (size, size, size), CROWN)

    def _tree(self, place: Floats, size: float) -> None:
        rng = self._rng
        trunk = size * rng.uniform(1.9, 2.7)
        self._add(CYLINDER, place, (0, 0, trunk / 2), (0.1 * size, 0.1 * size, trunk / 2 + 0.5), TRUNK)
        for k in range(14):  # the largest in the middle, smaller ones around it
            share = rng.uniform()
            ball = size * (0.8 if k == 0 else rng.uniform(0.22, 0.52))
            turn, out = (
                2.4 * k + rng.uniform(0, 0.8),
                size * rng.uniform(0.55, 0.95) * np.sin(2.6 * share + 0.3),
            )
            up = trunk + size * (1.0 if k == 0 else 0.25 + 1.9 * share)
            local = (out * np.cos(turn) * (k > 0), out * np.sin(turn) * (k > 0), up)
            self._add(SPHERE, place, local, (ball, ball, ball), CROWN)


def _turn(yaw: float) -> NDArray[np.float64]:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
