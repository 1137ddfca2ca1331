# SPDX-License-Identifier: MIT
"""Kills and a full disk lose nothing, and nothing grows afterwards. Long: lab/reliability/soak.py."""

from pathlib import Path

import pytest

from lab.reliability.soak_run import run


@pytest.mark.parametrize(
    ("keyframes", "kills"), [(500, 1), *(pytest.param(n, 3, marks=pytest.mark.nightly) for n in (500, 5000))]
)
def test_nothing_is_lost_and_nothing_grows(tmp_path: Path, keyframes: int, kills: int) -> None:
    outcome = run(tmp_path, keyframes=keyframes, kills=kills)
    assert not outcome.problems, outcome
