# SPDX-License-Identifier: MIT
"""Points of a moving LiDAR on the scanner: put right by whatever gives the poses, and sent so."""

import dataclasses
import logging
from pathlib import Path

import moving_lidars as lidar
import numpy as np
import pytest
from numpy.typing import NDArray

from tsfusion import Client, Keyframe
from tsfusion.core.config import ScanConfig
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.geometry import se3, sweeps
from tsfusion.geometry.frame import Frame
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.scanner.localization.given_poses import GivenPoses, TrajectoryFilePoses
from tsfusion.scanner.localization.localizer import Localizer, Lost, TrackedPose
from tsfusion.scanner.scanner import Scanner
from tsfusion.scanner.sources.watched_folder import WatchedFolder

NOBODY = "tcp://127.0.0.1:1"
COUNT = 3


def frames(**fields: object) -> list[Frame]:
    return [
        Frame(
            sensor="lidar", points=swept.points, point_times_s=swept.times_s,
            timestamp_ns=lidar.T0_NS + round(number * lidar.PERIOD_S * 1e9), **fields,
        )
        for number, swept in enumerate(lidar.sweep(number) for number in range(COUNT))
    ]  # fmt: skip


def sent(spool: Path, localizer: Localizer, sources: list[Frame]) -> list[NDArray[np.float32]]:
    """Points of the keyframes that a scanner sends of these frames, every one."""
    with Client(NOBODY, spool=spool, policy="spool_all") as client:
        scanner = Scanner(localizer, ScanConfig(distance=1e-6), lambda _: client, map_name="default")
        scanner.run(sources, lambda _: None)
    return [keyframe.points for keyframe in JournalRecording(spool)]


def worst(found: list[NDArray[np.float32]]) -> float:
    assert len(found) == COUNT
    return max(lidar.off(points, lidar.sweep(number)) for number, points in enumerate(found))


def test_by_the_sources_own_motion(tmp_path: Path) -> None:
    own = [
        dataclasses.replace(
            frame, T_world_camera=lidar.pose_at_ns(frame.timestamp_ns),
            motion=sweeps.motion_about(lidar.pose_at_ns, frame.timestamp_ns, frame.point_times_s),
        )
        for frame in frames()
    ]  # fmt: skip
    assert worst(sent(tmp_path / "a", GivenPoses(), own)) < 1e-3
    unknown = [dataclasses.replace(frame, motion=None) for frame in own]
    assert worst(sent(tmp_path / "b", GivenPoses(), unknown)) > 0.3


def test_by_a_trajectory_of_scans_in_a_watched_folder(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root, poses = tmp_path / "live", tmp_path / "poses.txt"
    root.mkdir()
    stamps, known = lidar.trajectory(-1, COUNT + 1)
    write_tum(poses, [stamp + 500_000_000 for stamp in stamps], known)
    for number, frame in enumerate(frames()):
        moments = (lidar.sweep(number).times_s * 1e9).astype(np.uint32)
        lidar.save(root / f"{frame.timestamp_ns}.pcd", frame.points, "t", moments)
    (root / "DONE").touch()
    for deskew, bound in ((True, lambda off: off < 2e-3), (False, lambda off: off > 0.3)):
        with WatchedFolder(root, deskew=deskew) as source:
            localizer = TrajectoryFilePoses(poses, max_gap_s=0.2, time_offset_s=0.5)
            assert bound(worst(sent(tmp_path / f"spool{deskew}", localizer, list(source))))
    assert not caplog.records
    for frame in frames():
        lidar.save(root / f"{frame.timestamp_ns}.pcd", frame.points, "t", np.zeros(len(frame.points), "u4"))
    with WatchedFolder(root) as source:
        assert all(frame.point_times_s is None for frame in source)
    (said,) = caplog.records
    assert (
        said.getMessage()
        == "folder live: motion within sweeps is not taken out: t is the same for all points"
    )


class Odometry(Localizer):
    """True poses; of the first frame in a world the motion is not known."""

    absolute = False

    def __init__(self, lost: tuple[int, ...] = ()) -> None:
        self._count, self._lost, self._first = 0, lost, True

    def track(self, frame: Frame) -> TrackedPose | Lost:
        self._count += 1
        if self._count in self._lost:
            return Lost(reason="the script says so", timestamp_ns=frame.timestamp_ns)
        motion = sweeps.motion_about(lidar.pose_at_ns, frame.timestamp_ns, frame.point_times_s)
        T, self._first, first = lidar.pose_at_ns(frame.timestamp_ns), False, self._first
        return TrackedPose(
            T_world_camera=T, timestamp_ns=frame.timestamp_ns, anchor=self._count, T_anchor_camera=np.eye(4),
            motion=None if first else motion,
        )  # fmt: skip

    def reset(self) -> None:
        self._first = True


def test_the_first_frame_of_odometry_waits_for_the_second(tmp_path: Path) -> None:
    assert worst(sent(tmp_path / "a", Odometry(), frames())) < 0.1  # the motion of the sweep after it
    assert worst(sent(tmp_path / "b", Odometry(lost=(2,)), [*frames()[:2], *frames()[1:]])) < 0.1
    (alone,) = sent(tmp_path / "c", Odometry(), frames()[:1])
    np.testing.assert_array_equal(alone, frames()[0].points)


def test_a_client_sends_points_that_are_put_right(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    seconds = np.linspace(0, 0.1, 11)
    with Client(NOBODY, spool=tmp_path / "spool", policy="spool_all") as client:
        for frame in frames():
            begin = (frame.timestamp_ns - lidar.T0_NS) / 1e9
            then = np.array([lidar.pose_at(begin + t) for t in seconds])
            given = {"points": frame.points, "point_times_s": frame.point_times_s, "sensor": "lidar"}
            T = then[0]
            client.send({**given, "T_world_camera": T, "motion": (seconds, se3.inverse(T) @ then)})
        assert (client.skewed, caplog.records) == (0, [])
        for _ in range(2):
            client.send(Keyframe(T_world_camera=T, **given))
        assert client.skewed == 2
    (said,) = caplog.records
    assert (said.levelno, "not taken out: points have times, and no motion" in said.getMessage()) == (
        logging.WARNING,
        True,
    )
    assert worst([keyframe.points for keyframe in JournalRecording(tmp_path / "spool")][:COUNT]) < 2e-3
