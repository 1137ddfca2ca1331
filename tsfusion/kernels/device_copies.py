# SPDX-License-Identifier: MIT
"""Copies between a process's memory and a device's.

Taichi 1.7 copies an array of NumPy that a kernel is handed into new memory of the device, and back, whoever
writes to it: 0.15 ms for four numbers on a GPU of 2024. On CUDA the driver is asked instead.
"""

import ctypes
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels import taichi as ti
from tsfusion.kernels.quick_launch import Copied

_ALIGNMENT = 256  # bytes
_FIRST_BYTES = 1 << 20


@ti.kernel
def _read(
    source: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.i32,
    out: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    for i in range(count):
        out[i] = source[i]


@ti.kernel
def _read_rows(source: ti.types.ndarray(dtype=ti.i32, ndim=2), out: ti.types.ndarray(dtype=ti.i32, ndim=2)):
    for i, j in ti.ndrange(out.shape[0], out.shape[1]):
        out[i, j] = source[i, j]


class Copies:
    """By kernels of Taichi, on any device."""

    def given(self, *arrays: NDArray[Any]) -> Sequence[Any]:
        """What a kernel (`QuickLaunch`) that reads these arrays is handed; valid until the next call."""
        return arrays

    def read(self, *wanted: tuple[Any, int]) -> list[NDArray[np.int32]]:
        """The first numbers of Taichi's int32 arrays, valid until the next call.

        Args:
            wanted: arrays, and how many numbers of each; whole rows, where there are rows.
        """
        found = []
        for source, count in wanted:
            out = np.empty(count, np.int32)
            if len(source.shape) == 2:
                _read_rows(source, out.reshape(-1, source.shape[1]))
            elif count:
                _read(source, count, out)
            found.append(out)
        return found

    def pin(self, memory: NDArray[np.uint8]) -> None:
        """Let this memory, instead of any before, be copied from faster, where the device can."""


class CudaCopies(Copies):
    """By CUDA's driver, in the order of Taichi's launches: both use the default stream.

    Raises:
        OSError: where there is no driver.
    """

    def __init__(self) -> None:
        self._cuda = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        self._program = ti.lang.impl.get_runtime().prog
        self._there = self._room(_FIRST_BYTES)
        self._here = self._pinned(_FIRST_BYTES)
        self._registered: NDArray[np.uint8] | None = None

    def given(self, *arrays: NDArray[Any]) -> Sequence[Any]:
        ends = np.cumsum([-(-array.nbytes // _ALIGNMENT) * _ALIGNMENT for array in arrays]).tolist()
        if ends[-1] > self._there.shape[0]:
            self._there = self._room(2 * ends[-1])
        first = self._address(self._there)
        copied = []
        for array, begin in zip(arrays, [0, *ends], strict=False):
            address = first + begin
            if array.nbytes:
                self._call("cuMemcpyHtoDAsync_v2", _U64(address), *_memory(array), None)
            copied.append(Copied(array, address))
        return copied

    def read(self, *wanted: tuple[Any, int]) -> list[NDArray[np.int32]]:
        ends = np.cumsum([count for _, count in wanted]).tolist()
        if 4 * ends[-1] > self._here.nbytes:
            self._call("cuMemFreeHost", ctypes.c_void_p(self._here.ctypes.data))
            self._here = self._pinned(8 * ends[-1])
        found = []
        for (source, count), begin in zip(wanted, [0, *ends], strict=False):
            out = self._here[begin : begin + count]
            if count:
                address, nbytes = _memory(out)
                self._call("cuMemcpyDtoHAsync_v2", address, _U64(self._address(source)), nbytes, None)
            found.append(out)
        self._call("cuStreamSynchronize", None)
        return found

    def pin(self, memory: NDArray[np.uint8]) -> None:
        if self._registered is not None:
            self._cuda.cuMemHostUnregister(_memory(self._registered)[0])
        failed = self._cuda.cuMemHostRegister_v2(*_memory(memory), 0)
        self._registered = None if failed else memory  # it stays mapped until then

    def _address(self, array: Any) -> int:
        found: int = self._program.get_ndarray_data_ptr_as_int(array.arr)
        return found

    def _room(self, nbytes: int) -> Any:
        return ti.ndarray(ti.u8, (nbytes,))

    def _pinned(self, nbytes: int) -> NDArray[np.int32]:
        address = ctypes.c_void_p()
        self._call("cuMemAllocHost_v2", ctypes.byref(address), _U64(nbytes))
        buffer = (ctypes.c_int32 * (nbytes // 4)).from_address(address.value or 0)
        return np.ctypeslib.as_array(buffer)

    def _call(self, name: str, *arguments: Any) -> None:
        """Call the driver.

        Raises:
            RuntimeError: it failed.
        """
        error = getattr(self._cuda, name)(*arguments)
        if error:
            raise RuntimeError(f"{name} of CUDA's driver failed with error {error}")


_U64 = ctypes.c_uint64


def _memory(array: NDArray[Any]) -> tuple[Any, Any]:
    """Address and size of an array."""
    return ctypes.c_void_p(array.ctypes.data), _U64(array.nbytes)


def copies() -> Copies:
    """Copies to and from the device that Taichi was started on."""
    if ti.lang.impl.current_cfg().arch == ti.cuda:
        return CudaCopies()
    return Copies()
