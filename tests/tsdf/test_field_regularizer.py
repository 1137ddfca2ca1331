# SPDX-License-Identifier: MIT
"""The field regulariser: what it solves, what it leaves alone, and that only the sums decide it."""

import hashlib
import math
from functools import partial
from itertools import product
from pathlib import Path

import kernel_twins
import numpy as np
import pytest
from block_stores import store_of
from command_processes import python
from formula_scenes import sphere_views, tilted_plane, volume_of, with_noise
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tsfusion.tsdf.store.block_store import pack_keys
from tsfusion.tsdf.surface import field_regularizer
from tsfusion.tsdf.surface.field_regularizer import FieldSettings, along_normals, solve, values_of
from tsfusion.tsdf.surface.mesh_extraction import extract

QUANTA = 60
SETTINGS = FieldSettings(smoothness=10.0, edge=0.03, reweightings=2)
STRONG = FieldSettings(smoothness=500.0, edge=0.03, reweightings=2)


def map_of(
    distance: NDArray[np.float64], weight: NDArray[np.int64], low: tuple[int, int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys and sums of dense (8a, 8b, 8c) arrays in voxels and sixteenths of a sample; `low` block."""
    shape = tuple(n // 8 for n in distance.shape)
    coordinates = np.array(list(product(*map(range, shape))))
    m = np.rint(distance * QUANTA).astype(np.int64)
    sums = ((m * weight) << 27) + weight
    cut = sums.reshape(shape[0], 8, shape[1], 8, shape[2], 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 512)
    return pack_keys(coordinates + np.array(low)), np.ascontiguousarray(cut)


def dense(rows: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Rows in key order, back as one dense array."""
    a, b, c = (n // 8 for n in shape)
    return rows.reshape(a, b, c, 8, 8, 8).transpose(0, 3, 1, 4, 2, 5).reshape(shape)


def centres(shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in shape), indexing="ij"), axis=-1)


def noisy_roof(seed: int, seen: float = 0.95) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Two planes that meet at an edge, noise, uneven weights, holes: (24, 16, 16)."""
    random = np.random.default_rng(seed)
    p = centres((24, 16, 16)) - (12.0, 8.0, 8.0)
    distance = np.maximum(p @ (0.6, 0.0, 0.8), p @ (-0.6, 0.48, 0.64))
    distance += 0.15 * random.standard_normal(distance.shape)
    weight = random.integers(16, 160, distance.shape) * (random.random(distance.shape) < seen)
    return np.clip(distance, -6, 6), weight


@pytest.mark.parametrize("seed", [0, 1])
def test_the_solver_equals_its_twin(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    distance, weight = noisy_roof(seed)
    keys, sums = map_of(distance, weight, (-2, -1, -1))
    raw = np.where(weight > 0, np.rint(distance * QUANTA), np.nan)
    edges = [edge for edge, _, _ in SETTINGS.rounds(0)]
    assert edges[0] > edges[-1] > 0
    expected = kernel_twins.field(raw, weight / 16, SETTINGS, QUANTA, edges)
    rows = solve(keys, store_of(keys, sums), 1.0, settings=SETTINGS)
    error = abs(dense(rows, distance.shape) - expected) / QUANTA
    assert (np.isnan(error) == (weight == 0)).all()
    assert np.nanmean(error) < 0.006  # voxel
    assert np.nanmax(error) < 0.1
    monkeypatch.setattr(field_regularizer, "STEPS", 400)
    monkeypatch.setattr(field_regularizer, "LOWEST", 0.0005)
    rows = solve(keys, store_of(keys, sums), 1.0, settings=SETTINGS)
    assert np.nanmax(abs(dense(rows, distance.shape) - expected)) / QUANTA < 1e-3


@pytest.mark.nightly
def test_a_coarser_start_leads_to_the_same_field(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing bends more than ε there is one minimum: from wherever it starts, steps lead to it."""
    distance, weight = noisy_roof(2)
    keys, sums = map_of(distance, weight, (-2, -1, -1))
    often = FieldSettings(smoothness=500.0, edge=4.0, reweightings=30)
    assert often.coarser == 1
    raw = np.where(weight > 0, np.rint(distance * QUANTA), np.nan)
    expected = kernel_twins.field(raw, weight / 16, often, QUANTA, [math.inf] + [often.edge * QUANTA] * 30)
    monkeypatch.setattr(field_regularizer, "STRONG_STEPS", 100)
    monkeypatch.setattr(field_regularizer, "STRONG_LOWEST", 0.0005)
    rows = solve(keys, store_of(keys, sums), 1.0, settings=often)
    error = abs(dense(rows, distance.shape) - expected) / QUANTA
    assert np.nanmax(error) < 0.05
    assert np.nanmean(error) < 0.005


def test_without_smoothness_the_field_is_raw() -> None:
    distance, weight = noisy_roof(3)
    keys, sums = map_of(distance, weight, (0, 0, 0))
    layers = store_of(keys, sums)
    rows = solve(keys, layers, 1.0, settings=FieldSettings(smoothness=0.0, edge=0.03, reweightings=2))
    assert np.array_equal(rows, values_of(keys, layers, 1.0), equal_nan=True)
    expected = np.where(weight > 0, np.rint(distance * QUANTA), np.nan)
    assert np.allclose(dense(rows, distance.shape), expected, atol=1e-3, equal_nan=True)


@pytest.mark.parametrize("settings", [SETTINGS, STRONG])
def test_a_ramp_passes_unchanged(settings: FieldSettings) -> None:
    random = np.random.default_rng(4)
    p = centres((24, 16, 16))
    distance = np.clip((p - 8) @ (0.5, 0.25, -0.25), -10, 10)  # sixtieths of a voxel, exactly
    weight = random.integers(16, 160, distance.shape) * (random.random(distance.shape) < 0.9)
    keys, sums = map_of(distance, weight, (0, 0, 0))
    rows = solve(keys, store_of(keys, sums), 1.0, settings=settings)
    error = dense(rows, distance.shape) / QUANTA - distance
    assert np.nanmax(abs(error)) < (1e-4 if settings is SETTINGS else 5e-2)
    assert (np.isnan(error) == (weight == 0)).all()
    rows = along_normals(keys, store_of(keys, sums), 1.0, smoothness=10.0)
    error = dense(rows, distance.shape) / QUANTA - distance
    assert np.nanmax(abs(error)) < 1e-4


@pytest.mark.parametrize("settings", [SETTINGS, STRONG])
def test_a_shift_by_whole_blocks_and_the_order_of_slots_change_no_bit(settings: FieldSettings) -> None:
    distance, weight = noisy_roof(5)
    keys, sums = map_of(distance, weight, (0, 0, 0))
    rows = solve(keys, store_of(keys, sums), 1.0, settings=settings)
    shifted, _ = map_of(distance, weight, (-7, 3, -1))
    other = solve(shifted, store_of(shifted, sums), 1.0, settings=settings)
    assert np.array_equal(rows, other, equal_nan=True)
    order = np.random.default_rng(0).permutation(len(keys))
    mixed = store_of(np.ascontiguousarray(keys[order]), np.ascontiguousarray(sums[order]))
    other = solve(keys, mixed, 1.0, settings=settings)
    assert np.array_equal(rows, other, equal_nan=True)


def test_threads_change_no_bit() -> None:
    program = (
        "import test_field_regularizer as t; from tsfusion.kernels.base import runtime;"
        "runtime.start({}); d, w = t.noisy_roof(6); k, s = t.map_of(d, w, (0, 0, 0));"
        "print(t.digest(t.solve(k, t.store_of(k, s), 1.0, settings=t.STRONG)))"
    )
    here = Path(__file__).parent
    found = {python(program.format(threads), check=True, cwd=here).stdout for threads in (1, 3)}
    assert len(found) == 1


def digest(rows: NDArray[np.float32]) -> str:
    return hashlib.sha256(rows.tobytes()).hexdigest()


def test_unseen_voxels_stay_unseen_and_block_nothing_else() -> None:
    distance, weight = noisy_roof(7, seen=0.5)
    keys, sums = map_of(distance, weight, (0, 0, 0))
    rows = solve(keys, store_of(keys, sums), 5.0, settings=STRONG)
    assert (np.isnan(dense(rows, distance.shape)) == (weight < 80)).all()


def test_an_empty_map_and_absent_blocks() -> None:
    empty = store_of(np.zeros(0, np.int64), np.zeros((1, 512), np.int64))
    for wanted in (np.zeros(0, np.int64), pack_keys(np.array([[1, 2, 3]], np.int32))):
        for rows in (
            solve(wanted, empty, 1.0, settings=STRONG),
            along_normals(wanted, empty, 1.0, smoothness=1.0),
        ):
            assert rows.shape == (len(wanted), 512)
            assert np.isnan(rows).all()
    keys, sums = map_of(np.full((8, 8, 8), 0.5), np.zeros((8, 8, 8), np.int64), (0, 0, 0))
    rows = solve(keys, store_of(keys, sums), 1.0, settings=STRONG)
    assert np.isnan(rows).all()


@pytest.mark.parametrize("sensor", ["kinect", "stereo"])
def test_a_part_equals_the_whole_to_a_hundredth_voxel(monkeypatch: pytest.MonkeyPatch, sensor: str) -> None:
    """Changes by a keyframe are found again by solving its blocks and those around; nothing else moves."""
    random = np.random.default_rng(0)
    *views, last = (with_noise(view, 0.004, random) for view in sphere_views(0.5, 8))
    volume = volume_of(views, sensor=sensor, regularizer="off")
    volume.take_dirty()
    model = volume.model
    settings = FieldSettings(model.field_smoothness, model.field_edge, model.field_reweightings)
    before = np.sort(volume._store.keys)
    old = solve(before, volume._store, 0.5, settings=settings)
    volume.integrate(last)
    changed = field_regularizer.around(pack_keys(volume.take_dirty()), volume._store, settings.rings)
    keys = np.sort(volume._store.keys)
    whole = solve(keys, volume._store, 0.5, settings=settings)
    part = solve(changed, volume._store, 0.5, settings=settings)
    assert 0 < len(changed) < len(keys)
    apart = abs(part - whole[np.searchsorted(keys, changed)]) / QUANTA
    assert np.nanmax(apart) < 0.01
    untouched = ~np.isin(before, changed)
    assert untouched.any()
    moved = abs(old - whole[np.searchsorted(keys, before)])[untouched] / QUANTA
    assert np.nanmax(moved, initial=0.0) < 0.01
    monkeypatch.setattr(field_regularizer, "BATCH", 100)
    batched = solve(keys, volume._store, 0.5, settings=settings)
    assert np.nanmax(abs(batched - whole)) / QUANTA < 0.01


def test_a_cube_keeps_its_edges_and_its_faces_lose_their_noise() -> None:
    random = np.random.default_rng(8)
    p = abs(centres((48, 48, 48)) - 24.0) - 11.7
    exact = np.linalg.norm(np.maximum(p, 0), axis=-1) + np.minimum(p.max(axis=-1), 0)
    distance = np.clip(exact + 0.15 * random.standard_normal(exact.shape), -4, 4)
    weight = np.full(distance.shape, 80) * (abs(exact) < 3.5)
    keys, sums = map_of(distance, weight, (0, 0, 0))
    raw = store_of(keys, sums)
    errors = {}
    for name, settings in (("raw", FieldSettings(0.0, 0.03, 0)), ("field", FieldSettings(30.0, 0.05, 3))):
        mesh = extract(keys, raw, 1.0, view=partial(solve, settings=settings))
        q = abs(mesh.vertices - 24.0) - 11.7
        error = abs(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0))
        near_edge = np.sort(abs(q), axis=1)[:, 1] < 1.0
        t = np.linspace(-10, 10, 81)
        edge = np.stack([t, np.full(81, 11.7), np.full(81, 11.7)], axis=1) + 24.0
        gap = cKDTree(mesh.vertices).query(edge)[0]
        errors[name] = error[~near_edge].mean(), error[near_edge].mean(), gap.mean()
    assert errors["field"][0] < 0.5 * errors["raw"][0]
    assert errors["field"][1] < errors["raw"][1]
    assert errors["field"][2] < 1.05 * errors["raw"][2]


def test_smoothing_along_normals_equals_its_twin() -> None:
    distance, weight = noisy_roof(9)
    keys, sums = map_of(distance, weight, (-2, -1, -1))
    rows = along_normals(keys, store_of(keys, sums), 1.0, smoothness=10.0)
    found = dense(rows, distance.shape)
    raw = np.where(weight > 0, np.rint(distance * QUANTA), np.nan)
    moved = 0
    for voxel in list(product(range(24), range(16), range(16)))[::7]:
        expected = kernel_twins.along_normal(raw, voxel, 10.0, 2.0 * QUANTA)
        assert np.allclose(found[voxel], expected, atol=0.05, equal_nan=True)
        moved += abs(expected - raw[voxel]) > 0.05
    assert moved > 50


@pytest.mark.parametrize(("surface", "share"), [("normal", 0.9), ("field", 0.7)])
def test_the_surface_of_a_noisy_plane_improves(surface: str, share: float) -> None:
    normal, views = tilted_plane(noise=0.01)
    errors = {}
    for mode in ("raw", surface):
        mesh = volume_of(views, surface=mode).extract_mesh(min_weight=1)
        errors[mode] = abs(mesh.vertices @ normal - 0.1).mean()
    assert errors[surface] < share * errors["raw"]
