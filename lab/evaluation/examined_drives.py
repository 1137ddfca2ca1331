# SPDX-License-Identifier: MIT
"""Drives of the localizer's examination: stereo pairs and LiDAR sweeps, recorded and rendered.

A rendered sweep is measured column by column while the sensor moves; its points have times.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lab.bench.peers import DATA
from lab.evaluation.examined_scenes import furnished_room
from lab.worlds.street_drive import StreetDrive
from tsfusion import open_dataset
from tsfusion.datasets import Synthetic
from tsfusion.datasets.worlds import worlds
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.sources.source import RecordedSource

STREET_FRAMES, SWEEPS = 50, 50
SLOTS = 16  # moments at which a sweep is rendered
SWEEP_S = 0.1


def _recorded(path: str, **options: Any) -> list[Frame]:
    frames = RecordedSource(open_dataset(DATA / path, **options))
    return [replace(frame, color=None) for frame in frames]


def _street(sequence: str) -> list[Frame]:
    """Render stereo pairs of the begin of a KITTI path, through a street that nothing else uses."""
    poses = DATA / "kitti_odometry" / "poses" / f"{sequence}.txt"
    drive = StreetDrive("kitti06", kitti=poses, count=STREET_FRAMES, color=False)
    return [replace(frame, color=None) for frame in RecordedSource(drive)]


def _swept(world: worlds.World, path: Callable[[worlds.World, Any], se3.Transform]) -> list[Frame]:
    """Render sweeps of a LiDAR; `path` gives the camera's pose by the number of a sweep."""
    paths = {"path": lambda index, _: path(world, index / SLOTS)}
    source = Synthetic(replace(world, paths=paths), "lidar", count=SWEEPS * SLOTS, color=False)
    return [_sweep(source, number) for number in range(SWEEPS)]


def _sweep(source: Synthetic, number: int) -> Frame:
    """Join parts of scans at successive moments; the stamp is that of the first."""
    points, times = [], []
    for slot in range(SLOTS):
        scan = np.asarray(source.frame(number * SLOTS + slot).points)
        share = 0.5 - np.arctan2(scan[:, 1], scan[:, 0]) / (2 * np.pi)
        kept = (share * SLOTS).astype(int) == slot
        points.append(scan[kept])
        times.append(np.full(kept.sum(), slot / SLOTS * SWEEP_S, np.float32))
    return Frame(
        sensor="lidar", points=np.concatenate(points), point_times_s=np.concatenate(times),
        timestamp_ns=round((number + 1) * SWEEP_S * 1e9), T_world_camera=source.pose(number * SLOTS),
    )  # fmt: skip


def _fast_street(seed: int) -> list[Frame]:
    """Drive by 0.45 to 1.95 m a sweep, and from lane to lane."""

    def place(t: float) -> list[float]:
        return [1.2 * t - 3 * np.cos(t / 4), -1.2 + 1.2 * np.sin(t / 5), 1.65]

    street = worlds.street(200.0, seed=seed)
    return _swept(street, lambda _, t: worlds.look_at(np.array(place(t)), np.array(place(t + 6))))


KITTI, ORB = "kitti_odometry", "kitti_odometry/poses_estimated/00_ORB.txt"
STEREO: dict[str, Callable[[], list[Frame]]] = {
    "KITTI 06": partial(_recorded, KITTI, sequence="06", modality="stereo"),
    "street along KITTI 05": partial(_street, "05"),
    "street along KITTI 09": partial(_street, "09"),
    "street along KITTI 10": partial(_street, "10"),
}
LIDAR: dict[str, Callable[[], list[Frame]]] = {
    "KITTI 00": partial(_recorded, KITTI, sequence="00", modality="lidar", poses=DATA / ORB),
    "KITTI 07, 3 to 12 m apart": partial(_recorded, "kitti07_lidar_keyframes"),
    "Livox": partial(_recorded, "livox_pcd"),
    "street, swept": partial(_fast_street, 90),
    "corridor, swept": lambda: _swept(worlds.ring(), lambda ring, t: ring.paths["laps"](3 * t, 520)),
    "room, swept": lambda: _swept(furnished_room(12), lambda room, t: room.paths["hand"](t, SWEEPS)),
}
