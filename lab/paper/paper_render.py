# SPDX-License-Identifier: MIT
"""Rendered frames kept in a folder, so that a run reads them as a camera would give them.

    python lab/paper/paper_render.py WORLD.json FOLDER

Rendering takes processor time and Taichi, and neither belongs to a front end.
"""

import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.worlds import rendered_recordings
from lab.worlds.named_worlds import open_world
from lab.worlds.street_drive import StreetDrive
from tsfusion.core import durable_files, process
from tsfusion.datasets import Dataset
from tsfusion.datasets.dataset import frame_of, pose_of
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics, Keyframe

_ARRAYS = ("depth", "disparity", "left", "right", "points", "color", "T_world_camera")
_NUMBERS = ("depth_scale", "disparity_scale", "baseline_fx")
RECORD = "recording.json"  # the last file: the folder is whole


class RenderedRecording:
    """A dataset of frames that `render` kept; frame by frame as they were.

    Args:
        folder: whole, as `render` left it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        record = msgspec.json.decode((folder / RECORD).read_bytes())
        self.name: str = record["name"]
        self.sensor: str = record["sensor"]
        self.skipped: dict[str, int] = {}
        stamps = record["timestamps_ns"]
        self.timestamps_ns = None if stamps is None else np.array(stamps, dtype=np.int64)
        self._poses = np.array(record["poses"]).reshape(-1, 4, 4)
        self._numbers: dict[str, Any] = record["numbers"]
        self._camera = record["intrinsics"]

    def __len__(self) -> int:
        return len(self._poses)

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Keyframe:
        return self.frame(index).keyframe(self._poses[index])

    def pose(self, index: int) -> NDArray[np.float64]:
        """(4, 4) true T_world_camera of a frame."""
        pose: NDArray[np.float64] = self._poses[index]
        return pose

    def frame(self, index: int) -> Frame:
        """A frame as it was rendered."""
        with np.load(_file(self._folder, index), allow_pickle=False) as kept:
            arrays: dict[str, Any] = {name: kept[name] for name in kept.files}
        if "left" in arrays and "color" not in arrays:
            arrays["color"] = np.repeat(arrays["left"][:, :, None], 3, axis=2)
        camera = None if self._camera is None else Intrinsics(*self._camera)
        stamp = 0 if self.timestamps_ns is None else int(self.timestamps_ns[index])
        return Frame(sensor=self.sensor, timestamp_ns=stamp, intrinsics=camera, **self._numbers, **arrays)


def render(dataset: Dataset, folder: Path, tell: Any = lambda _done, _all: None) -> None:
    """Keep every frame of a dataset in a folder; those that are there already are not made again."""
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / RECORD).exists():
        return
    for index in range(len(dataset)):
        if not _file(folder, index).exists():
            with durable_files.replacing(_file(folder, index)) as file:
                np.savez(file, **_arrays(frame_of(dataset, index)))  # type: ignore[arg-type]
        tell(index + 1, len(dataset))
    first = frame_of(dataset, 0)
    K, stamps = first.intrinsics, dataset.timestamps_ns
    record = {
        "name": dataset.name,
        "sensor": dataset.sensor,
        "timestamps_ns": None if stamps is None else np.asarray(stamps).tolist(),
        "poses": [np.asarray(pose_of(dataset, index)).tolist() for index in range(len(dataset))],
        "numbers": {name: getattr(first, name) for name in _NUMBERS},
        "intrinsics": None if K is None else [K.fx, K.fy, K.cx, K.cy],
    }
    with durable_files.replacing(folder / RECORD) as file:
        file.write(msgspec.json.encode(record))


def _arrays(frame: Frame) -> dict[str, NDArray[Any]]:
    """The arrays of a frame; the colour of a pair is its left image, three times."""
    found = {name: array for name in _ARRAYS if (array := getattr(frame, name)) is not None}
    if frame.left is not None:
        found.pop("color", None)
    return found


def _file(folder: Path, index: int) -> Path:
    return folder / f"{index:06}.npz"


def main() -> int:
    process.on_parent_end(signal.SIGKILL)
    from lab.paper.paper_worlds import PaperWorld

    world = msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=PaperWorld)
    shown = 0.0

    def tell(done: int, count: int) -> None:
        nonlocal shown
        if time.monotonic() - shown > 1 or done == count:
            shown = time.monotonic()
            print(f"{done} {count}", flush=True)

    dataset, folder = world.open(), Path(sys.argv[2])
    if world.source.partition(":")[2].startswith("kitti"):
        drive = open_world(world.source, **world.options, count=world.limit)
        assert isinstance(drive, StreetDrive)
        rendered_recordings.record(drive, folder, progress=tell)
    else:
        render(dataset, folder, tell)
    return 0


if __name__ == "__main__":
    sys.exit(main())
