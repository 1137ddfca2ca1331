# SPDX-License-Identifier: MIT
"""Packets of LiDARs: scans with times and no poses, or one line that says what is missing."""

import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_recordings import one_line

from tsfusion.core.errors import MissingDependency
from tsfusion.datasets import find, open_dataset
from tsfusion.datasets.dataset import NoPoses

VELODYNE = "velodyne_pcap/sample_velodyne_vlp16_gps.pcap"
OUSTER = ("OS-0-128-U1_v2.3.0_1024x10.pcap", "OS-1-128_v2.3.0_1024x10_lb_n3.osf", "512x10_raw.bag")


def capture(path: Path, sizes: list[int], magic: int = 0xA1B2C3D4) -> Path:
    """A capture of UDP packets of zeros; a size is that of a record."""
    records = b"".join(
        struct.pack("<4I", index, 0, size, size) + bytes(size) for index, size in enumerate(sizes)
    )
    path.write_bytes(struct.pack("<IHHiIII", magic, 2, 4, 0, 0, 65535, 1) + records)
    return path


def test_velodynes_packets_are_scans_with_times(data: Callable[[str], Path]) -> None:
    pytest.importorskip("velodyne_decoder")
    path = data(VELODYNE)
    assert (find(path).layout.name, find(path.parent).layout.name) == ("LiDAR packets", "LiDAR packets")
    with pytest.raises(NoPoses, match=r"has no poses; `tsfusion scan PATH` finds poses by itself"):
        open_dataset(path)
    dataset = open_dataset(path, posed=False)
    frames = [dataset.frame(index) for index in range(len(dataset))]
    assert [len(frame.points) for frame in frames] == [18790, 18701, 18678, 17317]
    assert np.ptp(frames[1].point_times_s) == pytest.approx(0.1, abs=0.005)
    for index in (2, 0, 3):  # in any order
        np.testing.assert_array_equal(dataset.frame(index).points, frames[index].points)
    ranges = np.linalg.norm(frames[0].points, axis=1)
    assert 1 < np.median(ranges) < 30
    assert np.diff(dataset.timestamps_ns).min() > 8e7


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # the SDK leaves bags open
@pytest.mark.parametrize("name", OUSTER)
def test_an_ousters_packets_are_scans_with_times(data: Callable[[str], Path], name: str) -> None:
    pytest.importorskip("ouster.sdk")
    dataset = open_dataset(data(f"ouster_packets/{name}"), posed=False)
    frame = dataset.frame(0)
    assert len(frame.points) in (128 * 1024, 128 * 512)
    ranges = np.linalg.norm(frame.points, axis=1)
    assert 0.2 < np.nanmedian(ranges) < 30
    assert np.ptp(frame.point_times_s) == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(("file", "module", "said"), [
    (VELODYNE, "velodyne_decoder", r"need velodyne-decoder: pip install '.\[velodyne\]'"),
    ("ouster_packets/" + OUSTER[0], "ouster.sdk", "pip install --no-deps ouster-sdk; without it"),
])  # fmt: skip
def test_a_library_that_is_missing_is_named(
    data: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, file: str, module: str, said: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependency, match=said):
        open_dataset(data(file))


def test_other_packets_and_damaged_captures_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    path = capture(tmp_path / "other.pcap", [900] * 3)
    one_line(
        lambda: open_dataset(path), "other.pcap has no packets of a Velodyne, and an Ouster's need the sensor"
    )
    (tmp_path / "empty.pcap").write_bytes(b"")
    one_line(lambda: open_dataset(tmp_path / "empty.pcap"), "has no packets of a Velodyne")
    (tmp_path / "wireshark.pcapng").write_bytes(b"\n\r\r\n\x1c\0\0\0\x4d\x3c\x2b\x1a" + bytes(16))
    one_line(lambda: open_dataset(tmp_path / "wireshark.pcapng"), "write it as pcap first: editcap -F pcap")
    path = capture(tmp_path / "zeros.pcap", [1248] * 5)
    one_line(lambda: open_dataset(path), "zeros.pcap (cannot be read|holds no usable frames)")


def test_a_cut_capture_has_the_scans_before_the_cut(data: Callable[[str], Path], tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    content = data(VELODYNE).read_bytes()
    (tmp_path / "cut.pcap").write_bytes(content[: len(content) // 2 + 7])
    assert 1 <= len(open_dataset(tmp_path / "cut.pcap", posed=False)) <= 3


def test_a_bag_of_packets_names_the_cure(data: Callable[[str], Path]) -> None:
    pytest.importorskip("rosbags")
    path = data("ros2_lidar_packets/vlp16")
    one_line(lambda: open_dataset(path), "its driver makes PointCloud2 of them, record that topic")
