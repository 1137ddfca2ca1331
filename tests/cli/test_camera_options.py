# SPDX-License-Identifier: MIT
"""The camera on the command line: given, named in what is printed, and asked for where it is not known."""

import json
from collections.abc import Callable
from pathlib import Path

import own_recordings
import pytest
from command_processes import Here, tsfusion
from own_recordings import KINECT
from small_recordings import kitti, redwood

CAMERA = "fx 585 fy 585 cx 320 cy 240, 640×480"


@pytest.fixture
def kitchen(data: Callable[[str], Path]) -> Path:
    return data("7scenes/redkitchen")


def failed(done: "object", status: int = 1) -> str:
    """The one line of a command that failed as it should."""
    assert done.returncode == status, done.stderr  # type: ignore[attr-defined]
    last: str = done.stderr.splitlines()[-1]  # type: ignore[attr-defined]
    assert last.startswith("tsfusion: ")
    return last


@pytest.mark.parametrize("verb", [["check"], ["replay"], ["scan"]])
def test_a_recording_of_an_unknown_camera_is_turned_away(
    here: Here, tmp_path: Path, kitchen: Path, verb: list[str]
) -> None:
    """Where 525 was taken once, and all came out 11 % too wide."""
    root = own_recordings.tum(tmp_path / "mine", own_recordings.views(kitchen, 2), camera=False)
    line = failed(here(*verb, root))
    assert "mine: the camera of these 640×480 images is not known: no camera-intrinsics.txt, K.txt," in line
    assert line.endswith("give --intrinsics fx,fy,cx,cy or --calibration FILE")


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


@pytest.mark.usefixtures("quick_servers")
def test_a_replay_names_its_camera(here: Here, tmp_path: Path, kitchen: Path) -> None:
    root = own_recordings.tum(tmp_path / "mine", own_recordings.views(kitchen, 2), camera=False)
    out = tmp_path / "out"
    done = here("replay", root, "--intrinsics", "585,585,320,240", "--voxel-size", 0.08, "--out", out)
    assert done.returncode == 0, done.stderr
    assert f"camera     {CAMERA}, as given" in done.stdout
    assert json.loads((out / "run.json").read_text())["camera"] == f"{CAMERA}, as given"


@pytest.mark.parametrize(
    ("flags", "match"),
    [
        (["--intrinsics", "585,585"], "--intrinsics must be fx,fy,cx,cy in pixels, such as 585,585,320,240"),
        (["--intrinsics", "a,b,c,d"], "--intrinsics must be fx,fy,cx,cy in pixels"),
        (["--intrinsics", "0,1,2,3"], "--intrinsics must be fx,fy,cx,cy in pixels"),
        (["--intrinsics", "5,5,400,3"], "intrinsics: cx 400 lies outside of the images, which are 8×6"),
        (["--calibration", "no.yaml"], "no.yaml is missing; expected Kalibr's"),
        (["--calibration", "no.yaml", "--intrinsics", "5,5,4,3"], "exclude each other: give one of them"),
    ],
)
def test_a_camera_that_cannot_be(here: Here, tmp_path: Path, flags: list[str], match: str) -> None:
    root = redwood(tmp_path, [0], [0])
    for verb in (["check"], ["replay"], ["scan"]):
        assert match in failed(here(*verb, root, *flags))


def test_what_has_no_use_for_a_camera_says_so(here: Here, tmp_path: Path) -> None:
    line = failed(here("check", kitti(tmp_path / "kitti"), "--intrinsics", "5,5,4,3"))
    assert "a KITTI odometry dataset comes with what it needs of a camera: leave out --intrinsics" in line
    line = failed(here("scan", "synthetic:room", "--calibration", "a.yaml"))
    assert "leave out --calibration" in line


def test_opencv_does_not_print_for_us(tmp_path: Path) -> None:
    """A TIFF that ends early is our error, not OpenCV's as well."""
    root = redwood(tmp_path, [0], [0])
    (root / "depth" / "00000.png").rename(root / "depth" / "00000.tiff")
    (root / "depth" / "00000.tiff").write_bytes(b"II*\0\x10\0\0\0" + bytes(40))
    done = tsfusion("check", root)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "00000.tiff cannot be decoded; expected a depth image" in done.stderr
