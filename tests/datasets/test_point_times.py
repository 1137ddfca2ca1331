# SPDX-License-Identifier: MIT
"""Times of points in the units and by the clocks of their writers; and those that are of no use."""

import re
from typing import Any

import numpy as np
import pytest

from tsfusion.datasets.scan_files import Scan, point_times, time_field

STAMP = 1_700_000_000_000_000_000
SHARE = np.linspace(0, 1, 11)


def read(field: str, moments: Any, stamp_ns: int = STAMP, between_s: float = 0.1) -> Any:
    points = np.ones((len(moments), 3), np.float32)
    return point_times(Scan(points, field, np.asarray(moments)), stamp_ns, between_s)


@pytest.mark.parametrize("start_s", [0.0, -0.05, -0.1])  # stamped at the sweep's begin, middle and end
@pytest.mark.parametrize(
    ("field", "unit", "zero_s", "kind"),
    [
        ("time", 1.0, 0, "f4"),
        ("timestamp", 1.0, STAMP / 1e9, "f8"),
        ("timestamp", 1e-9, STAMP / 1e9, "f8"),
        ("timestamp", 1e-9, STAMP / 1e9, "u8"),
        ("gps_time", 1.0, STAMP / 1e9, "f8"),
        ("t", 1e-6, 0, "i4"),
        ("offset_time", 1e-9, 0, "i4"),
        ("time", 1e-3, 0, "f4"),
    ],
)
def test_units_and_clocks(start_s: float, field: str, unit: float, zero_s: float, kind: str) -> None:
    moments = ((zero_s + start_s + SHARE * 0.1) / unit).astype(kind)
    times, untimed = read(field, moments)
    assert untimed == ""
    assert times.dtype == np.float32
    np.testing.assert_allclose(times, start_s + SHARE * 0.1, atol=2e-6)


def test_another_clock_counts_from_the_first_point() -> None:
    np.testing.assert_allclose(read("gps_time", 4000 + SHARE * 0.1).point_times_s, SHARE * 0.1, atol=1e-6)
    np.testing.assert_allclose(read("t", STAMP + SHARE * 1e8, 0).point_times_s, SHARE * 0.1, atol=1e-6)


def test_a_field_may_name_its_unit() -> None:
    np.testing.assert_allclose(read("time_us", SHARE * 5000).point_times_s, SHARE * 0.005, atol=1e-6)
    assert read("time_ns", SHARE * 5000).point_times_s is None


def test_frames_bound_a_sweep() -> None:
    moments = (SHARE * 4e5).astype(np.uint32)
    assert read("t", moments, between_s=1.0).point_times_s.max() == pytest.approx(0.4)
    assert read("t", moments, between_s=0.1).point_times_s is None


@pytest.mark.parametrize(
    ("moments", "reason"),
    [
        (np.zeros(11, np.float32), "t is the same for all points"),
        ((STAMP / 1e9 + SHARE * 900).astype(np.float32), "float32 is too coarse for t"),
        (SHARE * 1.3e6, r"t spans 1.3e\+06, in any unit no sweep of 0.003 to 0.3 s"),  # a packet's
        (SHARE * 1e12, "in any unit no sweep"),
        (np.array([-(1 << 62), *[0] * 9, 1 << 62]), "in any unit no sweep"),
    ],
)
def test_times_of_no_use_are_named(moments: Any, reason: str) -> None:
    times, untimed = read("t", moments)
    assert times is None
    assert re.search(reason, untimed)


def test_points_without_a_return_may_have_any_time() -> None:
    points = np.ones((4, 3), np.float32)
    points[0], points[1] = np.nan, 0
    scan = Scan(points, "timestamp", np.array([np.nan, 0.0, STAMP / 1e9, STAMP / 1e9 + 0.1]))
    np.testing.assert_allclose(point_times(scan, STAMP).point_times_s, [0, 0, 0, 0.1], atol=1e-6)
    assert point_times(Scan(points * np.nan, "t", np.arange(4)), STAMP) == (None, "")


def test_names_of_fields() -> None:
    for name in ("t", "time", "timeStamp", "time_stamp", "timestamp", "offset_time", "timeoffset", "gps_time",
                 "GpsTime", "scalar_GpsTime", "time_us", "point_time_offset", "ts"):  # fmt: skip
        assert time_field(["x", name, "intensity"]) == name
    assert time_field(["x", "y", "z", "intensity", "ring", "tone", "curvature", "timed"]) is None
