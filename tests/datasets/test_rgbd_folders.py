# SPDX-License-Identifier: MIT
"""RGB-D recordings: real geometry, and each way a folder can be broken."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from geometry_checks import warp_residual
from small_recordings import POSE, ROW, hololens, redwood, seven_scenes

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import TUM, HoloLens, Redwood, SevenScenes, open_dataset
from tsfusion.evaluation.view_prediction import points_camera
from tsfusion.geometry.keyframe import Intrinsics


@pytest.mark.parametrize(
    ("name", "i", "j", "bound"),
    [
        ("7scenes/redkitchen", 0, 2, 0.008),
        ("7scenes/redkitchen", 10, 21, 0.018),
        ("3dmatch", 0, 2, 0.025),
        ("hololens", 0, 4, 0.006),
        ("hololens", 20, 24, 0.012),
        ("redwood_livingroom1", 0, 10, 0.0016),
        ("redwood_livingroom1", 2, 52, 0.005),
        ("open3d_rgbd", 0, 4, 0.007),
    ],
)
def test_depth_of_one_view_lands_on_the_other(data, name, i, j, bound):
    dataset = open_dataset(data(name), color=False)
    a, b = dataset[i], dataset[j]
    residual = warp_residual(a, b)
    inverse = warp_residual(a, b, T_b_a=b.T_world_camera @ np.linalg.inv(a.T_world_camera))
    assert residual < bound
    assert inverse > 1.7 * residual


def test_icl_nuim_has_a_negative_fy_and_5000_units_a_metre(data):
    dataset = TUM(data("icl_nuim_tum"))
    a, b = dataset[0], dataset[2]
    assert dataset.intrinsics == Intrinsics(481.2, -480.0, 319.5, 239.5)
    assert warp_residual(a, b) < 0.0008
    assert 2 < np.median(points_camera(a)[:, 2]) < 6
    upright = TUM(data("icl_nuim_tum"), intrinsics=Intrinsics(481.2, 480.0, 319.5, 239.5))
    assert warp_residual(upright[0], upright[2]) > 0.0015


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


def _break(name: str, text: str | None):
    def change(root: Path) -> None:
        (root / name).unlink() if text is None else (root / name).write_text(text)

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (_break("frame-000001.depth.png", None), r"frame-000001\.depth\.png is missing"),
        (
            _break("frame-000001.color.png", None),
            r"frame-000001\.color\.png is missing; expected a colour image",
        ),
        (
            _break("frame-000001.pose.txt", POSE.replace("0.5", "nan")),
            r"frame-000001\.pose\.txt:1: not finite",
        ),
        (
            _break("frame-000001.pose.txt", POSE.replace("0.5", "0.5x")),
            r"pose\.txt:1: could not convert .*0\.5x",
        ),
        (
            _break("frame-000001.pose.txt", "1 0 0\n"),
            r"pose\.txt:1: 3 numbers, expected 4: a 4×4 camera-to-world",
        ),
        (_break("frame-000001.pose.txt", "1 0 0 0\n" * 3), r"must hold 4 rows of 4 numbers, got 3"),
        (_break("frame-000001.pose.txt", ""), r"frame-000001\.pose\.txt is empty; expected a 4×4"),
        (
            _break("frame-000001.pose.txt", POSE.replace("1 0 0 0.5", "2 0 0 0.5")),
            r"pose\.txt: T_world_camera must",
        ),
        (_break("camera-intrinsics.txt", "1 2\n"), r"camera-intrinsics\.txt:1: 2 numbers, expected 3"),
        (
            _break("camera-intrinsics.txt", "0 0 4\n0 5 3\n0 0 1\n"),
            r"camera-intrinsics\.txt: intrinsics must be finite",
        ),
        (_break("frame-000001.depth.png", ""), r"frame-000001\.depth\.png cannot be decoded"),
    ],
)
def test_a_broken_seven_scenes_folder_is_one_clear_line(tmp_path, change, match):
    seven_scenes(tmp_path)
    change(tmp_path)
    with pytest.raises(DatasetError, match=match) as caught:
        list(SevenScenes(tmp_path))
    assert "\n" not in str(caught.value)


def test_depth_saved_as_eight_bits_or_colour_of_another_size_is_refused(tmp_path):
    seven_scenes(tmp_path)
    cv2.imwrite(str(tmp_path / "frame-000000.depth.png"), np.ones((6, 8), np.uint8))
    cv2.imwrite(str(tmp_path / "frame-000001.color.png"), np.ones((3, 4, 3), np.uint8))
    dataset = SevenScenes(tmp_path)
    with pytest.raises(DatasetError, match=r"must hold one 16-bit channel, got .* uint8"):
        dataset[0]
    with pytest.raises(DatasetError, match="is 4×3, its depth image 8×6; expected equal sizes"):
        dataset[1]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (_break("poses.txt", (ROW + "\n") * 2), r"poses\.txt has 2 poses for 3 depth images"),
        (
            _break("poses.txt", ROW + "\n" + ROW.replace("0.5", "inf") + "\n" + ROW),
            r"poses\.txt:2: not finite",
        ),
        (_break("images/00001.png", None), r"00001\.png or \.jpg is missing, but .*depth"),
        (_break("K.txt", None), r"K\.txt is missing; expected a 3×3 camera matrix"),
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
