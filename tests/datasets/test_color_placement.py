# SPDX-License-Identifier: MIT
"""Colour of another time is found by edges: paired anew, and moved onto the depth by a tracker."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.evaluation.examined_scenes import furnished_room
from tsfusion.datasets import Synthetic, describe, open_dataset
from tsfusion.datasets.color_placement import color_placement
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.trajectory import quaternion
from tsfusion.scanner.localization.localizer import TrackedPose
from tsfusion.scanner.localization.rgbd.rgbd_tracker import RGBDLocalizer

SPEED = 3  # rendered frames between two recorded ones, 10 a second
COUNT = 36


@cache
def rendered(index: int) -> Frame:
    return room().frame(index)


@cache
def room() -> Synthetic:
    world = furnished_room(3)
    hand = world.paths["hand"]

    def between(index: int, count: int) -> se3.Transform:
        whole, part = divmod(index, SPEED)
        before, after = hand(whole, count), hand(whole + 1, count)
        return before @ se3.exp(part / SPEED * se3.log(se3.inverse(before) @ after))

    return Synthetic(replace(world, paths={"hand": between}), "kinect", count=SPEED * (COUNT + 8), seed=3)


def recorded(root: Path, late: int) -> Path:
    """A TUM folder whose colour comes `late` rendered frames late."""
    rows: dict[str, list[str]] = {"depth": [], "rgb": [], "groundtruth": []}
    for number in range(4, COUNT + 4):
        frame, stamp = rendered(SPEED * number), f"{number / 10:.6f}"
        images = {"depth": np.rint(frame.depth_m * 5000).clip(0, 65535).astype(np.uint16),
                  "rgb": rendered(SPEED * number - late).color}  # fmt: skip
        for kind, image in images.items():
            (root / kind).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(root / kind / f"{stamp}.png"), image)
            rows[kind].append(f"{stamp} {kind}/{stamp}.png")
        T = frame.T_world_camera
        rows["groundtruth"].append(" ".join(map(str, [stamp, *T[:3, 3], *quaternion(T[:3, :3])])))
    for kind, lines in rows.items():
        (root / f"{kind}.txt").write_text("\n".join(lines))
    K = frame.intrinsics
    (root / "K.txt").write_text(f"{K.fx} {K.fy} {K.cx} {K.cy}")
    return root


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize("frames", [1, -2])
def test_color_late_by_whole_frames_is_paired_anew(frames: int, posed: bool, tmp_path: Path) -> None:
    dataset = open_dataset(recorded(tmp_path / "late", frames * SPEED), posed=posed)
    way = "late" if frames > 0 else "early"
    assert f"colour {abs(frames)} frame{'s' * (abs(frames) > 1)} {way}, paired anew" in describe(dataset)
    for index in (5, 20):
        np.testing.assert_array_equal(dataset.frame(index).color, rendered(SPEED * (index + 4)).color)
    assert dataset.frame(-1 if frames > 0 else 0).color is None  # it is not in the recording


@pytest.mark.parametrize(
    ("first", "last", "scale", "right"),
    [(0, 80, 1.0, 20), (30, 60, 1.0, -20), (30, 60, 0.9, 32), (0, 30, 0.9, 32)],
)
def test_color_of_another_place_is_not_taken_for_late(
    first: int, last: int, scale: float, right: int
) -> None:
    """A steady turn moves edges aside as another camera does."""
    down = 0.75 * right if scale < 1 else 0.0
    moved = np.array([[scale, 0, right], [0, scale, down]], np.float32)
    shown = []
    for frame in map(rendered, range(first, last)):
        size = frame.color.shape[1::-1]
        color = cv2.warpAffine(frame.color, moved, size, borderMode=cv2.BORDER_REPLICATE)
        shown.append(replace(frame, color=color))
    place = color_placement(shown.__getitem__, len(shown))
    assert place is None or place.frames_late == 0


def test_color_on_time_stays_as_it_is(tmp_path: Path) -> None:
    dataset = open_dataset(recorded(tmp_path / "room", 0))
    assert dataset.color_place is None
    np.testing.assert_array_equal(dataset.frame(3).color, rendered(SPEED * 7).color)


def test_a_tracker_tells_the_motion_to_the_color() -> None:
    localizer, poses = RGBDLocalizer(), list[TrackedPose]()
    for number in range(4, COUNT):
        frame = replace(rendered(SPEED * number), color=rendered(SPEED * number - 1).color)
        found = localizer.track(replace(frame, timestamp_ns=number * 100_000_000))
        assert isinstance(found, TrackedPose)
        poses.append(found)
    assert poses[3].T_then_now is None  # not known yet
    moved = poses[-1].T_then_now
    assert moved is not None
    then, now = (rendered(SPEED * (COUNT - 1) - late).T_world_camera for late in (1, 0))
    assert se3.distance(se3.inverse(moved) @ se3.inverse(then) @ now) < 0.01


def test_color_stays_where_it_is_when_stamps_hardly_grow() -> None:
    """As those of a host that hands on two frames at once."""
    localizer = RGBDLocalizer()
    for number in range(4, COUNT):
        frame = replace(rendered(SPEED * number), color=rendered(SPEED * number - 1).color)
        stamp = number * 100_000_000 if number < COUNT - 1 else (number - 1) * 100_000_000 + 1
        found = localizer.track(replace(frame, timestamp_ns=stamp))
    assert isinstance(found, TrackedPose)
    assert found.color_delay_s
    assert found.T_then_now is None


@pytest.mark.parametrize("noise", [False, True])
def test_a_steady_turn_tells_of_no_delay(noise: bool) -> None:
    """Corners and planes do not move apart in it: errors of corners alone look like a delay of 70 ms."""
    localizer = RGBDLocalizer()
    circle = Synthetic("room", "kinect", path="circle", noise=noise, width=240)
    for index in range(len(circle)):
        found = localizer.track(circle.frame(index))
        assert isinstance(found, TrackedPose)
        assert found.color_delay_s == 0
        assert found.T_then_now is None
