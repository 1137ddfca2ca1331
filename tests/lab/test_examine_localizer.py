# SPDX-License-Identifier: MIT
"""The localizer's examination: it runs the scan's code, and its variants are true to their poses."""

import hashlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from command_processes import FORGETFUL_RUN, tsfusion

from lab.evaluation import examine_covariance, examine_localizer, examined_scenes
from lab.evaluation.drive_variants import LIDAR_VARIANTS, STEREO_VARIANTS, ahead
from lab.evaluation.recording_variants import VARIANTS, Frames, without_color
from tsfusion.datasets import Synthetic, open_dataset, select
from tsfusion.datasets.trajectory_files import read_poses, write_tum
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import points_world
from tsfusion.scanner.localization.stereo.stereo_tracker import StereoLocalizer
from tsfusion.scanner.sources.source import RecordedSource

COUNT = 14
POSES = """
import hashlib, pickle, sys
import cv2
cv2.setNumThreads(int(sys.argv[2]))
from lab.evaluation.examine_localizer import play
with open(sys.argv[1], "rb") as file:
    scanner = play(pickle.load(file))
print(hashlib.sha256(scanner.submaps[0].located.poses().tobytes()).hexdigest())
"""


@pytest.fixture(scope="module")
def room() -> Synthetic:
    return Synthetic("room", count=COUNT, path="handheld", noise=False)


@pytest.fixture(scope="module")
def frames(room: Synthetic) -> Frames:
    return list(RecordedSource(room))


def test_a_scan_and_the_examination_find_the_same_poses(tmp_path: Path) -> None:
    options = [word for name in (f"count={COUNT}", "path=handheld") for word in ("--option", name)]
    done = tsfusion("scan", "synthetic:room", *options, "--out", tmp_path / "out", command=FORGETFUL_RUN)
    assert (tmp_path / "out" / "trajectory.txt").exists(), done.stderr
    played = list(RecordedSource(open_dataset("synthetic:room", count=COUNT, path="handheld")))
    located = examine_localizer.play(played).submaps[0].located
    write_tum(tmp_path / "examined.txt", located.stamps_ns, list(located.poses()))
    assert (tmp_path / "examined.txt").read_text() == (tmp_path / "out" / "trajectory.txt").read_text()
    assert len(read_poses(tmp_path / "examined.txt")[1]) == COUNT


def _seen(sensor: str, root: Path) -> Frames:
    """Frames of the first seconds of KITTI, below the folder `root`."""
    sequence = {"stereo": "06", "lidar": "00"}[sensor]
    return list(RecordedSource(select(open_dataset(root, sequence=sequence, modality=sensor), limit=6)))


@pytest.mark.parametrize("sensor", ["kinect", "stereo", "lidar"])
def test_neither_threads_nor_load_change_a_pose(
    sensor: str, request: pytest.FixtureRequest, data: Callable[[str], Path], tmp_path: Path
) -> None:
    is_room = sensor == "kinect"
    frames = request.getfixturevalue("frames") if is_room else _seen(sensor, data("kitti_odometry"))
    (tmp_path / "frames").write_bytes(pickle.dumps(frames))
    expected = examine_localizer.play(frames).submaps[0].located.poses()
    found = [_poses_elsewhere(tmp_path / "frames", threads) for threads in (1, 2)]
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        found += [_poses_elsewhere(tmp_path / "frames", threads) for threads in (1, 2)]
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert set(found) == {hashlib.sha256(expected.tobytes()).hexdigest()}


@pytest.mark.parametrize("sensor", ["stereo", "lidar"])
def test_a_name_changes_no_pose(sensor: str, data: Callable[[str], Path], tmp_path: Path) -> None:
    found = set()
    for name in ("kitti_odometry", "drive", "euroc"):
        (tmp_path / name).symlink_to(data("kitti_odometry"))
        located = examine_localizer.play(_seen(sensor, tmp_path / name)).submaps[0].located
        assert len(located) == 6
        found.add(located.poses().tobytes())
    assert len(found) == 1


def _poses_elsewhere(frames: Path, threads: int) -> str:
    counts = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
    root = str(Path(examine_localizer.__file__).parents[2])
    done = subprocess.run(
        [sys.executable, "-c", POSES, str(frames), str(threads)], capture_output=True, text=True, check=True,
        timeout=120, env={**os.environ, **counts, "PYTHONPATH": root},
    )  # fmt: skip
    return done.stdout.strip()


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_variant_has_poses_in_time_order(frames: Frames, variant: str) -> None:
    chosen, again = (VARIANTS[variant](frames, np.random.default_rng(1)) for _ in range(2))
    stamps = [frame.timestamp_ns for frame in chosen]
    assert len(chosen) >= COUNT // 3
    assert stamps == sorted(set(stamps))
    assert all(frame.T_world_camera is not None for frame in chosen)
    assert all(np.array_equal(a.depth, b.depth) for a, b in zip(chosen, again, strict=True))


@pytest.mark.parametrize(
    "variant", ["twice the size", "half the size", "backwards", "mirrored", "near depth"]
)
def test_a_variant_shows_the_true_surface(room: Synthetic, frames: Frames, variant: str) -> None:
    bound = 0.02 if "size" in variant else 0.002
    for frame in VARIANTS[variant](frames, np.random.default_rng(1))[::5]:
        assert frame.T_world_camera is not None
        points = points_world(frame.keyframe(frame.T_world_camera))
        points = points * (-1, 1, 1) if variant == "mirrored" else points
        assert np.percentile(np.abs(room.distance(points)), 95) < bound


@pytest.mark.parametrize("variant", ["backwards", "mirrored", "a sector lost", "covered"])
def test_a_sweep_shows_the_true_surface(variant: str) -> None:
    street = Synthetic("street", "lidar", count=4, color=False, noise=False)
    chosen = LIDAR_VARIANTS[variant](list(RecordedSource(street)), np.random.default_rng(1))
    assert sorted({frame.timestamp_ns for frame in chosen}) == [frame.timestamp_ns for frame in chosen]
    for frame in chosen:
        assert frame.T_world_camera is not None
        points = se3.apply(frame.T_world_camera, np.asarray(frame.points))
        points = points * (1, -1, 1) if variant == "mirrored" else points
        assert np.percentile(np.abs(street.distance(points)), 95) < 0.002


def test_a_van_stands_at_its_distance_in_both_images(data: Callable[[str], Path]) -> None:
    chosen = STEREO_VARIANTS["a van ahead"](_seen("stereo", data("kitti_odometry")), np.random.default_rng(1))
    frame, K = chosen[0], chosen[0].intrinsics
    assert K is not None
    (distance, left), row = ahead(0)[0], round(K.cy)
    column = round(K.cx - K.fx * left / distance)
    disparity = frame.matched[row - 20 : row + 20, column - 20 : column + 20] / 16
    assert np.median(disparity) == pytest.approx(frame.baseline_fx / distance, abs=0.3)


def scanned(scene: str, variant: str) -> dict[str, float]:
    """Figures of a scan of a variant of a recorded scene."""
    frames = examine_localizer.frames_of(scene)
    assert not isinstance(frames, str)
    chosen = VARIANTS[variant](frames, np.random.default_rng(1))
    return examine_localizer.judged(examine_localizer.play(chosen), chosen)


def test_a_phone_with_near_smooth_depth_is_followed(data: Callable[[str], Path]) -> None:
    data("record3d_export")
    row = scanned("Record3D", "whole")
    assert row["lost"] <= 3
    assert row["ate_mm"] < 15


def test_a_step_in_exposure_is_outlived(data: Callable[[str], Path]) -> None:
    data("hololens")
    row = scanned("HoloLens", "light goes out by half")
    assert row["lost"] <= 3
    assert row["ate_mm"] < 10


def test_a_true_covariance_covers_as_many_errors_as_it_says() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(6, 6))
    some = [(root @ rng.normal(size=6), root @ root.T) for _ in range(2000)]
    for share, chi2 in examine_covariance.NOMINAL.items():
        assert abs(examine_covariance.coverage(some, 1, (0, 0), chi2) - share) < 0.03
    assert examine_covariance.coverage(some, 0.5, (0, 0)) < 0.4
    assert examine_covariance.coverage(some, 0.5, (9, 9)) == 1  # a truth that is no better


def test_poses_of_a_room_have_a_covariance() -> None:
    frames = list(RecordedSource(Synthetic("room", count=8, path="handheld")))
    found = examine_covariance.cases(frames)
    assert len(found) == 7
    assert "room" in examine_covariance.report({"room": found, "other room": found})


@pytest.fixture(scope="module")
def swung() -> Frames:
    """A second of a room swung through at 30 Hz."""
    return examined_scenes.fast_turns(7)[:30]


@pytest.fixture(scope="module")
def turned(swung: Frames) -> Frames:
    """Frames of a fast turn at 10 Hz: twenty degrees lie between two of them."""
    return swung[::3]


def test_a_gyroscope_helps_depth_alone_through_fast_turns(turned: Frames) -> None:
    turns = [after.turn_since(before.attitude) for before, after in pairwise(turned)]
    truth = [se3.inverse(a.T_world_camera) @ b.T_world_camera for a, b in pairwise(turned)]
    assert max(map(se3.angle, truth)) > np.radians(15)
    for turn, T in zip(turns, truth, strict=True):
        assert se3.angle(se3.transform(turn @ T[:3, :3].T, np.zeros(3))) < np.radians(1)
    seen = without_color(turned)
    blind = examine_localizer.blind(seen)
    helped, alone = (examine_localizer.judged(examine_localizer.play(each), each) for each in (seen, blind))
    assert helped["lost"] == 0
    assert helped["ate_mm"] < 10
    assert alone["lost"] > 0


@pytest.mark.parametrize("kind", ["colour", "depth alone", "stereo"])
def test_a_gyroscope_askew_by_90_degrees_is_told_once_and_does_no_harm(
    swung: Frames, turned: Frames, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    seen = without_color(swung) if kind == "depth alone" else turned if kind == "colour" else swung
    rows = []
    for each in (examine_localizer.askew(seen), examine_localizer.blind(seen)):
        localizer = StereoLocalizer() if kind == "stereo" else None
        rows.append(examine_localizer.judged(examine_localizer.play(each, localizer), each))
    assert caplog.text.count("the gyroscope is not used any more") == 1
    assert rows[0]["lost"] <= rows[1]["lost"]
    assert rows[0]["ate_mm"] <= 1.2 * rows[1]["ate_mm"] + 0.5


def test_a_gyroscope_helps_corners_through_fast_turns(turned: Frames) -> None:
    blind = examine_localizer.blind(turned)
    helped, alone = (
        examine_localizer.judged(examine_localizer.play(each, StereoLocalizer()), each)
        for each in (turned, blind)
    )
    assert helped["lost"] == 0
    assert alone["lost"] > 0


def test_a_pattern_that_repeats_is_not_taken_for_a_motion() -> None:
    """In a fast turn, corners are found again on the next of a wall's stripes, 0.8 m aside."""
    frames = [replace(frame, attitude=None) for frame in examined_scenes.fast_turns(10)[:10:2]]
    row = examine_localizer.judged(examine_localizer.play(frames), frames)
    assert row["lost"] == 0
    assert row["ate_mm"] < 10


def test_frames_lost_cost_more_than_an_error() -> None:
    rows = [{"ate_mm": 10.0, "lost": lost, "frames": 40} for lost in (0, 10)]
    rows.append({"ate_mm": None, "lost": 30, "frames": 40})
    costs = [examine_localizer.cost([row]) for row in rows]
    assert costs == sorted(costs)


def test_a_second_run_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frames: Frames) -> None:
    monkeypatch.setitem(examine_localizer.SCENES, "room", lambda: frames)
    results = examine_localizer.Results(tmp_path / "results.jsonl", every=len(VARIANTS))
    examine_localizer.examine(results, ["room"], ["tsfusion"], "key")
    monkeypatch.setattr(examine_localizer, "_played", None)  # would fail
    again = examine_localizer.Results(tmp_path / "results.jsonl", every=len(VARIANTS))
    examine_localizer.examine(again, ["room"], ["tsfusion"], "key")
    (row,) = again.of("key", ["room"], "tsfusion")
    assert (row["lost"], row["frames"]) == (0, COUNT)
    assert row["ate_mm"] < 1
    assert "room: tsfusion" in examine_localizer.report(again, "key", ["room"])
