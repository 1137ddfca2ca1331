# SPDX-License-Identifier: MIT
"""The topics of a sensor are found by type and name, or as named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from keyframes_and_servers import CAMERA, SHAPE, pose, wall
from rosbag_scenes import BGR, FRAME_NS, GRAY, T0, records
from rosbag_writing import BODY, OPTICAL, writing

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.rosbag.dataset import Bag
from tsfusion.geometry import se3
from tsfusion.geometry.calibration import Camera, Undistorter
from tsfusion.geometry.depth_registration import Registration
from tsfusion.geometry.keyframe import Intrinsics

pytest.importorskip("rosbags")


# --- topics and cameras ---


def test_the_registered_depth_and_its_colour_are_chosen(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        for name, encoding, image, frame in (
            ("depth/image_rect_raw", "16UC1", wall(1).measurement, "camera_depth_optical_frame"),
            ("aligned_depth_to_color/image_raw", "16UC1", wall(2).measurement, OPTICAL),
            ("color/image_raw", "rgb8", BGR[..., ::-1], OPTICAL),
            ("infra1/image_rect_raw", "mono8", GRAY, "camera_infra1_optical_frame"),
        ):
            bag.image(f"/camera/{name}", image, encoding, T0, frame)
            bag.camera_info(f"/camera/{name.split('/')[0]}/camera_info", CAMERA, SHAPE, T0)
    found = Bag(path, posed=False).frame(0)
    assert found.sensor == "realsense"
    assert np.array_equal(found.depth, wall(2).measurement)
    assert np.array_equal(found.color, BGR)
    other = Bag(path, posed=False, depth_topic="/camera/depth/image_rect_raw").frame(0)
    assert np.array_equal(other.depth, wall(1).measurement)
    assert other.color is None  # it is not registered to that one, and no transforms tell how to
    assert Bag(path, posed=False, color=False).frame(0).color is None


@pytest.mark.parametrize("posed", [True, False])
def test_colour_of_another_camera_is_registered_by_tf_static(tmp_path: Path, posed: bool) -> None:
    T_color_depth = se3.exp(np.array([0.03, 0.002, -0.001, 0.01, -0.02, 0.005]))
    camera, color = Intrinsics(55.0, 54.0, 38.0, 29.0), np.repeat(np.repeat(BGR, 2, axis=0), 2, axis=1)
    d = np.array([0.05, -0.02, 0.0, 0.0, 0.0])
    metres = np.where(wall().measurement > 0, wall().measurement * 0.001, np.nan).astype(np.float32)
    with writing(tmp_path, "mcap") as (bag, path):
        bag.transform(pose(1.0), BODY, "color", T0, static=True)
        bag.transform(pose(1.0) @ T_color_depth, BODY, "depth", T0, static=True)
        for i in range(3):
            stamp = T0 + i * FRAME_NS
            bag.odometry("/odom", pose(float(i)), "odom", BODY, stamp)
            bag.image("/camera/depth/image_rect_raw", metres, "32FC1", stamp, "depth")
            bag.camera_info("/camera/depth/camera_info", CAMERA, SHAPE, stamp)
            bag.image("/camera/color/image_raw", color, "bgr8", stamp, "color")
            bag.camera_info("/camera/color/camera_info", camera, color.shape[:2], stamp, d=d)
    flat = Undistorter(Camera.named(camera.matrix, color.shape[:2], "plumb_bob", d))
    registration = Registration(
        CAMERA, flat.intrinsics, T_color_depth, SHAPE, color_size=color.shape[:2]
    )  # fmt: skip
    expected = registration.color_of_depth(flat.image(color), np.nan_to_num(metres))
    found = Bag(path, posed=posed)
    assert len(found) == 3
    difference = np.abs(found.frame(1).color.astype(int) - expected)  # type: ignore[union-attr]
    assert difference.max() <= 1
    assert np.allclose(found.frame(2).T_world_camera, pose(3.0) @ T_color_depth, atol=1e-9)


@pytest.mark.parametrize("units", ["0.000250", 0.00025])
def test_a_recording_of_librealsense_has_its_own_depth_units(tmp_path: Path, units: Any) -> None:
    place = "/device_0/sensor_0"
    with writing(tmp_path, "sqlite3" if isinstance(units, str) else "ros1") as (bag, path):
        kind = "std_msgs/msg/String" if isinstance(units, str) else "std_msgs/msg/Float32"
        bag.write(f"{place}/option/Depth_Units/value", bag.make(kind, data=units), T0)
        bag.image(f"{place}/Depth_0/image/data", wall().measurement, "mono16", T0, "Depth")
        bag.camera_info(f"{place}/Depth_0/info/camera_info", CAMERA, SHAPE, T0)
        bag.image(f"{place}/Infrared_1/image/data", GRAY, "mono8", T0, "Depth")
    found = Bag(path, posed=False)
    assert (found.sensor, found.frame(0).color) == ("realsense", None)
    assert found.frame(0).depth_scale == pytest.approx(0.00025)
    assert Bag(path, posed=False, depth_scale=0.001).frame(0).depth_scale == 0.001


def test_what_cannot_be_chosen_is_listed(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        for camera in ("front", "back"):
            bag.image(f"/{camera}/depth", wall().measurement, "16UC1", T0)
            bag.camera_info(f"/{camera}/camera_info", CAMERA, SHAPE, T0)
            bag.cloud(f"/{camera}/points", records(), T0)
    with pytest.raises(
        DatasetError, match=r"several fit \(/back/depth, /front/depth\): choose with depth_topic"
    ):
        Bag(path)
    with pytest.raises(DatasetError, match=r"/front/depth \(sensor_msgs/Image, 1\)"):
        Bag(path, depth_topic="/side/depth")
    with pytest.raises(DatasetError, match="choose one with points_topic"):
        Bag(path, modality="lidar")
    with pytest.raises(DatasetError, match="topics of depth and lidar given"):
        Bag(path, depth_topic="/front/depth", points_topic="/front/points")
    with pytest.raises(DatasetError, match="no stereo found"):
        Bag(path, modality="stereo")
    with pytest.raises(DatasetError, match="modality of a ROS recording must be"):
        Bag(path, modality="sonar")  # type: ignore[arg-type]
    assert len(Bag(path, points_topic="/front/points", posed=False)) == 1
    assert len(Bag(path, depth_topic="/front/depth", posed=False)) == 1
