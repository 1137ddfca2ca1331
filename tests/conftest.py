# SPDX-License-Identifier: MIT
"""Fixtures shared by all tests."""

import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tsfusion.core import logs

os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # programs that tests start find what tests find
DATA = Path(os.environ.get("TSFUSION_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(autouse=True)
def logging_as_it_was() -> Iterator[None]:
    """A command that runs in this process logs to a stderr that is gone afterwards."""
    level, hook = logging.getLogger("tsfusion").level, sys.excepthook
    yield
    for handler in logging.root.handlers[:]:
        if isinstance(handler, logs.Stderr):
            handler.close()
            logging.root.removeHandler(handler)
    logging.getLogger("tsfusion").setLevel(level)
    sys.excepthook = hook


@pytest.fixture(scope="session")
def data() -> Callable[[str], Path]:
    """`data("7scenes/redkitchen")`: a folder of real sensor data, or a skip that says what is missing."""

    def find(name: str) -> Path:
        folder = DATA / name
        if not folder.exists():
            pytest.skip(f"no {name} in {DATA}: set TSFUSION_DATA to the folder of recorded datasets")
        return folder

    return find


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Mounts a file system of so many MiB; its folder."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def mount(mib: int) -> Path:
        if os.geteuid():
            pytest.skip("mounting a small file system takes root")
        command = ["mount", "-t", "tmpfs", "-o", f"size={mib}m", "none", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"no small file system can be mounted here: {done.stderr.strip()}")
        return folder

    yield mount
    if os.path.ismount(folder):
        subprocess.run(["umount", "-l", folder], check=True)
