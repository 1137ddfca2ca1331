# SPDX-License-Identifier: MIT
"""Every command of the laboratory starts, from any folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from repository import ROOT

FILES = sorted((ROOT / "lab").rglob("*.py"))
COMMANDS = [path for path in FILES if "ArgumentParser(" in path.read_text(encoding="utf-8")]


@pytest.mark.nightly
@pytest.mark.parametrize("path", COMMANDS, ids=lambda path: path.stem)
def test_a_command_says_how_it_is_used(path: Path, tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, str(path), "--help"], cwd=tmp_path, env=environment, capture_output=True, text=True,
        timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"usage: {path.name}")


def test_there_are_commands() -> None:
    assert len(COMMANDS) >= 25
