# SPDX-License-Identifier: MIT
"""Captures of nerfstudio, instant-ngp and apps: axes, pixel centres, units, lenses, sizes."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import written_recordings
from geometry_checks import warp_residual
from small_recordings import UNPOSED, UNREAD, LeftOut, one_line, one_line_of, put
from written_recordings import check, fits_together, transforms, views

from tsfusion.datasets import Nerfstudio, open_dataset
from tsfusion.geometry.calibration import Camera
from tsfusion.geometry.keyframe import Intrinsics, depth_metres


def rewrite(root: Path, change: Callable[[dict], object]) -> None:
    capture = json.loads((root / "transforms.json").read_text())
    change(capture)
    (root / "transforms.json").write_text(json.dumps(capture))


@pytest.mark.parametrize("shrink", [1, 3])
def test_nerfstudio_is_read_back(tmp_path, shrink):
    dataset = open_dataset(transforms(tmp_path / "capture", shrink=shrink))
    assert isinstance(dataset, Nerfstudio)
    assert dataset.name == "nerfstudio capture"
    check(dataset, views())
    assert len(open_dataset(tmp_path / "capture" / "transforms.json")) == 4


def test_instant_ngps_keys_mean_the_same(tmp_path):
    """As NeRFCapture and instant-ngp's scripts write them: another name and unit, an angle for the focal."""
    root = transforms(tmp_path)

    def rename(capture: dict) -> None:
        capture["camera_angle_x"] = 2 * np.arctan(capture["w"] / 2 / capture["fl_x"])
        capture["integer_depth_scale"] = 10 / 65535
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
            del capture[key]
        for number, frame in enumerate(capture["frames"]):
            frame["depth_path"] = frame.pop("depth_file_path")
            units = np.rint(depth_metres(views()[number]) * 6553.5).astype(np.uint16)
            cv2.imwrite(str(root / frame["depth_path"]), units)

    rewrite(root, rename)
    check(Nerfstudio(root), views(), depth_m=0.0002)


def test_depth_as_arrays_and_a_camera_of_each_frame(tmp_path):
    root = transforms(tmp_path)

    def spread(capture: dict) -> None:
        capture["depth_unit_scale_factor"] = 1.0
        for key in ("fl_x", "fl_y", "cx", "cy"):
            value = capture.pop(key)
            for frame in capture["frames"]:
                frame[key] = value
        for number, frame in enumerate(capture["frames"]):
            frame["depth_file_path"] = f"depth/{number}.npy"
            np.save(root / frame["depth_file_path"], depth_metres(views()[number]))

    rewrite(root, spread)
    check(Nerfstudio(root), views(), depth_m=0.0001)


def test_poses_that_were_scaled_for_training_are_in_metres_again(tmp_path):
    def shrunk(capture: dict) -> None:
        capture["applied_scale"] = 0.25
        for frame in capture["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= 0.25

    rewrite(transforms(tmp_path), shrunk)
    check(Nerfstudio(tmp_path), views())


@pytest.mark.parametrize(
    "lens",
    [
        Camera(Intrinsics(180, 179, 78, 61), (120, 160), "radtan", (-0.4, 0.05, 0.002, -0.001)),
        Camera(Intrinsics(180, 179, 78, 61), (120, 160), "equidistant", (-0.2, -0.01, 0.004, -0.001)),
    ],
    ids=["radtan", "fisheye"],
)
def test_distorted_captures_are_undistorted(tmp_path, lens):
    dataset = Nerfstudio(transforms(tmp_path, lens=lens))
    frames = list(dataset)
    fits_together(frames[0], frames[1])
    view = views()[0]
    good = warp_residual(frames[0], view, T_b_a=np.eye(4))
    assert good < 0.003
    K = view.intrinsics
    seen = written_recordings.through_lens(view.color, K, Camera(frames[0].intrinsics, (120, 160)))
    assert written_recordings.shift(frames[0].color, seen) < 0.1
    rewrite(tmp_path, lambda capture: [capture.pop(f"k{i}") for i in (1, 2)])
    assert warp_residual(Nerfstudio(tmp_path)[0], view, T_b_a=np.eye(4)) > 2 * good


@pytest.mark.parametrize(
    ("kind", "named"),
    [
        ("equidistant", lambda c: [c.pop("camera_model", None), c.update(is_fisheye=True)]),  # instant-ngp's
        ("radtan", lambda c: c.update(camera_model="PINHOLE")),  # nerfstudio applies k1 to it, too
    ],
)
def test_a_lens_by_another_name_is_the_same(tmp_path, kind, named):
    lens = Camera(Intrinsics(180, 179, 78, 61), (120, 160), kind, (-0.2, -0.01, 0.004, -0.001))
    dataset = Nerfstudio(transforms(tmp_path, lens=lens))
    expected = dataset[0]
    rewrite(tmp_path, named)
    found = Nerfstudio(tmp_path)[0]
    np.testing.assert_array_equal(found.depth, expected.depth)
    np.testing.assert_array_equal(found.color, expected.color)
    assert found.intrinsics == expected.intrinsics


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda c: c.update(k4=0.3), r"frame 0: k4 is not 0, but the lens model OPENCV has none"),
        (lambda c: c.update(ftheta_p0=1.0), r"camera_model must be one of .*, got ftheta_p0"),
        (lambda c: [f.pop("depth_file_path") for f in c["frames"]],
         r"has 4 frames, none with depth_file_path or depth_path; expected depth images"),
        (lambda c: c.update(camera_model="EQUIRECTANGULAR"), r"camera_model must be one of PINHOLE"),
        (lambda c: c.update(k1="big"), r"frame 0: k1 must be a number, got 'big'"),
        (lambda c: c.update(fl_x=-3), r"frame 0: intrinsics must be"),
        (lambda c: c.pop("fl_x"), r"frame 0 has neither fl_x nor camera_angle_x"),
        (lambda c: c.update(w=200), r"frame 0: image 160×120, but camera 200×120"),
        (lambda c: c.update(integer_depth_scale=0), r"integer_depth_scale must be > 0, got 0"),
        (lambda c: c["frames"][1].update(transform_matrix=[[1, 2]]),
         LeftOut(r"frame 1: transform_matrix: ", UNPOSED)),
        (lambda c: c["frames"][1].update(transform_matrix=[[10**400, 0, 0, 0]]),
         LeftOut(r"frame 1: transform_matrix: int too large", UNPOSED)),
        (lambda c: c["frames"][1].update(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()),
         LeftOut(r"frame 1: transform_matrix: T_world_camera must", UNPOSED)),
        (lambda c: c["frames"][1].update(depth_file_path="gone.png"),
         LeftOut(r"gone\.png is missing", UNREAD)),
        (lambda c: c["frames"][1].update(depth_file_path="gone.npy"),
         LeftOut(r"gone\.npy is missing", UNREAD)),
        (lambda c: c["frames"][1].update(depth_file_path="images/00000.png"),
         LeftOut(r"must hold one 16", UNREAD)),
        (lambda c: c.update(frames=[]), r"has no list of frames"),
        (lambda c: c.update(w=10**400), r"frame 0: w must be a number"),
        (lambda c: [c.pop("fl_x"), c.update(camera_angle_x=0)], r"camera_angle_x must be radians"),
        (lambda c: [f.pop("transform_matrix") for f in c["frames"]], r"has no poses; expected transforms"),
    ],
)  # fmt: skip
def test_a_broken_capture_is_one_clear_line(tmp_path, change, match):
    rewrite(transforms(tmp_path), change)
    one_line_of(lambda: Nerfstudio(tmp_path), match)


def test_frames_without_depth_or_pose_are_counted(tmp_path):
    root = transforms(tmp_path)
    rewrite(root, lambda c: (c["frames"][0].pop("depth_file_path"), c["frames"][1].pop("transform_matrix")))
    assert Nerfstudio(root).skipped == {"without depth": 1, "without a pose": 1}
    dataset = Nerfstudio(root, posed=False)
    assert (len(dataset), dataset.skipped, dataset.pose(0)) == (3, {"without depth": 1}, None)
    put("transforms.json", "{")(root)
    one_line(lambda: Nerfstudio(root), r"transforms\.json cannot be read \(")


def test_angles_of_view_tell_the_focal_lengths(tmp_path):
    transforms(tmp_path)
    plain = Nerfstudio(tmp_path)[0].intrinsics

    def angles(capture):
        for axis, side in (("x", "w"), ("y", "h")):
            length = capture.pop(f"fl_{axis}") * (1 if axis == "x" else 2)
            capture[f"camera_angle_{axis}"] = 2 * np.arctan(capture[side] / 2 / length)

    rewrite(tmp_path, angles)
    found = Nerfstudio(tmp_path)[0].intrinsics
    assert found.fx == pytest.approx(plain.fx)
    assert found.fy == pytest.approx(2 * plain.fy)


def test_arrays_that_are_none_or_claim_too_much_are_one_clear_line(tmp_path):
    rewrite(transforms(tmp_path), lambda c: c["frames"][0].update(depth_file_path="depth.npy"))
    with (tmp_path / "depth.npy").open("wb") as file:
        np.savez(file, depth=np.ones((120, 160), np.float32))
    one_line(lambda: Nerfstudio(tmp_path)[0], r"depth\.npy cannot be read")
    with (tmp_path / "depth.npy").open("wb") as file:
        claimed = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)}
        np.lib.format.write_array_header_1_0(file, claimed)
    one_line(lambda: Nerfstudio(tmp_path)[0], r"depth\.npy cannot be read")


def test_a_file_of_brackets_is_one_clear_line(tmp_path):
    (tmp_path / "transforms.json").write_text("[" * 200_000)
    one_line(lambda: Nerfstudio(tmp_path), r"transforms\.json cannot be read")
