# SPDX-License-Identifier: MIT
"""Loop closure: places known again, look-alikes refused, trajectories put right; poses never jump."""

import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from drifting_localizer import Drifting

from tsfusion.core.errors import MissingDependency
from tsfusion.datasets import Dataset, Synthetic, open_dataset
from tsfusion.datasets.dataset import frame_of
from tsfusion.datasets.worlds import worlds
from tsfusion.evaluation.trajectory_error import TrajectoryError, absolute_error
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.localizer import Lost, PoseCorrections, TrackedPose
from tsfusion.scanner.localization.loop_closure.loop_closing import LoopClosing, OrderedWork
from tsfusion.scanner.localization.loop_closure.loop_consensus import (
    Loop,
    LoopConsensus,
    OdometryChain,
    OdometryDrift,
    check_loop,
    matches,
)
from tsfusion.scanner.localization.loop_closure.place_index import PlaceIndex, PlaceView, place_view
from tsfusion.scanner.localization.rgbd.rgbd_tracker import RGBDLocalizer
from tsfusion.scanner.tracked_trajectory import TrackedTrajectory

FAR, TURNED = 0.05, 2.0  # metres and degrees: a loop that is farther off is wrong
SOON = 20.0  # seconds


class Run:
    """Frames through loop closure, and how right it was."""

    def __init__(self, frames: Sequence[Frame], seed: int = 0) -> None:
        self.closing = LoopClosing(Drifting(seed))
        self.truth = np.array([frame.T_world_camera for frame in frames])
        self.track = TrackedTrajectory()
        self.corrections: list[PoseCorrections] = []
        for frame in frames:
            pose = self.closing.track(frame)
            assert isinstance(pose, TrackedPose)
            self.track.add(pose, None, None)
            if (news := self.closing.corrections()) is not None:
                self.corrections.append(news)
                assert self.closing.corrections() is None
        self.loops = self.closing.consensus.accepted

    def error(self, corrections: PoseCorrections | None) -> TrajectoryError:
        return absolute_error(self.track.poses(corrections), self.truth)

    def wrong(self) -> list[tuple[int, int, float, float]]:
        """Believed loops that are not where they should be."""
        found = []
        for loop in self.loops:
            true = se3.inverse(self.truth[loop.old - 1]) @ self.truth[loop.new - 1]
            error = se3.inverse(true) @ loop.T_old_new
            off, turned = se3.distance(error), float(np.degrees(se3.angle(error)))
            if off > FAR or turned > TURNED:
                found.append((loop.old, loop.new, off, turned))
        return found


def frames_of(dataset: Dataset) -> list[Frame]:
    return [frame_of(dataset, index) for index in range(len(dataset))]


@cache
def two_laps() -> list[Frame]:
    return frames_of(Synthetic("corridor", count=120))


@cache
def views() -> list[PlaceView]:
    return [seen(frame) for frame in two_laps()[:4]]


def seen(frame: Frame) -> PlaceView:
    return place_view(frame, frame.depth_m)


def test_two_laps_with_drift_become_one_place():
    run = Run(two_laps())
    before, after = run.error(None), run.error(run.corrections[-1])
    assert before.length > 45
    assert after.rmse <= 0.3 * before.rmse, (before.rmse, after.rmse)
    assert len(run.loops) >= 20
    assert run.wrong() == []
    alone = Drifting()
    expected = [alone.track(frame).T_world_camera for frame in two_laps()]
    np.testing.assert_array_equal(run.track.poses(), expected)
    last = run.corrections[-1]
    assert last.loops == len(run.loops)
    newest = max(last.anchors)
    moved = last.T_corrected_world @ run.track.poses()[newest - 1]
    np.testing.assert_allclose(moved, last.anchors[newest], atol=1e-12)


def test_rooms_all_alike_are_not_one_room():
    """Each view has its like 4, 8, … metres before, equal to the last pixel: found, and not accepted."""
    frames = frames_of(Synthetic("rooms", count=45))
    run = Run(frames)
    assert run.closing.relocalise(frames[20]) is None
    assert run.closing.consensus.refused["contradicts the odometry"] > 30
    assert run.loops == []
    assert run.corrections == []


@pytest.mark.nightly  # else two laps of the corridor
@pytest.mark.parametrize("identical", [True, False])
def test_the_way_back_closes_each_room_with_itself(identical):
    run = Run(frames_of(Synthetic(worlds.rooms(identical=identical), count=120, path="return")))
    assert len(run.loops) >= 30
    assert run.wrong() == []
    assert run.error(run.corrections[-1]).rmse <= 0.3 * run.error(None).rmse


@pytest.mark.nightly  # else the street of stereo pairs
@pytest.mark.parametrize("seed", [0, 1])
def test_a_real_kitchen_gives_no_wrong_loop(data, seed):
    run = Run(frames_of(open_dataset(data("7scenes/redkitchen"))), seed)
    assert len(run.loops) >= 15
    assert run.wrong() == []
    assert run.error(run.corrections[-1]).rmse < run.error(None).rmse


@pytest.mark.slow
def test_a_street_driven_back_closes_from_stereo_pairs(data):
    dataset = open_dataset(data("kitti_odometry"), sequence="06")
    there, back = range(0, len(dataset), 2), range(len(dataset) - 1, 0, -2)
    run = Run([frame_of(dataset, index) for index in (*there, *back)])
    assert len(run.loops) >= 10
    assert run.error(run.corrections[-1]).rmse <= 0.3 * run.error(None).rmse


def test_a_view_is_itself_and_not_another():
    a, b, c = views()[0], views()[1], seen(two_laps()[30])
    same = check_loop(a, a)
    assert same.refused is None
    np.testing.assert_allclose(same.T_old_new, np.eye(4), atol=1e-4)
    truth = [frame.T_world_camera for frame in two_laps()]
    near = check_loop(a, b)
    error = truth[1] @ se3.inverse(near.T_old_new) @ se3.inverse(truth[0])
    assert near.refused is None
    assert se3.distance(error @ np.eye(4)) < 0.1  # in the world's axes: the lever arm of the position
    relative = se3.inverse(se3.inverse(truth[0]) @ truth[1]) @ near.T_old_new
    assert se3.distance(relative) < 0.02
    assert np.degrees(se3.angle(relative)) < 0.5
    assert check_loop(a, c).refused is not None


@pytest.mark.parametrize(("side", "word"), [("old", "see through"), ("new", "see through")])
def test_depth_that_sees_through_a_surface_is_evidence_against(side, word):
    """The same picture, but one camera saw 0.6 m farther in a quarter of it: another place, dressed alike."""
    a = views()[0]
    deeper = a.depth_mm.copy()
    deeper[:30, :40] += 600
    other = replace(a, depth_mm=deeper)
    old, new = (other, a) if side == "old" else (a, other)
    assert word in check_loop(old, new).refused


def test_matches_are_mutual_and_clear():
    rng = np.random.default_rng(0)
    old = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    order = rng.permutation(300)
    first, second = matches(old, old[order])
    assert len(first) == 300
    np.testing.assert_array_equal(order[second], first)
    twice = np.concatenate([old, old[:1]])
    assert 0 not in matches(twice, twice)[0]  # which of the two is not clear
    assert len(matches(old[:1], old)[0]) == 0
    assert len(matches(old, rng.integers(0, 256, (300, 32), dtype=np.uint8))[0]) == 0


def test_places_are_found_by_their_looks_and_forgotten():
    places = PlaceIndex(capacity=3)
    for number, seen_there in zip((3, 5, 8), views(), strict=False):
        assert not places.full
        places.add(number, seen_there)
    assert places.full
    for number, seen_there in zip((3, 5, 8), views(), strict=False):
        assert places.most_similar(seen_there)[0] == number
    assert places.most_similar(views()[2], before=8)[0] == 5
    assert places.most_similar(views()[0], before=3) == []
    places.forget(3)
    assert 3 not in places.most_similar(views()[0])
    places.add(9, views()[3])
    assert places.most_similar(views()[3])[0] == 9
    assert 9 not in places.most_similar(views()[0])[:1]


def test_an_index_grows_with_its_places():
    places = PlaceIndex(capacity=1000)
    begun = places._table.nbytes
    for number in range(64):
        places.add(number, views()[0])
    assert places._table.nbytes == begun <= 1 << 20
    places.add(64, views()[1])
    assert places._table.nbytes == 2 * begun
    assert places.most_similar(views()[1]) == [64]
    places.forget(64)
    assert places.most_similar(views()[1]) == []


def test_memory_is_bounded_and_the_way_stays_covered():
    closing = LoopClosing(Drifting(), capacity=20)
    for frame in two_laps()[:60]:
        closing.track(frame)
    kept = sorted(closing._places.views)
    assert len(kept) == 20
    assert kept[0] == 1
    assert kept[-1] == 60
    assert np.diff(kept).max() <= 6


def test_a_reset_forgets_and_a_lost_frame_changes_nothing():
    frames = two_laps()
    closing = LoopClosing(Drifting())
    for frame in frames[:68]:
        closing.track(frame)
    assert closing.corrections() is not None
    lost = closing.track(replace(frames[68], T_world_camera=None))
    assert isinstance(lost, Lost)
    assert closing.keyframes == 68
    assert closing.relocalise(frames[68]) is not None
    closing.reset()
    assert closing.corrections() is None
    assert closing.keyframes == 0
    assert closing.relocalise(frames[68]) is None
    closing.track(frames[0])
    assert closing.corrections() is None


def test_a_search_beside_the_tracker_finds_the_same():
    frames = two_laps()[::2][:40]
    alone, beside = LoopClosing(Drifting()), LoopClosing(Drifting(), beside=True)
    for frame in frames:
        there, here = alone.track(frame), beside.track(frame)
        np.testing.assert_array_equal(here.T_world_camera, there.T_world_camera)
    beside.settle()
    expected, found = alone.corrections(), beside.corrections()
    assert found.loops == expected.loops > 0
    np.testing.assert_array_equal(list(found.anchors.values()), list(expected.anchors.values()))
    assert beside.corrections() is None
    assert isinstance(beside.track(replace(frames[34], T_world_camera=None)), Lost)
    assert beside.relocalise(frames[34]) is not None
    beside.reset()
    assert beside.keyframes == 0


def test_a_lost_camera_finds_itself():
    frames = two_laps()
    closing = LoopClosing(Drifting())
    poses = [closing.track(frame) for frame in frames[:40]]
    found = closing.relocalise(frames[61])  # the second lap, between two keyframes
    anchor = poses[found.anchor - 1].T_world_camera
    np.testing.assert_allclose(found.T_world_camera, anchor @ found.T_anchor_camera)
    truth = se3.inverse(frames[found.anchor - 1].T_world_camera) @ frames[61].T_world_camera
    assert se3.distance(se3.inverse(truth) @ found.T_anchor_camera) < FAR
    assert closing.relocalise(frames[50]) is None  # never seen
    assert closing.keyframes == 40


def test_a_lost_tracker_goes_on_where_it_has_been_before():
    """The sensor walks on for 4 m, is covered, and wakes up where it was long ago: the world is the same."""
    dataset = Synthetic("corridor", count=520, width=320)
    alone = RGBDLocalizer()
    for index in range(34, 46):
        alone.track(dataset.frame(index))
    assert isinstance(alone.track(dataset.frame(8)), Lost)
    closing = LoopClosing(RGBDLocalizer())
    for index in range(46):
        assert isinstance(closing.track(dataset.frame(index)), TrackedPose)
    frame = dataset.frame(46)
    black = replace(frame, depth=np.zeros_like(frame.depth), color=np.zeros_like(frame.color))
    assert all(isinstance(closing.track(black), Lost) for _ in range(5))
    found = [(index, closing.track(dataset.frame(index))) for index in range(8, 16)]
    poses = [(index, pose) for index, pose in found if isinstance(pose, TrackedPose)]
    assert len(poses) >= 6, found
    for index, pose in poses:
        truth = se3.inverse(dataset.pose(0)) @ dataset.pose(index)
        error = se3.inverse(truth) @ pose.T_world_camera
        assert se3.distance(error) < FAR, index
        assert np.degrees(se3.angle(error)) < TURNED
    assert len({pose.anchor for _, pose in poses} & set(range(3))) == 0  # anchors are never used twice
    elsewhere = Synthetic("room", count=40)
    assert all(isinstance(closing.track(elsewhere.frame(0)), Lost) for _ in range(4))


def test_places_without_colour_are_seen_again_by_their_depth():
    """Twice round the things in a room, with drift; views of a plain wall close nothing."""
    dataset = Synthetic("room", count=160, path="handheld", color=False)
    run = Run(frames_of(dataset))
    assert run.error(run.corrections[-1]).rmse <= 0.6 * run.error(None).rmse
    assert run.wrong() == []
    wall = replace(dataset.frame(0), depth=np.full(dataset.frame(0).shape, 20_000, np.uint16))
    refused = check_loop(seen(wall), seen(wall), np.eye(4)).refused
    assert refused is not None
    assert "open" in refused


def test_lidar_frames_pass_through():
    run = Run(frames_of(Synthetic("room", "lidar", count=12, color=False)))
    assert len(run.track) == 12
    assert run.corrections == []


def test_without_scipy_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.sparse", None)
    with pytest.raises(MissingDependency, match=r"pip install '.\[slam\]'"):
        LoopClosing(Drifting())


def straight(count: int, drift: OdometryDrift | None = None) -> OdometryChain:
    chain = OdometryChain(drift or OdometryDrift())
    for number in range(count):
        chain.add(number, se3.exp(np.array([0.5 * number, 0, 0, 0, 0, 0])))
    return chain


def claim(old: int, new: int, *, off: float = 0.0, sigma: float = 0.02) -> Loop:
    """Check that `new` stands where odometry puts it, `off` metres farther along."""
    return Loop(old, new, se3.exp(np.array([0.5 * (new - old) + off, 0, 0, 0, 0, 0])), sigma)


def test_odometry_knows_how_far_it_may_be_off():
    """The covariance of a stretch against that of a thousand walks with the stated noise."""
    rng = np.random.default_rng(9)
    drift = OdometryDrift(translation_bias=0.0, rotation_bias=0.0)
    steps = [se3.exp(np.array([0.4, 0.1, 0, 0, 0.1 * (k % 3), 0.2])) for k in range(12)]
    chain = OdometryChain(drift)
    T = se3.exp(rng.normal(0, 1, 6))
    for number in range(13):
        chain.add(number, T)
        T = T @ steps[min(number, 11)]
    mean, covariance = chain.between(2, 12)
    np.testing.assert_allclose(mean, np.linalg.multi_dot(steps[2:12]), atol=1e-12)
    errors = []
    for _ in range(1000):
        walked = np.eye(4)
        for step in steps[2:12]:
            way = se3.distance(step) + se3.angle(step)
            sigma = [np.hypot(drift.translation * np.sqrt(way), drift.floor)] * 3
            sigma += [np.hypot(drift.rotation * np.sqrt(way), drift.floor / 3)] * 3
            walked = walked @ step @ se3.exp(rng.normal(0, 1, 6) * sigma)
        errors.append(se3.log(se3.inverse(mean) @ walked))
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), np.array(errors).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.2)
    back, covariance_back = chain.between(12, 2)
    np.testing.assert_allclose(back @ mean, np.eye(4), atol=1e-12)
    A = se3.adjoint(mean)
    np.testing.assert_allclose(covariance_back, A @ covariance @ A.T, rtol=1e-6, atol=1e-12)


def test_one_loop_is_not_accepted_and_three_that_agree_are():
    consensus = LoopConsensus(straight(60))
    off = 1.0  # between 3 and 6 deviations: more than expected, less than impossible
    far = claim(0, 50, off=off)
    assert 3 < consensus.deviation(far.old, far.new, far.T_old_new, far.covariance) < 6
    assert consensus.add([far]) == []
    assert consensus.add([claim(1, 51, off=off - 0.7)]) == []  # does not agree with it
    assert consensus.add([claim(1, 52, off=off)]) == []
    accepted = consensus.add([claim(2, 53, off=off)])
    assert [(loop.old, loop.new) for loop in accepted] == [(0, 50), (1, 52), (2, 53)]
    assert [loop.new for loop in consensus.add([claim(3, 54, off=off)])] == [54]
    assert consensus.add([claim(4, 55, off=off + 1.0)]) == []  # contradicts those accepted
    assert consensus.refused == {"contradicts the odometry": 1}


def test_where_odometry_expects_a_loop_two_suffice():
    consensus = LoopConsensus(straight(60))
    assert consensus.add([claim(0, 50)]) == []
    assert len(consensus.add([claim(1, 51)])) == 2


def test_a_look_alike_nearby_makes_a_loop_doubtful():
    """Twelve deviations are needed to rule another explanation out."""
    consensus = LoopConsensus(straight(60))
    for new in range(50, 54):
        found = consensus.add([claim(new - 50, new), claim(new - 48, new, off=2.0)])
        assert found == []
    assert consensus.refused["fits another place too"] == 4
    small = OdometryDrift(translation=0.005, rotation=0.001, translation_bias=0.002)
    sure = LoopConsensus(straight(60, small))
    for new in range(50, 54):
        found += sure.add([claim(new - 50, new), claim(new - 48, new, off=2.0)])
    assert len(found) == 4


def test_loops_of_one_keyframe_that_contradict_each_other_are_both_refused():
    consensus = LoopConsensus(straight(60))
    for new in range(50, 54):
        assert consensus.add([claim(new - 50, new), claim(new - 49, new, off=0.9)]) == []
    assert consensus.refused == {"fits another place too": 4}


def test_an_image_too_small_is_no_place():
    frame = two_laps()[0]
    tiny = replace(frame, depth=frame.depth[:8, :40].copy(), color=frame.color[:8, :40].copy())
    assert place_view(tiny, tiny.depth_m) is None


def test_a_place_seen_to_have_a_twin_is_doubtful_ever_after():
    chain = straight(400)
    consensus = LoopConsensus(chain)
    twin = Loop(0, 8, np.eye(4), 0.02)  # 8 stands 4 m from 0 and looks as if it stood there
    assert consensus.add([twin]) == []
    assert consensus.refused == {"contradicts the odometry": 1}
    for new in range(390, 396):
        assert consensus.add([claim(8, new)]) == []  # it may as well be at 0: 4 m are nothing after 190
    assert consensus.refused["fits another place too"] == 6
    assert len([loop for new in range(390, 396) for loop in consensus.add([claim(20, new)])]) >= 2


def test_a_loop_the_graph_withdraws_counts_no_more():
    consensus = LoopConsensus(straight(60))
    for new in (50, 51):
        consensus.add([claim(new - 50, new)])
    wrong = consensus.accepted[0]
    consensus.withdraw(wrong)
    assert wrong not in consensus.accepted
    assert consensus.refused == {"contradicts other loops": 1}


def test_the_corridor_has_two_laps_and_the_rooms_are_equal():
    ring = open_dataset("synthetic:corridor", count=80, width=64, noise=False)
    poses = np.array([ring.pose(index) for index in range(80)])
    assert ring.distance(poses[:, :3, 3]).min() > 0.3
    between = np.linalg.norm(poses[:40, :3, 3] - poses[40:, :3, 3], axis=1)
    assert np.median(between) > 0.05
    assert between.max() < 0.3
    rooms = open_dataset("synthetic:rooms", count=60, width=64, noise=False)
    assert rooms.distance(np.array([rooms.pose(index)[:3, 3] for index in range(60)])).min() > 0.3
    step = worlds.PITCH / (rooms.pose(1)[0, 3] - rooms.pose(0)[0, 3])
    assert step == pytest.approx(round(step))
    one, two = rooms.frame(5), rooms.frame(5 + round(step))
    assert (one.color == two.color).mean() > 0.97
    assert (one.depth == two.depth).mean() > 0.97
    other = Synthetic(worlds.rooms(identical=False), count=60, width=64, noise=False)
    assert (other.frame(5).color == other.frame(5 + round(step)).color).mean() < 0.5


def test_calls_are_made_in_order() -> None:
    work, made = OrderedWork("test", 3), list[int]()
    for number in range(50):
        work.add(made.append, number)
    work.wait()
    assert made == list(range(50))


def test_what_waits_has_an_end() -> None:
    work, go, began = OrderedWork("test", 2), threading.Event(), threading.Event()

    def slow() -> None:
        began.set()
        assert go.wait(SOON)

    work.add(slow)
    work.add(lambda: None)
    assert began.wait(SOON)
    added = threading.Event()
    adding = threading.Thread(target=lambda: (work.add(lambda: None), added.set()), daemon=True)
    adding.start()
    assert not added.is_set()  # there is no room
    go.set()
    assert added.wait(SOON)
    adding.join(SOON)
    work.wait()


def test_an_error_is_raised() -> None:
    work = OrderedWork("test", 2)
    work.add(lambda: 1 // 0)  # type: ignore[arg-type,return-value]
    with pytest.raises(ZeroDivisionError):
        work.wait()
    work.wait()
