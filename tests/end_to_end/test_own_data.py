# SPDX-License-Identifier: MIT
"""Own recordings made from real frames: the path alone gives what was recorded, and the right mesh."""

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
import own_recordings
import pytest
import rosbag_scenes
import trimesh
from command_processes import COMMAND, DEADLINE, Here, end, environment, eventually, tsfusion
from repository import ROOT

from tsfusion import Keyframe, open_dataset
from tsfusion.core.errors import DatasetError
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.evaluation.surface_fit import nearest

COUNT = 6
MANY = 60  # frames of the recordings that are fused
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
        stamps = (
            own_recordings.stamps_ns(len(poses))
            if form == "times"
            else [i * 10**9 for i in range(len(poses))]
        )
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
    late = open_dataset(timed, trajectory=other, time_offset_s=-own_recordings.T0_NS / 1e9)
    assert len(late) == 1  # the poses are a second apart


@pytest.mark.parametrize("poses", ["kitti", "numbers"])
def test_a_scan_of_images_without_times_takes_one_pose_a_frame(
    kitchen: list[Keyframe], tmp_path: Path, poses: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from tsfusion.cli.options import RUN_OPTIONS
    from tsfusion.cli.runs import _open

    root = own_recordings.images(tmp_path / "mine", kitchen, poses=False)
    slam = str(poses_file(tmp_path / "slam.txt", poses, kitchen))
    given = {"trajectory": slam, "start": 2, "stride": 2, "unpack": False}
    flags = dict.fromkeys([*RUN_OPTIONS, "localizer"]) | given
    source, _ = _open(None, str(root), flags)
    with source:
        found = [frame.T_world_camera for frame in source]
    assert (flags["trajectory"], flags["localizer"]) == (None, "given")
    np.testing.assert_allclose(found, [kitchen[2].T_world_camera, kitchen[4].T_world_camera], atol=1e-6)
    assert "one a frame in order" in capsys.readouterr().err


def test_the_list_of_datasets_says_why_one_cannot_be_opened(
    kitchen: list[Keyframe], tmp_path: Path, here: Here
) -> None:
    own_recordings.images(tmp_path / "unknown", kitchen[:1], camera=False)
    found = here("datasets", tmp_path / "unknown")
    assert found.returncode == 1
    assert "the camera of these 640×480 images is not known" in found.stderr
    assert "no datasets in" not in found.stderr
    lacking = own_recordings.tum(tmp_path / "lacking", kitchen[:2])
    for image in (lacking / "depth").iterdir():  # one alone would be left out
        image.unlink()
    found = here("datasets", lacking)
    assert found.returncode == 1
    assert "depth/17000000" in found.stderr
    assert "no datasets in" not in found.stderr


class Bound(NamedTuple):
    """Largest distances of a form's mesh from that of the recording itself, millimetres."""

    median: float
    p95: float


REPLAYED = Bound(0.1, 1.0)  # the same keyframes
GIVEN = Bound(6.0, 30.0)  # fewer keyframes, the same poses
LOCALISED = Bound(25.0, 80.0)  # own poses; the kitchen's are good to 30 mm
PACE = 0.1  # seconds between frames of a sensor that is watched
MESHES = dict.fromkeys(FORMS, REPLAYED) | {
    "trajectory": REPLAYED, "scan": LOCALISED, "growing": LOCALISED, "feed": GIVEN,
}  # fmt: skip


@pytest.fixture(scope="module")
def many(data: Data) -> list[Keyframe]:
    return own_recordings.views(data("7scenes/redkitchen"), MANY, every=1)


@pytest.fixture(scope="module")
def reference(data: Data, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """(n, 3) vertices of the recording's own mesh."""
    out = tmp_path_factory.mktemp("reference")
    return vertices(out, fused("replay", data("7scenes/redkitchen"), "--max-frames", MANY, out=out))


def fused(*words: object, out: Path) -> "subprocess.CompletedProcess[str]":
    return tsfusion(*words, "--voxel-size", 0.02, "--out", out, "--overwrite")


def vertices(out: Path, ended: "subprocess.CompletedProcess[str]") -> np.ndarray:
    assert ended.returncode == 0, ended.stderr
    assert "camera     fx 585 fy 585 cx 320 cy 240, 640×480, from" in ended.stdout
    assert (out / "preview.png").stat().st_size > 50_000
    return np.asarray(trimesh.load(out / "mesh.ply", process=False).vertices)


@pytest.mark.nightly
@pytest.mark.parametrize("form", MESHES)
def test_the_mesh_of_every_form_is_that_of_the_recording(
    many: list[Keyframe], reference: np.ndarray, tmp_path: Path, form: str
) -> None:
    root, out = tmp_path / "Küche süd", tmp_path / "out"
    if form in FORMS:
        ended = fused("replay", FORMS[form](root, many), out=out)
    elif form in ("growing", "feed"):
        ended = watched(root, out, many, feed=form == "feed")
    else:
        own_recordings.images(root, many, poses=False)
        slam = poses_file(tmp_path / "slam.txt", "kitti", many)
        given = ["replay", root, "--trajectory", slam] if form == "trajectory" else ["scan", root]
        ended = fused(*given, out=out)
    found = vertices(out, ended)
    if MESHES[form] is LOCALISED:  # in the frame of its first camera
        T = many[0].T_world_camera
        found = found @ T[:3, :3].T + T[:3, 3]
    distance = 1000 * nearest(found, reference)[0]
    median, p95 = np.median(distance), np.percentile(distance, 95)
    print(f"{form}: median {median:.2f}, p95 {p95:.2f} mm")
    assert median <= MESHES[form].median
    assert p95 <= MESHES[form].p95
    assert np.median(nearest(reference, found)[0]) * 1000 <= MESHES[form].p95


def unused_address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return f"tcp://127.0.0.1:{probe.getsockname()[1]}"


def watched(
    root: Path, out: Path, views: list[Keyframe], *, feed: bool
) -> "subprocess.CompletedProcess[str]":
    """Scan a folder while a sensor writes it, and another SLAM sends the poses of its frames."""
    root.mkdir()
    log, address = root.parent / "log.txt", unused_address()
    words = ["scan", f"folder:{root}", "--voxel-size", "0.02", "--out", str(out)]
    slam = None
    with ExitStack() as stack:
        if feed:
            words += ["--feed", address]
            sender = [sys.executable, str(ROOT / "contrib" / "pose_sender.py"), address]
            slam = stack.enter_context(subprocess.Popen(sender, stdin=subprocess.PIPE, text=True))
            stack.callback(slam.stdin.close)
        scan = subprocess.Popen(
            [*COMMAND, *words], stdout=stack.enter_context(log.open("w")), stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL, env=environment(),
        )  # fmt: skip
        stack.callback(end, scan)
        assert eventually(lambda: "no frames yet; waits for" in log.read_text(), DEADLINE)
        for number, (view, stamp) in enumerate(zip(views, own_recordings.stamps_ns(len(views)), strict=True)):
            if number == 1:  # the first frame brings the scanner up
                assert eventually(lambda: "scanning folder" in log.read_text(), DEADLINE), log.read_text()
            if slam is not None:
                slam.stdin.write(own_recordings.tum_line(stamp, view))
                slam.stdin.flush()
            own_recordings.image(root, str(stamp), view)
            time.sleep(PACE)
        (root / "DONE").touch()
        scan.wait(DEADLINE)
    return subprocess.CompletedProcess(words, scan.returncode, log.read_text(), log.read_text())
