# SPDX-License-Identifier: MIT
"""The layout of a path: found and reported; files, other packages' layouts, frames without poses."""

import json
import logging
import shutil
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_processes import tsfusion
from small_recordings import claim_size, kitti, one_line, redwood, seven_scenes
from written_recordings import replica, scannet, transforms, write

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import PartOfDataset, describe, find, layouts, open_dataset, select
from tsfusion.datasets.dataset import pose_of
from tsfusion.geometry.keyframe import Intrinsics


def tum(root: Path) -> Path:
    """Three frames with lists and no trajectory."""
    images = {"depth": np.full((480, 640), 5000, np.uint16), "rgb": np.zeros((480, 640, 3), np.uint8)}
    for name, pixels in images.items():
        lines = []
        for frame in range(3):
            write(root / name / f"{frame}.png", pixels)
            lines.append(f"{frame / 30:.4f} {name}/{frame}.png\n")
        (root / f"{name}.txt").write_text("".join(lines))
    (root / "K.txt").write_text("525 0 319.5\n0 525 239.5\n0 0 1\n")
    return root


def test_some_poses_are_given_where_they_are_known(tmp_path):
    seven_scenes(tmp_path, 4)
    (tmp_path / "frame-000002.pose.txt").unlink()
    dataset = open_dataset(tmp_path, posed=False)
    assert [dataset.pose(index) is None for index in range(-4, 0)] == [False, False, True, False]
    said = f"7-Scenes {tmp_path.name}, 4 RGB-D frames 8×6, poses for 3"
    unit = "depth unit 1 mm (1000 a metre), as usual"
    assert describe(dataset) == f"{said}; {unit}; camera fx 5 fy 5 cx 4 cy 3, 8×6, from camera-intrinsics.txt"
    every_second = select(dataset, stride=2)
    assert [pose_of(every_second, index) is None for index in range(2)] == [False, True]
    assert isinstance(every_second, PartOfDataset)
    with pytest.raises(IndexError):
        dataset.pose(4)


def test_poses_that_are_there_and_mostly_broken_are_an_error_all_the_same(tmp_path):
    seven_scenes(tmp_path)
    for frame, read in ((1, [True, False, True]), (2, None)):
        (tmp_path / f"frame-{frame:06d}.pose.txt").write_text("1 0 0\n")
        if read is not None:
            dataset = open_dataset(tmp_path, posed=False)
            assert [dataset.pose(index) is not None for index in range(3)] == read
    with pytest.raises(DatasetError, match="3 numbers, expected 4"):
        open_dataset(tmp_path, posed=False)
    root = kitti(tmp_path / "kitti")
    with pytest.raises(DatasetError, match=r"gone\.txt is missing"):
        open_dataset(root, posed=False, poses="gone.txt")


def test_kitti_poses_may_end_early(tmp_path):
    root = kitti(tmp_path)
    (root / "poses" / "06.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    for modality in ("stereo", "lidar"):
        dataset = open_dataset(root, modality=modality, posed=False)
        assert [dataset.pose(index) is None for index in range(4)] == [False, False, False, True]
        assert dataset.frame(3).T_world_camera is None
    pairs = open_dataset(root, posed=False)
    said = "KITTI 06 stereo, 4 stereo pairs 160×48 at 10 Hz, poses for 3"
    assert describe(pairs) == f"{said}; camera fx 700 fy 700 cx 40 cy 24, 160×48, from calib.txt"


def test_worlds_have_all_poses(tmp_path):
    assert open_dataset("synthetic:room", posed=False, count=2).pose(1) is not None


def test_a_file_stands_for_its_folder(tmp_path):
    root = tum(tmp_path / "desk")
    (root / "groundtruth.txt").write_text("".join(f"{t / 30:.4f} {t} 0 0 0 0 0 1\n" for t in range(3)))
    for name in ("depth.txt", "groundtruth.txt", "rgb.txt"):
        assert open_dataset(root / name).name == "TUM desk"
    with pytest.raises(DatasetError, match=r"0\.png is not a folder, nor a file that stands for a dataset"):
        open_dataset(root / "depth" / "0.png")
    (tmp_path / "scene.sens").write_text("x")
    with pytest.raises(DatasetError, match=r"scene\.sens is a ScanNet recording; export it .* SensReader"):
        open_dataset(tmp_path / "scene.sens")


def test_two_layouts_in_one_folder_are_told(tmp_path, caplog):
    root = tum(tmp_path / "both")
    seven_scenes(root)
    with caplog.at_level(logging.WARNING):
        found = find(root)
    assert (found.layout.name, found.also) == ("7-Scenes", ("TUM RGB-D",))
    assert f"{root} is read as 7-Scenes; it fits TUM RGB-D too" in caplog.text


def test_more_special_layouts_are_not_taken_for_plain_folders(tmp_path):
    for name, make in (("ScanNet", scannet), ("Replica", replica)):
        found = find(make(tmp_path / name))
        assert (found.layout.name, found.also) == (name, ())
    found = find(transforms(tmp_path / "capture"))
    assert (found.layout.name, found.also) == ("nerfstudio", ())


PLUGIN = """
from pathlib import Path
from tsfusion.datasets import Layout, Synthetic

def recognises(path):
    if path.name == "cursed":
        raise RuntimeError("no")
    return (path / "theirs.txt").is_file()

def opened(path, *, width=None):
    return Synthetic(count=2, width=width)

layout = Layout("Theirs", "theirs.txt", recognises, opened)
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """An installed package with two layouts, one of which cannot be loaded."""
    place = tmp_path / "site-packages"
    info = place / "theirs-1.0.dist-info"
    info.mkdir(parents=True)
    (place / "theirs_layout.py").write_text(PLUGIN)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[tsfusion.datasets]\ntheirs = theirs_layout:layout\nbroken = theirs_layout:gone\n"
    )
    monkeypatch.syspath_prepend(place)
    return place


@pytest.mark.usefixtures("plugin")
def test_other_packages_bring_layouts(tmp_path, caplog):
    root = tmp_path / "recording"
    root.mkdir()
    (root / "theirs.txt").write_text("")
    dataset = open_dataset(root, width=64, posed=False)
    assert (len(dataset), dataset[0].shape) == (2, (48, 64))
    assert find(root).layout.name == "Theirs"
    assert "Theirs" in [layout.name for layout in layouts()]
    assert "the dataset layout broken is left out: broken (theirs_layout:gone), an entry" in caplog.text
    with pytest.raises(DatasetError, match=r"^a Theirs dataset takes no `sequence`; it takes width$"):
        open_dataset(root, sequence="06")


@pytest.mark.usefixtures("plugin")
def test_another_packages_fault_is_not_ours(tmp_path, caplog):
    seven_scenes(tmp_path / "cursed")
    assert open_dataset(tmp_path / "cursed").name == "7-Scenes cursed"
    assert "the layout Theirs failed on" in caplog.text


def test_no_layout_fails_on_any_file_or_folder(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "depth").write_text("a file where a folder is expected")
    for name in ("a.log", "a.json", "a.txt", "depth.txt", "mav0", "traj.txt"):
        (tmp_path / "folder" / name).write_bytes(b"\xff\x00")
    for path in [*tmp_path.rglob("*"), tmp_path]:
        for layout in layouts():
            assert layout.recognises(path) in (True, False)
        one_line(lambda path=path: open_dataset(path))


def test_what_macos_puts_beside_files_is_no_recording(tmp_path):
    redwood(tmp_path, [0, 1], [0, 1])
    for path in [path for path in tmp_path.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\x16\7")
    assert len(list(open_dataset(tmp_path))) == 2
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as packed:
        for path in sorted(tmp_path.rglob("*.*")):
            if path.suffix != ".zip":
                place = "__MACOSX/depth" if path.name.startswith("._") else "recording"
                packed.write(path, f"{place}/{path.relative_to(tmp_path)}")
    assert len(open_dataset(tmp_path / "a.zip", unpack=True)) == 2


@pytest.mark.parametrize("side", [20_000, 100_000])
def test_an_image_that_claims_to_be_huge_is_named(tmp_path, side):
    root = redwood(tmp_path, [0], [0])
    claim_size(root / "depth" / "00000.png", side)
    with pytest.raises(DatasetError, match=r"00000\.png cannot be decoded; expected a depth image"):
        open_dataset(root)[0]


def test_a_depth_image_of_another_size_is_named(tmp_path):
    dataset = open_dataset(redwood(tmp_path, [0, 1], [0, 1]))
    assert dataset[0].shape == (6, 8)
    for name, pixels in (("depth", np.ones((12, 16), np.uint16)), ("color", np.zeros((12, 16, 3), np.uint8))):
        cv2.imwrite(str(tmp_path / name / "00001.png"), pixels)
    with pytest.raises(DatasetError, match=r"00001\.png is 16×12, others are 8×6; expected one size"):
        dataset[1]


def test_the_command_lists_files_and_says_which_recordings_are_broken(here, tmp_path):
    for name in ("a", "b"):
        scans = tmp_path / "scans" / name
        scans.mkdir(parents=True)
        for number in range(2):
            (scans / f"{number}.bin").write_bytes(b"1" if name == "a" else np.ones(36, "<f4").tobytes())
    (tmp_path / "cut.r3d").write_bytes(b"PK")
    found = here("datasets", tmp_path)
    assert found.returncode == 0
    assert found.stdout.startswith(f"{tmp_path / 'scans' / 'b'}  LiDAR scans b  lidar  2 frames")
    assert found.stdout.count("\n") == 1
    assert f"{tmp_path / 'cut.r3d'} is no whole .r3d file" in found.stderr
    assert f"{tmp_path / 'scans' / 'a' / '0.bin'} has 1 bytes" in found.stderr


def test_the_command_lists_layouts_and_datasets(here, tmp_path):
    listed, again = here("datasets"), here("datasets", "list")
    assert (listed.returncode, listed.stdout) == (again.returncode, again.stdout)
    rows = dict(line.split("  ", 1) for line in listed.stdout.splitlines())
    assert list(rows) == [*(layout.name for layout in layouts()), "synthetic"]
    scannet(tmp_path / "a" / "scene0000_00")
    camera = "camera fx 146.25 fy 146.25 cx 79.5 cy 59.5, 160×120, from intrinsic/intrinsic_depth.txt"
    expected = f"{tmp_path}  ScanNet scene0000_00  kinect  4 keyframes  {camera}\n"
    found = here("datasets", tmp_path)
    assert (found.returncode, found.stdout, found.stderr) == (0, expected, "")
    rows = json.loads(here("datasets", tmp_path, "--json").stdout)
    assert rows[0]["name"] == "ScanNet scene0000_00"
    tum(tmp_path / "b" / "rgbd")
    found = here("datasets", tmp_path / "b")
    assert "  TUM rgbd  kinect  3 frames without poses, for `tsfusion scan`  camera fx 525" in found.stdout
    assert found.returncode == 0
    (tmp_path / "b" / "rgbd" / "K.txt").unlink()
    found = here("datasets", tmp_path / "b")
    assert "the camera of these 640×480 images is not known" in found.stderr


def test_replay_says_what_it_found(tmp_path):
    scannet(tmp_path / "scene0000_00", lost=(2,))
    shutil.make_archive(str(tmp_path / "scan"), "zip", tmp_path, "scene0000_00")
    done = tsfusion("replay", tmp_path / "scan.zip", "--unpack", "--sensor", "sonar")
    assert done.returncode == 1
    first, second = done.stderr.splitlines()
    assert first.startswith("found: ScanNet scene0000_00, 3 RGB-D frames 160×120, all with poses; depth unit")
    assert "sonar" in second
    assert (tmp_path / "scan" / "scene0000_00").is_dir()


def test_options_are_taken_as_they_were_meant(tmp_path):
    redwood(tmp_path / "5", [0], [0])
    dataset = open_dataset(tmp_path / "5", intrinsics=[500, 500, 3.5, 2.5], depth_scale=1)
    assert dataset[0].intrinsics == Intrinsics(500, 500, 3.5, 2.5)
    assert dataset[0].depth_scale == 1.0
    with pytest.raises(DatasetError, match=r"5/17 is missing"):
        open_dataset(tmp_path / "5", trajectory=17)
    one_line(
        lambda: open_dataset(tmp_path / "5", color="False"), "`color` must be true or false, got 'False'"
    )


@pytest.mark.parametrize(
    "content",
    ["[" * 200_000, '{"intrinsic_matrix": [%s, 0, 0, 0, 1, 0, 3, 3, 1]}' % ("1" * 400),
     '{"camera": {"w": 1e999, "h": 6, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "scale": 1}}',
     '{"camera": {"w": 0, "h": 0, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "scale": 1}}'],
)  # fmt: skip
def test_a_broken_camera_file_is_one_clear_line(tmp_path, content):
    redwood(tmp_path / "redwood", [0], [0])
    (tmp_path / "redwood" / "camera_intrinsic.json").write_text(content)
    replica(tmp_path / "replica")
    (tmp_path / "replica" / "cam_params.json").write_text(content)
    for place in ("redwood", "replica"):
        one_line(lambda place=place: open_dataset(tmp_path / place), r"(intrinsic|params)\.json")
