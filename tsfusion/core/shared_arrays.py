# SPDX-License-Identifier: MIT
"""Arrays that one process writes and another reads, in memory that both have mapped; and a quick wait for a
message."""

import math
import mmap
import os
import select
import socket
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

_ALIGNMENT = 64  # bytes
MOST_SAID = 1 << 17  # bytes of a message
_STEP = 1 << 20


class SharedSlot(NamedTuple):
    """Place of an array in shared memory."""

    offset: int
    shape: tuple[int, ...]
    dtype: str

    @property
    def end(self) -> int:
        return self.offset + math.prod(self.shape) * np.dtype(self.dtype).itemsize


def make_file() -> int:
    """Descriptor of an unnamed file, in memory where the system has such files (Linux)."""
    with suppress(AttributeError):
        return os.memfd_create("tsfusion")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def look_out(descriptor: int, seconds: float) -> None:
    """Wait for input, at most `seconds`, without sleeping: a wake-up takes longer than the wait."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    end = time.monotonic() + seconds
    while not poll.poll(0) and time.monotonic() < end:
        os.sched_yield()  # the other process may have to run on this core


def talking_sockets() -> tuple[socket.socket, socket.socket]:
    """Two ends of a connection between processes that keeps messages apart; an end whose other end is closed
    reads b"".

    Raises OSError without such connections (macOS).
    """
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


class SharedArrays:
    """One process's side of the memory. Arrays stay valid; their content until the writer begins anew.

    `descriptor`: of the file; it is closed with this object.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._map: mmap.mmap | None = None
        self._size = 0
        self._end = 0

    def begin(self) -> None:
        """Overwrite the earlier arrays from now on."""
        self._end = 0

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> tuple[NDArray[Any], SharedSlot]:
        """Array to be filled, and its place."""
        place = SharedSlot(-(-self._end // _ALIGNMENT) * _ALIGNMENT, shape, np.dtype(dtype).str)
        self._end = end = place.end
        if end > self._size:
            os.ftruncate(self._descriptor, -(-max(end, 2 * self._size) // _STEP) * _STEP)
        return self.read(place), place

    def write(self, arrays: Iterable[NDArray[Any]]) -> list[SharedSlot]:
        """Copy arrays into the memory."""
        places = []
        for array in arrays:
            shared, place = self.empty(array.shape, array.dtype)
            shared[...] = array
            places.append(place)
        return places

    def read(self, place: SharedSlot) -> NDArray[Any]:
        """Array at a place, not copied."""
        if self._map is None or place.end > self._size:
            # Arrays of the earlier mapping keep it.
            self._size = os.fstat(self._descriptor).st_size
            self._map = mmap.mmap(self._descriptor, max(self._size, 1)) if self._size else None
        if self._map is None or 0 in place.shape:
            return np.zeros(place.shape, place.dtype)
        found: NDArray[Any] = np.ndarray(place.shape, place.dtype, self._map, place.offset)
        return found

    @property
    def memory(self) -> NDArray[np.uint8]:
        return np.empty(0, np.uint8) if self._map is None else np.frombuffer(self._map, np.uint8)

    def close(self) -> None:
        """Close the descriptor; arrays read before stay."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
