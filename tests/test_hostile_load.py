# SPDX-License-Identifier: MIT
"""A server under attack lives, keeps its memory bound, fuses what others send. Long: `scripts/hostile.py`."""

from pathlib import Path

import pytest
from hostile_run import run, table


def test_attacks_harm_nobody(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outcome = run(tmp_path, seconds=1.0)
    with capsys.disabled():
        print(f"\n{table(outcome)}")
    assert not outcome.problems, outcome
