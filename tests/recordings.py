# SPDX-License-Identifier: MIT
"""Recordings of the synthetic room written in other people's layouts, so that what is read back is known."""

import dataclasses
import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from geometry import warp_residual
from numpy.typing import NDArray

from tsfusion.calibration import Camera
from tsfusion.datasets import Dataset, Synthetic, worlds
from tsfusion.evaluation.predict import depth_metres
from tsfusion.keyframe import Intrinsics, Keyframe
from tsfusion.se3 import exp, inverse

Triple = tuple[float, float, float]
STEPS = 40  # keyframes of the circle that the views are the first of


def at(poses: list[NDArray[np.float64]], *, width: int = 160) -> list[Keyframe]:
    """What a Kinect without noise would see of the room from some poses."""
    world = dataclasses.replace(worlds.room(), paths={"given": lambda index, _: poses[index]})
    return list(Synthetic(world, "kinect", count=len(poses), noise=False, width=width))


@cache
def views(count: int = 4, *, width: int = 160) -> tuple[Keyframe, ...]:
    """The first of a circle's views, 9° apart."""
    room = Synthetic("room", "kinect", count=STEPS, noise=False, width=width)
    return tuple(room[index] for index in range(count))


def check(dataset: Dataset, expected: tuple[Keyframe, ...], *, depth_m: float = 0.0006) -> None:
    """Depth, camera, colour and relative poses are those of `expected`; and only they fit together."""
    assert len(dataset) == len(expected)
    found = list(dataset)
    for a, b in zip(found, expected, strict=True):
        assert a.color is not None
        assert b.color is not None
        np.testing.assert_allclose(depth_metres(a), depth_metres(b), atol=depth_m)
        assert shift(a.color, b.color) < 0.15
        np.testing.assert_allclose(a.intrinsics.matrix, b.intrinsics.matrix, rtol=1e-5)
        start, truth = found[0].T_world_camera, expected[0].T_world_camera
        np.testing.assert_allclose(
            inverse(start) @ a.T_world_camera, inverse(truth) @ b.T_world_camera, atol=1e-5
        )
    fits_together(found[0], found[1])


def shift(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Pixels that one image of the same size lies beside the other, away from their borders."""
    height, width = (_even_transform(size - 16) for size in a.shape[:2])
    grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32) for image in (a, b)]
    inner = [image[12 : 12 + height, 12 : 12 + width] for image in grey]
    moved, response = cv2.phaseCorrelate(*inner, cv2.createHanningWindow((width, height), cv2.CV_32F))
    assert response > 0.3, "the two images are not of the same"
    return float(np.hypot(*moved))


def _even_transform(size: int) -> int:
    """The largest size that OpenCV does not pad: padding to an odd one shifts its answer by half a pixel."""
    return next(n for n in range(size, 0, -1) if n % 2 == 0 and cv2.getOptimalDFTSize(n) == n)


def fits_together(a: Keyframe, b: Keyframe, *, bound: float = 0.006) -> None:
    """Depth of `a` moved into `b` is what `b` sees; with inverse poses or OpenGL's axes it is not."""
    T_b_a = inverse(b.T_world_camera) @ a.T_world_camera
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    assert warp_residual(a, b) < bound
    assert warp_residual(a, b, T_b_a=b.T_world_camera @ inverse(a.T_world_camera)) > 3 * bound
    assert warp_residual(a, b, T_b_a=flip @ T_b_a @ flip) > 3 * bound


def millimetres(view: Keyframe) -> NDArray[np.uint16]:
    """(H, W) uint16."""
    return np.rint(depth_metres(view) * 1000).astype(np.uint16)


def write(path: Path, image: NDArray[np.generic]) -> None:
    """An image, its folder made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else [])


def matrix(T: NDArray[np.float64]) -> str:
    """Rows of numbers."""
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in T) + "\n"


def camera_matrix(K: Intrinsics, size: int = 4) -> NDArray[np.float64]:
    """(size, size), as ScanNet pads it."""
    M = np.eye(size)
    M[:3, :3] = K.matrix
    return M


def scannet(root: Path, count: int = 4, *, lost: tuple[int, ...] = (), frames25k: bool = False) -> Path:
    """A scene as SensReader exports it: numbers not padded, big colour with a camera of its own."""
    wide = views(count, width=324)
    left, top = 20, 9  # of the colour image something is missing there
    for number, view in enumerate(views(count)):
        color = wide[number].color
        assert color is not None
        name = f"{number * 7:06d}" if frames25k else str(number * 7)
        write(root / "color" / f"{name}.jpg", color[top:, left:])
        write(root / "depth" / f"{name}.png", millimetres(view))
        T = np.full((4, 4), -np.inf) if number in lost else view.T_world_camera
        (root / "pose").mkdir(exist_ok=True)
        (root / "pose" / f"{name}.txt").write_text(matrix(T))
    K = wide[0].intrinsics
    assert K is not None
    cameras = {"depth": views(1)[0].intrinsics, "color": Intrinsics(K.fx, K.fy, K.cx - left, K.cy - top)}
    place = root if frames25k else root / "intrinsic"
    place.mkdir(exist_ok=True)
    for name, camera in cameras.items():
        assert camera is not None
        file = f"intrinsics_{name}.txt" if frames25k else f"intrinsic_{name}.txt"
        (place / file).write_text(matrix(camera_matrix(camera)))
        (place / f"extrinsic_{name}.txt").write_text(matrix(np.eye(4)))
    return root


def replica(root: Path, count: int = 4) -> Path:
    """`Replica/room0` of NICE-SLAM's archive, with the camera one folder up."""
    for number, view in enumerate(views(count)):
        assert view.color is not None
        write(root / "results" / f"frame{number:06d}.jpg", view.color)
        units = np.rint(depth_metres(view) * 6553.5).astype(np.uint16)
        write(root / "results" / f"depth{number:06d}.png", units)
    rows = (" ".join(f"{value:.18e}" for value in view.T_world_camera.ravel()) for view in views(count))
    (root / "traj.txt").write_text("\n".join(rows) + "\n")
    return root


def through_lens(image: NDArray[np.generic], pinhole: Intrinsics, camera: Camera) -> NDArray[np.generic]:
    """What a camera with a distorted lens sees in the pinhole camera's place; 0 beyond its image."""
    v, u = np.mgrid[: camera.size[0], : camera.size[1]]
    rays = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64))
    columns, rows = (
        (rays * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy))
        .astype(np.float32)
        .T.reshape(2, *camera.size)
    )
    mode = cv2.INTER_NEAREST if image.dtype == np.uint16 else cv2.INTER_LINEAR
    return np.asarray(cv2.remap(image, columns, rows, mode))


def transforms(root: Path, *, lens: Camera | None = None, shrink: int = 1, count: int = 4) -> Path:
    """A nerfstudio capture: OpenGL axes, pixel centres at halves; colour `shrink` times as large as depth."""
    frames = []
    for number, view in enumerate(views(count)):
        K, color, depth = view.intrinsics, view.color, millimetres(view)
        assert K is not None
        assert color is not None
        if lens is not None:
            color, depth = (through_lens(image, K, lens) for image in (color, depth))
            K = lens.intrinsics
        if shrink > 1:
            color = cv2.resize(color, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_CUBIC)
            K = K.scaled(shrink)
        write(root / "images" / f"{number:05d}.png", color)
        write(root / "depth" / f"{number:05d}.png", depth)
        frames.append({
            "file_path": f"images/{number:05d}.png",
            "depth_file_path": f"./depth/{number:05d}.png",
            "transform_matrix": (view.T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        })  # fmt: skip
    capture = {
        "camera_model": "OPENCV", "fl_x": K.fx, "fl_y": K.fy, "cx": K.cx + 0.5, "cy": K.cy + 0.5,
        "w": color.shape[1], "h": color.shape[0], "frames": frames,
    }  # fmt: skip
    if lens is not None:
        names = ("k1", "k2", "k3", "k4") if lens.model == "equidistant" else ("k1", "k2", "p1", "p2")
        capture |= dict(zip(names, lens.distortion, strict=True))
        capture["camera_model"] = "OPENCV_FISHEYE" if lens.model == "equidistant" else "OPENCV"
    (root / "transforms.json").write_text(json.dumps(capture))
    return root


def turned(
    degrees: tuple[float, float, float], translation: tuple[float, float, float]
) -> NDArray[np.float64]:
    """A transform by rotation vector and metres."""
    return exp(np.array([0, 0, 0, *np.radians(degrees)])) + _column(translation)


def _column(translation: Triple) -> NDArray[np.float64]:
    T = np.zeros((4, 4))
    T[:3, 3] = translation
    return T


def circle(count: int) -> list[NDArray[np.float64]]:
    """Poses of `views`."""
    return [view.T_world_camera for view in views(count)]


T_BODY_LEFT = turned((20, -70, 35), (0.05, -0.02, 0.03))
T_LEFT_RIGHT = turned((0.6, -1.2, 0.9), (0.06, 0.002, -0.003))
FIRST_NS = 1403715273262142976


def euroc(root: Path, model: str = "radial-tangential", *, count: int = 3) -> Path:
    """A sequence in the ASL layout: two distorting lenses, ground truth of the body at 100 Hz."""
    fisheye = model == "equidistant"
    lenses = [(0.02, -0.01, 0.004, -0.001), (0.015, -0.008, 0.003, 0.0)] if fisheye else [
        (-0.28, 0.07, 0.0002, 0.00002), (-0.27, 0.06, -0.0001, -0.00004)]  # fmt: skip
    matrices = [Intrinsics(420.3, 419.6, 183.6, 118.2), Intrinsics(418.8, 418.1, 190.0, 121.6)]
    T_world_left = circle(count)
    rig = [T_world_left, [T @ T_LEFT_RIGHT for T in T_world_left]]
    for side, poses in enumerate(rig):
        camera = Camera.named(matrices[side].matrix, (240, 376), model, lenses[side])
        place = root / "mav0" / f"cam{side}"
        rows = ["#timestamp [ns],filename\r"]
        for number, view in enumerate(at(poses, width=640)):
            assert view.color is not None
            assert view.intrinsics is not None
            stamp = FIRST_NS + number * 50_000_000 + side * 1000
            image = cv2.cvtColor(through_lens(view.color, view.intrinsics, camera), cv2.COLOR_BGR2GRAY)
            write(place / "data" / f"{stamp}.png", image)
            rows.append(f"{stamp},{stamp}.png\r")
        (place / "data.csv").write_text("\n".join(rows) + "\n")
        T_BS = T_BODY_LEFT if side == 0 else T_BODY_LEFT @ T_LEFT_RIGHT
        K = camera.intrinsics
        (place / "sensor.yaml").write_text(
            "# General sensor definitions.\nsensor_type: camera\ncomment: made for a test\n\n"
            "# Sensor extrinsics wrt. the body-frame.\nT_BS:\n  cols: 4\n  rows: 4\n  data: ["
            + ",\n         ".join(", ".join(f"{value:.12f}" for value in row) for row in T_BS)
            + "]\n\nrate_hz: 20\nresolution: [376, 240]\ncamera_model: pinhole\n"
            f"intrinsics: [{K.fx}, {K.fy}, {K.cx}, {K.cy}] #fu, fv, cu, cv\ndistortion_model: {model}\n"
            f"distortion_coefficients: [{', '.join(map(str, lenses[side]))}]\n\n"
        )
    _body_truth(root / "mav0" / "state_groundtruth_estimate0", T_world_left)
    return root


def _body_truth(place: Path, T_world_left: list[NDArray[np.float64]]) -> None:
    from scipy.spatial.transform import Rotation

    rows = [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    ]
    bodies = [T @ inverse(T_BODY_LEFT) for T in T_world_left]
    for number in range(5 * (len(bodies) - 1) + 1):  # between two images the body turns evenly
        before, share = min(number // 5, len(bodies) - 2), 0.0
        share = number / 5 - before
        A, B = bodies[before], bodies[before + 1]
        R = Rotation.from_matrix(A[:3, :3]) * Rotation.from_rotvec(
            share * Rotation.from_matrix(A[:3, :3].T @ B[:3, :3]).as_rotvec()
        )
        x, y, z, w = R.as_quat()
        t = (1 - share) * A[:3, 3] + share * B[:3, 3]
        stamp = FIRST_NS + number * 10_000_000
        rows.append(
            f"{stamp},{t[0]:.9f},{t[1]:.9f},{t[2]:.9f},{w:.9f},{x:.9f},{y:.9f},{z:.9f},0,0,0,0,0,0,0,0,0"
        )
    place.mkdir(parents=True)
    (place / "data.csv").write_text("\n".join(rows) + "\n")


T_VELO_IMU = turned((0.3, -0.1, 0.8), (-0.81, 0.32, -0.8))
T_CAM0_VELO = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]) @ turned(
    (0.5, 0.8, -0.4), (0.27, -0.01, 0.07)
)
R_RECT = turned((0.4, -0.6, 0.3), (0, 0, 0))
BASELINES = {"00": 0.0, "01": 0.12, "02": -0.06, "03": 0.055}  # metres to the right of camera 0
DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"


def kitti_raw(root: Path, *, count: int = 3, cameras: tuple[str, ...] = ("00", "01")) -> Path:
    """A day of one synchronised drive; its frames are numbered from 0, its clock has nanoseconds."""
    day, drive = root / DAY, root / DAY / DRIVE
    T_world_rectified = circle(count)
    T_world_imu = [T @ R_RECT @ T_CAM0_VELO @ T_VELO_IMU for T in T_world_rectified]
    K = at(T_world_rectified[:1], width=480)[0].intrinsics
    assert K is not None
    for camera in cameras:
        poses = [T @ _column((BASELINES[camera], 0, 0)) + T for T in T_world_rectified]
        for number, view in enumerate(at(poses, width=480)):
            assert view.color is not None
            grey = camera in ("00", "01")
            image = cv2.cvtColor(view.color, cv2.COLOR_BGR2GRAY) if grey else view.color
            write(drive / f"image_{camera}" / "data" / f"{number:010d}.png", image)
        _times(drive / f"image_{camera}", count)
    T_world_velo = [T @ inverse(T_VELO_IMU) for T in T_world_imu]
    for number, points in enumerate(scans(T_world_velo)):
        (drive / "velodyne_points" / "data").mkdir(parents=True, exist_ok=True)
        reflectance = np.full((len(points), 1), 0.3, np.float32)
        np.hstack([points, reflectance]).tofile(drive / "velodyne_points" / "data" / f"{number:010d}.bin")
    _times(drive / "velodyne_points", count)
    _packets(drive / "oxts" / "data", T_world_imu)
    _times(drive / "oxts", count)
    _calibration(day, K)
    return drive


def scans(poses: list[NDArray[np.float64]]) -> list[NDArray[np.float32]]:
    """What a spinning LiDAR without noise would see of the room from some poses."""
    axes = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # of camera and LiDAR
    world = dataclasses.replace(worlds.room(), paths={"given": lambda index, _: poses[index] @ inverse(axes)})
    made = Synthetic(world, "lidar", count=len(poses), noise=False, color=False)
    return [np.asarray(keyframe.points, np.float32) for keyframe in made]


def _times(place: Path, count: int) -> None:
    rows = (f"2011-09-26 13:02:25.{664389445 + 100_000_000 * number}" for number in range(count))
    (place / "timestamps.txt").write_text("\n".join(rows) + "\n")


def _packets(place: Path, poses: list[NDArray[np.float64]]) -> None:
    """GPS/IMU packets, by the inverse of the development kit's Mercator projection around 49° north."""
    place.mkdir(parents=True)
    radius, latitude = 6378137.0, 49.015
    scale = np.cos(np.radians(latitude))
    start = poses[0][:3, 3]
    north0 = scale * radius * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    for number, T in enumerate(poses):
        east, north, up = T[:3, 3] - start
        lat = np.degrees(2 * np.arctan(np.exp((north0 + north) / (scale * radius))) - np.pi / 2)
        lon = 8.434 + np.degrees(east / (scale * radius))
        roll, pitch = np.arctan2(T[2, 1], T[2, 2]), np.arcsin(-T[2, 0])
        yaw = np.arctan2(T[1, 0], T[0, 0])
        numbers = [lat, lon, 112.8 + up, roll, pitch, yaw, *[0.0] * 19]
        flags = ["4", "11", "4", "4", "0"]
        packet = " ".join([*(f"{value:.14f}" for value in numbers), *flags])
        (place / f"{number:010d}.txt").write_text(packet + "\n")


def _calibration(day: Path, K: Intrinsics) -> None:
    def rigid(T: NDArray[np.float64]) -> str:
        R, t = (" ".join(f"{value:.9e}" for value in part.ravel()) for part in (T[:3, :3], T[:3, 3]))
        return f"calib_time: 25-May-2012 16:47:16\nR: {R}\nT: {t}\n"

    (day / "calib_imu_to_velo.txt").write_text(rigid(T_VELO_IMU))
    (day / "calib_velo_to_cam.txt").write_text(rigid(T_CAM0_VELO))
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for camera, baseline in BASELINES.items():
        P = np.hstack([K.matrix, [[-K.fx * baseline], [0], [0]]])
        R = R_RECT[:3, :3] if camera == "00" else np.eye(3)
        for name, values in (("R_rect", R), ("P_rect", P)):
            lines.append(f"{name}_{camera}: " + " ".join(f"{value:.9e}" for value in values.ravel()))
    (day / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
