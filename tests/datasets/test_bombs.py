# SPDX-License-Identifier: MIT
"""Files that claim, or unpack to, far more than they have: refused before memory is spent on them."""

import os
import sqlite3
import struct
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbag_scenes import DEPTH, T0, infos
from rosbag_writing import writing

from tsfusion.core import limits
from tsfusion.core.errors import DatasetError
from tsfusion.datasets.readers import read_depth, read_image, read_lines
from tsfusion.datasets.rosbag.bag import Bag
from tsfusion.datasets.scan_files import read_scan

HOLE = 1 << 30
LARGE = np.zeros((1024, 8192), np.uint16)
DEEP = np.arange(120 * 160, dtype=np.uint16).reshape(120, 160)


@contextmanager
def little_memory(most: int = 40 << 20) -> Iterator[None]:
    """What Python and NumPy allocate inside is at most so many bytes."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def with_hole(path: Path, content: bytes = b"") -> Path:
    """A file that goes on with a gigabyte of nothing, which takes no room on the disk."""
    path.write_bytes(content)
    with path.open("r+b") as file:
        file.truncate(HOLE)
    return path


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


# --- recordings ---


@pytest.mark.parametrize(
    "form", ["ros1", "ros1-lz4", "ros1-bz2", "mcap", "mcap-zstd", "mcap-storage", "mcap-file", "sqlite3-zstd"]
)
def test_chunks_and_messages_that_unpack_to_too_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    pytest.importorskip("rosbags")
    with writing(tmp_path, form) as (bag, path):
        infos(bag, shape=LARGE.shape)
        bag.image(DEPTH, LARGE, "16UC1", T0)
    found = Bag(path, posed=False)
    assert len(found) == 1  # an image of 16 MB is none too large
    assert not found.frame(0).depth.any()
    monkeypatch.setattr(limits, "MAX_PIECE_BYTES", 1 << 20)
    with little_memory(), pytest.raises(DatasetError, match=r"(unpacks to more|is larger) than 1\.05 MB"):
        Bag(path, posed=False)


def test_a_compressed_database_that_would_fill_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rosbags")
    with writing(tmp_path, "sqlite3-file") as (bag, path):
        infos(bag, shape=LARGE.shape)
        bag.image(DEPTH, LARGE, "16UC1", T0)
    assert len(Bag(path, posed=False)) == 1
    monkeypatch.setattr(limits, "_FEW_BYTES", 1 << 20)
    with little_memory(), pytest.raises(DatasetError, match="unpacks to far more bytes"):
        Bag(path, posed=False)


def test_a_database_whose_messages_are_computed(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    with writing(tmp_path, "sqlite3") as (bag, path):
        infos(bag, shape=DEEP.shape)
        bag.image(DEPTH, DEEP, "16UC1", T0)
    database = sqlite3.connect(path / "recorded.db3")
    database.executescript(
        "ALTER TABLE messages RENAME TO was; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, "
        "timestamp INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(200000000)) VIRTUAL);"
        "INSERT INTO messages(id, topic_id, timestamp) SELECT id, topic_id, timestamp FROM was"
    )
    database.close()
    with little_memory(), pytest.raises(DatasetError, match="too big"):
        Bag(path, posed=False)


# --- images ---


def test_a_png_is_read_to_its_end_and_no_farther(tmp_path: Path) -> None:
    path = with_hole(tmp_path / "a.png", png(DEEP))
    with little_memory():
        np.testing.assert_array_equal(read_depth(path), DEEP)
    whole = png(DEEP)
    text = struct.pack(">I", 1 << 29) + b"teXt"
    for cut in (whole[:-12], whole[:33] + text):  # before its end; in a chunk of a text without end
        with little_memory(), pytest.raises(DatasetError, match="cannot be decoded"):
            read_depth(with_hole(path, cut))


def test_a_png_holds_no_more_than_its_pixels_need(tmp_path: Path) -> None:
    content = bytes(3 << 20)
    chunk = struct.pack(">I4s", len(content), b"IDAT") + content
    chunk += struct.pack(">I", zlib.crc32(chunk[4:]))
    path = tmp_path / "a.png"
    path.write_bytes(png(DEEP)[:-12] + chunk + png(DEEP)[-12:])
    with pytest.raises(DatasetError, match="cannot be decoded"):
        read_depth(path)


@pytest.mark.parametrize("suffix", [".jpg", ".tiff", ".pgm"])
def test_other_images_with_a_hole(tmp_path: Path, suffix: str) -> None:
    path = with_hole(tmp_path / f"a{suffix}", b"\xff\xd8")
    with little_memory(), pytest.raises(DatasetError, match="8192×8192 pixels"):
        read_image(path, "an image")


def test_a_jpeg_that_claims_a_gigapixel(tmp_path: Path) -> None:
    content = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes())
    at = content.index(b"\xff\xc0") + 5
    content[at : at + 4] = struct.pack(">2H", 30_000, 30_000)
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(DatasetError, match="cannot be decoded"):
        read_image(tmp_path / "a.jpg", "an image")


def test_opencv_is_bounded_in_the_command_alone() -> None:
    claims = b"P5\n20000 20000\n255\n" + bytes(100)
    code = f"""
import contextlib, os, tsfusion.__main__
assert "OPENCV_IO_MAX_IMAGE_PIXELS" not in os.environ  # a program may have larger images of its own
with contextlib.suppress(SystemExit):
    tsfusion.__main__.main(["--version"])
import cv2, numpy
cv2.imdecode(numpy.frombuffer({claims!r}, 'u1'), -1)
"""
    others = {name: value for name, value in os.environ.items() if not name.startswith("OPENCV_")}
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, env=others)
    assert b"in function 'validateInputImageSize'" in ran.stderr


def test_an_exr_that_claims_a_gigapixel(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    path = tmp_path / "a.exr"
    exr.File({"type": exr.scanlineimage}, {"Z": np.ones((4, 4), np.float32)}).write(str(path))
    content, window = path.read_bytes(), b"dataWindow\0box2i\0" + struct.pack("<5i", 16, 0, 0, 3, 3)
    assert window in content
    path.write_bytes(content.replace(window, window[:-8] + struct.pack("<2i", 29_999, 29_999)))
    with little_memory(), pytest.raises(DatasetError, match=r"needs 3\.6 GB of memory"):
        read_depth(path)


def test_an_array_with_a_hole(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((8, 8), np.float32))
    head = (tmp_path / "a.npy").read_bytes()[:128].replace(b"(8, 8), }", b"(16384, 8192), }".ljust(9))
    head = head[:118] + b" " * (127 - 118) + b"\n" if len(head) < 128 else head[:127] + b"\n"
    path = with_hole(tmp_path / "a.npy", head)
    with little_memory(), pytest.raises(DatasetError, match="needs 537 MB of memory"):
        read_depth(path)


# --- scans and text ---


def las(path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    cloud.x, cloud.y, cloud.z = np.ones((3, 4))
    cloud.write(str(path))
    content = bytearray(path.read_bytes())
    content[247:255] = struct.pack("<Q", 1 << 30)  # the number of points
    path.write_bytes(content)


def pcd(path: Path) -> None:
    pytest.importorskip("pypcd4")
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 300000000\nHEIGHT 1\n"
    head += "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 300000000\nDATA binary_compressed\n"
    path.write_bytes(head.encode() + struct.pack("<2I", 100, 3_600_000_000) + bytes(100))


@pytest.mark.parametrize(
    ("name", "write"),
    [("a.bin", with_hole), ("a.ply", with_hole), ("a.las", las), ("a.laz", las), ("a.pcd", pcd)],
)
def test_scans_that_claim_too_much(tmp_path: Path, name: str, write: Callable[[Path], object]) -> None:
    write(tmp_path / name)
    with little_memory(), pytest.raises(DatasetError, match="of memory; expected at most 268 MB"):
        read_scan(tmp_path / name)


def test_a_list_with_a_hole(tmp_path: Path) -> None:
    with little_memory(), pytest.raises(DatasetError, match=r"needs 1\.07 GB of memory"):
        read_lines(with_hole(tmp_path / "poses.txt", b"0 0 0\n"), "numbers")
