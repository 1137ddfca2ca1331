# SPDX-License-Identifier: MIT
"""Folders of depth and colour images: 7-Scenes, ScanNet, Replica, HoloLens, Redwood."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from geometry_checks import warp_residual
from small_recordings import (
    POSE,
    ROW,
    UNPOSED,
    UNREAD,
    LeftOut,
    hololens,
    one_line,
    one_line_of,
    put,
    redwood,
    seven_scenes,
)
from written_recordings import check, matrix, millimetres, replica, scannet, views, write

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import HoloLens, Redwood, Replica, ScanNet, SevenScenes, open_dataset
from tsfusion.geometry.keyframe import Intrinsics, depth_metres

SECOND_POSE = "frame-000001.pose.txt"


# --- 7-Scenes ---


def test_seven_scenes_colour_is_read_in_either_format(data):
    jpg, png = SevenScenes(data("7scenes/redkitchen")), SevenScenes(data("7scenes/redkitchen_png"))
    for dataset in (jpg, png):
        assert dataset[0].color.shape == (480, 640, 3)
        assert dataset[0].depth.dtype == np.uint16
    assert jpg.timestamps_ns is None


def test_seven_scenes_masks_the_original_releases_invalid_depth(tmp_path):
    seven_scenes(tmp_path, 1)
    depth = np.full((6, 8), 65535, np.uint16)
    depth[2, 3] = 1234
    cv2.imwrite(str(tmp_path / "frame-000000.depth.png"), depth)
    assert SevenScenes(tmp_path)[0].depth.sum() == 1234


def test_a_scene_is_all_its_sequences(tmp_path):
    seven_scenes(tmp_path / "seq-01", 2)
    seven_scenes(tmp_path / "seq-02", 3)
    for sequence in ("seq-01", "seq-02"):
        (tmp_path / sequence / "camera-intrinsics.txt").unlink()
    (tmp_path / "camera-intrinsics.txt").write_text("500 0 4\n0 501 3\n0 0 1\n")
    scene = SevenScenes(tmp_path)
    assert len(scene) == 5
    assert scene.intrinsics == Intrinsics(500, 501, 4, 3)
    assert len(SevenScenes(tmp_path / "seq-02")) == 3
    assert SevenScenes(tmp_path / "seq-02").intrinsics.fy == 501


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        (
            SECOND_POSE,
            POSE.replace("0.5", "0.5x"),
            LeftOut(r"pose\.txt:1: could not convert .*0\.5x", UNPOSED),
        ),
        (
            SECOND_POSE,
            "1 0 0\n",
            LeftOut(r"pose\.txt:1: 3 numbers, expected 4: a 4×4 camera-to-world", UNPOSED),
        ),
        (SECOND_POSE, "1 0 0 0\n" * 3, LeftOut(r"must hold 4 rows of 4 numbers, got 3", UNPOSED)),
        (SECOND_POSE, "", LeftOut(r"frame-000001\.pose\.txt is empty; expected a 4×4", UNPOSED)),
        (
            SECOND_POSE,
            POSE.replace("1 0 0 0.5", "2 0 0 0.5"),
            LeftOut(r"pose\.txt: T_world_camera must", UNPOSED),
        ),
        ("camera-intrinsics.txt", "1 2\n", r"camera-intrinsics\.txt: 2 numbers; expected .* 3×3 matrix"),
        ("camera-intrinsics.txt", "0 0 4\n0 5 3\n0 0 1\n", r"intrinsics\.txt: intrinsics must be finite"),
    ],
)
def test_a_broken_seven_scenes_folder_is_one_clear_line(tmp_path, name, content, match):
    put(name, content)(seven_scenes(tmp_path))
    one_line_of(lambda: SevenScenes(tmp_path), match)


def test_depth_saved_as_eight_bits_or_colour_of_another_size_is_refused(tmp_path):
    seven_scenes(tmp_path)
    for frame in range(3):
        cv2.imwrite(str(tmp_path / f"frame-{frame:06d}.depth.png"), np.ones((6, 8), np.uint8))
    cv2.imwrite(str(tmp_path / "frame-000001.color.png"), np.ones((3, 4, 3), np.uint8))
    with pytest.raises(DatasetError, match=r"must hold one 16-bit channel or floats, got .* 8 bits"):
        SevenScenes(tmp_path)
    for frame in range(3):
        cv2.imwrite(str(tmp_path / f"frame-{frame:06d}.depth.png"), np.ones((6, 8), np.uint16))
    dataset = SevenScenes(tmp_path)
    with pytest.raises(DatasetError, match=r"is 4×3, its depth image 8×6; expected equal .*color=false"):
        dataset[1]


# --- ScanNet ---


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
            "of these 160×120 images is not known",
        ),
        (put("intrinsic/intrinsic_depth.txt", "1 0 0\n"), r"depth\.txt: 3 numbers; expected"),
        (put("pose/7.txt", "1 0 0 0\n"),
         LeftOut(r"pose/7\.txt must hold 4 rows of 4 numbers, got 1", UNPOSED)),
        (put("pose/7.txt", matrix(np.eye(4)).replace("1.0", "2.0")),
         LeftOut(r"pose/7\.txt: T_world_camera must", UNPOSED)),
        (put("depth/0.png", None), r"holds no usable frames"),
        (put("intrinsic/intrinsic_color.txt", "1170 0 648\n0 1170 484\n0 0 1\n"),
         r"with cx 648, cy 484 is of images of another size"),
    ],
)  # fmt: skip
def test_a_broken_scannet_scene_is_one_clear_line(tmp_path, change, match):
    scannet(tmp_path, count=2)
    change(tmp_path)
    if match == r"holds no usable frames":
        (tmp_path / "depth" / "7.png").unlink()
    one_line_of(lambda: ScanNet(tmp_path), match)


# --- Replica ---


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
    write(root / "results" / "depth000003.png", np.full((680, 1200), 6554, np.uint16))
    (root / "traj.txt").write_text("\n".join(" ".join(matrix(np.eye(4) * 1.0).split()) for _ in range(4)))
    dataset = Replica(root)
    assert dataset.intrinsics == Intrinsics(600.0, 600.0, 599.5, 339.5)
    assert depth_metres(dataset[0])[0, 0] == pytest.approx(1, abs=1e-3)
    assert dataset[0].color is None
    write(root / "results" / "depth000004.png", np.full((680, 1200), 6554, np.uint16))
    assert Replica(root).skipped == {"without a pose": 1}
    assert len(Replica(root, posed=False)) == 2


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (put("room0/traj.txt", None), r"traj\.txt is missing; expected 16 numbers a line; `tsfusion scan"),
        (put("room0/traj.txt", "1 2 3\n"), r"traj\.txt:1: 3 numbers, expected 16"),
        (
            put("cam_params.json", "{}"),
            r"cam_params\.json must hold camera: w, h, fx.*; KeyError|holds no named",
        ),
        (
            put("cam_params.json", None),
            r"is not known \(that of NICE-SLAM's Replica is published for 1200×680",
        ),
    ],
)
def test_a_broken_replica_scene_is_one_clear_line(tmp_path, change, match):
    replica_with_camera(tmp_path / "Replica")
    change(tmp_path / "Replica")
    one_line_of(lambda: Replica(tmp_path / "Replica" / "room0"), match)


# --- HoloLens and Redwood ---


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (put("poses.txt", (ROW + "\n") * 2), r"poses\.txt has 2 poses for 3 depth images"),
        (put("images/00001.png", None), LeftOut(r"00001\.png is missing; expected a colour image", UNREAD)),
        (put("K.txt", None), r"is not known: no .*K\.txt.*; give --intrinsics"),
    ],
)
def test_a_broken_hololens_folder_is_one_clear_line(tmp_path, change, match):
    hololens(tmp_path / "h")
    assert [int(keyframe.depth[0, 0]) for keyframe in HoloLens(tmp_path / "h")] == [7, 8, 9]
    change(tmp_path / "h")
    one_line_of(lambda: HoloLens(tmp_path / "h"), match)


def test_redwood_poses_go_by_number_unless_there_are_as_many_images(tmp_path):
    fewer = Redwood(redwood(tmp_path / "fewer", [3, 5], list(range(10))))
    assert [keyframe.T_world_camera[0, 3] for keyframe in fewer] == [3, 5]
    shifted = Redwood(redwood(tmp_path / "shifted", [1, 2, 3], [0, 1, 2]))
    assert [keyframe.T_world_camera[0, 3] for keyframe in shifted] == [0, 1, 2]
    unposed = Redwood(redwood(tmp_path / "unposed", [0, 1, 2], [0, 1]))
    assert (len(unposed), unposed.skipped) == (2, {"without a pose": 1})
    with pytest.raises(DatasetError, match=r"holds no usable frames; expected .*\(3 without a pose\)"):
        Redwood(redwood(tmp_path / "none", [7, 8, 9], [0, 1]))


def test_a_pose_left_over_is_told(tmp_path, caplog):
    """Images numbered anew after one was lost would take the poses of others without a word."""
    Redwood(redwood(tmp_path / "cut", list(range(4)), list(range(40))))
    assert "left over" not in caplog.text
    Redwood(redwood(tmp_path / "lost", list(range(39)), list(range(40))))
    assert "40 poses for 39 depth images, each with the pose of its number: 1 left over" in caplog.text


def test_another_trajectory_gives_a_pose_for_each_image_of_any_layout(tmp_path):
    rows = tmp_path / "rows.txt"
    rows.write_text("".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for x in (7, 8, 9)))
    redwood(tmp_path / "redwood", [0, 1, 2], [0, 1, 2])
    hololens(tmp_path / "hololens")
    seven_scenes(tmp_path / "scenes")
    for root in (tmp_path / "redwood", tmp_path / "hololens", tmp_path / "scenes"):
        dataset = open_dataset(root, trajectory=rows)
        assert [keyframe.T_world_camera[0, 3] for keyframe in dataset] == [7, 8, 9], dataset.name
        one_line(lambda root=root: open_dataset(root, trajectory=tmp_path / "none.txt"), "none.txt")


@pytest.mark.parametrize(
    ("stems", "log", "expected"),
    [
        (range(12), [3, 1, 2, 0, *range(11, 3, -1)], list(range(12))),  # entries in another order
        ([*range(7), *range(8, 12)], [*range(3), *range(4, 12)], [0, 1, 2, 4, 5, 6, 8, 9, 10, 11]),  # holes
        ([0, 10, 20, 30], [3, 1, 2, 0], [0, 1, 2, 3]),  # numbered anew
        ([4, 9, 17, 31], [0, 10, 20, 30], [0, 10, 20, 30]),
        (range(0, 14, 2), range(7), list(range(7))),  # every second image, poses counted
        ([0, 1, 2, 4, 5, 6, 7], range(7), list(range(7))),  # one image and its pose taken out
        (range(7), range(0, 14, 2), list(range(0, 14, 2))),  # images counted
    ],
)
def test_as_many_poses_as_images_go_by_number_where_both_have_the_same(tmp_path, stems, log, expected):
    found = Redwood(redwood(tmp_path, list(stems), log))
    assert [keyframe.T_world_camera[0, 3] for keyframe in found] == expected


@pytest.mark.parametrize(
    "rename", [lambda n: f"frame_{n}", str, lambda n: f"{8 + 0.3 * n:.1f}", lambda n: f"h_{n:04x}"]
)
def test_images_come_in_the_order_of_their_numbers(tmp_path, rename):
    """9 before 10, as in names that are not padded with zeros."""
    root = hololens(tmp_path, 12)
    for image in [*root.glob("depth/*"), *root.glob("images/*")]:
        image.rename(image.with_stem(rename(int(image.stem))))
    assert [int(keyframe.depth[0, 0]) for keyframe in HoloLens(root)] == list(range(7, 19))


def test_scenes_come_in_the_order_of_their_numbers(tmp_path):
    for number in (2, 10, 1):
        seven_scenes(tmp_path / f"seq-{number}", 12)
        for file in (tmp_path / f"seq-{number}").glob("frame-*"):
            start, end = file.name.split(".", 1)
            file.rename(file.with_name(f"frame-{int(start[6:])}.{end}"))
    found = [int(keyframe.depth[0, 0]) for keyframe in SevenScenes(tmp_path)]
    assert found == [100 + frame for frame in range(12)] * 3


def test_redwood_reads_open3d_cameras(tmp_path):
    redwood(tmp_path, [0], [0])
    (tmp_path / "camera-intrinsics.txt").unlink()
    camera = {"width": 8, "height": 6, "intrinsic_matrix": [9, 0, 0, 0, 8, 0, 4, 3, 1]}
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps(camera))
    assert Redwood(tmp_path).intrinsics == Intrinsics(9, 8, 4, 3)
    (tmp_path / "camera_intrinsic.json").write_text("{}")
    with pytest.raises(DatasetError, match=r"camera_intrinsic\.json .*expected"):
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
        write(root / depth / f"{number:05d}.png", millimetres(view))
        write(root / color / f"{number:05d}.jpg", view.color)
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
        ("images", "trajectory.log", "depth"),
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


def test_a_folder_without_a_trajectory_names_the_one_of_another_layout(tmp_path):
    root = redwood_room(tmp_path, "image", "trajectory.log")
    (root / "trajectory.log").rename(root / "groundtruth.txt")
    with pytest.raises(
        DatasetError, match=r"has no trajectory; .*, or --trajectory .*/groundtruth\.txt names"
    ):
        Redwood(root)


@pytest.mark.parametrize(
    ("depth", "color"),
    [
        ("depth_{}", "color_{}"),
        ("{}-depth", "{}-rgb"),
        ("frame{}_Depth", "frame{}_image"),
        ("depth16_{}", "color_{}"),
        ("depth_raw_{}", "rgb_{}"),
        ("depth{}", "color{}"),
    ],
)
def test_depth_and_colour_in_one_folder(tmp_path, depth, color):
    root = redwood_room(tmp_path, "image", "trajectory.log")
    for number, file in enumerate(sorted((root / "depth").iterdir()), 9):  # 9, 10, …: by number, not by name
        file.rename(root / f"{depth.format(number)}.png")
    for number, file in enumerate(sorted((root / "image").iterdir()), 9):
        file.rename(root / f"{color.format(number)}.jpg")
    for name in ("depth", "image"):
        (root / name).rmdir()
    dataset = open_dataset(root)
    check(dataset, views())
    assert (dataset.timestamps_ns, dataset.uncolored) == (None, 0)
    check(open_dataset(root / "trajectory.log"), views())
    lines = (root / "trajectory.log").read_text().splitlines()
    (root / "trajectory.log").write_text("\n".join(lines[:10]).replace("0\t0\t1", "11\t11\t12") + "\n")
    by_number = open_dataset(root)
    assert (len(by_number), by_number.skipped) == (1, {"without a pose": 3})
    (root / "trajectory.log").write_text("1 2 x\n")
    assert len(open_dataset(root, posed=False)) == len(dataset), "a scan finds its own poses"
    (root / f"{color.format(9)}.jpg").unlink()
    assert open_dataset(root, posed=False).uncolored == 1


def test_depth_in_one_folder_is_one_series_of_16_bits(tmp_path):
    root = redwood_room(tmp_path / "room", "image", "trajectory.log")
    for place, name in (("depth", "Depth"), ("image", "Color")):
        for file in (root / place).iterdir():
            file.rename(root / f"{name}_{file.stem}{file.suffix.upper()}")
        (root / place).rmdir()
    for number in range(4):
        cv2.imwrite(str(root / f"depth_vis_{number}.png"), np.zeros((6, 8, 3), np.uint8))
        cv2.imwrite(str(root / f"depth_filled_{number}.png"), np.ones((6, 8), np.uint16))
    check(open_dataset(root), views())
    for number in range(2):
        cv2.imwrite(str(root / f"cam1_depth_{number}.png"), np.ones((6, 8), np.uint16))
        cv2.imwrite(str(root / f"cam1_rgb_{number}.png"), np.zeros((6, 8, 3), np.uint8))
    one_line(
        lambda: open_dataset(root), r"several series of depth images \(.*cam1_depth_0.*\); move the others"
    )
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for name in ("depth_1", "depth_2", "rgb_1", "rgb_2"):
        cv2.imwrite(str(pictures / f"{name}.png"), np.zeros((6, 8), np.uint8))
    one_line(lambda: open_dataset(pictures), "is in no layout known here")


def test_a_log_that_is_given_beats_the_one_that_is_found(tmp_path):
    root = redwood_room(tmp_path, "image", "trajectory.log")
    lines = (root / "trajectory.log").read_text().splitlines()
    (root / "other.log").write_text("\n".join(lines[:10]) + "\n")
    for dataset in (open_dataset(root / "other.log"), open_dataset(root, poses="other.log")):
        assert (len(dataset), dataset.skipped) == (2, {"without a pose": 2})
    (root / "livingroom1-depth-clean").mkdir()
    (root / "depth").rename(root / "livingroom1-depth-simulated")
    one_line(lambda: Redwood(root), r"holds 2 depth folders \(livingroom1-depth-clean, .*simulated\)")


# --- any of them ---


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
