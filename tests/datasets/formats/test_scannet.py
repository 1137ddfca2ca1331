# SPDX-License-Identifier: MIT
"""ScanNet: an exported scene of the synthetic room is read back."""

import numpy as np
import pytest
from small_recordings import one_line, put
from written_recordings import check, matrix, scannet, views

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import ScanNet, open_dataset


@pytest.mark.parametrize("frames25k", [False, True])
def test_scannet_is_read_back(tmp_path, frames25k):
    dataset = open_dataset(scannet(tmp_path / "scene0000_00", frames25k=frames25k))
    assert isinstance(dataset, ScanNet)
    assert dataset.name == "ScanNet scene0000_00"
    check(dataset, views())


def test_scannet_frames_that_the_tracker_lost_have_no_pose(tmp_path):
    root = scannet(tmp_path, lost=(1,))
    (root / "pose" / "21.txt").unlink()
    posed, all_ = ScanNet(root), ScanNet(root, posed=False)
    assert (len(posed), posed.skipped) == (2, {"without a pose": 2})
    assert (len(all_), all_.skipped) == (4, {})
    assert [all_.pose(index) is None for index in range(4)] == [False, True, False, True]
    np.testing.assert_array_equal(posed.frame(1).depth, all_.frame(2).depth)
    with pytest.raises(DatasetError, match=r"frame 1 of ScanNet .* has no pose; `tsfusion scan"):
        all_[1]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            put("intrinsic/intrinsic_depth.txt", None),
            r"intrinsic_depth\.txt is missing; expected color/N\.jpg",
        ),
        (put("intrinsic/intrinsic_depth.txt", "1 0 0\n"), r"must hold a 4×4 or 3×3 camera matrix, got 1×3"),
        (put("pose/7.txt", "1 0 0 0\n"), r"pose/7\.txt must hold 4 rows of 4 numbers, got 1"),
        (put("pose/7.txt", matrix(np.eye(4)).replace("1.0", "2.0")), r"pose/7\.txt: T_world_camera must"),
        (put("color/7.jpg", None), r"color/7\.png or \.jpg is missing, but .*depth/7\.png is there"),
        (put("color/7.jpg", ""), r"color/7\.jpg cannot be decoded"),
        (put("depth/0.png", None), r"holds no usable frames"),
    ],
)
def test_a_broken_scannet_scene_is_one_clear_line(tmp_path, change, match):
    scannet(tmp_path, count=2)
    change(tmp_path)
    if match == r"holds no usable frames":
        (tmp_path / "depth" / "7.png").unlink()
    one_line(lambda: list(ScanNet(tmp_path)), match)
