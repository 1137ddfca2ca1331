# SPDX-License-Identifier: MIT
"""Frames that cannot be read, and poses that are none, among many good ones: left out, counted, said once."""

import logging

import cv2
import numpy as np
import pytest
from support.small_recordings import one_line, seven_scenes

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import SevenScenes, open_dataset, select
from tsfusion.datasets.dataset import UnreadableFrame, UnreadableRecording
from tsfusion.datasets.readers import check_byte_order
from tsfusion.datasets.scan_files import read_scan
from tsfusion.datasets.trajectory_files import read_tum

STEM = "frame-000002"
IDENTITY = "0 0 0 0 0 0 1"


def _cut(file):
    file.write_bytes(file.read_bytes()[:-20])


def test_the_first_broken_frame_is_said_once_and_again_read_counts_once(tmp_path, caplog):
    _cut(seven_scenes(tmp_path, count=6) / f"{STEM}.depth.png")
    part = select(SevenScenes(tmp_path), stride=2)
    with caplog.at_level(logging.WARNING):
        assert [len(list(part)), len(list(part))] == [2, 2]
    assert part.skipped == {"unreadable": 1}
    (line,) = caplog.messages
    assert "frame 2 of 7-Scenes" in line
    assert f"{STEM}.depth.png cannot be decoded" in line
    with pytest.raises(UnreadableFrame, match="cannot be decoded"):
        part[1]


def test_a_recording_of_which_most_is_broken_is_an_error_with_the_cause(tmp_path):
    seven_scenes(tmp_path, count=6)
    for index in range(1, 5):
        _cut(tmp_path / f"frame-{index:06d}.color.png")
    with pytest.raises(UnreadableRecording, match=r"frame-000001\.color\.png .*; 4 of 6 frames of 7-Scenes"):
        list(SevenScenes(tmp_path))
    for index in range(1, 5):
        (tmp_path / f"frame-{index:06d}.pose.txt").write_text("nan\n")
    with pytest.raises(DatasetError, match=r"frame-000001\.pose\.txt:1: "):
        SevenScenes(tmp_path)


def test_nothing_is_interpolated_across_a_broken_pose(tmp_path):
    lines = [f"{k / 10:.1f} {k} 0 0 0 0 0 1" for k in range(6)]
    lines[3] = "0.3 nan 0 0 0 0 0 1"
    (tmp_path / "t.txt").write_text("\n".join(lines) + "\n")
    found = read_tum(tmp_path / "t.txt")
    at = [found.at(round(ms * 1e6), max_gap_ns=10**9) for ms in (150, 200, 250, 300, 350, 400, 450)]
    assert [None if T is None else round(float(T[0, 3]), 6) for T in at] == [1.5, 2, None, None, None, 4, 4.5]


def test_two_poses_at_one_time_are_refused_where_they_differ(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text(f"1 {IDENTITY}\n2 {IDENTITY}\n2 {IDENTITY}\n3 {IDENTITY}\n")
    assert read_tum(path).timestamps_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9]
    path.write_text(f"1 {IDENTITY}\n2 {IDENTITY}\n2 0.4 0 0 0 0 0 1\n3 {IDENTITY}\n")
    one_line(lambda: read_tum(path), r"two poses at one time, 1 time, the first at 2\.000000 s: .* 0\.400 m")


def test_the_ids_of_rtabmap_are_read(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text(f"#timestamp x y z qx qy qz qw id\n1 {IDENTITY} 1\n2 1 0 0 0 0 0 1 2\n")
    assert read_tum(path).translations[:, 0].tolist() == [0, 1]


def test_exchanged_bytes_of_depth_are_named():
    rows, columns = np.mgrid[:60, :80]
    depth = (1500 + 3 * columns + rows).astype(np.uint16)
    check_byte_order(depth, "depth.png")
    check_byte_order((depth * 256).astype(np.uint16), "coarse.png")  # multiples of 256, by any order
    with pytest.raises(DatasetError, match=r"depth\.png: the two bytes of each depth value are exchanged"):
        check_byte_order(depth.byteswap(), "depth.png")


def test_a_recording_with_exchanged_bytes_of_depth_is_refused(tmp_path):
    root = seven_scenes(tmp_path, count=3, shape=(60, 80))
    rows, columns = np.mgrid[:60, :80]
    for path in root.glob("*.depth.png"):
        cv2.imwrite(str(path), (1500 + 3 * columns + rows).astype(np.uint16).byteswap())
    with pytest.raises(UnreadableRecording, match="the two bytes of each depth value are exchanged"):
        list(open_dataset(root))


def test_names_of_files_may_have_separators_of_windows(tmp_path):
    (tmp_path / "depth").mkdir()
    for index in range(3):
        cv2.imwrite(str(tmp_path / "depth" / f"{index}.png"), np.full((6, 8), 900 + index, np.uint16))
    rows = "[0,1,0,0],[0,0,1,0],[0,0,0,1]"
    frames = [
        f'{{"depth_file_path": "depth\\\\{k}.png", "transform_matrix": [[1,0,0,{k}],{rows}]}}'
        for k in range(3)
    ]
    camera = '"fl_x": 5, "fl_y": 5, "cx": 4, "cy": 3, "w": 8, "h": 6'
    (tmp_path / "transforms.json").write_text(f'{{{camera}, "frames": [{",".join(frames)}]}}')
    assert [int(one.depth[0, 0]) for one in open_dataset(tmp_path)] == [900, 901, 902]


def test_fields_of_pcd_without_values_are_passed_over(tmp_path):
    pytest.importorskip("pypcd4")
    points = np.arange(12, dtype="<f4").reshape(4, 3)
    head = (
        "VERSION 0.7\nFIELDS x y normal z\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 0 1\nWIDTH 4\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 4\nDATA binary\n"
    )
    (tmp_path / "a.pcd").write_bytes(head.encode() + points.tobytes())
    assert (read_scan(tmp_path / "a.pcd").points == points).all()


def test_a_folder_without_depth_is_refused_with_or_without_poses(tmp_path):
    for name in ("depth", "color"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.jpg"), np.zeros((6, 8, 3), np.uint8))
    poses = tmp_path / "poses.txt"
    poses.write_text(f"1 {IDENTITY}\n")
    for options in ({"posed": False}, {"trajectory": poses}):
        one_line(
            lambda options=options: open_dataset(tmp_path, **options), "no usable frames; expected depth"
        )
