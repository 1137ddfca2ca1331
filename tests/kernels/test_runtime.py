# SPDX-License-Identifier: MIT
"""The engine as a server meets it: without a desktop, and with nobody told of it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_processes import python, tsfusion

from tsfusion.kernels import CACHE_VARIABLE, ENGINE
from tsfusion.kernels.base import runtime

_STARTS = """
import os, threading
from tsfusion.core.errors import MissingDependency
try:
    from tsfusion.kernels import ENGINE
except MissingDependency as error:
    raise SystemExit(str(error))
if ENGINE == "taichi":
    from taichi import _version_check
    _version_check.try_check_version = lambda: os.write(1, b"would tell its makers\\n")
from tsfusion.kernels.base import runtime
runtime.start(1)
for thread in threading.enumerate():
    if thread is not threading.main_thread():
        thread.join(5)
print("started")
"""


def run(**environment: str) -> "subprocess.CompletedProcess[str]":
    """Start Taichi in a process of its own."""
    return python(_STARTS, env={**os.environ, **environment})


TAICHI_ALONE = pytest.mark.skipif(ENGINE != "taichi", reason="taichi alone does so")


@TAICHI_ALONE
def test_nobody_is_told_that_it_runs() -> None:
    assert run().stdout == "started\n"
    told = run(TI_SKIP_VERSION_CHECK="OFF").stdout
    assert told == "would tell its makers\nstarted\n", "else this tests nothing"


@TAICHI_ALONE
@pytest.mark.skipif(sys.platform != "linux", reason="libX11 is asked for on Linux")
def test_a_missing_library_of_the_system_is_named(tmp_path: Path) -> None:
    (tmp_path / "libX11.so.6").touch()
    done = run(LD_LIBRARY_PATH=str(tmp_path))
    assert done.returncode == 1
    assert "taichi does not load" in done.stderr
    assert "libX11.so.6" in done.stderr
    assert "install libx11-6" in done.stderr


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a system without cores of one's own")
def test_threads_of_kernels_have_a_core_each() -> None:
    """Else two that are woken together often share one: at 2 cm two threads took longer than one."""
    program = """
import os, time
import numpy as np
from tsfusion import Volume
from tsfusion.core import process
ours = process.cores()
volume = Volume(0.05, threads=len(ours))
depth = np.full((480, 640), 2000, np.uint16)
def integrate():
    volume.integrate(depth=depth, intrinsics=(500, 500, 320, 240), T_world_camera=np.eye(4), sensor="kinect")
integrate()  # threads of the compiler are busy for the first time
before = {thread: cpu_ns(thread) for thread in os.listdir("/proc/self/task")}
for _ in range(20):
    integrate()
busy = sorted(before, key=lambda thread: cpu_ns(thread) - before[thread])
workers = [int(thread) for thread in busy if int(thread) != os.getpid()][-len(ours):]
print(sorted(map(sorted, map(os.sched_getaffinity, workers))) == [[core] for core in ours])
"""
    reads = "def cpu_ns(thread): return int(open(f'/proc/self/task/{thread}/schedstat').read().split()[0])\n"
    assert python(reads + program).stdout == "True\n"


@pytest.mark.parametrize("name", ["HOME", pytest.param(CACHE_VARIABLE, marks=pytest.mark.nightly)])
def test_a_home_that_cannot_be_written_is_done_without(name: str, tmp_path: Path) -> None:
    """Taichi makes its folder of compiled kernels when the process ends: that was a segmentation fault."""
    (tmp_path / "file").touch()
    other = tmp_path / f"tsfusion-kernels-{os.getuid()}"
    program = (
        "import numpy as np\n"
        "from tsfusion.kernels.base import runtime\n"
        "from tsfusion.kernels.answers.point_sampling import pair\n"
        "runtime.start(1)\n"
        "sums, values = np.zeros((1, 512), np.int64), np.zeros((1, 512), np.float32)\n"
        "pair(np.zeros(1, np.int32), sums, values, sums.copy())\n"
    )
    usual = {name: one for name, one in os.environ.items() if name not in ("XDG_CACHE_HOME", "HOME")}
    usual["TMPDIR"] = str(tmp_path)
    done = python(program, env={**usual, "HOME": str(tmp_path), name: str(tmp_path / "file")})
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(other.rglob("*.t*" if ENGINE == "taichi" else "*.q*"))
    assert not (tmp_path / ".cache").exists() or name != "HOME"
    other.chmod(0o777)  # others might have put kernels there
    done = python(
        "from tsfusion.kernels.base.runtime import kept_in; print(kept_in()[0])",
        env={**usual, "HOME": os.devnull},
    )
    assert done.stdout.startswith(f"{tmp_path}/tsfusion-kernels-")
    assert done.stdout.strip() != str(other)


def test_doctor_says_where_compiled_kernels_are_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    done = tsfusion("doctor")
    (line,) = (line for line in done.stdout.splitlines() if " runs; " in line)
    assert f"kept in {tmp_path}/tsfusion-kernels-" in line
    assert f"as {os.devnull}/" in line
    assert "set XDG_CACHE_HOME" in line


def test_kernels_of_this_engine_load_and_launch_fast() -> None:
    """An update of an engine keeps its private parts elsewhere, perhaps: then this test says so."""
    runs = (
        "import numpy as np\n"
        "from tsfusion.kernels.base import runtime\n"
        "from tsfusion.kernels.base.quick_launch import QuickLaunch\n"
        "from tsfusion.kernels.answers.point_sampling import pair\n"
        "runtime.start(1)\n"
        "sums, values = np.zeros((1, 512), np.int64), np.zeros((1, 512), np.float32)\n"
        "pair(np.zeros(1, np.int32), sums, values, sums.copy())\n"
        "print(runtime.load_fast(), QuickLaunch.is_active)\n"
    )
    assert python(runs).stdout == "True True\n"


def test_another_version_of_the_engine_loads_as_slowly_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    def moved(_name: str) -> object:
        raise ImportError

    monkeypatch.setattr(runtime, "import_module", moved)
    assert not runtime.load_fast.__wrapped__()


_WITHOUT_ROOM = """
import resource
from tsfusion.kernels.base import runtime
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, -1))
try:
    runtime.start(1)
except MemoryError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux keeps to this limit")
def test_too_little_address_space_is_one_clear_error() -> None:
    assert re.fullmatch(r"kernels cannot start: .*allocat.*failed\.", python(_WITHOUT_ROOM).stdout.strip())
