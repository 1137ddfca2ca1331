# SPDX-License-Identifier: MIT
"""Trajectory files, poses between two poses, and times in the names of files."""

from pathlib import Path

import numpy as np
import pytest

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.file_names import in_time
from tsfusion.datasets.trajectory_files import nanoseconds, read_log, read_poses, read_table, read_tum
from tsfusion.geometry.inertial_sensors import Accelerometer
from tsfusion.geometry.trajectory import Trajectory, quaternion, rigid, slerp

scipy_spatial = pytest.importorskip("scipy.spatial")

SECOND = 1_000_000_000
BEGIN = 1_700_000_000_050_000_000
EVEN = [BEGIN + k * 100_000_000 for k in range(24)]
UNEVEN = [BEGIN + 137_004_391 * k + 61_000_307 * (k * k % 7) for k in range(24)]
WRITTEN = {
    "SEC.NSEC": lambda ns: f"{ns // 10**9}.{ns % 10**9}",
    "SEC_NSEC": lambda ns: f"{ns // 10**9}_{ns % 10**9}",
    "SEC_NNNNNNNNN": lambda ns: f"scan_{ns // 10**9}_{ns % 10**9:09d}",
    "SEC.USEC": lambda ns: f"{ns // 10**9}.{ns % 10**9 // 1000}",
    "SEC_USEC": lambda ns: f"{ns // 10**9}_{ns % 10**9 // 1000:06d}",
    "SEC-USEC": lambda ns: f"{ns // 10**9}-{ns % 10**9 // 1000}",
    "SEC_MSEC": lambda ns: f"{ns // 10**9}_{ns % 10**9 // 10**6}",
    "decimals": lambda ns: f"{ns // 10**9}.{f'{ns % 10**9:09d}'.rstrip('0') or '0'}",
    "ns": str,
    "us": lambda ns: str(ns // 1000),
    "ms": lambda ns: str(ns // 10**6),
}


def test_slerp_takes_the_short_way_at_even_speed():
    def turn(degrees: float) -> np.ndarray:
        half = np.radians(degrees) / 2
        return np.array([0, 0, np.sin(half), np.cos(half)])

    rotations = scipy_spatial.transform.Rotation
    for share in (0.0, 0.25, 0.5, 1.0):
        for sign in (1, -1):
            mixed = rigid(slerp(turn(10), sign * turn(130), share), np.zeros(3))
            np.testing.assert_allclose(mixed, rigid(turn(10 + 120 * share), np.zeros(3)), atol=1e-12)
    R = rigid(turn(33), np.zeros(3))[:3, :3]
    np.testing.assert_allclose(R, rotations.from_quat(turn(33)).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(slerp(turn(5), turn(5), 0.3), turn(5))


def test_a_trajectory_is_never_extrapolated():
    stamps = np.array([10, 20, 30], dtype=np.int64) * SECOND
    still = Trajectory(stamps, np.arange(9.0).reshape(3, 3), np.tile([0.0, 0, 0, 1], (3, 1)))
    middle = still.at(15 * SECOND, max_gap_ns=10 * SECOND)
    np.testing.assert_allclose(middle[:3, 3], [1.5, 2.5, 3.5])
    assert still.at(15 * SECOND, max_gap_ns=9 * SECOND) is None
    assert still.at(9 * SECOND, max_gap_ns=99 * SECOND) is None
    assert still.at(31 * SECOND, max_gap_ns=99 * SECOND) is None
    for exact in (10, 20, 30):
        np.testing.assert_allclose(still.at(exact * SECOND, max_gap_ns=1)[0, 3], (exact - 10) * 0.3)


def test_stamps_keep_every_digit():
    here = Path("list.txt")
    assert nanoseconds("1305031790.645155", here, 1) == 1305031790645155000
    assert nanoseconds("1.5e3", here, 1) == 1500 * SECOND
    assert nanoseconds("7", here, 1) == 7 * SECOND
    for bad in ("-1", "nan", "inf", "x", ""):
        with pytest.raises(DatasetError, match=r"list\.txt:1: timestamp must be seconds"):
            nanoseconds(bad, here, 1)


def test_stamps_of_inertial_values_keep_every_digit_and_no_other_text_passes(tmp_path: Path) -> None:
    path = tmp_path / "imu.txt"

    def stamps(text: str) -> list[int]:
        path.write_text(f"{text} 0 0 9.81\n")
        read_table(sensor := Accelerometer(), path, "`stamp x y z` a line", separator=None, first=1)
        return sensor._stamps.tolist()

    assert stamps("1403636579.758555501") == stamps("1403636579758555501") == [1403636579758555501]
    for text in ("1.5e300", "1.403636579758555392e+18", "-5", "0x10"):
        assert stamps(text) == []


def test_a_list_that_was_sorted_as_text_is_put_in_order(tmp_path: Path) -> None:
    lines = sorted(f"{tenth / 10:.1f} {tenth} 0 0 0 0 0 1" for tenth in range(5, 360))
    (tmp_path / "poses.txt").write_text("\n".join(lines), encoding="ascii")
    np.testing.assert_array_equal(read_tum(tmp_path / "poses.txt").translations[:, 0], range(5, 360))
    (tmp_path / "poses.txt").write_text("\n".join([*lines[:200], *lines[100:300]]), encoding="ascii")
    with pytest.raises(DatasetError, match="clock steps back"):
        read_tum(tmp_path / "poses.txt")


@pytest.mark.parametrize("mark", ["", "#", "# "])
@pytest.mark.parametrize("unit", ["s", "ns"])
@pytest.mark.parametrize(
    "names",
    [
        "x,y,z,{}w,{}x,{}y,{}z",
        "px,py,pz,{}x,{}y,{}z,{}w",
        "p_x [m],p_y [m],p_z [m],{}w [],{}x [],{}y [],{}z []",
    ],
)
def test_a_header_that_names_the_parts_of_quaternions_states_their_order(
    tmp_path: Path, names: str, unit: str, mark: str
) -> None:
    angles = np.array([0.1, 0.4, 0.7, 1.0])
    poses = [rigid(np.array([0, np.sin(angle), 0, np.cos(angle)]), np.full(3, angle)) for angle in angles]
    for part in ("q", "q_RS_", "orientation."):
        header = f"{mark}timestamp,{names.format(*[part] * 4)}"
        order = [word.strip(" []")[-1] for word in header.split(",")[4:]]
        lines = [header]
        for k, T in enumerate(poses):
            parts = dict(zip("xyzw", quaternion(T[:3, :3]), strict=True))
            stamp = f"{BEGIN + k * SECOND}" if unit == "ns" else f"{BEGIN // SECOND + k}.05"
            lines.append(",".join([stamp, *map(str, [*T[:3, 3], *(parts[each] for each in order)])]))
        path = tmp_path / "poses.csv"
        path.write_text("\n".join(lines))
        times, found = read_poses(path)
        np.testing.assert_allclose(found, poses, atol=1e-12)
        assert times.tolist() == [BEGIN + k * SECOND for k in range(4)]


@pytest.mark.parametrize("way", WRITTEN)
@pytest.mark.parametrize("stamps", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_times_are_those_that_were_written(way, stamps):
    names = [WRITTEN[way](ns) for ns in stamps]
    files, found = in_time([Path(name) for name in sorted(names)], sorted(names))
    precision = 10**6 if way in ("SEC_MSEC", "ms") else 1000
    assert found is not None
    assert abs(found - sorted(stamps)).max() < precision
    assert [file.name for file in files] == names if stamps is EVEN else True


@pytest.mark.parametrize(
    "names",
    [
        [f"{k:06d}" for k in range(9)],
        [f"1700000000_{k}" for k in range(1, 30)],
        [f"1700000000_{k:06d}" for k in range(9)],
        [f"0.{k}" for k in range(1, 30)],
        ["s1_9", "s1_10"],
        [f"{1700000000 + k // 7}_{k}" for k in range(1, 40)],
        [f"{1700000000 + k // 7}_{k:06d}" for k in range(40) if k % 11 != 5],
        [f"cam0.{k}" for k in range(30) if k != 7],
        [f"cam0.{k}" for k in (1, 2, 3, 5, 6)],
        [f"{1700000000 + k}.5" for k in (0, 1, 1)],
    ],
)
def test_numbers_that_are_no_times_give_none(names):
    assert in_time([Path(name) for name in names], names)[1] is None


def test_ambiguous_times_are_refused():
    names = [f"{1700000000 + k}_50000000" for k in range(9)]
    with pytest.raises(DatasetError, match="ambiguous times: the fraction may be"):
        in_time([Path(name) for name in names], names)


def test_few_decimals_without_their_last_zeros_stay_decimals():
    for names, seconds in (
        (["0.0", "0.5", "1.25"], [0, 0.5, 1.25]),
        (["1.50", "1.625", "1.75"], [1.5, 1.625, 1.75]),
    ):
        found = in_time([Path(name) for name in names], names)[1]
        assert found is not None
        assert (found / 1e9).tolist() == seconds


@pytest.mark.parametrize(("stamp", "found"), [("1e9", [10**18]), ("12.5", [12500000000]), ("1250", [1250])])
def test_stamps_of_a_table(stamp: str, found: list[int], tmp_path: Path) -> None:
    path = tmp_path / "imu.txt"
    path.write_text(f"{stamp} 1 2 3\n")
    sensor = read_table(Accelerometer(), path, "", separator=None, first=1)
    assert sensor is not None
    assert list(sensor._stamps) == found


@pytest.mark.parametrize("stamp", ["1.0e300", "1e300", "-5.0", "0x10", "inf"])
def test_a_line_of_a_table_without_a_time_is_left_out(
    stamp: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "imu.txt"
    path.write_text(f"0.5 1 2 3\n{stamp} 1 2 3\n")
    sensor = read_table(Accelerometer(), path, "", separator=None, first=1)
    assert sensor is not None
    assert list(sensor._stamps) == [500_000_000]
    assert "imu.txt:2: timestamp must be seconds" in caplog.text


def test_no_value_of_a_table_with_mostly_broken_lines_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "imu.txt"
    path.write_text("0.5 1 2 3\n0.6 x\n0.7 x\n")
    assert len(read_table(Accelerometer(), path, "", separator=None, first=1).table()) == 0
    assert "the values of an inertial sensor are not used: " in caplog.text


def test_a_log_that_ends_inside_a_pose_keeps_the_poses_before(tmp_path: Path) -> None:
    path, rows = tmp_path / "a.log", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    path.write_text(f"0 0 1\n{rows}1 1 2\n{rows}2 2 3\n{rows[:-16]}")
    numbers, poses = zip(*read_log(path), strict=True)
    assert numbers == (0, 1, 2)
    assert [T is None for T in poses] == [False, False, True]
