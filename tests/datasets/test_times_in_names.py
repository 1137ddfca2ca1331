# SPDX-License-Identifier: MIT
"""Times in the names of files: decided by the whole series, or refused."""

from pathlib import Path

import pytest

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.file_names import in_time

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
