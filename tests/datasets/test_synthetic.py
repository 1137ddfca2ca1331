# SPDX-License-Identifier: MIT
"""The synthetic worlds: exact surfaces, the stated noise, the same bytes every time."""

import hashlib
import sys

import cv2
import kernel_twins
import numpy as np
import pytest
from command_processes import python
from geometry_checks import move, warp_residual
from rgbd_scenes import track
from scipy.spatial import cKDTree

from lab.worlds.desk_world import desk
from tsfusion.core.errors import DatasetError
from tsfusion.datasets import Synthetic
from tsfusion.datasets.worlds import worlds
from tsfusion.datasets.worlds.synthetic import DEPTH_SCALE, RayTiles, kinect, stereo
from tsfusion.geometry.keyframe import Keyframe, depth_metres, points_world
from tsfusion.scanner.localization.rgbd.rgbd_tracker import RGBDLocalizer


def digest(keyframe: Keyframe) -> str:
    arrays = (keyframe.measurement, keyframe.color, keyframe.T_world_camera)
    return hashlib.sha256(b"".join(a.tobytes() for a in arrays if a is not None)).hexdigest()


@pytest.mark.parametrize(
    ("world", "sensor", "width", "bound"),
    [
        ("room", "kinect", None, 1e-4),
        ("room", "lidar", None, 1e-6),
        ("street", "lidar", None, 1e-5),
        ("street", "kinect", 320, 1e-4),
    ],
)
def test_clean_views_lie_on_the_known_surface(world, sensor, width, bound):
    dataset = Synthetic(world, sensor, count=24, noise=False, width=width, color=False)
    for index in (0, 7, 23):
        points = points_world(dataset[index])[::7]
        assert len(points) > 300
        assert np.abs(dataset.distance(points)).max() < bound


@pytest.mark.parametrize("world", ["room", pytest.param("street", marks=pytest.mark.nightly)])
def test_clean_disparity_is_exact_to_half_a_unit(world):
    dataset = Synthetic(world, "stereo", noise=False, color=False)
    keyframe = dataset[5]
    valid = keyframe.disparity > 0
    half_a_unit = depth_metres(keyframe) ** 2 / keyframe.baseline_fx / 32
    K, (v, u) = keyframe.intrinsics, np.nonzero(valid)
    stretch = np.hypot(np.hypot((u - K.cx) / K.fx, (v - K.cy) / K.fy), 1)  # of a ray against its depth
    error = np.abs(dataset.distance(points_world(keyframe)))
    near = depth_metres(keyframe)[valid] < 40
    assert (error <= 1.05 * half_a_unit[valid] * stretch + 1e-6)[near].all()


def test_the_room_is_that_of_the_reference_images(data):
    place = data("synthetic_room")
    poses = np.loadtxt(place / "poses.txt").reshape(-1, 3, 4)
    clean, noisy = Synthetic(noise=False, color=False), Synthetic(color=False)
    for index in (0, 13, 39):
        keyframe = clean[index]
        np.testing.assert_allclose(keyframe.T_world_camera[:3], poses[index], atol=1e-7)
        theirs = cv2.imread(str(place / "clean" / f"{index:03d}.png"), cv2.IMREAD_UNCHANGED).astype(int)
        difference = np.abs(keyframe.depth.astype(int) - theirs)
        # Theirs were sphere-traced to a tolerance and cut to whole units; ours meet the formula (above).
        assert np.median(difference) <= 1
        assert (difference <= 12).mean() > 0.99
        reference = cv2.imread(str(place / "kinect" / f"{index:03d}.png"), cv2.IMREAD_UNCHANGED).astype(int)
        ours, their = (
            np.std((image - theirs)[difference <= 2]) for image in (noisy[index].depth.astype(int), reference)
        )
        assert ours == pytest.approx(their, rel=0.02)


def test_the_tour_sees_the_room_from_everywhere_within():
    """Every keyframe stands in free space; walls, floor and things come into view from near and in front."""
    tour = Synthetic("room", count=90, path="tour", noise=False, color=False, width=64)
    poses = np.array([tour.pose(index) for index in range(90)])
    assert tour.distance(poses[:, :3, 3]).min() > 0.15
    seen = np.concatenate([points_world(keyframe) for keyframe in tour])
    surface = np.random.default_rng(3).uniform((-2, -2, 0), (2, 2, 2.4), (4000, 3))
    surface[:, 2] *= np.arange(4000) % 2  # half of them on the floor, the others on the walls
    wall = surface[:, 2] > 0
    surface[wall, 0] = np.sign(surface[wall, 0]) * 2
    surface = surface[np.abs(tour.distance(surface)) < 1e-9]
    assert (cKDTree(seen).query(surface)[0] < 0.06).mean() > 0.97
    assert Synthetic("room", count=1, path="tour")[0].shape == (240, 320)


def test_rooms_that_are_hard_to_find_the_way_in():
    """The same walls and things; what is plain has one colour but for the light, what is bare is empty."""
    room, untextured, plain, bare = (
        Synthetic(name, count=10, path="handheld", width=160)[0]
        for name in ("room", "room-untextured", "room-plain", "room-bare")
    )
    np.testing.assert_array_equal(untextured.depth, room.depth)
    np.testing.assert_array_equal(plain.depth, room.depth)
    assert worlds.room("room-bare").distance(np.array([0.6, 0.3, 0.5])) == 0.5
    things = np.abs(room.depth.astype(int) - bare.depth) > 1000  # 10 cm, of 0.1 mm each
    assert 0.1 < things.mean() < 0.6
    walls = ~cv2.dilate(things.astype(np.uint8), np.ones((9, 9))).astype(bool)
    gray = {name: np.ptp(image.color, axis=2) for name, image in (("all", untextured), ("walls", plain))}
    assert gray["all"].max() <= 1
    assert gray["walls"][walls].max() <= 1
    assert gray["walls"][things].mean() > 10
    assert np.ptp(room.color, axis=2)[walls].mean() > 10


def test_the_hand_moves_as_a_hand_does():
    dataset = Synthetic("room", count=200, path="handheld", width=16)
    poses = np.array([dataset.pose(index) for index in range(200)])
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    speed = np.linalg.norm(steps[:, :3, 3], axis=1) * 10
    turn = np.degrees(np.arccos((np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2)) * 10
    assert 0.2 < speed.min() < 0.4 < speed.max() < 0.6
    assert 20 < turn.mean() < 40
    assert dataset.distance(poses[:, :3, 3]).min() > 0.15
    np.testing.assert_array_equal(Synthetic("room", count=40, path="handheld").pose(30), poses[30])


def test_the_signed_distance_of_the_room_is_the_documented_formula():
    rng = np.random.default_rng(1)
    p = rng.uniform((-2.2, -2.2, -0.2), (2.2, 2.2, 3.0), (5000, 3))
    x, y, z = p.T
    walls = np.min([2 - np.abs(x), 2 - np.abs(y), z, 2.8 - z], axis=0)
    sphere = np.linalg.norm(p - (0.6, 0.3, 0.5), axis=1) - 0.5
    q = np.abs(p - (-0.7, 0.6, 0.4)) - (0.4, 0.3, 0.4)
    box = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    w = np.stack([np.hypot(x, y + 0.8) - 0.15, np.abs(z - 0.6) - 0.6], axis=1)
    column = np.linalg.norm(np.maximum(w, 0), axis=1) + np.minimum(w.max(axis=1), 0)
    nearest = np.min([walls, sphere, box, column], axis=0)
    np.testing.assert_allclose(worlds.room().distance(p), nearest, atol=1e-12)


@pytest.mark.parametrize(
    ("world", "low", "high"), [("room", (-2, -2, 0), (2, 2, 2.8)), ("street", (0, -12, 0), (60, 12, 8))]
)
def test_the_signed_distance_never_exceeds_a_step(world, low, high):
    """|d(p) - d(q)| <= |p - q|: what sphere tracing and the error measure rely on."""
    rng = np.random.default_rng(2)
    p = rng.uniform(low, high, (4000, 3))
    q = p + rng.normal(0, 0.05, p.shape)
    surface = Synthetic(world)
    change = np.abs(surface.distance(p) - surface.distance(q))
    assert (change <= np.linalg.norm(p - q, axis=1) + 1e-12).all()


def test_kinect_noise_has_the_stated_deviation():
    z = np.full((400, 400), 2.0)
    z[:, 200:] = 4.0
    error = kinect(z, np.random.default_rng(0)) * DEPTH_SCALE - z
    assert error[:, :200].std() == pytest.approx(0.0012 + 0.0019 * 1.6**2, rel=0.02)
    assert error[:, 200:].std() == pytest.approx(0.0012 + 0.0019 * 3.6**2, rel=0.02)
    assert abs(error.mean()) < 1e-4


def test_stereo_noise_has_the_stated_deviation_correlation_and_outliers():
    z = np.full((600, 600), 2.0)
    error = stereo(z, 40.0, np.random.default_rng(0)) / 16 - 20.0
    core = error[np.abs(error) < 2]
    assert core.std() == pytest.approx(np.hypot(0.35, 0.15), rel=0.05)
    assert 0.003 < (np.abs(error) > 2).mean() < 0.01
    clipped = np.clip(error, -1, 1)
    neighbours = np.corrcoef(clipped[:, :-1].ravel(), clipped[:, 1:].ravel())[0, 1]
    far = np.corrcoef(clipped[:, :-20].ravel(), clipped[:, 20:].ravel())[0, 1]
    assert neighbours > 0.6
    assert abs(far) < 0.1


def test_lidar_noise_and_losses():
    clean = Synthetic("room", "lidar", noise=False, color=False)
    noisy = Synthetic("room", "lidar", color=False)
    assert 0.9 < len(noisy[0].points) / len(clean[0].points) < 0.99
    ranges = np.linalg.norm(noisy[0].points, axis=1)
    assert ranges.min() > 0.1
    error = noisy.distance(points_world(noisy[0]))
    assert 0.01 < error.std() < 0.02  # 2 cm along rays that meet walls at an angle


def test_equal_seeds_give_equal_bytes_in_any_order():
    for sensor in ("kinect", "stereo", "lidar"):
        a, b = (Synthetic("room", sensor, count=6, seed=4, width=64) for _ in range(2))
        forward = [digest(a[i]) for i in range(3)]
        backward = [digest(b[i]) for i in (2, 1, 0)][::-1]
        assert forward == backward
        assert digest(Synthetic("room", sensor, count=6, seed=5, width=64)[0]) != forward[0]


def test_the_thread_count_changes_nothing():
    code = (
        "import sys; sys.path[:0] = sys.argv[2:]; from tsfusion.kernels.base import runtime;"
        "runtime.start(int(sys.argv[1]));"
        "from tsfusion.datasets import Synthetic; from test_synthetic import digest;"
        "print(digest(Synthetic('street', 'stereo', width=96)[1]), digest(Synthetic('room', 'lidar')[1]))"
    )
    outputs = [python(code, threads, *sys.path, check=True).stdout for threads in (1, 3)]
    assert outputs[0] == outputs[1]
    assert len(outputs[0]) > 128


def test_neighbouring_views_agree():
    for world, sensor in (("room", "kinect"), ("street", "stereo")):
        dataset = Synthetic(world, sensor, noise=False, color=False)
        a, b = dataset[3], dataset[4]
        residual = warp_residual(a, b, max_depth=20)
        assert residual < 0.03
        assert warp_residual(a, b, T_b_a=np.eye(4), max_depth=20) > 5 * residual


def test_colour_is_the_surfaces_own():
    """One place has one colour from every view, and the views are not plain."""
    dataset = Synthetic("room", "kinect", noise=False, width=160)
    a, b = dataset[0], dataset[1]
    q, K = move(np.linalg.inv(b.T_world_camera), points_world(a)), b.intrinsics
    u = np.rint(q[:, 0] / q[:, 2] * K.fx + K.cx).astype(int)
    v = np.rint(q[:, 1] / q[:, 2] * K.fy + K.cy).astype(int)
    ok = (u >= 0) & (v >= 0) & (u < b.shape[1]) & (v < b.shape[0])
    ok[ok] &= np.abs(depth_metres(b)[v[ok], u[ok]] - q[ok, 2]) < 0.02
    colors = a.color.reshape(-1, 3)[(a.depth > 0).ravel()]
    difference = np.abs(colors[ok].astype(int) - b.color[v[ok], u[ok]].astype(int))
    assert ok.mean() > 0.5
    assert np.median(difference) < 12
    assert a.color.std() > 30


def test_the_tables_of_solids_and_materials_agree_with_the_kernel():
    Synthetic(width=16, count=1)[0]  # starts Taichi
    from tsfusion.kernels.worlds import synthetic_raycast, synthetic_textures

    solids = "ROOM BOX SPHERE CYLINDER GROUND"
    materials = "INTERIOR WOOD MARBLE STRIPES ROAD PAVEMENT FACADE PAINT METAL BARK LEAVES GLASS PLAIN"
    for module, names in ((synthetic_raycast, solids), (synthetic_textures, materials)):
        for name in names.split():
            assert getattr(module, name) == getattr(worlds, name)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"world": "moon"}, "world must be one of room, street, .*room-.*, got 'moon'"),
        ({"sensor": "sonar"}, "must be kinect, tof, stereo or lidar, got 'sonar'"),
        ({"count": 0}, "expected count >= 1, .*got count 0"),
        ({"path": "loop"}, "path must be one of circle, tour, handheld, got 'loop'"),
        ({"world": "street", "path": "tour"}, "path must be one of drive, got 'tour'"),
        ({"seed": -1}, "expected .*seed >= 0"),
        ({"width": 3}, "expected .*width >= 16"),
    ],
)
def test_a_world_that_cannot_be_made_is_one_clear_line(settings, match):
    with pytest.raises(DatasetError, match=match):
        Synthetic(**settings)


@pytest.mark.parametrize("world", ["corridor", pytest.param("rooms", marks=pytest.mark.nightly)])
def test_a_scanner_follows_a_world_as_it_comes(world):
    """All 40 frames in one map; a number of frames that is given is spread over the whole path."""
    dataset = Synthetic(world)
    assert len(dataset) == 40
    steps = np.linalg.norm(np.diff([dataset.pose(index)[:3, 3] for index in range(40)], axis=0), axis=1)
    assert steps.max() < 0.25
    result = track(RGBDLocalizer(), [dataset.frame(index) for index in range(40)])
    assert not result.lost
    assert result.ate() < 5
    whole = Synthetic(world, count=dataset.world.steps)
    np.testing.assert_array_equal(whole.pose(39), dataset.pose(39))


@pytest.mark.parametrize("world", ["room", "street"])
def test_rays_meet_what_the_twin_meets_first(world):
    dataset = Synthetic(world, "kinect", noise=False, color=False, width=24)
    keyframe = dataset[3]
    T = keyframe.T_world_camera
    directions = dataset._directions @ T[:3, :3].T
    expected = kernel_twins.trace(dataset.distance, T[:3, 3], directions, 5.9).reshape(keyframe.shape)
    found = np.where(depth_metres(keyframe) < 5.9, depth_metres(keyframe), 0)
    agree = np.abs(found - expected) < 2e-4
    assert agree.mean() > 0.99  # the rest graze an edge


@pytest.mark.parametrize(
    ("world", "sensor"), [("rooms", "kinect"), ("corridor", "kinect"), ("street", "lidar"), (desk(), "tof")]
)
def test_a_ray_that_is_asked_about_few_solids_sees_the_same(world, sensor, monkeypatch):
    dataset = Synthetic(world, sensor, count=9, width=160)

    def whole(tiles, T_world_sensor, solids):
        of_a_tile = np.arange(len(solids), dtype=np.int32)
        count = tiles.tile_of.max() + 1
        return np.arange(count + 1, dtype=np.int32) * len(solids), np.tile(of_a_tile, count)

    few = [digest(dataset[index]) for index in range(0, 9, 2)]
    monkeypatch.setattr(RayTiles, "lists", whole)
    assert [digest(dataset[index]) for index in range(0, 9, 2)] == few
