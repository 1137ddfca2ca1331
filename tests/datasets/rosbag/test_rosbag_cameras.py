# SPDX-License-Identifier: MIT
"""CameraInfo: lenses, rectification, binning, regions, and cameras that do not fit."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from keyframes_and_servers import CAMERA, SHAPE, pose, wall
from rosbag_scenes import BGR, FRAME_NS, GRAY, T0
from rosbag_writing import OPTICAL, WORLD, writing

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.rosbag.dataset import Bag
from tsfusion.geometry import se3
from tsfusion.geometry.calibration import Camera, Rectifier, StereoRig, Undistorter
from tsfusion.geometry.keyframe import Intrinsics

pytest.importorskip("rosbags")


def of_camera(folder: Path, shape: tuple[int, ...] = SHAPE, name: str = "depth", **info: Any) -> Path:
    with writing(folder, "ros1") as (bag, path):
        bag.image(f"/camera/{name}", np.ones(shape, np.uint16), "16UC1", T0)
        bag.camera_info("/camera/camera_info", CAMERA, SHAPE, T0, **info)
    return path


def test_a_lens_that_distorts_is_undistorted_unless_rectified(tmp_path: Path) -> None:
    K = Intrinsics(38.0, 37.0, 31.0, 24.0)
    d = np.array([-0.12, 0.03, 0.001, -0.002, 0.0])
    lens = Camera.named(K.matrix, SHAPE, "plumb_bob", d)
    flat = Undistorter(lens)
    with writing(tmp_path, "ros1") as (bag, path):
        bag.image("/camera/depth", wall().measurement, "16UC1", T0)
        bag.image("/camera/rgb", BGR, "bgr8", T0)
        bag.camera_info("/camera/camera_info", CAMERA, SHAPE, T0, d=d, k=K.matrix.reshape(-1))
    frame = Bag(path, posed=False).frame(0)
    assert frame.intrinsics == flat.intrinsics
    assert np.array_equal(frame.depth, flat.depth(wall().measurement))
    assert np.array_equal(frame.color, flat.image(BGR))
    rectified = Bag(path, posed=False, rectified=True).frame(0)
    assert rectified.intrinsics == CAMERA
    assert np.array_equal(rectified.depth, wall().measurement)
    path = of_camera(tmp_path / "rect", name="image_rect", d=d, k=K.matrix.reshape(-1))
    assert Bag(path, posed=False).frame(0).intrinsics == CAMERA
    path = of_camera(tmp_path / "odd", d=d, distortion_model="inverse_brown_conrady")
    with pytest.raises(DatasetError, match=r"distortion model must be one of .*rectified=True"):
        Bag(path, posed=False)


def test_raw_stereo_is_rectified_as_its_camera_infos_say(tmp_path: Path) -> None:
    """Two cameras turned away from each other and their rectification, by OpenCV as image_proc uses it."""
    K, baseline = Intrinsics(40.0, 40.0, 31.5, 23.5), 0.11
    T_right_left = se3.exp(np.array([-baseline, 0.004, -0.003, 0.02, -0.03, 0.01]))
    turns = cv2.stereoRectify(K.matrix, np.zeros(5), K.matrix, np.zeros(5), SHAPE[::-1],
                              T_right_left[:3, :3], T_right_left[:3, 3:])  # fmt: skip
    with writing(tmp_path, "mcap") as (bag, path):
        for side, R, P in (("left", turns[0], turns[2]), ("right", turns[1], turns[3])):
            bag.image(f"/stereo/{side}/image_raw", GRAY, "mono8", T0)
            bag.camera_info(f"/stereo/{side}/camera_info", K, SHAPE, T0, r=R.reshape(-1), p=P.reshape(-1))
        for i in range(2):
            bag.transform(pose(float(i)), WORLD, OPTICAL, T0 + i * FRAME_NS)
    lens = Camera.named(K.matrix, SHAPE, "plumb_bob", np.zeros(5))
    expected = Rectifier(StereoRig(lens, lens, T_right_left))
    frame = Bag(path).frame(0)
    assert np.allclose(frame.intrinsics.matrix, expected.intrinsics.matrix, atol=1e-6)
    assert frame.baseline_fx == pytest.approx(expected.baseline_fx)
    assert frame.baseline_fx == pytest.approx(frame.intrinsics.fx * np.linalg.norm(T_right_left[:3, 3]))
    left, right = expected.pair(GRAY, GRAY)
    assert np.abs(frame.left.astype(int) - left).max() <= 1
    assert np.abs(frame.right.astype(int) - right).max() <= 1
    assert np.allclose(frame.T_world_camera[:3, :3], expected.T_left_rectified[:3, :3], atol=1e-9)


def test_binning_and_regions_move_the_camera(tmp_path: Path) -> None:
    path = of_camera(tmp_path, shape=(12, 20), binning_x=2, binning_y=2,
                     roi={"x_offset": 8, "y_offset": 4, "width": 40, "height": 24})  # fmt: skip
    camera = Bag(path, posed=False).frame(0).intrinsics
    assert (camera.fx, camera.cx, camera.cy) == (20.0, (31.5 - 8) / 2, (23.5 - 4) / 2)


@pytest.mark.parametrize(
    ("info", "message"),
    [({"width": 99}, "its CameraInfo says 99×48"), ({"k": np.zeros(9), "p": np.zeros(12)}, "fx > 0")],
)
def test_cameras_that_do_not_fit_are_refused(tmp_path: Path, info: dict[str, Any], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        Bag(of_camera(tmp_path, **info), posed=False)
