# SPDX-License-Identifier: MIT
"""The camera on the command line: given, named in what is printed, and asked for where it is not known."""

import json
from collections.abc import Callable
from pathlib import Path

import own_recordings
import pytest
from command_processes import Here, tsfusion
from own_recordings import KINECT
from small_recordings import redwood

CAMERA = "fx 585 fy 585 cx 320 cy 240, 640×480"


@pytest.fixture
def kitchen(data: Callable[[str], Path]) -> Path:
    return data("7scenes/redkitchen")


def test_check_takes_a_camera_and_names_it(here: Here, tmp_path: Path, kitchen: Path) -> None:
    root = own_recordings.images(tmp_path / "mine", own_recordings.views(kitchen), camera=False)
    done = here("check", root, "--intrinsics", "585,585,320,240")
    assert f"; camera {CAMERA}, as given\n" in done.stderr
    (tmp_path / "k.txt").write_text(KINECT)
    done = here("check", root, "--calibration", tmp_path / "k.txt", "--json")
    assert json.loads(done.stdout)["camera"] == f"{CAMERA}, from the given k.txt"
    (root / "camera-intrinsics.txt").write_text(KINECT)
    assert f"; camera {CAMERA}, from camera-intrinsics.txt\n" in here("check", root).stderr
    assert f"  camera {CAMERA}, from camera-intrinsics.txt\n" in here("datasets", root).stdout


@pytest.mark.nightly  # else `test_check_takes_a_camera_and_names_it`
@pytest.mark.usefixtures("quick_servers")
def test_a_replay_names_its_camera(here: Here, tmp_path: Path, kitchen: Path) -> None:
    root = own_recordings.tum(tmp_path / "mine", own_recordings.views(kitchen, 2), camera=False)
    out = tmp_path / "out"
    done = here("replay", root, "--intrinsics", "585,585,320,240", "--voxel-size", 0.08, "--out", out)
    assert done.returncode == 0, done.stderr
    assert f"camera     {CAMERA}, as given" in done.stdout
    assert json.loads((out / "run.json").read_text())["camera"] == f"{CAMERA}, as given"


def test_opencv_does_not_print_for_us(tmp_path: Path) -> None:
    """A TIFF that ends early is our error, not OpenCV's as well."""
    root = redwood(tmp_path, [0], [0])
    (root / "depth" / "00000.png").rename(root / "depth" / "00000.tiff")
    (root / "depth" / "00000.tiff").write_bytes(b"II*\0\x10\0\0\0" + bytes(40))
    done = tsfusion("check", root)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "00000.tiff cannot be decoded; expected a depth image" in done.stderr
