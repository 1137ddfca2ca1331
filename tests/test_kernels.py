# SPDX-License-Identifier: MIT
"""Kernels against their NumPy twins: seeded, empty, single, negative and block-border inputs."""

import numpy as np
import pytest
import reference
from numpy.typing import NDArray

from tsfusion import Intrinsics, Keyframe, runtime
from tsfusion.config import SENSORS
from tsfusion.kernels import blocks, integrate, mc_tables, raster, smooth
from tsfusion.scratch import Scratch, model_parameters

QUANTA = integrate.QUANTA_PER_VOXEL


@pytest.fixture(scope="module", autouse=True)
def taichi() -> None:
    runtime.start(2)


def random_rays(seed: int, count: int, spread: float = 40.0) -> NDArray[np.int32]:
    random = np.random.default_rng(seed)
    rays = []
    for _ in range(count):
        direction = random.normal(size=3) * random.choice([1.0, 0.0, 1e-4], size=3, p=[0.8, 0.1, 0.1])
        direction = direction if np.any(direction) else np.array([0.0, 0.0, 1.0])
        end = reference.fixed(random.uniform(-spread, spread, 3))
        rays.append(
            reference.make_ray(end, direction, int(random.integers(256, 4096)), int(random.integers(1, 256)))
        )
    return np.array(rays, np.int32).reshape(-1, 8)


def border_rays() -> NDArray[np.int32]:
    """Along the axes and diagonals, ending exactly on voxel and block borders."""
    ends = [(0, 0, 0), (8 * 1024, 0, 0), (-8 * 1024, 512, 512), (1023, 1024, -1), (7 * 1024 + 1023,) * 3]
    ways = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 1, 1), (-1, 1, -1), (1, 1, 0)]
    return np.array([reference.make_ray(e, d, 3 * 256, 16) for e in ends for d in ways], np.int32)


CASES = {
    "none": np.zeros((0, 8), np.int32),
    "one": random_rays(1, 1),
    "many": random_rays(2, 300),
    "crowded": random_rays(3, 300, spread=3.0),
    "borders": border_rays(),
}


def load(rays: NDArray[np.int32]) -> Scratch:
    """A scratch that holds these rays, spread unevenly over bands."""
    scratch = Scratch(color=False, regularised=True, max_blocks=1 << 17)
    scratch.rays = np.vstack([rays, np.zeros((1, 8), np.int32)])
    cuts = np.sort(np.random.default_rng(0).integers(0, len(rays) + 1, len(scratch.band_count) - 1))
    edges = np.array([0, *cuts, len(rays)])
    scratch.band_start[:], scratch.band_count[:] = edges[:-1], np.diff(edges)
    scratch.touch(np.zeros(64, np.int64), np.zeros(64, np.int32))
    return scratch


def unpack(key: int) -> tuple[int, int, int]:
    mask = (1 << 21) - 1
    return tuple(int((key >> s) & mask) - (1 << 20) for s in (42, 21, 0))  # type: ignore[return-value]


def voxels_of(scratch: Scratch, sums: NDArray[np.int64]) -> dict[tuple[int, int, int], int]:
    found = {}
    for i in range(scratch.touched):
        corner = np.array(unpack(int(scratch.touched_keys[i]))) * 8
        for o in np.flatnonzero(sums[i]):
            found[tuple(int(c) for c in corner + (o >> 6, o >> 3 & 7, o & 7))] = int(sums[i, o])
    return found


def sum_rays(scratch: Scratch) -> None:
    integrate.integrate_rays(
        scratch.rays, scratch.band_start, scratch.band_count, scratch.table, scratch.table_index,
        0, scratch.frame, scratch.frame_color,
    )  # fmt: skip


@pytest.mark.parametrize("case", ["one", "many", "crowded", "borders"])
def test_the_traversal_visits_every_voxel_the_band_runs_through(case: str) -> None:
    for ray in CASES[case][:60]:
        visited = [voxel for voxel, _ in reference.crossed(ray)]
        assert len(set(visited)) == len(visited)
        truth = reference.segment_voxels(ray)
        # a voxel missed by either is one whose corner or face is only grazed
        for voxel in truth ^ set(visited):
            assert reference.neighbours(voxel) & truth & set(visited)
        assert len(truth - set(visited)) <= 0.1 * len(truth) + 2


@pytest.mark.parametrize("case", CASES)
def test_touched_blocks_are_those_of_the_crossed_voxels(case: str) -> None:
    scratch = load(CASES[case])
    found = [unpack(int(k)) for k in scratch.touched_keys[: scratch.touched]]
    assert len(set(found)) == len(found)
    assert set(found) == reference.blocks_of(CASES[case])


@pytest.mark.parametrize("case", CASES)
def test_integration_equals_the_twin_to_the_bit(case: str) -> None:
    scratch = load(CASES[case])
    sum_rays(scratch)
    expected = reference.integrate(CASES[case], QUANTA)
    found = voxels_of(scratch, scratch.frame)
    assert found == {voxel: (s << 27) + w for voxel, (s, w) in expected.items()}


def test_a_full_set_is_grown_and_loses_nothing() -> None:
    rays = random_rays(7, 6000, spread=400.0)
    scratch = load(rays)
    assert len(scratch.table) > 1 << 14
    assert scratch.touched == len(reference.blocks_of(rays))


def test_the_map_hash_finds_what_was_inserted_and_nothing_else() -> None:
    keys = np.unique(np.random.default_rng(4).integers(1, 1 << 62, 3000))
    table, slots = np.zeros(8192, np.int64), np.zeros(8192, np.int32)
    blocks.insert_blocks(keys, 0, 1000, 0, table, slots)
    blocks.insert_blocks(keys, 1000, 1000, 1000, table, slots)
    found = np.empty(len(keys), np.int32)
    blocks.find_blocks(keys, table, slots, found)
    assert (found == np.where(np.arange(len(keys)) < 2000, np.arange(len(keys)), -1)).all()


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("case", ["one", "many", "crowded", "borders"])
def test_smoothing_equals_a_dense_solve(case: str, weighted: bool) -> None:
    rays, smoothness = CASES[case], 2.5
    scratch = load(rays)
    sum_rays(scratch)
    random = np.random.default_rng(5)
    # half of the touched blocks were in the map before, with values and weights of their own
    slots = np.where(np.arange(scratch.touched) % 2 == 0, np.arange(scratch.touched), -1)
    scratch.touched_slots[: scratch.touched] = slots
    weights = random.integers(0, 200, (scratch.touched, 512))
    values = random.normal(0, 100, (scratch.touched, 512)).astype(np.float32)
    before = {}
    for i in np.flatnonzero(slots >= 0):
        corner = np.array(unpack(int(scratch.touched_keys[i]))) * 8
        for o in range(512):
            voxel = tuple(int(c) for c in corner + (o >> 6, o >> 3 & 7, o & 7))
            before[voxel] = (float(values[i, o]), int(weights[i, o]))
    smooth.smooth_rays(
        scratch.rays, scratch.band_start, scratch.band_count, scratch.table, scratch.table_index,
        scratch.touched_slots, smoothness, int(weighted), 1, scratch.frame,
        weights.astype(np.int64), values, scratch.signal, scratch.crossed, scratch.votes,
    )  # fmt: skip
    scratch.touched_slots[: scratch.touched] = np.arange(scratch.touched)
    after = np.full((scratch.touched, 512), np.nan, np.float32)
    smooth.commit_regularised(scratch.touched_slots, scratch.touched, scratch.votes, after)
    expected = reference.smooth(rays, QUANTA, before, smoothness, weighted)
    found = {}
    for i in range(scratch.touched):
        corner = np.array(unpack(int(scratch.touched_keys[i]))) * 8
        for o in np.flatnonzero(np.isfinite(after[i])):
            found[tuple(int(c) for c in corner + (o >> 6, o >> 3 & 7, o & 7))] = float(after[i, o])
    assert found.keys() == expected.keys()
    # values reach ±1000 quanta: a float32 solve and a sixteenth of a quantum of rounding
    assert max(abs(found[v] - expected[v]) for v in expected) < 0.2


def image_keyframe(seed: int, kind: str) -> Keyframe:
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(random.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    pose[:3, 3] = random.uniform(-2, 2, 3)
    camera = Intrinsics(60.0, -58.0, 19.5, 14.5)
    metres = random.uniform(0.0, 3.0, (30, 41)) * (random.random((30, 41)) > 0.2)
    if kind == "disparity":
        image = np.where(metres > 0, 30.0 / np.maximum(metres, 0.01) * 16, 0).clip(0, 65535).astype(np.uint16)
        return Keyframe(disparity=image, baseline_fx=30.0, intrinsics=camera, T_world_camera=pose)
    if kind == "float":
        depth = metres.astype(np.float32)
        depth[0, :5] = (np.nan, np.inf, -1.0, 0.0, 2.0)
        return Keyframe(depth=depth, intrinsics=camera, T_world_camera=pose)
    return Keyframe(depth=(metres * 1000).astype(np.uint16), intrinsics=camera, T_world_camera=pose)


def expected_samples(keyframe: Keyframe, parameters: NDArray[np.float64], voxel_size: float) -> dict:
    """Samples by tile: (point, origin, weight, half), positions in voxels."""
    K, T = keyframe.intrinsics, keyframe.T_world_camera
    assert K is not None
    tiles: dict[tuple[int, int], list] = {}
    for v, u in np.ndindex(*keyframe.shape):
        raw = float(keyframe.measurement[v, u])
        if keyframe.kind == "disparity":
            z = keyframe.baseline_fx * 16 / max(raw, 1e-9)
        else:
            z = raw * (keyframe.depth_scale if keyframe.measurement.dtype == np.uint16 else 1.0)
        if not (raw > 0 and parameters[7] <= z <= parameters[8]):
            continue
        p = T[:3, :3] @ ((u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z) + T[:3, 3]
        weight, half = reference.sample(parameters, z, 255)
        tiles.setdefault((v // 16, u // 16), []).append((p / voxel_size, T[:3, 3] / voxel_size, weight, half))
    return tiles


def close(found: NDArray[np.int32], expected: list[NDArray[np.int32]]) -> None:
    """Same rays but for the last bit of a rounded float."""
    wanted = np.array(expected, np.int64)
    assert found.shape == wanted.shape
    order = [np.lexsort(a[:, [2, 1, 0]].T) for a in (found, wanted)]
    difference = np.abs(found[order[0]].astype(np.int64) - wanted[order[1]])
    assert difference[:, :3].max() <= 2
    assert difference[:, 3:6].max() <= 64
    assert np.abs((found[order[0], 6] >> 16) - (wanted[order[1], 6] >> 16)).max() <= 1
    assert np.abs((found[order[0], 6] & 65535) - (wanted[order[1], 6] & 65535)).max() <= 1


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("kind", ["uint16", "float", "disparity"])
def test_rays_from_images_equal_the_twin(kind: str, exact: bool) -> None:
    keyframe, voxel_size = image_keyframe(11, kind), 0.05
    parameters = model_parameters(SENSORS["stereo"], voxel_size, keyframe.baseline_fx)
    scratch = Scratch(color=False, regularised=False, max_blocks=1 << 17)
    valid = scratch.make_rays(keyframe, SENSORS["stereo"], voxel_size, not exact)
    tiles = expected_samples(keyframe, parameters, voxel_size)
    assert valid == sum(len(t) for t in tiles.values())
    expected = []
    for samples in tiles.values():
        if exact:
            expected += [reference.make_ray(reference.fixed(p), p - o, h, w) for p, o, w, h in samples]
        else:
            expected += reference.bundle(samples)
    close(rays_of(scratch), expected)


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("own_origins", [True, False])
def test_rays_from_points_equal_the_twin(own_origins: bool, exact: bool) -> None:
    random = np.random.default_rng(13)
    points = random.uniform(-3, 3, (700, 3)).astype(np.float32)
    points[5] = np.nan
    origins = random.uniform(-0.2, 0.2, (700, 3)).astype(np.float32) if own_origins else None
    pose = np.eye(4)
    pose[:3, 3] = (1.0, -2.0, 3.0)
    keyframe = Keyframe(points=points, origins=origins, T_world_camera=pose)
    voxel_size, model = 0.2, SENSORS["scanner"]
    scratch = Scratch(color=False, regularised=False, max_blocks=1 << 17)
    valid = scratch.make_rays(keyframe, model, voxel_size, not exact)
    parameters = model_parameters(model, voxel_size, None)
    expected = []
    for first in range(0, 700, 256):
        samples = []
        for n in range(first, min(first + 256, 700)):
            o = np.zeros(3) if origins is None else origins[n].astype(np.float64)
            p = points[n].astype(np.float64)
            if np.isfinite(p).all():
                weight, half = reference.sample(parameters, float(np.linalg.norm(p - o)), 255)
                samples.append(((p + pose[:3, 3]) / voxel_size, (o + pose[:3, 3]) / voxel_size, weight, half))
        if exact:
            expected += [reference.make_ray(reference.fixed(p), p - o, h, w) for p, o, w, h in samples]
        else:
            expected += reference.bundle(samples)
    assert valid == 699
    close(rays_of(scratch), expected)


def rays_of(scratch: Scratch) -> NDArray[np.int32]:
    spans = zip(scratch.band_start, scratch.band_count, strict=True)
    return np.vstack([scratch.rays[s : s + n] for s, n in spans])


def smoothed(rays: NDArray[np.int32], sums: NDArray[np.int64], smoothness: float) -> NDArray[np.float32]:
    """Kernel's values (touched, 512) with A = W and y from `sums` and these rays; NaN where no ray went."""
    scratch = load(rays)
    sum_rays(scratch)
    scratch.touched_slots[: scratch.touched] = np.arange(scratch.touched)
    after = np.full((scratch.touched, 512), np.nan, np.float32)
    smooth.smooth_rays(
        scratch.rays, scratch.band_start, scratch.band_count, scratch.table, scratch.table_index,
        scratch.touched_slots, smoothness, 1, 0, scratch.frame, sums, after,
        scratch.signal, scratch.crossed, scratch.votes,
    )  # fmt: skip
    smooth.commit_regularised(scratch.touched_slots, scratch.touched, scratch.votes, after)
    return after


def test_a_ramp_passes_the_smoother_unchanged() -> None:
    for ray in CASES["many"][:40]:
        scratch = load(ray[None])
        sum_rays(scratch)
        plain = reference.raw_values(scratch.frame[: scratch.touched])
        after = smoothed(ray[None], np.zeros((scratch.touched, 512), np.int64), 1000.0)
        crossed = np.isfinite(after)
        assert crossed.sum() == len(reference.crossed(ray))
        # the stored ramp is rounded to quanta; nothing else may bend it
        assert np.abs(after - plain)[crossed].max() <= 0.75


def test_no_smoothness_returns_the_signal() -> None:
    rays = CASES["crowded"]
    scratch = load(rays)
    sum_rays(scratch)
    random = np.random.default_rng(8)
    weight = random.integers(1, 500, (scratch.touched, 512))
    before = (random.integers(-900, 900, weight.shape) * weight << 27) + weight
    after = smoothed(rays, before, 0.0)
    plain = reference.raw_values(before + scratch.frame[: scratch.touched])
    crossed = np.isfinite(after)
    assert np.abs(after - plain)[crossed].max() <= 0.05


def random_commit(seed: int) -> tuple[Scratch, NDArray, NDArray, NDArray, dict]:
    """A scratch with colour whose blocks are partly in a map of random sums, and its colours as lists."""
    random = np.random.default_rng(seed)
    scratch = Scratch(color=True, regularised=False, max_blocks=1 << 17)
    rays = CASES["many"].copy()
    rays[:, 7] = random.integers(0, 1 << 24, len(rays))
    scratch.rays, scratch.colored = rays, True
    scratch.band_count[0] = len(rays)
    scratch.touch(np.zeros(64, np.int64), np.zeros(64, np.int32))
    integrate.integrate_rays(
        scratch.rays, scratch.band_start, scratch.band_count, scratch.table, scratch.table_index,
        1, scratch.frame, scratch.frame_color,
    )  # fmt: skip
    scratch.touched_slots[: scratch.touched] = random.permutation(scratch.touched)
    colors: dict = {}
    for ray in rays:
        hit = ray[:3] >> 10
        key = int(sum((int(h >> 3) + (1 << 20)) << s for h, s in zip(hit, (42, 21, 0), strict=True)))
        block = int(np.flatnonzero(scratch.touched_keys[: scratch.touched] == key)[0])
        offset = int((hit[0] & 7) << 6 | (hit[1] & 7) << 3 | hit[2] & 7)
        rgb = (int(ray[7]) >> 16, int(ray[7]) >> 8 & 255, int(ray[7]) & 255)
        colors.setdefault((block, offset), []).append(rgb)
    weight = random.integers(0, 1000, (scratch.touched, 512))
    sums = (random.integers(-900, 900, weight.shape) * weight << 27) + weight
    rgn = random.integers(0, 1 << 60, weight.shape) & ~np.int64(0xFFFF) | random.integers(
        0, 100, weight.shape
    )
    return scratch, sums, rgn, random.integers(0, 1 << 20, weight.shape).astype(np.int32), colors


@pytest.mark.parametrize("sign", [1, -1])
def test_commits_equal_the_twin_to_the_bit(sign: int) -> None:
    scratch, sums, rgn, blue, colors = random_commit(21)
    n, slots = scratch.touched, scratch.touched_slots[: scratch.touched]
    expected = reference.commit(sums, slots, scratch.frame[:n], sign)
    expected_rgn, expected_blue = reference.commit_color(rgn, blue, slots, colors, sign)
    dirty = np.zeros(n, np.uint8)
    changed = integrate.commit_blocks(scratch.touched_slots, n, sign, scratch.frame, sums, dirty)
    integrate.commit_color(scratch.touched_slots, n, sign, scratch.frame_color, rgn, blue)
    assert changed == np.count_nonzero(scratch.frame[:n])
    assert dirty.all()
    assert (sums == expected).all()
    assert (rgn == expected_rgn).all()
    assert (blue == expected_blue).all()
    values = np.full(sums.shape, np.nan, np.float32)
    smooth.reset_regularised(scratch.touched_slots, n, sums, values)
    assert np.allclose(values, reference.raw_values(sums), rtol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_refusals_equal_the_twin(sign: int) -> None:
    scratch, sums, rgn, _, colors = random_commit(22)
    n, slots = scratch.touched, scratch.touched_slots[: scratch.touched]
    sums[:] = (1 << 26) - 200 if sign > 0 else 200
    rgn[:] = 1
    rgn[slots[::5]] = (1 << 15) - 1 if sign > 0 else 0
    slots[::7] = -1
    expected = reference.refused(sums, slots, scratch.frame[:n], colors, rgn, sign)
    assert 0 < expected < n
    found = integrate.refuse_blocks(
        scratch.touched_slots, n, sign, scratch.frame, scratch.frame_color, sums, rgn, 1
    )
    assert found == expected


def test_marching_cubes_cases_are_closed_and_complementary() -> None:
    for case in range(256):
        edges = mc_tables.TRIANGLE_EDGES[case, : 3 * mc_tables.TRIANGLE_COUNT[case]]
        crossing = {e for e, (a, b) in enumerate(mc_tables.EDGES) if (case >> a & 1) != (case >> b & 1)}
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
    seen = np.full((48, 64), raster.EMPTY, np.int64)
    image = np.zeros((48, 64, 4), np.float32)
    raster.rasterise(seen, vertices, faces, focal, 0.05)
    raster.shade(image, seen, vertices, faces, normals, colors, focal, *up, raster.EMPTY)
    pixels = np.argwhere(seen != raster.EMPTY)
    assert len(pixels) > 500
    for v, u in pixels[::7]:
        corner = faces[seen[v, u] & 0xFFFFFFFF]
        ray = np.array([(u - 31.5) / focal, (v - 23.5) / focal, 1.0])
        expected = reference.shade(vertices[corner], normals[corner], colors[corner], ray, up)
        assert np.allclose(image[v, u, :3], expected, atol=2e-3)
