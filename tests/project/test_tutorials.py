# SPDX-License-Identifier: MIT
"""Each tutorial is run from its first block to its last, with real sensor data in the place of the reader's.

That is nightly: the commands of a tutorial start servers and fuse recordings, some ten seconds each. Every
run of `test_docs.py` checks their words and runs their Python; `test_examples.py` runs the examples.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import doc_pages
import numpy as np
import own_recordings
import pytest
from repository import ROOT
from rosbag_writing import writing

from tsfusion import Volume, open_dataset

Data = Callable[[str], Path]
TUTORIALS = ROOT / "docs" / "tutorials"


def nothing(folder: Path, data: Data) -> None:
    """The tutorial brings all that it needs."""


def rgbd_folder(folder: Path, data: Data) -> None:
    """A person's recording, in the layout of TUM's."""
    own_recordings.tum(folder / "my-room", own_recordings.views(data("7scenes/redkitchen"), 24, every=1))


def stereo_pair(folder: Path, data: Data) -> None:
    """Rectified images of a car in two folders."""
    drive = data("kitti_odometry") / "sequences" / "06"
    for number, name in enumerate(("left", "right")):
        shutil.copytree(drive / f"image_{number}", folder / "my-drive" / name)
    left, right = (
        np.array(line.split()[1:], float) for line in (drive / "calib.txt").read_text().splitlines()[:2]
    )
    K = left.reshape(3, 4)[:, :3]
    np.savetxt(folder / "my-drive" / "K.txt", K)
    np.savetxt(folder / "my-drive" / "baseline.txt", [-right.reshape(3, 4)[0, 3] / K[0, 0]])


def lidar_bag(folder: Path, data: Data) -> None:
    """A bag of a driving robot."""
    pytest.importorskip("kiss_icp")
    drive = open_dataset(data("kitti_odometry"), sequence="00", modality="lidar")
    with writing(folder / "bag", "ros1") as (bag, path):
        for number, keyframe in enumerate(drive):
            points = np.ascontiguousarray(np.asarray(keyframe.measurement, np.float32))
            records = points.view([("x", "f4"), ("y", "f4"), ("z", "f4")]).reshape(1, -1)
            bag.cloud("/velodyne_points", records, own_recordings.T0_NS + number * 10**8)
    path.rename(folder / "drive.bag")


PREPARED: dict[str, Callable[[Path, Data], None]] = {
    "rgbd-folder": rgbd_folder,
    "realsense": nothing,
    "stereo-pair": stereo_pair,
    "lidar-bag": lidar_bag,
    "own-slam": nothing,
    "two-robots": nothing,
    "planner": nothing,
}
LEFT = {  # what a tutorial leaves: a map, and the fewest keyframes in it
    "rgbd-folder": ("room-run/map.tsf", 24),
    "stereo-pair": ("drive-run/map.tsf", 5),
    "lidar-bag": ("drive-again/map.tsf", 3),
    "own-slam": ("my-maps/maps/loops/map.tsf", 4),
    "two-robots": ("my-maps/maps/house/map.tsf", 8),
    "planner": ("my-maps/maps/default/map.tsf", 8),
}


def test_each_tutorial_is_run() -> None:
    assert set(PREPARED) == {page.stem for page in TUTORIALS.glob("*.md")} - {"index"}
    untried = {name for name in PREPARED if all(b.needs for b in doc_pages.blocks(TUTORIALS / f"{name}.md"))}
    assert untried == {"realsense"} == set(PREPARED) - set(LEFT)


@pytest.mark.nightly
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", LEFT)
def test_a_tutorial_works_at_the_first_try(name: str, data: Data, tmp_path: Path) -> None:
    PREPARED[name](tmp_path, data)
    doc_pages.run(TUTORIALS / f"{name}.md", tmp_path)
    path, fewest = LEFT[name]
    assert Volume.load(tmp_path / path).stats().keyframes >= fewest
