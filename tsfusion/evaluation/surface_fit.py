# SPDX-License-Identifier: MIT
"""Register two surfaces of one scene, measure how well they fit, and look for evidence against the fit."""

from collections.abc import Sequence
from importlib.util import find_spec

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import MissingDependency, needing
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.se3 import Transform

_AGREE = 0.8  # cosine between two normals of one surface, at least
_REACH = 2.0  # cells, distance within which the other surface is searched
_PARALLEL = 0.95  # the same where offsets between the surfaces are compared
_LEAST_PART, _HALVINGS = 50, 3  # cells
_DEPTH_MARGIN = 0.02  # share of the depth; a camera saw through points nearer than the measurement by more
_INSTALL = "maps are aligned with scipy: pip install '.[align]' in your clone of tsfusion"
_SEEDS = 4  # runs of RANSAC
_FEATURE_RADIUS = 5.0  # cells
_FEATURE_POINTS = 100
_NEAREST = 1.5  # cells between two points that are one, at most
_EDGE_LENGTHS = 0.9  # smallest ratio of two triangle sides that are one
_ITERATIONS, _SAMPLE, _AT_ONCE = 100_000, 3, 256  # of RANSAC; matches of a sample; samples judged together
_CONFIDENCE = 0.9999  # that no better sample was missed
_MOST_MATCHES = 4000  # that samples are judged by
_FEW_MATCHES = 30  # with fewer mutual matches, all count
_BINS = 11  # of the histogram of one angle
_ICP_ITERATIONS, _CONVERGED = 60, 1e-7
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
    with needing("scipy is not installed (pip install scipy)"):
        from scipy.spatial import cKDTree
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


def check_installed() -> None:
    """Raise MissingDependency if scipy is not installed, without importing it."""
    if find_spec("scipy") is None:
        raise MissingDependency(_INSTALL)


class SurfaceRegistration:
    """Registration of surface `b` to surface `a`: equal surfaces give equal transforms, to the bit.

    Features are fast point feature histograms (Rusu, Blodow, Beetz 2009). Sums are NumPy's own, because those
    of a BLAS depend on its threads.
    """

    def __init__(self, a: SampledSurface, b: SampledSurface) -> None:
        check_installed()
        from scipy.spatial import cKDTree

        self._a, self._b, self._cell = a, b, a.cell
        self._tree = cKDTree(a.points)

    def candidates(self) -> list[Transform]:
        """Return likely `T_a_b`, (4, 4) each, found by RANSAC with several seeds and not refined."""
        if min(len(self._a.points), len(self._b.points)) < _SAMPLE:
            return []
        pairs = self._matches()
        found = (self._consensus(*pairs, seed) for seed in range(_SEEDS)) if len(pairs[0]) >= _SAMPLE else ()
        return [T for T in found if T is not None]

    def _matches(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points of `b` and of `a`, (m, 3) each, whose features are each other's nearest."""
        ours, theirs = (_features(one, _FEATURE_RADIUS * self._cell) for one in (self._a, self._b))
        there, back = nearest(theirs, ours)[1], nearest(ours, theirs)[1]
        is_mutual = back[there] == np.arange(len(theirs))
        if is_mutual.sum() < _FEW_MATCHES:
            is_mutual[:] = True
        chosen = np.flatnonzero(is_mutual)
        chosen = chosen[:: -(-len(chosen) // _MOST_MATCHES)]  # spread evenly: points are sorted by place
        return self._b.points[chosen], self._a.points[there[chosen]]

    def _consensus(
        self, points: NDArray[np.float64], targets: NDArray[np.float64], seed: int
    ) -> Transform | None:
        """Return the transform that takes most of (m, 3) points near their targets, or None without one.

        The search ends early once a better transform is unlikely (Fischler and Bolles 1981).
        """
        reach, best, most, enough = _NEAREST * self._cell, None, 0, float(_ITERATIONS)
        chosen = np.random.default_rng(seed).integers(0, len(points), (_ITERATIONS, _SAMPLE))
        lengths, wanted = (_sides(one[chosen]) for one in (points, targets))
        shortest, longest = np.minimum(lengths, wanted), np.maximum(lengths, wanted)
        likely = np.flatnonzero(((shortest >= _EDGE_LENGTHS * longest) & (shortest > reach)).all(axis=1))
        for start in range(0, len(likely), _AT_ONCE):
            if likely[start] > enough:
                break
            some = chosen[likely[start : start + _AT_ONCE]]
            R, t = _rigid(points[some], targets[some])
            moved = np.einsum("kij,mj->kmi", R, points) + t[:, None]
            inliers = ((moved - targets) ** 2).sum(axis=2) < reach**2
            counts = inliers.sum(axis=1)
            if counts.max(initial=0) > most:
                k = int(counts.argmax())
                most, best = int(counts[k]), inliers[k]
                enough = np.log(1 - _CONFIDENCE) / np.log1p(-min((most / len(points)) ** _SAMPLE, 1 - 1e-9))
        if best is None:
            return None
        R, t = _rigid(points[best][None], targets[best][None])
        return se3.nearest(se3.transform(R[0], t[0]))

    def refined(self, T_a_b: Transform, reaches: Sequence[float] = _ICP_REACH) -> Transform:
        """Return the transform after runs of point-to-plane ICP, each with its reach in cells."""
        T = se3.nearest(T_a_b)
        for reach in reaches:
            for _ in range(_ICP_ITERATIONS):
                step = self._icp_step(T, reach * self._cell)
                T = se3.nearest(se3.exp(step) @ T)
                if np.abs(step).max() < _CONVERGED:
                    break
        return T

    def _icp_step(self, T: Transform, reach: float) -> NDArray[np.float64]:
        """Return the twist, translation first, moving `b` at `T` onto planes of `a`, by Tukey weights."""
        points = se3.apply(T, self._b.points)
        distance, index = self._tree.query(points, distance_upper_bound=reach)
        points, index = points[np.isfinite(distance)], index[np.isfinite(distance)]
        normals = self._a.normals[index]
        offset = ((points - self._a.points[index]) * normals).sum(axis=1)
        weight = np.maximum(1 - (offset / (_LOSS * reach)) ** 2, 0) ** 2
        J = np.hstack([normals, np.cross(points, normals)])
        H = np.einsum("ni,n,nj->ij", J, weight, J)
        g = np.einsum("ni,n->i", J, weight * offset)
        twist: NDArray[np.float64] = -np.linalg.lstsq(H, g, rcond=1e-10)[0]
        return twist


def _features(surface: SampledSurface, radius: float) -> NDArray[np.float64]:
    """Return the fast point feature histogram of each point, (n, 33): three angles of pairs, 11 bins each."""
    from scipy.spatial import cKDTree

    points, normals, count = surface.points, surface.normals, len(surface.points)
    distance, index = cKDTree(points).query(points, min(_FEATURE_POINTS, count), distance_upper_bound=radius)
    distance, index = distance[:, 1:], index[:, 1:]  # without the point itself
    is_near = np.isfinite(distance) & (distance > 0)
    index, distance = np.where(is_near, index, 0), np.where(is_near, distance, 1.0)
    line = (points[index] - points[:, None]) / distance[..., None]
    u, other = normals[:, None], normals[index]
    v = np.cross(u, line)
    length = np.linalg.norm(v, axis=2, keepdims=True)
    is_near &= length[..., 0] > 0
    v = v / np.where(length > 0, length, 1.0)
    angles = (
        (v * other).sum(axis=2),
        (u * line).sum(axis=2),
        np.arctan2((np.cross(u, v) * other).sum(axis=2), (u * other).sum(axis=2)) / np.pi,
    )
    simple = np.zeros((count, 3 * _BINS))
    rows = np.broadcast_to(np.arange(count)[:, None], index.shape)
    for number, angle in enumerate(angles):
        bins = np.clip(((angle + 1) * (_BINS / 2)).astype(np.int64), 0, _BINS - 1) + number * _BINS
        simple += np.bincount((rows * 3 * _BINS + bins)[is_near], minlength=simple.size).reshape(simple.shape)
    neighbours = np.maximum(is_near.sum(axis=1), 1)[:, None]
    simple /= neighbours
    weight = np.where(is_near, 1 / distance**2, 0.0)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    of_neighbours: NDArray[np.float64] = np.einsum("nk,nkf->nf", weight, simple[index])
    return simple + of_neighbours


def _sides(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of the sides of (k, 3, 3) triangles: (k, 3)."""
    sides: NDArray[np.float64] = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2)
    return sides


def _rigid(
    points: NDArray[np.float64], targets: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations (k, 3, 3) and translations (k, 3) that move (k, m, 3) points onto their targets.

    The least-squares solution of Kabsch (1976).
    """
    middle, aim = points.mean(axis=1), targets.mean(axis=1)
    U, _, Vt = np.linalg.svd(np.einsum("kmi,kmj->kij", points - middle[:, None], targets - aim[:, None]))
    turned = np.einsum("kji,klj->kil", Vt, U)
    Vt[:, 2] *= np.sign(np.linalg.det(turned))[:, None]
    R = np.einsum("kji,klj->kil", Vt, U)
    return R, aim - np.einsum("kij,kj->ki", R, middle)
