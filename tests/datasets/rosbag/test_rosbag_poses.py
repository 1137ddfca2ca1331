# SPDX-License-Identifier: MIT
"""Poses from /tf, odometry and other topics, at the time of a frame."""

import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from keyframes_and_servers import CAMERA, SHAPE, pose, wall
from rosbag_scenes import T0, T_BODY_OPTICAL
from rosbag_writing import BODY, OPTICAL, WORLD, BagWriter, writing

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.rosbag.bag import Bag
from tsfusion.datasets.rosbag.bag_cameras import RECTIFIED, REGISTERED
from tsfusion.datasets.rosbag.poses import PoseSamples
from tsfusion.geometry import se3

pytest.importorskip("rosbags")


# --- poses ---


def turning(seconds: float) -> np.ndarray:
    """Where a body is that turns and moves evenly."""
    T = se3.exp(np.array([0, 0, 0, 0.3, -0.9, 1.1]) * seconds)
    T[:3, 3] = np.array([0.5, -0.2, 0.1]) * seconds
    return T


def moments(bag: BagWriter, *, count: int = 10) -> list[int]:
    """Depth images between the times at which `turning` is told, each 100 ms."""
    stamps = [T0 + 37_000_000 + i * 100_000_000 for i in range(count)]
    bag.camera_info("/camera/camera_info", CAMERA, SHAPE, T0)
    for i, stamp in enumerate(stamps):
        bag.image("/camera/depth", wall(i).measurement, "16UC1", stamp)
    return stamps


def check_turning(found: Bag, after: np.ndarray = T_BODY_OPTICAL, before: np.ndarray | None = None) -> None:
    assert len(found) == 10
    for keyframe in found:
        T = turning((keyframe.timestamp_ns - T0) * 1e-9) @ after
        expected = T if before is None else before @ T
        assert np.allclose(keyframe.T_world_camera, expected, atol=1e-9, rtol=0)


def test_two_poses_at_one_time_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name, other_m in (("same", 0.0), ("other", 0.4)):
        with writing(tmp_path / name, "ros1") as (bag, path):
            moments(bag)
            bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, 0, static=True, log_ns=T0)
            for i in range(12):
                T = turning(i * 0.1)
                bag.transform(T, WORLD, BODY, T0 + i * 100_000_000)
                moved = T.copy()
                moved[0, 3] += other_m if i == 5 else 0
                bag.transform(moved, WORLD, BODY, T0 + i * 100_000_000)
        caplog.clear()
        check_turning(Bag(path))  # the first that came counts
        said = [line for line in caplog.messages if "two poses at one time" in line]
        assert len(said) == (name == "other"), said
    assert "1 time, the first at 1700000000.623457 s: they are 0.400 m and 0.00° apart" in said[0]
    assert f"({BODY} in {WORLD})" in said[0]


def test_transforms_are_chained_and_interpolated(tmp_path: Path) -> None:
    T_odom = se3.exp(np.array([3.0, 1, 0, 0, 0, 0.4]))
    with writing(tmp_path, "ros1") as (bag, path):
        moments(bag)
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, 0, static=True, log_ns=T0)
        for i in range(12):
            stamp = T0 + i * 100_000_000
            bag.transform(turning(i * 0.1), "odom", BODY, stamp)
            bag.transform(T_odom, "/map", "/odom", stamp + 10**9, log_ns=stamp)  # constant, of the future
            bag.transform(pose(i), BODY, "arm", stamp)
    check_turning(Bag(path), before=T_odom)
    check_turning(Bag(path, world_frame="odom"))
    with pytest.raises(DatasetError, match="no transforms lead from 'moon'"):
        Bag(path, world_frame="moon")


def test_transforms_in_a_loop_are_told_so(tmp_path: Path) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        moments(bag)
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True, log_ns=T0)
        for i in range(12):
            bag.transform(turning(i * 0.1), "odom", BODY, T0 + i * 100_000_000)
            bag.transform(np.eye(4), BODY, "odom", T0 + i * 100_000_000)
    with pytest.raises(DatasetError, match=f"← {BODY} ← odom ← {BODY}, a loop of transforms"):
        Bag(path, world_frame="map")


def test_a_static_transform_is_the_last_that_was_sent(tmp_path: Path) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        moments(bag)
        for T, log_ns in ((np.eye(4), T0), (T_BODY_OPTICAL, T0 + 1)):
            bag.transform(T, BODY, OPTICAL, T0, static=True, log_ns=log_ns)
        for i in range(12):
            bag.transform(turning(i * 0.1), WORLD, BODY, T0 + i * 100_000_000)
    check_turning(Bag(path))


def test_transforms_without_a_stamp_are_of_when_they_were_recorded(tmp_path: Path) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        moments(bag)
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
        for i in range(12):
            bag.transform(turning(i * 0.1), WORLD, BODY, 0, log_ns=T0 + i * 100_000_000)
    check_turning(Bag(path))


@pytest.mark.parametrize(
    ("topic", "registered", "rectified"),
    [
        ("/camera/depth_registered/image_rect", True, True), ("/aligned_depth_to_color/image", True, False),
        ("/camera/unregistered/image", False, False), ("/camera/unrectified/depth", False, False),
        ("/not_aligned/depth", False, False), ("/aligned_depth_to_infra1/image_raw", False, False),
    ],
)  # fmt: skip
def test_names_of_topics_are_read_by_words(topic: str, registered: bool, rectified: bool) -> None:
    assert (bool(REGISTERED.search(topic)), bool(RECTIFIED.search(topic))) == (registered, rectified)


def test_no_pose_is_made_up_across_a_gap(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        stamps = moments(bag)
        for i in (0, 1, 2, 3, 7, 8):
            bag.transform(turning(i * 0.1), WORLD, OPTICAL, T0 + i * 100_000_000)
    found = Bag(path)
    assert found.skipped == {"without a pose in time": 6}
    assert found.timestamps_ns.tolist() == [stamps[i] for i in (0, 1, 2, 7)]
    everything = Bag(path, posed=False)
    known = [everything.frame(i).T_world_camera is not None for i in range(10)]
    assert [i for i in range(10) if known[i]] == [0, 1, 2, 7]
    assert len(Bag(path, max_gap_s=0.5)) == 8


def odometry(bag: BagWriter, topic: str = "/odom") -> None:
    for i in range(12):
        bag.odometry(topic, turning(i * 0.1), "odom", BODY, T0 + i * 100_000_000)


def test_odometry_is_carried_to_the_sensor(tmp_path: Path) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        moments(bag)
        odometry(bag)
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
        bag.transform(pose(5.0), "map", "odom", T0, static=True)
    check_turning(Bag(path))
    check_turning(Bag(path, world_frame="map"), before=pose(5.0))


@pytest.mark.parametrize("kind", ["pose", "covariance", "transform", "path"])
def test_other_topics_tell_poses_too(tmp_path: Path, kind: str) -> None:
    told = [(T0 + i * 100_000_000, turning(i * 0.1)) for i in range(12)]
    with writing(tmp_path, "mcap") as (bag, path):
        moments(bag)
        for i, (stamp, T) in enumerate(told):
            if kind == "pose":
                bag.write("/slam", bag.posed(T, "map", stamp), stamp)
            elif kind == "transform":
                bag.write("/slam", bag.stamped(T, "map", OPTICAL, stamp), stamp)
            elif kind == "path":
                bag.path("/slam", told[: i + 1], "map", stamp)
            else:
                within = bag.make("geometry_msgs/msg/PoseWithCovariance", pose=bag.pose(T),
                                  covariance=np.zeros(36))  # fmt: skip
                name, heading = "geometry_msgs/msg/PoseWithCovarianceStamped", bag.heading(stamp, "map")
                bag.write("/slam", bag.make(name, header=heading, pose=within), stamp)
    check_turning(Bag(path), after=np.eye(4))


def test_a_pose_topic_that_was_named_goes_before_the_transforms(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        moments(bag)
        odometry(bag)
        odometry(bag, "/other")
        for i in range(12):
            bag.transform(pose(i), WORLD, OPTICAL, T0 + i * 100_000_000)
    check_turning(Bag(path, pose_topic="/odom", body_frame=OPTICAL), after=np.eye(4))
    with pytest.raises(DatasetError, match="holds poses of 'base_link', and no transforms lead from there"):
        Bag(path, pose_topic="/odom")
    with pytest.raises(DatasetError, match=r"no topic of poses.*nav_msgs/Odometry, 12"):
        Bag(path, pose_topic="/nowhere")


def test_poses_that_cannot_be_told_are_one_clear_error(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        moments(bag)
    with pytest.raises(DatasetError, match="has no poses of 'camera_color_optical_frame'"):
        Bag(path)
    assert len(Bag(path, posed=False)) == 10
    with writing(tmp_path / "two", "ros1") as (bag, path):
        moments(bag)
        for topic in ("/one", "/two"):
            odometry(bag, topic)
        bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
    with pytest.raises(DatasetError, match=r"several topics hold poses \(/one, /two\)"):
        Bag(path)


def test_poses_of_a_long_recording_stay_small() -> None:
    """A robot with thirty joints tells millions of transforms an hour."""
    q, t = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0), SimpleNamespace(x=1.0, y=2.0, z=3.0)
    samples = PoseSamples()
    tracemalloc.start()
    try:
        for stamp in range(10_000):
            samples.add(stamp * 10**9, t, q)
        assert tracemalloc.get_traced_memory()[0] < 100 * 10_000
    finally:
        tracemalloc.stop()
    assert len(samples.trajectory().timestamps_ns) == 10_000
