# SPDX-License-Identifier: MIT
"""Following a LiDAR."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_processes import python

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.datasets import open_dataset
from tsfusion.datasets.dataset import frame_of
from tsfusion.datasets.worlds.synthetic import Synthetic
from tsfusion.evaluation.trajectory_error import absolute_error
from tsfusion.geometry import se3, sweeps
from tsfusion.geometry.frame import Attitude, Frame
from tsfusion.scanner.localization.localizer import Lost, TrackedPose

pytest.importorskip("kiss_icp", exc_type=ImportError, reason="no kiss-icp: pip install '.[lidar]'")

from tsfusion.scanner.localization.lidar import LidarLocalizer

Data = Callable[[str], Path]


@pytest.fixture
def kitti(data: Data) -> list[Frame]:
    options = {"sequence": "00", "modality": "lidar", "poses": "poses_estimated/00_ORB.txt"}
    dataset = open_dataset(data("kitti_odometry"), **options)
    return [frame_of(dataset, index) for index in range(6)]


@pytest.fixture(scope="module")
def street() -> list[Frame]:
    dataset = Synthetic("street", "lidar", count=30, color=False)
    return [dataset.frame(index) for index in range(30)]


def scan(points: np.ndarray) -> Frame:
    return Frame(sensor="lidar", points=points.astype(np.float32))


def pose_of(frame: Frame) -> np.ndarray:
    return frame.T_world_camera


def away(found: list[TrackedPose | Lost], frames: list[Frame]) -> list[float]:
    """Metres between each pose and the frame's own, first upon first."""
    poses = [pose.T_world_camera for pose in found if isinstance(pose, TrackedPose)]
    first = se3.inverse(pose_of(frames[0]))
    pairs = zip(poses, frames, strict=True)
    return [se3.distance(se3.inverse(first @ pose_of(frame)) @ T) for T, frame in pairs]


def test_kitti_agrees_with_orb(kitti: list[Frame]) -> None:
    lidar = LidarLocalizer()
    found = [lidar.track(frame) for frame in kitti]
    assert max(away(found, kitti)) < 0.10  # the bar is 0.15
    assert all(pose.quality > 0.9 for pose in found if isinstance(pose, TrackedPose))


def test_street_from_a_rolling_start(street: list[Frame]) -> None:
    """KISS-ICP alone takes the first two metres for none: rings on the ground look the same everywhere."""
    lidar = LidarLocalizer()
    found = [lidar.track(frame) for frame in street]
    errors = away(found, street)
    assert max(errors[:4]) < 0.15
    poses = np.array([pose.T_world_camera for pose in found if isinstance(pose, TrackedPose)])
    error = absolute_error(poses, np.array([frame.T_world_camera for frame in street]))
    assert error.rmse < 0.08
    assert error.drift_percent < 0.5


def test_street_from_a_fast_start(street: list[Frame]) -> None:
    """Four metres on, a street looks nearly the same: a pose at rest has 80 % of the points."""
    lidar, fast = LidarLocalizer(), street[::4]
    assert max(away([lidar.track(frame) for frame in fast], fast)) < 0.5


def test_room() -> None:
    dataset = Synthetic("room", "lidar", count=40, color=False)
    frames = [dataset.frame(index) for index in range(20)]
    lidar = LidarLocalizer()
    assert max(away([lidar.track(frame) for frame in frames], frames)) < 0.08


def test_a_gyroscope_askew_by_90_degrees_is_told_once_and_does_no_harm(
    caplog: pytest.LogCaptureFixture,
) -> None:
    dataset = Synthetic("room", "lidar", count=40, color=False)
    Q = se3.exp(np.array([0, 0, 0, 1.6, 0, 0]))[:3, :3]
    frames = [dataset.frame(index) for index in range(16)]
    found = []
    for axes in (None, np.eye(3), Q):
        lidar, seen = LidarLocalizer(), frames
        if axes is not None:
            R = [axes @ frame.T_world_camera[:3, :3] @ axes.T for frame in frames]
            seen = [replace(frame, attitude=Attitude(each)) for frame, each in zip(frames, R, strict=True)]
        found.append(max(away([lidar.track(frame) for frame in seen], frames)))
    blind, helped, askew = found
    assert helped < 1.1 * blind + 0.005
    assert askew < 1.2 * blind + 0.005
    assert caplog.text.count("the gyroscope is not used any more") == 1


@pytest.mark.parametrize("second", [True, False])
def test_scans_of_two_sensors_in_turn_are_told(
    street: list[Frame], caplog: pytest.LogCaptureFixture, second: bool
) -> None:
    lidar, aside = LidarLocalizer(), np.array([0, 0.4, 0], np.float32)
    for index, frame in enumerate(street[:16]):
        found = lidar.track(scan(frame.points + aside) if second and index % 2 else scan(frame.points))
        assert isinstance(found, TrackedPose)
    assert caplog.text.count("two sensors") == second


def test_equal_scans_give_equal_poses(street: list[Frame]) -> None:
    runs = []
    for _ in range(2):
        lidar = LidarLocalizer()
        found = [lidar.track(frame) for frame in street[:5]]
        runs.append([pose.T_world_camera for pose in found if isinstance(pose, TrackedPose)])
    np.testing.assert_array_equal(runs[0], runs[1])


def turned(frame: Frame) -> Frame:
    return scan(frame.points[:, [1, 0, 2]] * (1, -1, 1))


def garbage(_: Frame) -> Frame:
    return scan(np.random.default_rng(0).uniform(-40, 40, (5000, 3)))


def nearly_nothing(frame: Frame) -> Frame:
    return scan(frame.points[:20])


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [(turned, "of the points lie"), (garbage, "of the points lie"), (nearly_nothing, "after thinning")],
)
def test_a_bad_scan_is_lost_and_leaves_no_trace(
    street: list[Frame], spoil: Callable[[Frame], Frame], reason: str
) -> None:
    lidar = LidarLocalizer()
    frames = [*street[:6], *map(spoil, street[6:8]), *street[8:12]]
    found = [lidar.track(frame) for frame in frames]
    assert [isinstance(pose, Lost) for pose in found] == [index in (6, 7) for index in range(12)]
    assert all(reason in pose.reason for pose in found[6:8])
    good = street[:6] + street[8:12]
    assert max(away([pose for pose in found if isinstance(pose, TrackedPose)], good)) < 0.2


def test_another_street_is_no_motion(kitti: list[Frame], data: Data) -> None:
    lidar = LidarLocalizer()
    for frame in kitti[:4]:
        assert isinstance(lidar.track(frame), TrackedPose)
    for index in range(3):
        path = data("kitti07_lidar_keyframes") / f"{index:06d}" / "points.bin"
        assert isinstance(lidar.track(scan(np.fromfile(path, np.float32).reshape(-1, 3))), Lost)


def test_reset_begins_a_new_world(street: list[Frame]) -> None:
    lidar = LidarLocalizer()
    before = [pose for pose in (lidar.track(frame) for frame in street[:3]) if isinstance(pose, TrackedPose)]
    lidar.reset()
    after = lidar.track(street[3])
    assert isinstance(after, TrackedPose)
    np.testing.assert_array_equal(after.T_world_camera, np.eye(4))
    assert after.starts_anchor
    assert after.anchor == before[-1].anchor + 1
    assert lidar.corrections() is None
    assert not lidar.absolute


def drive(street: list[Frame], count: int) -> list[Frame]:
    """Scans stamped at their beginning, of a sensor that goes and turns while it spins, faster and faster."""
    truths = [pose_of(frame) for frame in street]
    cloud = np.vstack([se3.apply(T, f.points) for T, f in zip(truths, street, strict=True)])
    T, slots = truths[0], 180
    rng = np.random.default_rng(5)
    made = []
    for index in range(count):
        world = cloud[rng.choice(len(cloud), 25_000, replace=False)]
        step = np.array([1.0, 0, 0, 0, 0, np.radians(1.5)]) * (1 + index / 4)
        beams = [T @ se3.exp(step * (slot + 0.5) / slots) for slot in range(slots)]
        local = se3.apply(se3.inverse(T), world)
        for _ in range(3):  # which beam sees a point depends on where the sensor is then
            share = (np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi)) % 1.0
            slot_of = np.minimum((share * slots).astype(int), slots - 1)
            for slot, beam in enumerate(beams):
                local[slot_of == slot] = se3.apply(se3.inverse(beam), world[slot_of == slot])
        stamp, times = 1 + index * 100_000_000, (share * 0.1).astype(np.float32)
        made.append(replace(scan(local), T_world_camera=T, timestamp_ns=stamp, point_times_s=times))
        T = T @ se3.exp(step)
    return made


def test_deskewed_scans_are_placed_where_they_began(street: list[Frame]) -> None:
    frames = drive(street, 9)
    worst = {}
    for deskew in (True, False):
        lidar = LidarLocalizer()
        given = frames if deskew else [replace(frame, point_times_s=None) for frame in frames]
        worst[deskew] = max(away([lidar.track(frame) for frame in given], frames))
    assert worst[True] < 0.3
    assert 2 * worst[True] < worst[False]


@pytest.mark.parametrize("every", [1, 2])  # a sweep lasts from scan to scan, or half as long
@pytest.mark.parametrize("are_stamped", [True, False])
def test_the_motion_in_a_sweep_is_told(street: list[Frame], every: int, are_stamped: bool) -> None:
    if not are_stamped and every == 2:
        pytest.skip("nothing tells that scans are missing")
    lidar, slow = LidarLocalizer(), drive(street, 9)[::every]
    for number, frame in enumerate(slow):
        stamp = frame.timestamp_ns if are_stamped else (number + 1) * 33_333_333
        found = lidar.track(replace(frame, timestamp_ns=stamp))
        assert isinstance(found, TrackedPose)
        if number == 0:
            assert found.motion is None
            continue
        step = np.array([1.0, 0, 0, 0, 0, np.radians(1.5)]) * (1 + number * every / 4)
        true = sweeps.at_stamp(
            frame.points, frame.point_times_s, sweeps.steady(step * 10, frame.point_times_s)
        )
        put_right = sweeps.at_stamp(frame.points, frame.point_times_s, found.motion)
        off = [np.median(np.linalg.norm(points - true, axis=1)) for points in (put_right, frame.points)]
        assert off[0] < 0.25 * off[1]


def test_motion_goes_on_over_missing_scans(street: list[Frame]) -> None:
    """Three scans are missing at 25 m/s, on a street that looks alike everywhere."""
    swept = drive(street, 12)
    lidar, kept = LidarLocalizer(), [*swept[:5], *swept[8:]]
    assert max(away([lidar.track(frame) for frame in kept], kept)) < 0.5


def test_a_stamp_that_is_behind_is_no_gap_after_it(street: list[Frame]) -> None:
    """One of twelve sweeps at 25 m/s has a stamp 0.3 s too early; no other one is missing."""
    swept = drive(street, 12)
    behind = replace(swept[6], timestamp_ns=swept[6].timestamp_ns - 300_000_000)
    lidar = LidarLocalizer()
    found = [lidar.track(behind if number == 6 else frame) for number, frame in enumerate(swept)]
    rest = [number for number in range(12) if number != 6]
    assert max(away([found[number] for number in rest], [swept[number] for number in rest])) < 0.5


def test_images_are_refused() -> None:
    with pytest.raises(InvalidKeyframe, match="follows points, got depth"):
        LidarLocalizer().track(Synthetic("room", "kinect", count=1, color=False).frame(0))


def test_too_little_to_begin_with() -> None:
    lost = LidarLocalizer().track(scan(np.ones((5, 3))))
    assert isinstance(lost, Lost)
    assert lost.reason == "only 5 points to begin with"


def test_without_kiss_icp_the_command_is_named() -> None:
    program = (
        "import sys; sys.modules['kiss_icp'] = None\n"
        "from tsfusion.scanner.localization.lidar import LidarLocalizer\n"
        "from tsfusion.core.errors import MissingDependency\n"
        "try: LidarLocalizer()\n"
        'except MissingDependency as error: sys.exit(".[lidar]" not in str(error))\n'
        "sys.exit(2)"
    )
    assert python(program).returncode == 0
