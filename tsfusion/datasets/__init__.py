# SPDX-License-Identifier: MIT
"""Open recorded and synthetic datasets: sequences of keyframes, loaded one at a time.

Any object with `__len__` and `__getitem__` that follows the `Dataset` protocol can be replayed.

Rooms:
    formats: readers, one for each layout of recordings.
    ros2: topics of a running ROS 2 system, over DDS and Zenoh.
    rosbag: ROS 1 and ROS 2 bags and MCAP files as datasets, without ROS.
    worlds: scenes with a known surface, rendered as keyframes.
    download: download, check and unpacking of public recordings.
"""

from pathlib import Path
from typing import Any

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import Dataset, PartOfDataset, select
from tsfusion.datasets.formats.euroc import EuRoC
from tsfusion.datasets.formats.folder_table import HoloLens, Redwood, Replica, ScanNet, SevenScenes
from tsfusion.datasets.formats.image_folders import StereoFolder
from tsfusion.datasets.formats.kitti import KITTI, KITTIRaw
from tsfusion.datasets.formats.nerfstudio import Nerfstudio
from tsfusion.datasets.formats.scan_folders import LidarDump, ScanFolder
from tsfusion.datasets.formats.tum import TUM
from tsfusion.datasets.layout_registry import (
    FoundDataset,
    Layout,
    describe,
    find,
    layouts,
    open_as,
    world_layout,
)
from tsfusion.datasets.rosbag.bag import Bag
from tsfusion.datasets.worlds.synthetic import WORLDS, Synthetic

__all__ = [
    "KITTI",
    "TUM",
    "Bag",
    "Dataset",
    "EuRoC",
    "FoundDataset",
    "HoloLens",
    "KITTIRaw",
    "Layout",
    "LidarDump",
    "Nerfstudio",
    "PartOfDataset",
    "Redwood",
    "Replica",
    "ScanFolder",
    "ScanNet",
    "SevenScenes",
    "StereoFolder",
    "Synthetic",
    "describe",
    "find",
    "layouts",
    "open_dataset",
    "select",
]

_SYNTHETIC = "synthetic:"


def open_dataset(path: str | Path, /, *, unpack: bool = False, **options: Any) -> Dataset:
    """Open a recording of any layout, or a synthetic world.

    Args:
        path: `synthetic:WORLD:SENSOR`, or a folder in one of `layouts()`, or a folder that holds exactly one
            such folder, or a file that stands for a dataset (`transforms.json`, a `.log`, …).
        unpack: True first unpacks an archive, to a folder beside it.
        options: arguments of the layout's class (`posed=False` keeps frames without a pose; `sequence=`,
            `modality=`, `poses=` for KITTI, `trajectory=` for TUM, `count=`, `seed=` for synthetic worlds,
            …). Options that are None are left out.

    Raises:
        DatasetError: the files are wrong, or the layout is unknown. The message says what was expected.

    Examples:
        >>> room = tsfusion.open_dataset("synthetic:room", count=3)
        >>> len(room), room[0].kind, room[0].shape
        (3, 'depth', (240, 320))
    """
    if not isinstance(unpack, bool):
        raise DatasetError(f"`unpack` must be true or false, got {unpack!r}")
    if not str(path).startswith(_SYNTHETIC):
        return find(path, unpack=unpack).open(**options)
    words = str(path)[len(_SYNTHETIC) :].split(":")
    if len(words) > 2:
        raise DatasetError(f"{path!s}: expected synthetic:WORLD or synthetic:WORLD:SENSOR")
    given = dict(zip(("world", "sensor"), filter(None, words), strict=False))
    theirs = world_layout(given["world"]) if given.get("world", "room") not in WORLDS else None
    return open_as("synthetic", theirs.open if theirs else Synthetic, {**given, **options})
