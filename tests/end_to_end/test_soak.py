# SPDX-License-Identifier: MIT
"""Nothing grows once the map has stopped to. The long form: `scripts/soak.py`."""

from pathlib import Path

import pytest
from soak_run import run


@pytest.mark.parametrize("keyframes", [800, pytest.param(3000, marks=pytest.mark.nightly)])
def test_files_and_threads_stay_and_memory_is_flat(tmp_path: Path, keyframes: int) -> None:
    outcome = run(tmp_path, keyframes=keyframes)
    assert not outcome.problems, outcome
