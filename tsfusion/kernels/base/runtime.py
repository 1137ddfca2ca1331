# SPDX-License-Identifier: MIT
"""Start Taichi, once per process, on the thread that will launch kernels."""

import ctypes
import os
import stat
import tempfile
import textwrap
from contextlib import redirect_stdout, suppress
from functools import cache
from importlib import import_module
from io import StringIO
from threading import get_ident
from types import SimpleNamespace
from typing import Any

from tsfusion.core import process
from tsfusion.core.errors import MapError, MissingDependency
from tsfusion.kernels import CACHE_VARIABLE, ENGINE, ti

_GRID = 2048  # blocks of 128 threads of a device's task: of four times as many, most only end: 5 µs each task

_started_threads: int | None = None
_FORKED = -1  # marks a forked process; the kernel thread stayed in its parent
_thread: int | None = None  # the thread that runs kernels; None before the start


def check_thread() -> None:
    """Raise MapError in a thread other than the one that started Taichi, or in a process forked from it.

    Taichi itself checks only a kernel's first launch. Two threads would write to one map at the same time. In
    a forked process the threads of kernels are missing, and a launch would wait for them for ever.
    """
    if get_ident() == _thread or _thread is None:
        return
    if _thread == _FORKED:
        raise MapError(
            "maps cannot be used in a process forked from one that has used some: begin it anew "
            '(multiprocessing.get_context("spawn")), or fork before the first Volume'
        )
    raise MapError(
        "maps and synthetic recordings belong to the first thread of a process that used some, and this is "
        "another thread: call them there alone (keyframes can come through a queue.Queue), or have a process "
        "for them (tsfusion serve, tsfusion.Client)"
    )


def _leave_thread() -> None:
    """Forbid kernels in a forked child, which lacks their threads, and keep its end from waiting for them."""
    global _thread  # noqa: PLW0603  as below
    if _thread is not None:
        _thread = _FORKED
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(ti.lang.impl.get_runtime().prog))  # never destroyed


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_thread)


def start(threads: int | None = None) -> None:
    """Start Taichi's CPU backend, once per process.

    The thread count of the first call remains, because a second `ti.init` would destroy kernels. Results
    never depend on it.

    Raises:
        MissingDependency: where taichi has no wheel (Linux aarch64, Intel Macs).
        MapError: in another thread than before, or in a forked process (`check_thread`).
        MemoryError: the system gives less address space than kernels need (`ulimit -v`).
    """
    global _started_threads, _thread  # noqa: PLW0603  the process-wide state: Taichi itself is global
    check_thread()
    if _started_threads is None:
        _thread = get_ident()
        load_fast()
        wanted = threads or len(process.cores())
        kept_in()
        # `ti.init` starts the threads of kernels, and prints; a program may be reading our stdout
        with process.cores_of_their_own(wanted), redirect_stdout(StringIO()):
            try:
                ti.init(
                    arch=ti.cpu,
                    cpu_max_num_threads=wanted,
                    fast_math=False,  # a reassociated float would make two kernels disagree
                    cfg_optimization=False,  # LLVM does the same; Taichi's took three quarters of compiling
                    offline_cache=True,
                    log_level=ti.ERROR,
                )
            except RuntimeError as error:
                raise MemoryError(f"kernels cannot start: {first_line(error)}") from error
        _started_threads = wanted


def start_device(arch: str) -> None:
    """Start Taichi on a GPU instead of the CPU, once per process: `arch` is `cuda`, `vulkan` or `metal`.

    Raises MissingDependency if this machine, or Taichi's build for it, has no such device, or if the device
    lacks a feature that the map needs.
    """
    load_fast()
    kept_in()
    with redirect_stdout(StringIO()):
        ti.init(
            arch=getattr(ti, arch), fast_math=False, cfg_optimization=arch == "cuda", offline_cache=True,
            log_level=ti.ERROR, saturating_grid_dim=_GRID,
        )  # fmt: skip
    if ti.cfg.arch != getattr(ti, arch):
        raise MissingDependency("Taichi finds no such device, or no driver of one")
    from tsfusion.kernels.base import kernel_functions

    try:
        is_exact = kernel_functions.is_exact()
    except RuntimeError as error:
        raise MissingDependency(f"the device cannot run the kernels ({first_line(error)})") from error
    if not is_exact:
        raise MissingDependency("the device does not add 64-bit integers and round 64-bit floats exactly")


@cache
def kept_in() -> tuple[str, str]:
    """Return the cache folder of compiled kernels, and why it is not the usual one (empty if it is).

    Taichi creates the folder at a process's end. If it cannot, this end is a segmentation fault.
    """
    usual = os.environ.get(CACHE_VARIABLE) or ti.lang.impl.default_cfg().offline_cache_file_path
    try:
        os.makedirs(usual, exist_ok=True)
    except OSError as error:
        other = f"{tempfile.gettempdir()}/tsfusion-kernels-{os.getuid()}"
        with suppress(OSError):
            os.mkdir(other, 0o700)
        found = os.lstat(other)
        if found.st_uid != os.getuid() or found.st_mode != stat.S_IFDIR | 0o700:  # its kernels are executed
            other = tempfile.mkdtemp(prefix="tsfusion-kernels-")
        os.environ[CACHE_VARIABLE] = other  # an argument of `ti.init` would cause a warning
        return other, f"{usual} cannot be made: {error.strerror}"
    return usual, ""


def first_line(error: BaseException) -> str:
    """Return the first line of a Taichi error; its other lines only show positions in Taichi's own code."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


@cache
def load_fast() -> bool:
    """Make kernels load faster; return False if this version of the engine keeps what this needs elsewhere.

    Nothing formats the source position of each statement of each kernel, which only compile errors show. The
    formatting took a third of the time in which kernels load from the cache. A function's lines are looked up
    and wrapped only once, which saves a twelfth. Quadrants parses each kernel once, not twice: its first pass
    finds unused fields of dataclasses, and no kernel takes any.
    """
    plain = SimpleNamespace(fill=lambda line, **_: line.rstrip(), dedent=textwrap.dedent)
    no_position = lambda _context, _node: ""  # noqa: E731
    try:
        transformer = import_module(f"{ENGINE}.lang.ast.ast_transformer_utils")
        if ENGINE == "taichi":
            lines = import_module("taichi.lang.kernel_impl")
            _replace(lines, "getsourcelines", cache(lines.getsourcelines))
            _replace(transformer.ASTTransformerContext, "get_pos_info", no_position)
        else:
            lines, kernel = (import_module(f"quadrants.lang.{name}") for name in ("_func_base", "kernel"))
            _replace(lines, "get_source_info_and_src", cache(lines.get_source_info_and_src))
            _replace(transformer.ASTTransformerFuncContext, "memoized_get_pos_info", no_position)
            _replace(kernel.Kernel, "_try_load_fastcache", _without_first_pass)
        _replace(lines, "textwrap", plain)
    except (ImportError, AttributeError):
        return False
    return True


def _replace(owner: Any, name: str, new: Any) -> None:
    """Replace an attribute; raise AttributeError if there was none."""
    getattr(owner, name)
    setattr(owner, name, new)


def _without_first_pass(kernel: Any, _arguments: Any, key: Any) -> set[str]:
    """Return the fields of dataclasses that a kernel of quadrants uses: none."""
    kernel.fast_checksum = None
    kernel.used_py_dataclass_parameters_by_key_enforcing[key] = set[str]()
    return set()


def threads() -> int:
    """Return the number of CPU threads that kernels run on; 1 before `start`."""
    return _started_threads or 1
