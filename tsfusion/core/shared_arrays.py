# SPDX-License-Identifier: MIT
"""Share arrays between two processes in mapped memory, and wait for a message without sleeping."""

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
    """Location of an array in shared memory."""

    offset: int
    shape: tuple[int, ...]
    dtype: str

    @property
    def end(self) -> int:
        return self.offset + math.prod(self.shape) * np.dtype(self.dtype).itemsize


def make_file() -> int:
    """Return the descriptor of an unnamed file, in memory if the system has such files (Linux)."""
    with suppress(AttributeError):
        return os.memfd_create("tsfusion")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def look_out(descriptor: int, seconds: float) -> None:
    """Wait for input, at most `seconds`, by polling: a wake-up from sleep would take longer than the wait."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    end = time.monotonic() + seconds
    while not poll.poll(0) and time.monotonic() < end:
        os.sched_yield()  # the other process may need this core


def talking_sockets() -> tuple[socket.socket, socket.socket]:
    """Return the two ends of a connection between processes that keeps messages separate.

    After one end is closed, the other reads b"". Raises OSError without such connections (macOS).
    """
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


class SharedArrays:
    """Memory that two processes share, as one of them sees it. Arrays stay valid; their content lasts until
    the writer's next `begin`.

    `descriptor`: of the file; it is closed with this object.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._map: mmap.mmap | None = None
        self._size = 0
        self._end = 0

    def begin(self) -> None:
        """Start a new message: arrays made from now on overwrite the earlier ones."""
        self._end = 0

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> tuple[NDArray[Any], SharedSlot]:
        """Reserve memory for an array; return the array, to be filled, and its location."""
        place = SharedSlot(-(-self._end // _ALIGNMENT) * _ALIGNMENT, shape, np.dtype(dtype).str)
        self._end = end = place.end
        if end > self._size:
            os.ftruncate(self._descriptor, -(-max(end, 2 * self._size) // _STEP) * _STEP)
        return self.read(place), place

    def write(self, arrays: Iterable[NDArray[Any]]) -> list[SharedSlot]:
        """Copy arrays into the memory; return their locations."""
        places = []
        for array in arrays:
            shared, place = self.empty(array.shape, array.dtype)
            shared[...] = array
            places.append(place)
        return places

    def read(self, place: SharedSlot) -> NDArray[Any]:
        """Return the array at a location, not copied."""
        if self._map is None or place.end > self._size:
            # Arrays of the earlier mapping keep that mapping alive.
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
        """Close the descriptor; arrays read before stay valid."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
