# SPDX-License-Identifier: MIT
"""The loop that shares units of work out: each comes once, and neighbours go to different threads."""

from pathlib import Path

import numpy as np
import pytest
from command_processes import python

from tsfusion.kernels import ti
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.quick_launch import runs, unit_of


@ti.kernel
def note(
    count: ti.i32,
    times: ti.types.ndarray(dtype=ti.i32, ndim=1),
    iterations: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """How often each unit came, and in which iteration."""
    for run in range(runs(count)):
        unit = unit_of(run, count)
        if unit < count:
            ti.atomic_add(times[unit], 1)
            iterations[unit] = run


def check(count: int) -> None:
    times, iterations = np.zeros(count + 1, np.int32), np.zeros(count + 1, np.int32)
    note(count, times, iterations)
    assert times.tolist() == [1] * count + [0]
    threads = runtime.threads()
    # Taichi gives each thread one piece of the loop: of the same length, at least 512
    thread = iterations[:count] // max(-(-count // threads), 512)
    assert thread.tolist() == [unit % threads for unit in range(count)]


@pytest.mark.parametrize("count", [0, 1, 2, 3, 64, 1023, 1024, 1025, 5000])
def test_each_unit_comes_once_and_neighbours_go_to_different_threads(count: int) -> None:
    runtime.start()
    check(count)


def test_with_any_number_of_threads() -> None:
    program = (
        "import sys, test_run_loop as t; t.runtime.start(int(sys.argv[1]));"
        "[t.check(count) for count in (0, 1, 64, 1000, 1537, 9999)]"
    )
    for threads in (1, 3, 16):
        python(program, threads, check=True, cwd=Path(__file__).parent)
