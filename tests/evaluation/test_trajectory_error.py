# SPDX-License-Identifier: MIT
"""The trajectory error: laws, evo's own figures, and evo itself where it is installed."""

import json
import shutil
import subprocess
import zipfile
from pathlib import Path

import msgspec
import numpy as np
import pytest
from command_processes import tsfusion

from tsfusion import DatasetError
from tsfusion.cli.check import table
from tsfusion.datasets import open_dataset, select
from tsfusion.datasets.dataset import NOMINAL_NS, Frames, pose_of
from tsfusion.datasets.trajectory_files import read_poses, read_tum, write_tum
from tsfusion.evaluation.trajectory_error import absolute_error, associate, paired, umeyama
from tsfusion.geometry import se3
from tsfusion.geometry.trajectory import quaternion, rigid
from tsfusion.scanner.sources.source import RecordedSource

RNG = np.random.default_rng(7)
FREIBURG = "tum_rgbd/trajectories/freiburg1_xyz"


def walk(count: int = 40) -> np.ndarray:
    """Poses of a sensor that wanders."""
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3.exp(RNG.normal(0, 0.1, 6)))
    return np.array(poses)


def test_a_moved_copy_has_no_error():
    poses, T = walk(), se3.exp(np.array([3.0, -2, 1, 0.5, -1, 2]))
    error = absolute_error(T @ poses, poses)
    assert error.max < 1e-12
    assert error.rotation_deg < 1e-5
    assert error.drift_percent < 1e-9
    assert absolute_error(T @ poses, poses, align=False).min > 1
    found, scale = umeyama(poses[:, :3, 3], 2.5 * poses[:, :3, 3] + 1, with_scale=True)
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(found[:3, :3], np.eye(3), atol=1e-12)


def test_known_figures():
    """A straight way whose every second pose is 2 cm to the side: 1 cm off each after alignment."""
    poses = np.tile(np.eye(4), (41, 1, 1))
    poses[:, 0, 3] = np.arange(41)
    estimate = poses.copy()
    estimate[::2, 1, 3] += 0.02
    error = absolute_error(estimate, poses)
    assert error.count == 41
    assert error.length == 40
    assert error.mean == pytest.approx(0.01, rel=0.03)
    assert error.rmse == pytest.approx(0.01, rel=0.03)
    assert error.std < 5e-4
    assert error.rmse**2 == pytest.approx(error.mean**2 + error.std**2)
    estimate = poses.copy()
    estimate[:, 0, 3] *= 1.01
    assert absolute_error(estimate, poses).drift_percent == pytest.approx(1.0)


def test_mirrored_positions_are_turned_not_mirrored():
    positions = RNG.normal(size=(50, 3))
    T, _ = umeyama(positions, positions * (1, 1, -1))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_association_takes_the_nearest_in_time():
    few, many = np.array([10, 20, 31, 90]), np.array([0, 9, 12, 19, 22, 30, 32, 50])
    a, b = associate(few, many, 2)
    assert (list(a), list(b)) == ([0, 1, 2], [1, 3, 5])
    assert [list(x) for x in associate(many, few, 2)] == [[1, 3, 5], [0, 1, 2]]
    with pytest.raises(DatasetError, match=r"no two poses are within 1e-09 s"):
        associate(few, many + 1000, 1)
    assert [list(x) for x in associate(np.array([5]), np.array([4]), 2)] == [[0], [0]]


def test_quaternions_come_back():
    for twist in (*RNG.normal(0, 1, (200, 6)), np.zeros(6), [0, 0, 0, np.pi, 0, 0], [1, 2, 3, 0, 1e-9, 0]):
        T = se3.exp(np.array(twist))
        np.testing.assert_allclose(rigid(quaternion(T[:3, :3]), T[:3, 3]), T, atol=1e-12)


def test_tum_files_are_read_as_they_were_written(tmp_path):
    poses, stamps = walk(5), [0, 1, 10**9, 1305031102_175304123, 2 * 10**18]
    write_tum(tmp_path / "a.txt", stamps, list(poses))
    again = read_tum(tmp_path / "a.txt")
    assert list(again.timestamps_ns) == stamps
    np.testing.assert_allclose(read_poses(tmp_path / "a.txt")[1], poses, atol=2e-9)


# `evo_ape kitti poses/00.txt 00_ORB.txt`, with and without -a (evo 1.38.1)
EVO = {
    True: {
        "rmse": 1.303449714565045, "mean": 1.1569971285389946, "median": 1.0656247695558074,
        "std": 0.6002822693968386, "min": 0.06931322021483205, "max": 3.587949120678975,
    },
    False: {
        "rmse": 7.790288882656827, "mean": 7.01175040166684, "median": 6.801631674560281,
        "std": 3.3946954473067767, "min": 4.000000055511189e-09, "max": 13.458508807381891,
    },
}  # fmt: skip


@pytest.mark.parametrize("align", [True, False])
def test_figures_are_evos(data, align):
    kitti = data("kitti_odometry")
    poses = paired(kitti / "poses_estimated/00_ORB.txt", kitti / "poses/00.txt")
    error = absolute_error(*poses, align=align)
    for name, value in EVO[align].items():
        assert getattr(error, name) == pytest.approx(value, abs=1e-9), name


@pytest.mark.skipif(shutil.which("evo_ape") is None, reason="evo is not installed")
@pytest.mark.parametrize(
    ("form", "estimate", "reference"),
    [
        ("kitti", "kitti_odometry/poses_estimated/00_SPTAM.txt", "kitti_odometry/poses/00.txt"),
        ("tum", f"{FREIBURG}-rgbdslam.txt", f"{FREIBURG}-groundtruth.txt"),
    ],
)
def test_evo_itself_agrees(data, tmp_path, form, estimate, reference):
    estimate, reference, result = data(estimate), data(reference), tmp_path / "result.zip"
    command = ["evo_ape", form, reference, estimate, "-a", "--save_results", result]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    with zipfile.ZipFile(result) as archive:
        stats = json.loads(archive.read_poses("stats.json"))
    error = absolute_error(*paired(estimate, reference))
    for name in ("rmse", "mean", "median", "std", "min", "max"):
        assert getattr(error, name) == pytest.approx(stats[name], abs=1e-9), name


def test_ate_on_the_command_line(here, data, tmp_path):
    folder = data("tum_rgbd/trajectories")
    files = folder / "fr2_desk_ORB.txt", folder / "fr2_desk_groundtruth.txt"
    done = here("ate", *files, "--json")
    assert done.returncode == 0, done.stderr
    error = json.loads(done.stdout)
    assert error["rmse"] == pytest.approx(0.008, abs=0.001)
    assert {"min", "max", "mean", "median", "std", "rmse", "count"} <= set(error)
    shown = here("ate", *files).stdout
    assert f"{1000 * error['rmse']:.1f} mm" in shown
    assert "RMSE" in shown
    assert here("ate", *files, "--plot", tmp_path / "a.png").returncode == 0
    assert (tmp_path / "a.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("folder", "option"), [("7scenes/redkitchen", ()), ("kitti_odometry", ("--option", "sequence=06"))]
)
def test_a_recording_is_a_reference(here, data, tmp_path, folder, option):
    """By its times, or those that a scan counts where it has none."""
    root, given = data(folder), dict(each.split("=") for each in option[1:])
    dataset, estimate = open_dataset(root, **given), tmp_path / "estimate.txt"
    stamps = [frame.timestamp_ns for frame in RecordedSource(select(dataset, limit=30))]
    T = se3.exp(np.array([3.0, -2, 1, 0.5, -1, 2]))
    write_tum(estimate, stamps, [T @ pose_of(dataset, index) for index in range(30)])
    done = here("ate", estimate, root, *option, "--json")
    assert done.returncode == 0, done.stderr
    error = json.loads(done.stdout)
    assert error["count"] == 30
    assert error["max"] < 1e-5
    assert error["rotation_deg"] < 1e-3


def test_a_folder_that_is_no_recording_is_refused(tmp_path):
    write_tum(tmp_path / "a.txt", [1, 2], list(walk(2)))
    (tmp_path / "empty").mkdir()
    done = tsfusion("ate", tmp_path / "a.txt", tmp_path / "empty")
    assert done.returncode == 1
    assert "7-Scenes" in done.stderr


def test_other_axes_and_large_figures_are_legible(tmp_path):
    poses = walk()
    body = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    stamps = [10**9 * (index + 1) for index in range(len(poses))]
    for name, each in (("a.txt", poses), ("b.txt", poses @ body)):
        write_tum(tmp_path / name, stamps, list(each))
    told = "the orientations differ by 120° on average"
    assert told in tsfusion("ate", tmp_path / "b.txt", tmp_path / "a.txt").stdout
    assert told not in tsfusion("ate", tmp_path / "a.txt", tmp_path / "a.txt").stdout
    error = msgspec.structs.replace(absolute_error(poses, poses), length=12345.6, drift_percent=12345.67)
    assert table([("ATE", error)]).endswith("      40   12345.6 m  12345.67 %")


def test_a_straight_way_is_drawn_in_a_window():
    from tsfusion.evaluation.trajectory_error import _limits

    for extent in ([30.0, 0.01], [0.0, 2.0], [3.0, 2.0], [0.0, 0.0]):
        low, high = _limits(np.array([5.0, -5.0]), np.array([5.0, -5.0]) + extent)
        assert (low < (5, -5)).all()
        assert (high > np.array([5, -5]) + extent).all()
        assert min(high - low) >= 0.25 * max(high - low)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("1 2 3\n", "five a pose"),
        ("1 2 3 4 5\n", "is no trajectory: expected 8 numbers a line"),
        ("1 2 3 4\n", "has 1 lines; expected four lines of four numbers a pose"),
        ("", "is no trajectory"),
        (None, "is missing"),
    ],
)
def test_what_is_no_trajectory(tmp_path: Path, text, match):
    if text is not None:
        (tmp_path / "a.txt").write_text(text)
    with pytest.raises(DatasetError, match=match):
        read_poses(tmp_path / "a.txt")


def test_unequal_numbers_without_times(data, tmp_path):
    kitti = data("kitti_odometry")
    lines = (kitti / "poses/00.txt").read_text().splitlines(keepends=True)
    (tmp_path / "short.txt").write_text("".join(lines[:100]))
    with pytest.raises(DatasetError, match=r"100 poses and .* 4541, .* the dataset's folder"):
        paired(tmp_path / "short.txt", kitti / "poses/00.txt")
    (tmp_path / "one.txt").write_text(lines[0])
    with pytest.raises(DatasetError, match="two positions or more"):
        absolute_error(*paired(tmp_path / "one.txt", tmp_path / "one.txt"))


def test_poses_are_paired_by_what_both_files_know(tmp_path, caplog):
    poses, uneven = walk(40), np.cumsum(RNG.uniform(0.04, 0.12, 40) * 1e9).astype(np.int64)
    truth, untimed = tmp_path / "truth.txt", Untimed(list(poses))
    write_tum(truth, list(map(int, uneven)), list(poses))
    assert absolute_error(*paired(truth, untimed)).rmse < 1e-6
    some = [*range(20), *range(25, 40)]
    write_tum(tmp_path / "scan.txt", [(k + 1) * NOMINAL_NS for k in some], [poses[k] for k in some])
    assert absolute_error(*paired(tmp_path / "scan.txt", untimed)).count == 35
    write_tum(tmp_path / "part.txt", [int(uneven[k]) for k in some], [poses[k] for k in some])
    with pytest.raises(DatasetError, match=r"35 poses and untimed 40, .* no times in untimed"):
        paired(tmp_path / "part.txt", untimed)
    assert not caplog.messages
    late = [int(ns) + 17_000_000 * (k % 4 == 3) for k, ns in enumerate(uneven)]
    write_tum(tmp_path / "late.txt", late, list(poses))
    paired(tmp_path / "late.txt", truth)
    assert caplog.messages == ["30 of 40 poses have a partner within 0.01 s; the error is of these"]
    later = [int(ns) + 17_000_000 * (k % 4 != 3) for k, ns in enumerate(uneven)]
    write_tum(tmp_path / "later.txt", later, list(poses))
    with pytest.raises(DatasetError, match=r"only 10 of 40 poses have a partner within 0\.01 s"):
        paired(tmp_path / "later.txt", truth)


class Untimed(Frames):
    """A recording of poses alone, without times."""

    def __init__(self, poses):
        self.name, self.sensor, self.skipped, self._poses = "untimed", "kinect", {}, poses

    def __len__(self):
        return len(self._poses)

    def _frame(self, index):
        raise DatasetError(f"frame {index} has no image")
