# SPDX-License-Identifier: MIT
"""Fit small planes to a depth image, and measure the distances of other points from them.

Points are paired with planes by projection, after Blais and Levine, "Registering multiview range data"
(1995), and aligned by point-to-plane distances, after Chen and Medioni (1992). Inverse depth of a plane is
linear over the pixels. So inverse depth is averaged over blocks of pixels, and planes are fitted to it by
least squares.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics

Floats = NDArray[np.float32]

BLOCKS = 160 * 120  # of an image, about
_FIT_RADIUS = 1  # blocks
_FIT_SHARE = 0.6  # share of the 3×3 blocks around a block that must be valid
_NEAREST = 0.1  # metres
_MAX_CURVATURE = 0.006  # deviation inside a block or from its plane, as a share of the depth
_MIN_COSINE = 0.17  # between ray and normal
_CELL = 8  # errors are averaged over 8×8 blocks
_NORMAL = np.float32(1 / 32767)  # unit of packed normals: 1/30 mm for each metre
_STRIP = 8  # rows of blocks averaged together: their pixels stay in the CPU's cache


@dataclass(frozen=True, eq=False)
class PlaneImage:
    """Planes fitted to the blocks of one depth image, in its camera's axes."""

    intrinsics: Intrinsics  # of an image with one pixel for each block
    shape: tuple[int, int]  # rows and columns of blocks
    points: Floats  # (3, n) float32 metres, the blocks' centres
    sigma: Floats  # (n,) float32 metres, standard deviation of a depth camera at these depths
    index: NDArray[np.intp]  # (n,) number of the point's block, row by row
    # (3, rows·columns) unit normals: float32, or int16 in units of `_NORMAL`
    normals: Floats | NDArray[np.int16]
    offsets: Floats  # (rows·columns,) float32 metres, normal · p = offset > 0; 0 = no plane
    roughness: float  # deviation of the blocks from the planes fitted around them, as a share of `sigma`

    @property
    def covered(self) -> float:
        """Share of the blocks that have a plane."""
        return float(np.count_nonzero(self.offsets) / len(self.offsets))

    @property
    def median_depth(self) -> float:
        """Median depth of the points, metres."""
        return float(np.median(self.points[2])) if self.points.size else 0.0

    def planes(self, block: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return normals, (3, m) float32, and offsets, (m,), of blocks."""
        normals = self.normals.take(block, axis=1)
        is_packed = normals.dtype == np.int16
        unpacked = normals * _NORMAL if is_packed else normals.astype(np.float32, copy=False)
        return unpacked, self.offsets.take(block)

    def without_points(self) -> "PlaneImage":
        """Return the planes alone, with normals in 16 bits: a quarter of the memory.

        Points of other images can still be matched with them.
        """
        if self.normals.dtype == np.int16:
            return self
        return replace(
            self,
            points=np.empty((3, 0), np.float32),
            sigma=np.empty(0, np.float32),
            index=np.empty(0, np.intp),
            normals=np.rint(self.normals / _NORMAL).astype(np.int16),
        )

    def every(self, step: int) -> NDArray[np.intp]:
        """Return the indices of the points on every `step`-th row and column of blocks."""
        return np.flatnonzero(_lattice(self.shape, step).take(self.index))


@lru_cache(maxsize=16)
def _lattice(shape: tuple[int, int], step: int) -> NDArray[np.bool_]:
    """Return a mask of the blocks on every `step`-th row and column, (rows·columns,)."""
    row, column = np.indices(shape)
    chosen: NDArray[np.bool_] = ((row % step == step // 2) & (column % step == step // 2)).ravel()
    return chosen


def deviation(depth: Any) -> Any:
    """Return the standard deviation of structured-light depth, metres (Nguyen, Izadi and Lovell 2012)."""
    return 0.0012 + 0.0019 * (depth - 0.4) ** 2


def fit_planes(depth: Floats, intrinsics: Intrinsics) -> PlaneImage:
    """Fit planes to a depth image, (H, W) float32 metres, 0 = no depth."""
    block = max(1, round((depth.size / BLOCKS) ** 0.5))
    inverse, valid = _blocks(depth, block)
    K, shape = intrinsics.scaled(1 / block), (inverse.shape[0], inverse.shape[1])
    index = np.flatnonzero(valid)
    v, u = np.divmod(index, shape[1])
    z = 1 / inverse.ravel()[index]
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z]).astype(np.float32)
    normals, roughness = _normals(inverse, valid, K)
    offsets = np.zeros(valid.size, np.float32)
    # The plane goes through the block's own point. The neighbours' mean would lie inside a round object.
    offsets[index] = np.einsum("in,in->n", normals[:, index], points)
    sigma = deviation(points[2]).astype(np.float32)
    return PlaneImage(K, shape, points, sigma, index, normals, offsets, roughness)


def _blocks(depth: Floats, block: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the mean inverse depth of blocks, and True if at least half of a block is one smooth surface."""
    rows, columns = depth.shape[0] // block, depth.shape[1] // block
    share, mean, square = (np.empty((rows, columns), np.float32) for _ in range(3))
    for top in range(0, rows, _STRIP):
        strip = slice(top, min(top + _STRIP, rows))
        pixels = depth[top * block : strip.stop * block, : columns * block]
        there = (pixels > _NEAREST).astype(np.float32)
        inverse = there / np.maximum(pixels, np.float32(_NEAREST))
        for image, into in ((there, share), (inverse, mean), (inverse * inverse, square)):
            into[strip] = cv2.resize(image, (columns, strip.stop - top), interpolation=cv2.INTER_AREA)
    valid = share >= 0.5
    mean = np.divide(mean, share, out=np.ones_like(mean), where=valid)
    spread = np.divide(square, share, out=np.ones_like(mean), where=valid) - mean * mean
    z = 1 / mean
    limit = _MAX_CURVATURE * z + 2 * deviation(z)
    return mean, valid & (spread * z**4 < limit**2)


def _normals(inverse: Floats, valid: NDArray[np.bool_], K: Intrinsics) -> tuple[Floats, float]:
    """Return normals, (3, n), of planes fitted around each block, 0 where none fits, and the roughness."""
    r = _FIT_RADIUS
    ones, step = np.ones(2 * r + 1), np.arange(-r, r + 1, dtype=np.float64)
    w = valid.astype(np.float32)
    q = inverse * w

    def moment(image: Floats, x: NDArray[np.float64], y: NDArray[np.float64]) -> Any:
        return cv2.sepFilter2D(image, cv2.CV_32F, x, y, borderType=cv2.BORDER_CONSTANT)

    s, su, sv = moment(w, ones, ones), moment(w, step, ones), moment(w, ones, step)
    suu, suv, svv = moment(w, step**2, ones), moment(w, step, step), moment(w, ones, step**2)
    sq, squ, sqv = moment(q, ones, ones), moment(q, step, ones), moment(q, ones, step)
    ok = valid & (s >= _FIT_SHARE * (2 * r + 1) ** 2)
    s = np.where(ok, s, 1)
    mu, mv, mq = su / s, sv / s, sq / s
    cuu, cuv, cvv = suu / s - mu * mu, suv / s - mu * mv, svv / s - mv * mv
    cuq, cvq = squ / s - mu * mq, sqv / s - mv * mq
    det = cuu * cvv - cuv * cuv
    ok &= det > 0.1
    det = np.where(ok, det, 1)
    a, b = (cvv * cuq - cuv * cvq) / det, (cuu * cvq - cuv * cuq) / det
    rest = moment(q * inverse, ones, ones) / s - mq * mq - a * cuq - b * cvq
    z = 1 / np.where(ok, mq, 1)
    off = np.sqrt(np.maximum(rest, 0)) * z * z
    sigma = deviation(z)
    ok &= off < _MAX_CURVATURE * z + sigma
    x = ((np.arange(ok.shape[1]) - K.cx) / K.fx).astype(np.float32)[None, :]
    y = ((np.arange(ok.shape[0]) - K.cy) / K.fy).astype(np.float32)[:, None]
    # 1/z = a (u - u0) + b (v - v0) + c around block (u0, v0) is normal · (x, y, 1) = 1/z.
    nx, ny, c = a * np.float32(K.fx), b * np.float32(K.fy), mq - a * mu - b * mv
    normals = np.stack([nx, ny, c - nx * x - ny * y])
    length = np.maximum(np.sqrt((normals * normals).sum(axis=0)), np.float32(1e-12))
    ok &= c > _MIN_COSINE * length * np.sqrt(x * x + y * y + 1)
    free = 1 - 3 / (2 * r + 1) ** 2  # share of free residuals: three parameters are fitted
    roughness = float(np.median(off[ok] / sigma[ok]) / np.sqrt(free)) if ok.any() else 0.0
    return np.where(ok, normals / length, 0).reshape(3, -1), roughness


@dataclass(frozen=True, eq=False)
class Match:
    """Points of one image, each paired with the plane of the other image's block that it projects onto."""

    moved: Floats  # (3, m) float32 metres, the points in the other camera's axes
    normals: Floats  # (3, m) float32, normals of the planes
    distance: Floats  # (m,) float32 metres, signed distances from the planes
    sigma: Floats  # (m,) float32 metres, standard deviation of the points' depth
    chosen: NDArray[np.intp]  # (m,) indices of the points
    block: NDArray[np.intp]  # (m,) numbers of the other image's blocks


def match(
    there: PlaneImage, here: PlaneImage, T_there_here: se3.Transform, some: NDArray[np.intp] | None
) -> Match:
    """Pair the points of `here` (all, or those with the indices `some`) with the planes of `there`."""
    points, sigma = (here.points, here.sigma) if some is None else (here.points[:, some], here.sigma[some])
    K, (rows, columns) = there.intrinsics, there.shape
    moved = T_there_here[:3, :3].astype(np.float32) @ points + T_there_here[:3, 3:].astype(np.float32)
    scale = 1 / np.maximum(moved[2], np.float32(_NEAREST))
    u = moved[0] * scale * np.float32(K.fx) + np.float32(K.cx + 0.5)
    v = moved[1] * scale * np.float32(K.fy) + np.float32(K.cy + 0.5)
    inside = (moved[2] > _NEAREST) & (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    block = np.where(inside, v, 0).astype(np.intp) * columns + np.where(inside, u, 0).astype(np.intp)
    chosen = np.flatnonzero(inside & (there.offsets.take(block) > 0))
    block = block.take(chosen)
    moved, (normals, offsets) = moved.take(chosen, axis=1), there.planes(block)
    distance = normals[0] * moved[0] + normals[1] * moved[1] + normals[2] * moved[2] - offsets
    which = chosen if some is None else some.take(chosen)
    return Match(moved, normals, distance, sigma.take(chosen), which, block)


def correlated_blocks(found: Match, columns: int) -> float:
    """Return how many blocks share one error: 1 for white noise, dozens for a sensor with smooth errors.

    It is the variance of the distances' means over cells of blocks, divided by that of white noise.
    """
    near = np.abs(found.distance) < 4 * found.sigma
    whitened = (found.distance[near] / found.sigma[near]).astype(np.float64)
    row, column = np.divmod(found.block[near], columns)
    cell = row // _CELL * columns + column // _CELL
    count, total = np.bincount(cell), np.bincount(cell, weights=whitened)
    full = count > _CELL * _CELL // 2
    if not full.any():
        return 1.0
    variance = max(float(np.mean(whitened**2)), 1e-12)
    return max(1.0, float((total[full] ** 2).sum() / count[full].sum()) / variance)


def equations(found: Match, weight: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return normal equations, (6, 6) and (6,), of the step that brings the points to their planes.

    The step is applied as `exp(step) @ T_there_here`.
    """
    x, y, z = found.moved
    nx, ny, nz = found.normals
    J = np.empty((6, len(x)), np.float32)
    J[:3] = found.normals
    J[3], J[4], J[5] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
    weighted = J * weight
    H, g = weighted @ J.T, weighted @ found.distance
    return H.astype(np.float64), -g.astype(np.float64)
