# SPDX-License-Identifier: MIT
"""Tiny recordings in the layouts of datasets, and changes that break them."""

import logging
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from tsfusion import Keyframe
from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import UNREADABLE, WITHOUT_POSE, Dataset

P0 = "700 0 40 0 0 700 24 0 0 0 1 0"
P1 = "700 0 40 -350 0 700 24 0 0 0 1 0"
TR = "0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3"
POSE = "1 0 0 0.5\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
ROW = POSE.replace("\n", " ")
CAMERA = "5 0 4\n0 5 3\n0 0 1\n"  # of images of 8×6
UNREAD, UNPOSED = {UNREADABLE: 1}, {WITHOUT_POSE: 1}  # what a recording counts of one frame
Change = Callable[[Path], object]  # of a recording in a folder


def first_views(count: int) -> list[Keyframe]:
    """The first keyframes of the synthetic room of 40."""
    from tsfusion.datasets import Synthetic

    return [Synthetic("room", count=40)[index] for index in range(count)]


def seven_scenes(root: Path, count: int = 3, shape: tuple[int, int] = (6, 8)) -> Path:
    """7-Scenes: depth of (100 + frame) mm."""
    root.mkdir(parents=True, exist_ok=True)
    for frame in range(count):
        stem = root / f"frame-{frame:06d}"
        cv2.imwrite(f"{stem}.depth.png", np.full(shape, 100 + frame, np.uint16))
        cv2.imwrite(f"{stem}.color.png", np.full((*shape, 3), 10 * frame, np.uint8))
        Path(f"{stem}.pose.txt").write_text(POSE)
    (root / "camera-intrinsics.txt").write_text(CAMERA)
    return root


def kitti(root: Path, count: int = 4) -> Path:
    """KITTI odometry: random texture, 8 px of disparity; the car drives 1 m a frame."""
    place = root / "sequences" / "06"
    for name in ("image_0", "image_1", "velodyne"):
        (place / name).mkdir(parents=True)
    (root / "poses").mkdir()
    rng = np.random.default_rng(3)
    for frame in range(count):
        left, right = textured_pair(rng, (48, 160), 8)
        cv2.imwrite(str(place / "image_0" / f"{frame:06d}.png"), left)
        cv2.imwrite(str(place / "image_1" / f"{frame:06d}.png"), right)
        np.abs(rng.normal(size=(100, 4))).astype(np.float32).tofile(place / "velodyne" / f"{frame:06d}.bin")
    (place / "calib.txt").write_text(f"P0: {P0}\nP1: {P1}\nP2: {P0}\nP3: {P1}\nTr: {TR}\n")
    (place / "times.txt").write_text("".join(f"{frame / 10:e}\n" for frame in range(count)))
    rows = (f"1 0 0 0 0 1 0 0 0 0 1 {frame}\n" for frame in range(count))
    (root / "poses" / "06.txt").write_text("".join(rows))
    return root


def round_a_block(file: Path) -> Path:
    """Poses in KITTI's format: round a block of 40×30 m and a little on, in its axes (y down, z forward)."""
    lines = []
    for index in range(150):
        way, share = divmod(index, 36)[0] % 4, index % 36 / 36
        angle = -np.pi / 2 * (way + max(0.0, share - 0.75) * 4)
        corner = [(0, 0), (0, 40), (-30, 40), (-30, 0)][way]
        ahead = [(0, 0), (0, 40), (-30, 40), (-30, 0)][(way + 1) % 4]
        x, z = np.array(corner) + share * (np.array(ahead) - corner)
        y, cosine, sine = 0.02 * z, np.cos(angle), np.sin(angle)
        lines.append(f"{cosine} 0 {sine} {x} 0 1 0 {y} {-sine} 0 {cosine} {z}")
    file.write_text("\n".join(lines))
    return file


def hololens(root: Path, count: int = 3) -> Path:
    """Depth of (7 + frame) mm, all with one pose."""
    for name in ("depth", "images"):
        (root / name).mkdir(parents=True)
    for frame in range(count):
        cv2.imwrite(str(root / "depth" / f"{frame:05d}.png"), np.full((6, 8), 7 + frame, np.uint16))
        cv2.imwrite(str(root / "images" / f"{frame:05d}.png"), np.zeros((6, 8, 3), np.uint8))
    (root / "K.txt").write_text(CAMERA)
    (root / "poses.txt").write_text((ROW + "\n") * count)
    return root


def redwood(root: Path, stems: list[int], poses: list[int]) -> Path:
    """Images named by `stems`, and a log of poses with the numbers `poses`."""
    for name, pixels in (("depth", np.ones((6, 8), np.uint16)), ("color", np.zeros((6, 8, 3), np.uint8))):
        (root / name).mkdir(parents=True)
        for stem in stems:
            cv2.imwrite(str(root / name / f"{stem:05d}.png"), pixels)
    (root / "camera-intrinsics.txt").write_text(CAMERA)
    text = (f"{i} {i} {i + 1}\n" + POSE.replace("0.5", str(i)) for i in poses)
    (root / "trajectory.log").write_text("".join(text))
    return root


def corbs(root: Path, *, shape: tuple[int, int] = (480, 640)) -> Path:
    """Five frames as CoRBS ships them: Windows paths, CRLF, comments, the trajectory in a folder of its own.

    Depth at 0, 0.1 … 0.4 s, colour 4 ms later except the third; poses every 50 ms up to 0.3 s.
    """
    place = root / "D1_pre_registereddata"
    lists: dict[str, list[str]] = {"depth": [], "rgb": []}
    for name in lists:
        (place / name).mkdir(parents=True)
    for frame in range(5):
        seconds = 1000 + frame / 10
        cv2.imwrite(str(place / "depth" / f"{frame}.png"), np.full(shape, 5000 * (frame + 1), np.uint16))
        cv2.imwrite(str(place / "rgb" / f"{frame}.png"), np.full((*shape, 3), frame, np.uint8))
        lists["depth"].append(f"{seconds:.6f} depth\\{frame}.png")
        lists["rgb"].append(f"{seconds + (0.03 if frame == 2 else 0.004):.6f} rgb\\{frame}.png")
    for name, lines in lists.items():
        text = "\r\n".join(["# recorded", "# timestamp filename", *lines, ""])
        (place / f"{name}.txt").write_bytes(text.encode())
    (root / "D1_Trajectory").mkdir()
    poses = [f"{1000.01 + 0.05 * i:.4f} {i} 0 0 0 0 0 1" for i in range(-1, 7)]
    text = "\r\n".join(["# t x y z q", *poses, ""])
    (root / "D1_Trajectory" / "groundtruth.txt").write_bytes(text.encode())
    return place


def put(name: str, content: str | bytes | None) -> Change:
    """Write a file of a recording; None: delete it."""

    def change(root: Path) -> None:
        if content is None:
            (root / name).unlink()
        else:
            (root / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return change


def replace(name: str, old: str, new: str) -> Change:
    """Replace a text in a file of a recording."""
    return lambda root: (root / name).write_bytes(
        (root / name).read_bytes().replace(old.encode(), new.encode())
    )


def claim_size(png: Path, side: int) -> None:
    """Let a PNG claim so many pixels a side."""
    content = bytearray(png.read_bytes())
    struct.pack_into(">2I", content, 16, side, side)
    struct.pack_into(">I", content, 29, zlib.crc32(content[12:29]))
    png.write_bytes(content)


def one_line(open_: Callable[[], object], match: str | None = None) -> None:
    """Opening must raise a DatasetError of one line that matches."""
    with pytest.raises(DatasetError, match=match) as caught:
        open_()
    assert "\n" not in str(caught.value)


class LeftOut(NamedTuple):
    """What is said of a recording's broken part that is left out, and what the recording counts then."""

    match: str
    skipped: dict[str, int]


def one_line_of(open_: Callable[[], Dataset], expected: str | LeftOut) -> None:
    """A recording is refused, as `one_line` has it, or opens without the part that it names."""
    if isinstance(expected, str):
        one_line(lambda: list(open_()), expected)
        return
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("tsfusion").addHandler(handler)
    try:
        dataset = open_()
        frames = list(dataset)
    finally:
        logging.getLogger("tsfusion").removeHandler(handler)
    assert dataset.skipped == expected.skipped, dataset.skipped
    assert len(frames) == len(dataset) - dataset.skipped.get(UNREADABLE, 0)
    assert len([line for line in said if re.search(expected.match, line)]) == 1, said
    assert "\n" not in "".join(said)


def textured_pair(rng: np.random.Generator, shape: tuple[int, int], disparity: int):
    """(left, right) random texture, equal but for the disparity."""
    wide = rng.integers(0, 256, (shape[0], shape[1] + disparity)).astype(np.uint8)
    wide = cv2.GaussianBlur(wide, (0, 0), 0.8)
    left, right = wide[:, : shape[1]], wide[:, disparity:]
    return np.ascontiguousarray(left), np.ascontiguousarray(right)
