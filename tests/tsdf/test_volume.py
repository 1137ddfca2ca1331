# SPDX-License-Identifier: MIT
"""Laws of the map: it is a sum, whatever the order, the threads or the history."""

import copy
import dataclasses
import inspect
import pickle
import re
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, get_type_hints

import kernel_twins
import numpy as np
import pytest
from command_processes import environment, python
from failures import memory_limited
from formula_scenes import CAMERA, SHAPE, plane_keyframe, sphere_views, volume_of
from numpy.typing import NDArray

from tsfusion import Keyframe, Volume, VolumeConfig
from tsfusion.core.config import LIMIT_SETTINGS, VIEW_SETTINGS, LoadSettings, VolumeSettings
from tsfusion.core.errors import (
    InvalidConfig,
    InvalidKeyframe,
    KeyframeTooLarge,
    MapError,
    MapFull,
    MapQuota,
    OutputError,
    WeightOverflow,
)
from tsfusion.geometry.keyframe import KeyframeFields
from tsfusion.geometry.map_questions import OwnSliceSettings
from tsfusion.kernels.base.voxel_traversal import ADDED, COST, COUNT
from tsfusion.kernels.integration import integrate, ray_smoothing
from tsfusion.kernels.integration.integrate import QUANTA_PER_VOXEL
from tsfusion.tsdf.integration.integrator import KeyframeQuota
from tsfusion.tsdf.store.block_store import cells_of, pack_keys, unpack_keys

VIEWS = sphere_views(0.4, 8)


def bytes_of(volume: Volume) -> dict[str, bytes]:
    used = volume._store.used()
    return {name: layer[used].tobytes() for name, layer in volume._store.layers().items()}


@pytest.mark.parametrize("bundle", [True, False])
def test_the_volume_holds_exactly_the_twins_sums(bundle: bool) -> None:
    depth = np.zeros(SHAPE, np.float32)
    depth[40:70, 60:95] = VIEWS[0].measurement[40:70, 60:95]
    keyframe = Keyframe(depth=depth, intrinsics=CAMERA, T_world_camera=VIEWS[0].T_world_camera)
    volume = volume_of([keyframe, keyframe], bundle=bundle)
    buffers = volume._ray_buffers
    rays = np.vstack([buffers.rays[start : start + count] for start, count in buffers.strips[:, :2]])
    expected = kernel_twins.integrate(rays, QUANTA_PER_VOXEL)
    found = {}
    for slot, corner in enumerate(unpack_keys(volume._store.keys) * 8):
        for o in np.flatnonzero(volume._store.sums[slot]):
            found[tuple((corner + (o >> 6, o >> 3 & 7, o & 7)).tolist())] = int(volume._store.sums[slot, o])
    assert found == {voxel: 2 * ((s << 27) + w) for voxel, (s, w) in expected.items()}


@pytest.mark.parametrize("regularizer", ["off", "paper", "ray"])
def test_any_order_gives_the_same_hash(regularizer: str) -> None:
    hashes = {volume_of(VIEWS, regularizer=regularizer).map_hash() for _ in range(2)}
    hashes.add(volume_of(VIEWS[::-1], regularizer=regularizer).map_hash())
    hashes.add(volume_of(VIEWS[4:] + VIEWS[:4], regularizer="off").map_hash())
    assert len(hashes) == 1


@pytest.mark.parametrize("regularizer", ["ray", pytest.param("off", marks=pytest.mark.nightly)])
def test_one_thread_gives_the_hash_of_two(regularizer: str) -> None:
    script = (
        "from formula_scenes import sphere_views, volume_of\n"
        f"v = volume_of(sphere_views(0.4, 4), threads={{}}, regularizer={regularizer!r})\n"
        "layers = v._store.layers().values()\n"
        "print(v.map_hash(), v.color_hash(), [hash(layer.tobytes()) for layer in layers])\n"
    )
    variables = environment() | {"PYTHONHASHSEED": "0"}
    found = {python(script.format(threads), env=variables, check=True).stdout for threads in (1, 2)}
    assert len(found) == 1


@pytest.mark.parametrize("bundle", [True, False])
def test_retract_restores_the_bytes(bundle: bool) -> None:
    volume = volume_of(VIEWS[:3], bundle=bundle)
    before, map_hash, color_hash = bytes_of(volume), volume.map_hash(), volume.color_hash()
    for keyframe in VIEWS[3:6]:
        volume.integrate(keyframe)
    assert volume.map_hash() != map_hash
    for keyframe in VIEWS[3:6]:
        volume.retract(keyframe)
    assert (volume.map_hash(), volume.color_hash()) == (map_hash, color_hash)
    assert bytes_of(volume) == before
    assert volume.stats().keyframes == 3


def test_a_moved_keyframe_is_a_retraction_and_an_addition() -> None:
    volume = volume_of(VIEWS[:4])
    volume.retract(VIEWS[1])
    volume.integrate(VIEWS[6])
    assert volume.map_hash() == volume_of([VIEWS[0], VIEWS[2], VIEWS[3], VIEWS[6]]).map_hash()


def test_what_the_map_does_not_hold_cannot_be_retracted() -> None:
    volume = volume_of(VIEWS[:2])
    before = bytes_of(volume)
    with pytest.raises(MapError, match="blocks are missing"):
        volume.retract(VIEWS[5])
    assert bytes_of(volume) == before
    volume.integrate(VIEWS[5])
    assert volume.map_hash() == volume_of([*VIEWS[:2], VIEWS[5]]).map_hash()


def test_colour_that_was_never_added_cannot_be_retracted() -> None:
    plain = replace(VIEWS[0], color=None)
    volume = volume_of([plain, VIEWS[1]])
    before = bytes_of(volume)
    with pytest.raises(MapError, match="does not hold"):
        volume.retract(VIEWS[0])
    assert bytes_of(volume) == before
    volume.retract(plain)
    volume.integrate(VIEWS[0])


def test_an_empty_map_has_nothing_to_retract() -> None:
    nothing = Keyframe(points=np.zeros((0, 3), np.float32), T_world_camera=np.eye(4))
    with pytest.raises(MapError, match="holds none"):
        Volume(voxel_size=0.02).retract(nothing)


def test_a_shift_by_whole_blocks_shifts_the_map() -> None:
    shift = np.array([3, -2, 5])
    moved = []
    for keyframe in VIEWS[:3]:
        T = keyframe.T_world_camera.copy()
        T[:3, 3] += shift * 8 * 0.0625  # powers of two: the sums round alike
        moved.append(replace(keyframe, color=None, T_world_camera=T))
    here = [replace(keyframe, color=None) for keyframe in VIEWS[:3]]
    a, b = volume_of(here, voxel_size=0.0625), volume_of(moved, voxel_size=0.0625)
    rows = [dict(zip(map(tuple, unpack_keys(v._store.keys)), v._store.sums, strict=False)) for v in (a, b)]
    shifted = {tuple(np.array(key) + shift): row for key, row in rows[0].items()}
    assert shifted.keys() == rows[1].keys()
    equal = sum((row == rows[1][key]).sum() for key, row in shifted.items())
    assert equal > 0.999 * 512 * len(shifted)  # a last bit of a back-projected point may round the other way


def test_no_smoothness_equals_plain_fusion() -> None:
    volume = volume_of(VIEWS, regularizer="ray", smoothness=0.0)
    used = volume._store.used()
    sums, correction = volume._store.sums[used], volume._store.correction[used]
    weight = sums & ((1 << 27) - 1)
    assert np.abs(correction / np.maximum(weight, 1)).max() <= 1 / 16


def test_dirty_blocks_are_reported_once() -> None:
    volume = volume_of(VIEWS[:1])
    dirty = volume.take_dirty()
    assert {tuple(b) for b in dirty} == {tuple(b) for b in unpack_keys(volume._store.keys)}
    assert len(volume.take_dirty()) == 0
    stats = volume.integrate(VIEWS[1])
    assert len(volume.take_dirty()) == stats.blocks


def test_cells_of_a_block_reach_one_block_down_each_axis() -> None:
    cells = cells_of(np.array([[0, 0, 0], [0, 0, 1]], np.int32))
    assert len(cells) == 12
    assert {tuple(c) for c in cells} >= {(0, 0, 0), (-1, -1, -1), (-1, -1, 1)}


def test_an_empty_keyframe_changes_nothing() -> None:
    volume = volume_of(VIEWS[:1])
    before = volume.map_hash()
    empty = np.zeros(SHAPE, np.uint16)
    stats = volume.integrate(Keyframe(depth=empty, intrinsics=CAMERA, T_world_camera=np.eye(4)))
    assert (stats.samples, stats.rays, stats.updates, stats.blocks) == (0, 0, 0, 0)
    assert stats.invalid == empty.size
    volume.integrate(Keyframe(points=np.zeros((0, 3), np.float32), T_world_camera=np.eye(4)))
    assert volume.map_hash() == before
    assert Volume(voxel_size=0.02).extract_mesh().faces.shape == (0, 3)


def test_points_far_outside_the_reach_of_keys_are_dropped_and_counted() -> None:
    points = np.array([[0, 0, 50.0], [0, 0, 2.0]], np.float32)
    T = np.eye(4)
    T[0, 3] = 9e5
    volume = Volume(voxel_size=0.02, sensor="lidar")
    assert volume.integrate(Keyframe(points=points, T_world_camera=T)).invalid == 2
    assert volume.stats().blocks == 0


def test_confidence_zero_is_no_return_and_half_is_less() -> None:
    keyframe, full = VIEWS[0], volume_of(VIEWS[:1])
    for value, check in ((0, lambda w: w == 0), (128, lambda w: 0 < w < weights(full))):
        doubted = replace(keyframe, color=None, confidence=np.full(SHAPE, value, np.uint8))
        assert check(weights(volume_of([doubted])))


def weights(volume: Volume) -> int:
    return int((volume._store.sums & ((1 << 27) - 1)).sum())


def test_the_limits_hold_and_leave_the_map_alone() -> None:
    volume = volume_of(VIEWS[:1])
    small = volume_of(VIEWS[:1], max_blocks=volume.stats().blocks)
    before = bytes_of(small)
    with pytest.raises(MapFull, match="max_blocks"):
        small.integrate(VIEWS[4])
    assert bytes_of(small) == before
    with pytest.raises(MapFull, match="max_blocks_per_keyframe"):
        volume_of(VIEWS[:1], max_blocks_per_keyframe=3)


def test_a_keyframe_of_blocks_that_the_map_has_may_not_touch_too_many_either(tmp_path: Path) -> None:
    path = volume_of(VIEWS[:1]).save(tmp_path / "map.tsf")
    volume = Volume.load(path, max_blocks_per_keyframe=3)
    before = bytes_of(volume)
    with pytest.raises(KeyframeTooLarge, match="max_blocks_per_keyframe"):
        volume.integrate(VIEWS[0])
    assert bytes_of(volume) == before


def test_keys_that_collide_are_no_keyframe(monkeypatch: pytest.MonkeyPatch) -> None:
    volume = volume_of(VIEWS[:1])
    before, usual = bytes_of(volume), integrate.add_rays

    def collide(*given: Any) -> None:
        usual(*given)
        if given[3][integrate.WHICH] == integrate.ALL:
            volume._ray_buffers.touched[integrate.TOUCHED_OVERFLOW] = 1

    with monkeypatch.context() as patched:
        patched.setattr(integrate, "add_rays", collide)
        with pytest.raises(KeyframeTooLarge, match="collide"):
            volume.integrate(VIEWS[4])
    assert bytes_of(volume) == before
    volume.integrate(VIEWS[4])
    assert volume.map_hash() == volume_of([VIEWS[0], VIEWS[4]]).map_hash()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory")
@pytest.mark.parametrize("regularizer", ["off", "ray"])
def test_without_memory_a_keyframe_fits_or_leaves_the_map_alone(regularizer: str) -> None:
    """Kernels that are compiled need none: they run in less than the process has already."""
    volume, fitted = volume_of(VIEWS[:1], voxel_size=0.004, regularizer=regularizer), VIEWS[:1]
    volume.warm_up()
    for room, view in zip((-1 << 26, 0, 1 << 14, 1 << 18, 1 << 20, 1 << 22, 1 << 24), VIEWS[1:], strict=True):
        with memory_limited(room):
            volume.integrate(VIEWS[0])
            volume.retract(VIEWS[0])
            with suppress(MemoryError):
                volume.integrate(view)
                fitted = [*fitted, view]
    assert 1 < len(fitted) < 8
    assert volume.map_hash() == volume_of(fitted, voxel_size=0.004).map_hash()


def test_full_voxels_refuse_more_and_lose_nothing() -> None:
    volume = volume_of(VIEWS[:1])
    slot, voxel = np.argwhere(volume._store.sums != 0)[0]
    volume._store.sums[slot, voxel] = (1 << 26) - 1
    volume._store.bounds[slot] = (1 << 26) - 1
    before, blocks = bytes_of(volume), volume.stats().blocks
    with pytest.raises(WeightOverflow) as refused:
        volume.integrate(VIEWS[0])
    said = {"bundle" in str(refused.value), *re.findall(r"(\w+) (--[\w-]+)", str(refused.value))}
    assert said == {False, ("replay", "--stride"), ("scan", "--max-rate")}  # a bundle is what it is already
    moved = VIEWS[0].T_world_camera.copy()
    moved[:3, 3] += 0.1  # needs blocks that must not stay either
    with pytest.raises(WeightOverflow):
        volume.integrate(replace(VIEWS[0], T_world_camera=moved))
    assert bytes_of(volume) == before
    assert volume.stats().blocks == blocks
    volume.retract(VIEWS[0])  # making room is always allowed


def test_a_bound_that_is_too_cautious_is_looked_up() -> None:
    volume = volume_of(VIEWS[:1])
    volume._store.bounds[:] = (1 << 26) - 1
    volume.integrate(VIEWS[1])
    assert volume.map_hash() == volume_of(VIEWS[:2]).map_hash()
    weight = (volume._store.sums & ((1 << 27) - 1)).max(axis=1)
    touched = volume._ray_buffers.touched_slots
    assert (volume._store.bounds[touched] == weight[touched]).all()


def test_a_settled_colour_takes_no_more_votes() -> None:
    volume = volume_of(VIEWS[:1])
    voted = volume._store.color_rgn != 0
    volume._store.color_rgn[voted] |= 1 << 15
    before = volume._store.color_rgn.copy()
    volume.integrate(VIEWS[0])
    assert (volume._store.color_rgn[voted[: len(before)]] == before[voted]).all()


def test_settled_colours_do_not_stop_a_retraction() -> None:
    volume = volume_of(VIEWS[:2])
    before = volume.map_hash()
    volume.integrate(VIEWS[2])
    voted = volume._store.color_rgn[: volume.stats().blocks] != 0
    volume._store.color_rgn[: len(voted)][voted] |= 1 << 15
    settled = volume._store.color_rgn[: len(voted)][voted].copy()
    volume.retract(VIEWS[2])
    assert volume.map_hash() == before
    assert (volume._store.color_rgn[: len(voted)][voted] == settled).all()


@pytest.mark.parametrize("where", ["_smooth", "reserve_touched", "largest_weights", "ONLY_DEFERRED"])
def test_whatever_fails_leaves_the_map_as_it_was(monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    volume = volume_of(VIEWS[:2], regularizer="ray")
    before, stats = bytes_of(volume), volume.stats()
    volume._store.bounds[:] = (1 << 26) - 1  # so that the weights are looked at

    def fail(*_: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patched:
        if where == "_smooth":
            patched.setattr(volume._integrator, "_smooth", fail)
        elif where == "reserve_touched":
            first, buffers = [True], volume._ray_buffers
            usual = buffers.reserve_touched
            patched.setattr(buffers, "reserve_touched", lambda n: usual(n) if first.pop() else fail())
            first.insert(0, False)
        elif where == "ONLY_DEFERRED":  # the blocks are there, and nothing is added to them
            usual_add = integrate.add_rays

            def add(*given: Any) -> None:
                fail() if given[3][integrate.WHICH] == integrate.ONLY_DEFERRED else usual_add(*given)

            patched.setattr(integrate, "add_rays", add)
        else:
            patched.setattr("tsfusion.kernels.integration.integrate.largest_weights", fail)
        with pytest.raises(MemoryError):
            volume.integrate(VIEWS[5])
    assert bytes_of(volume) == before
    assert (volume.stats().blocks, volume.keyframes) == (stats.blocks, 2)
    volume.integrate(VIEWS[5])
    assert volume.map_hash() == volume_of([*VIEWS[:2], VIEWS[5]]).map_hash()


def test_an_interrupt_waits_for_the_keyframe() -> None:
    volume = volume_of(VIEWS[:1])
    usual = volume._integrator._check

    def interrupted(part: tuple[int, int], sign: int) -> None:
        signal.raise_signal(signal.SIGINT)
        usual(part, sign)

    volume._integrator._check = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        volume.integrate(VIEWS[1])
    assert volume.keyframes == 2
    assert volume.map_hash() == volume_of(VIEWS[:2]).map_hash()


def test_a_failure_while_smoothing_leaves_no_vote_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> None:
        raise MemoryError

    volume, undisturbed = (
        volume_of(VIEWS[:1], voxel_size=0.04, regularizer="ray", sensor="kinect") for _ in range(2)
    )
    with monkeypatch.context() as patch:
        patch.setattr(ray_smoothing, "commit_votes", failing)
        with pytest.raises(MemoryError):
            volume.integrate(VIEWS[2])
    assert not volume._integrator._buffers.votes.any()
    for each in (volume, undisturbed):
        each.integrate(VIEWS[1])
    assert volume.map_hash() == undisturbed.map_hash()
    meshes = [each.extract_mesh(surface="raw").vertices for each in (volume, undisturbed)]
    assert np.array_equal(*meshes)


def test_a_still_camera_can_carve_for_long() -> None:
    T = np.eye(4)
    wall = plane_keyframe(T, np.array([0.0, 0.0, 1.0]), 1.5)
    volume = volume_of([wall], space_carving=True)
    heaviest = int((volume._store.sums & ((1 << 27) - 1)).max())
    assert heaviest * 10_000 < 1 << 26


def test_a_keyframe_too_heavy_for_one_go_gives_the_same_map(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = volume_of(VIEWS[:3])
    monkeypatch.setattr("tsfusion.tsdf.integration.integrator.PART_WEIGHT", 20_000)
    parts = volume_of(VIEWS[:3])
    assert len(list(parts._integrator._parts())) > 3
    assert parts.map_hash() == whole.map_hash()
    parts.retract(VIEWS[2])
    assert parts.map_hash() == volume_of(VIEWS[:2]).map_hash()


def test_a_full_set_of_missing_blocks_is_grown_and_loses_nothing() -> None:
    volume = Volume(voxel_size=0.005, threads=2)
    volume._ray_buffers.missing = np.zeros(64, np.int64)
    volume.integrate(VIEWS[0])
    assert len(volume._ray_buffers.missing) > 64
    assert volume.map_hash() == volume_of(VIEWS[:1], voxel_size=0.005).map_hash()


def scattered(count: int, spread: float) -> Keyframe:
    """Points anywhere, each seen from another place: no two rays cross the same blocks."""
    random = np.random.default_rng(4)
    points = random.uniform(-spread, spread, (count, 3)).astype(np.float32)
    origins = points + random.uniform(-1, 1, (count, 3)).astype(np.float32)
    return Keyframe(points=points, origins=origins, T_world_camera=np.eye(4))


@pytest.mark.parametrize(
    ("settings", "blocks", "error"),
    [
        ({"max_blocks_per_keyframe": 4096}, 1 << 30, KeyframeTooLarge),
        ({"max_blocks": 4096}, 1 << 30, MapFull),
        ({}, 4096, MapQuota),
    ],
)
def test_adding_ends_when_too_many_blocks_are_missing(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, int], blocks: int, error: type[MapFull]
) -> None:
    volume = volume_of(VIEWS[:1], **settings)
    before, stats = bytes_of(volume), volume.stats()
    usual, passes, buffers = integrate.add_rays, [0], volume._ray_buffers

    def counted(*given: object) -> None:
        passes[0] += 1
        usual(*given)

    monkeypatch.setattr(integrate, "add_rays", counted)
    volume.quota = KeyframeQuota(cost=1 << 40, blocks=blocks)
    with pytest.raises(error):
        volume.integrate(scattered(100_000, 50.0))
    assert passes[0] == 2  # it was added, and taken away again
    assert buffers.strips[:, ADDED].sum() < 0.2 * buffers.strips[:, COUNT].sum()
    assert bytes_of(volume) == before
    assert volume.stats().blocks == stats.blocks
    volume.quota = None
    volume.integrate(VIEWS[1])
    assert volume.map_hash() == volume_of(VIEWS[:2]).map_hash()


@pytest.mark.parametrize("keyframe", [*VIEWS[:2], scattered(1000, 2.0)])
def test_a_keyframe_costs_at_least_the_voxels_it_crosses(keyframe: Keyframe) -> None:
    volume = Volume(voxel_size=0.01, threads=2)
    updates = volume.integrate(keyframe).updates
    cost = int(volume._ray_buffers.strips[:, COST].sum())
    assert updates <= cost <= 8 * updates
    before = bytes_of(volume)
    volume.quota = KeyframeQuota(cost=cost - 1)
    with pytest.raises(KeyframeTooLarge, match=f"at most quota_cost = {cost - 1}, these cost {cost}"):
        volume.integrate(keyframe)
    assert bytes_of(volume) == before
    volume.quota = KeyframeQuota(cost=cost)
    volume.integrate(keyframe)


def test_a_keyframe_costs_the_blocks_that_it_adds() -> None:
    """Memory that is touched for the first time takes longer than any ray."""
    volume, keyframe = volume_of(VIEWS[:1]), scattered(1000, 20.0)
    before = bytes_of(volume)
    added = volume.integrate(keyframe).new_blocks
    cost = int(volume._ray_buffers.strips[:, COST].sum()) + 1000 * added
    volume = volume_of(VIEWS[:1])
    volume.quota = KeyframeQuota(cost=cost - 1)
    with pytest.raises(KeyframeTooLarge, match=r"\d+ new blocks or more, which is above"):
        volume.integrate(keyframe)
    assert bytes_of(volume) == before
    volume.quota = KeyframeQuota(cost=cost)
    assert volume.integrate(keyframe).new_blocks == added


def test_rays_away_from_each_other_cost_more() -> None:
    volume, scan = Volume(voxel_size=0.01, threads=2), scattered(1000, 2.0)
    assert scan.points is not None
    assert scan.origins is not None
    together = replace(scan, points=scan.points * 1e-2, origins=scan.points * 1e-2 + [0, 0, 1])
    costs = []
    for keyframe in (scan, together):
        updates = volume.integrate(keyframe).updates
        costs.append(int(volume._ray_buffers.strips[:, COST].sum()) / updates)
    assert costs[0] > 3 * costs[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"voxel_size": float("nan")}, "voxel_size"),
        ({"voxel_size": float("inf")}, "voxel_size"),
        ({"sensor": "sonar"}, "sensor"),
        ({"regularizer": "tv"}, "regularizer"),
        ({"voxelsize": 0.02}, "voxelsize"),
        ({"min_range": 5.0, "max_range": 2.0}, "min_range"),
        ({"min_support": 9.0, "max_support": 4.0}, "min_support"),
    ],
)
def test_a_bad_setting_is_named(settings: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidConfig, match=message):
        Volume(**settings)


def test_memory_grows_without_losing_a_bit() -> None:
    volume = volume_of(VIEWS, voxel_size=0.004)
    assert volume.stats().blocks > 2048  # past two growths of every array
    backwards = volume_of(VIEWS[::-1], voxel_size=0.004)
    assert volume.map_hash() == backwards.map_hash()
    assert volume.stats().bytes_per_block <= 12_300


@pytest.mark.nightly
def test_kernels_stay_in_bounds() -> None:
    """Taichi's debug mode checks every array access; it needs a process of its own."""
    script = (
        "import numpy as np, formula_scenes\n"
        "from tsfusion.kernels.base import runtime\n"
        "from tsfusion import Volume, Keyframe\n"
        "import taichi as ti\n"
        "ti.init(arch=ti.cpu, debug=True, offline_cache=True, log_level=ti.ERROR)\n"
        "runtime._started_threads = 2\n"
        "v = Volume(voxel_size=0.04, regularizer='ray')\n"
        "for k in formula_scenes.sphere_views(0.4, 2): v.integrate(k)\n"
        "r = np.random.default_rng(0).uniform(-3, 3, (700, 3)).astype(np.float32)\n"
        "v.integrate(Keyframe(points=r, T_world_camera=np.eye(4)))\n"
        "v.retract(Keyframe(points=r, T_world_camera=np.eye(4)))\n"
        "assert len(v.extract_mesh(min_weight=0).faces)\n"
        "assert len(v.extract_mesh(min_weight=0, blocks=v.take_dirty()[::3]).faces)\n"
    )
    done = python(script, env=environment(), timeout=240)
    assert done.returncode == 0, done.stderr[-2000:]


def random_cloud(seed: int, count: int) -> NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(-4, 4, (count, 3)).astype(np.float32)


def test_points_in_any_order_of_keyframes_and_two_sensors() -> None:
    keyframes = [
        Keyframe(points=random_cloud(i, 3000), T_world_camera=np.eye(4), sensor="lidar") for i in range(3)
    ]
    a = volume_of([*VIEWS[:2], *keyframes])
    b = volume_of([*keyframes[::-1], *VIEWS[1::-1]])
    assert a.map_hash() == b.map_hash()


@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, Volume.copy])
@pytest.mark.parametrize("files", [False, True])
def test_a_copy_shares_nothing(how: Callable[[Volume], Volume], files: bool, tmp_path: Path) -> None:
    kept: dict[str, Any] = {"memory_bytes": 1 << 20, "cache": tmp_path} if files else {}
    settings: dict[str, Any] = {"voxel_size": 0.02, "regularizer": "ray", **kept}
    volume = Volume(**settings)
    for keyframe in VIEWS[:3]:
        volume.integrate(keyframe)
    volume.retract(VIEWS[2])
    volume.meta["notes"] = ["here"]
    before, counts = bytes_of(volume), volume.stats()
    copied = how(volume)
    assert bytes_of(copied) == before
    assert copied.stats().keyframes == 2
    assert copied.version == volume.version
    assert np.array_equal(copied.take_dirty(), volume.take_dirty())
    assert copied.held.numbers == (held := volume.held.numbers)
    copied.integrate(VIEWS[3])
    copied.meta["notes"].append("there")
    copied.release_empty()
    assert bytes_of(volume) == before
    assert volume.stats().blocks == counts.blocks
    assert volume.keyframes == counts.keyframes
    assert volume.meta == {"notes": ["here"]}
    assert volume.held.numbers == held != copied.held.numbers
    assert copied.map_hash() == volume_of([*VIEWS[:2], VIEWS[3]], voxel_size=0.02).map_hash()


def test_a_copy_knows_which_blocks_have_gone() -> None:
    volume = volume_of(VIEWS[:2])
    volume.take_dirty()
    volume.retract(VIEWS[1])
    volume.release_empty()
    copied, gone = volume.copy().take_dirty(), volume.take_dirty()
    assert len(gone) > len(np.intersect1d(pack_keys(gone), volume._store.keys))
    assert np.array_equal(copied, gone)


def test_a_copy_keeps_the_limits_of_its_map() -> None:
    volume = volume_of(VIEWS[:2])
    volume.limit_memory(100)
    with pytest.raises(MemoryError):
        volume.copy().integrate(VIEWS[5])


def test_a_map_is_saved_not_pickled() -> None:
    with pytest.raises(MapError, match=r"cannot be pickled: use save"):
        pickle.dumps(volume_of(VIEWS[:1]))


@pytest.mark.parametrize(
    ("name", "cure"), [("v.ply", "extract_mesh().save"), ("v.GLB", "extract_mesh"), ("v.npz", "save_voxels")]
)
def test_a_map_has_not_the_name_of_another_kind(name: str, cure: str, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"a map is saved as \.tsf") as refused:
        volume_of(VIEWS[:1]).save(tmp_path / name)
    assert cure in str(refused.value)
    assert not (tmp_path / name).exists()


def test_type_checkers_know_every_setting() -> None:
    def plain(struct: type) -> dict[str, object]:
        words = {"sensor": str, "arch": str}  # of which the words come from a recording or an option
        return {**get_type_hints(struct), **words}

    assert get_type_hints(VolumeSettings) == plain(VolumeConfig)
    assert set(get_type_hints(LoadSettings)) == {*VIEW_SETTINGS, *LIMIT_SETTINGS, "arch"}
    fields = {one.name: one.type for one in dataclasses.fields(Keyframe) if one.init}
    assert get_type_hints(KeyframeFields) == fields


def test_type_checkers_know_how_a_slice_is_cut() -> None:
    parameters = inspect.signature(Volume.current_slice).parameters
    cut = {name: one.annotation for name, one in parameters.items() if one.kind is one.KEYWORD_ONLY}
    assert get_type_hints(OwnSliceSettings) == cut


def test_a_number_is_the_voxel_size() -> None:
    assert Volume(0.25).config == Volume(voxel_size=0.25).config
    assert Volume(np.float32(0.05), color=False).config.voxel_size == 0.05


def test_a_keyframe_may_be_given_by_its_fields() -> None:
    keyframe = VIEWS[0]
    fields = {name: getattr(keyframe, name) for name in ("depth", "depth_scale", "T_world_camera")}
    fields["intrinsics"] = keyframe.intrinsics.matrix
    volume, named = Volume(0.05), Volume(0.05)
    volume.integrate(keyframe)
    named.integrate(**fields)
    assert named.map_hash() == volume.map_hash()
    named.retract(fields)
    assert named.map_hash() == Volume(0.05).map_hash()


def test_habits_of_other_libraries_are_answered() -> None:
    volume, points, T = Volume(0.05), np.ones((4, 3)), np.eye(4)
    with pytest.raises(InvalidConfig, match="sdf_trunc: write min_support=N, max_support=N with N"):
        Volume(0.05, sdf_trunc=0.1)
    with pytest.raises(InvalidConfig, match="by name, such as space_carving=True; for sdf_trunc: write"):
        Volume(0.05, 0.1, True)
    with pytest.raises(InvalidConfig, match="unknown setting voxl_size: did you mean voxel_size"):
        Volume(voxl_size=0.05)
    with pytest.raises(InvalidKeyframe, match=r"got ndarray, ndarray; by name: .* in the sensor's frame"):
        volume.integrate(points, T)
    with pytest.raises(InvalidKeyframe, match=r"no extrinsic: write T_world_camera, its inverse"):
        volume.integrate(points=points, extrinsic=T)
    with pytest.raises(AttributeError, match=r"no extract_triangle_mesh: write extract_mesh\(\)"):
        volume.extract_triangle_mesh()
    assert volume.keyframes == 0


def test_blocks_that_retractions_empty_make_room_and_nothing_else_changes(tmp_path: Path) -> None:
    views = sphere_views(0.4, 6)
    volume = volume_of(views[:4])
    volume.take_dirty()
    assert volume.release_empty() == 0
    before = volume.stats().blocks
    for gone in views[:2]:
        volume.retract(gone)
    dirty = {tuple(block) for block in volume.take_dirty().tolist()}
    volume.retract(views[2])
    dirty_again = {tuple(block) for block in volume.take_dirty().tolist()}
    volume.integrate(views[2])
    volume.retract(views[2])
    released = volume.release_empty()
    assert 0 < released == before - volume.stats().blocks
    last = {tuple(block) for block in volume.take_dirty().tolist()}
    assert dirty_again <= last <= dirty | dirty_again  # also those released
    assert len(volume.take_dirty()) == 0 < len(dirty)
    fresh = volume_of(views[3:4])
    assert volume.map_hash() == fresh.map_hash()
    assert volume.color_hash() == fresh.color_hash()
    loaded = Volume.load(volume.save(tmp_path / "map.tsf"), threads=2)
    assert loaded.stats().blocks == volume.stats().blocks
    for one in (volume, fresh):
        for view in views[4:]:
            one.integrate(view)
    assert volume.map_hash() == fresh.map_hash()
    assert volume.color_hash() == fresh.color_hash()
    assert volume.extract_mesh().encode(".ply") == fresh.extract_mesh().encode(".ply")
    assert volume.release_empty() == 0


def test_denormal_numbers_in_a_pose_are_zeros() -> None:
    """Taichi has the processor flush them to zero, and then LAPACK finds no rotation."""
    volume, T = Volume(voxel_size=0.05, threads=2), np.eye(4)
    T[0, 1:3], T[1, 1] = (5e-322, 1e-310), 1 + 5e-7
    keyframe = Keyframe(points=np.ones((1, 3), np.float32), T_world_camera=T)
    assert (keyframe.T_world_camera == np.eye(4)).all()
    assert volume.integrate(keyframe).samples == 1
