# SPDX-License-Identifier: MIT
"""Python with a small disk of its own, which really fills up."""

import subprocess
import sys
from pathlib import Path

import pytest

_MOUNT = 'mount -t tmpfs -o "size=$1" none "$2" && shift 2 && exec "$@"'


def run(folder: Path, size: str, code: str) -> str:
    """Run `code` where a file system of `size` is mounted at `folder`, its only argument; what it prints.

    Skip the test where that is not allowed.
    """
    folder.mkdir(exist_ok=True)
    shell = ["unshare", "--mount", "sh", "-c", _MOUNT, "sh", size, str(folder)]
    try:
        allowed = subprocess.run([*shell, "true"], capture_output=True, timeout=30, check=False)
    except FileNotFoundError:
        pytest.skip("a disk of one's own needs unshare")
    if allowed.returncode:
        pytest.skip(f"a disk of one's own needs more rights: {allowed.stderr.decode().strip()}")
    done = subprocess.run(
        [*shell, sys.executable, "-c", code, str(folder)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout
