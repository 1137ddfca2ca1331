# SPDX-License-Identifier: MIT
"""Nothing grows once the map has stopped to. The long form: `scripts/soak.py`."""

from pathlib import Path

from soak_run import run


def test_files_and_threads_stay_and_memory_is_flat(tmp_path: Path) -> None:
    outcome = run(tmp_path, keyframes=600)
    assert not outcome.problems, outcome
