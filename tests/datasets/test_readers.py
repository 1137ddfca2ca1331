# SPDX-License-Identifier: MIT
"""Depth images of every kind, and what is none, without a word by OpenCV or libpng; times of points."""

import re
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from small_recordings import one_line, put, redwood
from written_recordings import check, matrix, millimetres, views, write

from tsfusion.core.errors import DatasetError, MissingDependency
from tsfusion.datasets import open_dataset
from tsfusion.datasets.readers import check_metres, read_color, read_depth, read_image
from tsfusion.datasets.rosbag import bag_messages
from tsfusion.datasets.scan_files import Scan, point_times, time_field
from tsfusion.geometry.keyframe import depth_metres
from tsfusion.viewer.map.scanner_marks import small_picture
from tsfusion.wire.records.array_encoding import unpack_image

STAMP = 1_700_000_000_000_000_000
SHARE = np.linspace(0, 1, 11)


def save(path: Path, depth: np.ndarray) -> None:
    """Depth in a file of any kind."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, depth)
    elif path.suffix == ".exr":
        exr = pytest.importorskip("OpenEXR")
        kind = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        name = "RGB" if depth.ndim == 3 else "Z"
        exr.File(kind, {name: depth.astype(np.float32)}).write(str(path))
    else:
        assert cv2.imwrite(str(path), depth)


def room(root: Path, suffix: str, units: float | None, *, dtype: type = np.float32) -> Path:
    """A Redwood-like recording of the room; depth in `units` a metre, None = uint16 millimetres."""
    log, K = "", views()[0].intrinsics
    for number, view in enumerate(views()):
        depth = millimetres(view) if units is None else (depth_metres(view) * units).astype(dtype)
        save(root / "depth" / f"{number:05d}{suffix}", depth)
        write(root / "color" / f"{number:05d}.png", view.color)
        log += f"{number} {number} {number + 1}\n{matrix(view.T_world_camera)}"
    (root / "trajectory.log").write_text(log)
    (root / "K.txt").write_text(matrix(K.matrix))
    return root


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".pgm"])
def test_sixteen_bits_of_any_kind(tmp_path, suffix):
    check(open_dataset(room(tmp_path, suffix, None)), views())


@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [(".tiff", np.float32), (".exr", np.float32), (".npy", np.float32), (".npy", np.float64)],
)
def test_floats_are_metres(tmp_path, suffix, dtype):
    dataset = open_dataset(room(tmp_path, suffix, 1.0, dtype=dtype))
    check(dataset, views(), depth_m=1e-5)
    assert dataset[0].depth.dtype == np.float32


def test_tum_lists_name_floats_too(tmp_path):
    for name, suffix in (("depth", ".npy"), ("rgb", ".png")):
        (tmp_path / f"{name}.txt").write_text("".join(f"{n}.0 {name}/{n}{suffix}\n" for n in range(2)))
    for number, view in enumerate(views(2)):
        save(tmp_path / "depth" / f"{number}.npy", depth_metres(view))
        write(tmp_path / "rgb" / f"{number}.png", view.color)
    (tmp_path / "K.txt").write_text(matrix(views()[0].intrinsics.matrix))
    dataset = open_dataset(tmp_path, posed=False)
    np.testing.assert_allclose(dataset.frame(1).depth_m, depth_metres(views()[1]), atol=1e-6)


@pytest.mark.parametrize("suffix", [".tiff", ".npy"])
def test_floats_in_millimetres_are_an_error_until_their_unit_is_given(tmp_path, suffix):
    root = room(tmp_path, suffix, 1000.0)
    match = (
        r"00000\.\w+: depth is expected in metres, .*: millimetres\? then give --option depth_scale=0\.001"
    )
    one_line(lambda: open_dataset(root)[0], match)
    check(open_dataset(root, depth_scale=0.001), views(), depth_m=1e-5)
    one_line(lambda: open_dataset(root, depth_scale=1e-6)[0], "then give --option depth_scale=1 ")


def test_metres_of_a_hall_and_of_a_hand_are_no_mistakes():
    for metres in (0.02, 0.5, 60.0):
        check_metres(np.full((48, 64), metres, np.float32), "a file")
    check_metres(np.full((48, 64), np.nan, np.float32), "a file")


def test_depth_of_several_kinds_is_an_error(tmp_path):
    root = room(tmp_path, ".npy", 1.0)
    write(root / "depth" / "00000.png", np.zeros((120, 160, 3), np.uint8))  # to look at
    one_line(lambda: open_dataset(root), r"depth holds files of \.npy and \.png; expected depth of one kind")
    (root / "depth" / "00000.png").unlink()
    np.save(root / "depth" / "00001.npy", np.ones((120, 160), np.uint16))
    dataset = open_dataset(root)
    assert dataset[0].depth.dtype == np.float32
    one_line(lambda: dataset[1], r"00001\.npy holds uint16, others float32; expected one kind of depth")


@pytest.mark.parametrize(
    ("image", "match"),
    [
        (np.ones((6, 8), np.uint8), r"must hold one 16-bit channel or floats, .* \(was it saved again as 8"),
        (np.ones((6, 8, 3), np.uint8), r"must hold one 16-bit channel or floats, got .*: a colour image"),
        (np.ones((6, 8, 3), np.uint16), r"must hold one 16-bit channel or floats, got shape \(6, 8, 3\)"),
    ],
)
def test_what_is_no_depth_is_named(tmp_path, image, match):
    root = redwood(tmp_path, [0], [0])
    write(root / "depth" / "00000.png", image)
    one_line(lambda: open_dataset(root), match)


def test_npy_and_grey_floats(tmp_path):
    depth = np.random.default_rng(0).random((6, 8)).astype(np.float32)
    save(tmp_path / "grey.npy", np.dstack([depth, depth, depth]))
    save(tmp_path / "numbers.npy", (depth * 1000).astype(np.int64))
    np.testing.assert_array_equal(read_depth(tmp_path / "grey.npy"), depth)
    assert read_depth(tmp_path / "numbers.npy").dtype == np.uint16
    for name, other in (("bytes", (depth * 1000).astype(">u2")), ("one", depth[..., None].astype(">f4"))):
        save(tmp_path / f"{name}.npy", other)
        np.testing.assert_array_equal(read_depth(tmp_path / f"{name}.npy"), other.reshape(6, 8))
    save(tmp_path / "far.npy", np.full((6, 8), 70_000))
    one_line(lambda: read_depth(tmp_path / "far.npy"), "must hold one 16-bit channel or floats, .* int64")
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY")
    one_line(lambda: read_depth(tmp_path / "bad.npy"), r"bad\.npy cannot be read")


def test_exr_of_any_writer_and_without_its_package(tmp_path, monkeypatch):
    pytest.importorskip("OpenEXR")
    depth = np.random.default_rng(0).random((6, 8)).astype(np.float32)
    save(tmp_path / "grey.exr", np.dstack([depth, depth, depth]))
    np.testing.assert_array_equal(read_depth(tmp_path / "grey.exr"), depth)
    (tmp_path / "bad.exr").write_bytes(b"no image")
    one_line(lambda: read_depth(tmp_path / "bad.exr"), r"bad\.exr cannot be decoded; expected a depth image")
    monkeypatch.setitem(__import__("sys").modules, "OpenEXR", None)
    with pytest.raises(MissingDependency, match=r"pip install '\.\[exr\]'"):
        read_depth(tmp_path / "grey.exr")


def chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def test_nothing_is_printed_by_the_libraries_that_decode(tmp_path, capfd):
    """An ICC profile that libpng does not like, a bit that fell over, a file that ends early."""
    root = redwood(tmp_path, [*range(6)], [*range(6)])
    files = [root / "depth" / f"0000{number}.png" for number in range(3)]
    whole = files[0].read_bytes()
    files[0].write_bytes(
        whole[:33] + chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(b"x" * 50)) + whole[33:]
    )
    files[1].write_bytes(whole[:45] + bytes([whole[45] ^ 1]) + whole[46:])
    files[2].write_bytes(whole[:-20])
    dataset = open_dataset(root)
    assert (dataset[0].depth == 1).all()
    for index in (1, 2):
        with pytest.raises(DatasetError, match=rf"{index}\.png cannot be decoded; expected a depth"):
            dataset[index]
    put("depth/00000.png", whole[:8] + chunk(b"IHDR", b""))(root)
    one_line(lambda: dataset[0], "cannot be decoded")
    assert capfd.readouterr() == ("", "")


def exif(image: np.ndarray, orientation: int) -> bytes:
    """A JPEG with an EXIF orientation."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff + data[2:]


@pytest.mark.parametrize("orientation", [2, 3, 4, 6, 8])
def test_colour_is_read_as_stored_whatever_its_exif_orientation(tmp_path, orientation):
    image = np.zeros((24, 32, 3), np.uint8)
    image[:12, :16] = 200
    (tmp_path / "a.jpg").write_bytes(exif(image, orientation))
    raw = np.fromfile(tmp_path / "a.jpg", np.uint8)
    shown = cv2.imdecode(raw, cv2.IMREAD_COLOR)
    assert shown.shape != image.shape or np.abs(shown.astype(int) - image).mean() > 20
    bag = SimpleNamespace(format="jpeg", data=raw)
    for found in (
        read_color(tmp_path / "a.jpg", (24, 32)),
        read_image(tmp_path / "a.jpg", "an image", cv2.IMREAD_ANYCOLOR),
        bag_messages.color(bag),
        unpack_image(raw.tobytes(), np.dtype(np.uint8), (24, 32, 3)),
        small_picture(raw.tobytes()),
    ):
        assert np.abs(found.astype(int) - image).mean() < 3
    assert np.abs(bag_messages.gray(bag).astype(int) - image[..., 0]).mean() < 3
    if orientation > 4:
        one_line(lambda: read_color(tmp_path / "a.jpg", (32, 24)), "EXIF orientation turns these")


def test_colour_of_a_phone_is_made_as_small_as_its_depth(tmp_path: Path) -> None:
    image = np.zeros((180, 240, 3), np.uint8)
    image[:, 120:] = 200
    cv2.imwrite(str(tmp_path / "a.png"), image)
    small = read_color(tmp_path / "a.png", (24, 32))
    np.testing.assert_array_equal(small, np.repeat([[[0] * 3] * 16 + [[200] * 3] * 16], 24, axis=0))
    for other in ((90, 120), (24, 40), (32, 24)):  # too large for a phone's depth, or of another shape
        one_line(lambda other=other: read_color(tmp_path / "a.png", other), "expected equal sizes")


def read(field: str, moments: Any, stamp_ns: int = STAMP, between_s: float = 0.1) -> Any:
    points = np.ones((len(moments), 3), np.float32)
    return point_times(Scan(points, field, np.asarray(moments)), stamp_ns, between_s)


@pytest.mark.parametrize("start_s", [0.0, -0.05, -0.1])  # stamped at the sweep's begin, middle and end
@pytest.mark.parametrize(
    ("field", "unit", "zero_s", "kind"),
    [
        ("time", 1.0, 0, "f4"),
        ("timestamp", 1.0, STAMP / 1e9, "f8"),
        ("timestamp", 1e-9, STAMP / 1e9, "f8"),
        ("timestamp", 1e-9, STAMP / 1e9, "u8"),
        ("gps_time", 1.0, STAMP / 1e9, "f8"),
        ("t", 1e-6, 0, "i4"),
        ("offset_time", 1e-9, 0, "i4"),
        ("time", 1e-3, 0, "f4"),
    ],
)
def test_units_and_clocks(start_s: float, field: str, unit: float, zero_s: float, kind: str) -> None:
    moments = ((zero_s + start_s + SHARE * 0.1) / unit).astype(kind)
    times, untimed = read(field, moments)
    assert untimed == ""
    assert times.dtype == np.float32
    np.testing.assert_allclose(times, start_s + SHARE * 0.1, atol=2e-6)


def test_another_clock_counts_from_the_first_point() -> None:
    np.testing.assert_allclose(read("gps_time", 4000 + SHARE * 0.1).point_times_s, SHARE * 0.1, atol=1e-6)
    np.testing.assert_allclose(read("t", STAMP + SHARE * 1e8, 0).point_times_s, SHARE * 0.1, atol=1e-6)


def test_a_field_may_name_its_unit() -> None:
    np.testing.assert_allclose(read("time_us", SHARE * 5000).point_times_s, SHARE * 0.005, atol=1e-6)
    assert read("time_ns", SHARE * 5000).point_times_s is None


def test_frames_bound_a_sweep() -> None:
    moments = (SHARE * 4e5).astype(np.uint32)
    assert read("t", moments, between_s=1.0).point_times_s.max() == pytest.approx(0.4)
    assert read("t", moments, between_s=0.1).point_times_s is None


@pytest.mark.parametrize(
    ("moments", "reason"),
    [
        (np.zeros(11, np.float32), "t is the same for all points"),
        ((STAMP / 1e9 + SHARE * 900).astype(np.float32), "float32 is too coarse for t"),
        (SHARE * 1.3e6, r"t spans 1.3e\+06, in any unit no sweep of 0.003 to 0.3 s"),  # a packet's
        (SHARE * 1e12, "in any unit no sweep"),
        (np.array([-(1 << 62), *[0] * 9, 1 << 62]), "in any unit no sweep"),
        (
            SHARE[::-1] * 0.1,
            "t falls from the first point to the last; if it is right, sort the points by it",
        ),
        ((SHARE + 0.45) % 1 * 0.1, "t begins anew within the sweep"),
    ],
)
def test_times_of_no_use_are_named(moments: Any, reason: str) -> None:
    times, untimed = read("t", moments)
    assert times is None
    assert re.search(reason, untimed)


def test_times_may_come_ring_after_ring() -> None:
    for rings in (2, 3, 16):
        np.testing.assert_allclose(read("t", np.tile(SHARE * 0.1, rings)).point_times_s[:11], SHARE * 0.1)
    assert read("t", (SHARE * 0.1)[[*range(9), 10, 9]]).untimed == ""


def test_points_without_a_return_may_have_any_time() -> None:
    points = np.ones((4, 3), np.float32)
    points[0], points[1] = np.nan, 0
    scan = Scan(points, "timestamp", np.array([np.nan, 0.0, STAMP / 1e9, STAMP / 1e9 + 0.1]))
    np.testing.assert_allclose(point_times(scan, STAMP).point_times_s, [0, 0, 0, 0.1], atol=1e-6)
    assert point_times(Scan(points * np.nan, "t", np.arange(4)), STAMP) == (None, "")


def test_names_of_fields() -> None:
    for name in ("t", "time", "timeStamp", "time_stamp", "timestamp", "offset_time", "timeoffset", "gps_time",
                 "GpsTime", "scalar_GpsTime", "time_us", "point_time_offset", "ts"):  # fmt: skip
        assert time_field(["x", name, "intensity"]) == name
    assert time_field(["x", "y", "z", "intensity", "ring", "tone", "curvature", "timed"]) is None
