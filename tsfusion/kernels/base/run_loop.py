# SPDX-License-Identifier: MIT
"""A parallel loop over heavy units of work (a band of rays, a block), shared out among the threads.

Taichi 1.7's CPU backend gives each thread one piece of a loop, next to each other and of the same length, at
least 512 iterations (`make_cpu_multithreaded_range_for.cpp`). Neighbouring units cost alike, and those of one
piece more than those of another: at 1 cm the rays of an image's lower half cost 1.7 times those of its upper
half, and one thread waited for the other. So thread t of T takes units t, t + T, t + 2T, …:

    for run in range(runs(count)):  # run loop: kernels/base/run_loop.py
        unit = unit_of(run, count)
        if unit < count:
"""

import taichi as ti

from tsfusion.kernels.base import runtime

_LEAST = 512  # iterations that Taichi gives to one thread


@ti.func
def _piece(count):
    """Iterations of one thread."""
    threads = ti.static(runtime.threads())
    return ti.max((count + threads - 1) // threads, _LEAST)


@ti.func
def runs(count):
    """Iterations of a run loop over `count` units."""
    return _piece(count) * ti.static(runtime.threads())


@ti.func
def unit_of(run, count):
    """The unit of an iteration; `count` or more where it has none."""
    piece = _piece(count)
    return run % piece * ti.static(runtime.threads()) + run // piece
