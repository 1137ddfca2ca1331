# SPDX-License-Identifier: MIT
"""Versions are told wherever tsfusion runs, also from its sources, where it is not installed."""

import os
import subprocess
from importlib import metadata
from pathlib import Path

import pytest
from command_processes import QUICK_RUN
from repository import SUPPORT

import tsfusion
from tsfusion.core.process import version_of

SOURCES = Path(tsfusion.__file__).parents[1]
# Of its own package a process finds no metadata then.
NOT_INSTALLED = """
from importlib import metadata
found = metadata.distribution
def distribution(name):
    if name == "tsfusion":
        raise metadata.PackageNotFoundError(name)
    return found(name)
metadata.distribution = distribution
"""


def test_versions_are_those_installed() -> None:
    assert version_of("numpy") == metadata.version("numpy")
    assert version_of("tsfusion") == metadata.version("tsfusion") == tsfusion.__version__
    assert version_of("no-such-package") == "missing"


@pytest.mark.timeout(180)
def test_a_run_needs_no_installed_package(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(NOT_INSTALLED)
    done = subprocess.run(
        [*QUICK_RUN, "demo", "--count", "3", "--out", "demo"],
        check=False,
        capture_output=True,
        text=True,
        timeout=150,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(SOURCES), str(SUPPORT)])},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3/3" in done.stdout + done.stderr
