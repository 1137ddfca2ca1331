# SPDX-License-Identifier: MIT
"""Ground of a street along a path: a road with kerbs, the same wherever the path goes twice."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

KERB = 4.4  # metres from the course
STEP = 0.13  # metres from the road up to the pavement
MARGIN = 70.0  # metres of ground around the course
HEIGHT_CELL, APART_CELL, SHADE_CELL = 4.0, 0.5, 0.25  # metres
APART_REACH = 40.0  # metres; farther places count as being so far
NODE = 0.5  # metres between the course's nodes
_SMOOTH = 4.0  # metres over which heights of several passes are averaged


@dataclass(frozen=True, eq=False)
class RoadGround:
    """Height of the ground, and how far every place is from the course; z is up.

    Attributes:
        course: (n, 3) metres: x, y and arc length of the path, a node every half metre.
        heights: (a, b) metres, of the road; bilinear between nodes.
        apart: (c, d) float32 metres from the course; bilinear between nodes.
        nearest: (c, d) int32, the nearest node of the course.
        shade: (e, f) uint8, light on the ground: `cast_shadow` takes it away.
        layout: (8,) as `street_raycast.cast_view` wants it.
    """

    course: Floats
    heights: Floats
    apart: NDArray[np.float32]
    nearest: NDArray[np.int32]
    layout: Floats
    shade: NDArray[np.uint8] = field(repr=False)

    @staticmethod
    def along(path: Floats) -> "RoadGround":
        """Ground of a path: (n, 3) metres, places on the road in the order of driving."""
        course = _resampled(path)
        low = course[:, :2].min(axis=0) - MARGIN
        cells = np.ceil((course[:, :2].max(axis=0) + MARGIN - low) / HEIGHT_CELL).astype(int)
        heights = _heights(course, low, cells[::-1] + 1)
        size = cells * round(HEIGHT_CELL / APART_CELL) + 1
        apart, nearest = _apart(course, low, size[::-1])
        slope = max(np.abs(np.diff(heights, axis=axis)).max() for axis in (0, 1)) / HEIGHT_CELL * np.sqrt(2)
        layout = np.array([*low, HEIGHT_CELL, APART_CELL, SHADE_CELL, KERB, STEP, slope + 0.01])
        shade = np.full(cells[::-1] * round(HEIGHT_CELL / SHADE_CELL) + 1, 255, dtype=np.uint8)
        arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(course[:, :2], axis=0), axis=1))])
        return RoadGround(np.column_stack([course[:, :2], arc]), heights, apart, nearest, layout, shade)

    def height(self, points: Floats) -> Floats:
        """Height of the road below places (n, 2 or 3): (n,) metres."""
        return _bilinear(self.heights, (points[:, :2] - self.layout[:2]) / HEIGHT_CELL)

    def away(self, points: Floats) -> Floats:
        """Distance of places (n, 2 or 3) from the course: (n,) metres, at most 40."""
        return _bilinear(self.apart, (points[:, :2] - self.layout[:2]) / APART_CELL)

    def distance(self, points: Floats) -> Floats:
        """Signed distance to the ground: (n, 3) metres → (n,), positive above.

        Exact across kerbs on level, straight ground; the error by slopes and bends is below a percent.
        """
        above, beyond = points[:, 2] - self.height(points), self.away(points) - KERB
        east, north = (
            (self.height(points + shift) - self.height(points - shift)) / 0.2
            for shift in (np.array([0.1, 0, 0]), np.array([0, 0.1, 0]))
        )
        above = above / np.sqrt(1 + east**2 + north**2)
        below_top = above - STEP
        outside = np.where(
            beyond < 0,
            np.minimum(above, np.hypot(beyond, np.maximum(below_top, 0))),
            below_top,
        )
        inside = np.where(beyond < 0, -above, np.minimum(-below_top, np.hypot(beyond, np.minimum(above, 0))))
        solid = np.where(beyond < 0, above < 0, below_top < 0)
        return np.where(solid, -inside, outside)

    def cast_shadow(self, corners: Floats, dark: float) -> None:
        """Darken the ground within the convex hull of places (n, 2) metres; `dark` from 0 to 1."""
        fine = (corners - self.layout[:2]) / SHADE_CELL
        hull = cv2.convexHull(np.rint(fine * 16).astype(np.int32))
        low, high = np.floor(fine.min(axis=0)).astype(int) - 2, np.ceil(fine.max(axis=0)).astype(int) + 3
        low, high = np.maximum(low, 0), np.minimum(high, np.array(self.shade.shape)[::-1])
        if (low >= high).any():
            return
        part = self.shade[low[1] : high[1], low[0] : high[0]]
        mask = np.zeros(part.shape, dtype=np.uint8)
        cv2.fillConvexPoly(mask, hull - (16 * low)[None, None].astype(np.int32), 255, shift=4)
        light = 1 - dark * cv2.GaussianBlur(mask, (3, 3), 0).astype(np.float32) / 255
        np.minimum(part, (255 * light).astype(np.uint8), out=part)


def _resampled(path: Floats) -> Floats:
    """(n, 3) nodes half a metre apart; where the path stands still it counts once."""
    step = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    kept = np.concatenate([[True], step > 0.05])
    path = path[kept]
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1))])
    at = np.linspace(0, arc[-1], max(2, round(arc[-1] / NODE) + 1))
    return np.stack([np.interp(at, arc, path[:, axis]) for axis in range(3)], axis=1)


def _heights(course: Floats, low: Floats, size: NDArray[np.int64]) -> Floats:
    """Mean height of the course, weighted by nearness, at every node."""
    y, x = np.mgrid[: size[0], : size[1]] * HEIGHT_CELL
    result = np.empty(size)
    for row in range(size[0]):
        places = np.stack([x[row] + low[0], y[row] + low[1]], axis=1)
        square = ((places[:, None] - course[None, ::2, :2]) ** 2).sum(axis=2)
        weight = 1 / (square + _SMOOTH**2) ** 2
        result[row] = (weight @ course[::2, 2]) / weight.sum(axis=1)
    return result


def _apart(
    course: Floats, low: Floats, size: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Distance of every node from the course, and the course's nearest node."""
    apart = np.full(size, APART_REACH, dtype=np.float32)
    nearest = np.zeros(size, dtype=np.int32)
    reach = round(APART_REACH / APART_CELL)
    for k, (a, b) in enumerate(zip(course[:-1, :2], course[1:, :2], strict=True)):
        i, j = np.rint((a - low) / APART_CELL).astype(int)
        rows, columns = slice(max(j - reach, 0), j + reach + 1), slice(max(i - reach, 0), i + reach + 1)
        y, x = np.ogrid[rows.start : min(rows.stop, size[0]), columns.start : min(columns.stop, size[1])]
        px, py = x * APART_CELL + low[0] - a[0], y * APART_CELL + low[1] - a[1]
        dx, dy = b - a
        share = np.clip((px * dx + py * dy) / (dx * dx + dy * dy), 0, 1)
        away = np.hypot(px - share * dx, py - share * dy)
        closer = away < apart[rows, columns]
        apart[rows, columns][closer] = away[closer]
        nearest[rows, columns][closer] = k
    return apart, nearest


def _bilinear(grid: NDArray[np.floating], at: Floats) -> Floats:
    """Values of a grid between its nodes, at (n, 2) of x, y in cells; the border's beyond it."""
    x, y = (np.clip(at[:, k], 0, grid.shape[1 - k] - 1) for k in (0, 1))
    i, j = (np.minimum(np.floor(v).astype(int), grid.shape[1 - k] - 2) for k, v in ((0, x), (1, y)))
    a, b = x - i, y - j
    low = grid[j, i] * (1 - a) + grid[j, i + 1] * a
    high = grid[j + 1, i] * (1 - a) + grid[j + 1, i + 1] * a
    result: Floats = low * (1 - b) + high * b
    return result
