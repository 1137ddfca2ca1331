# SPDX-License-Identifier: MIT
"""Compute camera views of a map, the point that the pointer's ray hits, and the map's up direction."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import up_direction
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import SensorPosture, Up
from tsfusion.viewer.map.clipping import Clipping
from tsfusion.viewer.map.map_tiles import MapTiles, Tile
from tsfusion.wire.asking.followed_map import PathsFound, ScannerSeen

FOV = math.radians(50)  # from top to bottom of the picture
_ELEVATION = math.radians(42)
_SIDES = 12  # directions tried around the map
_SAMPLE = 20  # points per tile
_SHARE = (0.5, 99.5)  # percentiles of the coordinates that the picture must contain
_FILLED = 0.92  # share of the picture that the map fills
_MOST_VIEWS = 16  # cached views of the whole map, one for each window shape
_FIRST = 2000  # triangles at which the search for up starts
_LESS = 0.985  # cosine of 10°: only a larger change of the up direction counts


class PageCamera(NamedTuple):
    """Camera of a browser: its position and its target, both (3,) metres, and its up direction."""

    position: NDArray[np.float64]
    target: NDArray[np.float64]
    up: NDArray[np.float64]


class ShownPoint(NamedTuple):
    points: NDArray[np.float64]
    normals: NDArray[np.float64]


def sample(tiles: MapTiles) -> ShownPoint:
    """Return some vertices of each tile, in proportion to its triangles, to choose a view with."""
    meshes = [tile.mesh for tile in list(tiles.tiles.values())]
    total = sum(len(mesh.vertices) for mesh in meshes)
    step = max(1, total // (_SAMPLE * max(len(meshes), 50)))
    if not meshes:
        return ShownPoint(np.zeros((0, 3)), np.zeros((0, 3)))
    points = np.concatenate([mesh.vertices[::step] for mesh in meshes]).astype(np.float64)
    return ShownPoint(points, np.concatenate([mesh.normals[::step] for mesh in meshes]).astype(np.float64))


def whole(
    surface: ShownPoint, up: NDArray[np.float64], aspect: float, *, covered: float = 0.0
) -> PageCamera | None:
    """Return a camera above the map, on the side from which most surface is seen; None for an empty map.

    Args:
        aspect: width / height of the picture.
        covered: share of the picture's height that is hidden at its lower end.
    """
    if len(surface.points) < 3:
        return None
    east = np.cross(up, (1.0, 0, 0) if abs(up[0]) < 0.7 else (0.0, 1, 0))
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    turns = 2 * np.pi * np.arange(_SIDES) / _SIDES
    level = np.cos(turns)[:, None] * east + np.sin(turns)[:, None] * north
    toward = math.cos(_ELEVATION) * level + math.sin(_ELEVATION) * up  # from the target to the camera
    best = np.maximum(surface.normals @ toward.T, 0).sum(axis=0).argmax()
    return _fitted(surface.points, (toward[best], up), aspect, covered)


class WholeViews:
    """Cache of cameras that show the whole map; `refresh` clears it after changes."""

    def __init__(self, tiles: MapTiles) -> None:
        self._tiles = tiles
        self._up: NDArray[np.float64] = np.array((0.0, 0.0, 1.0))
        self._version = -1
        self._sample: ShownPoint | None = None
        self._views: dict[tuple[float, float], PageCamera] = {}

    def forget(self) -> None:
        self._sample = None
        self._views.clear()

    def refresh(self, up: NDArray[np.float64]) -> None:
        """Clear the cache if the tiles, or the up direction, have changed."""
        if self._version != self._tiles.version or not np.array_equal(up, self._up):
            self._up, self._version = up, self._tiles.version
            self.forget()

    def of(self, aspect: float, covered: float) -> PageCamera | None:
        """Return the camera of `whole`; None is not cached, so that the first surface is shown at once."""
        view = self._views.get((aspect, covered))
        if view is None:
            if self._sample is None or not len(self._sample.points):
                self._sample = sample(self._tiles)
            view = whole(self._sample, self._up, aspect, covered=covered)
            if view is not None:
                if len(self._views) >= _MOST_VIEWS:  # a window has many shapes while it is resized
                    self._views.clear()
                self._views[aspect, covered] = view
        return view


def _fitted(
    points: NDArray[np.float64],
    directions: tuple[NDArray[np.float64], NDArray[np.float64]],
    aspect: float,
    covered: float,
) -> PageCamera:
    """Return the nearest camera with this direction that has nearly all points in its picture."""
    toward, up = directions
    right = np.cross(up, toward)
    right /= np.linalg.norm(right)
    above = np.cross(toward, right)
    low, high = np.percentile(points, _SHARE, axis=0)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    points = inside if len(inside) > 2 else points
    x, y, z = points @ right, points @ above, points @ toward
    tall = _FILLED * math.tan(FOV / 2)
    # A camera at (cx, cy, d) sees points with −first (d − z) ≤ x − cx ≤ last (d − z), likewise for y
    sides = [(x, tall * aspect, tall * aspect), (y, tall * (1 - 2 * covered), tall)]
    ends = [((p - first * z).min(), (p + last * z).max(), first, last) for p, first, last in sides]
    d = max((high - low) / (first + last) for low, high, first, last in ends)
    cx, cy = ((low + first * d + high - last * d) / 2 for low, high, first, last in ends)
    middle = float(np.median(z))
    target = cx * right + cy * above + middle * toward
    return PageCamera(target + (d - middle) * toward, target, up)


def behind(T_world_camera: NDArray[np.float64], up: NDArray[np.float64], *, distance: float) -> PageCamera:
    """Return a camera behind and above a scanner, which looks in the scanner's direction.

    Args:
        T_world_camera: (4, 4), OpenCV axes.
        distance: metres.
    """
    position, forward = T_world_camera[:3, 3], T_world_camera[:3, 2]
    level = forward - (forward @ up) * up
    length = float(np.linalg.norm(level))
    level = level / length if length > 0.1 else -T_world_camera[:3, 1]
    return PageCamera(position - distance * level + 0.7 * distance * up, position + distance * level, up)


def first_hit(
    tiles: MapTiles, clipping: Clipping, origin: NDArray[np.float64], direction: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the (3,) nearest shown point at which a ray hits the front of the surface; None without a hit.

    `origin` and `direction`: (3,) of the ray, in the map's frame.
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
    """Return the distance at which a ray enters a box; infinity = never."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (bounds - origin) / direction
    ends = np.where(np.isnan(ends), np.array((-np.inf, np.inf))[:, None], ends)
    enters, leaves = float(ends.min(axis=0).max()), float(ends.max(axis=0).min())
    return max(enters, 0.0) if leaves >= max(enters, 0.0) else np.inf


def _hits(tile: Tile, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return distances at which a ray hits front sides of triangles, nearest first (Möller, Trumbore)."""
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


class MapUp:
    def __init__(self) -> None:
        self.up: Up | None = None
        self._is_given = False
        self._held = SensorPosture()
        self._looked_at = 0  # number of triangles at the last search

    @property
    def direction(self) -> NDArray[np.float64]:
        """Up direction of the map, (3,) unit vector; +z while it is unknown."""
        return np.array((0.0, 0.0, 1.0) if self.up is None else self.up.direction)

    def note_scanner(self, event: ScannerSeen) -> None:
        """Count how the sensor of a new keyframe was held, for the estimate."""
        if not self._held.is_known:
            self._looked_at = 0  # earlier results lacked attitudes
        self._held.add(event.T_world_camera, "lidar" if event.intrinsics is None else "camera")

    def note_paths(self, event: PathsFound) -> None:
        """Replace the counts of how sensors were held by those of all keyframes of the map."""
        if event.held is not None and event.held.is_known:
            self._held = SensorPosture(event.held.numbers)
            self._looked_at = 0  # earlier results lacked attitudes

    def note_given(self, up: Up | None) -> None:
        """Use the up direction that is stored with the map."""
        if up is not None:
            self.up, self._is_given = up, True

    def look(self, tiles: MapTiles) -> None:
        """Estimate the up direction again if the map has doubled since the last time."""
        if self._is_given or (count := tiles.triangles) < max(_FIRST, 2 * self._looked_at):
            return
        self._looked_at = count
        found = up_direction.find(_some_triangles(tiles, count), self._held)
        if found is not None and (self.up is None or self.direction @ found.direction < _LESS):
            self.up = found


def _some_triangles(tiles: MapTiles, count: int) -> Mesh:
    """Return a mesh of some triangles from all tiles, each with its own vertices."""
    step = max(1, count // up_direction.SAMPLE)
    corners, normals = [], []
    for tile in tiles.tiles.values():
        faces = tile.mesh.faces[::step].ravel()
        corners.append(tile.mesh.vertices[faces])
        normals.append(tile.mesh.normals[faces])
    vertices = np.concatenate(corners)
    return Mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), np.concatenate(normals))
