# SPDX-License-Identifier: MIT
"""Copy arrays between the memory of a process and a GPU's; measure rows there, and lay out `told`.

Taichi 1.7 copies a NumPy argument of a kernel into new memory of the device, and back, even if no kernel
writes to it: 0.15 ms for four numbers on a GPU of 2024. On CUDA the driver copies instead. `told`, (n,)
int32, is the report of a kernel launch to its host: counts, new block keys, slots of touched blocks.
"""

import ctypes
import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels import ANY, I32, I64, ANYx2, I32x2, I64x2, ti
from tsfusion.kernels.base.quick_launch import Copied, QuickLaunch
from tsfusion.kernels.base.voxel_traversal import DEFERRED, STRIP_FIELDS
from tsfusion.kernels.integration.integrate import CUBE, TOUCHED_HEADER, TOUCHED_MISSING, lane_weight
from tsfusion.kernels.integration.space_carving import BITS

_ALIGNMENT = 256  # bytes
_FIRST_BYTES = 1 << 20
_SMALL_BYTES = 1 << 12
_DTYPES = {ti.i32: np.dtype(np.int32), ti.i64: np.dtype(np.int64)}
# `told` starts with the header of the touched blocks (`integrate`). Then come: number of new blocks; number
# of missing blocks whose hash index no other block wants; flag, two of these are the same; the strips, the
# k-th of which also counts updates of every 64th ray; keys of new blocks, in the order of their slots, two
# numbers each; slots of touched blocks.
NEW, APART, ARE_SAME = (TOUCHED_HEADER + i for i in range(3))
HEADER = 16
STRIPS = 64  # the strips of a map on the CPU: bundles of points end at their ends
FEW_NEW = 4096  # largest number of blocks that a launch inserts itself
STRIPS_AT = HEADER
FRESH_AT = STRIPS_AT + STRIPS * STRIP_FIELDS
TOUCHED_AT = FRESH_AT + 2 * FEW_NEW
FIRST_BLOCKS = 8192  # blocks that a new map has room for
FIRST_HASH = 4 * FIRST_BLOCKS
LACKING = DEFERRED  # field of a strip: updates of missing blocks
CLAIMS = 1 << 14  # entries of a table that counts the missing blocks for each hash index
BEGINNERS = max(TOUCHED_AT, CLAIMS)


@ti.kernel
def _read(source: ANY, out: ANY):
    for i in range(out.shape[0]):
        out[i] = source[i]


@ti.kernel
def _read_rows(source: I32x2, out: I32x2):
    for i, j in ti.ndrange(out.shape[0], out.shape[1]):
        out[i, j] = source[i, j]


class Copies:
    """Copies of arrays to and from a GPU by Taichi kernels, on any device."""

    def given(self, *arrays: NDArray[Any]) -> Sequence[Any]:
        """Copy arrays to the device, and return them as arguments for a kernel, until the next call."""
        return arrays

    def read(self, *wanted: tuple[Any, int]) -> list[NDArray[Any]]:
        """Return the first items of Taichi arrays of int32 or int64 as NumPy arrays, until the next call.

        `wanted` has arrays of one or two dimensions, each with its number of items or rows.
        """
        found = []
        for source, count in wanted:
            out = np.empty((count, *source.shape[1:]), _DTYPES[source.dtype])
            if count:
                (_read_rows if out.ndim == 2 else _read)(source, out)
            found.append(out)
        return found

    def finish(self) -> None:
        """Wait until the `given` arrays are copied and may change. `read` waits, too."""

    def pin(self, memory: NDArray[np.uint8]) -> None:
        """Page-lock this memory, if the device can, for faster copies; earlier memory is unlocked."""


class CudaCopies(Copies):
    """Copies of arrays by CUDA's driver, in the order of Taichi's launches: both use the default stream.

    Raises OSError without a driver.
    """

    def __init__(self) -> None:
        self._cuda = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        self._program = ti.lang.impl.get_runtime().prog
        self._there = self._room(_FIRST_BYTES)
        self._here = self._pinned(_FIRST_BYTES)
        self._registered: NDArray[np.uint8] | None = None

    def given(self, *arrays: NDArray[Any]) -> Sequence[Any]:
        begins = [0] * len(arrays)
        end = small_end = 0
        for i in sorted(range(len(arrays)), key=lambda i: arrays[i].nbytes):
            begins[i] = _aligned(end)
            end = begins[i] + arrays[i].nbytes
            small_end = end if arrays[i].nbytes <= _SMALL_BYTES else small_end
        if end > self._there.shape[0]:
            self._there = self._room(2 * end)
        first = self._address(self._there)
        small = np.empty(small_end, np.uint8)  # small arrays are copied together
        for array, begin in zip(arrays, begins, strict=True):
            if array.nbytes <= _SMALL_BYTES:
                small[begin : begin + array.nbytes] = array.reshape(-1).view(np.uint8)
            else:
                self._call("cuMemcpyHtoDAsync_v2", _U64(first + begin), *_memory(array), None)
        if small_end:
            self._call("cuMemcpyHtoDAsync_v2", _U64(first), *_memory(small), None)
        return [Copied(array, first + begin) for array, begin in zip(arrays, begins, strict=True)]

    def read(self, *wanted: tuple[Any, int]) -> list[NDArray[Any]]:
        found: list[NDArray[Any]] = []
        end = 0
        for source, count in wanted:
            shape, dtype = (count, *source.shape[1:]), _DTYPES[source.dtype]
            begin, nbytes = _aligned(end), math.prod(shape) * dtype.itemsize
            end = begin + nbytes
            if end > len(self._here):
                self._here = self._pinned(2 * end)  # earlier results stay in the former memory
            out = self._here[begin:end].view(dtype).reshape(shape)
            if count:
                address, size = _memory(out)
                self._call("cuMemcpyDtoHAsync_v2", address, _U64(self._address(source)), size, None)
            found.append(out)
        self.finish()
        return found

    def finish(self) -> None:
        self._call("cuStreamSynchronize", None)

    def pin(self, memory: NDArray[np.uint8]) -> None:
        if self._registered is not None:
            self._cuda.cuMemHostUnregister(_memory(self._registered)[0])
        failed = self._cuda.cuMemHostRegister_v2(*_memory(memory), 0)
        self._registered = None if failed else memory  # the reference keeps it mapped until then

    def _address(self, array: Any) -> int:
        found: int = self._program.get_ndarray_data_ptr_as_int(array.arr)
        return found

    def _room(self, nbytes: int) -> Any:
        return ti.ndarray(ti.u8, (nbytes,))

    def _pinned(self, nbytes: int) -> NDArray[np.uint8]:
        """Return page-locked memory, from which copies are faster; kept until the process ends."""
        address = ctypes.c_void_p()
        self._call("cuMemAllocHost_v2", ctypes.byref(address), _U64(nbytes))
        return np.ctypeslib.as_array((ctypes.c_uint8 * nbytes).from_address(address.value or 0))

    def _call(self, name: str, *arguments: Any) -> None:
        """Call function `name` of the CUDA driver. Raises RuntimeError if it fails."""
        error = getattr(self._cuda, name)(*arguments)
        if error:
            raise RuntimeError(f"{name} of CUDA's driver failed with error {error}")


_U64 = ctypes.c_uint64


def _aligned(nbytes: int) -> int:
    return -(-nbytes // _ALIGNMENT) * _ALIGNMENT


def _memory(array: NDArray[Any]) -> tuple[Any, Any]:
    return ctypes.c_void_p(array.ctypes.data), _U64(array.nbytes)


def copies() -> Copies:
    """Return the object that copies arrays to and from the device on which Taichi runs."""
    if ti.lang.impl.current_cfg().arch == ti.cuda:
        with suppress(OSError):
            return CudaCopies()
    return Copies()


@QuickLaunch
@ti.kernel
def write_hash(places: I32, keys: I64, slots: I32, hash_keys: I64, hash_slots: I32):
    """Write keys and slots to indices `places` of the GPU's hash table from block to slot."""
    for i in range(places.shape[0]):
        hash_keys[places[i]] = keys[i]
        hash_slots[places[i]] = slots[i]


@QuickLaunch
@ti.kernel
def largest_weights(sums: I64x2, slots: I32, count: ti.i32, found: I32):
    """Write the largest weight in block `slots[i]` to `found[i]`, for the first `count` slots."""
    for i in range(count):
        most = 0
        for v in range(CUBE):
            most = ti.max(most, lane_weight(sums[slots[i], v]))
        found[i] = most


@QuickLaunch
@ti.kernel
def add_free_blocks(slots: I32, amounts: I64, masks: I64x2, sign_: ti.i32, sums: I64x2):
    """Add free-space votes to the clear voxels of blocks, as `space_carving.add_free_blocks` does."""
    for i in range(slots.shape[0] * CUBE):
        n, v = i // CUBE, i % CUBE
        if (masks[n, v // BITS] >> (v % BITS)) & 1 == 1:
            sums[slots[n], v] += sign_ * amounts[n]


@ti.kernel
def read_rows(layer: ANYx2, slots: I32, rows: ANYx2):
    """Copy the row of each block `slots[i]` from a map layer to `rows[i]`."""
    for i in range(slots.shape[0] * CUBE):
        rows[i // CUBE, i % CUBE] = layer[slots[i // CUBE], i % CUBE]


@ti.kernel
def write_rows(layer: ANYx2, slots: I32, rows: ANYx2):
    """Copy `rows[i]` to the row of block `slots[i]` in a map layer."""
    for i in range(slots.shape[0] * CUBE):
        layer[slots[i // CUBE], i % CUBE] = rows[i // CUBE, i % CUBE]


@ti.kernel
def move_rows(layer: ANYx2, count: ti.i32, larger: ANYx2):
    """Copy the first `count` rows of a map layer into a larger array, when the layer grows."""
    for i in range(count * CUBE):
        larger[i // CUBE, i % CUBE] = layer[i // CUBE, i % CUBE]


@ti.kernel
def move_list(listed: ANY, larger: ANY):
    """Copy a list into a larger array, when the list grows."""
    for i in range(listed.shape[0]):
        larger[i] = listed[i]


@ti.func
def strip_field(strip, field: ti.template()):
    """Return the index in the report `told` of a strip's field."""
    return STRIPS_AT + strip * STRIP_FIELDS + field


@ti.func
def begin_keyframe(i, told: ti.template(), claims: ti.template()):
    """Clear the last keyframe's report `told` and counters `claims`: entry i, in the i-th thread."""
    if i < TOUCHED_AT:
        told[i] = 0
    if i < CLAIMS:
        claims[i] = 0


@ti.func
def joined(low, high):
    """Join the two int32 halves of a block key."""
    return (ti.cast(high, ti.i64) << 32) | (ti.cast(low, ti.i64) & ti.i64(4294967295))


@ti.func
def fresh_key(told: ti.template(), rank):
    """Return the key of the new block with number `rank` in the report `told`."""
    return joined(told[FRESH_AT + 2 * rank], told[FRESH_AT + 2 * rank + 1])


@ti.func
def rank_of(told: ti.template(), key):
    """Return the rank of a new block: blocks that share no hash index come first; each group is sorted."""
    rank = rank_within(told, key, 0, told[APART])
    if rank < 0:
        rank = rank_within(told, key, told[APART], told[TOUCHED_MISSING])
    return rank


@ti.func
def rank_within(told: ti.template(), key, first, end):
    """Return the rank of a new block among ranks `first` … `end` − 1 (binary search by key); else −1."""
    low, high = first, end
    while high - low > 1:
        middle = (low + high) >> 1
        if fresh_key(told, middle) <= key:
            low = middle
        else:
            high = middle
    found = -1
    if first < end:
        found = ti.select(fresh_key(told, low) == key, low, -1)
    return found
