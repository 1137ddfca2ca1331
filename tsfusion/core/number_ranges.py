# SPDX-License-Identifier: MIT
"""Hold sets of whole numbers as few ranges, such as keyframes 3 to 17 and 20; find distinct integers."""

import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig

_WORD = re.compile(r"\s*([0-9]{1,18})\s*(?:-\s*([0-9]{1,18})\s*)?")
Integer = TypeVar("Integer", bound=np.integer)


class NumberRanges:
    """A set of whole numbers, 16 bytes a range. `ranges`: first and last number of each."""

    def __init__(self, ranges: Iterable[tuple[int, int]] = ()) -> None:
        self._ranges: NDArray[np.int64] = _merged(np.array(list(ranges), dtype=np.int64).reshape(-1, 2))

    def __contains__(self, number: int) -> bool:
        at = bisect_right(self._ranges[:, 0], number) - 1
        return at >= 0 and number <= int(self._ranges[at, 1])

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """First and last number of each range, in ascending order."""
        return ((first, last) for first, last in self._ranges.tolist())

    @property
    def count(self) -> int:
        """How many numbers are in the set. As `__len__`, `list` would ask for so much memory."""
        return sum(last - first + 1 for first, last in self)

    def __str__(self) -> str:
        return ", ".join(f"{first}-{last}" if last > first else f"{first}" for first, last in self)

    def mask(self, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return an (n,) mask of the `numbers` that are in the set."""
        if not len(self._ranges):
            return np.zeros(len(numbers), np.bool_)
        at = np.searchsorted(self._ranges[:, 0], numbers, side="right") - 1
        found: NDArray[np.bool_] = (at >= 0) & (numbers <= self._ranges[at, 1])
        return found

    def add(self, numbers: NDArray[np.int64]) -> None:
        self._ranges = _merged(np.concatenate([self._ranges, np.repeat(numbers[:, None], 2, axis=1)]))


def _merged(ranges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return (n, 2) ranges in order, with overlapping and adjacent ones joined."""
    if not len(ranges):
        return ranges
    ranges = ranges[np.argsort(ranges[:, 0], kind="stable")]
    reach = np.maximum.accumulate(ranges[:, 1])
    begins = np.flatnonzero(np.concatenate([[True], ranges[1:, 0] - 1 > reach[:-1]]))
    return np.stack([ranges[begins, 0], reach[np.append(begins[1:], len(ranges)) - 1]], axis=1)


def parse(text: str) -> tuple[tuple[int, int], ...]:
    """Return the ranges in a text such as `3-17,20`. Raises InvalidConfig for anything else."""
    found = []
    for word in text.split(","):
        match = _WORD.fullmatch(word)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
        if not 1 <= first <= last:
            raise InvalidConfig(f"keyframes must be numbers and ranges such as 3-17,20, got {text!r}")
        found.append((first, last))
    return tuple(NumberRanges(found))


def distinct(values: NDArray[Integer]) -> NDArray[Integer]:
    """Return the distinct integers of an array of any shape, ascending: (n,).

    `np.unique` hashes integers since NumPy 2.3, which takes twenty times as long with many keys.
    """
    ascending = np.sort(values, axis=None)
    is_first = np.ones(len(ascending), bool)
    is_first[1:] = ascending[1:] != ascending[:-1]
    return ascending[is_first]
