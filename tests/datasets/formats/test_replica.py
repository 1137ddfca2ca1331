# SPDX-License-Identifier: MIT
"""Replica: a scene of the synthetic room is read back."""

import json
from pathlib import Path

import numpy as np
import pytest
import written_recordings
from small_recordings import one_line, put
from written_recordings import check, matrix, replica, views

from tsfusion.datasets import Replica, open_dataset
from tsfusion.evaluation.view_prediction import depth_metres
from tsfusion.geometry.keyframe import Intrinsics


def replica_with_camera(root: Path, **changed: object) -> Path:
    K = views(1)[0].intrinsics
    camera = {"w": 160, "h": 120, "fx": K.fx, "fy": K.fy, "cx": K.cx, "cy": K.cy, "scale": 6553.5}
    root.mkdir()
    (root / "cam_params.json").write_text(json.dumps({"camera": {**camera, **changed}}))
    return replica(root / "room0")


def test_replica_is_read_back(tmp_path):
    dataset = open_dataset(replica_with_camera(tmp_path / "Replica"))
    assert isinstance(dataset, Replica)
    check(dataset, views(), depth_m=0.0002)
    assert open_dataset(tmp_path / "Replica").name == "Replica room0"


def test_replica_without_its_camera_file_has_nice_slams_camera(tmp_path):
    root = tmp_path / "room0"
    written_recordings.write(root / "results" / "depth000003.png", np.full((68, 120), 6554, np.uint16))
    (root / "traj.txt").write_text("\n".join(" ".join(matrix(np.eye(4) * 1.0).split()) for _ in range(4)))
    dataset = Replica(root)
    assert dataset.intrinsics == Intrinsics(600.0, 600.0, 599.5, 339.5).scaled(0.1)
    assert depth_metres(dataset[0])[0, 0] == pytest.approx(1, abs=1e-3)
    assert dataset[0].color is None
    written_recordings.write(root / "results" / "depth000004.png", np.full((68, 120), 6554, np.uint16))
    assert Replica(root).skipped == {"without a pose": 1}
    assert len(Replica(root, posed=False)) == 2


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (put("room0/traj.txt", None), r"traj\.txt is missing; expected 16 numbers a line; `tsfusion scan"),
        (put("room0/traj.txt", "1 2 3\n"), r"traj\.txt:1: 3 numbers, expected 16"),
        (put("cam_params.json", "{}"), r"cam_params\.json must hold camera: w, h, fx.*; KeyError: 'camera'"),
        (put("room0/results/frame000001.jpg", None), r"frame000001\.jpg is missing, but .*depth000001\.png"),
        (put("cam_params.json", None), r"depth000000\.png is 160×120, its camera 1200×680"),
    ],
)
def test_a_broken_replica_scene_is_one_clear_line(tmp_path, change, match):
    replica_with_camera(tmp_path / "Replica")
    change(tmp_path / "Replica")
    one_line(lambda: list(Replica(tmp_path / "Replica" / "room0")), match)
