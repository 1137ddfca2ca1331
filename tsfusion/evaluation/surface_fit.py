# SPDX-License-Identifier: MIT
"""Register two surfaces of one scene, measure how well they fit, and look for evidence against the fit."""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import MissingDependency
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.se3 import Transform

_AGREE = 0.8  # cosine between two normals of one surface, at least
_REACH = 2.0  # cells, distance within which the other surface is searched
_PARALLEL = 0.95  # the same where offsets between the surfaces are compared
_LEAST_PART, _HALVINGS = 50, 3  # cells
_DEPTH_MARGIN = 0.02  # share of the depth; a camera saw through points nearer than the measurement by more
_INSTALL = (
    "maps are aligned with Open3D and scipy: pip install '.[align]' in your clone of tsfusion, with a Python "
    "up to 3.12"
)
_SEEDS = 4  # runs of RANSAC
_FEATURE_RADIUS = 5.0  # cells
_FEATURE_POINTS = 100
_NEAREST = 1.5  # cells between two points that are one, at most
_EDGE_LENGTHS = 0.9  # smallest ratio of two triangle sides that are one
_ITERATIONS, _CONFIDENCE = 100_000, 0.999
_ICP_ITERATIONS = 60
_LOSS = 0.7  # share of the reach; larger distances have no effect
_ICP_REACH = (3.0, 1.5, 0.6)  # cells, for each run of ICP


class SurfaceFit(msgspec.Struct, frozen=True):
    """Fit of one surface to another.

    Attributes:
        overlap: share of the smaller surface that lies on the other surface, 0 to 1.
        rmse_m: root mean square distance between the surfaces where they overlap, metres; NaN without
            overlap.
        constraint: 0 to 1, how firmly the overlap holds the surfaces in the direction (or rotation) that is
            held least. About 0 for a plane, a ball or a straight corridor, about 0.1 for three planes at
            right angles.
        matches: number of cells that overlap.
    """

    overlap: float
    rmse_m: float
    constraint: float
    matches: int


def nearest(
    points: NDArray[np.floating], targets: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return (distance, index) of the nearest of `targets` (m, 3) to `points` (n, 3); inf without targets.

    Raises:
        MissingDependency: scipy is not installed.
    """
    try:
        from scipy.spatial import cKDTree
    except ImportError as error:
        raise MissingDependency("scipy is not installed (pip install scipy)") from error
    if not len(targets):
        return np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    distance, index = cKDTree(targets).query(points)
    return distance, index


class SampledSurface:
    """One point with a normal for each cell of a mesh, (n, 3) each."""

    def __init__(self, mesh: Mesh, cell: float) -> None:
        self.cell = cell
        at = np.floor(mesh.vertices.astype(np.float64) / cell).astype(np.int64) + (1 << 20)
        _, cells = np.unique(at[:, 0] << 42 | at[:, 1] << 21 | at[:, 2], return_inverse=True)
        count = np.bincount(cells)
        points, normals = (
            np.stack([np.bincount(cells, axis.astype(np.float64)) for axis in values.T], 1) / count[:, None]
            for values in (mesh.vertices, mesh.normals)
        )
        length = np.linalg.norm(normals, axis=1)
        is_flat = length > _AGREE  # other cells hold both sides of a thin object
        self.points, self.normals = points[is_flat], normals[is_flat] / length[is_flat, None]

    def moved(self, T: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points and normals after a transform, (4, 4): (n, 3) each."""
        return se3.apply(T, self.points), self.normals @ T[:3, :3].T


def fit(a: SampledSurface, b: SampledSurface, T_a_b: Transform, tolerance: float) -> SurfaceFit:
    """Return the fit of surface `b`, moved by `T_a_b`, to surface `a`.

    Args:
        tolerance: metres along the normal; two points within it are on one surface.

    Raises:
        MissingDependency: scipy is not installed.
    """
    points, normals = b.moved(T_a_b)
    distance, index = nearest(points, a.points)
    offset = ((points - a.points[index]) * a.normals[index]).sum(axis=1)
    agree = (normals * a.normals[index]).sum(axis=1) > _AGREE
    lies = agree & (distance < _REACH * a.cell) & (np.abs(offset) < tolerance)
    matches = int(lies.sum())
    overlap = min(1.0, matches / max(1, min(len(a.points), len(b.points))))
    if matches < 6:
        return SurfaceFit(overlap, np.nan, 0.0, matches)
    rmse = float(np.sqrt((offset[lies] ** 2).mean()))
    return SurfaceFit(overlap, rmse, _constraint(points[lies], a.normals[index[lies]]), matches)


def _constraint(points: NDArray[np.float64], normals: NDArray[np.float64]) -> float:
    """Return the smallest eigenvalue of the information matrix of point-to-plane distances, at unit size."""
    arms = points - points.mean(axis=0)
    arms /= max(float(np.sqrt((arms**2).sum(axis=1).mean())), 1e-9)
    J = np.hstack([normals, np.cross(arms, normals)])
    return max(0.0, float(np.linalg.eigvalsh(J.T @ J / len(J))[0]))


def parts_spread(a: SampledSurface, b: SampledSurface, T_a_b: Transform, reach: float) -> float:
    """Return by how many metres parts of the common surface disagree about the position of surface `b`.

    Three directions are checked. In each, parts of the surface with normals along the direction give a
    position of `b`, by the median of their offsets. Parts of a map that has drifted disagree, though the
    fit's residual is small: a robust fit leaves out what does not fit.

    Args:
        reach: metres within which the other surface is searched.

    Raises:
        MissingDependency: scipy is not installed.
    """
    points, normals = b.moved(T_a_b)
    distance, index = nearest(points, a.points)
    toward = a.normals[index]
    near = (distance < reach) & ((normals * toward).sum(axis=1) > _PARALLEL)
    offset = ((a.points[index] - points) * toward).sum(axis=1)[near]
    toward, points = toward[near], points[near]
    along = toward @ np.linalg.eigh(toward.T @ toward)[1]
    spreads = []
    for cosine in along.T:
        parts = _split(points, np.flatnonzero(np.abs(cosine) > _AGREE), _HALVINGS)
        wanted = [0.0, *(float(np.median(offset[part] * np.sign(cosine[part]))) for part in parts)]
        spreads.append(max(wanted) - min(wanted))
    return float(np.linalg.norm(spreads))


def _split(points: NDArray[np.float64], part: NDArray[np.intp], halvings: int) -> list[NDArray[np.intp]]:
    """Split points into equal parts by `halvings` cuts across the longest side; drop parts below 50."""
    if len(part) < _LEAST_PART:
        return []
    if not halvings or len(part) < 2 * _LEAST_PART:
        return [part]
    order = np.argsort(points[part, np.argmax(np.ptp(points[part], axis=0))])
    return [one for half in np.array_split(part[order], 2) for one in _split(points, half, halvings - 1)]


class SeenDepth:
    """Depth image of a keyframe, which tells whether the camera looked through a point.

    Args:
        keyframe: with depth or disparity.
        voxel_size: metres; a point nearer to a measurement than two voxels counts as seen.
    """

    def __init__(self, keyframe: Keyframe, voxel_size: float) -> None:
        assert keyframe.intrinsics is not None
        self._K, self._T_camera_world = keyframe.intrinsics, se3.inverse(keyframe.T_world_camera)
        self._near, self._far = _depth_range(keyframe)
        self._margin = 2 * voxel_size

    def looks(self, points: NDArray[np.float64]) -> tuple[int, int]:
        """Return how many of (n, 3) world points the camera looked through, and how many it saw.

        Points that are out of view, hidden, or at pixels without depth are not counted.
        """
        x, y, z = se3.apply(self._T_camera_world, points).T
        K, (height, width) = self._K, self._near.shape
        with np.errstate(all="ignore"):
            u, v = np.round(K.fx * x / z + K.cx), np.round(K.fy * y / z + K.cy)
            inside = (z > 0.1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        z, u, v = z[inside], u[inside].astype(int), v[inside].astype(int)
        margin = self._margin + _DEPTH_MARGIN * z
        near, far = self._near[v, u], self._far[v, u]
        through = z < near - margin
        return int(through.sum()), int(((z <= far + margin) & ~through & (near > 0)).sum())


def _depth_range(keyframe: Keyframe) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the smallest and largest depth around each pixel, metres; NaN beside a pixel without depth."""
    measured = keyframe.measurement.astype(np.float32)
    with np.errstate(all="ignore"):
        if keyframe.kind == "disparity":
            depth = np.float32(keyframe.baseline_fx or np.nan) / (measured * keyframe.disparity_scale)
        elif keyframe.measurement.dtype == np.uint16:
            depth = measured * np.float32(keyframe.depth_scale)
        else:
            depth = measured
    depth[~(np.isfinite(depth) & (measured > 0))] = 0
    window = np.ones((5, 5), np.uint8)
    near, far = cv2.erode(depth, window), cv2.dilate(depth, window)
    near[near == 0] = np.nan
    return np.asarray(near, np.float32), np.asarray(far, np.float32)


def open3d() -> Any:
    """Import and return the module Open3D.

    Raises:
        MissingDependency: Open3D is not installed.
    """
    try:
        import open3d
    except ImportError as error:
        raise MissingDependency(_INSTALL) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)  # it warns for every bad guess
    return open3d


def check_installed() -> None:
    """Raise MissingDependency if Open3D or scipy is not installed, without importing them."""
    for name in ("open3d", "scipy"):
        if find_spec(name) is None:
            raise MissingDependency(_INSTALL)


class SurfaceRegistration:
    """Registration of surface `b` to surface `a`, with point features by Open3D."""

    def __init__(self, a: SampledSurface, b: SampledSurface) -> None:
        self._o3d = open3d()
        self._registration = self._o3d.pipelines.registration
        self._a, self._b = self._cloud(a), self._cloud(b)
        self._cell = a.cell

    def candidates(self) -> list[Transform]:
        """Return likely `T_a_b`, (4, 4) each, found by RANSAC with several seeds and not refined."""
        found, registration = [], self._registration
        features = [self._features(cloud) for cloud in (self._b, self._a)]
        reach = _NEAREST * self._cell
        checks = [
            registration.CorrespondenceCheckerBasedOnEdgeLength(_EDGE_LENGTHS),
            registration.CorrespondenceCheckerBasedOnDistance(reach),
        ]
        for seed in range(_SEEDS):
            self._o3d.utility.random.seed(seed)
            result = registration.registration_ransac_based_on_feature_matching(
                self._b, self._a, *features, True, reach,
                registration.TransformationEstimationPointToPoint(False), 3, checks,
                registration.RANSACConvergenceCriteria(_ITERATIONS, _CONFIDENCE),
            )  # fmt: skip
            if result.fitness > 0:
                found.append(se3.nearest(np.array(result.transformation)))
        return found

    def refined(self, T_a_b: Transform, reaches: Sequence[float] = _ICP_REACH) -> Transform:
        """Return the transform after runs of point-to-plane ICP, each with its reach in cells."""
        T = T_a_b
        registration = self._registration
        enough = registration.ICPConvergenceCriteria(1e-7, 1e-7, _ICP_ITERATIONS)
        for reach in reaches:
            loss = registration.TukeyLoss(_LOSS * reach * self._cell)
            method = registration.TransformationEstimationPointToPlane(loss)
            result = registration.registration_icp(self._b, self._a, reach * self._cell, T, method, enough)
            T = np.array(result.transformation)
        return se3.nearest(T)

    def _cloud(self, surface: SampledSurface) -> Any:
        vectors = self._o3d.utility.Vector3dVector
        cloud = self._o3d.geometry.PointCloud(vectors(surface.points))
        cloud.normals = vectors(surface.normals)
        return cloud

    def _features(self, cloud: Any) -> Any:
        around = self._o3d.geometry.KDTreeSearchParamHybrid(
            radius=_FEATURE_RADIUS * self._cell, max_nn=_FEATURE_POINTS
        )
        return self._registration.compute_fpfh_feature(cloud, around)
