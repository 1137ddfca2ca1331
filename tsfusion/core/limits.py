# SPDX-License-Identifier: MIT
"""Limit the memory that a foreign file may take, before it is used, and limit rates.

A container of a few kilobytes can unpack to gigabytes, and a file with a hole can have any size. So code that
reads or unpacks foreign files checks sizes here.
"""

import io
import math
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from tsfusion.core.errors import DatasetError
from tsfusion.core.readable_numbers import size

MAX_PIECE_BYTES = 1 << 27  # of an unpacked chunk, record or message: over 2 million points of 48 bytes
MAX_FILE_BYTES = 1 << 28  # of a file that is read whole: floats of the largest image of a keyframe
_FEW_BYTES, _WORST_RATIO = 1 << 29, 100  # of a compressed recording; sensors' data reaches 10 or 20
_WINDOW = 5.0  # seconds over which growth is counted
_SHORTEST = 1.0  # seconds until there is a rate


def check(source: object, nbytes: float) -> None:
    """Raise DatasetError if reading a `source` completely takes more than `MAX_FILE_BYTES` of memory."""
    if nbytes > MAX_FILE_BYTES:
        raise DatasetError(
            f"{source} needs {size(nbytes)} of memory; expected at most {size(MAX_FILE_BYTES)}"
        )


def unpack(opener: Callable[[Any, str], Any], packed: bytes, *_: Any) -> bytes:
    """Unpack a chunk or a message with `bz2.open` or the like. Raises ValueError beyond `MAX_PIECE_BYTES`."""
    with opener(io.BytesIO(packed), "rb") as file:
        found: bytes = file.read(MAX_PIECE_BYTES + 1)
    if len(found) > MAX_PIECE_BYTES:
        raise ValueError(f"a part of {size(len(packed))} unpacks to more than {size(MAX_PIECE_BYTES)}")
    return found


class BoundedFile(io.BufferedReader):
    """A file that gives at most `MAX_PIECE_BYTES` at once, and unpacks to no more than its limit."""

    def __init__(self, raw: Any, packed: float = math.inf) -> None:
        super().__init__(raw)
        self._left = max(_FEW_BYTES, _WORST_RATIO * packed)

    def read(self, nbytes: int | None = -1, /) -> bytes:
        """Read bytes as from any file. Raises ValueError beyond the limits."""
        if nbytes is not None and nbytes > MAX_PIECE_BYTES:
            raise ValueError(f"a part of {size(nbytes)} is larger than {size(MAX_PIECE_BYTES)}")
        found = super().read(nbytes)
        self._left -= len(found)
        if self._left < 0:
            raise ValueError("it unpacks to far more bytes than a file of its size can hold")
        return found


class BoundedPath(type(Path())):  # type: ignore[misc]  # which class it is depends on the system
    """A path that opens binary files as `BoundedFile`."""

    def open(self, mode: str = "r", *args: Any, **kwargs: Any) -> IO[Any]:
        opened: IO[Any] = (
            BoundedFile(io.FileIO(self)) if mode == "rb" else super().open(mode, *args, **kwargs)
        )
        return opened


class Rates:
    """Growth of two counts per second, over the last seconds; None = not enough time has passed.

    If a count falls, it belongs to a new object, and the measurement starts again.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[float, int, int]] = deque()

    def __call__(self, first: int, second: int) -> tuple[float | None, float | None]:
        """Add the present values of the two counts; return the growth of each per second."""
        now = time.monotonic()
        if self._samples and (first < self._samples[-1][1] or second < self._samples[-1][2]):
            self._samples.clear()
        self._samples.append((now, first, second))
        while len(self._samples) > 2 and now - self._samples[0][0] > _WINDOW:
            self._samples.popleft()
        then, first_then, second_then = self._samples[0]
        seconds = now - then
        if seconds < _SHORTEST:
            return None, None
        return (first - first_then) / seconds, (second - second_then) / seconds


class Bucket:
    """A token bucket, which limits a rate to `rate` a second, and to `burst` seconds' worth at once."""

    def __init__(self, rate: float, now: float, *, burst: float = 2.0) -> None:
        self._rate = rate
        self._level = self._most = burst * rate
        self._then = now

    def wait(self, amount: float, now: float) -> float:
        """Return seconds until an amount may pass; one larger than the bucket passes when that is full."""
        self._level = min(self._level + (now - self._then) * self._rate, self._most)
        self._then = now
        return max(min(amount, self._most) - self._level, 0.0) / self._rate

    def spend(self, amount: float) -> None:
        """Take an amount that passes now out of the bucket."""
        self._level -= amount
