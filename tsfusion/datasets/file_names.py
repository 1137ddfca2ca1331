# SPDX-License-Identifier: MIT
"""Read the numbers in file names, which give order and times of files, and which files belong together."""

import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError

SortKey = tuple[tuple[int, Decimal, str], ...]

_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")
_SPLIT = re.compile(
    r"[^0-9]*(?P<s>[0-9]+(?=\.)|[0-9]{10}(?=[^0-9.]))(?P<mark>[^0-9]+)(?P<f>[0-9]{1,9})[^0-9]*"
)
_UNIX_DIGITS = 10  # digits of Unix seconds in this century
_EPOCH_UNITS = {13: 10**6, 16: 10**3, 19: 1}  # digits of a Unix time of this century → unit in ns
_UNITS = {"hundredths": 10**7, "milliseconds": 10**6, "microseconds": 10**3, "nanoseconds": 1}
_USUAL_WIDTHS = {3, 6, 9}  # digits of ms, µs and ns with leading zeros
_FASTEST_NS, _SLOWEST_NS = 2 * 10**6, 10**12  # between two frames


def order(name: str) -> SortKey:
    """Return a sort key of a name by its numbers: 9 before 10, 1.25 before 1.5."""
    parts = re.findall(r"([0-9]+(?:\.[0-9]+)?)|([^0-9]+)", name)
    return tuple((0, Decimal(number), "") if number else (1, Decimal(0), text) for number, text in parts)


def in_order(files: Iterable[Path]) -> list[Path]:
    """Sort files by their folders, and in each folder by the numbers in their names.

    If all names have one length, sort by characters: this suits hexadecimal names, too.
    """
    found = list(files)
    if len({len(file.stem) for file in found}) == 1:
        return sorted(found, key=lambda file: (order(str(file.parent)), file.name))
    return sorted(found, key=lambda file: (order(str(file.parent)), order(file.stem), file.suffix))


def only_file(path: Path, endings: Iterable[str]) -> Path | None:
    """Return a file with one of the endings: the path itself, or the only one in a folder; None without."""
    if path.is_file():
        return path if path.suffix.lower() in endings else None
    found = [file for file in path.glob("[!.]*") if file.suffix.lower() in endings]
    return found[0] if len(found) == 1 else None


def numbers_in(name: str) -> list[str]:
    """Return the integers and decimal numbers in a name, as text."""
    return _NUMBER.findall(name)


def series_of(files: Iterable[Path]) -> list[list[Path]]:
    """Group files of one kind whose names differ only in their numbers; sort each series.

    A number after a letter names a sensor (`cam0_`, `lidar1_`), unless it is the only or the last number.
    """
    found: dict[tuple[str, str], list[Path]] = {}
    for file in files:
        if numbers_in(file.stem):
            found.setdefault((_unnumbered(file.stem), file.suffix.lower()), []).append(file)
    return [in_order(one) for one in found.values()]


def _unnumbered(name: str) -> str:
    last = len(numbers_in(name)) - 1
    parts, end = [], 0
    for index, match in enumerate(_NUMBER.finditer(name)):
        is_sensor = index < last and match.start() > 0 and name[match.start() - 1].isalpha()
        parts += [name[end : match.start()], match[0] if is_sensor else "#"]
        end = match.end()
    return "".join([*parts, name[end:]]).lower()


def time_of(name: str) -> int | None:
    """Return the time in a name, nanoseconds: decimal seconds (TUM), or Unix time in ms, µs or ns (EuRoC)."""
    if re.fullmatch(r"\d+\.\d+", name, re.ASCII):
        return int(Decimal(name) * 1_000_000_000)
    return int(name) * _EPOCH_UNITS[len(name)] if name.isdecimal() and len(name) in _EPOCH_UNITS else None


def in_time(files: Sequence[Path], names: Sequence[str]) -> tuple[list[Path], NDArray[np.int64] | None]:
    """Sort files by the times in their names. Return them with (n,) nanoseconds, or unsorted with None.

    A time is one that `time_of` reads, also between words; or Unix seconds, a separator and a fraction
    (`SEC_USEC`). Fractions of unequal width are decimals, or ms, µs or ns without leading zeros. The reading
    that fits all names and has the most regular steps is taken.

    Raises:
        DatasetError: several readings fit.
    """
    stamps = _times(names)
    if stamps is None:
        return list(files), None
    order = np.argsort(stamps, kind="stable")
    return [files[index] for index in order], stamps[order]


def _times(names: Sequence[str]) -> NDArray[np.int64] | None:
    whole = [time_of(found[0]) if len(found := numbers_in(name)) == 1 else None for name in names]
    split = [match for name in names if (match := _SPLIT.fullmatch(name))]
    if len(split) < len(names) or not split:
        stamps = np.array([] if None in whole else whole, np.int64)
        return stamps if len(stamps) == len(set(stamps.tolist())) > 0 else None
    parts = [(match["s"], match["f"]) for match in split]
    is_decimal, widths = split[0]["mark"] == ".", {len(fraction) for _, fraction in parts}
    steps = np.diff([count for _, count in sorted((int(s), int(f)) for s, f in parts)])
    is_sensor = len({s for s, _ in parts}) == 1 and all(
        one.string[one.start("s") - 1].isalpha() for one in split
    )
    if (is_sensor or not (is_decimal and len(widths) == 1)) and _counts(steps):
        return None  # a counter after the number of a sensor or chapter, or after seconds
    if len(widths) == 1 and (is_decimal or widths <= _USUAL_WIDTHS):
        ways = {"decimals": _read(parts, None)}
    else:
        ways = _ways(parts)
        if not is_decimal and len(widths) > 1:
            ways.pop("decimals", None)  # without a point, trailing zeros are not left out
    is_stripped = len(parts[0][0]) < _UNIX_DIGITS and not any(f[-1] == "0" for _, f in parts if len(f) > 1)
    if not any(map(_is_plausible, ways.values())):
        decimals = ways.get("decimals") if is_decimal else None
        return decimals if decimals is not None and len(set(decimals.tolist())) == len(decimals) else None
    return _chosen(
        {way: stamps for way, stamps in ways.items() if _is_plausible(stamps)}, names[0], is_stripped
    )


def _counts(steps: NDArray[np.int64]) -> bool:
    """Return True if the differences of sorted numbers are those of a count: mostly 1, never 0."""
    return not len(steps) or bool(steps.min() > 0 and np.median(steps) == 1)


def _ways(parts: Sequence[tuple[str, str]]) -> dict[str, NDArray[np.int64]]:
    """Return times, (n,) ns, by name of a unit that fractions of unequal width may have (decimals, ms, …)."""
    several = [fraction for _, fraction in parts if len(fraction) > 1]
    led, ended = (any(one[at] == "0" for one in several) for at in (0, -1))
    largest = max(int(fraction) for _, fraction in parts)
    units = {} if led else {way: unit for way, unit in _UNITS.items() if largest * unit < 10**9}
    ways = {way: _read(parts, unit) for way, unit in units.items()}
    is_unix, is_even = len(parts[0][0]) == _UNIX_DIGITS, len({len(one) for one in several}) == 1
    if not (ended and ways and is_unix and not is_even):  # decimals end in 0 if all have one width
        ways["decimals"] = _read(parts, None)
    return ways


def _read(parts: Sequence[tuple[str, str]], unit: int | None) -> NDArray[np.int64]:
    """Return (n,) nanoseconds of (seconds, fraction) texts. `unit`: ns of a fraction's 1; None = decimals."""
    fractions = [int(f.ljust(9, "0")) if unit is None else int(f) * unit for _, f in parts]
    return np.array([int(s) * 10**9 for s, _ in parts], np.int64) + np.array(fractions, np.int64)


def _chosen(ways: dict[str, NDArray[np.int64]], name: str, is_stripped: bool) -> NDArray[np.int64]:
    """Return the times with clearly the most regular steps; else decimals, if final zeros may be left out."""
    best, *others = sorted(ways, key=lambda way: _unevenness(ways[way]))
    if not others or _unevenness(ways[others[0]]) > 2 * _unevenness(ways[best]) + 0.05:
        return ways[best]
    if is_stripped and "decimals" in ways:
        return ways["decimals"]
    raise DatasetError(
        f"names such as {name} are ambiguous times: the fraction may be {best} or {others[0]}; expected "
        "fractions of one width, with their leading zeros (SEC.NNNNNNNNN)"
    )


def _is_plausible(stamps: NDArray[np.int64]) -> bool:
    steps = np.diff(np.sort(stamps))
    return not len(steps) or bool(steps.min() > 0 and _FASTEST_NS <= np.median(steps) <= _SLOWEST_NS)


def _unevenness(stamps: NDArray[np.int64]) -> float:
    """Return how irregular a series of times is: the spread of its steps' logarithms; 0 = equal steps."""
    return float(np.log(np.diff(np.sort(stamps))).std()) if len(stamps) > 1 else 0.0
