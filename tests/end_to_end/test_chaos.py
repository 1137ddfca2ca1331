# SPDX-License-Identifier: MIT
"""No keyframe is lost when processes are killed and the network is bad. Long: lab/reliability/chaos.py."""

from pathlib import Path

import pytest
from quick_fusers import SUMS

from lab.reliability.chaos_run import run


@pytest.mark.parametrize(
    ("seed", "keyframes", "kills", "fuser"),
    [(2, 40, 3, SUMS), *(pytest.param(seed, 150, 8, None, marks=pytest.mark.nightly) for seed in range(4))],
)
def test_killed_again_and_again_nothing_is_lost(
    tmp_path: Path, seed: int, keyframes: int, kills: int, fuser: tuple[str, ...] | None
) -> None:
    result = run(seed, tmp_path, keyframes=keyframes, kills=kills, fuser=fuser)
    assert not result.problems, result
    assert sum(result.kills.values()) >= kills - 2, result
