# SPDX-License-Identifier: MIT
"""Poles, posts and bars thinner than a voxel are never free, however many rays pass them in their voxels."""

from pathlib import Path

import numpy as np
import pytest
from thin_obstacles import BAR_HEIGHT, POSTS, VOXEL, scans, views

from tsfusion import MapError, Volume, VolumeConfig
from tsfusion.geometry.map_grids import FREE, OCCUPIED
from tsfusion.tsdf.files.saved_map_addition import add_files


def check_not_free(volume: Volume, folder: Path, *, bar: bool) -> None:
    """Neither by slices, the file for map_server, nor distances: at the posts, and at the bar."""
    box = (2.5, -1.5, 3.5, 1.5)
    points = np.array([(x, y, 0.9) for x, y in POSTS])
    costmap = volume.occupancy_slice(0.75, 1.05, up="z", box=box)
    rows, columns = costmap.grid.cells_of(points).T
    assert (costmap.cells[rows, columns] == OCCUPIED).all()
    costmap.save(folder / "yard.yaml")
    pixels = np.frombuffer((folder / "yard.pgm").read_bytes()[-costmap.cells.size :], np.uint8)
    assert (pixels.reshape(costmap.cells.shape)[::-1][rows, columns] == 0).all()
    assert (volume.distance_slice(0.75, 1.05, up="z", box=box).distance[rows, columns] < VOXEL).all()
    if bar:
        points = np.append(points, [(POSTS[0][0], y, BAR_HEIGHT) for y in (-0.7, 0.1, 0.9)], axis=0)
    field = volume.distance_field((2.5, -1.5, 0.4, 3.5, 1.5, 1.4), max_distance=0.5)
    at = tuple(np.floor((points - field.origin) / field.voxel_size).astype(int).T)
    assert (field.occupancy[at] == OCCUPIED).all()
    assert (field.distance[at] < VOXEL).all()


@pytest.mark.parametrize("gap", [0.25, 3.0])
@pytest.mark.parametrize("carves", [False, True])
def test_poles_that_a_lidar_hits_are_never_free(tmp_path: Path, *, gap: float, carves: bool) -> None:
    volume = Volume(VOXEL, sensor="lidar", space_carving=carves)
    for scan in scans(gap):
        volume.integrate(scan)
    check_not_free(volume, tmp_path, bar=False)
    beside = volume.occupancy_slice(0.75, 1.05, up="z", box=(1.0, -0.7, 2.5, 0.7)).cells
    assert not carves or (beside == FREE).mean() > 0.95


@pytest.mark.parametrize(
    ("gap", "carves", "color"), [(0.2, False, True), (1.0, True, True), (1.0, True, False)]
)
def test_posts_and_bars_before_a_depth_camera_are_never_free(
    tmp_path: Path, *, gap: float, carves: bool, color: bool
) -> None:
    volume = Volume(VOXEL, sensor="tof", space_carving=carves)
    for view in views(gap, color=color):
        volume.integrate(view)
    check_not_free(volume, tmp_path, bar=True)


def test_what_is_beside_a_wall_in_a_post_or_unseen_is_not_free_to_a_planner() -> None:
    """For a robot of 15 cm, on paths along a wall, through a post, and behind the wall."""
    volume = Volume(0.04, sensor="tof", space_carving=True)
    for view in views(1.0, color=True):
        volume.integrate(view)
    wall = POSTS[0][0] + 1.0
    y = np.linspace(-0.3, 0.3, 13)
    paths = {
        x: np.stack([np.full_like(y, x), y, np.full_like(y, 1.1)], axis=1)
        for x in (wall - 0.1, wall - 0.6, wall + 0.4)
    }
    through = np.linspace([2.5, POSTS[2][1], 1.1], [3.5, POSTS[2][1], 1.1], 41)
    field = volume.distance_field((2, -1, 0.8, wall + 0.5, 1, 1.4), max_distance=0.3)
    assert field.reach == 0.3
    near, free, unseen = (field.at(path) for path in paths.values())
    assert np.abs(near - 0.1).max() < 0.04
    assert (free > 0.2).all()
    assert (unseen == 0).all()
    post = field.at(through)
    assert post.min() <= 0
    ahead = POSTS[2][0] - through[:, 0]
    assert (post[np.abs(ahead) < 0.12] < 0.15).all()
    assert (post[ahead > 0.25] > 0.15).all()
    assert (field.at(np.array([[0.0, 0, 1], [9, 9, 9]])) == 0).all()  # outside the box
    taken = volume.distance_field((wall + 0.3, -1, 0.8, wall + 0.5, 1, 1.4), unseen_is_free=True)
    assert (taken.at(paths[wall + 0.4]) > 0.2).all()
    box = (2, -1, wall + 0.5, 1)
    plane = volume.distance_slice(1.0, 1.2, up="z", box=box)
    rows, columns = plane.grid.cells_of(paths[wall + 0.4]).T
    assert (plane.distance[rows, columns] == 0).all()
    other = volume.distance_slice(1.0, 1.2, up="z", box=box, unseen_is_free=True)
    assert (other.distance[rows, columns] > 0.2).all()
    found = volume.sample(paths[wall - 0.6])
    assert found.reach == pytest.approx(0.12)
    assert np.isfinite(volume.sample([[wall - 0.8 * found.reach, 0, 1.1]]).distance).all()


def test_hits_are_sums_that_go_with_the_map(tmp_path: Path) -> None:
    first, second, *others = scans(3.0, 5)
    volume = Volume(VOXEL, sensor="lidar")
    volume.integrate(first)
    before = {name: layer[: volume._store.count].copy() for name, layer in volume._store.layers().items()}
    assert before["hits"].sum() > 1000
    volume.integrate(second)
    volume.retract(second)
    for name, layer in before.items():
        np.testing.assert_array_equal(volume._store.layers()[name][: len(layer)], layer)
    rest = Volume(VOXEL, sensor="lidar")
    for scan in (*others, second):
        rest.integrate(scan)
        volume.integrate(scan)
    alone = Volume(VOXEL, sensor="lidar")
    alone.integrate(first)
    parts = [alone.save(tmp_path / "one.tsf"), rest.save(tmp_path / "rest.tsf")]
    add_files(parts, tmp_path / "sum.tsf")
    assert hits(Volume.load(tmp_path / "sum.tsf")) == hits(volume)
    alone.merge(rest)
    assert hits(alone) == hits(volume) == hits(Volume.load(volume.save(tmp_path / "map.tsf")))


def test_a_map_that_has_not_counted_hits_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of an earlier version: nothing is counted of what it holds, and all of it can be taken away."""
    one, other = scans(3.0, 2)
    with monkeypatch.context() as earlier:
        earlier.setattr(VolumeConfig, "counts_hits", False)
        volume = Volume(VOXEL, sensor="lidar")
        volume.integrate(one)
        volume.save(tmp_path / "map.tsf")
    opened = Volume.load(tmp_path / "map.tsf")
    assert opened.map_hash() == volume.map_hash()
    opened.integrate(other)
    opened.retract(one)
    fresh = Volume(VOXEL, sensor="lidar")
    fresh.integrate(other)
    assert opened.map_hash() == fresh.map_hash()


def test_a_map_that_counts_no_hits_is_added_to_one_that_does() -> None:
    lidar, camera = Volume(VOXEL, sensor="lidar"), Volume(VOXEL, sensor="kinect")
    for volume, keyframe in zip((lidar, camera), scans(3.0, 2), strict=True):
        volume.integrate(keyframe)
    with pytest.raises(MapError, match="add this one to that one"):
        camera.merge(lidar)
    counted = int(lidar._store.hits.sum())
    both = lidar.copy()
    both.merge(camera)
    assert (both.keyframes, int(both._store.hits.sum())) == (2, counted)
    assert both.map_hash() not in (lidar.map_hash(), camera.map_hash())


def hits(volume: Volume) -> dict[int, bytes]:
    """Row of each block."""
    store = volume._store
    return {int(store.keys[slot]): store.hits[slot].tobytes() for slot in store.used()}
