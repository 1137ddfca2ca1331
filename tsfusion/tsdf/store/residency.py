# SPDX-License-Identifier: MIT
"""Limit the memory that blocks in files take: the blocks unchanged for longest leave memory."""

import mmap
import os
import sys
from collections.abc import Collection, Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files, process
from tsfusion.core.config import CacheConfig
from tsfusion.core.errors import InvalidConfig
from tsfusion.tsdf.store.growing_array import FileArray

GROUP = 32  # blocks that leave memory together: whole pages of every layer, even with pages of 64 kB
_LOW = 7 / 8  # share of the budget that remains after blocks have left
_PART = 1 << 17  # entries of the page table per read
_PRESENT = np.uint64(63)  # bit of an entry: the page is in memory


class Residency:
    """Limit of the memory that a map's layers in files take in this process."""

    def __init__(self, layers: Collection[FileArray], disk_bytes: int = 0) -> None:
        self._layers, self.disk_bytes = layers, disk_bytes
        self._measured = 0  # bytes of the layers in memory at the last measurement,
        self._shared = process.shared_rss_bytes()  # and bytes of all files at that time

    @cached_property
    def row_bytes(self) -> int:
        return sum(layer.item_bytes for layer in self._layers)

    @property
    def nbytes(self) -> int:
        """Estimated bytes of the blocks in memory; libraries loaded since the last measurement count, too."""
        return max(0, self._measured + process.shared_rss_bytes() - self._shared)

    def keep_within(self, budget: int, versions: NDArray[np.int32]) -> None:
        """Let the blocks unchanged for longest leave memory if all take more than `budget` bytes.

        `versions`, (count,), has the last keyframe that changed each block.
        """
        if self.nbytes <= budget or not len(versions):
            return
        in_memory = self._in_memory(-(-len(versions) // GROUP))
        total = int(in_memory.sum())
        if total > budget:
            newest = np.maximum.reduceat(versions, np.arange(0, len(versions), GROUP))
            here = np.flatnonzero(in_memory)
            here = here[np.argsort(newest[here], kind="stable")]
            freed = np.cumsum(in_memory[here])
            leaving = here[: int(np.searchsorted(freed, total - _LOW * budget)) + 1]
            self._let_go(np.sort(leaving))
            total -= int(in_memory[leaving].sum())
        self._measured, self._shared = total, process.shared_rss_bytes()

    def _in_memory(self, groups: int) -> NDArray[np.int64]:
        """Return the bytes in memory of each group of `GROUP` blocks; all bytes if the system cannot tell."""
        in_memory = np.zeros(groups, np.int64)
        for layer in self._layers:
            pages = GROUP * layer.item_bytes // mmap.PAGESIZE  # pages in a group
            is_here = _pages_in_memory(layer.address // mmap.PAGESIZE, groups * pages)
            in_memory += is_here.reshape(groups, pages).sum(axis=1) * mmap.PAGESIZE
        return in_memory

    def _let_go(self, groups: NDArray[np.int64]) -> None:
        for first, end in _runs(groups):
            for layer in self._layers:
                layer.let_go(first * GROUP, end * GROUP)


def _pages_in_memory(first: int, count: int) -> NDArray[np.bool_]:
    """Return a mask of the pages `first`, `first` + 1, … in this process's memory (Linux)."""
    found = np.ones(count, bool)
    with suppress(OSError), open("/proc/self/pagemap", "rb", buffering=0) as table:
        for i in range(0, count, _PART):
            part = os.pread(table.fileno(), 8 * min(_PART, count - i), 8 * (first + i))
            entries = np.frombuffer(part, np.uint64)
            found[i : i + len(entries)] = entries >> _PRESENT != 0
    return found


def _runs(numbers: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield the first and the end of each run of consecutive numbers; the numbers are sorted."""
    cuts = np.flatnonzero(np.diff(numbers) != 1) + 1
    for part in np.split(numbers, cuts):
        yield int(part[0]), int(part[-1]) + 1


def checked_cache(memory_bytes: int, cache: str | os.PathLike[str] | CacheConfig | None) -> CacheConfig:
    """Return the settings of the folder for blocks outside memory. Raises InvalidConfig for unusable ones."""
    if memory_bytes < 1:
        raise InvalidConfig(f"memory_bytes must be > 0, got {memory_bytes}")
    if sys.platform != "linux" or not process.shared_rss_bytes():
        raise InvalidConfig("memory_bytes needs Linux and its /proc: elsewhere all blocks stay in memory")
    if not isinstance(cache, CacheConfig):
        cache = CacheConfig(folder=os.fspath(cache or os.environ.get("TMPDIR") or "/var/tmp"))
    if durable_files.is_in_memory(Path(cache.folder)):
        raise InvalidConfig(
            f"the folder {cache.folder} is a RAM disk: files in it take memory; choose one on a disk "
            "for `cache`"
        )
    return cache
