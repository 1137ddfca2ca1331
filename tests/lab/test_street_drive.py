# SPDX-License-Identifier: MIT
"""Streets along KITTI's paths: clear of the path, known surfaces, true stereo."""

import hashlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from geometry_checks import move
from small_recordings import round_a_block

from lab.evaluation.known_surfaces import WorldSurface, drive_surface
from lab.worlds import roadside
from lab.worlds.street_drive import StreetDrive
from tsfusion.datasets.worlds import worlds

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return round_a_block(tmp_path_factory.mktemp("poses") / "06.txt")


@pytest.fixture(scope="module")
def drive(path):
    return StreetDrive("kitti06", kitti=path, width=240)


def points_of(depth, drive, index):
    K, (v, u) = drive.intrinsics, np.nonzero(depth)
    z = depth[v, u]
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)
    return move(drive.pose(index), points), z


def test_equal_arguments_give_equal_bytes_in_any_order(path, drive):
    def digest(frame):
        return hashlib.sha256(frame.left.tobytes() + frame.right.tobytes() + frame.color.tobytes()).digest()

    again = StreetDrive("kitti06", kitti=path, width=240)
    assert [digest(drive.frame(i)) for i in (3, 70)] == [digest(again.frame(i)) for i in (70, 3)][::-1]
    assert digest(drive.frame(3)) != digest(StreetDrive("kitti06", kitti=path, width=240, seed=1).frame(3))
    assert drive.frame(3).left.std() > 25
    assert (
        drive.fingerprint() == again.fingerprint() != StreetDrive("kitti06", kitti=path, seed=1).fingerprint()
    )


def test_the_ground_goes_on_beyond_its_border(drive):
    """The last node's height counts there: nothing behind the arrays is read."""
    ground = drive.world.ground
    far = np.array([[1e4, 1e4, 0.0], [-1e4, 1e4, 0.0], [1e4, -1e4, 0.0], [-1e4, -1e4, 0.0]])
    corners = ground.heights[[-1, -1, 0, 0], [-1, 0, -1, 0]]
    np.testing.assert_array_equal(ground.height(far), corners)
    renderer = drive._rendering()
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = (*ground.layout[:2] + (np.array(ground.heights.shape)[::-1] - 1) * 4 + 5, corners[0] + 2)
    depth = renderer.depth(T)[:, : drive.size[1] // 2]
    v = np.arange(depth.shape[0])[-8:]
    K = drive.intrinsics
    expected = (2 - 0.13) * K.fy / (v - K.cy)
    np.testing.assert_allclose(depth[-8:], np.repeat(expected[:, None], depth.shape[1], axis=1), rtol=1e-9)


def test_what_is_rendered_lies_on_the_known_surface(drive):
    kinds = set()
    for index in (5, 33, 100):
        points, z = (part[::4] for part in points_of(drive.depth(index), drive, index))
        error = np.abs(drive.distance(points))
        assert len(points) > 2500
        assert np.quantile(error, 0.98) < 1e-4
        assert (error < 0.01 + 0.001 * z).all()  # slopes and bends
        renderer, T = drive._rendering(), drive._eye(index, 0.0)
        kinds |= set(np.unique(renderer._cast(T, renderer._tiles(T), renderer._pixels)[1]))
    assert {-1, -2, -3, -4} < kinds
    surface = drive_surface(drive, [5, 100], voxel_size=0.2, max_range=25)
    np.testing.assert_allclose(surface.distance(points[::20]), drive.distance(points[::20]), atol=1e-9)
    assert len(surface.seen) > 1000
    apart = [np.linalg.norm(surface.seen - drive.pose(i)[:3, 3], axis=1) for i in (5, 100)]
    assert np.min(apart, axis=0).max() < 40  # 25 m deep, at the edge of the image
    assert np.abs(drive.distance(surface.seen)).max() < 0.002
    up = -drive._upright[2] @ np.array(drive._poses)[:, :3, 1].mean(axis=0)
    assert up == pytest.approx(1)


def test_tiles_lose_no_solid(drive):
    """Rays that may meet every solid meet the same as those that look in their tile's list."""
    renderer, T = drive._rendering(), drive._eye(40, 0.0)
    starts, _, nearest = renderer._tiles(T)
    every = np.argsort(nearest, kind="stable").astype(np.int32)
    ends = np.arange(len(starts), dtype=np.int32)
    whole = (np.repeat(0, len(ends)).astype(np.int32), every, nearest)
    whole[0][1:] = len(every)  # the first tile lists all of them
    first = np.flatnonzero(np.arange(len(renderer._pixels)) >= 0)[::7]
    listed, _ = renderer._cast(T, renderer._tiles(T), renderer._pixels[first])
    renderer_all = _cast_all(renderer, T, whole, renderer._pixels[first])
    np.testing.assert_array_equal(listed, renderer_all)


def _cast_all(renderer, T, lists, pixels):
    from lab.worlds.kernels.street_raycast import cast_view
    from lab.worlds.street_views import REACH

    distance, hit = np.empty(len(pixels)), np.empty(len(pixels), dtype=np.int32)
    ground = renderer._ground
    cast_view(
        T, renderer._rays(pixels), np.zeros(len(pixels), np.int32), *lists, renderer._solids, ground.heights,
        ground.apart, ground.layout, REACH, distance, hit,
    )  # fmt: skip
    return distance


def test_the_right_picture_agrees_with_the_left_ones_depth(path):
    drive = StreetDrive("kitti06", kitti=path, width=480, noise=False)
    frame, depth = drive.frame(60), drive.depth(60)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float32)
    disparity = np.where(depth > 0, drive.baseline_fx / np.maximum(depth, 1), 0).astype(np.float32)

    def error(shift):
        warped = cv2.remap(frame.right, u - disparity + shift, v, cv2.INTER_LINEAR).astype(int)
        seen = (u > disparity + 3) & (depth > 0) & (depth < 60)
        return np.median(np.abs(warped - frame.left)[seen])

    assert error(0) <= 3  # of 255: exposures differ by two percent
    assert min(error(-2), error(2)) > 2 * error(0)


@pytest.mark.parametrize("name", ["kitti06", "kitti07"])
def test_nothing_stands_in_the_way(data, name):
    drive = StreetDrive(name, kitti=data("kitti_odometry"))
    cameras = np.array(drive._poses)[::3, :3, 3]
    solids = drive.world.solids
    houses = solids[np.isin(solids[:, 9], (roadside.HOUSE, roadside.TILES))]
    for rows, clearance in ((houses, 3), (solids, 1)):
        world = replace(drive.world, solids=rows, ground=None)
        assert WorldSurface(world, np.empty((0, 3)), edges=False).distance(cameras).min() > clearance
    height = drive.world.ground.distance(drive.world.turned(cameras))
    assert 1.4 < height.min() < 1.65 < height.max() < 1.9
    beside = [
        np.linalg.norm(solids[:, 1:3] - place, axis=1) for place in drive.world.turned(cameras)[::20, :2]
    ]
    built = [(np.isin(solids[:, 9], (roadside.HOUSE,)) & (away < 45)).sum() for away in beside]
    assert min(built) >= 3  # along the whole path


def test_the_tables_agree_with_the_kernels(drive):
    drive._rendering()
    from lab.worlds.kernels import street_shading, street_things
    from tsfusion.kernels.worlds import synthetic_raycast

    for name in (
        *(
            "HOUSE",
            "TILES",
            "BODY",
            "CABIN",
            "TYRE",
            "POLE",
            "TRUNK",
            "CROWN",
            "HEDGE",
            "SIGN",
            "FENCE",
            "BIN",
        ),
        "SUNK",
    ):
        assert getattr(street_things, name) == getattr(roadside, name)
    assert tuple(roadside.SUN) == street_shading.SUN
    assert (synthetic_raycast.AXLE, synthetic_raycast.PRISM) == (worlds.AXLE, worlds.PRISM)
