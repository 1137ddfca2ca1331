# SPDX-License-Identifier: MIT
"""A jump of the poses and a drift between two visits are found with their place and size; good poses pass."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tsfusion.datasets.dataset import Frames
from tsfusion.evaluation.frame_pairs import FramePair, pairs_of, seen_frames
from tsfusion.evaluation.pose_check import check
from tsfusion.evaluation.trajectory_check import PoseFault, find_fault
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics

K, SIZE = Intrinsics(150.0, 150.0, 79.5, 59.5), (120, 160)
ROOM = np.array([[-2.2, -1.6, 0.0], [2.0, 1.8, 2.5]])
CABINET = np.array([[1.2, 0.3, 0.0], [2.0, 1.1, 1.2]])
HALL = np.array([[-40.0, -30.0, 0.0], [100.0, 30.0, 8.0]])
Poses = list[NDArray[np.float64]]


class Walk(Frames):
    """Frames of a formula, 30 or 10 a second, with poses that may be wrong."""

    def __init__(self, measurements: list[dict[str, object]], poses: Poses, *, hz: int, sensor: str) -> None:
        self.name, self.sensor, self.skipped = "a walk", sensor, {}
        self._measured, self._poses = measurements, poses
        self.timestamps_ns = np.arange(len(poses)) * (10**9 // hz)

    def __len__(self) -> int:
        return len(self._measured)

    def _frame(self, index: int) -> Frame:
        return self._posed_frame(index, **self._measured[index])


def cast(
    origin: NDArray[np.float64], rays: NDArray[np.float64], *boxes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(n,) lengths of rays from inside the first box to it, or to the others, which are solid."""
    with np.errstate(divide="ignore"):
        ends = (boxes[0][:, None] - origin) / rays
        length = np.max(ends, axis=0).min(axis=1)
        for box in boxes[1:]:
            ends = (box[:, None] - origin) / rays
            near, far = np.min(ends, axis=0).max(axis=1), np.max(ends, axis=0).min(axis=1)
            length = np.where((near > 0) & (near < far), np.minimum(length, near), length)
    return length


@cache
def twice_round_a_room() -> tuple[list[dict[str, object]], Poses]:
    poses, measured = [], []
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].reshape(2, -1)
    pixels = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(u.size)], axis=1)
    for angle in np.linspace(0, 4 * np.pi, 80, endpoint=False):
        way = np.array([np.cos(angle), np.sin(angle), -0.25]) / np.hypot(1, 0.25)
        right = np.array([np.sin(angle), -np.cos(angle), 0.0])
        T = se3.transform(np.stack([right, np.cross(way, right), way], axis=1), [0, 0, 1.3] + 0.5 * way)
        depth = cast(T[:3, 3], pixels @ T[:3, :3].T, ROOM, CABINET).reshape(SIZE)
        measured.append(
            {"depth": np.round(1000 * depth).astype(np.uint16), "depth_scale": 0.001, "intrinsics": K}
        )
        poses.append(T)
    return measured, poses


def moved(shift: Callable[[int], float], axis: int = 0) -> Walk:
    measured, poses = twice_round_a_room()
    offsets = [shift(index) * np.eye(3)[axis] for index in range(len(poses))]
    given = [se3.transform(T[:3, :3], T[:3, 3] + off) for T, off in zip(poses, offsets, strict=True)]
    return Walk(measured, given, hz=30, sensor="kinect")


def fault_of(walk: Walk) -> PoseFault | None:
    def compare(first: int, second: int) -> FramePair | None:
        return next(iter(pairs_of(seen_frames(walk, [(first, second)]), [(first, second)])), None)

    return find_fault(walk, compare, 2.0)


def test_good_poses_pass() -> None:
    noise = np.random.default_rng(0).normal(0, 0.004, 80)
    assert check(moved(lambda _: 0.0)).verdict == "agree"
    assert check(moved(lambda index: noise[index])).verdict == "agree"


@pytest.mark.parametrize(("metres", "axis"), [(0.15, 0), (0.4, 1), (1.5, 2)])
def test_a_jump_is_found_where_it_is(metres: float, axis: int) -> None:
    report = check(moved(lambda index: metres * (index > 30), axis))
    assert (report.verdict, report.mistake, report.frames) == ("disagree", "jump", (30, 31))
    assert report.metres == pytest.approx(metres, rel=0.05)
    assert f"jump by {metres:.2f} m from frame 30 to 31 (1.00 s to 1.03 s)" in report.text


def test_a_measurement_that_is_repeated_while_the_poses_go_on_is_told() -> None:
    walk = moved(lambda _: 0.0)
    walk._measured = [*walk._measured[:30], *walk._measured[30:31] * 20, *walk._measured[50:]]
    report = check(walk)
    assert (report.verdict, report.mistake) == ("disagree", "repeated frames")
    assert report.frames is not None
    assert 30 <= report.frames[0] < report.frames[1] < 50


def test_a_simulated_camera_that_passes_a_plain_wall_does_not_repeat_a_measurement() -> None:
    wall = {"depth": np.full(SIZE, 1500, np.uint16), "intrinsics": K}
    poses = [se3.transform(np.eye(3), [0.3 * index, 0.0, 0.0]) for index in range(40)]
    assert check(Walk([wall] * 40, poses, hz=10, sensor="kinect")).verdict == "cannot tell"


def test_one_wrong_pose_of_few_is_a_jump() -> None:
    walk = moved(lambda index: 0.5 * (index == 5))
    walk._measured, walk._poses, walk.timestamps_ns = (
        walk._measured[:12],
        walk._poses[:12],
        walk.timestamps_ns[:12],
    )
    fault = fault_of(walk)
    assert fault is not None
    assert (fault.mistake, fault.metres) == ("jump", pytest.approx(0.5, abs=0.05))


@pytest.mark.parametrize(("metres", "axis"), [(0.2, 0), (0.6, 0)])
def test_drift_shows_where_a_place_is_seen_again(metres: float, axis: int) -> None:
    report = check(moved(lambda index: metres * index / 80, axis))
    assert (report.verdict, report.mistake) == ("disagree", "drift")
    assert report.frames is not None
    first, second = report.frames
    assert second - first >= 35
    assert report.metres == pytest.approx(metres * (second - first) / 80, abs=0.02)


def test_a_step_that_no_sensor_makes_is_a_jump_where_frames_show_nothing() -> None:
    walk = moved(lambda index: 0.4 * (index > 30))
    blank = {**walk._measured[30], "depth": np.zeros(SIZE, np.uint16)}
    walk._measured = [*walk._measured[:30], blank, *walk._measured[31:]]
    fault = fault_of(walk)
    assert fault is not None
    assert (fault.mistake, fault.frames) == ("jump", (30, 31))
    assert fault.metres == pytest.approx(0.4, rel=0.1)
    walk.timestamps_ns = None  # who knows how fast it was
    fault = fault_of(walk)
    assert fault is not None
    assert fault.mistake == "drift"


def test_poses_that_are_off_each_by_itself_neither_jump_nor_drift() -> None:
    noise = np.random.default_rng(1).normal(0, 0.2, 80)
    assert fault_of(moved(lambda index: noise[index])) is None


def test_one_place_alone_shows_no_drift() -> None:
    """Something may have been moved there; the other places are as before."""
    assert fault_of(moved(lambda index: 0.3 * float(np.clip((8 - abs(index - 60)) / 6, 0, 1)))) is None


def lidar_rays() -> NDArray[np.float64]:
    azimuth, elevation = np.meshgrid(
        np.linspace(0, 2 * np.pi, 720, endpoint=False), np.radians(np.linspace(-15, 15, 16))
    )
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], -1).reshape(-1, 3)


def test_scans_of_a_tunnel_which_are_all_alike_are_not_refused() -> None:
    tunnel, rays = np.array([[-1000.0, -3.0, 0.0], [1000.0, 3.0, 4.0]]), lidar_rays()
    length = cast(np.array([0.0, 0.0, 2.0]), rays, tunnel)
    scan = {"points": np.float32(rays * length[:, None])[length < 80]}
    poses = [se3.transform(np.eye(3), [float(index), 0.0, 2.0]) for index in range(40)]
    assert check(Walk([scan] * 40, poses, hz=10, sensor="lidar")).verdict == "cannot tell"


def test_exact_scans_of_a_lidar_that_moves_pass_and_its_jump_does_not() -> None:
    rays = lidar_rays()
    poses = [se3.transform(np.eye(3), [0.8 * index, 0.5 * np.sin(0.1 * index), 1.0]) for index in range(40)]
    boxes = [np.array([[x, y, 0.0], [x + 2, y + 2, 3.0]]) for x, y in ((10, 3), (20, -6), (31, 4), (5, -5))]
    lengths = [cast(T[:3, 3], rays, HALL, *boxes) for T in poses]
    measured = [{"points": np.float32(rays * length[:, None])[length < 80]} for length in lengths]
    assert check(Walk(measured, poses, hz=10, sensor="lidar")).verdict == "agree"
    jumped = [se3.transform(np.eye(3), T[:3, 3] + [0, 2.5 * (i > 20), 0]) for i, T in enumerate(poses)]
    report = check(Walk(measured, jumped, hz=10, sensor="lidar"))
    assert (report.mistake, report.frames) == ("jump", (20, 21))
    points = [
        np.float32(one["points"] @ T[:3, :3].T + T[:3, 3]) for one, T in zip(measured, poses, strict=True)
    ]
    report = check(Walk([{"points": each} for each in points], poses, hz=10, sensor="lidar"))
    assert (report.verdict, report.mistake) == ("disagree", "points in the world")
