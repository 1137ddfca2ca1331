# SPDX-License-Identifier: MIT
"""A server under attack lives, keeps to its memory, fuses other scans. Long: lab/reliability/hostile.py."""

from pathlib import Path

import pytest

from lab.reliability.attack_target import ACCESS, Access
from lab.reliability.attacks import ATTACKS_OF
from lab.reliability.hostile_run import Bounds, run, table
from tsfusion.core import process
from tsfusion.gateway.ports.connection_limits import MemoryGuard


def test_memory_that_does_not_come_back_is_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reported again, it would drop every connection for ever."""
    held = 0
    monkeypatch.setattr(process, "rss_bytes", lambda: held)
    bound = MemoryGuard(800)
    reported = []
    for held in (700, 800, 850, 900, 950, 960, 980, 1080, 1090, 400, 790, 810):  # noqa: B007
        reported.append(bound.excess(uncounted=0))
    assert reported == [0, 0, 850, 0, 0, 960, 0, 1080, 0, 0, 0, 810]
    assert bound.excess(uncounted=100) == 0


def test_memory_that_was_freed_counts_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    held = [900]
    monkeypatch.setattr(process, "rss_bytes", lambda: held[0])
    monkeypatch.setattr(process, "give_back_memory", lambda: held.__setitem__(0, 500))
    assert MemoryGuard(800).excess(uncounted=0) == 0


LOADED = Bounds(delay_s=10.0, control_s=10.0, slack_bytes=128 << 20)  # a machine that does other things, too


SOME = (  # of each port and each bound one; the bounds of the others have tests of their own
    "bombs", "lies", "rubbish", "corrections", "greetings", "mesh flood", "unfinished", "empty frames",
    "half open", "deaf viewers", "replays", "cameras", "odd questions", "forgetting", "fill",
)  # fmt: skip


@pytest.mark.parametrize(
    ("access", "seconds", "attacks"),
    [
        ("open", 0.1, SOME),
        *(
            pytest.param(access, seconds, ATTACKS_OF[access], marks=pytest.mark.nightly)
            for access in ACCESS
            for seconds in (0.1, 3.0)
        ),
    ],
)
def test_attacks_harm_nobody(
    tmp_path: Path, access: Access, seconds: float, attacks: tuple[str, ...]
) -> None:
    outcome = run(tmp_path, seconds, attacks, access=access, bounds=LOADED)
    assert not outcome.problems, f"{outcome.problems}\n{table(outcome)}"
