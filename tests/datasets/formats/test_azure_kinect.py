# SPDX-License-Identifier: MIT
"""Recordings of an Azure Kinect: depth, colour by its own camera, times; damage is named."""

import json
import struct
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from known_turns import END_S, R_SENSOR_IMU, STILL_S, assert_known, attitude, samples
from small_recordings import one_line

from tsfusion.core.errors import MissingDependency
from tsfusion.datasets import color_placement, describe, find, open_dataset
from tsfusion.datasets.dataset import NoPoses
from tsfusion.datasets.trajectory_files import write_tum

SAMPLE = "azure_kinect"
LENS = (0.4, -0.05, 0.01, 0.7, 0.05, -0.01)  # k1 to k6


def camera(name: str, focal: tuple[float, float], x_m: float = 0.0) -> dict[str, Any]:
    numbers = [0.5, 0.5, *focal, *LENS, 0, 0, 1e-4, -1e-4]
    return {
        "Location": f"CALIBRATION_CameraLocation{name}",
        "Intrinsics": {"ModelParameters": numbers},
        "Rt": {"Rotation": np.eye(3).ravel().tolist(), "Translation": [x_m, 0, 0]},
    }


CALIBRATION = {"CalibrationInformation": {
    "Cameras": [camera("D0", (0.49, 0.49)), camera("PV0", (0.48, 0.64), -0.032)]}}  # fmt: skip


def recorded(
    path: Path,
    count: int = 4,
    *,
    calibration: object = CALIBRATION,
    tracks: tuple[str, ...] = ("DEPTH", "COLOR"),
) -> Path:
    """Depth 320×288 that grows from frame to frame, and a coloured JPEG of 1280×720."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w", options={"allow_raw_vfw": "1"}) as file:
        if calibration is not None:
            file.add_attachment(
                "calibration.json", "application/octet-stream", json.dumps(calibration).encode()
            )
        streams = {}
        for name in tracks:
            made = file.add_stream("rawvideo" if name == "DEPTH" else "mjpeg", rate=30)
            made.width, made.height = (320, 288) if name == "DEPTH" else (1280, 720)
            made.pix_fmt = "gray16be" if name == "DEPTH" else "yuvj420p"
            if name == "DEPTH":
                made.codec_context.codec_tag = "b16g"
            made.time_base = Fraction(1, 1_000_000)
            made.metadata["title"] = name
            streams[name] = made
        for index in range(count):
            pictures = {"DEPTH": depth(index).astype(">u2"), "COLOR": color(index)}
            for name, made in streams.items():
                image = pictures[name]
                kind = "gray16be" if name == "DEPTH" else "bgr24"
                packed = av.VideoFrame(image.shape[1], image.shape[0], kind)
                packed.planes[0].update(np.ascontiguousarray(image).tobytes())
                packed.pts, packed.time_base = 100_000 + 33_333 * index, Fraction(1, 1_000_000)
                packed = packed if name == "DEPTH" else packed.reformat(format="yuvj420p")
                packed.pts, packed.time_base = 100_000 + 33_333 * index, Fraction(1, 1_000_000)
                for packet in made.encode(packed):
                    file.mux(packet)
        for made in streams.values():
            file.mux(made.encode(None))
    return path


def depth(index: int) -> np.ndarray:
    return np.full((288, 320), 1000 + 100 * index, np.uint16)


def color(index: int) -> np.ndarray:
    return np.full((720, 1280, 3), (40, 90 + 20 * index, 160), np.uint8)


def test_a_recording_is_recognised_and_gives_its_frames(tmp_path: Path) -> None:
    path = recorded(tmp_path / "küche.mkv")
    assert (find(path).layout.name, find(tmp_path).path) == ("Azure Kinect", path.parent)
    dataset = open_dataset(path, posed=False)
    assert (len(dataset), dataset.skipped, dataset.uncolored) == (4, {}, 0)
    assert np.diff(dataset.timestamps_ns).tolist() == pytest.approx([33.333e6] * 3, abs=1e6)
    for index in (0, 3, 1, 1, 2):
        frame = dataset.frame(index)
        seen = frame.depth > 0
        assert seen.mean() > 0.95
        assert set(np.unique(frame.depth[seen])) == {1000 + 100 * index}
        np.testing.assert_allclose(
            frame.color.reshape(-1, 3).mean(axis=0), (40, 90 + 20 * index, 160), atol=4
        )
        assert frame.intrinsics == dataset.camera.intrinsics
        assert frame.sensor == "tof"
    assert "4 RGB-D frames 320×288 at 30 Hz, no poses" in describe(dataset)
    assert open_dataset(path, posed=False, color=False).frame(0).color is None


def test_poses_come_from_a_scan_or_a_file(tmp_path: Path) -> None:
    path = recorded(tmp_path / "a.mkv")
    with pytest.raises(NoPoses, match=r"a.mkv has no poses; `tsfusion scan PATH` finds poses by itself"):
        open_dataset(path)
    stamps = open_dataset(path, posed=False).timestamps_ns.tolist()
    write_tum(tmp_path / "slam.txt", stamps, [np.eye(4)] * 4)
    assert len(list(open_dataset(path, trajectory=tmp_path / "slam.txt"))) == 4


def test_depth_alone_is_a_recording(tmp_path: Path) -> None:
    dataset = open_dataset(recorded(tmp_path / "a.mkv", tracks=("DEPTH",)), posed=False)
    assert dataset.frame(1).color is None
    assert "4 depth images" in describe(dataset)


def test_a_recording_that_was_cut_has_its_first_frames(tmp_path: Path) -> None:
    content = recorded(tmp_path / "a.mkv", 8).read_bytes()
    (tmp_path / "b.mkv").write_bytes(content[: len(content) * 5 // 8])
    dataset = open_dataset(tmp_path / "b.mkv", posed=False)
    assert 3 <= len(dataset) <= 6
    assert (dataset.frame(1).depth > 0).any()
    for nbytes in (0, 40, 300):
        (tmp_path / "c.mkv").write_bytes(content[:nbytes])
        one_line(lambda: open_dataset(tmp_path / "c.mkv"), "c.mkv .*; expected an Azure Kinect's .mkv")


@pytest.mark.parametrize(("change", "said"), [
    ({"calibration": None}, "has no calibration"),
    ({"calibration": [1, 2]}, "its calibration is malformed"),
    ({"calibration": {"CalibrationInformation": {"Cameras": [camera("D0", (0.4, 0.4))]}}}, "is malformed"),
    ({"calibration": {"CalibrationInformation": {"Cameras": [camera("D0", (-1, 0.4))]}}}, "is malformed"),
    ({"tracks": ("COLOR",)}, "has no track DEPTH; expected an Azure Kinect's .mkv"),
])  # fmt: skip
def test_what_is_missing_is_said(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = recorded(tmp_path / "a.mkv", **change)
    one_line(lambda: open_dataset(path, posed=False), said)


def test_the_library_is_named_where_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mkv").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependency, match=r"an .mkv needs PyAV: pip install '.\[azure\]'"):
        open_dataset(tmp_path / "a.mkv")


def test_colour_of_a_real_recording_lies_on_its_depth(data: Callable[[str], Path]) -> None:
    pytest.importorskip("av")
    dataset = open_dataset(data(SAMPLE), posed=False)
    frame = dataset.frame(0)
    assert (len(dataset), frame.depth.shape, frame.color.shape) == (1, (576, 640), (576, 640, 3))
    edges = color_placement.outlines(frame)
    shifted = color_placement.outlines(
        type(frame)(depth=frame.depth, color=np.roll(frame.color, 24, axis=1), sensor="tof",
                    intrinsics=frame.intrinsics)
    )  # fmt: skip
    here, there = (float((edges.depth * each.image).sum() / edges.depth.sum()) for each in (edges, shifted))
    assert here > 1.7
    assert here > there + 0.3
    assert 437 < dataset.camera.intrinsics.fx < 438
    assert cv2.cvtColor(frame.color, cv2.COLOR_BGR2GRAY).std() > 20


def element(name: int, content: bytes) -> bytes:
    """An element of EBML: its name, its length in eight bytes, its content."""
    return name.to_bytes((name.bit_length() + 7) // 8) + (len(content) | 1 << 56).to_bytes(8) + content


def track(number: int, kind: int, codec: bytes, title: bytes, *others: bytes) -> bytes:
    head = [(0xD7, bytes([number])), (0x73C5, bytes([number])), (0x83, bytes([kind])), (0x86, codec)]
    return element(0xAE, b"".join([*(element(*each) for each in [*head, (0x536E, title)]), *others]))


def block(number: int, stamp_us: int, content: bytes, *, lacing: int = 0) -> bytes:
    """A cluster of one block, a microsecond a tick."""
    held = bytes([0x80 | number]) + bytes([0, 0, 0x80 | lacing]) + content
    return element(0x1F43B675, element(0xE7, stamp_us.to_bytes(8)) + element(0xA3, held))


def inertial(path: Path, offset_us: int = 300_000) -> Path:
    """A recording as k4arecorder writes it, by the Matroska specification: eight inertial samples a block.

    Times of samples are those of the device, times of blocks begin with the recording.
    """
    size = struct.pack("<IiiHH4sIiiII", 40, 320, 288, 1, 16, b"b16g", 2 * 320 * 288, 0, 0, 0, 0)
    video = element(0xE0, element(0xB0, (320).to_bytes(2)) + element(0xBA, (288).to_bytes(2)))
    tracks = track(1, 1, b"V_MS/VFW/FOURCC", b"DEPTH", video, element(0x63A2, size))
    tracks += track(2, 17, b"S_K4A/IMU", b"IMU")
    tag = element(0x45A3, b"K4A_START_OFFSET_NS") + element(0x4487, str(1000 * offset_us).encode())
    blocks, waiting = [], []
    for number, (seconds, force, rate) in enumerate(samples()):
        stamp = round(seconds * 1e9) + 1000 * offset_us
        waiting.append(struct.pack("<Q3fQ3f", stamp, *force, stamp, *rate))
        if len(waiting) == 8:
            first = round(1e6 * (seconds - 7 / 200))
            blocks.append(block(2, first, b"\x07" + b"".join(waiting), lacing=4))
            waiting = []
        if number % 10 == 5:
            blocks.append(block(1, round(seconds * 1e6) + 1500, depth(0).astype(">u2").tobytes()))
    header = element(0x4282, b"matroska") + element(0x4287, b"\x04") + element(0x4285, b"\x02")
    info = element(0x1549A966, element(0x2AD7B1, (1000).to_bytes(2)))
    whole = info + element(0x1654AE6B, tracks) + element(0x1254C367, element(0x7373, element(0x67C8, tag)))
    path.write_bytes(element(0x1A45DFA3, header) + element(0x18538067, whole + b"".join(blocks)))
    place = {"Rotation": R_SENSOR_IMU.T.ravel().tolist(), "Translation": [0, 0, 0]}
    said = json.loads(json.dumps(CALIBRATION))
    said["CalibrationInformation"]["InertialSensors"] = [
        {"SensorType": f"CALIBRATION_InertialSensorType_{kind}", "Rt": place}
        for kind in ("Gyro", "Accelerometer")
    ]
    path.with_name("calibration.json").write_text(json.dumps(said))
    return path


def test_inertial_samples_tell_turns_and_up(tmp_path: Path) -> None:
    pytest.importorskip("av")
    dataset = open_dataset(inertial(tmp_path / "a.mkv"), posed=False)
    frames = [dataset.frame(index) for index in range(len(dataset))]
    assert len(frames) == round(END_S * 20)
    assert_known((frame.timestamp_ns / 1e9 - 0.3, frame.attitude) for frame in frames)
    at_rest = next(
        index for index in range(len(dataset)) if dataset.timestamps_ns[index] > (0.2 + STILL_S) * 1e9
    )
    assert attitude(0) @ dataset.frame(at_rest).specific_force == pytest.approx((0, 0, 9.81), abs=0.01)


def test_a_real_recording_tells_its_up(data: Callable[[str], Path]) -> None:
    """The camera stood upright."""
    pytest.importorskip("av")
    dataset = open_dataset(data(SAMPLE), posed=False)
    gyroscope, accelerometer = dataset._gyroscope, dataset._accelerometer
    assert len(gyroscope.table()) == 1
    x, y, z = accelerometer.around(336_277_000)
    assert np.hypot(np.hypot(x, y), z) == pytest.approx(9.81, abs=0.1)
    assert -y > 9.5
