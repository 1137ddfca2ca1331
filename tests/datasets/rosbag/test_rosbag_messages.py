# SPDX-License-Identifier: MIT
"""Images, compressed images and point clouds of ROS in every encoding."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from keyframes_and_servers import SHAPE, wall
from rosbag_scenes import BGR, COLOR, DEPTH, FRAME_NS, GRAY, T0, only_depth, records
from rosbag_writing import BagWriter, jpeg, writing

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.rosbag.bag import Bag

pytest.importorskip("rosbags")
WITH_ALPHA = np.dstack([BGR, np.full(SHAPE, 9, np.uint8)])


def of_color(folder: Path, stored: np.ndarray, encoding: str, **options: Any) -> Any:
    """Pixel layout in which a colour image beside a depth image is read."""

    def write(bag: BagWriter) -> None:
        bag.image(DEPTH, wall().measurement, "16UC1", T0)
        bag.image(COLOR, stored, encoding, T0, **options)

    return only_depth(folder, write)[0].color


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "stored", "expected"),
    [
        ("bgr8", BGR, BGR),
        ("rgb8", BGR[..., ::-1], BGR),
        ("bgra8", WITH_ALPHA, BGR),
        ("rgba8", WITH_ALPHA[..., [2, 1, 0, 3]], BGR),
        ("mono8", GRAY, np.dstack([GRAY] * 3)),
        ("8UC3", BGR, BGR),
    ],
)
def test_colour_encodings(
    tmp_path: Path, encoding: str, stored: np.ndarray, expected: np.ndarray, padding: int
) -> None:
    assert np.array_equal(of_color(tmp_path, stored, encoding, padding=padding), expected)


@pytest.mark.parametrize(("encoding", "first"), [("yuv422", 1), ("yuv422_yuy2", 0)])
def test_yuv_is_read(tmp_path: Path, encoding: str, first: int) -> None:
    stored = np.full((*SHAPE, 2), 128, np.uint8)
    stored[..., first if encoding != "yuv422" else 1] = 180  # luminance
    color = of_color(tmp_path, stored, encoding)
    assert np.ptp(color) == 0  # grey
    assert abs(int(color[0, 0, 0]) - round(1.164 * (180 - 16))) <= 1


@pytest.mark.parametrize(
    ("pattern", "red"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))]
)
def test_bayer_patterns_have_red_where_they_say(tmp_path: Path, pattern: str, red: tuple[int, int]) -> None:
    stored = np.zeros(SHAPE, np.uint8)
    stored[red[0] :: 2, red[1] :: 2] = 200
    color = of_color(tmp_path, stored, f"bayer_{pattern}8")
    assert color[5:-5, 5:-5].reshape(-1, 3).mean(axis=0) == pytest.approx([0, 0, 200], abs=1)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 6])
def test_depth_encodings(tmp_path: Path, big: bool, padding: int) -> None:
    metres = np.where(wall().measurement > 0, wall().measurement * np.float32(0.00137), np.nan)

    def write(bag: BagWriter) -> None:
        bag.image(DEPTH, metres.astype(np.float32), "32FC1", T0, big=big, padding=2 * padding)
        bag.image(DEPTH, wall(1).measurement, "16UC1", T0 + FRAME_NS, big=big, padding=padding)
        bag.image(DEPTH, wall(2).measurement, "mono16", T0 + 2 * FRAME_NS, big=big, padding=padding)

    found = only_depth(tmp_path, write)
    assert np.array_equal(found[0].measurement, metres.astype(np.float32), equal_nan=True)
    for i in (1, 2):
        assert np.array_equal(found[i].measurement, wall(i).measurement)


def test_compressed_images(tmp_path: Path) -> None:
    import struct

    depth, color = wall().measurement, wall().color
    a, b = 100.0 * (100.0 + 1), 1 - 100.0 * 101.0 / 10  # of image_transport: quantisation 100, at most 10 m
    metres = depth * np.float32(0.001)
    inverse = np.where(depth > 0, np.round(a / np.maximum(metres, 0.1) + b), 0)

    def write(bag: BagWriter) -> None:
        first, second, third = T0, T0 + FRAME_NS, T0 + 2 * FRAME_NS
        name, head = f"{DEPTH}/compressedDepth", struct.pack("<iff", 0, a, b)
        bag.compressed(name, head + jpeg(depth, ".png"), "16UC1; compressedDepth png", first)
        bag.compressed(name, head + jpeg(inverse.astype(np.uint16), ".png"), "32FC1; compressedDepth", second)
        bag.compressed(name, jpeg(depth, ".png"), "16UC1; png compressed", third)
        bag.compressed(f"{COLOR}/compressed", jpeg(color), "rgb8; jpeg compressed bgr8", first)
        bag.compressed(f"{COLOR}/compressed", jpeg(color, ".png"), "png", second)

    found = only_depth(tmp_path, write)
    assert (len(found), found.uncolored) == (3, 1)
    assert np.array_equal(found[0].measurement, depth)
    assert np.array_equal(found[2].measurement, depth)
    read = found[1].measurement
    assert np.array_equal(np.isnan(read), depth == 0)
    step = metres[depth > 0] ** 2 / a  # what one step of the quantisation is at that depth
    assert (np.abs(read[depth > 0] - metres[depth > 0]) <= 0.51 * step).all()
    assert np.array_equal(found[1].color, color)
    assert np.abs(found[0].color.astype(int) - color).mean() < 4
    assert found[2].color is None


def test_an_image_that_cannot_be_decoded_is_named(tmp_path: Path) -> None:
    name, form = f"{DEPTH}/compressedDepth", "16UC1; compressedDepth"

    def write(bag: BagWriter, *, whole: bool = True) -> None:
        bag.compressed(name, bytes(50), form, T0)
        if whole:
            bag.compressed(name, bytes(12) + jpeg(wall().measurement, ".png"), form, T0 + FRAME_NS)

    found = only_depth(tmp_path, write)
    with pytest.raises(DatasetError, match=r"message 0 of .*compressedDepth of 50 bytes cannot be decoded"):
        found[0]
    assert np.array_equal(found[1].measurement, wall().measurement)
    with pytest.raises(DatasetError, match="compressedDepth cannot be decoded"):
        only_depth(tmp_path / "two", lambda bag: write(bag, whole=False), depth_topic=name)


def test_messages_that_do_not_fit_themselves_are_counted(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        bag.image(DEPTH, wall(0).measurement, "16UC1", T0)
        for i, wrong in enumerate(({"step": 20}, {"height": 49}, {"data": np.zeros(7, np.uint8)},
                                   {"width": 1 << 30}, {"encoding": "64FC7"}, {"height": 0}), 1):  # fmt: skip
            encoding = wrong.pop("encoding", "16UC1")
            bag.image(DEPTH, wall(i).measurement, encoding, T0 + i, **wrong)
        bag.image(DEPTH, wall(1).measurement, "16UC1", T0 + FRAME_NS)

    found = only_depth(tmp_path, write)
    assert len(found) == 2
    assert found.skipped == {f"of {DEPTH} that are broken": 6}
    assert np.array_equal(found[1].measurement, wall(1).measurement)


def of_cloud(folder: Path, table: np.ndarray, **wrong: Any) -> Any:
    with writing(folder, "sqlite3") as (bag, path):
        bag.cloud("/points", table, T0, **wrong)
    return Bag(path, posed=False).frame(0)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("kind", ["f4", "u4"])
def test_points_have_their_colours(tmp_path: Path, kind: str, big: bool) -> None:
    packed = np.array([0x00112233, 0x00445566, 0xFFFFFFFF, 0], np.uint32)
    table = records(rgb=packed.view(kind))
    if big:
        table = table.astype(table.dtype.newbyteorder(">"))
    frame = of_cloud(tmp_path, table, big=big)
    assert frame.color.tolist() == [[0x33, 0x22, 0x11], [0x66, 0x55, 0x44], [255] * 3, [0] * 3]


def test_points_without_a_return_are_not_numbers(tmp_path: Path) -> None:
    x = np.array([1, 0, np.nan, 2], np.float32)
    frame = of_cloud(tmp_path, records(x=x, y=x, z=x))
    assert np.isfinite(frame.points).all(axis=1).tolist() == [True, False, False, True]
    assert frame.point_times_s is None


@pytest.mark.parametrize(
    ("name", "column", "expected"),
    [
        ("t", np.array([0, 5e7, 1e8], np.uint32), [0, 0.05, 0.1]),  # Ouster: ns of the sweep
        ("time", np.array([-0.1, -0.05, 0], np.float32), [-0.1, -0.05, 0]),  # Velodyne
        ("timestamp", T0 * 1e-9 + np.array([0, 0.05, 0.1]), [0, 0.05, 0.1]),  # Hesai: absolute s
        ("timestamp", T0 + np.array([0, 5e7, 1e8]), [0, 0.05, 0.1]),  # Livox: absolute ns as float64
        ("timestamp", np.array([0, 50, 100], np.float64), [0, 0.05, 0.1]),  # ms
        ("offset_time", np.array([0, 50_000, 100_000], np.uint32), [0, 0.05, 0.1]),  # µs
        ("timestamp", 100 + np.array([7, 7.05, 7.1]), [0, 0.05, 0.1]),  # of another clock
        ("time", np.array([np.nan, 0, 0.1], np.float32), [0, 0, 0.1]),
        ("t", np.array([0, 0, 0], np.uint32), None),
        ("time", np.array([0, 1e12, 2e12]), None),
    ],
)
def test_points_have_their_times(tmp_path: Path, name: str, column: np.ndarray, expected: Any) -> None:
    times = of_cloud(tmp_path, records(**{name: column})).point_times_s
    if expected is None:
        assert times is None
    else:
        assert times.tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"row_step": 3}, {"point_step": 8}, {"height": 2}, {"data": np.zeros(5, np.uint8)}]
)
def test_clouds_that_do_not_fit_themselves_are_counted(tmp_path: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(DatasetError, match=r"no usable frames.*1 of /points that are broken"):
        of_cloud(tmp_path, records(), **wrong)
