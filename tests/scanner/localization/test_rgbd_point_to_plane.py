# SPDX-License-Identifier: MIT
"""Planes of depth images and the step between two views, on surfaces that are known exactly."""

import cv2
import numpy as np
import pytest

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization import features
from tsfusion.scanner.localization.rgbd.point_to_plane import correlated_blocks, equations, fit_planes, match
from tsfusion.scanner.localization.rgbd.pose_solver import AlignmentTarget, solve

K = Intrinsics(585.0, 585.0, 319.5, 239.5)


def corner_of_a_room(T: np.ndarray, K: Intrinsics = K, shape: tuple[int, int] = (480, 640)) -> np.ndarray:
    """(H, W) float32 metres: three walls that meet ahead, seen from `T`, T_world_camera."""
    v, u = np.indices(shape)
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(shape)], axis=-1) @ T[:3, :3].T
    depth = np.full(shape, np.inf)
    for normal, offset in (((0.6, 0, 0.8), 2.0), ((-0.6, 0, 0.8), 1.8), ((0, 0.8, 0.6), 1.6)):
        z = (offset - np.dot(normal, T[:3, 3])) / (rays @ np.array(normal))
        depth = np.minimum(depth, np.where(z > 0, z, np.inf))
    return depth.astype(np.float32)


def test_planes_are_those_of_the_surface():
    seen = fit_planes(corner_of_a_room(np.eye(4)), K)
    assert seen.shape == (120, 160)
    assert seen.covered > 0.9
    normals, offsets = seen.planes(np.flatnonzero(seen.offsets))
    planes = np.concatenate([normals, offsets[None]])
    truth = np.array([(0.6, 0, 0.8, 2.0), (-0.6, 0, 0.8, 1.8), (0, 0.8, 0.6, 1.6)])
    away = np.abs(planes.T[:, None] - truth).max(axis=2).min(axis=1)
    assert (away < 1e-3).mean() > 0.93  # the rest lie across an edge
    assert seen.roughness < 1e-3


def test_the_last_rows_have_planes_whatever_their_number():
    shape = (424, 512)  # a Kinect v2's: 141 rows of blocks, which is no number of whole strips
    seen = fit_planes(corner_of_a_room(np.eye(4), K, shape), K)
    assert seen.shape == (141, 170)
    offsets = seen.offsets.reshape(seen.shape)
    assert (offsets[-9:-1, 2:-2] > 0).mean() > 0.9
    np.testing.assert_allclose(
        fit_planes(np.full(shape, 2.0), K).offsets.max(),
        2.0,
        rtol=1e-5,  # of float64, too
    )


def test_the_centre_of_a_block_lies_on_its_ray():
    seen = fit_planes(np.full((480, 640), 2.0, np.float32), K)
    u, v = seen.points[0] / seen.points[2] * K.fx + K.cx, seen.points[1] / seen.points[2] * K.fy + K.cy
    np.testing.assert_allclose(u[:3], (1.5, 5.5, 9.5), atol=1e-3)
    np.testing.assert_allclose(v[::160][:3], (1.5, 5.5, 9.5), atol=1e-3)
    np.testing.assert_allclose(seen.points[2], 2.0, rtol=1e-6)


@pytest.mark.parametrize("depth", [np.zeros((48, 64), np.float32), np.full((1, 1), 2.0, np.float32)])
def test_no_surface(depth):
    seen = fit_planes(depth, K)
    assert seen.covered == 0
    found = match(seen, seen, np.eye(4), None)
    assert len(found.distance) == 0
    assert correlated_blocks(found, seen.shape[1]) == 1


def test_holes_and_edges_have_no_plane():
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 320:] = 1.0
    depth[100:140, 100:140] = 0
    seen = fit_planes(depth, K)
    offsets = seen.offsets.reshape(seen.shape)
    assert (offsets[:, 79:81] == 0).all()
    assert (offsets[26:34, 26:34] == 0).all()
    assert (offsets[2:20, 2:70] > 0).all()


def test_a_moved_view_is_as_far_from_the_planes_as_it_moved():
    wall = fit_planes(np.full((480, 640), 2.0, np.float32), K)
    T = se3.exp(np.array([0, 0, 0.05, 0, 0, 0]))
    np.testing.assert_allclose(match(wall, wall, T, None).distance, 0.05, atol=1e-4)
    assert len(match(wall, wall, se3.exp(np.array([9.0, 0, 0, 0, 0, 0])), None).distance) == 0
    assert len(match(wall, wall, se3.exp(np.array([0, 0, -5.0, 0, 0, 0])), None).distance) == 0


def test_planes_without_points_are_matched_as_before_in_a_quarter_of_the_memory():
    T = se3.exp(np.array([0.01, -0.02, 0.01, 0.01, 0.005, -0.01]))
    there, here = (fit_planes(corner_of_a_room(pose), K) for pose in (np.eye(4), T))
    kept = there.without_points()
    assert kept.points.size == kept.sigma.size == kept.index.size == 0
    assert kept.covered == there.covered
    before, after = (match(image, here, T, None) for image in (there, kept))
    np.testing.assert_array_equal(after.block, before.block)
    np.testing.assert_allclose(after.distance, before.distance, rtol=0, atol=1e-4)
    arrays = ("points", "sigma", "index", "normals", "offsets")
    whole, packed = (sum(getattr(image, name).nbytes for name in arrays) for image in (there, kept))
    assert packed < 0.27 * whole
    assert kept.without_points() is kept


def test_the_step_is_the_gradient_of_the_distances():
    """Against differences: moving by -gradient/information is what brings the sum of squares down fastest."""
    T = se3.exp(np.array([0.01, -0.02, 0.01, 0.01, 0.005, -0.01]))
    there, here = (fit_planes(corner_of_a_room(pose), K) for pose in (np.eye(4), T))
    found = match(there, here, np.eye(4), None)
    one = np.ones(len(found.distance), np.float32)
    _, g = equations(found, one)

    def cost(step: np.ndarray) -> float:
        moved = se3.apply(se3.exp(step), found.moved.T)
        change = np.einsum("in,ni->n", found.normals, moved - found.moved.T)
        return float(((found.distance + change) ** 2).sum() / 2)

    for axis in range(6):
        step = 1e-4 * np.eye(6)[axis]
        assert -g[axis] == pytest.approx((cost(step) - cost(-step)) / 2e-4, rel=1e-3, abs=1e-2)


def test_errors_that_are_alike_count_once():
    rng = np.random.default_rng(0)
    wall = fit_planes(np.full((480, 640), 2.0, np.float32), K)
    white = (2 + 0.006 * rng.standard_normal((480, 640))).astype(np.float32)
    smooth = cv2.GaussianBlur(rng.standard_normal((480, 640)), (0, 0), 30)
    wavy = (2 + 0.006 * smooth / smooth.std()).astype(np.float32)
    matched = (match(wall, fit_planes(z, K), np.eye(4), None) for z in (white, wavy))
    counts = [correlated_blocks(each, 160) for each in matched]
    assert 1 <= counts[0] < 1.3
    assert counts[1] > 30


@pytest.mark.parametrize("corners", [0, 200])
def test_the_pose_is_found_from_ten_centimetres_away(corners):
    T = se3.exp(np.array([0.06, -0.05, 0.07, 0.05, -0.04, 0.05]))
    there, here = (fit_planes(corner_of_a_room(pose), K) for pose in (np.eye(4), T))
    points = np.random.default_rng(0).uniform((-0.5, -0.5, 1), (0.5, 0.5, 2), (corners, 3))
    q = se3.apply(se3.inverse(T), points)
    pixels = np.stack([K.fx * q[:, 0] / q[:, 2] + K.cx, K.fy * q[:, 1] / q[:, 2] + K.cy], axis=1)
    link = AlignmentTarget(np.eye(4), there, points, pixels.astype(np.float32))
    off = se3.inverse(T) @ solve([link], here, K, 640, np.eye(4)).T_anchor_camera
    assert se3.distance(off) < 2e-4
    assert se3.angle(off) < 2e-4


def test_corners_alone_give_the_pose_and_outliers_do_not_matter():
    rng = np.random.default_rng(1)
    T = se3.exp(rng.normal(0, 0.03, 6))
    nothing = fit_planes(np.zeros((480, 640), np.float32), K)
    points = rng.uniform((-1, -1, 1), (1, 1, 3), (300, 3))
    q = se3.apply(se3.inverse(T), points)
    pixels = np.stack([K.fx * q[:, 0] / q[:, 2] + K.cx, K.fy * q[:, 1] / q[:, 2] + K.cy], axis=1)
    pixels[:40] += rng.normal(0, 80, (40, 2))
    link = AlignmentTarget(np.eye(4), nothing, points, pixels.astype(np.float32))
    guess = T @ se3.exp(np.full(6, 0.005))
    off = se3.inverse(T) @ solve([link], nothing, K, 640, guess).T_anchor_camera
    assert se3.distance(off) < 1e-3


def test_what_moves_in_one_view_moves_by_the_other_the_same():
    """A second view's planes are used in the first one's axes."""
    T_a_b = se3.exp(np.array([0.1, 0.05, -0.1, 0.02, 0.1, 0.05]))
    T = se3.exp(np.array([0.02, 0.03, 0.01, -0.01, 0.02, 0.02]))
    a, b, here = (fit_planes(corner_of_a_room(pose), K) for pose in (np.eye(4), T_a_b, T))
    none, nowhere = np.empty((0, 3)), np.empty((0, 2), np.float32)
    links = [
        AlignmentTarget(np.eye(4), a, none, nowhere),
        AlignmentTarget(se3.inverse(T_a_b), b, none, nowhere),
    ]
    off = se3.inverse(T) @ solve(links, here, K, 640, np.eye(4)).T_anchor_camera
    assert se3.distance(off) < 2e-4
    assert se3.angle(off) < 2e-4


def test_noise_has_no_corners():
    rng = np.random.default_rng(2)
    for sigma in (0.5, 2, 6):
        gray = np.clip(120 + sigma * rng.standard_normal((240, 320)), 0, 255).astype(np.uint8)
        found = features.corners(gray, 400)
        assert len(found) > 100
        assert not features.stronger_than_noise(gray, found).any()
        gray[100:120, 100:120] = 240
        found = features.corners(gray, 400)
        assert features.stronger_than_noise(gray, found).sum() == 4
