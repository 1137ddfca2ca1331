# SPDX-License-Identifier: MIT
"""Kills and a full disk lose nothing, and nothing grows afterwards. Long: lab/reliability/soak.py."""

from pathlib import Path

import pytest

from lab.reliability.soak_run import run


@pytest.mark.parametrize("keyframes", [500, pytest.param(5000, marks=pytest.mark.nightly)])
def test_nothing_is_lost_and_nothing_grows(tmp_path: Path, keyframes: int) -> None:
    outcome = run(tmp_path, keyframes=keyframes)
    assert not outcome.problems, outcome
