# SPDX-License-Identifier: MIT
"""No test waits for ever: nor where SIGINT is ignored, nor in C code, nor behind a thread."""

import os
import sys
from pathlib import Path

import pytest
from command_processes import python
from repository import TESTS

# As a shell starts a job in the background.
RUN = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
os.execv(sys.executable, [sys.executable, "-m", "pytest", *sys.argv[1:]])
"""
CTRL_C = """
import os, signal, subprocess, sys, pytest

def test_ctrl_c():
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        signal.pause()

def test_ctrl_c_of_a_child():
    command = [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGINT)"]
    assert subprocess.run(command, stderr=subprocess.DEVNULL).returncode == -signal.SIGINT
"""
STUCK_IN_C = """
import ctypes

def test_stuck():
    mutex, lock = ctypes.create_string_buffer(64), ctypes.PyDLL(None).pthread_mutex_lock
    lock(mutex)
    lock(mutex)  # no signal ends that
"""


@pytest.mark.parametrize(
    ("tests", "status", "said"),
    [(CTRL_C, 0, "2 passed"), (STUCK_IN_C, 1, "in test_stuck")],
    ids=["ctrl-c", "stuck in C"],
)
def test_a_run_in_the_background_ends(tmp_path: Path, tests: str, status: int, said: str) -> None:
    (tmp_path / "test_it.py").write_text(tests)
    paths = {"PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path])}
    done = python(
        RUN, "-p", "conftest", "-p", "no:cacheprovider", "--timeout", "1", tmp_path,
        cwd=tmp_path, env={**os.environ, **paths},
    )  # fmt: skip
    assert said in done.stdout + done.stderr
    assert done.returncode == status
