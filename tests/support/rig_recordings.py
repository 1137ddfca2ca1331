# SPDX-License-Identifier: MIT
"""Rigs driven through the synthetic room, written as EuRoC and KITTI write their recordings."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from written_recordings import at, through_lens, views, write

from tsfusion.datasets import Synthetic
from tsfusion.datasets.worlds import worlds
from tsfusion.geometry.calibration import Camera
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import exp, inverse

Triple = tuple[float, float, float]


def turned(degrees: Triple, translation: Triple) -> NDArray[np.float64]:
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

    rows = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z"]
    bodies = [T @ inverse(T_BODY_LEFT) for T in T_world_left]
    for number in range(5 * (len(bodies) - 1) + 1):  # between two images the body turns evenly
        before = min(number // 5, len(bodies) - 2)
        share = number / 5 - before
        A, B = bodies[before], bodies[before + 1]
        R = Rotation.from_matrix(A[:3, :3]) * Rotation.from_rotvec(
            share * Rotation.from_matrix(A[:3, :3].T @ B[:3, :3]).as_rotvec()
        )
        x, y, z, w = R.as_quat()
        t = (1 - share) * A[:3, 3] + share * B[:3, 3]
        stamp = FIRST_NS + number * 10_000_000
        numbers = ",".join(f"{value:.9f}" for value in (*t, w, x, y, z))
        rows.append(f"{stamp},{numbers},0,0,0,0,0,0,0,0,0")
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
    for camera in cameras:
        poses = [T @ _column((BASELINES[camera], 0, 0)) + T for T in T_world_rectified]
        for number, view in enumerate(at(poses, width=480)):
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
    """Points (n, 3) of a spinning LiDAR without noise in the room, at some poses."""
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
