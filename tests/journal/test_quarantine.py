# SPDX-License-Identifier: MIT
"""The quarantine keeps to its limits, the newest keyframes stay."""

import os
from pathlib import Path

import pytest

from tsfusion.journal import quarantine
from tsfusion.journal.quarantine import Quarantine

SESSION = bytes(range(16))


def test_the_quarantine_keeps_to_its_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quarantine, "_MAX_FILES", 5)

    def keep(kept: Quarantine, seq: int, size: int = 100) -> Path:
        path = kept.keep([bytes(size)], session=SESSION, seq=seq, reason="crc")
        assert path is not None
        os.utime(path, ns=(seq, seq))
        return path

    def seqs() -> list[int]:
        return sorted(int(path.name.split("-")[1]) for path in tmp_path.glob("*.mcap"))

    kept = Quarantine(tmp_path, 1 << 20)
    for seq in range(1, 9):
        keep(kept, seq)
    assert (len(kept), seqs()) == (5, [4, 5, 6, 7, 8])
    keep(kept, 4)  # again: now it is the newest
    os.utime(keep(kept, 4), ns=(9, 9))
    assert len(kept) == 5
    kept = Quarantine(tmp_path, 1 << 20)  # as a new process finds it
    assert len(kept) == 5
    keep(kept, 10)
    assert seqs() == [4, 6, 7, 8, 10]
    keep(kept, 11, (1 << 20) - 1000)
    assert seqs()[-1] == 11
    keep(kept, 12, 2 << 20)  # the newest stays, whatever its size
    assert (len(kept), seqs()) == (1, [12])


def test_the_quarantine_does_not_look_at_every_file_for_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Quarantine(tmp_path, 1 << 20)
    monkeypatch.setattr(Path, "glob", None)
    assert kept.keep([b"x"], session=SESSION, seq=1, reason="crc") is not None
    assert len(kept) == 1
