# SPDX-License-Identifier: MIT
"""Control this process's memory, limits, signals, cores and end; report versions."""

import _signal  # type: ignore[import-not-found]  # `signal` makes enumerations of numbers: 5 µs a call
import ctypes
import os
import resource
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

import tsfusion
from tsfusion.core.errors import InvalidConfig, MissingDependency

ENGINES = ("taichi", "quadrants")  # quadrants: a maintained fork of Taichi, with builds for 64-bit Arm
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h

# Arguments of Popen: the terminal's Ctrl-C does not reach the process. It stays in this session if
# Python can do that: Linux shares the cores among sessions (autogroup), and a process in its own session that
# mostly sleeps then waits seconds for a busy core.
OWN_GROUP: dict[str, Any] = (
    {"process_group": 0} if sys.version_info >= (3, 11) else {"start_new_session": True}
)


def peak_rss_bytes() -> int:
    """Return the peak resident memory of this process, bytes."""
    if sys.platform == "linux":
        # not getrusage: its maximum survives exec, so that a child would report its parent's
        with suppress(OSError):  # no file descriptor is left: then use getrusage anyway
            for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def rss_bytes() -> int:
    """Return the present resident memory of this process, bytes; 0 = unknown."""
    with suppress(OSError), open("/proc/self/statm", "rb") as file:  # by far quicker than a Path
        return int(file.read().split()[1]) * resource.getpagesize()
    return 0


def tree_rss_bytes(pid: int) -> int:
    """Return the present resident memory of a process and its children, bytes; 0 = unknown (Linux)."""
    total = 0
    with suppress(OSError, ValueError, IndexError):
        total = (
            int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()
        )
        for tasks in Path(f"/proc/{pid}/task").iterdir():
            for child in (tasks / "children").read_text(encoding="ascii").split():
                total += tree_rss_bytes(int(child))
    return total


def shared_rss_bytes() -> int:
    """Return the part of the resident memory that is mapped from files, bytes; 0 = unknown."""
    with suppress(OSError), open("/proc/self/statm", "rb") as file:
        return int(file.read().split()[2]) * resource.getpagesize()
    return 0


def give_back_memory() -> None:
    """Return the allocator's freed memory to the system (glibc; does nothing elsewhere)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def keep_freed_memory() -> None:
    """Let the allocator keep up to 32 MB of freed memory, for arrays of up to 8 MB (glibc).

    Otherwise a keyframe's arrays are returned to the system and mapped again: 1.5 ms of 7 in a fuser.
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_MMAP_THRESHOLD, 8 << 20)
        mallopt(_M_TRIM_THRESHOLD, 32 << 20)


def data_bytes() -> int:
    """Return the memory that this process has reserved, used or not, bytes; 0 = unknown."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmData:"):
                return int(line.split()[1]) * 1024
    return 0


def limit_memory(most: int) -> None:
    """Make allocations beyond `most` bytes fail from now on; Python raises MemoryError (Linux)."""
    if sys.platform == "linux":
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (most if hard < 0 else min(most, hard), hard))


def lift_memory_limit() -> None:
    """Remove the `limit_memory` that this process inherited from its parent."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))


def state(pid: int) -> str:
    """Return the state of a process as the system's letter; empty if it is unknown, or without a process.

    R = runs, S = sleeps, D = waits for a disk and cannot even be killed, T and t = stopped.
    """
    with suppress(OSError, IndexError), open(f"/proc/{pid}/stat", "rb") as file:
        # Not at the first bracket: the name before the state may hold one.
        return file.read().rpartition(b")")[2].split()[0].decode()
    return ""


def end_first() -> None:
    """Make the system kill this process before others when the machine's memory runs out (Linux)."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")


def on_parent_end(number: signal.Signals) -> None:
    """Send this process a signal when the thread that started it ends (Linux)."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0)


def end_with_stdin() -> None:
    """From now on, end this process as by SIGTERM when its stdin closes: its parent closed it, or ended."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 4096):  # unbuffered: no lock is held when the interpreter ends
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


def raise_file_limit() -> None:
    """Allow as many open files as this user may have: each connection needs one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        with suppress(OSError, ValueError):  # a system that allows less than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def cores() -> list[int]:
    """Return the numbers of the machine's cores that this process may use, ascending."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


@contextmanager
def cores_of_their_own(count: int) -> Iterator[None]:
    """Give each of the last `count` threads that start in the block its own core (Linux).

    Does so only if `count` is the number of cores. Otherwise threads that one call wakes for a millisecond's
    work often share a core, because the caller's core seems busy until the caller waits.
    """
    ours, before = cores(), _threads()
    yield
    if len(ours) == count:
        started = [thread for thread in _threads() if thread not in before]
        for thread, core in zip(started[-count:], ours, strict=False):
            with suppress(OSError):  # it has ended
                os.sched_setaffinity(thread, {core})


def _threads() -> list[int]:
    """Return the numbers of this process's threads, ascending; empty = unknown."""
    with suppress(OSError):
        return sorted(map(int, os.listdir("/proc/self/task")))
    return []


def physical_memory_bytes() -> int:
    """Return the machine's memory, or the part that this container or service may use, bytes."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    group = "/"
    with suppress(OSError):
        group = Path("/proc/self/cgroup").read_text(encoding="utf-8").rpartition("0::")[2].strip()
    for name in {group, "/"}:
        with suppress(OSError, ValueError):  # no such group, or no limit: "max"
            path = Path("/sys/fs/cgroup") / name.lstrip("/") / "memory.max"
            limits.append(int(path.read_text(encoding="ascii")))
    return min(limits)


def oom_kills() -> int:
    """Return the number of processes that the system has killed for lack of memory; 0 = unknown."""
    with suppress(OSError):
        for line in Path("/proc/vmstat").read_text(encoding="ascii").splitlines():
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    return 0


_holds_back = False  # the main thread is inside `uninterrupted`


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of the block.

    Code in the block that swallows exceptions then cannot swallow these signals.
    """
    global _holds_back  # noqa: PLW0603  as the handlers are the process's
    if _holds_back or threading.current_thread() is not threading.main_thread():
        yield  # signals only ever interrupt the main thread
        return
    came: list[tuple[int, FrameType | None]] = []
    usual: dict[int, Any] = {}

    def later(number: int, frame: FrameType | None) -> None:
        came.append((number, frame))

    for caught in (signal.SIGINT, signal.SIGTERM):
        if _signal.getsignal(caught) is not None:  # one that Python did not set cannot be put back
            usual[caught] = _signal.signal(caught, later)
    _holds_back = True
    try:
        yield
    finally:
        _holds_back = False
        for number, handler in usual.items():
            _signal.signal(number, handler)
    for number, frame in came:
        handler = signal.getsignal(number)  # the first signal's handler may have set it
        if callable(handler):
            handler(number, frame)
        elif handler == signal.SIG_DFL:
            signal.raise_signal(number)


def chosen_engine() -> str:
    """Return the engine of kernels: `TSFUSION_ENGINE` if it is set, else the first of `ENGINES` installed.

    Raises:
        InvalidConfig: when `TSFUSION_ENGINE` names no engine.
    """
    forced = os.environ.get("TSFUSION_ENGINE")
    if forced and forced not in ENGINES:
        raise InvalidConfig(f"TSFUSION_ENGINE must be {' or '.join(ENGINES)}, got {forced!r}")
    return forced or next((name for name in ENGINES if find_spec(name)), ENGINES[0])


def installed_engine() -> str:
    """Return `chosen_engine`; raise MissingDependency if it is not installed."""
    if find_spec(engine := chosen_engine()) is None:
        raise MissingDependency(
            f"fusing needs {engine}, which is not installed here or has no build for this platform: "
            "pip install '.[server]' in your clone of tsfusion, or send keyframes to another machine's server"
        )
    return engine


def without_flags(*kept: str) -> dict[str, str]:
    """Return this process's environment without variables that set flags; those of `kept` stay."""
    names = {name for name in os.environ if not name.startswith("TSFUSION_")} | {"TSFUSION_ENGINE", *kept}
    return {name: value for name, value in os.environ.items() if name in names}


def version_of(package: str) -> str:
    """Return the version of a package, or `missing`; tsfusion also runs from its sources."""
    if package == "tsfusion":
        return tsfusion.__version__
    from importlib import metadata

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "missing"
