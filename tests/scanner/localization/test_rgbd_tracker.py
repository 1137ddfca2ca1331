# SPDX-License-Identifier: MIT
"""The RGB-D tracker: how far it drifts on recorded and on exact scenes, and that it knows when it is lost."""

import itertools
import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
from command_processes import python
from rgbd_scenes import CAMERA, garbage, track, wall

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.datasets import Synthetic, open_dataset, select
from tsfusion.datasets.worlds import worlds
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.localizer import Lost, TrackedPose
from tsfusion.scanner.localization.rgbd import rgbd_tracker
from tsfusion.scanner.localization.rgbd.pose_solver import PoseEvidence
from tsfusion.scanner.localization.rgbd.rgbd_frame import RGBDFrame, TrackingKeyframe
from tsfusion.scanner.localization.rgbd.rgbd_tracker import RGBDLocalizer


@pytest.fixture(scope="module")
def kitchen(data):
    return open_dataset(data("7scenes/redkitchen"))


@pytest.fixture(scope="module")
def room():
    """A second and a half of the exact room, seen by a person's hand."""
    dataset = Synthetic("room", count=16, path="handheld")
    return [dataset.frame(index) for index in range(16)]


def frames(dataset, *, start=0, stop=None, stride=1):
    part = select(dataset, start=start, stop=stop, stride=stride)
    return (part.frame(index) for index in range(len(part)))


def test_the_kitchen_at_two_and_a_half_frames_a_second(kitchen):
    result = track(RGBDLocalizer(), frames(kitchen, stop=75, stride=3))
    assert not result.lost
    assert result.ate() < 30


def test_neither_a_name_nor_threads_change_a_pose(data, tmp_path):
    """Raw colour of a Kinect is registered by what it shows, whatever the folder is called."""
    poses = []
    for name, threads in (("7scenes/redkitchen", 1), ("kitchen", 2), ("heads", 1)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(data("7scenes/redkitchen"))
        before = cv2.getNumThreads()
        cv2.setNumThreads(threads)
        try:
            result = track(RGBDLocalizer(), frames(open_dataset(tmp_path / name), stop=40, stride=5))
        finally:
            cv2.setNumThreads(before)
        assert not result.lost
        poses.append(result.poses.tobytes())
    assert poses[0] == poses[1] == poses[2]


@pytest.mark.nightly  # else its first 75 frames
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_the_kitchen(kitchen, stride):
    """The recorded poses are good to 30 mm."""
    result = track(RGBDLocalizer(), frames(kitchen, stride=stride))
    assert not result.lost
    assert result.ate(75 // stride) < 30
    assert result.ate() < 40


@pytest.mark.parametrize(
    ("world", "bound"),
    [
        ("room", 3),
        ("room-bare", 5),
        pytest.param("room-untextured", 5, marks=pytest.mark.nightly),
        pytest.param("room-plain", 5, marks=pytest.mark.nightly),
    ],
)
@pytest.mark.parametrize("path", ["handheld", pytest.param("circle", marks=pytest.mark.nightly)])
def test_rooms_with_exact_poses(world, bound, path):
    count = 40 if path == "handheld" else 150
    result = track(RGBDLocalizer(), frames(Synthetic(world, count=count, path=path)))
    assert not result.lost
    assert result.ate() < bound


def test_a_keyframe_takes_a_third_of_the_memory_once_a_newer_one_is_followed(kitchen):
    frame = RGBDFrame.of(kitchen.frame(0))
    new = TrackingKeyframe.of(frame, 0, np.eye(4))
    old = new.packed()
    np.testing.assert_allclose(old.frame.gray, new.frame.gray, atol=12)
    assert np.abs(old.frame.gray - new.frame.gray.astype(float)).mean() < 1
    pickled, before = len(pickle.dumps(old)), len(pickle.dumps(frame))
    assert pickled < before / 3
    assert old.packed().frame is old.frame
    # A frame at the same place is found by it, as by the new one.
    found, expected = (len(keyframe.recall(frame)[0]) for keyframe in (old, new))
    assert found > 0.8 * expected > 50


@pytest.mark.nightly  # else the room with a picture carried through it, which has this size too
def test_a_room_at_full_resolution():
    room = Synthetic("room", count=150, path="handheld", width=640)
    result = track(RGBDLocalizer(), frames(room, stride=3))
    assert not result.lost
    assert result.ate() < 3


@pytest.mark.parametrize(
    ("folder", "stop", "bound"), [("hololens", 20, 10), ("redwood_livingroom1", 10, 10), ("3dmatch", 3, 15)]
)
def test_other_sensors(data, folder, stop, bound):
    result = track(RGBDLocalizer(), frames(open_dataset(data(folder)), stop=stop))
    assert not result.lost
    assert result.ate() < bound


def test_depth_alone_goes_on_where_the_image_fails(data):
    """Colour of another camera, taken as it is, cost 15 of these 125 frames."""
    raw = open_dataset(data("7scenes/redkitchen"), register=False)
    assert not track(RGBDLocalizer(), frames(raw, start=20, stop=50)).lost


def test_depth_alone(kitchen):
    bare = (replace(frame, color=None) for frame in frames(kitchen, stop=30))
    result = track(RGBDLocalizer(), bare)
    assert not result.lost
    assert result.ate() < 30
    room = track(RGBDLocalizer(), frames(Synthetic("room", count=20, path="handheld", color=False)))
    assert not room.lost
    assert room.ate() < 1


def test_garbage_is_lost_and_the_way_is_found_again(kitchen):
    seen = list(frames(kitchen, stop=36, stride=1))
    between = list(garbage(seen[20]).values())
    localizer = RGBDLocalizer()
    before = track(localizer, seen[:21])
    assert not before.lost
    assert len(track(localizer, between).lost) == len(between)
    after = track(localizer, seen[21:])
    assert not after.lost
    anchors = [answer.anchor for answer in before.answers + after.answers]
    assert anchors == sorted(anchors)
    before.answers += after.answers
    before.truth += after.truth
    assert before.ate() < 30


def test_uncovered_elsewhere_it_finds_a_place_it_has_been_to(kitchen):
    """Lost at one end of the way, shown its beginning: nothing but the look of the place can help."""
    localizer, seen = RGBDLocalizer(), list(frames(kitchen, stop=45))
    assert not track(localizer, seen).lost
    assert isinstance(localizer.track(garbage(seen[-1])["covered"]), Lost)
    again = track(localizer, seen[:8])
    assert len(again.lost) <= 3
    found = [(a, T) for a, T in zip(again.answers, again.truth, strict=True) if isinstance(a, TrackedPose)]
    assert found[0][0].starts_anchor
    for answer, T in found:
        error = se3.inverse(se3.inverse(seen[0].T_world_camera) @ T) @ answer.T_world_camera
        assert se3.distance(error) < 0.03
        assert se3.angle(error) < np.radians(2)


@pytest.mark.parametrize("color", [True, False])
def test_no_pose_after_a_jump_is_wrong(kitchen, color):
    """From a second to ten between two frames, at 40 to 60 degrees/s: either lost or right."""
    there = {index: kitchen.frame(index) for index in range(0, 125, 12)}
    if not color:
        there = {index: replace(frame, color=None) for index, frame in there.items()}
    lost = 0
    for first, last in [(0, 36), (0, 60), (24, 84), (36, 108), (60, 0), (84, 36), (108, 12), (120, 60)]:
        result = track(RGBDLocalizer(), [there[first], there[last]])
        lost += len(result.lost)
        if not result.lost:
            moved = se3.inverse(result.truth[0]) @ result.truth[1]
            off = se3.distance(se3.inverse(moved) @ result.poses[1])
            assert off < 0.06  # twice what the truth is good to
    assert lost >= 4


def test_uncovered_half_a_metre_on_it_is_found(data):
    """HoloLens moves by 100 mm a frame; what is seen again leaves the pose open by more than 100 mm."""
    seen = list(frames(open_dataset(data("hololens")), start=8, stop=28))
    seen[12:15] = [garbage(frame)["blank depth"] for frame in seen[12:15]]
    result = track(RGBDLocalizer(), seen)
    assert result.lost == [12, 13, 14]
    assert result.ate() < 15


def evidence(agreeing: float, likeness: float | None, uncertainty: float = 0.01) -> PoseEvidence:
    return PoseEvidence(0.8, agreeing, likeness, 50, np.eye(6), uncertainty)


def test_depth_and_image_together_choose_between_keyframes():
    assert evidence(0.94, 0.75).beats(evidence(0.75, 0.83))
    assert not evidence(0.99, None).beats(evidence(0.75, 0.83))
    assert not evidence(0.94, 0.75).beats(evidence(0.93, 0.75))


def test_an_open_pose_is_believed_of_a_lost_camera_whose_image_is_much_alike():
    assert evidence(1.0, 0.8, 0.15).doubt(strict=True) is None
    for strict, likeness, uncertainty in ((False, 0.8, 0.15), (True, 0.5, 0.15), (True, 0.8, 0.25)):
        assert "leaves the pose open" in str(evidence(1.0, likeness, uncertainty).doubt(strict=strict))


def test_another_place_is_lost(kitchen, data):
    other = open_dataset(data("redwood_livingroom1")).frame(0)
    other = replace(other, intrinsics=kitchen.intrinsics)
    assert track(RGBDLocalizer(), [kitchen.frame(0), other]).lost == [1]


@pytest.mark.parametrize("waves", [False, True])
def test_along_a_plain_wall_it_is_lost(waves):
    """Depth says nothing of a motion along a plane, and noise in both images must not pass for it."""
    plain = [wall(2 * index, textured=False, waves=waves, seed=index) for index in range(6)]
    result = track(RGBDLocalizer(), plain)
    assert result.lost == [1, 2, 3, 4, 5]
    assert "plain wall" in result.answers[1].reason
    assert track(RGBDLocalizer(), [replace(frame, color=None) for frame in plain]).lost == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("waves", [False, True])
def test_along_a_wall_with_a_pattern_it_goes_by_the_image(waves):
    walls = (wall(2 * index, textured=True, waves=waves, seed=index) for index in range(12))
    result = track(RGBDLocalizer(), walls)
    assert not result.lost
    expected = np.arange(12) * 2 * 2.0 / CAMERA.fx
    np.testing.assert_allclose(result.poses[:, 0, 3], expected, atol=0.003)
    np.testing.assert_allclose(result.poses[:, 1:3, 3], 0, atol=0.003)


def test_a_picture_carried_through_the_view_is_not_followed():
    """An eighth of the image, with more corners than all the rest, that moves by itself."""
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (480, 640, 3)).astype(np.uint8), (0, 0), 1.5)[:200, :200]
    dataset, shown = Synthetic("room", count=30, path="handheld", width=640), []
    for index in range(30):
        frame, left = dataset.frame(index), 40 + 4 * index
        depth, color = frame.depth.copy(), frame.color.copy()
        if index > 10:
            depth[100:300, left : left + 200] = 6000
            color[100:300, left : left + 200] = picture
        shown.append(replace(frame, depth=depth, color=color))
    result = track(RGBDLocalizer(), shown)
    assert not result.lost
    assert result.ate() < 5


def test_frames_left_out_are_made_up_for_by_the_clock():
    dataset = Synthetic("room", count=40, path="handheld")
    some = [0, 1, 2, 3, 6, 7, 8, 12, 13, 14, 15, 19, 20, 21, 26, 27]
    result = track(RGBDLocalizer(), (dataset.frame(index) for index in some))
    assert not result.lost
    assert result.ate() < 2


def test_equal_frames_give_equal_poses_to_the_bit(room):
    first, second = (track(RGBDLocalizer(), room).poses for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_delay_longer_than_an_interval_has_its_sign():
    """Colour two intervals before depth: measured against the last pose, it would count as later."""
    room = worlds.room()
    paths = {"slow": lambda index, count: room.paths["handheld"](300 + index / 9, count)}
    source = Synthetic(replace(room, paths=paths), "kinect", count=180)
    localizer, interval_ns = RGBDLocalizer(), 33_333_333
    for index in range(6, 180, 3):
        color, stamp_ns = source.frame(index - 6).color, index // 3 * interval_ns
        localizer.track(replace(source.frame(index), color=color, timestamp_ns=stamp_ns))
    assert localizer.color_delay.seconds == pytest.approx(-2e-9 * interval_ns, abs=0.02)


def test_a_delay_that_no_camera_has_is_not_believed():
    delay = rgbd_tracker.ColorDelay()
    for _ in range(2 * rgbd_tracker.FEWEST_DELAYS):
        delay.add(1.0, 0.3)
    assert delay.seconds == 0


@pytest.mark.parametrize("late", [-1, 0, 1])
def test_colour_of_another_time_is_allowed_for(late, monkeypatch):
    """Colour a third of an interval before or after depth; on time, nothing is estimated or changed."""
    room = worlds.room()
    paths = {"slow": lambda index, count: room.paths["handheld"](index / 3, count)}
    source = Synthetic(replace(room, paths=paths), "kinect", count=120)
    some = [replace(source.frame(i), color=source.frame(i + late).color) for i in range(2, 118, 3)]
    localizer = RGBDLocalizer()
    result = track(localizer, some)
    assert not result.lost
    interval_s = (some[1].timestamp_ns - some[0].timestamp_ns) / 1e9
    assert localizer.color_delay.seconds == pytest.approx(late * interval_s / 3, abs=interval_s / 6)
    monkeypatch.setattr(rgbd_tracker, "MOST_DELAYS", 0)
    unaware = track(RGBDLocalizer(), some)
    if late:
        assert result.ate() < 0.8 * unaware.ate()
    else:
        np.testing.assert_array_equal(result.poses, unaware.poses)


def test_units_do_not_matter(room):
    """Metres in float32, millimetres, and disparity: the same depth, the same way."""
    metres = [replace(frame, depth=frame.depth_m.copy()) for frame in room[:8]]
    holes = [np.where(frame.depth_m > 0, frame.depth_m, np.float32(np.nan)) for frame in metres]
    unset = [replace(frame, depth=depth) for frame, depth in zip(metres, holes, strict=True)]
    disparity = [
        replace(
            frame, depth=None, disparity=np.rint(1024 * 40 / frame.depth_m).astype(np.uint16),
            disparity_scale=1 / 1024, baseline_fx=40.0,
        )
        for frame in room[:8]
    ]  # fmt: skip
    expected = track(RGBDLocalizer(), room[:8]).poses
    for other in (metres, unset):
        np.testing.assert_allclose(track(RGBDLocalizer(), other).poses, expected, atol=1e-6)
    np.testing.assert_allclose(track(RGBDLocalizer(), disparity).poses, expected, atol=1e-3)


def test_anchors_and_quality(room):
    localizer = RGBDLocalizer()
    poses, anchors = [localizer.track(frame) for frame in room], {}
    assert all(isinstance(pose, TrackedPose) for pose in poses)
    assert poses[0].starts_anchor
    np.testing.assert_array_equal(poses[0].T_world_camera, np.eye(4))
    for pose, frame in zip(poses, room, strict=True):
        if pose.starts_anchor:
            assert pose.anchor not in anchors
            anchors[pose.anchor] = pose.T_world_camera
        T = anchors[pose.anchor] @ pose.T_anchor_camera
        np.testing.assert_allclose(T, pose.T_world_camera, atol=1e-12)
        assert pose.timestamp_ns == frame.timestamp_ns
        assert 0.9 < pose.quality <= 1
    assert list(anchors) == list(range(len(anchors)))
    assert 3 <= len(anchors) < len(room)
    assert localizer.corrections() is None


def errors_and_covariances(given):
    """Track frames with exact poses; return errors, (n, 6), and covariances, (n, 6, 6), camera's axes."""
    localizer, keyframes, before, found = RGBDLocalizer(), {}, -1, []
    for frame in given:
        pose = localizer.track(frame)
        assert isinstance(pose, TrackedPose)
        if pose.covariance is None:
            assert before == -1  # the first frame alone has none
        else:
            anchor, truth = keyframes[before if pose.starts_anchor else pose.anchor]
            estimated = se3.inverse(anchor) @ pose.T_world_camera
            true = se3.inverse(truth) @ frame.T_world_camera
            found.append((se3.log(se3.inverse(estimated) @ true), pose.covariance))
        if pose.starts_anchor:
            before = pose.anchor
            keyframes[before] = pose.T_world_camera, frame.T_world_camera
    errors, covariances = zip(*found, strict=True)
    return np.array(errors), np.array(covariances)


def test_the_covariance_covers_the_error(room):
    errors, covariances = errors_and_covariances(room)
    chi2 = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    assert (chi2 < 10.64).mean() >= 0.8  # 90 % of six numbers
    assert np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2)).max() < 5e-3  # and is no excuse


def test_colour_that_contradicts_depth_makes_the_pose_less_certain(room):
    late = [replace(frame, color=before.color) for before, frame in itertools.pairwise(room)]
    certain, doubtful = (
        np.median([np.trace(C) for C in errors_and_covariances(some)[1]]) for some in (room, late)
    )
    assert doubtful > 4 * certain


def test_depth_with_smooth_errors_makes_the_pose_less_certain(room):
    def wavy(frame):
        """Bend the depth by 5 mm, in waves that stay in the image while the camera moves."""
        y, x = np.indices(frame.depth_m.shape)
        bend = 1 + 0.002 * np.sin(x / 17) * np.sin(y / 13)
        depth = (frame.depth_m * bend).astype(np.float32)
        return replace(frame, depth=depth, depth_scale=1.0, color=None)

    plain = [replace(frame, color=None) for frame in room]
    certain, doubtful = (
        np.median([np.trace(C) for C in errors_and_covariances(some)[1]])
        for some in (plain, [wavy(frame) for frame in room])
    )
    assert doubtful > 2 * certain


def test_reset_begins_another_world(room):
    localizer = RGBDLocalizer()
    before = [localizer.track(frame) for frame in room[:6]]
    localizer.reset()
    after = localizer.track(room[12])
    np.testing.assert_array_equal(after.T_world_camera, np.eye(4))
    assert after.anchor == before[-1].anchor + 1
    assert isinstance(localizer.track(room[0]), (TrackedPose, Lost))


def test_a_first_frame_without_depth_is_no_beginning(room):
    localizer = RGBDLocalizer()
    lost = localizer.track(garbage(room[0])["blank depth"])
    assert isinstance(lost, Lost)
    assert lost.reason == "0.0% of the depth image shows a surface"
    first = localizer.track(room[0])
    assert first.starts_anchor
    np.testing.assert_array_equal(first.T_world_camera, np.eye(4))


def test_an_image_of_another_size_goes_by_depth(room):
    localizer = RGBDLocalizer()
    localizer.track(room[0])
    half = replace(
        room[1],
        depth=np.ascontiguousarray(room[1].depth[::2, ::2]),
        color=np.ascontiguousarray(room[1].color[::2, ::2]),
        intrinsics=Intrinsics(CAMERA.fx / 2, CAMERA.fy / 2, CAMERA.cx / 2, CAMERA.cy / 2),
    )
    moved = se3.inverse(room[0].T_world_camera) @ room[1].T_world_camera
    assert se3.distance(se3.inverse(moved) @ localizer.track(half).T_world_camera) < 0.01


@pytest.mark.parametrize(
    ("fields", "kind"),
    [
        ({"points": np.zeros((9, 3), np.float32)}, "points"),
        ({"left": np.zeros((8, 8), np.uint8), "right": np.zeros((8, 8), np.uint8), "baseline_fx": 1.0,
          "intrinsics": CAMERA}, "pair"),
    ],
)  # fmt: skip
def test_frames_without_a_depth_image_are_refused(fields, kind):
    with pytest.raises(InvalidKeyframe, match=f"needs a depth or disparity image in every frame, got {kind}"):
        RGBDLocalizer().track(Frame(sensor="scanner", **fields))


@pytest.mark.nightly  # else `test_a_keyframe_takes_a_third_of_the_memory_once_a_newer_one_is_followed`
def test_a_scanner_stays_small(kitchen, tmp_path):
    """No Taichi, no more than 200 MB, and nothing that grows once as many keyframes are kept as may be."""
    for index in range(len(kitchen)):
        frame = kitchen.frame(index)
        cv2.imwrite(str(tmp_path / f"{index:03}.png"), frame.depth)
        cv2.imwrite(str(tmp_path / f"{index:03}.jpg"), frame.color)
    code = """
import re, sys
from pathlib import Path
import cv2
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.localizer import TrackedPose
from tsfusion.scanner.localization.rgbd.rgbd_tracker import RGBDLocalizer

def megabytes(name):
    return int(re.search(name + r":\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024

localizer, sizes, K = RGBDLocalizer(), [], Intrinsics(585.0, 585.0, 320.0, 240.0)
names = [f"{sys.argv[1]}/{index:03}" for index in range(125)]
for name in names + names[::-1]:
    depth, color = cv2.imread(name + ".png", cv2.IMREAD_UNCHANGED), cv2.imread(name + ".jpg")
    answer = localizer.track(Frame(sensor="kinect", depth=depth, color=color, intrinsics=K))
    assert isinstance(answer, TrackedPose), answer
    sizes.append(megabytes("VmRSS"))
assert answer.anchor > 50
kept = localizer._kept
assert [isinstance(one.frame.image, bytes) for one in kept] == [True] * (len(kept) - 1) + [False]
assert "taichi" not in sys.modules
print(megabytes("VmHWM"), max(sizes[200:]) - max(sizes[:200]))
"""
    done = python(code, tmp_path, timeout=300, check=True)
    peak, growth = map(float, done.stdout.split())
    assert peak < 200
    assert growth < 10
