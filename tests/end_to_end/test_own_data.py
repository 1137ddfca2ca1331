# SPDX-License-Identifier: MIT
"""Own recordings made from real frames: the path alone gives the keyframes that were recorded."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import own_recordings
import pytest
import rosbag_scenes

from tsfusion import Keyframe, open_dataset
from tsfusion.core.errors import DatasetError
from tsfusion.datasets.trajectory_files import write_tum

COUNT = 6
Data = Callable[[str], Path]
Write = Callable[[Path, Sequence[Keyframe]], Path]

FORMS: dict[str, Write] = {
    "tum": own_recordings.tum,
    "images": own_recordings.images,
    "nerfstudio": own_recordings.nerfstudio,
    "ros1": lambda root, views: own_recordings.bag(root, views, "ros1"),
    "sqlite3": lambda root, views: own_recordings.bag(root, views, "sqlite3"),
    "mcap": lambda root, views: own_recordings.bag(root, views, "mcap"),
}


@pytest.fixture(scope="module")
def kitchen(data: Data) -> list[Keyframe]:
    return own_recordings.views(data("7scenes/redkitchen"), COUNT, every=1)


@pytest.mark.parametrize("form", FORMS)
def test_an_own_recording_gives_what_was_recorded(kitchen: list[Keyframe], tmp_path: Path, form: str) -> None:
    found = open_dataset(FORMS[form](tmp_path / "mine", kitchen))
    assert len(found) == COUNT
    for keyframe, expected in zip(found, kitchen, strict=True):
        metres = np.asarray(keyframe.measurement) * keyframe.depth_scale
        np.testing.assert_allclose(metres, np.asarray(expected.measurement) * 0.001, atol=1e-6)
        assert np.array_equal(keyframe.color, expected.color)
        np.testing.assert_allclose(keyframe.intrinsics.matrix, expected.intrinsics.matrix, rtol=1e-12)
        np.testing.assert_allclose(keyframe.T_world_camera, expected.T_world_camera, atol=1e-6)


def poses_file(path: Path, form: str, kitchen: list[Keyframe]) -> Path:
    """The poses as another SLAM writes them: by time, by frame number, one a line."""
    poses = [view.T_world_camera for view in kitchen]
    if form == "kitti":
        np.savetxt(path, [T[:3].ravel() for T in poses])
    else:
        stamps = own_recordings.stamps_ns(COUNT) if form == "times" else [i * 10**9 for i in range(COUNT)]
        write_tum(path, stamps, poses)
    return path


@pytest.mark.parametrize("form", ["images", "timed", "nerfstudio", "mcap", "tum"])
@pytest.mark.parametrize("poses", ["times", "kitti"])
def test_every_own_recording_takes_poses_of_another_slam(
    kitchen: list[Keyframe], tmp_path: Path, form: str, poses: str
) -> None:
    slam = poses_file(tmp_path / "slam.txt", poses, kitchen)
    write = {"timed": own_recordings.timed_images} | FORMS
    root = write[form](tmp_path / "mine", kitchen)
    if form == "images":
        (root / "trajectory.log").unlink()
    if form == "mcap" and poses == "times":
        write_tum(slam, [rosbag_scenes.T0 + i * rosbag_scenes.FRAME_NS for i in range(COUNT)],
                  [view.T_world_camera for view in kitchen])  # fmt: skip
    found = open_dataset(root, trajectory=slam)
    assert len(found) == COUNT
    for keyframe, expected in zip(found, kitchen, strict=True):
        np.testing.assert_allclose(keyframe.T_world_camera, expected.T_world_camera, atol=1e-6)


def test_poses_that_cannot_be_paired_are_an_error_that_says_so(
    kitchen: list[Keyframe], tmp_path: Path
) -> None:
    root = own_recordings.images(tmp_path / "mine", kitchen, poses=False)
    short = poses_file(tmp_path / "short.txt", "kitti", kitchen[:-1])
    with pytest.raises(DatasetError, match=r"has 5 poses for 6 frames, .*: give one pose a frame, or times"):
        open_dataset(root, trajectory=short)
    timed = own_recordings.timed_images(tmp_path / "timed", kitchen)
    other = poses_file(tmp_path / "other.txt", "numbers", kitchen)
    with pytest.raises(DatasetError, match=r"no pose at the time of any frame: .* expected one clock"):
        open_dataset(timed, trajectory=other)


@pytest.mark.parametrize("poses", ["kitti", "numbers"])
def test_a_scan_of_images_without_times_takes_one_pose_a_frame(
    kitchen: list[Keyframe], tmp_path: Path, poses: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from tsfusion.cli.scan import _open

    root = own_recordings.images(tmp_path / "mine", kitchen, poses=False)
    settings = {"trajectory": str(poses_file(tmp_path / "slam.txt", poses, kitchen)), "localizer": None}
    more = {"part": {"start": 2, "stride": 2, "limit": None}, "settings": settings}
    with _open(None, str(root), {}, camera={}, rate=None, recording={}, **more) as source:
        found = [frame.T_world_camera for frame in source]
    assert settings == {"trajectory": None, "localizer": "given"}
    np.testing.assert_allclose(found, [kitchen[2].T_world_camera, kitchen[4].T_world_camera], atol=1e-6)
    assert "one a frame in order" in capsys.readouterr().err
