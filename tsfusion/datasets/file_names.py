# SPDX-License-Identifier: MIT
"""Numbers in the names of a recording's files: their order, their times, and which files belong together."""

import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SortKey = tuple[tuple[int, Decimal, str], ...]

_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?")
_NANOSECONDS = 19  # digits of a time of this century


def order(name: str) -> SortKey:
    """Sort key of names by their numbers: 9 before 10, 1.25 before 1.5."""
    parts = re.findall(r"([0-9]+(?:\.[0-9]+)?)|([^0-9]+)", name)
    return tuple((0, Decimal(number), "") if number else (1, Decimal(0), text) for number, text in parts)


def in_order(files: Iterable[Path]) -> list[Path]:
    """Files in the order of their folders, and in each of the numbers in their names.

    Names of one length are in the order of their characters: hexadecimal ones, too.
    """
    found = list(files)
    if len({len(file.stem) for file in found}) == 1:
        return sorted(found, key=lambda file: (order(str(file.parent)), file.name))
    return sorted(found, key=lambda file: (order(str(file.parent)), order(file.stem), file.suffix))


def numbers_in(name: str) -> list[str]:
    """The numbers in a name, decimal ones too."""
    return _NUMBER.findall(name)


def series_of(files: Iterable[Path]) -> list[list[Path]]:
    """Files of names that differ in their numbers alone, and of one kind; each series in the order of these.

    A number that follows a letter names a sensor (`cam0_`, `lidar1_`), unless it is the only one or the last.
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
    """Timestamp in a name, nanoseconds: of decimal seconds (TUM) or nanoseconds (EuRoC); None = neither."""
    if re.fullmatch(r"\d+\.\d+", name, re.ASCII):
        return int(Decimal(name) * 1_000_000_000)
    return int(name) if re.fullmatch(rf"\d{{{_NANOSECONDS}}}", name, re.ASCII) else None


def times_of_names(names: Sequence[str]) -> NDArray[np.int64] | None:
    """(n,) nanoseconds from the names of a recording's files; None unless all are times, in order."""
    stamps = [stamp for name in names if (stamp := time_of(name)) is not None]
    in_order = len(stamps) == len(names) and all(a < b for a, b in pairwise(stamps))
    return np.array(stamps, dtype=np.int64) if in_order else None
