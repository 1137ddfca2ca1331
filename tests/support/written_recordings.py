# SPDX-License-Identifier: MIT
"""Recordings of the synthetic room, written in the layouts of public datasets, and checks of what is read."""

import dataclasses
import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from geometry_checks import warp_residual
from numpy.typing import NDArray

from tsfusion.datasets import Dataset, Synthetic
from tsfusion.datasets.worlds import worlds
from tsfusion.geometry.calibration import Camera
from tsfusion.geometry.keyframe import Intrinsics, Keyframe, depth_metres
from tsfusion.geometry.se3 import inverse

STEPS = 40  # keyframes of the whole circle


def at(poses: list[NDArray[np.float64]], *, width: int = 160) -> list[Keyframe]:
    """Keyframes of the room by a Kinect without noise, at some poses."""
    world = dataclasses.replace(worlds.room(), paths={"given": lambda index, _: poses[index]})
    return list(Synthetic(world, "kinect", count=len(poses), noise=False, width=width))


@cache
def views(count: int = 4, *, width: int = 160) -> tuple[Keyframe, ...]:
    """The first keyframes of a circle, 9° apart."""
    room = Synthetic("room", "kinect", count=STEPS, noise=False, width=width)
    return tuple(room[index] for index in range(count))


def check(dataset: Dataset, expected: tuple[Keyframe, ...], *, depth_m: float = 0.0006) -> None:
    """Depth, camera, colour and relative poses are those of `expected`; and only they fit together."""
    assert len(dataset) == len(expected)
    found = list(dataset)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(depth_metres(a), depth_metres(b), atol=depth_m)
        assert shift(a.color, b.color) < 0.15
        np.testing.assert_allclose(a.intrinsics.matrix, b.intrinsics.matrix, rtol=1e-5)
        start, truth = found[0].T_world_camera, expected[0].T_world_camera
        wanted = inverse(truth) @ b.T_world_camera
        np.testing.assert_allclose(inverse(start) @ a.T_world_camera, wanted, atol=1e-5)
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
    """Depth as (H, W) uint16 millimetres."""
    return np.rint(depth_metres(view) * 1000).astype(np.uint16)


def write(path: Path, image: NDArray[np.generic]) -> None:
    """Write an image, and make its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix == ".jpg" else [])


def matrix(T: NDArray[np.float64]) -> str:
    """The text of a matrix: rows of numbers."""
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
        name = f"{number * 7:06d}" if frames25k else str(number * 7)
        write(root / "color" / f"{name}.jpg", color[top:, left:])
        write(root / "depth" / f"{name}.png", millimetres(view))
        T = np.full((4, 4), -np.inf) if number in lost else view.T_world_camera
        (root / "pose").mkdir(exist_ok=True)
        (root / "pose" / f"{name}.txt").write_text(matrix(T))
    K = wide[0].intrinsics
    cameras = {"depth": views(1)[0].intrinsics, "color": Intrinsics(K.fx, K.fy, K.cx - left, K.cy - top)}
    place = root if frames25k else root / "intrinsic"
    place.mkdir(exist_ok=True)
    for name, camera in cameras.items():
        file = f"intrinsics_{name}.txt" if frames25k else f"intrinsic_{name}.txt"
        (place / file).write_text(matrix(camera_matrix(camera)))
        (place / f"extrinsic_{name}.txt").write_text(matrix(np.eye(4)))
    return root


def replica(root: Path, count: int = 4) -> Path:
    """`Replica/room0` of NICE-SLAM's archive, with the camera one folder up."""
    for number, view in enumerate(views(count)):
        write(root / "results" / f"frame{number:06d}.jpg", view.color)
        units = np.rint(depth_metres(view) * 6553.5).astype(np.uint16)
        write(root / "results" / f"depth{number:06d}.png", units)
    rows = (" ".join(f"{value:.18e}" for value in view.T_world_camera.ravel()) for view in views(count))
    (root / "traj.txt").write_text("\n".join(rows) + "\n")
    return root


def through_lens(image: NDArray[np.generic], pinhole: Intrinsics, camera: Camera) -> NDArray[np.generic]:
    """The image of a camera with a distorting lens in the place of a pinhole camera; 0 beyond its image."""
    v, u = np.mgrid[: camera.size[0], : camera.size[1]]
    rays = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64))
    pixels = rays * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
    columns, rows = pixels.astype(np.float32).T.reshape(2, *camera.size)
    mode = cv2.INTER_NEAREST if image.dtype == np.uint16 else cv2.INTER_LINEAR
    return np.asarray(cv2.remap(image, columns, rows, mode))


def transforms(root: Path, *, lens: Camera | None = None, shrink: int = 1, count: int = 4) -> Path:
    """A nerfstudio capture: OpenGL axes, pixel centres at halves; colour `shrink` times as large as depth."""
    frames = []
    for number, view in enumerate(views(count)):
        K, color, depth = view.intrinsics, view.color, millimetres(view)
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
