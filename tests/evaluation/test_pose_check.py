# SPDX-License-Identifier: MIT
"""Genuine datasets pass the check; the usual mistakes are named, those that nobody could see are not."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from clients_and_spools import NOBODY
from numpy.typing import NDArray
from support.corrupted_recordings import FOLDERS, Corrupted, genuine, opened

from tsfusion import cli
from tsfusion.datasets import Dataset, PartOfDataset, Synthetic, open_dataset, select
from tsfusion.evaluation import pose_check
from tsfusion.evaluation.pose_check import check
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import quaternion, rigid
from tsfusion.pipelines.runs import engine

Data = Callable[[str], Path]
MIRROR, OPENGL = np.diag([1.0, -1, 1, 1]), np.diag([1.0, -1, -1, 1])
BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
OTHER_WORLD = se3.exp(np.array([0.3, 0.1, -0.2, 0.5, -1.2, 0.8]))


def stretched(factor: float) -> Callable[[Transform], Transform]:
    def change(T: Transform) -> Transform:
        moved: Transform = np.array(T)
        moved[:3, 3] *= factor
        return moved

    return change


def reordered(order: list[int]) -> Callable[[Transform], Transform]:
    return lambda T: rigid(quaternion(T[:3, :3])[order], T[:3, 3])


def transposed(T: Transform) -> Transform:
    turned: Transform = np.array(T)
    turned[:3, :3] = T[:3, :3].T
    return turned


def deeper(factor: float) -> Callable[[Frame], dict[str, object]]:
    return lambda frame: {"depth_scale": frame.depth_scale * factor}


def negative_fy(frame: Frame) -> dict[str, object]:
    K = frame.intrinsics
    return {"intrinsics": Intrinsics(K.fx, -K.fy, K.cx, K.cy)}


POSES: dict[str, tuple[Callable[[Transform], NDArray[np.float64]], str]] = {
    "inverse": (se3.inverse, "inverse"),
    "opengl": (lambda T: T @ OPENGL, "opengl"),
    "view matrix": (lambda T: OPENGL @ se3.inverse(T), "inverse opengl"),
    "left-handed": (lambda T: MIRROR @ T @ MIRROR, "mirror"),
    "body axes": (lambda T: T @ BODY, "body axes"),
    "camera axes": (lambda T: T @ BODY.T, "camera axes"),
    "quaternion wxyz": (reordered([3, 0, 1, 2]), "quaternion wxyz"),
    "quaternion xyzw": (reordered([1, 2, 3, 0]), "quaternion xyzw"),
    "conjugate": (transposed, "conjugate"),
}
WHOLE = (
    "7scenes",
    "hololens",
    pytest.param("redwood", marks=pytest.mark.nightly),
    pytest.param("open3d", marks=pytest.mark.nightly),
)


@cache
def synthetic(world: str, sensor: str) -> Dataset:
    return Corrupted(Synthetic(world, sensor, count=18))


@pytest.mark.parametrize("name", FOLDERS)
def test_genuine_folders_pass(name: str, data: Data) -> None:
    report = genuine(data(FOLDERS[name]))
    assert report.verdict == ("cannot tell" if name == "icl" else "agree")  # whose three frames hardly move
    assert report.mistake is None


@pytest.mark.parametrize(
    ("sequence", "poses"), [("06", None), ("00", "poses_estimated/00_ORB.txt")], ids=["stereo", "lidar"]
)
def test_genuine_kitti_passes(sequence: str, poses: str | None, data: Data) -> None:
    options = {"sequence": sequence} | ({} if poses is None else {"poses": poses})
    assert check(opened(data("kitti_odometry"), **options)).verdict == "agree"


@pytest.mark.parametrize(
    ("world", "sensor"),
    [
        ("room", "kinect"),
        ("room", "stereo"),
        pytest.param("room", "lidar", marks=pytest.mark.nightly),
        pytest.param("street", "lidar", marks=pytest.mark.nightly),
    ],
)
def test_synthetic_worlds_pass(world: str, sensor: str) -> None:
    assert check(synthetic(world, sensor)).verdict == "agree"


@pytest.mark.parametrize("mistake", POSES)
@pytest.mark.parametrize("name", [pytest.param("7scenes", marks=pytest.mark.nightly), *WHOLE[1:]])
def test_misread_poses_are_named(name: str, mistake: str, data: Data) -> None:
    change, expected = POSES[mistake]
    report = check(Corrupted(opened(data(FOLDERS[name])), change))
    assert report.verdict == "disagree"
    assert report.mistake == expected
    assert report.tried[expected] > 0.8


@pytest.mark.slow
@pytest.mark.parametrize(
    "mistake",
    [
        "inverse",
        *(pytest.param(one, marks=pytest.mark.nightly) for one in POSES if one != "inverse"),
    ],
)
def test_misread_poses_of_a_lidar_are_named(mistake: str) -> None:
    change, expected = POSES[mistake]
    report = check(Corrupted(synthetic("room", "lidar"), change))
    assert expected in (report.mistake, *report.alternatives)


def test_kitti_scans_without_tr_are_named(data: Data) -> None:
    root = data("kitti_odometry")
    scans = opened(root, sequence="00", poses="poses_estimated/00_ORB.txt")
    report = check(Corrupted(scans, lambda T: BODY @ T @ BODY.T))  # of the camera, up to the world's axes
    assert report.mistake == "camera axes"
    assert "Tr" in report.text


def test_what_straight_driving_cannot_tell_apart_is_said(data: Data) -> None:
    report = check(Corrupted(opened(data("kitti_odometry"), sequence="06"), se3.inverse))
    assert report.mistake == "inverse"
    assert "opengl" in report.alternatives
    assert "opengl" in report.text


@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.parametrize(("factor", "words"), [(1000, "millimetres"), (100, "centimetres")], ids=["mm", "cm"])
def test_units_of_translations_are_named(name: str, factor: float, words: str, data: Data) -> None:
    report = check(Corrupted(opened(data(FOLDERS[name])), stretched(factor)))
    assert report.mistake == "scale"
    assert report.factor == pytest.approx(1 / factor)
    assert words in report.text


@pytest.mark.parametrize("name", WHOLE)
@pytest.mark.parametrize("factor", [0.2, 1.31, pytest.param(5.0, marks=pytest.mark.nightly)])
def test_wrong_depth_scale_is_measured(name: str, factor: float, data: Data) -> None:
    report = check(Corrupted(opened(data(FOLDERS[name])), frame=deeper(factor)))
    assert report.mistake == "scale"
    assert report.factor == pytest.approx(factor, rel=0.04)
    small = factor < 1
    size = f"{1 / factor if small else factor:.3g} times too {'small' if small else 'large'}"
    assert factor == 1.31 or f"depth is {size}" in report.text


@pytest.mark.parametrize("name", WHOLE)
def test_wrong_sign_of_fy_is_named(name: str, data: Data) -> None:
    report = check(Corrupted(opened(data(FOLDERS[name])), frame=negative_fy))
    assert report.mistake == "mirror"
    assert "fy" in report.text


@pytest.mark.parametrize("late", [-1, pytest.param(1, marks=pytest.mark.nightly), 2])
@pytest.mark.parametrize("name", ["7scenes", "hololens"])
def test_poses_of_other_frames_are_noticed(name: str, late: int, data: Data) -> None:
    report = check(Corrupted(opened(data(FOLDERS[name])), late=late))
    assert report.mistake == "time"
    assert report.shift == late


def test_shift_is_told_in_milliseconds(data: Data) -> None:
    moved = Corrupted(opened(data(FOLDERS["7scenes"])), late=1)
    moved.timestamps_ns = np.arange(len(moved), dtype=np.int64) * 133_000_000
    assert "1 frame (133 ms) late" in check(moved).text


def test_what_agrees_and_cannot_be_told_apart_is_said(data: Data) -> None:
    report = genuine(data(FOLDERS["3dmatch"]))
    assert report.verdict == "agree"
    assert set(report.alternatives) == {"mirror", "conjugate"}
    assert "mirror, conjugate" in report.text
    assert "tell them apart" in report.text
    sure = genuine(data(FOLDERS["7scenes"]))
    assert sure.text == "poses and depth agree"
    assert sure.alternatives == ()


@pytest.mark.parametrize("name", ["7scenes", "hololens", "3dmatch"])
def test_axes_of_the_world_do_not_matter(name: str, data: Data) -> None:
    assert check(Corrupted(opened(data(FOLDERS[name])), lambda T: OTHER_WORLD @ T)).verdict == "agree"


@pytest.mark.parametrize("name", ["7scenes", "hololens"])
def test_what_nothing_explains_is_said(name: str, data: Data) -> None:
    rng = np.random.default_rng(4)
    noisy = Corrupted(opened(data(FOLDERS[name])), lambda T: se3.exp(rng.normal(size=6) * 0.05) @ T)
    report = check(noisy)
    assert report.verdict == "disagree"
    assert report.mistake == "unexplained"


def test_kittis_wrong_ground_truth_is_flagged(data: Data) -> None:
    report = check(opened(data("kitti_odometry"), sequence="00"))
    assert report.verdict == "disagree"
    assert report.mistake == "scale"  # of the first scans: 0.86 m a frame, ORB-SLAM has 0.70
    assert report.factor == pytest.approx(0.82, abs=0.04)
    assert "no usual unit" in report.text


def blind(frame: Frame) -> dict[str, object]:
    return {"depth": np.zeros(frame.shape, np.uint16)}


def still(views: Dataset) -> Dataset:
    return Corrupted(PartOfDataset(views, [0] * 20), lambda _: np.eye(4))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        pytest.param("hololens", lambda views: select(views, start=5, stride=32), id="shares nothing"),
        pytest.param("7scenes", still, id="stands still"),
        pytest.param("7scenes", lambda views: select(views, limit=1), id="one frame"),
        pytest.param("open3d", lambda views: Corrupted(views, frame=blind), id="without depth"),
    ],
)
def test_what_cannot_be_told(name: str, change: Callable[[Dataset], Dataset], data: Data) -> None:
    assert check(change(opened(data(FOLDERS[name])))).verdict == "cannot tell"


def test_points_that_no_lidar_measures_are_no_matter() -> None:
    scans = synthetic("room", "lidar")

    def beyond(frame: Frame) -> dict[str, object]:
        return {"points": np.vstack([[[3e38, 0, 0]], frame.points[1:]]).astype(np.float32)}

    assert check(Corrupted(scans, frame=beyond)).verdict == "agree"


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    return int(ended.value.code or 0)


def test_verb_says_what_it_found(data: Data, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    place = data(FOLDERS["open3d"])
    assert run("check", str(place)) == 0
    assert "poses and depth agree" in capsys.readouterr().out
    assert run("check", str(place), "--json") == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "agree"
    assert run("check", str(inverted(place, tmp_path))) == 1
    assert "world-to-camera" in capsys.readouterr().out
    assert run("check", str(place), "--option", "depth_scale=0.0002") == 1
    assert "depth is 5 times too small" in capsys.readouterr().out


def inverted(place: Path, folder: Path) -> Path:
    """A copy whose trajectory is world-to-camera."""
    from tsfusion.datasets.trajectory_files import read_log

    copy = folder / "wrong"
    copy.mkdir()
    for name in ("depth", "color"):
        (copy / name).symlink_to(place / name)
    (copy / "K.txt").write_text("525 0 319.5\n0 525 239.5\n0 0 1\n")
    text = ""
    for index, T in read_log(place / "trajectory.log"):
        rows = "\n".join(" ".join(repr(float(value)) for value in row) for row in se3.inverse(T))
        text += f"{index} {index} {index + 1}\n{rows}\n"
    (copy / "trajectory.log").write_text(text)
    K = opened(place).frame(0).intrinsics
    (copy / "K.txt").write_text(f"{K.fx} {K.fy} {K.cx} {K.cy}")
    return copy


def test_replay_stops_before_it_fuses_what_is_wrong(
    data: Data, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from tsfusion.cli import runs
    from tsfusion.core.errors import IncompleteRun

    wrong = inverted(data(FOLDERS["open3d"]), tmp_path)
    with pytest.raises(IncompleteRun, match=r"nothing is fused, .* the poses are world-to-camera"):
        runs._checked(open_dataset(wrong))
    assert runs._checked(open_dataset(data(FOLDERS["open3d"]))) == ("", [])
    assert capsys.readouterr().err == ""


def test_a_scan_says_what_is_wrong_with_frames_without_poses(
    data: Data, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colour that does not lie on the depth costs a scan its place: half of the frames are not localised."""
    whole = data(FOLDERS["7scenes"])
    assert pose_check.check_frames(open_dataset(whole, posed=False)) == (None, None)
    depth, color = pose_check.check_frames(open_dataset(whole, posed=False, register=False))
    assert depth is None
    assert str(color).startswith("the colour is not registered to the depth: its edges lie about")
    monkeypatch.setattr(engine, "LINGER", 0.0)
    askew = ("--intrinsics", "585,585,240,320")
    out, few = tmp_path / "out", ("--option", "register=false", "--max-frames", "8", *askew)
    with pytest.raises(SystemExit):
        cli.main(["scan", str(whole), *few, "--connect", NOBODY, f"--spool={out}-spool", "--out", str(out)])
    warning, centre = json.loads((out / "run.json").read_text())["warnings"]
    assert "cx and cy are exchanged, or of the image turned by 90°" in centre
    assert warning.startswith(color)
    assert "--option color=false tracks by the depth alone" in warning
    assert "The colour is not registered to the depth" in (out / "report.html").read_text(encoding="utf-8")


def test_depth_in_a_wrong_unit_is_told_without_poses(data: Data) -> None:
    depth, _ = pose_check.check_frames(open_dataset(data(FOLDERS["open3d"]), depth_scale=1.0))
    assert str(depth).startswith("depth is unusable: it reads as")
