# SPDX-License-Identifier: MIT
"""Recordings of an Azure Kinect: depth, colour by its own camera, times; damage is named."""

import json
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
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
