# SPDX-License-Identifier: MIT
"""Everything is killed, the link is spoiled, no keyframe is lost. The long form: `scripts/chaos.py`."""

from pathlib import Path

from chaos_run import run


def test_killed_again_and_again_nothing_is_lost(tmp_path: Path) -> None:
    result = run(2, tmp_path, keyframes=100, kills=6)
    assert not result.problems, result
    assert sum(result.kills.values()) >= 4, result
