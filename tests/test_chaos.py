# SPDX-License-Identifier: MIT
"""Everything is killed, the link is cut and throttled, and no keyframe is lost. `scripts/chaos.py` is the long form."""

from pathlib import Path

from chaos_run import run


def test_killed_again_and_again_nothing_is_lost(tmp_path: Path) -> None:
    result = run(1, tmp_path, keyframes=100, kills=6, mean_gap=0.8)
    assert not result.problems, result
    assert sum(result.kills.values()) >= 4, result
