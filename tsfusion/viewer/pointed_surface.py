# SPDX-License-Identifier: MIT
"""The point of a map's surface that a ray of a browser's pointer meets."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.viewer.clipping import Clipping
from tsfusion.viewer.map_tiles import MapTiles, Tile


def first_hit(
    tiles: MapTiles, clipping: Clipping, origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """(3,) the nearest point of what is shown of the front of a surface; None = the ray meets none.

    Args:
        origin, direction: (3,) of the ray, in the map's frame.
    """
    direction = direction / np.linalg.norm(direction)
    nearest, found = np.inf, None
    entries = [(_entry(tile.bounds, origin, direction), tile) for tile in list(tiles.tiles.values())]
    for entry, tile in sorted(entries, key=lambda one: one[0]):
        if entry >= nearest or not np.isfinite(entry):
            break
        for distance in _hits(tile, origin, direction):
            point = origin + distance * direction
            if distance < nearest and clipping.shows(point[None])[0]:
                nearest, found = distance, point
                break
    return found


def _entry(bounds: NDArray[np.float32], origin: NDArray[np.float64], direction: NDArray[np.float64]) -> float:
    """Where a ray comes into a box; infinity where it does not."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (bounds - origin) / direction
    ends = np.where(np.isnan(ends), np.array((-np.inf, np.inf))[:, None], ends)
    enters, leaves = float(ends.min(axis=0).max()), float(ends.max(axis=0).min())
    return max(enters, 0.0) if leaves >= max(enters, 0.0) else np.inf


def _hits(tile: Tile, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distances at which a ray meets front sides of triangles, the nearest first (Möller and Trumbore)."""
    a, b, c = tile.mesh.vertices[tile.mesh.faces].astype(np.float64).transpose(1, 0, 2)
    ab, ac = b - a, c - a
    p = np.cross(direction, ac)
    facing = (ab * p).sum(axis=1)
    front = facing > 1e-12
    scale = 1 / np.where(front, facing, 1.0)
    t = origin - a
    u = (t * p).sum(axis=1) * scale
    q = np.cross(t, ab)
    v = (q @ direction) * scale
    distance = (ac * q).sum(axis=1) * scale
    grain = 1e-9
    met = front & (u >= -grain) & (v >= -grain) & (u + v <= 1 + grain) & (distance > 0)
    found: NDArray[np.float64] = np.sort(distance[met])
    return found
