# SPDX-License-Identifier: MIT
"""Taichi is started once, here, on the thread that will launch kernels."""

import os
from contextlib import redirect_stdout
from io import StringIO

_started_threads: int | None = None


def start(threads: int | None = None) -> None:
    """Start Taichi's CPU backend, once a process.

    The thread count of the first call stands: a second `ti.init` would tear kernels down. Results never
    depend on it.

    Raises:
        MissingDependency: where taichi has no wheel (Linux aarch64, Intel Macs).
    """
    global _started_threads  # noqa: PLW0603  the one piece of process-wide state: Taichi itself is global
    from tsfusion.kernels import taichi as ti  # says what to do where there is none

    if _started_threads is None:
        _started_threads = threads or os.cpu_count() or 1
        with redirect_stdout(StringIO()):  # `ti.init` prints; a program may be reading our stdout
            ti.init(
                arch=ti.cpu,
                cpu_max_num_threads=_started_threads,
                fast_math=False,  # a reassociated float would make two kernels disagree
                offline_cache=True,
                log_level=ti.ERROR,
            )
