# SPDX-License-Identifier: MIT
"""Taichi as a server meets it: without a desktop, and with nobody told of it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

_STARTS = """
import os, threading
from tsfusion.core.errors import MissingDependency
try:
    from tsfusion.kernels import taichi
except MissingDependency as error:
    raise SystemExit(str(error))
from taichi import _version_check
_version_check.try_check_version = lambda: os.write(1, b"would tell its makers\\n")
from tsfusion.kernels import runtime
runtime.start(1)
for thread in threading.enumerate():
    if thread is not threading.main_thread():
        thread.join(5)
print("started")
"""


def run(**environment: str) -> "subprocess.CompletedProcess[str]":
    """Start Taichi in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", _STARTS], capture_output=True, text=True, timeout=120, check=False,
        env={**os.environ, **environment},
    )  # fmt: skip


def test_nobody_is_told_that_it_runs() -> None:
    assert run().stdout == "started\n"
    assert run(TI_SKIP_VERSION_CHECK="OFF").stdout == "would tell its makers\nstarted\n", (
        "else this tests nothing"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="libX11 is asked for on Linux")
def test_a_missing_library_of_the_system_is_named(tmp_path: Path) -> None:
    (tmp_path / "libX11.so.6").touch()
    done = run(LD_LIBRARY_PATH=str(tmp_path))
    assert done.returncode == 1
    assert "taichi does not load" in done.stderr
    assert "libX11.so.6" in done.stderr
    assert "install libx11-6" in done.stderr
