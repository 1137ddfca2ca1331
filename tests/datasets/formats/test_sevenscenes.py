# SPDX-License-Identifier: MIT
"""7-Scenes: sequences, colour, invalid depth and errors."""

import cv2
import numpy as np
import pytest
from small_recordings import POSE, one_line, put, seven_scenes

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import SevenScenes
from tsfusion.geometry.keyframe import Intrinsics


def test_seven_scenes_colour_is_read_in_either_format(data):
    jpg, png = SevenScenes(data("7scenes/redkitchen")), SevenScenes(data("7scenes/redkitchen_png"))
    for dataset in (jpg, png):
        assert dataset[0].color.shape == (480, 640, 3)
        assert dataset[0].depth.dtype == np.uint16
    assert jpg.timestamps_ns is None


def test_seven_scenes_colour_is_registered_to_depth(data):
    place = data("7scenes/redkitchen")
    released, ours = (np.mean([_edges_met(dataset[i]) for i in range(0, 120, 20)]) for dataset in (
        SevenScenes(place, register=False), SevenScenes(place)
    ))  # fmt: skip
    assert ours > 1.6 * released


def _edges_met(keyframe) -> float:
    """Colour gradient under the near side of depth steps, in multiples of the image's mean."""
    z = cv2.medianBlur(keyframe.depth, 5).astype(float)
    edge = np.zeros(z.shape, bool)
    for shift in (3, -3):
        for axis in (0, 1):
            edge |= (z > 300) & (np.roll(z, shift, axis) > z + 150)
    edge[:8] = edge[-8:] = edge[:, :8] = edge[:, -8:] = False
    grey = cv2.GaussianBlur(cv2.cvtColor(keyframe.color, cv2.COLOR_BGR2GRAY), (0, 0), 1.2)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_64F, 1, 0), cv2.Sobel(grey, cv2.CV_64F, 0, 1))
    return float(gradient[edge].mean() / gradient.mean())


def test_seven_scenes_masks_the_original_releases_invalid_depth(tmp_path):
    seven_scenes(tmp_path, 1)
    depth = np.full((6, 8), 65535, np.uint16)
    depth[2, 3] = 1234
    cv2.imwrite(str(tmp_path / "frame-000000.depth.png"), depth)
    assert SevenScenes(tmp_path)[0].depth.sum() == 1234


def test_a_scene_is_all_its_sequences(tmp_path):
    seven_scenes(tmp_path / "seq-01", 2)
    seven_scenes(tmp_path / "seq-02", 3)
    (tmp_path / "camera-intrinsics.txt").write_text("500 0 4\n0 501 3\n0 0 1\n")
    scene = SevenScenes(tmp_path)
    assert len(scene) == 5
    assert scene.intrinsics == Intrinsics(500, 501, 4, 3)
    assert len(SevenScenes(tmp_path / "seq-02")) == 3
    assert SevenScenes(tmp_path / "seq-02").intrinsics.fy == 501


def test_frames_without_a_pose_are_skipped_and_counted(tmp_path):
    seven_scenes(tmp_path, 4)
    (tmp_path / "frame-000002.pose.txt").unlink()
    dataset = SevenScenes(tmp_path)
    assert [int(keyframe.depth[0, 0]) for keyframe in dataset] == [100, 101, 103]
    assert dataset.skipped == {"without a pose": 1}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (put("frame-000001.depth.png", None), r"frame-000001\.depth\.png is missing"),
        (
            put("frame-000001.color.png", None),
            r"frame-000001\.color\.png is missing; expected a colour image",
        ),
        (put("frame-000001.pose.txt", POSE.replace("0.5", "nan")), r"frame-000001\.pose\.txt:1: not finite"),
        (
            put("frame-000001.pose.txt", POSE.replace("0.5", "0.5x")),
            r"pose\.txt:1: could not convert .*0\.5x",
        ),
        (
            put("frame-000001.pose.txt", "1 0 0\n"),
            r"pose\.txt:1: 3 numbers, expected 4: a 4×4 camera-to-world",
        ),
        (put("frame-000001.pose.txt", "1 0 0 0\n" * 3), r"must hold 4 rows of 4 numbers, got 3"),
        (put("frame-000001.pose.txt", ""), r"frame-000001\.pose\.txt is empty; expected a 4×4"),
        (
            put("frame-000001.pose.txt", POSE.replace("1 0 0 0.5", "2 0 0 0.5")),
            r"pose\.txt: T_world_camera must",
        ),
        (put("camera-intrinsics.txt", "1 2\n"), r"camera-intrinsics\.txt:1: 2 numbers, expected 3"),
        (
            put("camera-intrinsics.txt", "0 0 4\n0 5 3\n0 0 1\n"),
            r"camera-intrinsics\.txt: intrinsics must be finite",
        ),
        (put("frame-000001.depth.png", ""), r"frame-000001\.depth\.png cannot be decoded"),
    ],
)
def test_a_broken_seven_scenes_folder_is_one_clear_line(tmp_path, change, match):
    seven_scenes(tmp_path)
    change(tmp_path)
    one_line(lambda: list(SevenScenes(tmp_path)), match)


def test_depth_saved_as_eight_bits_or_colour_of_another_size_is_refused(tmp_path):
    seven_scenes(tmp_path)
    cv2.imwrite(str(tmp_path / "frame-000000.depth.png"), np.ones((6, 8), np.uint8))
    cv2.imwrite(str(tmp_path / "frame-000001.color.png"), np.ones((3, 4, 3), np.uint8))
    dataset = SevenScenes(tmp_path)
    with pytest.raises(DatasetError, match=r"must hold one 16-bit channel, got .* uint8"):
        dataset[0]
    with pytest.raises(DatasetError, match="is 4×3, its depth image 8×6; expected equal sizes"):
        dataset[1]
