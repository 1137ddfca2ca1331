# SPDX-License-Identifier: MIT
"""Slow twins of the kernels in plain NumPy and Python: the same mathematics, written for reading."""

from collections import defaultdict
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from tsfusion.kernels.surface import marching_cubes as cases

Voxel = tuple[int, int, int]
WEIGHT_ONE = 16
MAX_BUNDLE_WEIGHT = 255
MAX_DISTANCE = 1023
NEVER = 1 << 30


def sample(parameters: NDArray[np.float64], z: float, trust: float) -> tuple[int, int, int]:
    """Weight of samples at depth z whose confidences sum to `trust`; half-width of their band, and its
    support, 2⁻⁸ voxel."""
    floor, slope, z0, low, high, voxel_size, full = parameters[:7]
    sigma = floor + slope * (z - z0) * (z - z0)
    weight = int(WEIGHT_ONE * trust / 255.0 * min(1.0, max((full / sigma) ** 2, 1 / WEIGHT_ONE)) + 0.5)
    support = int(min(max(3.0 * sigma / voxel_size, low), high) * 256.0)
    half = int(min(max(3.0 * sigma / voxel_size, parameters[12]) * 256.0, support))
    return min(max(weight, 1), MAX_BUNDLE_WEIGHT), half, support


def make_ray(
    end: Any,
    direction: Any,
    half: int,
    weight: int,
    color: int = 0,
    normal: Any = None,
    before: int = 0,
    support: int = 0,
) -> NDArray[np.int32]:
    """One ray; `end` int 2⁻¹⁰ voxel, `direction` float of any length, `half` 2⁻⁸ voxel; with the `normal` of
    the plane it ends on, or none. Where it begins further `before` its end than its `support`, it carves."""
    support = max(support, half)
    before = max(before, support)
    u = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    unit = [int(x) for x in np.floor(u * 65536 + 0.5)]
    gradient = u if normal is None else np.asarray(normal) / (np.asarray(normal) @ u)
    loss = [int(x) for x in np.floor(gradient * 65536 + 0.5)]
    exact = [int(e) << 6 for e in end]
    start = [e - (u * before >> 8) for e, u in zip(exact, unit, strict=True)]
    voxel = [s >> 16 for s in start]
    crossing, interval = [NEVER] * 3, [NEVER] * 3
    for a in range(3):
        if abs(unit[a]) > 8:
            inverse = 65536.0 / abs(unit[a])
            gap = 65536 - (start[a] & 65535) if unit[a] > 0 else start[a] & 65535
            interval[a], crossing[a] = int(inverse * 65536.0), int(gap * inverse)
    distance = sum((e - (v << 16) - 32768) * g for e, v, g in zip(exact, voxel, loss, strict=True)) >> 16
    downward = sum(1 << a for a in range(3) if unit[a] < 0)
    loss = [-g if x < 0 else g for g, x in zip(loss, unit, strict=True)]
    packed = np.uint32(weight << 24 | color).astype(np.int32)
    last = (distance, before + half << 8 | support & 255, before << 8 | support >> 8 << 3 | downward, packed)
    return np.array([*voxel, *crossing, *interval, *loss, *last], np.int32)


def weight_of(ray: NDArray[np.int32]) -> int:
    return int(ray[15]) >> 24 & 255


def end_of(ray: NDArray[np.int32]) -> Voxel:
    """The voxel in which the ray ends."""
    for (voxel, _), leaves in crossed_until(ray):
        if leaves > parts_of(ray)[0]:
            return voxel
    raise AssertionError


def parts_of(ray: NDArray[np.int32]) -> tuple[int, int, int]:
    """Where along the ray its end lies, the half-width of its band and its support, 2⁻¹⁶ voxel."""
    length, end = int(ray[13]), int(ray[14])
    return end & ~255, (length & ~255) - (end & ~255), (end & 248) << 13 | (length & 255) << 8


def fixed(p: Any) -> NDArray[np.int64]:
    return np.floor(np.asarray(p, np.float64) * 1024.0).astype(np.int64)


def crossed(ray: NDArray[np.int32]) -> list[tuple[Voxel, int]]:
    """The voxels a ray crosses in its band, in order, with their distances (2⁻¹⁶ voxel)."""
    return [found for found, _ in crossed_until(ray)]


def crossed_until(ray: NDArray[np.int32]) -> list[tuple[tuple[Voxel, int], int]]:
    """As `crossed`, each with where along the band the ray leaves it."""
    voxel, crossing, interval, loss = ([int(x) for x in ray[i : i + 3]] for i in (0, 3, 6, 9))
    distance = int(ray[12])
    found = []
    while True:
        axis = min(range(3), key=lambda a: (crossing[a], a))
        found.append((((voxel[0], voxel[1], voxel[2]), distance), crossing[axis]))
        if crossing[axis] >= int(ray[13]) & ~255:
            return found
        crossing[axis] += interval[axis]
        voxel[axis] += -1 if int(ray[14]) >> axis & 1 else 1
        distance -= loss[axis]


def blocks_of(rays: NDArray[np.int32]) -> set[Voxel]:
    return {(v[0] >> 3, v[1] >> 3, v[2] >> 3) for ray in rays for v, _ in crossed(ray)}


def quantize(distance: int, quanta_per_voxel: int) -> int:
    return max(-MAX_DISTANCE, min(MAX_DISTANCE, (distance * quanta_per_voxel + 32768) >> 16))


def integrate(rays: NDArray[np.int32], quanta_per_voxel: int) -> dict[Voxel, tuple[int, int]]:
    """(Σ w·m, Σ w) of every voxel the rays cross."""
    sums: dict[Voxel, tuple[int, int]] = defaultdict(lambda: (0, 0))
    for ray in rays:
        end, half, support = parts_of(ray)
        for (voxel, distance), leaves in crossed_until(ray):
            w, m, (s, total) = weight_of(ray), quantize(distance, quanta_per_voxel), sums[voxel]
            if leaves < end - half:  # free space
                most = quantize(support, quanta_per_voxel)
                m = min(max(m, 0), most) if half < support else most
                w = max(w >> 1, 1)
            sums[voxel] = (s + w * m, total + w)
    return dict(sums)


def colors(rays: NDArray[np.int32]) -> dict[Voxel, tuple[int, int, int, int]]:
    """(Σ R, Σ G, Σ B, n) of the voxels that rays end in."""
    sums: dict[Voxel, tuple[int, int, int, int]] = defaultdict(lambda: (0, 0, 0, 0))
    for ray in rays:
        packed = int(ray[15])
        vote = (packed >> 16 & 255, packed >> 8 & 255, packed & 255, 1)
        voxel = end_of(ray)
        r, g, b, n = (a + c for a, c in zip(sums[voxel], vote, strict=True))
        sums[voxel] = (r, g, b, n)
    return dict(sums)


CELLS = [(1, 1), (2, 1), (2, 2), (3, 2), (3, 3), (4, 3), (4, 4), (6, 4), (6, 6), (12, 6), (12, 12)]


def cell_shape(depths: NDArray[np.float64], pitch: float) -> tuple[int, int]:
    """(width, height) of a tile's cells in pixels; `pitch` = voxels a pixel spans at 1 m."""
    pixel = float(depths[depths > 0].mean()) * pitch
    return max((w, h) for w, h in CELLS if w * h * pixel**2 <= 1 or w == 1)


def tile_plane(depths: NDArray[np.float64], sigma: float, voxel_size: float) -> tuple[float, float] | None:
    """(∂z/∂x, ∂z/∂y) a pixel, if the tile is flat."""
    y, x = (2 * found for found in np.nonzero(depths[::2, ::2]))
    if len(y) < 9 or sigma >= voxel_size:
        return None
    system = np.stack([x, y, np.ones(len(x))], axis=1)
    plane, *_ = np.linalg.lstsq(system, depths[y, x], rcond=None)
    residual = float(((system @ plane - depths[y, x]) ** 2).mean())
    if residual >= 2 * sigma**2 + (0.1 * voxel_size) ** 2:
        return None
    return float(plane[0]), float(plane[1])


def layers(z: NDArray[np.float64], tolerance: Any) -> list[NDArray[np.bool_]]:
    """The valid samples of a cell by layer of depth, nearest first."""
    found, floor = [], 0.0
    while (z > floor).any():
        ceiling = z[z > floor].min() + tolerance(z[z > floor].min())
        found.append((z > floor) & (z <= ceiling))
        floor = ceiling
    return found


def runs(points: NDArray[np.float64], voxel_size: float) -> list[NDArray[np.intp]]:
    """Consecutive valid points within a voxel of the first of them."""
    found: list[list[int]] = []
    for i in np.flatnonzero(np.isfinite(points).all(axis=1)):
        if not found or np.linalg.norm(points[i] - points[found[-1][0]]) > voxel_size:
            found.append([])
        found[-1].append(int(i))
    return [np.array(run) for run in found]


def solve(y: Any, a: Any, t: Any, smoothness: float) -> NDArray[np.float64]:
    """x̂ = argmin (x − y)ᵀ A (x − y) + λ ‖D2 (x − t)‖², by a dense solve."""
    y, a, t = (np.asarray(v, np.float64) for v in (y, a, t))
    n = len(y)
    if n < 3:
        return y
    D2 = np.zeros((n - 2, n))
    for i in range(n - 2):
        D2[i, i : i + 3] = (1, -2, 1)
    return t + np.linalg.solve(np.diag(a) + smoothness * D2.T @ D2, a * (y - t))


def smooth(
    rays: NDArray[np.int32],
    quanta_per_voxel: int,
    before: dict[Voxel, tuple[float, int]],
    smoothness: float,
    weighted: bool,
) -> dict[Voxel, float]:
    """Regularised values after these rays; `before` holds (value, weight) of the voxels seen before.

    The free space before a ray's band is no part of its signal.
    """
    added = integrate(rays, quanta_per_voxel)
    votes = defaultdict(list)
    for ray in rays:
        end, half, _ = parts_of(ray)
        voxels = [found for found, leaves in crossed_until(ray) if leaves >= end - half]
        t = [distance * quanta_per_voxel / 65536 for _, distance in voxels]
        w, y = [], []
        for voxel, _ in voxels:
            x_old, w_old = before.get(voxel, (0.0, 0))
            s, w_new = added[voxel]
            w.append(w_old + w_new)
            y.append((w_old * x_old + s) / (w_old + w_new))
        a = np.array(w) / np.mean(w) if weighted else np.ones(len(w))
        for (voxel, _), x in zip(voxels, solve(y, a, t, smoothness), strict=True):
            votes[voxel].append(x)
    return {voxel: float(np.mean(xs)) for voxel, xs in votes.items()}


def marching_cubes(values: dict[Voxel, float]) -> list[tuple[tuple[float, float, float], ...]]:
    """Triangles, as positions in voxels (voxel centres at + 0.5), over all cells with eight known corners."""
    triangles = []
    for cell in values:
        corners = [tuple(np.add(cell, c)) for c in cases.CORNERS]
        if not all(c in values for c in corners):
            continue
        case = sum(1 << i for i, c in enumerate(corners) if values[c] < 0)
        edges = cases.TRIANGLE_EDGES[case, : 3 * cases.TRIANGLE_COUNT[case]]
        points = []
        for e in edges:
            a, b = (corners[i] for i in cases.EDGES[e])
            points.append(tuple(np.array(a) + 0.5 + share(values, a, b) * (np.array(b) - np.array(a))))
        triangles += [tuple(points[i : i + 3]) for i in range(0, len(points), 3)]
    return triangles


def crossed_cells(
    values: dict[Voxel, float], meshed: set[Voxel], behind: float, clear: float
) -> tuple[set[Voxel], set[tuple[Voxel, int]], dict[Voxel, int]]:
    """Cells of the `meshed` blocks that the surface crosses, the edges (voxel, axis) that carry their
    vertices, and how many triangles each has: twin of `surface_cells.find_cells`. Where a corner is
    `clear` and another far `behind`, there are none."""
    edges, triangles = set(), {}
    for cell in values:
        corners = [tuple(int(x) for x in np.add(cell, c)) for c in cases.CORNERS]
        if tuple(c >> 3 for c in cell) not in meshed or not all(c in values for c in corners):
            continue
        found = [values[c] for c in corners]  # type: ignore[index]
        if min(found) < behind and max(found) > clear:
            continue
        case = sum(1 << i for i, value in enumerate(found) if value < 0)
        if 0 < case < 255:
            triangles[cell] = int(cases.TRIANGLE_COUNT[case])
            for e, (a, b) in enumerate(cases.EDGES):
                if (case >> a & 1) != (case >> b & 1):
                    edges.add((corners[a], e // 4))
    return set(triangles), edges, triangles  # type: ignore[return-value]


def share(values: dict[Voxel, float], a: Any, b: Any) -> float:
    """Where between voxels a and b the value crosses zero."""
    return min(max(values[a] / (values[a] - values[b]), 0.001), 0.999)


def slope(values: dict[Voxel, float], voxel: Any) -> NDArray[np.float64]:
    """Central differences, one-sided where only one neighbour is known."""
    found = np.zeros(3)
    for axis, step in enumerate(np.eye(3, dtype=int)):
        low, high = (tuple(int(x) for x in np.array(voxel) + s * step) for s in (-1, 1))
        if low in values and high in values:
            found[axis] = (values[high] - values[low]) / 2
        elif high in values:
            found[axis] = values[high] - values[voxel]
        elif low in values:
            found[axis] = values[voxel] - values[low]
    return found


def vertex(values: dict[Voxel, float], colors: dict[Voxel, Any], position: Any) -> tuple[Any, Any]:
    """(unit normal, RGB) of the vertex at a position in voxels: twin of `emit_vertices`."""
    away = np.abs(np.asarray(position) - 0.5 - np.round(np.asarray(position) - 0.5))
    axis = int(np.argmax(away))
    a = np.round(np.asarray(position) - 0.5).astype(int)
    a[axis] = int(np.floor(position[axis] - 0.5))
    b = a.copy()
    b[axis] += 1
    a, b = tuple(a.tolist()), tuple(b.tolist())
    t = share(values, a, b)
    normal = (1 - t) * slope(values, a) + t * slope(values, b)
    votes = [(s, colors[v]) for s, v in ((1 - t, a), (t, b)) if v in colors]
    if not votes:
        votes = [(1.0, colors[v]) for v in sorted(neighbours(a)) if v in colors]
    total = sum(s for s, _ in votes)
    rgb = sum(s * np.array(c, float) for s, c in votes) / total if votes else np.full(3, 160.0)
    return normal / np.linalg.norm(normal), np.floor(rgb + 0.5)


def field(
    raw: NDArray[np.float64], weight: NDArray[np.float64], settings: Any, quanta: int, edges: list[float]
) -> NDArray[np.float64]:
    """argmin Σ W (x − y)² + λ Σ ω |D2 x|² on a dense array of quanta, NaN = unseen, by sparse direct solves;
    ω = 1 / (1 + (D2 x / ε)²) of the last x, for each ε of `edges`. Voxels beyond reach stay as they are."""
    listed = abs(np.nan_to_num(raw, nan=np.inf)) <= settings.reach * quanta
    number = np.full(raw.shape, -1)
    number[listed] = np.arange(listed.sum())
    rows = []
    for axis in range(3):
        n = np.moveaxis(number, axis, 0)
        triples = np.stack([n[:-2], n[1:-1], n[2:]], axis=-1).reshape(-1, 3)
        rows.append(triples[(triples >= 0).all(axis=1)])
    triples = np.concatenate(rows)
    where = (np.repeat(np.arange(len(triples)), 3), triples.ravel())
    D2 = sparse.csr_matrix((np.tile([1.0, -2.0, 1.0], len(triples)), where), (len(triples), listed.sum()))
    x = y = raw[listed]
    W = weight[listed]
    for edge in edges:
        omega = 1 / (1 + (D2 @ x / edge) ** 2)
        A = sparse.diags(W) + settings.smoothness * D2.T @ sparse.diags(omega) @ D2
        x = spsolve(A.tocsc(), W * y)
    result = raw.copy()
    result[listed] = x
    return result


def along_normal(raw: NDArray[np.float64], voxel: Voxel, smoothness: float, reach: float) -> float:
    """One voxel's value after smoothing up to 3 samples a side along its gradient; NaN = unseen."""

    def value(p: Any) -> float:
        inside = all(0 <= c < n for c, n in zip(p, raw.shape, strict=True))
        return float(raw[tuple(p)]) if inside else np.nan

    def sample(p: NDArray[np.float64]) -> float:
        low = np.floor(p).astype(int)
        corners = [np.array(c) for c in product((0, 1), repeat=3)]
        return sum(np.prod(np.where(c, p - low, low + 1 - p)) * value(low + c) for c in corners)

    here = value(voxel)
    gradient = np.array([value(voxel + e) - value(voxel - e) for e in np.eye(3, dtype=int)])
    if not abs(here) <= reach or not np.linalg.norm(gradient) > 0:
        return here
    signal = [here]
    for k in (1.0, 2.0, 3.0):
        step = k * gradient / np.linalg.norm(gradient)
        before, after = sample(voxel - step), sample(voxel + step)
        if np.isnan(before + after):
            break
        signal = [before, *signal, after]
    flat = np.zeros(len(signal))
    return float(solve(signal, flat + 1, flat, smoothness)[len(signal) // 2])


def segment_voxels(end: Any, direction: Any, half: float) -> set[Voxel]:
    """Voxels within `half` voxels of `end` along a line, by dense sampling: no traversal to get wrong."""
    t = np.linspace(-half, half, 20001)
    u = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    return {(int(x), int(y), int(z)) for x, y, z in np.floor(np.asarray(end) / 1024.0 + t[:, None] * u)}


def neighbours(voxel: Voxel) -> set[Voxel]:
    return {tuple(np.add(voxel, d)) for d in product((-1, 0, 1), repeat=3)}  # type: ignore[misc]


def trace(distance: Any, origin: Any, directions: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """Twin of `kernels.worlds.synthetic_raycast.cast`: sphere tracing; 0 = nothing within reach."""
    length = np.linalg.norm(directions, axis=1)
    t = np.zeros(len(directions))
    for _ in range(300):
        t += distance(origin + directions * t[:, None]) / length
    found = (np.abs(distance(origin + directions * t[:, None])) < 1e-6) & (t < reach)
    return np.where(found, t, 0.0)


def see(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], focal: float, shape: tuple[int, int], near: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Twin of `rasterizer`: the front-facing triangle each pixel sees (−1 = none) and its depth."""
    height, width = shape
    v, u = np.mgrid[:height, :width]
    rays = np.dstack([(u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal, np.ones(shape)])
    seen, depth = np.full(shape, -1, np.int64), np.full(shape, np.inf)
    for f, (a, b, c) in enumerate(vertices[faces].astype(np.float64)):
        normal = np.cross(b - a, c - a)
        if normal @ a >= 0:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (normal @ a) / (rays @ normal)
        p = rays * z[..., None]
        inside = [np.cross(q - o, p - o) @ normal >= 0 for o, q in ((a, b), (b, c), (c, a))]
        hit = np.logical_and.reduce(inside) & (z >= near) & (z < depth)
        seen[hit], depth[hit] = f, z[hit]
    return seen, np.where(seen >= 0, depth, 0.0)


def shade(corners: Any, normals: Any, colors: Any, ray: Any, up: Any) -> NDArray[np.float64]:
    """Twin of `kernels.answers.rasterizer.shade` for one pixel of one triangle: linear RGB."""
    weights = np.linalg.solve(np.asarray(corners, float).T, ray)
    weights = np.clip(weights / weights.sum(), 0, 1)
    normal = weights @ np.asarray(normals, float)
    normal /= np.linalg.norm(normal)
    facing = max(-normal @ ray / np.linalg.norm(ray), 0.0)
    light = 0.25 + 0.45 * facing + 0.35 * (0.5 + 0.5 * normal @ up)
    result: NDArray[np.float64] = np.minimum(light * (weights @ np.asarray(colors, float) / 255) ** 2.2, 1.0)
    return result


def occlusion(depth: Any, v: int, u: int, focal: float, radius: float, strength: float) -> float:
    """Twin of `kernels.answers.rasterizer.occlude` for one pixel: the share of its light that is left."""
    from tsfusion.kernels.answers import rasterizer

    height, width = depth.shape

    def point(row: int, column: int) -> NDArray[np.float64]:
        x, y = (column - (width - 1) / 2) / focal, (row - (height - 1) / 2) / focal
        return float(depth[row, column]) * np.array((x, y, 1.0))

    def step(dv: int, du: int) -> NDArray[np.float64]:
        ways = []
        if v + dv < height and u + du < width:
            ways.append(point(v + dv, u + du) - point(v, u))
        if v >= dv and u >= du:
            ways.append(point(v, u) - point(v - dv, u - du))
        return min(ways, key=lambda way: abs(way[2]))

    here, normal = point(v, u), np.cross(step(1, 0), step(0, 1))
    normal /= np.linalg.norm(normal)
    reach, hidden = min(focal * radius / here[2], 0.2 * width), 0.0
    for k in range(rasterizer.TAPS):
        far, turn = reach * np.sqrt((k + 0.5) / rasterizer.TAPS), rasterizer.GOLDEN * k
        y, x = v + round(far * np.sin(turn)), u + round(far * np.cos(turn))
        if 0 <= y < height and 0 <= x < width and depth[y, x] > 0:
            way = point(y, x) - here
            length = float(np.linalg.norm(way))
            if 0 < length < radius:
                hidden += max(way @ normal / length - rasterizer.FLAT, 0.0) * (1 - length / radius)
    return max(1 - strength * hidden / rasterizer.TAPS, 0.0)


def clear_depths(keyframe: Any, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """(rows, columns) depths up to which patches of 3×3 pixels are clear, voxels; 0 = no sample."""
    image = keyframe.measurement.astype(np.float64)
    if keyframe.kind == "disparity":
        with np.errstate(divide="ignore"):
            image = keyframe.baseline_fx / (keyframe.disparity_scale * image)
    elif keyframe.measurement.dtype == np.uint16:
        image *= keyframe.depth_scale
    if keyframe.confidence is not None:
        image[keyframe.confidence == 0] = 0
    floor, slope, z0, low, high, voxel_size = parameters[:6]
    nearest, farthest, filters = parameters[7:10]
    rows, columns = -(-image.shape[0] // 3), -(-image.shape[1] // 3)
    K, found = keyframe.intrinsics, np.zeros((rows, columns))
    for r, c in product(range(rows), range(columns)):
        patch = image[3 * r : 3 * r + 3, 3 * c : 3 * c + 3].ravel()
        depths = np.sort(patch[(patch >= nearest) & (patch <= farthest)])  # NaN is in neither
        if len(depths) < (2 if filters else 1):
            continue
        least = depths[:2][-1]
        half = min(max(3 * (floor + slope * (least - z0) ** 2) / voxel_size, low), high)
        x, y = (3 * c + 1 - K.cx) / K.fx, (3 * r + 1 - K.cy) / K.fy
        found[r, c] = max(least / voxel_size - half / np.sqrt(x * x + y * y + 1), 0)
    return found


def clear_voxels(keyframe: Any, parameters: NDArray[np.float64]) -> tuple[set[Voxel], set[Voxel]]:
    """The voxels that an image looks through, beyond four voxels before the camera: those that lie there for
    certain, and those of which rounding may decide, too."""
    clear, voxel_size = clear_depths(keyframe, parameters), parameters[5]
    K, T, (rows, columns) = keyframe.intrinsics, keyframe.T_world_camera, clear.shape
    high, wide = (side / 3 for side in keyframe.shape)
    centre = T[:3, 3] / voxel_size
    x, y = (np.array([-1, 3 * columns]) - K.cx) / K.fx, (np.array([-1, 3 * rows]) - K.cy) / K.fy
    ends = np.array([(0, 0, 0), *((a, b, 1) for a in x for b in y)]) * clear.max() @ T[:3, :3].T + centre
    axes = [
        np.arange(int(low) - 2, int(high) + 3) for low, high in zip(ends.min(0), ends.max(0), strict=True)
    ]
    voxels = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    p = (voxels + 0.5 - centre) @ T[:3, :3]
    voxels, p = voxels[p[:, 2] > 3.9], p[p[:, 2] > 3.9]
    u = (p[:, 0] / p[:, 2] * K.fx + K.cx + 0.5) / 3
    v = (p[:, 1] / p[:, 2] * K.fy + K.cy + 0.5) / 3
    shift = 0.02 * np.array([(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])  # patches
    depths = []
    for du, dv in shift:
        column, row = np.floor(u + du).astype(int), np.floor(v + dv).astype(int)
        inside = (column >= 0) & (u + du < wide) & (row >= 0) & (v + dv < high)
        depths.append(np.where(inside, clear[row.clip(0, rows - 1), column.clip(0, columns - 1)], 0))
    certain = (p[:, 2] < np.min(depths, axis=0) - 0.03) & (p[:, 2] > 4.03)
    possible = p[:, 2] < np.max(depths, axis=0) + 0.03
    sure, maybe = (set(map(tuple, voxels[which].tolist())) for which in (certain, possible))
    return sure, maybe
