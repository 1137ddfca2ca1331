# SPDX-License-Identifier: MIT
"""left/ and right/ as a recording: the frames of a watched folder, poses of a file, what is left out."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from small_recordings import Change, LeftOut, one_line, one_line_of, put, textured_pair

from tsfusion.datasets import open_dataset

DISPARITY = 8
ROW = "1 0 0 {} 0 1 0 0 0 0 1 0\n"


def pairs(root: Path, count: int = 4) -> Path:
    """Pairs of random texture on a plane at fx · baseline / disparity = 1.5 m."""
    for side in ("left", "right"):
        (root / side).mkdir(parents=True)
    rng = np.random.default_rng(3)
    for frame in range(count):
        for side, image in zip(("left", "right"), textured_pair(rng, (48, 160), DISPARITY), strict=True):
            cv2.imwrite(str(root / side / f"{frame:04d}.png"), image)
    (root / "K.txt").write_text("100 0 80\n0 100 24\n0 0 1\n")
    (root / "baseline.txt").write_text("0.12\n")
    return root


def test_poses_come_from_a_file(tmp_path: Path) -> None:
    root = pairs(tmp_path / "pairs")
    (tmp_path / "poses.txt").write_text("".join(ROW.format(x) for x in range(4)))
    one_line(lambda: open_dataset(root), r"has no poses; expected --trajectory FILE; `tsfusion scan")
    dataset = open_dataset(root, trajectory=tmp_path / "poses.txt", color=False)
    assert [keyframe.T_world_camera[0, 3] for keyframe in dataset] == [0, 1, 2, 3]
    seen = dataset[2]
    metres = seen.baseline_fx / (seen.disparity[seen.disparity > 0] * seen.disparity_scale)
    assert np.median(metres) == pytest.approx(100 * 0.12 / DISPARITY, rel=0.02)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda root: cv2.imwrite(str(root / "left" / "0001.png"), np.zeros((40, 160), np.uint8)),
         LeftOut(r"images of \(160, 48\) pixels, got \(160, 40\)", {"unreadable": 1})),
        (put("baseline.txt", None), r"has no baseline\.txt \(metres\)"),
        (put("baseline.txt", "120\n"), r"baseline\.txt must hold .*: are these millimetres\?"),
        (put("K.txt", None), r"is not known: no .*K\.txt.*; give --intrinsics"),
    ],
)  # fmt: skip
def test_a_broken_folder_is_one_clear_line(tmp_path: Path, change: Change, expected: str | LeftOut) -> None:
    change(pairs(tmp_path / "pairs"))
    (tmp_path / "poses.txt").write_text("".join(ROW.format(x) for x in range(4)))
    one_line_of(lambda: open_dataset(tmp_path / "pairs", trajectory=tmp_path / "poses.txt"), expected)
