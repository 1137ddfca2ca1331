# SPDX-License-Identifier: MIT
"""Free space that an image carves is added with the image's rays, or not at all."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from formula_scenes import plane_keyframe, sphere_views, volume_of

from tsfusion import Keyframe, Volume
from tsfusion.core.errors import KeyframeTooLarge, MapError, MapFull, MapQuota, WeightOverflow
from tsfusion.tsdf.integration.integrator import CARVED_COST, KeyframeQuota

VIEWS = sphere_views(0.4, 4)
WALL = plane_keyframe(np.eye(4), np.array([0.0, 0.0, 1.0]), 2.0)
SETTINGS: dict[str, Any] = {"voxel_size": 0.03, "color": False, "space_carving": True}


def map_of(*keyframes: Keyframe, **settings: Any) -> Volume:
    return volume_of(list(keyframes), **{**SETTINGS, **settings})


def state_of(volume: Volume) -> tuple[str, int]:
    return volume.map_hash(), volume.stats().blocks


@pytest.mark.parametrize("threads", [1, 3])
def test_the_order_and_the_threads_do_not_matter(threads: int) -> None:
    expected = map_of(*VIEWS).map_hash()
    assert map_of(*VIEWS[::-1], threads=threads).map_hash() == expected
    assert map_of(*VIEWS, WALL).map_hash() != expected


def test_a_view_that_carves_what_others_have_seen_changes_their_blocks() -> None:
    volume = map_of(*VIEWS)
    volume.take_dirty()
    stats = volume.integrate(WALL)
    changed = volume.take_dirty()
    assert stats.blocks == len(changed) > stats.new_blocks > 0
    assert len(np.unique(changed, axis=0)) == len(changed), "each once"
    before = volume.stats().blocks
    assert volume.integrate(WALL).updates == stats.updates
    assert volume.stats().blocks == before


def test_what_an_image_carves_is_taken_away_with_it() -> None:
    volume = map_of(*VIEWS)
    before = volume.map_hash()
    added, taken = volume.integrate(WALL), volume.retract(WALL)
    assert volume.map_hash() == before
    assert (added.updates, added.blocks) == (taken.updates, taken.blocks)
    assert volume.release_empty() == added.new_blocks


def test_a_keyframe_that_the_map_does_not_hold_is_not_taken_away() -> None:
    """The keyframe's rays end in blocks of the map, but its free space is not there, or has no votes."""
    volume = map_of(*VIEWS, space_carving=False)
    band = state_of(volume)
    volume.config = replace_carving(volume)
    with pytest.raises(MapError, match="cannot retract"):
        volume.retract(VIEWS[0])
    assert state_of(volume) == band
    carved = map_of(VIEWS[0])
    before = state_of(carved)
    moved = VIEWS[0].T_world_camera.copy()
    moved[:3, 3] += 0.01
    with pytest.raises(MapError, match="cannot retract"):
        carved.retract(replace(VIEWS[0], T_world_camera=moved))
    assert state_of(carved) == before


def replace_carving(volume: Volume) -> Any:
    from msgspec.structs import replace as changed

    return changed(volume.config, space_carving=True)


@pytest.mark.parametrize(
    ("settings", "error"),
    [({"max_blocks_per_keyframe": 300}, KeyframeTooLarge), ({"max_blocks": 300}, MapFull)],
)
def test_a_map_without_room_for_free_space_stays_as_it_was(
    settings: dict[str, int], error: type[MapFull]
) -> None:
    """The band alone would fit."""
    assert map_of(WALL, space_carving=False).stats().blocks < 200 < 300 < map_of(WALL).stats().blocks
    volume = map_of(**settings)
    with pytest.raises(error):
        volume.integrate(WALL)
    assert state_of(volume) == state_of(map_of())
    near = replace(WALL, depth=np.full(WALL.measurement.shape, 0.5, np.float32))
    volume.integrate(near)
    assert volume.map_hash() == map_of(near).map_hash()


def test_a_sender_s_quota_counts_what_is_carved() -> None:
    volume, usual = map_of(VIEWS[0]), map_of(VIEWS[0])
    before, stats = state_of(volume), usual.integrate(WALL)
    listed = len(usual._ray_buffers.carved)
    assert listed > 100
    rays = int(usual._ray_buffers.strips[:, 7].sum())
    refused = [
        (KeyframeQuota(cost=rays + CARVED_COST * listed - 1), KeyframeTooLarge),
        (KeyframeQuota(cost=rays + CARVED_COST * listed + 1000), KeyframeTooLarge),
        (KeyframeQuota(cost=1 << 30, blocks=stats.new_blocks - 1), MapQuota),
    ]
    for quota, error in refused:
        volume.quota = quota
        with pytest.raises(error):
            volume.integrate(WALL)
        assert state_of(volume) == before
    volume.quota = KeyframeQuota(cost=1 << 30, blocks=stats.new_blocks)
    assert volume.integrate(WALL) == stats


def test_voxels_full_of_free_space_refuse_more_and_lose_nothing() -> None:
    volume = map_of(WALL)
    before = state_of(volume)
    slot = int(np.argmax((volume._store.sums >> 27).min(axis=1)))  # all of it is free
    volume._store.sums[slot] += (1 << 26) - 1 - (volume._store.sums[slot] & ((1 << 27) - 1))
    volume._store.bounds[slot] = (1 << 26) - 1
    full = volume.map_hash()
    moved = WALL.T_world_camera.copy()
    moved[:3, 3] += 0.1  # needs blocks that must not stay either
    for keyframe in (WALL, replace(WALL, T_world_camera=moved)):
        with pytest.raises(WeightOverflow):
            volume.integrate(keyframe)
        assert state_of(volume) == (full, before[1])


def test_points_carve_along_their_rays() -> None:
    wall = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(-0.5, 0.5, 40), [2.0]), -1)
    scan = Keyframe(points=wall.reshape(-1, 3).astype(np.float32), T_world_camera=np.eye(4))
    volume = map_of(WALL)
    stats = volume.integrate(scan)
    assert not len(volume._ray_buffers.carved)
    assert stats.updates > 10 * stats.rays
    volume.retract(scan)
    assert volume.map_hash() == map_of(WALL).map_hash()


def test_a_keyframe_without_a_usable_sample_changes_nothing() -> None:
    """Few pixels stand alone; or all surfaces lie beyond the edge of the world, but not the way there."""
    depth = np.zeros(WALL.measurement.shape, np.float32)
    depth[1::5, 1::5] = 4.0
    depth[2::5, 2::5] = 8.0
    edge = np.eye(4)
    edge[2, 3] = ((1 << 20) - 100) * 0.03
    far = replace(WALL, depth=np.full(depth.shape, 4.0, np.float32), T_world_camera=edge)
    volume = map_of(WALL)
    before = state_of(volume)
    for keyframe in (replace(WALL, depth=depth), far):
        stats = volume.integrate(keyframe)
        assert (stats.samples, stats.updates, stats.blocks, stats.new_blocks) == (0, 0, 0, 0)
    assert state_of(volume) == before
    assert volume.keyframes == 1
