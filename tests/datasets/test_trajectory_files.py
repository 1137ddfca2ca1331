# SPDX-License-Identifier: MIT
"""Trajectory files, and poses between two poses."""

from pathlib import Path

import numpy as np
import pytest

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.trajectory_files import nanoseconds, read_tum
from tsfusion.geometry.trajectory import Trajectory, rigid, slerp

scipy_spatial = pytest.importorskip("scipy.spatial")

SECOND = 1_000_000_000


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


def test_a_list_that_was_sorted_as_text_is_put_in_order(tmp_path: Path) -> None:
    lines = sorted(f"{tenth / 10:.1f} {tenth} 0 0 0 0 0 1" for tenth in range(5, 360))
    (tmp_path / "poses.txt").write_text("\n".join(lines), encoding="ascii")
    np.testing.assert_array_equal(read_tum(tmp_path / "poses.txt").translations[:, 0], range(5, 360))
    (tmp_path / "poses.txt").write_text("\n".join([*lines[:200], *lines[100:300]]), encoding="ascii")
    with pytest.raises(DatasetError, match="clock steps back"):
        read_tum(tmp_path / "poses.txt")
