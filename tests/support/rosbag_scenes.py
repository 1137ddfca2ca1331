# SPDX-License-Identifier: MIT
"""Small ROS recordings of walls, and a robot that carries the camera."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from keyframes_and_servers import CAMERA, SHAPE, pose
from rosbag_writing import BODY, OPTICAL, WORLD, BagWriter, writing

from tsfusion.datasets.rosbag.bag import Bag
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.journal import Journal
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.wire.records import codec

T0, FRAME_NS = 1_700_000_000_123_456_789, 33_333_333
T_BODY_OPTICAL = se3.exp(np.array([0.1, -0.05, 0.3, 1.2, -1.1, 1.3]))
DEPTH, COLOR = "/camera/depth_registered/image_rect", "/camera/rgb/image_rect_color"


def infos(bag: BagWriter, stamp: int = T0, shape: tuple[int, ...] = SHAPE, camera: Any = CAMERA) -> None:
    for topic in (DEPTH, COLOR):
        bag.camera_info(topic.rpartition("/")[0] + "/camera_info", camera, shape, stamp)


def scan(bag: BagWriter, keyframes: list[Keyframe]) -> None:
    """Depth, colour and a robot that carries the camera."""
    bag.transform(T_BODY_OPTICAL, BODY, OPTICAL, T0, static=True)
    for i, keyframe in enumerate(keyframes):
        stamp = T0 + i * FRAME_NS
        infos(bag, stamp, keyframe.shape, keyframe.intrinsics)
        bag.transform(keyframe.T_world_camera @ se3.inverse(T_BODY_OPTICAL), WORLD, BODY, stamp)
        bag.image(DEPTH, keyframe.measurement, "16UC1", stamp)
        bag.image(COLOR, keyframe.color[..., ::-1], "rgb8", stamp + 1_000_000)


def only_depth(folder: Path, write: Callable[[BagWriter], None], **options: Any) -> Bag:
    """A recording of what `write` writes besides a camera and a place."""
    with writing(folder, "ros1") as (bag, path):
        infos(bag)
        bag.transform(pose(1.0), WORLD, OPTICAL, T0)
        bag.transform(pose(2.0), WORLD, OPTICAL, T0 + 10**8)
        write(bag)
    return Bag(path, **options)


def journal_of(folder: Path, keyframes: list[Keyframe]) -> JournalPlace:
    log, session = Journal(folder / "journal", 1 << 30, sync=False), bytes(range(16))
    for seq, keyframe in enumerate(keyframes, 1):
        frames = codec.encode(keyframe, session=session, seq=seq, jpeg_quality=90)
        log.append(frames, session=session, seq=seq, client="scanner", logged_ns=T0 + seq * 10**8)
    log.close()
    return JournalPlace(folder / "journal")


BGR = np.random.default_rng(2).integers(0, 256, (*SHAPE, 3)).astype(np.uint8)
GRAY = BGR[..., 0]


def records(**columns: Any) -> np.ndarray:
    """One row of points with the columns given; x, y and z count up."""
    n = len(next(iter(columns.values()))) if columns else 4
    columns = {**{axis: np.arange(1, n + 1, dtype=np.float32) for axis in "xyz"}, **columns}
    table = np.zeros((1, n), [(name, np.asarray(column).dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return table
