# SPDX-License-Identifier: MIT
"""HoloLens and Redwood folders: poses, cameras and errors."""

import json
from pathlib import Path

import pytest
import written_recordings
from small_recordings import POSE, ROW, hololens, one_line, put, redwood
from written_recordings import check, matrix, millimetres, views

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import HoloLens, Redwood, open_dataset
from tsfusion.geometry.keyframe import Intrinsics


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (put("poses.txt", (ROW + "\n") * 2), r"poses\.txt has 2 poses for 3 depth images"),
        (put("poses.txt", ROW + "\n" + ROW.replace("0.5", "inf") + "\n" + ROW), r"poses\.txt:2: not finite"),
        (put("images/00001.png", None), r"00001\.png or \.jpg is missing, but .*depth"),
        (put("K.txt", None), r"K\.txt is missing; expected a 3×3 camera matrix"),
    ],
)
def test_a_broken_hololens_folder_is_one_clear_line(tmp_path, change, match):
    hololens(tmp_path / "h")
    assert [int(keyframe.depth[0, 0]) for keyframe in HoloLens(tmp_path / "h")] == [7, 8, 9]
    change(tmp_path / "h")
    with pytest.raises(DatasetError, match=match):
        list(HoloLens(tmp_path / "h"))


def test_redwood_poses_go_by_number_unless_there_are_as_many_images(tmp_path):
    fewer = Redwood(redwood(tmp_path / "fewer", [3, 5], list(range(10))))
    assert [keyframe.T_world_camera[0, 3] for keyframe in fewer] == [3, 5]
    shifted = Redwood(redwood(tmp_path / "shifted", [1, 2, 3], [0, 1, 2]))
    assert [keyframe.T_world_camera[0, 3] for keyframe in shifted] == [0, 1, 2]
    unposed = Redwood(redwood(tmp_path / "unposed", [0, 1, 2], [0, 1]))
    assert (len(unposed), unposed.skipped) == (2, {"without a pose": 1})
    with pytest.raises(DatasetError, match=r"holds no usable frames; expected .*\(3 without a pose\)"):
        Redwood(redwood(tmp_path / "none", [7, 8, 9], [0, 1]))


def test_redwood_reads_open3d_cameras(tmp_path):
    redwood(tmp_path, [0], [0])
    camera = {"width": 8, "height": 6, "intrinsic_matrix": [9, 0, 0, 0, 8, 0, 4, 3, 1]}
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps(camera))
    assert Redwood(tmp_path).intrinsics == Intrinsics(9, 8, 4, 3)
    (tmp_path / "camera_intrinsic.json").write_text("{}")
    with pytest.raises(DatasetError, match=r"camera_intrinsic\.json must be an Open3D camera"):
        Redwood(tmp_path)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("0 0 1\n" + POSE[:-8], r"trajectory\.log has 4 lines; expected five a pose"),
        ("0 x\n" + POSE, r"trajectory\.log:1: three integers expected before each matrix"),
        ("0 0 1\n" + POSE.replace("0.5", "nan"), r"trajectory\.log:2: not finite"),
        ("", r"trajectory\.log has 0 lines"),
    ],
)
def test_a_broken_redwood_trajectory_is_one_clear_line(tmp_path, text, match):
    redwood(tmp_path, [0], [0])
    (tmp_path / "trajectory.log").write_text(text)
    with pytest.raises(DatasetError, match=match):
        Redwood(tmp_path)


def redwood_room(root: Path, color: str, log: str, depth: str = "depth") -> Path:
    """Open3D's and Redwood's places for the same images and poses."""
    K = Intrinsics(525, 525, 319.5, 239.5)
    text = ""
    for number, view in enumerate(views()):
        written_recordings.write(root / depth / f"{number:05d}.png", millimetres(view))
        written_recordings.write(root / color / f"{number:05d}.jpg", view.color)
        text += f"{number}\t{number}\t{number + 1}\n{matrix(view.T_world_camera)}"
        K = view.intrinsics or K
    (root / log).parent.mkdir(exist_ok=True)
    (root / log).write_text(text)
    camera = {"width": 160, "height": 120, "intrinsic_matrix": [K.fx, 0, 0, 0, K.fy, 0, K.cx, K.cy, 1]}
    (root / "intrinsic.json").write_text(json.dumps(camera))
    return root


@pytest.mark.parametrize(
    ("color", "log", "depth"),
    [
        ("image", "trajectory.log", "depth"),
        ("color", "odometry.log", "depth"),
        ("rgb", "scene/trajectory.log", "depth"),
        ("color", "lounge_trajectory.log", "depth"),
        ("livingroom1-color", "livingroom1-traj.txt", "livingroom1-depth-clean"),
    ],
)
def test_redwoods_and_open3ds_places_are_known(tmp_path, color, log, depth):
    root = redwood_room(tmp_path / "scene1", color, log, depth)
    dataset = open_dataset(root)
    assert isinstance(dataset, Redwood)
    check(dataset, views())
    if log.endswith(".log"):
        check(open_dataset(root / log), views())


def test_a_log_that_is_given_beats_the_one_that_is_found(tmp_path):
    root = redwood_room(tmp_path, "image", "trajectory.log")
    lines = (root / "trajectory.log").read_text().splitlines()
    (root / "other.log").write_text("\n".join(lines[:10]) + "\n")
    for dataset in (open_dataset(root / "other.log"), open_dataset(root, poses="other.log")):
        assert (len(dataset), dataset.skipped) == (2, {"without a pose": 2})
    (root / "livingroom1-depth-clean").mkdir()
    (root / "depth").rename(root / "livingroom1-depth-simulated")
    one_line(lambda: Redwood(root), r"holds 2 depth folders \(livingroom1-depth-clean, .*simulated\)")
