# SPDX-License-Identifier: MIT
"""Folders of LiDAR scans: every format gives the same points, names give order and times, errors a line."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from clients_and_spools import NOBODY
from command_processes import Here
from geometry_checks import move
from numpy.typing import NDArray
from small_recordings import LeftOut, one_line, one_line_of, put, seven_scenes

from tsfusion import Volume, VolumeConfig
from tsfusion.core.errors import DatasetError, MissingDependency
from tsfusion.datasets import KITTI, LidarDump, ScanFolder, find, open_dataset, scan_files
from tsfusion.datasets.trajectory_files import read_poses, write_tum
from tsfusion.geometry.keyframe import points_camera
from tsfusion.pipelines.runs import engine

FORMATS = ("bin", "ply", "pcd", "laz")


def save(path: Path, points: NDArray[np.float32], number: int = 0) -> None:
    """Write a scan in the format of the file's ending; PCD in each of its three encodings in turn."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".bin":
        np.column_stack([points, np.full(len(points), 0.5, np.float32)]).astype("<f4").tofile(path)
    elif path.suffix == ".ply":
        trimesh.PointCloud(points).export(path)
    elif path.suffix == ".pcd":
        pcd = pytest.importorskip("pypcd4")
        encoding = (pcd.Encoding.ASCII, pcd.Encoding.BINARY, pcd.Encoding.BINARY_COMPRESSED)[number % 3]
        pcd.PointCloud.from_xyz_points(points).save(path, encoding=encoding)
    else:
        laspy = pytest.importorskip("laspy")
        made = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
        made.header.scales = [1e-5] * 3
        made.x, made.y, made.z = points.T.astype(np.float64)
        made.write(path)


def scan(number: int, count: int = 50) -> NDArray[np.float32]:
    points = np.random.default_rng(number).uniform(-20, 20, (count, 3)).astype(np.float32)
    points[0] = number
    return points


def folder(root: Path, names: list[str], suffix: str = "bin") -> Path:
    for number, name in enumerate(names):
        save(root / f"{name}.{suffix}", scan(number), number)
    return root


def with_poses(root: Path, count: int, name: str = "poses.txt") -> Path:
    rows = (f"1 0 0 {number} 0 1 0 0 0 0 1 0\n" for number in range(count))
    (root / name).write_text("".join(rows))
    return root


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_gives_kittis_points(data, tmp_path, suffix):
    recorded = KITTI(data("kitti_odometry"), "00", "lidar", poses="poses_estimated/00_ORB.txt")
    for number in range(3):
        save(tmp_path / "velodyne" / f"{number:06d}.{suffix}", recorded[number].points, number)
    poses = [recorded[number].T_world_camera for number in range(3)]
    write_tum(tmp_path / "seq_poses_tum.txt", [10**9 * number for number in range(3)], poses)
    dataset = open_dataset(tmp_path)
    assert isinstance(dataset, ScanFolder)
    assert (len(dataset), dataset.sensor, dataset.skipped) == (3, "lidar", {})
    for number in range(3):
        found, expected = dataset[number], recorded[number]
        error = np.abs(found.points - expected.points).max()
        assert error <= {"pcd": 1e-6, "laz": 1e-4}.get(suffix, 0), "PCD's text has ten decimals"
        assert np.abs(found.T_world_camera - expected.T_world_camera).max() < 1e-6
    volume = Volume(VolumeConfig(voxel_size=0.1, sensor="lidar", threads=1))
    for keyframe in dataset:
        volume.integrate(keyframe)
    assert volume.stats().blocks > 10_000


def test_names_give_the_order_and_times(tmp_path):
    numbered = with_poses(folder(tmp_path / "a", ["scan_10", "scan_9", "scan_100"]), 3)
    assert [int(one.points[0, 0]) for one in open_dataset(numbered)] == [1, 0, 2]
    assert open_dataset(numbered).timestamps_ns is None
    timed = folder(tmp_path / "b", ["1700000000.100000", "1700000000.200000", "1700000000.300000"])
    poses = np.repeat(np.eye(4)[None], 2, axis=0)
    write_tum(timed / "run_tum.txt", [1_700_000_000_100_000_000, 1_700_000_000_250_000_000], list(poses))
    dataset = open_dataset(timed)
    assert dataset.timestamps_ns.tolist() == [1_700_000_000_100_000_000, 1_700_000_000_200_000_000]
    assert dataset.skipped == {"without a pose in time": 1}
    (timed / "run_tum.txt").unlink()
    assert [dataset.pose(k) for dataset in [open_dataset(timed, posed=False)] for k in range(3)] == [None] * 3


def test_a_trajectory_may_be_given_and_others_files_are_counted(tmp_path):
    root = folder(tmp_path / "a", ["1", "2", "3", "4"])
    save(root / "map.bin", scan(9))
    with_poses(tmp_path, 4, "mine.txt")
    dataset = open_dataset(root, trajectory=tmp_path / "mine.txt")
    assert (len(dataset), dataset.skipped) == (4, {"of another name": 1})
    assert dataset[1].T_world_camera[0, 3] == 1
    save(root / "whole.bin", scan(9))
    one_line(lambda: open_dataset(root), r"has 4 scans named as \d\.bin, and 2 named otherwise; expected one")


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["cloud_1583836591_182590976", "cloud_1583836592_5"], [1583836591182590976, 1583836592000000005]),
        (["2023-01-01-12-59-58", "2023-01-01-13-00-01"], None),
        (["s1_9", "s1_10"], None),
        (["1583836591182590976", "1583836592182590976"], [1583836591182590976, 1583836592182590976]),
    ],
)
def test_names_of_several_numbers_are_one_series(tmp_path, names, stamps):
    root = with_poses(folder(tmp_path, names[::-1]), 2)
    dataset = open_dataset(root)
    assert [int(one.points[0, 0]) for one in dataset] == [1, 0]
    found = dataset.timestamps_ns
    assert (None if found is None else found.tolist()) == stamps


def test_poses_that_do_not_fit_do_not_keep_a_scan_from_its_own(tmp_path, caplog):
    root = with_poses(folder(tmp_path, ["0", "1", "2"]), 2)
    one_line(lambda: open_dataset(root), r"poses\.txt has 2 poses for 3 frames")
    assert len(open_dataset(root, posed=False)) == 3
    assert "the recorded poses are not used: " in caplog.text
    one_line(lambda: open_dataset(root, posed=False, trajectory=root / "poses.txt"), r"has 2 poses for 3")


def test_which_scans_are_meant_must_be_clear(tmp_path):
    two = folder(tmp_path / "two", ["lidar1_0", "lidar1_1", "lidar2_0", "lidar2_1"])
    one_line(lambda: open_dataset(two), r"has 2 scans named as lidar1_0\.bin, and 2 named otherwise")
    root = folder(folder(tmp_path / "kinds", ["0", "1"]), ["2", "3", "4"], "ply")
    one_line(lambda: open_dataset(root), r"several series of scans \(.*/\*\.bin and .*/\*\.ply\); move the")
    for number in (2, 3, 4):
        (root / f"{number}.ply").unlink()
    folder(root / "points", ["0", "1"])
    one_line(lambda: open_dataset(root, posed=False), r"several series of scans .*points/\*\.bin\)")


def test_points_beside_a_recording_are_made_of_it(tmp_path):
    seven_scenes(tmp_path / "scene")
    folder(tmp_path, ["cloud_1", "cloud_2"], "ply")
    folder(tmp_path / "clouds", ["1", "2"], "ply")
    assert find(tmp_path).layout.name == "7-Scenes"
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for number in (1, 2):
        trimesh.creation.box().export(meshes / f"{number}.ply")
    with pytest.raises(DatasetError, match="is in no layout known here"):
        find(meshes)


def test_what_is_no_recording_is_not_taken_for_one(tmp_path):
    run = folder(tmp_path / "run", ["mesh-2", "mesh-3"], "ply")
    (run / "run.json").write_text("{}")
    folder(tmp_path / "one", ["1"])
    for place in (run, tmp_path / "one"):
        with pytest.raises(DatasetError, match="is in no layout known here"):
            find(place)


def test_poses_beside_kittis_calibration_may_be_the_cameras(tmp_path):
    root = with_poses(folder(tmp_path / "00" / "velodyne", ["0", "1"]).parent, 2)
    (root / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(DatasetError, match=r"poses\.txt may be the camera's poses; open the benchmark"):
        open_dataset(root)
    assert len(open_dataset(root, trajectory=root / "poses.txt")) == 2
    (root / "calib.txt").unlink()
    (tmp_path / "sequences").mkdir()
    root = root.rename(tmp_path / "sequences" / "00")
    one_line(
        lambda: open_dataset(root), r"sequence of KITTI without calib\.txt, so poses\.txt may be the camera"
    )


def test_odometry_faster_than_scans_is_not_taken_by_their_numbers(tmp_path, caplog):
    root = folder(tmp_path, ["0", "1", "2"])
    for rate_hz, is_scans in ((10, True), (100, False)):
        caplog.clear()
        write_tum(root / "poses.txt", [round(n * 1e9 / rate_hz) for n in range(9)], shifts(9))
        if is_scans:
            dataset = open_dataset(root)
            assert [dataset.pose(index)[0, 3] for index in range(3)] == [0, 1, 2]
            assert "has 9 poses for 3 scans: a scan takes the pose of its number" in caplog.text
        else:
            one_line(
                lambda: open_dataset(root),
                "poses.txt has 9 poses for 3 frames, and the recording has no times",
            )


def test_points_of_three_numbers(tmp_path):
    root = with_poses(tmp_path, 2)
    for number in range(2):
        scan(number, count=4).astype("<f4").tofile(root / f"{number}.bin")
    one_line(
        lambda: open_dataset(root)[0], r"0\.bin has intensities below 0; expected 4 float32 a point, x, y"
    )
    assert np.array_equal(open_dataset(root, fields=3)[1].points, scan(1, count=4))
    one_line(
        lambda: open_dataset(root, fields=5)[0], r"has 48 bytes, not 20 a point; expected 5 float32 a point"
    )
    one_line(lambda: open_dataset(root, fields=2), r"fields must be from 3 to 64 numbers a point, got 2")


@pytest.mark.parametrize("last", [lambda n: n % 32, lambda n: n * np.nan, lambda n: 1e-6 * n])
@pytest.mark.parametrize("least", [0, -9])
def test_five_numbers_a_point_that_read_as_four_are_named(least: int, last, tmp_path: Path) -> None:
    root, rng = with_poses(tmp_path, 2), np.random.default_rng(7)
    for number in range(2):
        numbers = rng.uniform(least, 9, (800, 4)) * (5, 5, 0.3, 10)
        points = np.column_stack([numbers, last(np.arange(800))])
        points.astype("<f4").tofile(root / f"{number}.bin")
    for others in ({}, {"fields": 4}, {"fields": 8}):
        said = r"0\.bin seems to have 5 numbers a point.*--option fields=5"
        one_line(lambda others=others: open_dataset(root, **others)[0], said)
    assert open_dataset(root, fields=5)[1].points.shape == (800, 3)


def test_numbers_in_another_order_of_bytes_are_no_coordinates(tmp_path):
    points = np.column_stack([scan(1, count=400), np.full(400, 0.5, np.float32)])
    points.astype(">f4").tofile(tmp_path / "1.bin")
    one_line(lambda: scan_files.read_scan(tmp_path / "1.bin"), "no coordinates, but numbers above 1e9")


@pytest.mark.parametrize("suffix", ["ply", "pcd", "las"])
def test_a_scan_that_was_cut_off_is_no_smaller_one(tmp_path, suffix):
    path = tmp_path / f"0.{suffix}"
    save(path, scan(0), 1)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - 12 * 20])
    with pytest.raises(DatasetError, match=r"was cut off: it has \d+ of the 50 points|is damaged"):
        scan_files.read_scan(path)


def test_a_scan_whose_reader_is_missing_names_the_command(tmp_path, monkeypatch):
    for module, suffix in (("pypcd4", "pcd"), ("laspy", "las")):
        for name in {module, *(name for name in sys.modules if name.startswith(f"{module}."))}:
            monkeypatch.setitem(sys.modules, name, None)
        (tmp_path / f"0.{suffix}").write_bytes(b"x")
        with pytest.raises(MissingDependency, match=f"pip install '?{module}"):
            scan_files.read_scan(tmp_path / f"0.{suffix}")


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
@pytest.mark.skipif(importlib.util.find_spec("kiss_icp") is None, reason="needs '.[lidar]'")
@pytest.mark.usefixtures("quick_servers")
def test_a_folder_of_scans_is_scanned_and_replayed(data, here: Here, tmp_path, monkeypatch):
    monkeypatch.setattr(engine, "LINGER", 0.0)
    recorded = KITTI(data("kitti_odometry"), "00", "lidar")
    for number in range(3):
        save(tmp_path / "scans" / f"{number}.ply", recorded[number].points)
    done = here("scan", tmp_path / "scans", "--connect", NOBODY, "--out", tmp_path / "scan")
    assert "not at the server" in done.stderr
    assert "3/3 localised by lidar" in done.stdout
    refused = here("replay", tmp_path / "scans", "--out", tmp_path / "none")
    assert "has no poses; expected scans numbered" in refused.stderr
    poses = tmp_path / "scan" / "trajectory.txt"
    done = here("replay", tmp_path / "scans", "--trajectory", poses, "--voxel-size", 0.4, "--out", "again")
    assert done.returncode == 0, done.stderr
    assert "keyframes  3/3 fused" in done.stdout


def test_lidar_keyframes_meet_by_their_poses(data):
    from scipy.spatial import cKDTree

    dataset = open_dataset(data("kitti07_lidar_keyframes"))
    assert isinstance(dataset, LidarDump)
    assert (len(dataset), dataset.sensor) == (5, "lidar")
    a, b = (move(dataset[i].T_world_camera, points_camera(dataset[i])) for i in (0, 1))
    together = np.median(cKDTree(b).query(a)[0])
    apart = np.median(cKDTree(points_camera(dataset[1])).query(points_camera(dataset[0]))[0])
    assert together < 0.25
    assert apart > 1.5 * together


def dump(root: Path) -> Path:
    for number in range(3):
        place = root / f"{number:06d}"
        place.mkdir()
        np.full((4, 3), number, np.float32).tofile(place / "points.bin")
    (root / "graph.txt").write_text("v0 0 0 0 0 0 0 1\nv2 1 2 3 0 0 0.5 0.8660254\ne 0 1 0 0 0\n")
    return root


def test_clouds_go_by_their_number(tmp_path):
    dataset = open_dataset(dump(tmp_path))
    assert (len(dataset), dataset.skipped) == (2, {"without a pose": 1})
    assert dataset[1].points[0, 0] == 2
    assert list(dataset[1].T_world_camera[:3, 3]) == [1, 2, 3]
    assert dataset[1].T_world_camera[1, 0] == pytest.approx(np.sin(np.radians(60)))
    unposed = open_dataset(tmp_path, posed=False)
    assert [unposed.pose(index) is None for index in range(3)] == [False, True, False]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (put("graph.txt", None), r"graph\.txt is missing; .*`tsfusion scan"),
        (put("graph.txt", "v0 0 0 0 0 0 0\n"), r"graph\.txt:1: 6 numbers, expected 7"),
        (put("graph.txt", "v0 0 0 0 0 0 0 2\n"), r"graph\.txt:1: quaternion must have length 1, got 2"),
        (put("graph.txt", "vertex 0 0 0 0 0 0 1\n"), r"graph\.txt:1: 'vertex'; expected `VERTEX_SE3"),
        (
            put("000000/points.bin", "x"),
            LeftOut(r"points\.bin has 1 bytes, not 12 a point", {"without a pose": 1, "unreadable": 1}),
        ),
    ],
)
def test_a_broken_dump_is_one_clear_line(tmp_path, change, match):
    change(dump(tmp_path))
    one_line_of(lambda: LidarDump(tmp_path), match)


def blocks(poses, stamps, separator=","):
    """Poses as BALM writes them: four lines each, the time in the corner."""
    lines = []
    for T, stamp in zip(poses, stamps, strict=True):
        rows = np.vstack([T[:3], [0, 0, 0, stamp]])
        lines += [separator.join(f"{value:.6f}" for value in row) + separator for row in rows]
    return "\n".join(lines) + "\n"


def shifts(count):
    return [np.array([[1.0, 0, 0, n], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) for n in range(count)]


@pytest.mark.parametrize("separator", [",", " "])
def test_poses_of_four_lines_with_the_time_in_the_corner(tmp_path, separator, caplog):
    root = folder(tmp_path, ["full2", "full3", "full4"], "pcd")
    stamps = [1630577758.5 + number / 2 for number in range(9)]
    (root / "alidarPose.csv").write_text(blocks(shifts(9), stamps, separator))
    dataset = open_dataset(root)
    assert [dataset.pose(index)[0, 3] for index in range(3)] == [2, 3, 4]
    assert dataset.timestamps_ns.tolist() == [round(stamp * 1e9) for stamp in stamps[2:5]]
    assert "has 9 poses for 3 scans: a scan takes the pose of its number, counted from 0" in caplog.text
    times, poses = read_poses(root / "alidarPose.csv")
    assert (len(times), poses[8][0, 3], poses[8][3, 3]) == (9, 8, 1)
    (root / "alidarPose.csv").write_text(blocks(shifts(9), [1] * 9, separator))
    assert open_dataset(root).timestamps_ns is None
    (root / "alidarPose.csv").write_text(blocks(shifts(9), stamps[::-1], separator))
    one_line(lambda: open_dataset(root), "times must rise from pose to pose")
    (root / "alidarPose.csv").write_text(blocks(shifts(9), stamps, separator)[:-40])
    one_line(
        lambda: open_dataset(root),
        "has 3. lines; expected four lines of four numbers a pose|4 numbers|must rise",
    )


def test_a_pose_graph_beside_scans(tmp_path):
    root = folder(tmp_path, ["000000", "000003", "000007"], "ply")
    vertices = [f"VERTEX_SE3:QUAT {n} {n}.5 0 0 0 0 0 1" for n in (0, 3, 5, 7)]
    (root / "graph.g2o").write_text("\n".join([*vertices, "EDGE_SE3:QUAT 0 3 3 0 0 0 0 0 1"]))
    dataset = open_dataset(root)
    assert [dataset.pose(index)[0, 3] for index in range(3)] == [0.5, 3.5, 7.5]
    (root / "graph.g2o").write_text("EDGE_SE3:QUAT 0 3 3 0 0 0 0 0 1\n")
    one_line(lambda: open_dataset(root), "graph.g2o has no vertices; expected `VERTEX_SE3:QUAT id x y z")


def test_numbers_that_are_no_places_of_poses_are_refused(tmp_path):
    root = with_poses(folder(tmp_path, ["1", "2", "6"], "pcd"), 5)
    one_line(lambda: open_dataset(root), "has 5 poses for 3 frames")


def test_a_pair_of_scans_with_their_relative_pose(tmp_path):
    for name in ("source", "target"):
        folder(tmp_path / "x", ["1"], "pcd")
        (tmp_path / "x" / "1.pcd").rename(tmp_path / f"{name}.pcd")
    (tmp_path / "x").rmdir()
    (tmp_path / "T_target_source.txt").write_text("1 0 0 2\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    assert find(tmp_path).layout.name == "LiDAR pair"
    dataset = open_dataset(tmp_path)
    assert [dataset.pose(index)[0, 3] for index in range(2)] == [0, 2]
    assert [file.stem for file in dataset._files] == ["target", "source"]
    (tmp_path / "T_target_source.txt").write_text("1 0 0 2\n0 1 0 0\n")
    one_line(lambda: open_dataset(tmp_path), "must hold 4 rows of 4 numbers, got 2 rows")
    (tmp_path / "T_target_source.txt").unlink()
    one_line(lambda: find(tmp_path), r"holds 2 clouds of points .source.pcd, target.pcd.; open one, or name")


def test_one_cloud_is_opened_by_its_path_or_its_folders(tmp_path):
    root = folder(tmp_path / "a" / "b" / "c", ["7"], "pcd")
    for path in (root / "7.pcd", root, tmp_path / "a" / "b"):
        assert len(open_dataset(path, posed=False)) == 1
        one_line(
            lambda path=path: open_dataset(path), "has no poses; expected --trajectory FILE with the pose"
        )
    scan(0).astype("<f4").tofile(tmp_path / "lone.bin")
    assert len(open_dataset(tmp_path / "lone.bin", posed=False, fields=3)) == 1


def test_labels_are_said_to_be_unused(tmp_path, caplog):
    root = folder(tmp_path / "08" / "velodyne", ["000000"]).parent
    (root / "labels").mkdir()
    assert len(open_dataset(root, posed=False)) == 1
    assert "08: the labels are not used; what moves is fused, too" in caplog.text
