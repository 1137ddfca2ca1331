# SPDX-License-Identifier: MIT
"""The topics of a sensor and its cameras: found by type and name, or as named; lenses, binning, regions."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from keyframes_and_servers import CAMERA, SHAPE, pose, wall
from rosbag_scenes import BGR, FRAME_NS, GRAY, T0, records
from rosbag_writing import BODY, OPTICAL, WORLD, writing

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.rosbag.bag import Bag
from tsfusion.geometry import se3
from tsfusion.geometry.calibration import Camera, Rectifier, StereoRig, Undistorter
from tsfusion.geometry.depth_registration import Registration
from tsfusion.geometry.keyframe import Intrinsics

pytest.importorskip("rosbags")


# --- topics ---


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


@pytest.mark.parametrize(("zoom", "changes"), [(1.01, False), (1.15, True)])
def test_a_camera_that_changes_is_not_taken_for_one(tmp_path: Path, zoom: float, changes: bool) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        for i in range(4):
            stamp, factor = T0 + i * 10**9, zoom if i > 1 else 1.0
            camera = Intrinsics(CAMERA.fx * factor, CAMERA.fy * factor, CAMERA.cx, CAMERA.cy)
            bag.camera_info("/camera/camera_info", camera, SHAPE, stamp)
            bag.image("/camera/depth", wall(i).measurement, "16UC1", stamp)
    if not changes:
        assert len(Bag(path, posed=False)) == 4
        return
    with pytest.raises(DatasetError, match=r"camera of /camera/camera_info changes 2\.0 s after its start"):
        Bag(path, posed=False)
    assert len(Bag(path, posed=False, intrinsics=CAMERA)) == 4


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
    registration = Registration(CAMERA, flat.intrinsics, T_color_depth, SHAPE, color_size=color.shape[:2])
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
        DatasetError, match=r"several topics fit \(/back/depth, /front/depth\): choose one with depth_topic"
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


# --- cameras ---


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


@pytest.mark.parametrize("name", ["depth", "image_rect"])
def test_skew_in_a_matrix_of_a_camera_info_is_used(tmp_path: Path, name: str) -> None:
    k = CAMERA.matrix + np.array([[0, 5, 0], [0, 0, 0], [0, 0, 0]])
    p = np.column_stack([k, np.zeros(3)])
    info = {"k": k.reshape(-1)} if name == "depth" else {"p": p.reshape(-1)}
    camera = Bag(of_camera(tmp_path, name=name, **info), posed=False).camera
    assert camera.lens == Camera.named(k, SHAPE, "none")
    assert camera.lens.skew == 5


def test_skew_of_a_rectified_pair_is_refused(tmp_path: Path) -> None:
    with writing(tmp_path, "mcap") as (bag, path):
        for side, shift in (("left", 0.0), ("right", -5.0)):
            P = np.column_stack([CAMERA.matrix, [shift, 0, 0]])
            P[0, 1] = 3
            bag.image(f"/stereo/{side}/image_rect", GRAY, "mono8", T0)
            bag.camera_info(f"/stereo/{side}/camera_info", CAMERA, SHAPE, T0, p=P.reshape(-1))
    with pytest.raises(DatasetError, match="skew of 3 px"):
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


# --- cameras that are given, or missing ---


def test_depth_without_a_camera_info_needs_a_camera(tmp_path: Path) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        bag.image("/depth/image", wall().measurement, "16UC1", T0, "depth_optical")
        bag.image("/rgb/image", BGR, "bgr8", T0, OPTICAL)
        bag.camera_info("/rgb/camera_info", CAMERA, SHAPE, T0)  # of another frame: the colour camera's
    match = r"no CameraInfo of /depth/image: name one with --option info_topic=TOPIC, or give --intrinsics"
    with pytest.raises(DatasetError, match=match):
        Bag(path, posed=False)
    named = Bag(path, posed=False, info_topic="/rgb/camera_info")
    assert str(named.camera).endswith("64×48, from /rgb/camera_info")
    given = Bag(path, posed=False, intrinsics=Intrinsics(39.0, 39.0, 31.0, 23.0))
    assert str(given.camera) == "fx 39 fy 39 cx 31 cy 23, 64×48, as given"
    assert given.frame(0).intrinsics == Intrinsics(39.0, 39.0, 31.0, 23.0)
    with pytest.raises(DatasetError, match="cx 320 lies outside of the images, which are 64×48"):
        Bag(path, posed=False, intrinsics=Intrinsics(585, 585, 320, 240))


def test_a_calibration_beats_the_camera_info(tmp_path: Path) -> None:
    path, file = of_camera(tmp_path), tmp_path / "lens.yaml"
    lens = Camera(Intrinsics(38.0, 37.0, 31.0, 24.0), SHAPE, "radtan", (-0.12, 0.03, 0.001, -0.002))
    file.write_text(
        "intrinsics: [38, 37, 31, 24]\nresolution: [64, 48]\ndistortion_model: radtan\n"
        "distortion_coeffs: [-0.12, 0.03, 0.001, -0.002]\n"
    )
    dataset = Bag(path, posed=False, calibration=file)
    assert dataset.frame(0).intrinsics == Undistorter(lens).intrinsics
    assert str(dataset.camera).endswith(", from the given lens.yaml, undistorted")


def test_floats_of_millimetres_are_an_error_until_their_unit_is_given(tmp_path: Path) -> None:
    millimetres = wall().measurement.astype(np.float32)
    with writing(tmp_path, "ros1") as (bag, path):
        bag.image("/camera/depth", millimetres, "32FC1", T0)
        bag.camera_info("/camera/camera_info", CAMERA, SHAPE, T0)
    with pytest.raises(DatasetError, match=r"message 0 of /camera/depth has floats: .*: millimetres\?"):
        Bag(path, posed=False).frame(0)
    frame = Bag(path, posed=False, depth_scale=0.001).frame(0)
    np.testing.assert_allclose(frame.depth, millimetres * 0.001)


def test_points_take_no_camera(tmp_path: Path) -> None:
    with writing(tmp_path, "ros1") as (bag, path):
        bag.cloud("/points", records(), T0)
    with pytest.raises(DatasetError, match="point clouds have no camera"):
        Bag(path, posed=False, intrinsics=CAMERA)
