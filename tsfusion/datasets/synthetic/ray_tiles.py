# SPDX-License-Identifier: MIT
"""Tiles of a sensor's rays, and which solids each tile may meet: most of a world is elsewhere."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.synthetic.worlds import GROUND, ROOM, Solids

TILE = 16  # rays along a side
# Metres by which a solid's ball is widened: around a point that is met, solids as near as this dim the light
# (`daylight`), and rounding is far below the rest.
WIDER = 0.6

Floats = NDArray[np.float64]
Indices = NDArray[np.int32]


class RayTiles:
    """Cones around the tiles of a grid of rays.

    Args:
        directions: (H·W, 3) float64 of the rays, row by row, in the sensor's axes.
        shape: (H, W).
    """

    def __init__(self, directions: Floats, shape: tuple[int, int]) -> None:
        rows, columns = np.mgrid[: shape[0], : shape[1]] // TILE
        self.tile_of: Indices = (rows * (columns.max() + 1) + columns).ravel().astype(np.int32)
        rays = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        count = int(self.tile_of.max()) + 1
        axes = np.stack([np.bincount(self.tile_of, rays[:, k], count) for k in range(3)], axis=1)
        self._axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        cosines = np.ones(count)
        np.minimum.at(cosines, self.tile_of, (rays * self._axes[self.tile_of]).sum(axis=1))
        self._angles: Floats = np.arccos(np.clip(cosines, -1, 1))  # half of the cones' opening, radians

    def lists(self, T_world_sensor: Floats, solids: Solids) -> tuple[Indices, Indices]:
        """(starts, listed) of `cast`: tile t may meet the solids listed[starts[t] : starts[t + 1]].

        Args:
            solids: (m, 12), as of a world.
        """
        away = solids[:, 1:4] - T_world_sensor[:3, 3]
        distance = np.linalg.norm(away, axis=1)
        radius = np.linalg.norm(solids[:, 4:7], axis=1) + WIDER
        beyond = np.maximum(distance, radius)
        ball = np.arcsin(radius / beyond)  # half of the angle under which it is seen
        cosines = (self._axes @ T_world_sensor[:3, :3].T) @ (away / beyond[:, None]).T
        meets = np.arccos(np.clip(cosines, -1, 1)) <= self._angles[:, None] + ball
        meets |= (distance <= radius) | np.isin(solids[:, 0], (ROOM, GROUND))
        starts = np.concatenate([[0], np.cumsum(meets.sum(axis=1))]).astype(np.int32)
        listed = np.nonzero(meets)[1].astype(np.int32)
        return starts, listed if len(listed) else np.zeros(1, np.int32)
