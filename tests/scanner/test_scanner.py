# SPDX-License-Identifier: MIT
"""The scanner's loop: what is lost is never sent, and a new world goes into a map of its own."""

import logging
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from keyframes_and_servers import CAMERA, journaled_corrections, pose, serving, until, wall
from quick_fusers import SUMS

from tsfusion import Client
from tsfusion.core.config import ScanConfig
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.scanner.localization.localizer import Localizer, Lost, PoseCorrections, TrackedPose
from tsfusion.scanner.scanner import Scanner
from tsfusion.scanner.tracked_trajectory import TrackedTrajectory

FRAME_NS = 100_000_000
NOBODY = "tcp://127.0.0.1:1"


class Scripted:
    """Scripted localizer: `T`racked, `L`ost, or `C`: a pose, and a loop that moves all by 5 cm."""

    def __init__(self, script: str, *, absolute: bool = False) -> None:
        self.absolute = absolute
        self.resets = 0
        self._script, self._at, self._anchor = script, -1, 0
        self._news: PoseCorrections | None = None
        self._anchors: dict[int, np.ndarray] = {}

    def track(self, frame: Frame) -> TrackedPose | Lost:
        self._at += 1
        if self._script[self._at] == "L":
            return Lost(reason="the script says so", timestamp_ns=frame.timestamp_ns)
        self._anchor += 1
        T = pose(0.2 * self._at)
        self._anchors[self._anchor] = T
        if self._script[self._at] == "C":
            moved = {number: pose(0, 0.05) @ anchor for number, anchor in self._anchors.items()}
            self._news = PoseCorrections(anchors=moved, T_corrected_world=pose(0, 0.05), loops=1)
        return TrackedPose(
            T_world_camera=T, timestamp_ns=frame.timestamp_ns, anchor=self._anchor,
            T_anchor_camera=np.eye(4), starts_anchor=True,
        )  # fmt: skip

    def corrections(self) -> PoseCorrections | None:
        news, self._news = self._news, None
        return news

    def prepare(self) -> None:
        pass

    def settle(self) -> None:
        pass

    def reset(self) -> None:
        self.resets += 1
        self._anchors = {}


def frames(count: int) -> Iterator[Frame]:
    """Walls at ten a second, whose stamp tells which is which."""
    for index in range(count):
        keyframe = wall(index)
        yield Frame(
            sensor="kinect", depth=keyframe.depth, color=keyframe.color, intrinsics=CAMERA,
            timestamp_ns=(index + 1) * FRAME_NS,
        )  # fmt: skip


@contextmanager
def scanned(
    spools: Path,
    localizer: Localizer,
    count: int,
    *,
    address: str = NOBODY,
    free_name: str | None = None,
    **config: float,
) -> Iterator[Scanner]:
    """A scanner that has taken so many frames; without a server all keyframes stay in its spools."""
    with ExitStack() as stack:

        def connect(name: str) -> Client:
            return stack.enter_context(Client(address, spool=spools / name, map=name, policy="spool_all"))

        scanner = Scanner(
            localizer, ScanConfig(**config), connect, map_name="hall", free_name=lambda: free_name
        )
        scanner.run(frames(count), lambda _: None)
        yield scanner


def spooled(spools: Path, name: str) -> list[int]:
    """Which frames were to be sent to a map."""
    return [keyframe.timestamp_ns // FRAME_NS - 1 for keyframe in JournalRecording(spools / name)]


def test_another_rule_may_choose_the_keyframes(tmp_path: Path) -> None:
    class EveryThird:
        def reason(self, frame: Frame, _T: np.ndarray) -> str | None:
            return None if frame.timestamp_ns // FRAME_NS % 3 else "third"

        def accept(self, frame: Frame, _T: np.ndarray) -> None:
            pass

        def reset(self) -> None:
            pass

    client = Client(NOBODY, spool=tmp_path / "hall", map="hall", policy="spool_all")
    with client:
        scanner = Scanner(
            Scripted("T" * 7), ScanConfig(), lambda _: client, map_name="hall", selector=EveryThird()
        )
        scanner.run(frames(7), lambda _: None)
    assert scanner.state().selected == {"third": 2}
    assert spooled(tmp_path, "hall") == [2, 5]


def test_a_lost_sensor_sends_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "tsfusion")
    with scanned(tmp_path, Scripted("LTTLLLTT"), 8) as scanner:
        until(lambda: "no server answers" in scanner.state().link)
        state = scanner.state()
    assert (state.state, state.frames, state.tracked, state.lost) == ("tracking", 8, 4, 4)
    assert (state.submaps, state.selected) == (1, {"first": 1, "distance": 3})
    assert (state.stats.sent, state.stats.waiting, state.stats.durable) == (4, 4, 0)
    assert state.keyframe_delay_ms is None
    assert spooled(tmp_path, "hall") == [1, 2, 6, 7]
    assert "the sensor is lost: the script says so" in caplog.text
    assert "found again" in caplog.text


def test_lost_for_long_a_new_map_begins(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    localizer = Scripted("TTT" + "L" * 11 + "TTLT")
    with scanned(tmp_path, localizer, 18) as scanner:
        assert [submap.name for submap in scanner.submaps] == ["hall", "hall-2"]
        assert localizer.resets == 1
        assert scanner.state().stats.sent == 6
        assert len(scanner.submaps[1].located) == 3
    assert spooled(tmp_path, "hall") == [0, 1, 2]
    assert spooled(tmp_path, "hall-2") == [14, 15, 17]
    assert "a new map, hall-2" in caplog.text


@pytest.mark.parametrize(("free", "named"), [("hall-7", "hall-7"), ("hall", "hall-2")])
def test_a_new_map_is_one_that_nobody_has(tmp_path: Path, free: str, named: str) -> None:
    """The server knows which names are free; one that this scan has itself is not."""
    with scanned(tmp_path, Scripted("T" + "L" * 12 + "T"), 14, free_name=free) as scanner:
        assert [submap.name for submap in scanner.submaps] == ["hall", named]


@pytest.mark.parametrize("script", ["L" * 30 + "TT", "TT" + "L" * 9 + "T"])
def test_no_new_map_before_the_first_or_within_patience(tmp_path: Path, script: str) -> None:
    localizer = Scripted(script)
    with scanned(tmp_path, localizer, len(script)) as scanner:
        assert (len(scanner.submaps), localizer.resets) == (1, 0)
        assert scanner.state().stats.sent == script.count("T")


def test_poses_from_elsewhere_stay_in_one_world(tmp_path: Path) -> None:
    localizer = Scripted("T" + "L" * 30 + "T", absolute=True)
    with scanned(tmp_path, localizer, 32, patience=0.5) as scanner:
        assert (len(scanner.submaps), localizer.resets) == (1, 0)
        assert scanner.state().state == "tracking"


def test_corrections_reach_the_server(tmp_path: Path) -> None:
    with (
        serving(tmp_path / "state", fuser=SUMS) as server,
        scanned(tmp_path / "spools", Scripted("TTTC"), 4, address=server.address) as scanner,
    ):
        (submap,) = scanner.submaps
        submap.client.flush(timeout=60)
        assert scanner.state().loops == 1
        assert submap.client.stats.corrections_acknowledged == 1
    (sent,) = journaled_corrections(tmp_path / "state", "hall")
    assert list(sent.seqs) == submap.located.seqs.tolist()
    np.testing.assert_allclose(sent.poses[3], pose(0, 0.05) @ submap.located.poses()[3])
    np.testing.assert_allclose(sent.T_map_odometry, pose(0, 0.05))


def test_a_server_with_room_for_two_maps_is_asked_for_no_third(tmp_path: Path) -> None:
    localizer = Scripted(("T" + "L" * 12) * 3 + "T")
    names: list[str] = []
    with ExitStack() as stack:

        def connect(name: str) -> Client:
            names.append(name)
            return stack.enter_context(Client(NOBODY, spool=tmp_path / name, map=name, policy="spool_all"))

        scanner = Scanner(localizer, ScanConfig(), connect, map_name="hall", most=2)
        scanner.run(frames(40), lambda _: None)
        assert (names, localizer.resets) == (["hall", "hall-2"], 1)
        assert [len(submap.located) for submap in scanner.submaps] == [1, 3]


def test_in_the_end_keyframes_since_the_last_loop_are_moved_too(tmp_path: Path) -> None:
    with (
        serving(tmp_path / "state", fuser=SUMS) as server,
        scanned(tmp_path / "spools", Scripted("TCTT"), 4, address=server.address) as scanner,
    ):
        (submap,) = scanner.submaps
        scanner.finish()
        scanner.finish()
        submap.client.flush(timeout=60)
        assert submap.client.stats.corrections_sent == 2
    _, sent = journaled_corrections(tmp_path / "state", "hall")
    assert len(sent.seqs) == 4
    np.testing.assert_allclose(sent.poses[3], pose(0, 0.05) @ submap.located.poses()[3])


def test_a_track_gives_back_what_it_took() -> None:
    rng = np.random.default_rng(5)
    track, poses, references = TrackedTrajectory(), [], []
    assert (len(track), len(track.poses()), len(track.keyframes()[0]), track.last_seq) == (0, 0, 0, -1)
    for number in range(20):
        T, T_anchor, reference = (se3.exp(rng.normal(0, 1, 6)) for _ in range(3))
        references.append(reference)
        poses.append(
            TrackedPose(
                T_world_camera=T, timestamp_ns=number << 40, anchor=number // 3, T_anchor_camera=T_anchor,
                starts_anchor=number % 3 == 0,
            )
        )  # fmt: skip
        track.add(poses[-1], reference if number % 2 else None, number + 7 if number % 4 == 0 else None)
    np.testing.assert_array_equal(track.poses(), [given.T_world_camera for given in poses])
    assert track.stamps_ns == [given.timestamp_ns for given in poses]
    anchors = {number: se3.exp(rng.normal(0, 1, 6)) for number in range(4)}
    moved = PoseCorrections(anchors=anchors, T_corrected_world=se3.exp(rng.normal(0, 1, 6)), loops=1)
    known = [anchors[given.anchor] @ given.T_anchor_camera for given in poses if given.anchor in anchors]
    later = [given for given in poses if given.anchor not in anchors]
    one_by_one = [*known, *(moved.T_corrected_world @ given.T_world_camera for given in later)]
    np.testing.assert_allclose(track.poses(moved), one_by_one, atol=1e-12)
    seqs, chosen = track.keyframes(moved)
    assert seqs.tolist() == [7, 11, 15, 19, 23]
    np.testing.assert_allclose(chosen, track.poses(moved)[::4])
    which, kept = track.with_reference()
    assert which.tolist() == [*range(1, 20, 2)]
    np.testing.assert_array_equal(kept, references[1::2])


def test_a_track_of_an_hour_is_small() -> None:
    track = TrackedTrajectory()
    T = np.eye(4)
    tracemalloc.start()
    for number in range(20_000):
        track.add(TrackedPose(T_world_camera=T, timestamp_ns=number, anchor=0, T_anchor_camera=T), T, number)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size / len(track) < 400


def test_names_of_submaps_fit() -> None:
    names = []

    class Stub:
        pass

    def connect(name: str) -> Stub:
        names.append(name)
        return Stub()

    made: Callable[..., Scanner] = Scanner
    scanner = made(Scripted("T"), ScanConfig(), connect, map_name="m" * 32)
    scanner._begin_submap(1.0)
    assert scanner._next == "m" * 30 + "-2"
    assert names == ["m" * 32]  # no map on the server for a sensor that never sees anything again
