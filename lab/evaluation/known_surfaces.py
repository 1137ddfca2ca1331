# SPDX-License-Identifier: MIT
"""Known surfaces (worlds of solids, reference meshes), and the error of a mesh against one."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from lab.evaluation import surface_error
from lab.worlds.street_drive import StreetDrive, StreetWorld
from tsfusion.core.errors import MissingDependency
from tsfusion.datasets.worlds.worlds import BOX, CYLINDER, GROUND, ROOM, Solids, World
from tsfusion.evaluation.surface_fit import nearest
from tsfusion.geometry import se3
from tsfusion.geometry.mesh import Mesh

COMPLETE_WITHIN = 1.5  # voxels
MOST_NORMALS = 50_000  # of evenly chosen vertices
EDGE_REACH = 2.0  # voxels: what counts as near an edge
_CIRCLE = 24  # segments of a cylinder's rim
_STEP = 1e-5  # metres, of the distance's gradient
_ON_SURFACE = 1e-3  # metres: nearer points count as on the surface
_COLUMN = 4.0  # metres: the side of the columns of points that are measured together


class KnownSurface(Protocol):
    """A surface whose place is known, and the part of it that cameras saw."""

    seen: NDArray[np.float64]  # (n, 3) float64 metres, evenly spread points of the part that was seen
    # (m, 2, 3) float64 metres, segments where it bends sharply; empty where they are not known
    edges: NDArray[np.float64]

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) metres from points (n, 3); the sign, where there is one, is + outside."""
        ...

    def normals(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 3) outward directions of the surface nearest to points (n, 3), of any length."""
        ...


class WorldSurface:
    """Surface of a synthetic world.

    Args:
        seen: (n, 3) metres, points near the surface; they are moved onto it.
        edges: measure edges too; False where there are too many of them.
    """

    def __init__(self, world: World, seen: NDArray[np.float64], *, edges: bool = True) -> None:
        self._world = world
        self.edges = edges_of(world) if edges else np.empty((0, 2, 3))
        self.seen = seen.copy()
        off = np.flatnonzero(np.abs(away := self.distance(seen)) > _ON_SURFACE)
        self.seen[off] -= away[off, None] * self.normals(seen[off])

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The world's distance, but of each column of points only to the solids that can be nearest."""
        world = self._world
        if isinstance(world, StreetWorld):
            world, points = replace(world, upright=None), world.turned(points)
        result = np.empty(len(points))
        column = np.floor(points[:, :2] / _COLUMN).astype(np.int64) @ (1 << 20, 1)
        order = np.argsort(column, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(column[order])) + 1):
            if len(part):
                near = replace(world, solids=_candidates(world.solids, points[part]))
                result[part] = near.distance(points[part])
        return result

    def normals(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        slope = [self.distance(points + axis) - self.distance(points - axis) for axis in _STEP * np.eye(3)]
        return np.stack(slope, axis=1) / (2 * _STEP)


class ReferenceSurface:
    """A reference mesh; a distance is measured to the triangle of the nearest of many samples.

    Args:
        measured: (n, 3) metres, points measured on it. What lies within `reach` metres of one was seen, by
            one point a cube of that size.

    Raises:
        MissingDependency: without scipy.
    """

    def __init__(
        self,
        vertices: NDArray[np.float64],
        faces: NDArray[np.int64],
        measured: NDArray[np.float64],
        *,
        reach: float,
        samples: int = 400_000,
    ) -> None:
        import trimesh

        self._mesh = trimesh.Trimesh(vertices, faces, process=False)
        self._samples, self._face = trimesh.sample.sample_surface(self._mesh, samples, seed=0)
        near = nearest(self._samples, measured)[0] <= reach
        self.seen = surface_error.one_per_cell(self._samples[near], reach)
        self.edges = np.empty((0, 2, 3))

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        import trimesh

        triangles = self._mesh.triangles[self._nearest(points)]
        on_face = trimesh.triangles.closest_point(triangles, points)
        result: NDArray[np.float64] = np.linalg.norm(points - on_face, axis=1)
        return result

    def normals(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        result: NDArray[np.float64] = self._mesh.face_normals[self._nearest(points)]
        return result

    def _nearest(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """(n,) index of the face that holds the nearest sample."""
        face: NDArray[np.int64] = self._face[nearest(points, self._samples)[1]]
        return face


def drive_surface(
    drive: StreetDrive, frames: Iterable[int], *, voxel_size: float, max_range: float
) -> WorldSurface:
    """Surface of a street, and the part of it within `max_range` metres of the cameras of some frames.

    What was seen has one point a cell of 1.5 voxels in which one image has at least two pixels. The drive's
    width decides how far that is; its noise does not matter.
    """
    cell, K = COMPLETE_WITHIN * voxel_size, drive.intrinsics
    v, u = np.mgrid[: drive.size[0], : drive.size[1]]
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(u.shape)], axis=-1)
    found = [np.empty((0, 3))]
    for index in frames:
        depth = drive.depth(index)
        near = (depth > 0) & (depth < max_range)
        T = drive.pose(index)
        assert T is not None
        points = se3.apply(T, rays[near] * depth[near, None])
        found.append(surface_error.one_per_cell(points, cell, at_least=2))
    seen = surface_error.one_per_cell(np.concatenate(found), cell)
    return WorldSurface(drive.world, seen, edges=False)


def measure(mesh: Mesh, truth: KnownSurface, voxel_size: float) -> dict[str, Any]:
    """Every figure of a mesh against a known surface: millimetres, percent, degrees; None for NaN.

    - `accuracy_mm`: |distance| of the vertices from the surface; `precision`: within 1 voxel of it.
    - `completeness`: of the surface seen, what has a vertex within 1.5 voxels; `f_score` of the two.
    - `normal_deg`: angle between the normals of the vertices and of the surface.
    - `edge_mm`: mean |distance| of the vertices within 2 voxels of an edge, `edge_completeness` likewise.

    Completeness is None without scipy.
    """
    vertices = mesh.vertices.astype(np.float64)
    distance = truth.distance(vertices)
    some = slice(None, None, 1 + len(vertices) // MOST_NORMALS)
    angle = surface_error.angles(mesh.normals[some], truth.normals(vertices[some]))
    angle = angle if len(angle) else np.array([np.nan])
    found: dict[str, Any] = {
        "vertices": len(vertices),
        "accuracy_mm": msgspec.structs.asdict(surface_error.spread_mm(distance)),
        "precision": surface_error.percent_within(distance, voxel_size),
        "normal_deg": {"median": float(np.median(angle)), "mean": float(angle.mean())},
    }
    reach = EDGE_REACH * voxel_size
    near_edge = surface_error.segment_distance(vertices, truth.edges) <= reach
    found["edge_mm"] = surface_error.spread_mm(distance[near_edge]).mean
    try:
        missed, _ = nearest(truth.seen, vertices)
    except MissingDependency:
        return rounded(found)
    complete = COMPLETE_WITHIN * voxel_size
    found["completeness"] = surface_error.percent_within(missed, complete)
    found["f_score"] = surface_error.f_score(found["precision"], found["completeness"])
    at_edge = surface_error.segment_distance(truth.seen, truth.edges) <= reach
    found["edge_completeness"] = surface_error.percent_within(missed[at_edge], complete)
    return rounded(found)


def edges_of(world: World) -> NDArray[np.float64]:
    """(m, 2, 3) the edges of boxes, rooms and cylinders that lie on the world's surface."""
    segments = [_edges(row) for row in world.solids if int(row[0]) in (BOX, ROOM, CYLINDER)]
    found = np.concatenate([*segments, np.empty((0, 2, 3))])
    on_surface = np.abs(world.distance(found.mean(axis=1))) < 1e-6
    return found[on_surface]


def rounded(figures: dict[str, Any]) -> dict[str, Any]:
    """Figures with three decimals; None for NaN, which JSON lacks."""
    result: dict[str, Any] = {}
    for key, value in figures.items():
        if isinstance(value, dict):
            result[key] = rounded(value)
        elif isinstance(value, float):
            result[key] = round(value, 3) if np.isfinite(value) else None
        else:
            result[key] = value
    return result


def _candidates(solids: Solids, points: NDArray[np.float64]) -> Solids:
    """The solids that can be nearest to some point: no other solid is nearer to all points."""
    low, high = points.min(axis=0), points.max(axis=0)
    radius = np.linalg.norm(solids[:, 4:7], axis=1)
    gap = np.linalg.norm(np.maximum(np.maximum(low - solids[:, 1:4], solids[:, 1:4] - high), 0), axis=1)
    farthest = np.linalg.norm(np.maximum(high - solids[:, 1:4], solids[:, 1:4] - low), axis=1)
    endless = np.isin(solids[:, 0], (ROOM, GROUND))
    chosen: Solids = solids[endless | (gap - radius <= farthest[~endless].min(initial=np.inf))]
    return chosen


def _edges(row: Solids) -> NDArray[np.float64]:
    """(m, 2, 3) the edges of one solid, in the world."""
    half, (cosine, sine) = row[4:7], row[7:9]
    local = np.array(list(_rims(half) if int(row[0]) == CYLINDER else _box_edges(half)))
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    moved: NDArray[np.float64] = local @ turn.T + row[1:4]
    return moved


def _box_edges(half: NDArray[np.float64]) -> Iterable[NDArray[np.float64]]:
    for axis in range(3):
        for signs in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            ends = np.insert(np.array([signs, signs]), axis, (-1, 1), axis=1)
            yield ends * half


def _rims(half: NDArray[np.float64]) -> Iterable[NDArray[np.float64]]:
    turn = 2 * np.pi * np.arange(_CIRCLE + 1) / _CIRCLE
    for height in (-half[2], half[2]):
        rim = np.stack([half[0] * np.cos(turn), half[0] * np.sin(turn), np.full(len(turn), height)], axis=1)
        yield from np.stack([rim[:-1], rim[1:]], axis=1)
