# SPDX-License-Identifier: MIT
"""Launch a kernel in a tenth of the time that Taichi takes, and distribute loops over threads.

Taichi 1.7 checks the type of every argument again at each launch: 8 µs per argument, 0.14 ms for the sixteen
of `integrate.add_rays`. A small keyframe's rays take no longer, and the check runs in a single thread.

A run loop is a parallel loop over heavy units of work (a strip of rays, a block). Taichi 1.7's CPU backend
gives each thread one contiguous piece of a loop, of equal length, at least 512 iterations
(`make_cpu_multithreaded_range_for.cpp`). Neighbouring units cost the same, pieces do not: at 1 cm the rays of
an image's lower half cost 1.7 times those of its upper half, and one thread waited for the other. So thread t
of T takes units t, t + T, t + 2T, …:

    for run in range(runs(count)):  # run loop: kernels/base/quick_launch.py
        unit = unit_of(run, count)
        if unit < count:
"""

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels import ENGINE, ti
from tsfusion.kernels.base import runtime

_LEAST = 512  # least iterations that Taichi gives to one thread
_INTEGERS, _FLOATS = (int, np.integer), (float, np.floating)
_INTEGER, _FLOAT, _OF_TAICHI, _OF_NUMPY, _COPIED = -1, -2, -3, -4, -5
_PLACES = range(64) if ENGINE == "quadrants" else [(place,) for place in range(64)]  # of arguments
# Attributes of a kernel with its parameters, its compiled forms, and their machine code by the same key
_KEPT_BY = {
    "taichi": ("arguments", "compiled_kernels", ""),
    "quadrants": ("arg_metas", "materialized_kernels", "compiled_kernel_data_by_key"),
}
_WHAT: dict[type, int] = {}  # kind of each argument type seen so far: a new check takes half of a launch


class Copied(NamedTuple):
    """A NumPy array that also has a copy on a GPU; kernels that only read the array get the copy.

    The first launch, which Taichi makes, copies the array itself.
    """

    array: NDArray[Any]
    address: int


class QuickLaunch:
    """A kernel over contiguous NumPy arrays, Taichi arrays and numbers, launched without Taichi's checks once
    the argument types are known.

    Taichi itself makes the first launch for each choice of dtypes and dimensions, every launch with other
    arguments, and all launches in another version of Taichi.
    """

    is_active: ClassVar = False  # True after the first kernel of this process that can be launched quickly

    def __init__(self, kernel: Callable[..., None]) -> None:
        update_wrapper(self, kernel)
        self._kernel = kernel
        self._program: Any = None
        self._compiled: dict[tuple[int, ...], tuple[Any, Any]] = {}
        self._takes_floats: list[bool] = []

    def __call__(self, *arguments: Any) -> None:
        kind = _kind(arguments)
        known = None
        if kind is not None and self._program is ti.lang.impl.get_runtime().prog:
            known = self._compiled.get(kind)
        if known is None:
            self._begin(arguments, kind)
            return
        kernel, code = known
        context = kernel.make_launch_context()
        set_ndarray, set_array = context.set_arg_ndarray, context.set_arg_external_array_with_shape
        for place, takes_floats, argument in zip(_PLACES, self._takes_floats, arguments, strict=False):
            what = _WHAT[type(argument)]
            if what == _OF_TAICHI:
                set_ndarray(place, argument.arr)
            elif what == _OF_NUMPY:
                address = argument.__array_interface__["data"][0]
                set_array(place, address, argument.nbytes, argument.shape, 0)
            elif what == _COPIED:
                array = argument.array
                set_array(place, argument.address, array.nbytes, array.shape, 0)
            elif takes_floats:
                context.set_arg_float(place, float(argument))
            else:
                context.set_arg_int(place, int(argument))
        self._program.launch_kernel(code, context)

    def _begin(self, arguments: tuple[Any, ...], kind: tuple[int, ...] | None) -> None:
        """Launch the kernel through its engine, and keep its compiled form for launches of this kind."""
        arguments = tuple(_plain(one) for one in arguments)
        self._kernel(*arguments)
        if kind is None:
            return
        try:
            program, primal = ti.lang.impl.get_runtime().prog, self._kernel._primal  # type: ignore[attr-defined]
            if self._program is not program:
                self._compiled.clear()
            parameters, kernels, codes = (getattr(primal, name, None) for name in _KEPT_BY[ENGINE])
            if not all(map(_is_known, parameters)):
                return
            key = primal.ensure_compiled(*arguments)
            kernel = kernels[key]
            if codes is None:
                code = program.compile_kernel(program.config(), program.get_device_caps(), kernel)
            else:
                code = codes[key]
            floats = ti.types.primitive_types.real_type_ids
            self._takes_floats = [id(parameter.annotation) in floats for parameter in parameters]
            self._compiled[kind] = kernel, code
            self._program, QuickLaunch.is_active = program, True
        except (AttributeError, KeyError, TypeError):  # another version of the engine
            self._program = None


def _plain(argument: Any) -> Any:
    """Return an argument as the engine takes it: quadrants warns of NumPy numbers and of tuples."""
    if isinstance(argument, Copied):
        return argument.array
    if isinstance(argument, np.generic):
        return argument.item()
    return np.array(argument) if isinstance(argument, tuple) else argument


def _is_known(argument: Any) -> bool:
    """Return True for a kernel argument that is an array or a number; Taichi splits vectors to numbers."""
    annotation = argument.annotation
    numbers = ti.types.primitive_types.type_ids
    return isinstance(annotation, ti.types.ndarray_type.NdarrayType) or id(annotation) in numbers


def _kind(arguments: tuple[Any, ...]) -> tuple[int, ...] | None:
    """Return the argument types as numbers, the key of a compiled kernel, or None if Taichi must launch."""
    kind = []
    for argument in arguments:
        what = _WHAT.get(type(argument))
        if what == _OF_TAICHI:
            kind.append(-8 - (id(argument.dtype) << 4 | len(argument.shape)))
        elif what == _OF_NUMPY or what == _COPIED:
            array = argument.array if what == _COPIED else argument
            if not (array.flags.c_contiguous and array.dtype.isnative):  # `num` does not show byte order
                return None
            kind.append(array.dtype.num << 4 | array.ndim)
        elif what is not None:
            kind.append(what)
        elif (found := _what(argument)) is None:
            return None
        else:
            _WHAT[type(argument)] = found
            return _kind(arguments)
    return tuple(kind)


def _what(argument: Any) -> int | None:
    """Return the number of an argument's type, also for a subclass, or None if only Taichi can launch it."""
    for kind, what in (
        (ti.Ndarray, _OF_TAICHI), (np.ndarray, _OF_NUMPY), (Copied, _COPIED), (_INTEGERS, _INTEGER),
        (_FLOATS, _FLOAT),
    ):  # fmt: skip
        if isinstance(argument, kind):
            return what
    return None


@ti.func
def _piece(count):
    threads = ti.static(runtime.threads())
    return ti.max((count + threads - 1) // threads, _LEAST)


@ti.func
def runs(count):
    """Return the number of iterations of a run loop over `count` units of work."""
    return _piece(count) * ti.static(runtime.threads())


@ti.func
def unit_of(run, count):
    """Return the unit of work of a run loop's iteration; a number of `count` or more means no work."""
    piece = _piece(count)
    return run % piece * ti.static(runtime.threads()) + run // piece
