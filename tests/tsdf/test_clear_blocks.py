# SPDX-License-Identifier: MIT
"""Free space without carving: what keyframes look through as a whole, counted exactly, and never a hit."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from formula_scenes import CAMERA, SHAPE, directions, look_at, sphere_views, volume_of
from numpy.typing import NDArray
from thin_obstacles import BAR_HEIGHT, POSTS, scans, views

from tsfusion import Keyframe, MapFull, Volume
from tsfusion.core.errors import DamagedCheckpoint
from tsfusion.geometry.map_grids import FREE, OCCUPIED, UNSEEN
from tsfusion.kernels.base import runtime
from tsfusion.tsdf.files import checkpoint
from tsfusion.tsdf.files.saved_map_addition import add_files
from tsfusion.tsdf.store import clear_blocks
from tsfusion.tsdf.store.block_store import unpack_keys
from tsfusion.tsdf.store.clear_blocks import ClearBlocks

SIDE = 3.0  # of a room around the origin, metres
VIEWS = sphere_views(0.4, 6)
Array = NDArray[np.float64]


def room_depth(origin: Array, rays: Array) -> Array:
    """Ray parameters (…,) at which rays leave the room."""
    safe = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    ends: Array = ((np.sign(safe) * SIDE / 2 - origin) / safe).min(axis=-1)
    return ends


def camera_view(eye: Array, target: Array) -> Keyframe:
    T = look_at(eye, target)
    depth = room_depth(T[:3, 3], directions(T)).astype(np.float32)
    return Keyframe(depth=depth, intrinsics=CAMERA, T_world_camera=T)


def camera_views(count: int = 16) -> list[Keyframe]:
    """A camera turns around near the middle of the empty room."""
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ahead = [np.array([np.cos(turn), np.sin(turn), 0.3 * np.sin(3 * turn)]) for turn in turns]
    return [camera_view(-0.9 * way, 2 * way) for way in ahead]


def sweep(origin: tuple[float, float, float], rings: int = 32) -> Keyframe:
    """A LiDAR in the empty room."""
    turn, rise = np.meshgrid(np.radians(np.arange(0, 360, 0.5)), np.radians(np.linspace(-40, 40, rings)))
    rays = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], -1)
    rays = rays.reshape(-1, 3)
    T = np.eye(4)
    T[:3, 3] = origin
    points = rays * room_depth(T[:3, 3], rays)[:, None]
    return Keyframe(points=points.astype(np.float32), T_world_camera=T)


SWEEPS = [sweep((x, 0.2 * x, 0.1)) for x in (-0.4, 0.0, 0.5)]


def with_holes(keyframe: Keyframe) -> Keyframe:
    depth = keyframe.measurement.copy()
    depth[30:36, 40:90] = depth[70:110, 20:60] = 0
    return replace(keyframe, depth=depth)


def counted(volume: Volume) -> dict[int, int]:
    keys, counts = volume._store.clear.counts()
    return dict(zip(keys.tolist(), counts.tolist(), strict=True))


def free_blocks(volume: Volume) -> Array:
    """(n, 3) metres: corners of the blocks that keyframes look through."""
    blocks = unpack_keys(volume._store.clear.counts()[0])
    return blocks * 8 * volume.config.voxel_size


@pytest.mark.parametrize("color", [False, True])
def test_the_middle_of_a_room_that_a_camera_looks_through_is_free(color: bool) -> None:
    keyframes = camera_views()
    if color:
        keyframes = [replace(one, color=np.full((*SHAPE, 3), 99, np.uint8)) for one in keyframes]
    volume = volume_of(keyframes, voxel_size=0.02, color=color)
    middle = (-0.5, -0.5, 0.5, 0.5)
    costmap = volume.occupancy_slice(-0.1, 0.1, box=middle, up="z", need_free=True)
    assert (costmap.cells == FREE).mean() > 0.95
    field = volume.distance_field((-0.4, -0.4, -0.1, 0.4, 0.4, 0.1), max_distance=0.5)
    assert (field.occupancy == FREE).mean() > 0.95
    assert (field.distance[field.occupancy == FREE] == 0.5).all()
    beyond = volume.occupancy_slice(-0.1, 0.1, box=(1.7, -0.5, 2.2, 0.5), up="z")
    assert (beyond.cells == UNSEEN).all()
    assert (volume.distance_slice(-0.1, 0.1, box=middle, up="z").distance > 0).mean() > 0.95


def test_the_middle_of_a_room_that_a_lidar_looks_through_is_free() -> None:
    volume = volume_of(SWEEPS, voxel_size=0.05, sensor="lidar", min_range=0.3)
    cells = volume.occupancy_slice(-0.2, 0.2, box=(-0.6, -0.6, 0.6, 0.6), up="z").cells
    assert (cells == FREE).mean() > 0.9
    assert not (cells == OCCUPIED).any()


@pytest.mark.parametrize("voxel_size", [0.02, 0.035])
def test_a_view_looks_through_all_of_its_counted(voxel_size: float) -> None:
    """Each of their voxels lies in the image, before what is seen there."""
    for keyframe in (*camera_views(5), with_holes(camera_views(5)[1])):
        volume = volume_of([keyframe], voxel_size=voxel_size)
        corners = free_blocks(volume)
        assert len(corners) > 5
        steps = (np.array(list(np.ndindex((8, 8, 8)))) + 0.5) * voxel_size
        T = np.linalg.inv(keyframe.T_world_camera)
        p = (corners[:, None] + steps).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        u, v = (p[:, a] / p[:, 2] * 120 + c for a, c in ((0, 79.5), (1, 59.5)))
        assert ((u > -0.5) & (u < 159.5) & (v > -0.5) & (v < 119.5) & (p[:, 2] > 0)).all()
        at = np.rint(v).astype(int), np.rint(u).astype(int)
        seen, near = keyframe.measurement[at], cv2.dilate(keyframe.measurement, np.ones((5, 5)))[at]
        assert ((p[:, 2] < seen) | ((seen == 0) & (near > 0))).all(), "a patch needs two samples"


def test_a_sweep_looks_through_all_of_its_counted() -> None:
    volume = volume_of(SWEEPS[:1], voxel_size=0.04, sensor="lidar", min_range=0.3)
    corners, size = free_blocks(volume), 8 * 0.04
    assert len(corners) > 50
    assert (corners >= -SIDE / 2).all()
    assert (corners + size <= SIDE / 2).all()
    keyframe = SWEEPS[0]
    rays = keyframe.measurement / np.linalg.norm(keyframe.measurement, axis=1, keepdims=True)
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    for corner in corners - keyframe.T_world_camera[:3, 3]:
        near, far = np.sort([corner / rays, (corner + size) / rays], axis=0)
        assert (near.max(axis=1) < far.min(axis=1)).sum() >= 1, "a ray goes through each"


@pytest.mark.parametrize("gap", [0.25, 3.0])
def test_no_pole_that_a_lidar_hits_is_free(gap: float) -> None:
    volume = volume_of(scans(gap), voxel_size=0.1, sensor="lidar")
    assert gap < 1 or len(counted(volume)) > 5
    height = np.arange(0.85, 1.15, 0.02)
    points = np.array([(x, y, z) for x, y in POSTS for z in height])
    field = volume.distance_field((2.4, -1.6, 0.4, 3.6, 1.6, 1.6), max_distance=0.3)
    at = tuple(np.floor((points - field.origin) / field.voxel_size).astype(int).T)
    assert (field.occupancy[at] != FREE).all()


@pytest.mark.parametrize("voxel_size", [0.02, 0.05, 0.1])
def test_no_post_and_no_bar_before_a_camera_is_free(voxel_size: float) -> None:
    volume = volume_of(views(1.0, color=False), voxel_size=voxel_size, sensor="tof")
    points = [(x, y, z) for x, y in POSTS[1:3] for z in np.arange(0.5, 1.3, 0.01)]
    points += [(POSTS[0][0], y, BAR_HEIGHT) for y in np.arange(-0.9, 0.9, 0.01)]
    field = volume.distance_field((2.4, -1.6, 0.2, 3.6, 1.6, 1.6), max_distance=0.3)
    at = tuple(np.floor((np.array(points) - field.origin) / voxel_size).astype(int).T)
    assert (field.occupancy[at] != FREE).all()
    beside = volume.occupancy_slice(0.8, 1.0, box=(1.0, -0.2, 2.0, 0.2), up="z").cells
    assert voxel_size > 0.05 or (beside == FREE).mean() > 0.5


def test_counts_are_sums() -> None:
    for keyframes, settings in ((camera_views(6), {}), (SWEEPS, {"sensor": "lidar", "min_range": 0.3})):
        volume = volume_of(keyframes, voxel_size=0.04, **settings)
        expected = counted(volume)
        assert max(expected.values()) > 1
        for threads in (1, 3):
            other = volume_of(keyframes[::-1], voxel_size=0.04, threads=threads, **settings)
            assert counted(other) == expected
        volume.integrate(keyframes[0])
        assert sum(counted(volume).values()) > sum(expected.values())
        volume.retract(keyframes[0])
        assert counted(volume) == expected
        for keyframe in keyframes:
            volume.retract(keyframe)
        assert counted(volume) == {}


def test_a_refused_keyframe_does_not_count() -> None:
    keyframe, other = camera_views(2)
    volume = volume_of([keyframe], voxel_size=0.02)
    blocks, before = volume.stats().blocks, counted(volume)
    full = volume_of([keyframe], voxel_size=0.02, max_blocks=blocks + 1)
    with pytest.raises(MapFull):
        full.integrate(other)
    assert counted(full) == before


def test_blocks_are_bounded_and_empty_ones_make_room() -> None:
    runtime.start(None)
    table, blocks = ClearBlocks(), 20
    table.add(np.arange(1, 161), 1, blocks)
    with pytest.raises(MapFull, match="160 blocks of free space, 8 times max_blocks"):
        table.add(np.arange(200, 201), 1, blocks)
    assert len(table.counts()[0]) == 160
    table.add(np.arange(1, 141), -1, blocks)
    table.add(np.arange(500, 700), -1, blocks)  # which it never had
    table.add(np.arange(200, 340), 1, blocks)
    assert table.counts()[0].tolist() == [*range(141, 161), *range(200, 340)]
    assert len(table) == 160


def test_who_follows_is_told_what_became_free() -> None:
    runtime.start(None)
    table = ClearBlocks()
    table.add(np.array([5, 7]), 1, 10, 1)
    table.add(np.array([7, 9]), 1, 10, 2)
    table.add(np.array([5]), -1, 10, 3)
    changed = [table.changed_since(version) for version in (0, 1, 2, 3)]
    assert [one.tolist() for one in changed if one is not None] == [[5, 7, 9], [5, 9], [5], []]
    table.replace(table.counts(), 3)
    assert table.changed_since(3) is None
    table.add(np.array([9]), -1, 10, 5)
    assert table.changed_since(4) == [9]


@pytest.mark.parametrize("up", ["z", "0.2,-0.3,0.8"])
def test_a_slice_follows_what_is_looked_through(up: str) -> None:
    first, *others = camera_views(8)
    volume = volume_of([first], voxel_size=0.04)
    how: dict[str, Any] = {"box": (-1.0, -1.0, 1.0, 1.0), "up": up}
    current = volume.current_slice(-0.1, 0.1, **how)
    for keyframe in (*others, None):
        if keyframe is None:
            volume.retract(others[2])
        else:
            volume.integrate(keyframe)
        current.update()
        fresh = volume.current_slice(-0.1, 0.1, **how)
        assert (current.occupancy().cells == fresh.occupancy().cells).all()
        assert (current.distances().distance == fresh.distances().distance).all()


def test_a_saved_map_keeps_them(tmp_path: Path) -> None:
    keyframes = camera_views(4)
    volume = volume_of(keyframes, voxel_size=0.04)
    opened = Volume.load(volume.save(tmp_path / "map.tsf"))
    assert counted(opened) == counted(volume) == counted(volume.copy()) != {}
    opened.retract(keyframes[1])
    assert counted(opened) == counted(volume_of([keyframes[0], *keyframes[2:]], voxel_size=0.04))


def test_a_map_of_an_earlier_version_goes_on(tmp_path: Path) -> None:
    one, other = camera_views(2)
    volume = volume_of([one], voxel_size=0.04)
    volume.save(tmp_path / "new.tsf")
    checkpoint.copy(tmp_path / "new.tsf", tmp_path / "old.tsf", leave_out_counts)
    opened = Volume.load(tmp_path / "old.tsf")
    assert opened.map_hash() == volume.map_hash()
    assert not opened.knows_free_space
    opened.integrate(other)
    opened.retract(one)
    assert opened.knows_free_space
    alone = volume_of([other], voxel_size=0.04)
    assert opened.map_hash() == alone.map_hash()
    assert {key: count for key, count in counted(opened).items() if count > 0}.keys() <= counted(alone).keys()


def leave_out_counts(header: checkpoint.CheckpointHeader) -> None:
    header.clear = b""


@pytest.mark.parametrize("damage", ["cut", "order", "size", "junk"])
def test_damaged_blocks_of_a_saved_map_are_said(tmp_path: Path, damage: str) -> None:
    volume = volume_of(camera_views(1), voxel_size=0.04)
    keys, counts = volume._store.clear.counts()

    def alter(header: checkpoint.CheckpointHeader) -> None:
        header.clear = {
            "cut": header.clear[:-3],
            "order": clear_blocks.encoded((keys[::-1], counts)),
            "size": clear_blocks.encoded((keys + (4 << 60), counts)),
            "junk": b"junk",
        }[damage]

    volume.save(tmp_path / "map.tsf")
    checkpoint.copy(tmp_path / "map.tsf", tmp_path / "other.tsf", alter)
    with pytest.raises(DamagedCheckpoint, match="malformed"):
        Volume.load(tmp_path / "other.tsf")


def test_maps_add_up(tmp_path: Path) -> None:
    keyframes = camera_views(6)
    whole = volume_of(keyframes, voxel_size=0.04)
    one, rest = volume_of(keyframes[:2], voxel_size=0.04), volume_of(keyframes[2:], voxel_size=0.04)
    parts = [one.save(tmp_path / "one.tsf"), rest.save(tmp_path / "rest.tsf")]
    add_files(parts, tmp_path / "sum.tsf")
    one.merge(rest)
    assert counted(one) == counted(whole) == counted(Volume.load(tmp_path / "sum.tsf"))


def test_a_part_of_a_map_knows_the_free_space_of_its_whole_blocks() -> None:
    volume = volume_of(camera_views(12), voxel_size=0.02)
    edge = 8 * 0.02
    parts = [volume.crop((low, -9, -9, low + 9, 9, 9)) for low in (-9 + edge, edge)]
    counted = [np.unique(free_blocks(one), axis=0) for one in (volume, *parts)]
    assert len(counted[0]) == len(counted[1]) + len(counted[2])
    parts[0].merge(parts[1])
    assert parts[0].map_hash() == volume.map_hash()
    assert (np.unique(free_blocks(parts[0]), axis=0) == counted[0]).all()
    cut = volume.crop((-9, -9, -9, 1.5 * edge, 9, 9))
    assert (free_blocks(cut)[:, 0] + edge <= 1.5 * edge + 1e-9).all()


def test_a_sweep_of_a_moving_sensor_is_seen_from_where_it_was() -> None:
    """Each point has a start of its own: the room is as free as from one place, and no more."""
    origins = np.linspace((-0.15, 0, 0), (0.15, 0, 0), len(SWEEPS[1].measurement)).astype(np.float32)
    turn = np.argsort(np.arctan2(*SWEEPS[1].measurement[:, 1::-1].T), kind="stable")
    rays = SWEEPS[1].measurement[turn].astype(np.float64)
    origin = SWEEPS[1].T_world_camera[:3, 3] + origins
    ends = room_depth(origin, rays)
    points = (origins + rays * ends[:, None]).astype(np.float32)
    moving = replace(SWEEPS[1], points=points, origins=origins)
    how: dict[str, Any] = {"voxel_size": 0.05, "sensor": "lidar", "min_range": 0.3}
    one, other = volume_of([SWEEPS[1]], **how), volume_of([moving], **how)
    assert len(counted(other)) > 0.4 * len(counted(one)) > 5
    assert (np.abs(free_blocks(other) + 0.2) <= SIDE / 2 - 0.2 + 1e-9).all()
    fast = replace(moving, origins=origins * 20, points=points)
    assert len(counted(volume_of([fast], **how))) <= len(counted(other))


def test_a_carved_map_counts_none() -> None:
    volume = volume_of(camera_views(2), voxel_size=0.04, space_carving=True)
    assert counted(volume) == {}
    assert volume.knows_free_space
    assert msgspec.structs.asdict(volume.config)["space_carving"]
