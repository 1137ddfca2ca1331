# SPDX-License-Identifier: MIT
"""Scans that find their place in a map before they send, or go into a map of their own."""

import concurrent.futures
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_processes import Here
from idle_fuser import keeping
from journaled_maps import unknown_start
from keyframes_and_servers import Server

from tsfusion import AlignmentRefused, Keyframe, Mesh, Volume, VolumeConfig, open_dataset
from tsfusion.cli.progress import Quiet
from tsfusion.core.config import ClientConfig, ScanConfig
from tsfusion.datasets import select
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.pipelines.maps import scan_alignment
from tsfusion.pipelines.maps.scan_alignment import ExistingMap, PlacedLocalizer, PlacementTry, find_place
from tsfusion.pipelines.report.run_record import RunRecord
from tsfusion.pipelines.runs import run as pipelines_run
from tsfusion.scanner.keyframe_selection import KeyframeSelector
from tsfusion.scanner.localization.localizer import Lost, PoseCorrections, TrackedPose
from tsfusion.scanner.sources.source import RecordedSource

CONFIG = VolumeConfig(voxel_size=0.05, threads=1)
T = unknown_start(2)  # T_map_world
MAP = ExistingMap("hall", Mesh(*(np.zeros((3, 3), dtype) for dtype in ("f4", "i4", "f4"))), 0.05)
FRAMES = 4


class Inline:
    """Runs what it is given at once, in this process."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __enter__(self) -> "Inline":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def submit(self, work: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        future: Future[Any] = Future()
        try:
            future.set_result(work(*arguments))
        except BrokenExecutor as error:
            future.set_exception(error)
        return future


@pytest.fixture
def tries(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of keyframes with which the place was looked for; it is found with 14 or more."""
    counts: list[int] = []

    def locate(_: ExistingMap, __: VolumeConfig, keyframes: list[Keyframe]) -> PlacementTry:
        counts.append(len(keyframes))
        return PlacementTry(T, "") if len(keyframes) >= 14 else PlacementTry(None, "too little")

    monkeypatch.setattr(concurrent.futures, "ProcessPoolExecutor", Inline)
    monkeypatch.setattr(scan_alignment, "locate", locate)
    return counts


class Straight:
    """Goes on by 0.2 m a frame, and is lost for good at some frame."""

    absolute = False

    def __init__(self, lost_at: int = 10**9) -> None:
        self.frames = 0
        self._lost_at = lost_at

    def track(self, frame: Frame) -> TrackedPose | Lost:
        self.frames += 1
        if self.frames > self._lost_at:
            return Lost(reason="dark", timestamp_ns=frame.timestamp_ns)
        pose = se3.transform(np.eye(3), (0.2 * self.frames, 0, 0))
        return TrackedPose(
            T_world_camera=pose, timestamp_ns=frame.timestamp_ns, anchor=1, T_anchor_camera=np.eye(4)
        )

    def corrections(self) -> PoseCorrections | None:
        one = {1: se3.transform(np.eye(3), (0.0, 0.1, 0.0))}
        return PoseCorrections(anchors=one, T_corrected_world=one[1], loops=1)

    def prepare(self) -> None:
        pass

    def settle(self) -> None:
        pass

    def reset(self) -> None:
        pass


def frames(count: int) -> Iterator[Frame]:
    for i in range(count):
        yield Frame(sensor="lidar", timestamp_ns=i, points=np.full((4, 3), i, np.float32))


def found(localizer: Straight, count: int, *, live: bool = False) -> scan_alignment.Placing:
    selector = KeyframeSelector(ScanConfig(distance=0.3), outdoors=False)
    return find_place(MAP, CONFIG, localizer, frames(count), selector, live=live, tell=lambda _: None)


def test_it_tries_again_with_more_keyframes(tries: list[int]) -> None:
    placing = found(Straight(), 100)
    assert tries == [12, 18]
    assert np.array_equal(placing.T_map_world, T)  # type: ignore[arg-type]
    kept = [frame.points is not None and len(frame.points) for frame in placing.frames]
    assert kept == [4, 0] * 17 + [4]  # every second is a keyframe; of others only the pose is kept
    localizer = PlacedLocalizer(Straight(), T, placing.answers)
    assert localizer.corrections() is None  # until the keyframes that they name were sent
    for frame, answer in zip(placing.frames, placing.answers, strict=True):
        moved = localizer.track(frame)
        assert isinstance(moved, TrackedPose)
        assert isinstance(answer, TrackedPose)
        assert np.allclose(moved.T_world_camera, T @ answer.T_world_camera)
    corrections = localizer.corrections()
    assert corrections is not None
    anchor, by = corrections.anchors[1], corrections.T_corrected_world
    assert np.allclose(anchor, T @ se3.transform(np.eye(3), (0.0, 0.1, 0.0)))
    assert np.allclose(by @ T, anchor)  # what follows in the map's frame is corrected likewise
    localizer.reset()  # the sensor was lost: a new world, of which nothing is known
    again = localizer.track(placing.frames[0])
    assert isinstance(again, TrackedPose)
    assert np.allclose(again.T_world_camera[:3, :3], np.eye(3))


def test_the_last_try_is_with_all_there_is(tries: list[int]) -> None:
    assert found(Straight(), 31).T_map_world is not None
    assert tries == [12, 16]
    tries.clear()
    placing = found(Straight(lost_at=25), 100)
    assert (placing.T_map_world, placing.why, tries) == (None, "too little", [12, 13])
    assert isinstance(placing.answers[-1], Lost)
    assert found(Straight(lost_at=0), 3).why == "no frame had a pose"


def test_keyframes_that_wait_are_limited(tries: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan_alignment, "locate", lambda *_: PlacementTry(None, "too little"))
    placing = found(Straight(), 10_000)
    assert len(placing.keyframes) == scan_alignment.MOST_KEYFRAMES

    def dies(*_: Any) -> PlacementTry:
        raise BrokenExecutor

    monkeypatch.setattr(scan_alignment, "locate", dies)
    assert "the process that looked for it ended" in found(Straight(), 30).why


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with keeping(tmp_path_factory.mktemp("places")) as running:
        yield running


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, server: Server) -> Callable[..., RunRecord]:
    """A scan of a few frames, into a map that is said to have a surface."""
    monkeypatch.setattr(pipelines_run, "_existing_map", lambda target: MAP._replace(name=target.link.map))
    monkeypatch.setattr(concurrent.futures, "ProcessPoolExecutor", Inline)

    def run(map_name: str, *, align: bool) -> RunRecord:
        plan = pipelines_run.RunPlan(
            source=RecordedSource(select(open_dataset("synthetic:room"), limit=FRAMES)),
            scan=ScanConfig(localizer="rgbd"), volume=CONFIG, connect=server.address,
            client=ClientConfig(map=map_name), spool=tmp_path / "spool", align=align,
        )  # fmt: skip
        return pipelines_run.run(plan, tmp_path / "out", Quiet(), overwrite=True)

    return run


def poses(server: Server, map_name: str) -> list[np.ndarray]:
    recording = JournalRecording(state_folder.map_folder(server.state, map_name))
    return [recording[i].T_world_camera for i in range(len(recording))]


def test_a_placed_scan_is_of_the_maps_frame(
    scan: Callable[..., RunRecord], server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan("hall", align=False)
    before = poses(server, "hall")
    monkeypatch.setattr(scan_alignment, "locate", lambda *_: PlacementTry(T, ""))
    second = scan("hall", align=True)  # without: refused, as it is of another world
    assert (second.frames, second.complete) == (FRAMES, True)
    sent = poses(server, "hall")[len(before) :]
    assert len(sent) == len(before) > 0
    assert all(np.allclose(now, T @ then) for now, then in zip(sent, before, strict=True))


def test_an_unplaced_scan_goes_into_a_map_of_its_own(
    scan: Callable[..., RunRecord], server: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    scan("yard", align=False)
    before = poses(server, "yard")
    monkeypatch.setattr(scan_alignment, "locate", lambda *_: PlacementTry(None, "they share too little"))
    with pytest.raises(AlignmentRefused, match=r"the scan is in the map yard-2, as .* they share too little"):
        scan("yard", align=True)
    assert len(poses(server, "yard")) == len(before)
    assert all(map(np.allclose, poses(server, "yard-2"), before))
    assert (tmp_path / "out/run.json").exists()


def test_flags_that_do_not_go_together(here: Here) -> None:
    said = here("scan", "synthetic:room", "--align").stderr
    assert "--align has no effect without --connect" in said
    said = here("scan", "synthetic:room", "--align", "--same-frame", "--connect", "tcp://127.0.0.1:10").stderr
    assert "--same-frame and --align exclude each other" in said


def test_the_place_of_keyframes_in_a_surface() -> None:
    dataset = open_dataset("synthetic:room")
    volume, own = Volume(CONFIG), []
    for i in range(0, 40, 2):
        if i < 26:
            volume.integrate(dataset[i])
        if i >= 12:
            keyframe = dataset[i]
            own.append(replace(keyframe, T_world_camera=se3.inverse(T) @ keyframe.T_world_camera))
    existing = ExistingMap("hall", volume.extract_mesh(), CONFIG.voxel_size)
    answer = scan_alignment.locate(existing, CONFIG, own)
    assert answer.T_map_world is not None, answer.why
    assert np.allclose(answer.T_map_world, T, atol=0.02)
