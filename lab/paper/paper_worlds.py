# SPDX-License-Identifier: MIT
"""Worlds of the paper's experiments: recordings where there are some, rendered ones in their place."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from lab.paper.paper_render import RenderedRecording
from lab.worlds.named_worlds import open_world
from tsfusion.core.config import LocalizerName, ScanConfig, SensorName
from tsfusion.datasets import Dataset, open_dataset, select
from tsfusion.datasets.dataset import NOMINAL_NS, pose_of
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.keyframe_selection import OUTDOORS, KeyframeSelector

DATA = Path(os.environ.get("TSFUSION_DATA", Path(__file__).parents[3] / "shared" / "data"))
INDOORS = ("kinect", "tof")
_LEAST_DISTANCE = 0.02  # metres between keyframes
_HALVINGS = 30


class PaperWorld(Struct, frozen=True, kw_only=True):
    """A recording that is run, and what the paper says of the one that it stands for.

    Attributes:
        name: short, for files.
        title: for a person; says what it really is.
        source, options: what `open_world` takes.
        limit: number of frames; None = all.
        keyframes: as many are chosen, if the path allows; None = by the usual distance.
        died_at: the keyframe at which the paper's baseline ended; None = not said.
        cache: folder with its rendered frames; empty = it is a recording, or not rendered yet.
        stands_for: the paper's name of the recording.
        published_rmse: metres that ORB-SLAM2 published for the real sequence; None = nothing known.
        loops: whether the path comes back to a place.
    """

    name: str
    title: str
    stands_for: str
    source: str
    sensor: SensorName
    localizer: LocalizerName
    voxel_size: float
    options: dict[str, Any] = {}
    limit: int | None = None
    keyframes: int | None = None
    died_at: int | None = None
    cache: str = ""
    published_rmse: float | None = None
    loops: bool = False

    @property
    def is_rendered(self) -> bool:
        """True if the frames are made up, and the surface is known."""
        return self.source.startswith("synthetic:")

    def open(self) -> Dataset:
        """The recording, with its true poses where it has some."""
        if self.cache and not (Path(self.cache) / "sequences").is_dir():
            kept: Dataset = RenderedRecording(Path(self.cache))
            return select(kept, limit=self.limit)
        if self.cache:
            return select(open_dataset(self.cache), limit=self.limit)
        options = dict(self.options)
        if not self.is_rendered:
            options["posed"] = False
        return select(open_world(self.source, **options), limit=self.limit)


def worlds(
    *, quick: bool, kitti: Path | None = None, corbs: Path | None = None, frames: int | None = None
) -> list[PaperWorld]:
    """The worlds of a run: KITTI 06 and 07 and Desk1, or what stands for them here.

    Args:
        quick: short ones only.
        kitti: folder with the real sequences 06 and 07; None = the rendered ones.
        corbs: folder of the real Desk1 in TUM's layout; None = the rendered one.
        frames: at most so many of each.
    """
    if quick:
        found = [_clip() or _street(40), _desk(corbs, 60)]
    else:
        found = [_sequence(kitti, "06", 428, 60, 0.8), _sequence(kitti, "07", 242, 25, 0.5)]
        found.append(_desk(corbs, None))
    if frames is None:
        return found
    # a part has not as many keyframes as the paper's whole
    return [replace(world, limit=min(frames, world.limit or frames), keyframes=None) for world in found]


def _sequence(kitti: Path | None, number: str, keyframes: int, died_at: int, rmse: float) -> PaperWorld:
    """A sequence of KITTI: recorded, or its true path through a rendered street, or what there is."""
    common: dict[str, Any] = {
        "name": f"kitti{number}", "stands_for": f"{number}_KITTI", "sensor": "stereo", "localizer": "stereo",
        "voxel_size": 0.15, "keyframes": keyframes, "died_at": died_at, "published_rmse": rmse, "loops": True,
    }  # fmt: skip
    root = kitti or DATA / "kitti_odometry"
    if kitti is not None:
        return PaperWorld(
            title=f"KITTI {number}, recorded", source=str(kitti), options={"sequence": number}, **common
        )
    if (root / "poses" / f"{number}.txt").is_file():
        return PaperWorld(
            title=f"path of KITTI {number} through a rendered street", source=f"synthetic:kitti{number}",
            options={"kitti": str(root.absolute())}, **common,
        )  # fmt: skip
    if number == "06":
        return _street(300)
    return PaperWorld(
        name="corridor", title="rendered corridor, two laps (KITTI's path is not here)",
        stands_for="07_KITTI", source="synthetic:corridor", options={"count": 260}, limit=260,
        sensor="kinect", localizer="rgbd", voxel_size=0.04, died_at=died_at, loops=True,
    )  # fmt: skip


def _clip() -> PaperWorld | None:
    """The thirty real pairs of KITTI 06, where they are."""
    if not (DATA / "kitti_odometry" / "sequences" / "06" / "image_0").is_dir():
        return None
    return PaperWorld(
        name="kitti06-clip", title="KITTI 06, recorded, the first 30 pairs", stands_for="06_KITTI",
        source=str(DATA / "kitti_odometry"), options={"sequence": "06"}, sensor="stereo", localizer="stereo",
        voxel_size=0.15, died_at=60, limit=30,
    )  # fmt: skip


def _street(count: int) -> PaperWorld:
    return PaperWorld(
        name="street", title=f"rendered straight street, {count} m", stands_for="06_KITTI",
        source="synthetic:street:stereo", options={"count": count}, limit=count, sensor="stereo",
        localizer="stereo", voxel_size=0.15, died_at=60,
    )  # fmt: skip


def _desk(corbs: Path | None, limit: int | None) -> PaperWorld:
    common: dict[str, Any] = {"name": "desk1", "stands_for": "CoRBS_D1", "localizer": "rgbd"}
    if corbs is not None:
        return PaperWorld(
            title="CoRBS Desk1, recorded",
            source=str(corbs),
            sensor="tof",
            voxel_size=0.01,
            limit=limit,
            **common,
        )
    return PaperWorld(
        title="rendered desk, a Kinect v2's errors", source="synthetic:desk", sensor="tof", voxel_size=0.01,
        options={"count": limit or 300}, limit=limit or 300, **common,
    )  # fmt: skip


def sweep_worlds(found: list[PaperWorld]) -> list[PaperWorld]:
    """A world a sensor (stereo, RGB-D, LiDAR) whose surface is known, for the sweep of λ and support."""
    stereo = next((each for each in found if each.sensor == "stereo" and each.is_rendered), _street(40))
    depth = next((each for each in found if each.sensor in INDOORS and each.is_rendered), None)
    lidar = PaperWorld(
        name="street-lidar", title="rendered street, LiDAR", stands_for="", source="synthetic:street:lidar",
        options={"count": 40}, sensor="lidar", localizer="lidar", voxel_size=0.1,
    )  # fmt: skip
    return [stereo, depth or _desk(None, None), lidar]


def planned_keyframes(
    dataset: Dataset, wanted: int | None, *, outdoors: bool, config: ScanConfig | None = None
) -> NDArray[np.int64]:
    """Indices of frames that are to be keyframes, chosen by the true path, so that there are `wanted`.

    The same frames for every mode: what differs between modes is the mode alone.

    Args:
        wanted: the distance between keyframes is the one that gives as many, or nearly; None = the usual one.
    """
    config = config or ScanConfig()
    poses = [pose_of(dataset, index) for index in range(len(dataset))]
    known = [(index, T) for index, T in enumerate(poses) if T is not None]
    if len(known) < 2:
        raise ValueError(f"{dataset.name} has no true poses to choose keyframes by")

    def chosen(distance: float | None) -> NDArray[np.int64]:
        selector = KeyframeSelector(
            ScanConfig(distance=distance, angle=config.angle, min_overlap=0.0), outdoors=outdoors
        )
        return _select(selector, known)

    return chosen(None) if wanted is None else _with_count(chosen, wanted)


def _select(selector: KeyframeSelector, poses: list[tuple[int, NDArray[np.float64]]]) -> NDArray[np.int64]:
    frame = Frame(sensor="lidar", points=np.ones((1, 3), np.float32))  # the rule asks it for nothing
    found = []
    for index, T in poses:
        if selector.reason(frame, T) is not None:
            selector.accept(frame, T)
            found.append(index)
    return np.array(found, dtype=np.int64)


def _with_count(chosen: Callable[[float], NDArray[np.int64]], wanted: int) -> NDArray[np.int64]:
    """The choice whose number is nearest to `wanted`; the number falls as the distance grows."""
    low, high = _LEAST_DISTANCE, 20 * OUTDOORS
    best = chosen(low)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        found = chosen(middle)
        if abs(len(found) - wanted) < abs(len(best) - wanted):
            best = found
        if len(found) == wanted:
            return found
        low, high = (middle, high) if len(found) > wanted else (low, middle)
    return best


def stamps_ns(dataset: Dataset) -> NDArray[np.int64]:
    """(n,) nanoseconds of the frames by the recording's clock, or ten a second."""
    if dataset.timestamps_ns is not None:
        return np.asarray(dataset.timestamps_ns, dtype=np.int64)
    return (1 + np.arange(len(dataset), dtype=np.int64)) * NOMINAL_NS
