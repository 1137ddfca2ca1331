# SPDX-License-Identifier: MIT
"""Real keyframes written as a user's own recordings: the folders, bags and captures that people have."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rosbag_scenes import scan
from rosbag_writing import writing
from written_recordings import matrix, write

from tsfusion.datasets import SevenScenes
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.trajectory import quaternion

T0_NS, FRAME_NS = 1_700_000_000_000_000_000, 133_333_333
KINECT = "585 0 320\n0 585 240\n0 0 1\n"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def views(kitchen: Path, count: int = 3, *, every: int = 10) -> list[Keyframe]:
    """Keyframes of 7-Scenes' kitchen, as recorded."""
    recorded = SevenScenes(kitchen)
    return [recorded[number * every] for number in range(count)]


def stamps_ns(count: int) -> list[int]:
    """Times of the frames, 7.5 a second."""
    return [T0_NS + number * FRAME_NS for number in range(count)]


def tum(root: Path, views: Sequence[Keyframe], *, camera: bool = True) -> Path:
    """Lists of time-stamped images and `groundtruth.txt`, as recorders write them; not a TUM sensor."""
    lists: dict[str, list[str]] = {"depth": [], "rgb": []}
    for view, stamp in zip(views, stamps_ns(len(views)), strict=True):
        name = f"{stamp / 1e9:.6f}"
        assert view.color is not None
        write(root / "depth" / f"{name}.png", np.asarray(view.measurement) * 5)  # units of 1/5000 m
        write(root / "rgb" / f"{name}.png", view.color)
        for kind, lines in lists.items():
            lines.append(f"{name} {kind}/{name}.png")
    for kind, lines in lists.items():
        (root / f"{kind}.txt").write_text("\n".join(["# timestamp filename", *lines]) + "\n")
    write_tum(root / "groundtruth.txt", stamps_ns(len(views)), [view.T_world_camera for view in views])
    if camera:
        _camera_matrix(root / "camera-intrinsics.txt", views[0])
    return root


def images(root: Path, views: Sequence[Keyframe], *, camera: bool = True, poses: bool = True) -> Path:
    """PNG folders of equal names, with the 3×3 matrix of the camera and Redwood's `trajectory.log`."""
    for number, view in enumerate(views):
        image(root, f"{number:06d}", view, camera=camera)
    if poses:
        rows = (f"{i} {i} {i + 1}\n{matrix(view.T_world_camera)}" for i, view in enumerate(views))
        (root / "trajectory.log").write_text("".join(rows))
    return root


def image(root: Path, name: str, view: Keyframe, *, camera: bool = True) -> None:
    """One frame of PNG folders, as a sensor adds it."""
    assert view.color is not None
    if camera and not (root / "camera-intrinsics.txt").exists():
        root.mkdir(exist_ok=True, parents=True)
        _camera_matrix(root / "camera-intrinsics.txt", view)
    write(root / "depth" / f"{name}.png", np.asarray(view.measurement))
    write(root / "color" / f"{name}.png", view.color)


def tum_line(stamp_ns: int, view: Keyframe) -> str:
    """A pose as a SLAM prints it: `seconds tx ty tz qx qy qz qw`."""
    T = view.T_world_camera
    row = " ".join(f"{x:.9f}" for x in (*T[:3, 3], *quaternion(T[:3, :3])))
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} {row}\n"


def timed_images(root: Path, views: Sequence[Keyframe]) -> Path:
    """PNG folders without poses, whose names are the seconds of the frames."""
    images(root, views, poses=False)
    for number, stamp in enumerate(stamps_ns(len(views))):
        for kind in ("depth", "color"):
            image = root / kind / f"{number:06d}.png"
            image.rename(image.with_name(f"{stamp / 1e9:.6f}.png"))
    return root


def nerfstudio(root: Path, views: Sequence[Keyframe]) -> Path:
    """A capture with `transforms.json`: OpenGL axes, pixel centres at halves."""
    K, frames = views[0].intrinsics, []
    for number, view in enumerate(views):
        assert view.color is not None
        write(root / "images" / f"{number:05d}.png", view.color)
        write(root / "depth" / f"{number:05d}.png", np.asarray(view.measurement))
        frames.append({
            "file_path": f"images/{number:05d}.png",
            "depth_file_path": f"depth/{number:05d}.png",
            "transform_matrix": (view.T_world_camera @ _OPENGL).tolist(),
        })  # fmt: skip
    height, width = views[0].shape
    capture = {
        "camera_model": "OPENCV", "fl_x": K.fx, "fl_y": K.fy, "cx": K.cx + 0.5, "cy": K.cy + 0.5,
        "w": width, "h": height, "frames": frames,
    }  # fmt: skip
    (root / "transforms.json").write_text(json.dumps(capture))
    return root


def bag(root: Path, views: Sequence[Keyframe], form: str) -> Path:
    """A robot's recording in one of the `FORMS` of bags: depth, colour, camera_info and transforms."""
    with writing(root, form) as (writer, path):
        scan(writer, list(views))
    return path


def _camera_matrix(path: Path, view: Keyframe) -> None:
    path.write_text("\n".join(" ".join(f"{x:g}" for x in row) for row in view.intrinsics.matrix) + "\n")
