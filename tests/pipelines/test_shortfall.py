# SPDX-License-Identifier: MIT
"""Runs that missed what they were for, and voxels far too small for a first keyframe."""

from typing import Any

import msgspec
import numpy as np
import pytest

from tsfusion import Intrinsics, InvalidConfig, Keyframe, VolumeConfig
from tsfusion.client import ClientStats
from tsfusion.datasets.dataset import UNREADABLE
from tsfusion.pipelines.report import run_record, shortfall
from tsfusion.pipelines.report.run_record import RunRecord
from tsfusion.pipelines.runs import map_growth

STATS = ClientStats(
    sent=10, durable=10, fused=10, refused={}, rejected={}, skipped={}, waiting=0, waiting_bytes=0, state="ok"
)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, ""),
        ({"skipped": {"thinned": 5, "dropped": 1}}, ""),  # which a policy asked for
        ({"rejected": {"no_samples": 5}}, ""),  # there was nothing to lose
        ({"rejected": {"KeyframeTooLarge": 1}}, "the map took 9 of 10 keyframes only: all too far"),
        (
            {"waiting": 3},
            "3 keyframes are not at the server (no server answers), but in SPOOL; check",
        ),
        ({"refused": {"quota": 2}}, "2 keyframes will never be at the server (2 × quota)"),
        (
            {"skipped": {"disk": 1}},
            "1 keyframe will never be at the server (1 × disk): the disk",
        ),
        ({"skipped": {"damaged": 2}}, "2 records of an earlier scan's spool could not be read"),
        ({"corrections_refused": {"quota": 1}}, "1 correction was not taken (1 × quota): keyframes are"),
        ({"rejected": {"no_samples": 6}}, "the map took 4 of 10 keyframes only: all too far"),
    ],
)
def test_what_is_not_at_the_server_or_in_its_map(changed: dict[str, Any], words: str) -> None:
    stats = msgspec.structs.replace(STATS, **changed)
    found = shortfall.of_delivery(stats, spool="SPOOL", link="no server answers", rejection="all too far")
    assert words in found
    assert bool(words) == bool(found)


def test_frames_lost() -> None:
    assert shortfall.of_tracking(40, 38, "dark") == ""
    found = shortfall.of_tracking(40, 37, "dark")
    assert found.startswith(
        "the sensor was lost (dark): only 37 of 40 frames were localised; move more slowly"
    )
    assert "40 of 40 frames were localised, in 2 maps" in shortfall.of_tracking(40, 40, "dark", maps=2)
    late = shortfall.of_tracking(40, 19, "late", localizer="feed")
    assert "send poses sooner" in late
    assert "slowly" not in late
    assert "in its clock" in shortfall.of_tracking(40, 19, "gap", localizer="trajectory")
    assert shortfall.together(["", found, "", "more"]) == f"{found}; more"


@pytest.mark.parametrize(
    ("changed", "level", "headline"),
    [
        ({}, "good", "Complete: all 90 keyframes were fused."),
        ({"missed": "lost"}, "bad", "Lost"),
        ({"complete": False}, "notice", "90 of 90 keyframes were fused; the source was not read to its end."),
        ({"keyframes_fused": 89, "keyframes_rejected": {"no_samples": 1}}, "notice",
         "89 of 90 keyframes were fused; not in the map: 1 × no_samples."),
        ({"frames": 100, "frames_tracked": 99}, "notice",
         "90 of 90 keyframes were fused; 1 frame was not localised."),
        ({"warnings": ["the colour is late"]}, "notice", "90 of 90 keyframes were fused; see the warnings."),
        ({"keyframes_fused": 2, "keyframes_durable": 90}, "good",
         "Complete: all 90 keyframes are at the server, 2 fused so far."),
        ({"keyframes_fused": 2}, "notice", "2 of 90 keyframes were fused."),
    ],
)  # fmt: skip
def test_a_run_is_as_good_as_its_worst_finding(changed: dict[str, Any], level: str, headline: str) -> None:
    counts = {"keyframes_sent": 90, "keyframes_fused": 90, **changed}
    found = run_record.verdict(RunRecord(kind="scan", source="a camera", **counts))
    assert (found.level, found.headline) == (level, headline)


def test_many_frames_without_a_pose() -> None:
    assert shortfall.of_poses(39, {"without a pose in time": 2, "without depth": 90}) == ""
    assert shortfall.of_poses(45, {"without a pose": 15}).startswith("only 45 of 60 frames have a pose")
    found = shortfall.of_poses(20, {"without a pose in time": 20, "without a pose": 1})
    assert found.startswith("only 20 of 41 frames have a pose")
    assert "--trajectory FILE" in found


def test_many_frames_that_cannot_be_read() -> None:
    assert shortfall.of_unreadable(40, {UNREADABLE: 2, "without a pose": 30}) == ""
    found = shortfall.of_unreadable(40, {UNREADABLE: 3})
    assert found.startswith("3 of 40 frames cannot be read, and are not in the map")


def test_a_voxel_size_that_a_keyframe_cannot_have_is_refused_with_a_proposal() -> None:
    v, u = np.mgrid[:480, :640]
    depth = (1500 + u // 4 + v // 3).astype(np.uint16)
    keyframe = Keyframe(
        depth=depth, intrinsics=Intrinsics(525.0, 525.0, 320.0, 240.0), T_world_camera=np.eye(4)
    )
    with pytest.raises(InvalidConfig, match=r"would need some [0-9.]+ GB .*; use 0.002 or more"):
        map_growth.check_fits(keyframe, VolumeConfig(voxel_size=0.0001))
    for size in (0.002, 0.02):
        map_growth.check_fits(keyframe, VolumeConfig(voxel_size=size))
    angle, distance = np.random.default_rng(0).uniform(0, [[2 * np.pi], [100.0]], (2, 1_500_000))
    ground = np.stack([distance * np.cos(angle), distance * np.sin(angle), 0 * angle], 1).astype(np.float32)
    disc = Keyframe(points=ground, T_world_camera=np.eye(4))
    with pytest.raises(InvalidConfig, match=r"use 0.2 or more"):  # larger than what was refused
        map_growth.check_fits(disc, VolumeConfig(voxel_size=0.05, sensor="lidar"))
    blank = Keyframe(depth=np.zeros_like(depth), intrinsics=keyframe.intrinsics, T_world_camera=np.eye(4))
    map_growth.check_fits(blank, VolumeConfig(voxel_size=0.0001))
