# SPDX-License-Identifier: MIT
"""Kernels against their NumPy twins: seeded, empty, single, negative and block-border inputs."""

import formula_scenes
import kernel_twins
import numpy as np
import pytest
from numpy.typing import NDArray

from tsfusion import Intrinsics, Keyframe
from tsfusion.core.config import SENSORS, VolumeConfig
from tsfusion.kernels import block_hash, integrate, marching_tables, rasterizer, ray_smoothing, runtime
from tsfusion.kernels.voxel_traversal import COUNT, RAY_FIELDS, START, WEIGHT
from tsfusion.tsdf.block_store import BlockStore, unpack_keys
from tsfusion.tsdf.integrator import Integrator
from tsfusion.tsdf.ray_buffers import BANDS, RayBuffers, model_parameters

QUANTA = integrate.QUANTA_PER_VOXEL
Segment = tuple[NDArray[np.int64], NDArray[np.float64], int]  # end 2⁻¹⁰ voxel, direction, half 2⁻⁸ voxel


@pytest.fixture(scope="module", autouse=True)
def taichi() -> None:
    runtime.start(2)


def random_segments(seed: int, count: int, spread: float = 40.0) -> list[Segment]:
    random = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        direction = random.normal(size=3) * random.choice([1.0, 0.0, 1e-4], size=3, p=[0.8, 0.1, 0.1])
        direction = direction if np.any(direction) else np.array([0.0, 0.0, 1.0])
        end = kernel_twins.fixed(random.uniform(-spread, spread, 3))
        found.append((end, direction, int(random.integers(256, 4096))))
    return found


def border_segments() -> list[Segment]:
    """Along the axes and diagonals, ending exactly on voxel and block borders."""
    ends = [(0, 0, 0), (8 * 1024, 0, 0), (-8 * 1024, 512, 512), (1023, 1024, -1), (7 * 1024 + 1023,) * 3]
    ways = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 1, 1), (-1, 1, -1), (1, 1, 0)]
    return [(np.array(e), np.array(d, float), 3 * 256) for e in ends for d in ways]


SEGMENTS = {
    "none": [],
    "one": random_segments(1, 1),
    "many": random_segments(2, 300),
    "crowded": random_segments(3, 300, spread=3.0),
    "borders": border_segments(),
}


def rays_along(segments: list[Segment], seed: int = 0) -> NDArray[np.int32]:
    """Rays of random weights and colours."""
    random = np.random.default_rng(seed)
    rays = [
        kernel_twins.make_ray(*segment, int(random.integers(1, 256)), int(random.integers(0, 1 << 24)))
        for segment in segments
    ]
    return np.array(rays, np.int32).reshape(-1, RAY_FIELDS)


CASES = {name: rays_along(segments) for name, segments in SEGMENTS.items()}


class Map:
    """A store and the means to put rays into it, without keyframes."""

    def __init__(self) -> None:
        self.store = BlockStore(voxel_size=1.0, color=True, corrected=True)
        self.buffers = RayBuffers(color=True, regularised=True)
        self._integrator = Integrator(self.store, self.buffers, VolumeConfig(regularizer="off"))

    def apply(self, rays: NDArray[np.int32], sign: int = 1) -> int:
        """Add the rays, spread unevenly over bands."""
        buffers = self.buffers
        buffers.rays = np.vstack([rays, np.zeros((1, RAY_FIELDS), np.int32)])
        buffers.deferred = np.zeros(len(buffers.rays), np.int32)
        buffers.colored = True
        cuts = np.sort(np.random.default_rng(0).integers(0, len(rays) + 1, BANDS - 1))
        edges = np.array([0, *cuts, len(rays)])
        buffers.bands[:, START], buffers.bands[:, COUNT] = edges[:-1], np.diff(edges)
        buffers.bands[:, WEIGHT] = 255 * np.diff(edges)
        return self._integrator.apply(sign)

    def smooth(self, smoothness: float, *, weighted: bool = True, feedback: bool = True) -> None:
        s, store = self.buffers, self.store
        s.reserve_votes()
        ray_smoothing.smooth_rays(
            s.rays, s.bands, store.hash_keys, store.hash_slots, store.places, smoothness, int(weighted),
            int(feedback), store.sums, store.correction, s.signal, s.crossed, s.votes,
        )  # fmt: skip
        ray_smoothing.commit_votes(s.touched, store.sums, s.votes, store.correction)

    def voxels(self) -> dict[kernel_twins.Voxel, tuple[int, int]]:
        """(slot, offset) of every voxel with votes."""
        found = {}
        for slot, corner in enumerate(unpack_keys(self.store.keys) * 8):
            for o in np.flatnonzero(self.store.sums[slot]):
                x, y, z = (int(c) for c in corner + (o >> 6, o >> 3 & 7, o & 7))
                found[x, y, z] = (slot, int(o))
        return found

    def value(self, at: tuple[int, int]) -> float:
        packed = int(self.store.sums[at])
        return ((packed >> 27) + float(self.store.correction[at])) / (packed & 0x7FFFFFF)


@pytest.mark.parametrize("case", ["one", "many", "crowded", "borders"])
def test_the_traversal_visits_every_voxel_the_band_runs_through(case: str) -> None:
    for (end, direction, half), ray in list(zip(SEGMENTS[case], CASES[case], strict=True))[:60]:
        visited = [voxel for voxel, _ in kernel_twins.crossed(ray)]
        assert len(set(visited)) == len(visited)
        truth = kernel_twins.segment_voxels(end, direction, half / 256)
        # a voxel missed by either is one whose corner or face is only grazed
        for voxel in truth ^ set(visited):
            assert kernel_twins.neighbours(voxel) & truth & set(visited)
        assert len(truth - set(visited)) <= 0.1 * len(truth) + 2
        ends = np.floor(end / 1024).astype(int)
        assert np.abs(np.array(kernel_twins.end_of(ray)) - ends).max() <= 1


@pytest.mark.parametrize("case", CASES)
def test_the_maps_blocks_are_those_of_the_crossed_voxels(case: str) -> None:
    here = Map()
    here.apply(CASES[case])
    found = [tuple(key) for key in unpack_keys(here.store.keys).tolist()]
    assert len(set(found)) == len(found)
    assert set(found) == kernel_twins.blocks_of(CASES[case])
    assert sorted(here.buffers.touched_slots.tolist()) == list(range(len(found)))


@pytest.mark.parametrize("case", CASES)
def test_integration_equals_the_twin_to_the_bit(case: str) -> None:
    here, half = Map(), len(CASES[case]) // 2
    # the second time, some blocks are there and some are missing
    updates = here.apply(CASES[case][:half]) + here.apply(CASES[case])
    expected = kernel_twins.integrate(np.vstack([CASES[case][:half], CASES[case]]), QUANTA)
    found = {voxel: int(here.store.sums[at]) for voxel, at in here.voxels().items()}
    assert found == {voxel: (s << 27) + w for voxel, (s, w) in expected.items()}
    assert updates == sum(len(kernel_twins.crossed(ray)) for ray in (*CASES[case][:half], *CASES[case]))


@pytest.mark.parametrize("case", CASES)
def test_colours_equal_the_twin_to_the_bit(case: str) -> None:
    here = Map()
    here.apply(CASES[case])
    voxels, rgn = here.voxels(), here.store.color_rgn
    found = {
        voxel: (int(rgn[at] >> 40), int(rgn[at] >> 16 & 0xFFFFFF), int(here.store.color_b[at]),
                int(rgn[at] & 0xFFFF))
        for voxel, at in voxels.items() if rgn[at]
    }  # fmt: skip
    assert found == kernel_twins.colors(CASES[case])


@pytest.mark.parametrize("case", CASES)
def test_what_is_taken_away_leaves_no_bit(case: str) -> None:
    here = Map()
    here.apply(CASES["many"])
    before = {name: layer.copy() for name, layer in here.store.layers().items()}
    here.apply(CASES[case])
    here.apply(CASES[case], sign=-1)
    for name, layer in here.store.layers().items():
        assert (layer[: len(before[name])] == before[name]).all()
        assert not layer[len(before[name]) :].any()


def test_many_missing_blocks_are_all_found() -> None:
    rays = rays_along(random_segments(7, 6000, spread=400.0))
    here = Map()
    here.apply(rays)
    assert here.store.count == len(kernel_twins.blocks_of(rays))


def test_the_map_hash_finds_what_was_inserted_and_nothing_else() -> None:
    keys = np.unique(np.random.default_rng(4).integers(1, 1 << 62, 3000))
    table, slots = np.zeros(8192, np.int64), np.zeros(8192, np.int32)
    block_hash.insert_blocks(keys, 0, 1000, 0, table, slots)
    block_hash.insert_blocks(keys, 1000, 1000, 1000, table, slots)
    found = np.empty(len(keys), np.int32)
    block_hash.find_blocks(keys, table, slots, found)
    assert (found == np.where(np.arange(len(keys)) < 2000, np.arange(len(keys)), -1)).all()


def test_dropped_blocks_are_not_found_and_the_rest_are() -> None:
    here = Map()
    here.apply(CASES["many"])
    keys, kept = here.store.keys.copy(), here.store.count - 5
    here.store.sums[kept:] = 0
    here.store.drop(kept)
    found = here.store.slots_of(keys)
    assert (found == np.where(np.arange(len(keys)) < kept, np.arange(len(keys)), -1)).all()


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("case", ["one", "many", "crowded", "borders"])
def test_smoothing_equals_a_dense_solve(case: str, weighted: bool) -> None:
    smoothness, here, random = 2.5, Map(), np.random.default_rng(5)
    # part of the voxels were in the map before, with smoothed values of their own
    here.apply(rays_along(random_segments(6, 200, spread=20.0)))
    weight = here.store.sums & 0x7FFFFFF
    here.store.correction[:] = random.normal(0, 30, weight.shape) * weight
    before = {
        voxel: (here.value(at), int(weight[at])) for voxel, at in here.voxels().items() if weight[at] > 0
    }
    here.apply(CASES[case])
    here.smooth(smoothness, weighted=weighted)
    expected = kernel_twins.smooth(CASES[case], QUANTA, before, smoothness, weighted)
    voxels = here.voxels()
    assert expected.keys() <= voxels.keys()
    # values reach ±1000 quanta: a float32 solve and a sixteenth of a quantum of rounding
    assert max(abs(here.value(voxels[v]) - expected[v]) for v in expected) < 0.2
    for voxel in before.keys() - expected.keys():
        assert abs(here.value(voxels[voxel]) - before[voxel][0]) < 1e-3
    assert not here.buffers.votes.any()


def test_a_ramp_passes_the_smoother_unchanged() -> None:
    for ray in CASES["many"][:40]:
        here = Map()
        here.apply(ray[None])
        here.smooth(1000.0, feedback=False)
        weight = np.maximum(here.store.sums & 0x7FFFFFF, 1)
        # the stored ramp is rounded to quanta; nothing else may bend it
        assert np.abs(here.store.correction / weight).max() <= 0.75


def test_no_smoothness_returns_the_signal() -> None:
    here = Map()
    here.apply(CASES["crowded"])
    here.smooth(0.0, feedback=False)
    weight = np.maximum(here.store.sums & 0x7FFFFFF, 1)
    assert np.abs(here.store.correction / weight).max() <= 0.05


def image_keyframe(seed: int, kind: str) -> Keyframe:
    """A slanted plane with a step, noise, holes and lone pixels; some tiles are flat."""
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(random.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    pose[:3, 3] = random.uniform(-2, 2, 3)
    camera = Intrinsics(60.0, -58.0, 19.5, 14.5)
    v, u = np.mgrid[:30, :41]
    metres = 1.0 + 0.02 * u + 0.01 * v + 0.5 * (v > 20) + 0.01 * random.normal(size=(30, 41))
    metres[random.random((30, 41)) < 0.1] = 0.0
    alone = (random.random((30, 41)) < 0.1) & (v > 12)
    metres[alone] = random.uniform(0.5, 4.0, alone.sum())
    if kind == "disparity":
        image = np.where(metres > 0, 30.0 / np.maximum(metres, 0.01) * 16, 0).clip(0, 65535).astype(np.uint16)
        return Keyframe(disparity=image, baseline_fx=30.0, intrinsics=camera, T_world_camera=pose)
    if kind == "float":
        depth = metres.astype(np.float32)
        depth[0, :5] = (np.nan, np.inf, -1.0, 0.0, 2.0)
        return Keyframe(depth=depth, intrinsics=camera, T_world_camera=pose)
    return Keyframe(depth=(metres * 1000).astype(np.uint16), intrinsics=camera, T_world_camera=pose)


def depth_of(keyframe: Keyframe, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W) metres, 0 where there is no usable return."""
    raw = np.nan_to_num(keyframe.measurement.astype(np.float64), nan=0.0, posinf=0.0)
    if keyframe.kind == "disparity":
        z = keyframe.baseline_fx * 16 / np.maximum(raw, 1e-9)
    else:
        z = raw * (keyframe.depth_scale if keyframe.measurement.dtype == np.uint16 else 1.0)
    return np.where((raw > 0) & (z >= parameters[7]) & (z <= parameters[8]), z, 0.0)


def expected_rays(
    keyframe: Keyframe, parameters: NDArray[np.float64], voxel_size: float, bundled: bool, filtered: bool
) -> tuple[list[NDArray[np.int32]], int]:
    """Rays by tile, cell and layer, and how many samples went into them."""
    K, T = keyframe.intrinsics, keyframe.T_world_camera
    assert K is not None
    metres = depth_of(keyframe, parameters)
    pitch = max(1 / abs(K.fx), 1 / abs(K.fy)) / voxel_size
    rays, used = [], 0

    def tolerance(z: float) -> float:
        return voxel_size + 4 * (parameters[0] + parameters[1] * (z - parameters[2]) ** 2)

    for top, left in np.ndindex(-(-metres.shape[0] // 12), -(-metres.shape[1] // 12)):
        tile = metres[12 * top : 12 * top + 12, 12 * left : 12 * left + 12]
        if not tile.any():
            continue
        wide, high = kernel_twins.cell_shape(tile, pitch) if bundled else (1, 1)
        sigma = (tolerance(float(tile[tile > 0].mean())) - voxel_size) / 4
        plane = kernel_twins.tile_plane(tile, sigma, voxel_size) if bundled else None
        for y, x in np.ndindex(-(-tile.shape[0] // high), -(-tile.shape[1] // wide)):
            cell = tile[y * high : (y + 1) * high, x * wide : (x + 1) * wide]
            for layer in kernel_twins.layers(cell, tolerance):
                v, u = np.argwhere(layer).mean(axis=0) + (y * high, x * wide)
                z = cell[layer].mean()
                if filtered and layer.sum() == 1:
                    v0, u0 = int(v) + 12 * top, int(u) + 12 * left
                    around = metres[max(v0 - 1, 0) : v0 + 2, max(u0 - 1, 0) : u0 + 2]
                    if ((around > 0) & (np.abs(around - z) <= tolerance(z))).sum() < 2:
                        continue
                v, u = v + 12 * top, u + 12 * left
                ray = T[:3, :3] @ ((u - K.cx) / K.fx, (v - K.cy) / K.fy, 1)
                normal = None
                if plane is not None:
                    right, down = T[:3, 0] / K.fx * z + ray * plane[0], T[:3, 1] / K.fy * z + ray * plane[1]
                    normal = np.cross(right, down)
                weight, half = kernel_twins.sample(parameters, z, 255 * layer.sum())
                end = kernel_twins.fixed((ray * z + T[:3, 3]) / voxel_size)
                rays.append(kernel_twins.make_ray(end, ray, half, weight, normal=normal))
                used += int(layer.sum())
    return rays, used


def close(found: NDArray[np.int32], expected: list[NDArray[np.int32]]) -> None:
    """The same rays in the same order, but for the last bits of rounded floats."""
    wanted = np.array(expected, np.int64)
    assert found.shape == wanted.shape
    ends = [ray_ends(rays.astype(np.float64)) for rays in (found, wanted)]
    assert np.abs(ends[0] - ends[1]).max() <= 0.01  # voxels
    assert (np.abs(found[:, 9:12] - wanted[:, 9:12]) <= 64 + abs(wanted[:, 9:12]) / 64).all()
    assert (found[:, 14] & 7 == wanted[:, 14] & 7).all()
    assert np.abs(found[:, 14] - wanted[:, 14]).max() <= 512
    assert np.abs((found[:, 15] >> 24 & 255) - (wanted[:, 15] >> 24 & 255)).max() <= 1


def ray_ends(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) the distance of the coordinate origin to each ray's plane, voxels: free of the first voxel."""
    downward = rays[:, 14].astype(int)[:, None] >> np.arange(3) & 1
    gradient = rays[:, 9:12] * (1 - 2 * downward)
    return (((rays[:, :3] + 0.5) * gradient).sum(axis=1) + rays[:, 12]) / 65536


def rays_of(buffers: RayBuffers) -> NDArray[np.int32]:
    return np.vstack([buffers.rays[s : s + n] for s, n in buffers.bands[:, [START, COUNT]]])


@pytest.mark.parametrize("bundled", [True, False])
@pytest.mark.parametrize("kind", ["uint16", "float", "disparity"])
def test_rays_from_images_equal_the_twin(kind: str, bundled: bool) -> None:
    keyframe, voxel_size = image_keyframe(11, kind), 0.05
    parameters = model_parameters(SENSORS["stereo"], voxel_size, keyframe.baseline_fx)
    buffers = RayBuffers(color=False, regularised=False)
    samples = buffers.make_rays(
        keyframe, VolumeConfig(sensor="stereo", voxel_size=voxel_size, bundle=bundled)
    )
    expected, used = expected_rays(keyframe, parameters, voxel_size, bundled, filtered=True)
    assert 0 < used < np.count_nonzero(depth_of(keyframe, parameters))  # some lone pixels are dropped
    assert samples == used
    close(rays_of(buffers), expected)


def test_a_plane_is_met_exactly_by_every_voxel_beside_a_ray() -> None:
    normal, offset = np.array([0.6, -0.48, 0.64]), 1.5
    keyframe = formula_scenes.plane_keyframe(np.eye(4), normal, offset)
    voxel_size = 0.05
    here = Map()
    here.buffers.make_rays(keyframe, VolumeConfig(voxel_size=voxel_size))
    here.apply(rays_of(here.buffers))
    errors, across = [], []
    for voxel, at in here.voxels().items():
        centre = (np.array(voxel) + 0.5) * voxel_size
        ray = centre / np.linalg.norm(centre)
        truth = (offset - centre @ normal) / (ray @ normal) / voxel_size
        errors.append(here.value(at) / QUANTA - truth)
        across.append(abs(offset - centre @ normal) / voxel_size)
    near = np.array(across) < 1
    assert near.sum() > 1000
    # rays of neighbouring directions meet in a voxel, so not every value is exact, but none is biased
    assert np.abs(np.array(errors)[near]).mean() < 0.05
    assert abs(np.array(errors)[near].mean()) < 0.01


@pytest.mark.parametrize("bundled", [True, False])
@pytest.mark.parametrize("own_origins", [True, False])
def test_rays_from_points_equal_the_twin(own_origins: bool, bundled: bool) -> None:
    random = np.random.default_rng(13)
    points = (random.uniform(-3, 3, 3) + np.cumsum(random.normal(0, 0.1, (700, 3)), axis=0)).astype(
        np.float32
    )
    points[5] = np.nan
    origins = random.uniform(-0.2, 0.2, (700, 3)).astype(np.float32) if own_origins else None
    pose = np.eye(4)
    pose[:3, 3] = (1.0, -2.0, 3.0)
    keyframe = Keyframe(points=points, origins=origins, T_world_camera=pose)
    voxel_size, model = 0.2, SENSORS["scanner"]
    buffers = RayBuffers(color=False, regularised=False)
    config = VolumeConfig(sensor="scanner", voxel_size=voxel_size, bundle=bundled)
    samples = buffers.make_rays(keyframe, config)
    parameters = model_parameters(model, voxel_size, None)
    starts = np.zeros((700, 3)) if origins is None else origins.astype(np.float64)
    expected = []
    for band in range(BANDS):
        part = slice(band * 700 // BANDS, (band + 1) * 700 // BANDS)
        p, o = points[part].astype(np.float64), starts[part]
        valid = np.flatnonzero(np.isfinite(p).all(axis=1))
        for run in kernel_twins.runs(p, voxel_size) if bundled else [[i] for i in valid]:
            end, start = p[run].mean(axis=0), o[run].mean(axis=0)
            weight, half = kernel_twins.sample(parameters, float(np.linalg.norm(end - start)), 255 * len(run))
            end = kernel_twins.fixed((end + pose[:3, 3]) / voxel_size)
            expected.append(kernel_twins.make_ray(end, p[run].mean(axis=0) - start, half, weight))
    assert samples == 699
    close(rays_of(buffers), expected)


def test_marching_cubes_cases_are_closed_and_complementary() -> None:
    for case in range(256):
        edges = marching_tables.TRIANGLE_EDGES[case, : 3 * marching_tables.TRIANGLE_COUNT[case]]
        crossing = {e for e, (a, b) in enumerate(marching_tables.EDGES) if (case >> a & 1) != (case >> b & 1)}
        assert set(edges.tolist()) == crossing


def test_shading_equals_the_twin() -> None:
    random = np.random.default_rng(31)
    centres = random.uniform((-2, -1.5, 2), (2, 1.5, 6), (40, 1, 3))
    vertices = (centres + random.normal(0, 0.6, (40, 3, 3))).reshape(-1, 3).astype(np.float32)
    vertices[:, 2] = np.maximum(vertices[:, 2], 0.5)
    normals = random.normal(size=vertices.shape)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    colors = random.integers(0, 256, vertices.shape).astype(np.uint8)
    faces = np.arange(120, dtype=np.int32).reshape(-1, 3)
    focal, up = 50.0, np.array([0.0, -0.8, -0.6])
    seen = np.full((48, 64), rasterizer.EMPTY, np.int64)
    image = np.zeros((48, 64, 4), np.float32)
    rasterizer.rasterise(seen, vertices, faces, focal, 0.05)
    rasterizer.shade(image, seen, vertices, faces, normals, colors, focal, *up, rasterizer.EMPTY)
    pixels = np.argwhere(seen != rasterizer.EMPTY)
    assert len(pixels) > 500
    for v, u in pixels[::7]:
        corner = faces[seen[v, u] & 0xFFFFFFFF]
        ray = np.array([(u - 31.5) / focal, (v - 23.5) / focal, 1.0])
        expected = kernel_twins.shade(vertices[corner], normals[corner], colors[corner], ray, up)
        assert np.allclose(image[v, u, :3], expected, atol=2e-3)
