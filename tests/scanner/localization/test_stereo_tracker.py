# SPDX-License-Identifier: MIT
"""Following a stereo camera, and finding out that its pairs are badly rectified."""

import dataclasses
import logging
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.datasets import open_dataset
from tsfusion.datasets.dataset import frame_of
from tsfusion.datasets.worlds.synthetic import Synthetic
from tsfusion.evaluation.trajectory_error import absolute_error
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.stereo_matching import Matcher, quick_disparity
from tsfusion.scanner.localization.localizer import Localizer, Lost, TrackedPose
from tsfusion.scanner.localization.stereo import rectification_check, stereo_tracker
from tsfusion.scanner.localization.stereo.rectification_check import RectificationCheck
from tsfusion.scanner.localization.stereo.reprojection import StereoCamera, refine
from tsfusion.scanner.localization.stereo.stereo_tracker import StereoLocalizer

Data = Callable[[str], Path]


@pytest.fixture(autouse=True)
def one_thread() -> None:
    cv2.setNumThreads(1)


def frames(data: Data, sequence: str, count: int) -> list[Frame]:
    dataset = open_dataset(data("kitti_odometry"), sequence=sequence, modality="stereo")
    return [frame_of(dataset, index) for index in range(count)]


def poses(localizer: Localizer, followed: list[Frame]) -> list[TrackedPose]:
    found = [localizer.track(frame) for frame in followed]
    lost = [pose for pose in found if isinstance(pose, Lost)]
    assert not lost
    return [pose for pose in found if isinstance(pose, TrackedPose)]


def positions(found: list[TrackedPose]) -> np.ndarray:
    return np.array([pose.T_world_camera for pose in found])


def length(found: list[TrackedPose]) -> float:
    return float(np.linalg.norm(np.diff(positions(found)[:, :3, 3], axis=0), axis=1).sum())


def both(frame: Frame, change: Callable[[np.ndarray], np.ndarray]) -> Frame:
    return dataclasses.replace(frame, left=change(frame.left), right=change(frame.right), color=None)


def blank(frame: Frame) -> Frame:
    return both(frame, np.zeros_like)


def garbage(frame: Frame) -> Frame:
    rng = np.random.default_rng(1)
    return both(frame, lambda image: rng.integers(0, 255, image.shape, dtype=np.uint8))


def test_kitti_drift(data: Data) -> None:
    clip = frames(data, "06", 30)
    stereo = StereoLocalizer()
    found = [stereo.track(frame) for frame in clip]
    assert all(isinstance(pose, TrackedPose) and pose.quality > 0.5 for pose in found)
    error = absolute_error(positions(found), np.array([frame.T_world_camera for frame in clip]))
    assert error.drift_percent <= 1.0
    assert error.rmse < 0.08


def test_equal_frames_give_equal_poses(data: Data) -> None:
    clip = frames(data, "06", 5)
    once, again = (positions(poses(StereoLocalizer(), clip)) for _ in range(2))
    np.testing.assert_array_equal(once, again)


def test_half_the_frame_rate_is_enough(data: Data) -> None:
    clip = frames(data, "06", 30)[::2]
    found = poses(StereoLocalizer(), clip)
    error = absolute_error(positions(found), np.array([frame.T_world_camera for frame in clip]))
    assert error.drift_percent <= 1.0


def test_anchors_carry_the_poses(data: Data) -> None:
    clip = frames(data, "06", 8)
    found = poses(StereoLocalizer(), clip)
    anchors = {pose.anchor: pose.T_world_camera for pose in found if pose.starts_anchor}
    assert list(anchors) == list(range(len(anchors)))
    assert 2 <= len(anchors) < len(found)
    for pose in found:
        T = anchors[pose.anchor] @ pose.T_anchor_camera
        np.testing.assert_allclose(T, pose.T_world_camera, atol=1e-9)


def test_a_camera_that_stands_still_stays_where_it_is(data: Data) -> None:
    (frame,) = frames(data, "06", 1)
    rng = np.random.default_rng(0)

    def noisy(image: np.ndarray) -> np.ndarray:
        noise = rng.normal(0, 3, image.shape)
        return np.clip(image + noise, 0, 255).astype(np.uint8)

    found = poses(StereoLocalizer(), [both(frame, noisy) for _ in range(8)])
    assert max(se3.distance(pose.T_world_camera) for pose in found) < 0.02
    assert max(se3.angle(pose.T_world_camera) for pose in found) < np.radians(0.05)


def test_a_step_in_exposure_is_outlived(data: Data) -> None:
    clip = frames(data, "06", 8)
    darker = [
        both(frame, lambda image: image // 2) if index > 3 else frame for index, frame in enumerate(clip)
    ]
    plain, stepped = (positions(poses(StereoLocalizer(), each)) for each in (clip, darker))
    assert np.linalg.norm(plain[:, :3, 3] - stepped[:, :3, 3], axis=1).max() < 0.1


@pytest.mark.parametrize("spoil", [blank, garbage])
def test_a_bad_frame_is_lost_and_the_next_one_is_not(data: Data, spoil: Callable[[Frame], Frame]) -> None:
    clip = frames(data, "06", 5)
    stereo, whole = StereoLocalizer(), poses(StereoLocalizer(), clip)
    found = [stereo.track(spoil(frame) if index == 3 else frame) for index, frame in enumerate(clip)]
    assert isinstance(found[3], Lost)
    assert found[3].timestamp_ns == clip[3].timestamp_ns
    assert re.search(r"^\d+ of \d+ (corners|points)", found[3].reason)
    last = found[4]
    assert isinstance(last, TrackedPose)
    assert se3.distance(se3.inverse(whole[4].T_world_camera) @ last.T_world_camera) < 0.1


@pytest.mark.parametrize("last", [5, 14])
def test_half_a_second_without_frames_is_bridged(data: Data, last: int) -> None:
    clip = frames(data, "06", last + 6)
    stereo = StereoLocalizer()
    poses(stereo, clip[last - 2 : last + 1])
    found = stereo.track(clip[last + 5])
    assert isinstance(found, TrackedPose)
    (whole,) = poses(StereoLocalizer(), clip[last - 2 :])[-1:]
    assert se3.distance(whole.T_world_camera) > 6
    assert se3.distance(se3.inverse(whole.T_world_camera) @ found.T_world_camera) < 0.3


def test_another_place_is_no_motion(data: Data) -> None:
    clip, other = frames(data, "06", 30), frames(data, "01", 3)
    stereo = StereoLocalizer()
    poses(stereo, clip[:4])
    elsewhere = [both(frame, lambda image: np.ascontiguousarray(image[:370, :1226])) for frame in other]
    assert all(isinstance(stereo.track(frame), Lost) for frame in [*elsewhere, *clip[14:18]])
    larger = stereo.track(other[0])
    assert isinstance(larger, Lost)
    assert larger.reason == "the image is 1241×376, unlike those before"


def test_a_pose_does_not_wait_for_what_the_next_frame_needs(data: Data) -> None:
    clip = frames(data, "06", 4)
    prepared, alone = StereoLocalizer(), StereoLocalizer()
    for index, frame in enumerate(clip):
        found, expected = prepared.track(frame), alone.track(frame)
        assert isinstance(found, TrackedPose)
        assert isinstance(expected, TrackedPose)
        np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)
        assert ("quick_disparity" in vars(frame)) == (index == 0)
        prepared.prepare()
        assert "quick_disparity" in vars(frame)
        prepared.prepare()  # once is enough


def test_reset_begins_a_new_world(data: Data) -> None:
    clip = frames(data, "06", 6)
    stereo = StereoLocalizer()
    before = poses(stereo, clip[:3])
    stereo.reset()
    after = poses(stereo, clip[3:])
    np.testing.assert_array_equal(after[0].T_world_camera, np.eye(4))
    assert after[0].starts_anchor
    assert after[0].anchor == before[-1].anchor + 1
    assert stereo.corrections() is None


def test_nothing_to_begin_with(data: Data) -> None:
    (frame,) = frames(data, "06", 1)
    stereo = StereoLocalizer()
    first = stereo.track(blank(frame))
    assert isinstance(first, Lost)
    assert "corners with depth" in first.reason
    assert isinstance(stereo.track(frame), TrackedPose)


def test_disparity_with_an_image() -> None:
    street = Synthetic("street", "stereo", count=12)
    found = poses(StereoLocalizer(), [street.frame(index) for index in range(12)])
    error = absolute_error(positions(found), np.array([street.pose(index) for index in range(12)]))
    assert error.drift_percent < 1.5


def test_what_it_cannot_follow() -> None:
    for sensor, message in (("lidar", "got points"), ("kinect", "got depth without colour")):
        frame = Synthetic("room", sensor, count=1, color=False).frame(0)
        with pytest.raises(InvalidKeyframe, match=message):
            StereoLocalizer().track(frame)


def test_quick_disparity_agrees_with_ground_truth(data: Data) -> None:
    folder = data("middlebury_motorcycle")
    left, right = motorcycle(folder)
    truth = np.load(folder / "motorcycle_disp.npz")["arr_0"]
    quick = quick_disparity(left, right)
    assert quick.shape == left.shape
    assert quick.dtype == np.float32
    known = np.isfinite(truth) & (quick > 0)
    assert known.mean() > 0.7
    error = np.abs(quick - truth)[known]
    assert np.median(error) < 0.5
    whole = Matcher()(left, right)
    both_found = (quick > 0) & (whole > 0)
    assert np.median(np.abs(quick - whole / 16)[both_found]) < 0.5


def test_refinement_finds_motion_and_offset() -> None:
    rng = np.random.default_rng(2)
    K, baseline_fx, count = Intrinsics(700.0, 700.0, 600.0, 180.0), 380.0, 400
    rig, guess = StereoCamera(K, baseline_fx), se3.exp(np.array([0, 0, 1.0, 0, 0.018, 0]))
    T = se3.exp(np.array([0.05, 0.01, 1.1, 0.002, 0.02, -0.003]))
    disparity = rng.uniform(3, 60, count)
    old = np.column_stack([rng.uniform(0, 1200, count), rng.uniform(0, 370, count)]).astype(np.float32)
    z = baseline_fx / disparity
    points = np.column_stack([(old[:, 0] - K.cx) / K.fx * z, (old[:, 1] - K.cy) / K.fy * z, z])
    x, y, depth = se3.apply(se3.inverse(T), points).T
    keep = depth > 2
    new = np.column_stack([K.fx * x / depth + K.cx, K.fy * y / depth + K.cy])[keep]
    new = (new + rng.normal(0, 0.2, new.shape)).astype(np.float32)
    old, disparity = old[keep], disparity[keep]
    measured = disparity - 0.7 + rng.normal(0, 0.1, len(old))
    bent = refine(guess, old, measured, new, rig)
    straight = refine(guess, old, measured, new, rig, with_offset=True)
    assert straight.offset == pytest.approx(0.7, abs=0.05)
    assert straight.offset_sigma < 0.1
    assert straight.agree.mean() > 0.95
    wrong, right = (se3.distance(se3.inverse(T) @ motion.T_old_new) for motion in (bent, straight))
    assert right < 0.005
    assert wrong > 10 * right
    assert refine(guess, old[:2], measured[:2], new[:2], rig) is None


def grey(path: Path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)


def motorcycle(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    return grey(folder / "motorcycle_left.png"), grey(folder / "motorcycle_right.png")


def euroc(folder: Path, *, rectify: bool) -> list[Frame]:
    """The four pairs, three times over, as the folder's own calibration rectifies them, or raw."""

    def numbers(name: str, text: str) -> np.ndarray:
        found = re.search(rf"^\s*{name}:\s*\[([^\]]*)\]", text, re.MULTILINE)
        return np.array([float(word) for word in found[1].split(",")])

    cameras = []
    for side in (0, 1):
        text = (folder / f"mav0/cam{side}/sensor.yaml").read_text(encoding="utf-8")
        fx, fy, cx, cy = numbers("intrinsics", text)
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        cameras.append((K, numbers("distortion_coefficients", text), numbers("data", text).reshape(4, 4)))
    (K0, D0, T0), (K1, D1, T1) = cameras
    T, size = se3.inverse(T1) @ T0, (752, 480)
    turns = cv2.stereoRectify(K0, D0, K1, D1, size, T[:3, :3].copy(), T[:3, 3:].copy(), alpha=0)
    P0, P1 = turns[2:4]
    maps = [
        cv2.initUndistortRectifyMap(K, D, R, P, size, cv2.CV_32FC1)
        for K, D, R, P in ((K0, D0, turns[0], P0), (K1, D1, turns[1], P1))
    ]
    pairs, K = [], Intrinsics(P0[0, 0], P0[1, 1], P0[0, 2], P0[1, 2])
    for path in sorted((folder / "mav0/cam0/data").glob("*.png")):
        images = [grey(Path(str(path).replace("cam0", f"cam{k}"))) for k in (0, 1)]
        if rectify:
            images = [cv2.remap(image, *maps[k], cv2.INTER_LINEAR) for k, image in enumerate(images)]
        left, right = images
        pairs.append(Frame(sensor="stereo", left=left, right=right, intrinsics=K, baseline_fx=-P1[0, 3]))
    return pairs * 3


def check(followed: list[Frame]) -> RectificationCheck:
    stereo = StereoLocalizer()
    for frame in followed:
        stereo.track(frame)
    return stereo.rectification


def test_good_pairs_are_not_reported(data: Data, caplog: pytest.LogCaptureFixture) -> None:
    clip = check(frames(data, "06", 12))
    assert clip.ok, clip.problems
    assert clip.disparity_px is not None  # the car moves: that much is known
    left, right = motorcycle(data("middlebury_motorcycle"))
    K = Intrinsics(994.978, 994.978, 311.193, 254.877)
    still = Frame(sensor="stereo", left=left, right=right, intrinsics=K, baseline_fx=0.193 * 994.978)
    lone = check([still] * 8)
    assert lone.ok, lone.problems
    assert lone.disparity_px is None  # it stands: nothing to tell it from
    hovering = check(euroc(data("euroc_V1_01"), rectify=True))
    assert hovering.ok, hovering.problems
    assert not caplog.records


def test_raw_pairs_are_reported(data: Data) -> None:
    raw = check(euroc(data("euroc_V1_01"), rectify=False))
    assert not raw.ok
    assert raw.worst_rows_px > 10


def turned(frame: Frame, A: np.ndarray) -> Frame:
    right = cv2.warpAffine(frame.right, A, frame.right.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    return dataclasses.replace(frame, right=right)


def spoilt(clip: list[Frame], what: str) -> list[Frame]:
    height, width = clip[0].right.shape
    middle = (width / 2, height / 2)
    A = {
        "rows": np.array([[1, 0, 0], [0, 1, 1.5]]),
        "roll": cv2.getRotationMatrix2D(middle, -0.3, 1),  # OpenCV counts anticlockwise
        "stretch": cv2.getRotationMatrix2D(middle, 0, 1.01),
        "disparity": np.array([[1, 0, 1.0], [0, 1, 0]]),
    }[what]
    return [turned(frame, A) for frame in clip]


@pytest.mark.parametrize(
    ("what", "field", "value", "within"),
    [
        ("rows", "rows_px", 1.5, 0.4),
        ("roll", "roll_deg", 0.3, 0.05),
        ("stretch", "stretch", 1.01, 0.003),
        ("disparity", "disparity_px", -1.0, 0.4),
    ],
)
def test_bad_pairs_are_reported_with_a_measure(
    data: Data, caplog: pytest.LogCaptureFixture, what: str, field: str, value: float, within: float
) -> None:
    with caplog.at_level(logging.WARNING):
        found = check(spoilt(frames(data, "06", 11), what))
    assert not found.ok
    assert getattr(found, field) == pytest.approx(value, abs=within)
    assert [record.getMessage() for record in caplog.records] == list(found.problems)
    assert any("calibrate" in problem for problem in found.problems)


def test_swapped_sides_are_named(data: Data) -> None:
    clip = [
        dataclasses.replace(frame, left=frame.right, right=frame.left, color=None)
        for frame in frames(data, "06", 8)
    ]
    assert "swapped" in check(clip).problems[-1]


def test_the_faulty_clip_shows_from_its_images_alone(data: Data) -> None:
    """KITTI 01 as handed down: its disparities are too low, and uncorrected, lengths come out 8 % long."""
    clip = frames(data, "01", 15)
    stereo = StereoLocalizer()
    found = positions(poses(stereo, clip))
    check = stereo.rectification
    assert check.disparity_px == pytest.approx(-0.7, abs=0.25)
    truth = np.array([frame.T_world_camera for frame in clip])
    ratio = np.linalg.norm(found[-1][:3, 3]) / np.linalg.norm((se3.inverse(truth[0]) @ truth[-1])[:3, 3])
    assert 1.02 < ratio < 1.07


@pytest.mark.parametrize("offset", [-0.4, 0.4])
def test_an_offset_of_all_disparities_is_corrected(
    data: Data, monkeypatch: pytest.MonkeyPatch, offset: float
) -> None:
    """Without the correction, an offset of 0.4 px makes the way 1 % longer or shorter."""
    clip = [turned(frame, np.array([[1, 0, offset], [0, 1, 0]])) for frame in frames(data, "06", 20)]
    as_handed_down = length(poses(StereoLocalizer(), frames(data, "06", 20)))
    corrected = length(poses(StereoLocalizer(), clip))
    monkeypatch.setattr(rectification_check, "PAIR_SIGMA", 1e-6)
    uncorrected = length(poses(StereoLocalizer(), clip))
    assert abs(corrected - as_handed_down) < 0.5 * abs(uncorrected - as_handed_down)


def distant(x: float) -> Frame:
    """A rectified pair `x` metres to the right that sees patches 45 to 85 m away alone."""
    rng, (height, width, focal, baseline) = np.random.default_rng(0), (240, 640, 400.0, 0.3)
    pair = np.zeros((2, height, width), np.float32)
    for z in (85.0, 70.0, 55.0, 45.0):
        wall = cv2.GaussianBlur(rng.integers(0, 256, (700, 700)).astype(np.float32), (0, 0), 1.2)
        cut = np.full(wall.shape, float(z == 85), np.float32)
        for column, row in rng.integers(0, 700, (14, 2)):
            cut[row : row + 40, column : column + 40] = 1
        for image, right in zip(pair, (x, x + baseline), strict=True):
            moved = np.array([[2.4, 0, width / 2 - 840 - focal * right / z], [0, 2.4, height / 2 - 840]])
            seen, mask = (cv2.warpAffine(each, moved, (width, height)) for each in (wall, cut))
            image[:] = image * (1 - mask) + seen * mask
    left, right = pair.clip(0, 255).astype(np.uint8)
    K = Intrinsics(focal, focal, width / 2, height / 2)
    return Frame(left=left, right=right, intrinsics=K, baseline_fx=focal * baseline, sensor="stereo")


def test_a_distant_view_tells_no_offset() -> None:
    """Matching rounds disparities of 1.4 to 2.7 px, which looked like an offset of 0.8 px."""
    stereo = StereoLocalizer()
    poses(stereo, [distant(0.2 * number) for number in range(16)])
    assert stereo.rectification is not None
    assert stereo.rectification.ok
    assert stereo.rectification.disparity_px is None


def test_a_leap_that_turns_as_the_gyroscope_needs_more_corners() -> None:
    """In a room swung through, the first motion was found 0.8 m aside, on the next of a wall's stripes."""
    T = se3.exp(np.array([0.8, 0, 0, 0, 0.35, 0]))
    assert stereo_tracker._least_share(T, T[:3, :3]) == stereo_tracker.MIN_SHARE_LEAP
    for turn in (None, np.eye(3), T[:3, :3].T):
        assert stereo_tracker._least_share(T, turn) == stereo_tracker.MIN_SHARE_SUDDEN


def blurred(frame: Frame, angle: float) -> Frame:
    along, kernel = 15 * np.array([np.cos(angle), np.sin(angle)]), np.zeros((35, 35), np.float32)
    ends = [tuple(np.rint(17 + sign * along).astype(int).tolist()) for sign in (-1, 1)]
    kernel = cv2.line(kernel, *ends, 1.0)
    return both(frame, lambda image: cv2.filter2D(image, -1, kernel / kernel.sum()))


def test_blurred_views_are_followed_at_a_smaller_size(data: Data) -> None:
    """Each frame is blurred along another direction, by a 40th of the width."""
    clip = [blurred(frame, float(index)) for index, frame in enumerate(frames(data, "06", 10))]
    found = positions(poses(StereoLocalizer(), clip))
    error = absolute_error(found, np.array([frame.T_world_camera for frame in clip]))
    assert error.rmse < 0.15
