# SPDX-License-Identifier: MIT
"""Every layout gives each frame its own pose, whatever happened to a file of one frame."""

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from small_recordings import CAMERA, one_line

from lab.reliability.fuzz_folders import WRITERS
from tsfusion.datasets import describe, find, open_dataset
from tsfusion.datasets.dataset import frame_of, readable
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform
from tsfusion.scanner.sources.watched_folder import WatchedFolder

Found = dict[bytes, Transform | None]  # poses by what was measured


class Row(NamedTuple):
    """A layout, and the files of its frames in order."""

    layout: str
    writer: str
    first: str
    second: str = ""
    poses: str = ""  # a file for each frame, or one for all
    lines: tuple[int, int] = (1, 0)  # of a pose in such a file, and of these before its numbers
    refused: dict[str, str] = {}  # changes that keep more than one frame from being told, and the error
    is_watched: bool = False
    options: dict[str, Any] = {}


_ORDER = dict.fromkeys(("first missing", "first renamed"), "has 6 poses for 5")  # is all they go by
_NUMBERS = {f"{side} renamed": "is not named by a frame number" for side in ("first", "second")}
_KITTI, _RAW = "sequences/06/{}/*", "2011_09_26/2011_09_26_drive_0001_sync/{}/data/*"
ROWS = (
    Row("7-Scenes", "seven-scenes", "*.depth.png", "*.color.png", "*.pose.txt", is_watched=True),
    Row("ScanNet", "scannet", "depth/*", "color/*", "pose/*"),
    Row("Replica", "replica", "results/depth*", "results/frame*", "traj.txt", is_watched=True),
    Row("HoloLens", "hololens", "depth/*", "images/*", "poses.txt", refused=_ORDER, is_watched=True),
    Row("Redwood", "redwood", "depth/*", "color/*", "trajectory.log", (5, 1), is_watched=True),
    Row("RGB-D folders", "plain", "depth/*", "rgb/*", is_watched=True),
    Row("RGB-D folders", "flat", "depth_*", "color_*"),
    Row("TUM RGB-D", "tum", "depth/*", "rgb/*", "groundtruth.txt"),
    Row("nerfstudio", "nerfstudio", "depth/*", "images/*"),
    Row("stereo folders", "stereo", "left/*", "right/*", is_watched=True),
    Row("KITTI odometry", "kitti", _KITTI.format("image_0"), _KITTI.format("image_1"), "poses/06.txt",
        refused=_NUMBERS),
    Row("KITTI odometry", "kitti", _KITTI.format("velodyne"), "", "poses/06.txt", refused=_NUMBERS,
        options={"modality": "lidar"}),
    Row("KITTI raw", "kitti-raw", _RAW.format("image_00"), _RAW.format("image_01"), _RAW.format("oxts"),
        refused=_NUMBERS),
    Row("EuRoC", "euroc", "mav0/cam0/data/*", "mav0/cam1/data/*"),
    Row("LiDAR scans", "scans", "*.bin", "", "poses_kitti.txt", is_watched=True),
    *(Row("LiDAR scans", f"scans-{suffix}", f"*.{suffix}", "", "poses_tum.txt", is_watched=True)
      for suffix in ("pcd", "ply", "laz")),
    Row("Record3D", "record3d", "depth/*", "rgb/*"),
    Row("Stray Scanner", "stray", "depth/*", "rgb/*", "odometry.csv", (1, 1)),
    Row("Polycam", "polycam", "keyframes/depth/*", "keyframes/images/*"),
    Row("3D Scanner App", "scanner-app", "depth_*", "frame_*.png"),
    Row("ARKitScenes", "arkit-scenes", "lowres_depth/*", "lowres_wide/*", "lowres_wide.traj"),
    Row("LiDAR keyframes", "lidar-keyframes", "*/points.bin", "", "graph.txt"),
)  # fmt: skip
ONE_EACH = ("*.pose.txt", "pose/*", _RAW.format("oxts"))  # files of poses
WITHOUT_POSES = ("plain", "flat", "stereo")
# Colour that is not there is no loss where it lies beside its depth
UNSEEN = dict.fromkeys(("flat", "scanner-app"), ("second missing", "second renamed"))


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2 | 1])


def of_another_type(file: Path) -> None:
    """Another image in place of depth, else no image at all."""
    stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if stored is not None and stored.dtype == np.uint16:
        cv2.imwrite(str(file), np.zeros((*stored.shape, 3), np.uint8))
    else:
        file.write_bytes(b"\xff\xd8\xff\xe0" + bytes(51))


def swap(one: Path, other: Path) -> None:
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)


CHANGES: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "empty": lambda file: file.write_bytes(b""),
    "cut": cut,
    "renamed": lambda file: file.rename(file.with_name(f"x7-{file.name}")),
    "of another type": of_another_type,
}


class Harmed(NamedTuple):
    """One frame of a row, and what happens to a file of it."""

    row: Row
    change: str

    def __str__(self) -> str:
        return f"{self.row.writer} {self.row.first}: {self.change}"

    def harm(self, root: Path) -> None:
        """Change the frame in the middle."""
        patterns = {"first": self.row.first, "second": self.row.second or self.row.first}
        sides = {side: sorted(root.glob(pattern)) for side, pattern in patterns.items()}
        middle = len(sides["first"]) // 2
        side, change = self.change.split(" ", 1)
        if side == "pose":
            self._harm_pose(root, middle, change)
        elif change == "swapped with the second":
            swap(sides["first"][middle], sides["second"][middle])
        else:
            CHANGES[change](sides[side][middle])

    def _harm_pose(self, root: Path, middle: int, change: str) -> None:
        found = sorted(root.glob(self.row.poses))
        file, frame = (found[middle], 0) if len(found) > 1 else (found[0], middle)
        if change == "missing":
            file.unlink()
            return
        lines = file.read_text().splitlines()
        each, before = self.row.lines
        words = lines[frame * each + before].split()
        lines[frame * each + before] = " ".join([*words[:-1], "nan"] if change == "of nan" else words[:-1])
        file.write_text("\n".join(lines) + "\n")


def harms(row: Row) -> list[Harmed]:
    changes = [f"{side} {change}" for side in ("first", "second") if getattr(row, side) for change in CHANGES]
    is_depth = row.second and "image_0" not in row.first and row.first != "left/*" and "cam0" not in row.first
    changes += ["first swapped with the second"] * bool(is_depth)
    changes += ["pose of nan", "pose cut"] * bool(row.poses) + ["pose missing"] * (row.poses in ONE_EACH)
    return [Harmed(row, change) for change in changes]


def measured(frame: Frame) -> bytes:
    parts = (frame.depth, frame.left, frame.right, frame.points)
    return b"".join(np.ascontiguousarray(part).tobytes() for part in parts if part is not None)


def opened(root: Path, row: Row) -> tuple[Found, int]:
    """Frames that can be read, and how many were left out."""
    dataset = open_dataset(root, posed=row.writer not in WITHOUT_POSES, **row.options)
    read = readable(lambda index: frame_of(dataset, index), range(len(dataset)))
    return {measured(frame): frame.T_world_camera for _, frame in read}, sum(dataset.skipped.values())


@pytest.fixture(scope="module")
def unharmed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Row], tuple[Path, Found]]:
    """A recording in the layout of a row, and its frames."""

    @cache
    def made(writer: str) -> Path:
        root = tmp_path_factory.mktemp(writer) / writer
        root.mkdir()
        WRITERS[writer](root)
        return root

    return lambda row: (made(row.writer), opened(made(row.writer), row)[0])


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.writer} {row.first}")
def test_a_layout_is_recognised_and_has_all_frames_and_poses(
    unharmed: Callable[[Row], tuple[Path, Found]], row: Row
) -> None:
    root, frames = unharmed(row)
    count = len(list(root.glob(row.first)))
    assert (find(root).layout.name, find(root).also) == (row.layout, ())
    assert len(frames) == count >= 3
    poses = [T for T in frames.values() if T is not None]
    assert len(poses) == (0 if row.writer in WITHOUT_POSES else count)
    assert len({T.tobytes() for T in poses}) == len(poses)


@pytest.mark.parametrize("row", [row for row in ROWS if row.poses], ids=lambda row: row.writer + row.first)
def test_a_recording_without_poses_is_there_for_a_scan(
    unharmed: Callable[[Row], tuple[Path, Found]], tmp_path: Path, row: Row
) -> None:
    whole, frames = unharmed(row)
    root = Path(shutil.copytree(whole, tmp_path / whole.name))
    for file in root.glob(row.poses):
        file.unlink()
    dataset = open_dataset(root, posed=False, **row.options)
    found = [frame_of(dataset, index) for index in range(len(dataset))]
    assert {measured(frame) for frame in found} == set(frames)
    assert [frame.T_world_camera for frame in found] == [None] * len(frames)
    assert dataset.skipped == {}
    assert ", no poses" in describe(dataset)
    one_line(lambda: dataset[1], r"frame 1 of .* has no pose; `tsfusion scan PATH` finds")
    one_line(lambda: open_dataset(root, **row.options), "pose|trajectory|groundtruth|packets")


@pytest.mark.parametrize("harmed", [one for row in ROWS for one in harms(row)], ids=str)
def test_what_happens_to_one_frame_leaves_the_others_at_their_poses(
    unharmed: Callable[[Row], tuple[Path, Found]], tmp_path: Path, harmed: Harmed
) -> None:
    whole, frames = unharmed(harmed.row)
    root = Path(shutil.copytree(whole, tmp_path / whole.name))
    harmed.harm(root)
    if refused := harmed.row.refused.get(harmed.change):
        one_line(lambda: opened(root, harmed.row), refused)
        return
    found, skipped = opened(root, harmed.row)
    assert len(found) == len(frames) - (harmed.change not in UNSEEN.get(harmed.row.writer, ()))
    for key, T in found.items():
        expected = frames[key]
        assert (T is None) == (expected is None)
        assert T is None or np.abs(T - expected).max() < 1e-12
    assert skipped == 1 or (harmed.change.endswith(("missing", "renamed")) and skipped <= 2)


@pytest.mark.parametrize(
    "harmed",
    [one for row in ROWS if row.is_watched for one in harms(row) if "pose" not in one.change],
    ids=str,
)
def test_a_watched_folder_gives_the_same_frames(
    unharmed: Callable[[Row], tuple[Path, Found]], tmp_path: Path, harmed: Harmed
) -> None:
    whole, frames = unharmed(harmed.row)
    root = Path(shutil.copytree(whole, tmp_path / whole.name))
    recorded = open_dataset(root, posed=False)
    (root / "DONE").touch()
    with WatchedFolder(root) as source:
        watched = list(source)
    assert [measured(frame) for frame in watched] == list(frames)
    for index, frame in enumerate(watched):
        expected = frame_of(recorded, index)
        assert frame.depth_scale == expected.depth_scale
        assert (frame.intrinsics, frame.baseline_fx) == (expected.intrinsics, expected.baseline_fx)
    harmed.harm(root)
    with WatchedFolder(root) as source:
        found = [measured(frame) for frame in source]
    is_last = harmed.change == "first renamed" and not harmed.row.second  # any name will do
    assert len(found) == len(frames) - (not is_last)
    assert set(found) <= set(frames)


def test_units_are_the_layouts_own_where_no_file_states_them(
    unharmed: Callable[[Row], tuple[Path, Found]], tmp_path: Path
) -> None:
    root = Path(shutil.copytree(unharmed(ROWS[2])[0], tmp_path / "replica"))
    (root / "cam_params.json").unlink()
    (root / "K.txt").write_text(CAMERA)
    (root / "DONE").touch()
    with WatchedFolder(root) as source:
        scales = {frame.depth_scale for frame in source}
    assert scales == {frame_of(open_dataset(root), 0).depth_scale} == {1 / 6553.5}
