# SPDX-License-Identifier: MIT
"""Progress of a run: the same counts as a table on a terminal, as plain lines elsewhere, or not at all."""

import logging
import os
import pty
import subprocess
import sys

import pytest
from command_processes import environment

from tsfusion.cli import progress
from tsfusion.cli.run_summary import explained
from tsfusion.client import ClientStats
from tsfusion.scanner.scanner import ScanState

STATS = ClientStats(
    sent=9, durable=8, fused=7, refused={}, rejected={"quota": 1}, skipped={}, waiting=1, waiting_bytes=5000,
    state="ok",
)  # fmt: skip
LOST = ScanState(
    state="lost", why="no texture", frames=30, tracked=20, lost=10, submap="default", submaps=1,
    selected={"first": 1, "distance": 8}, loops=2, stats=STATS, link="", keyframe_delay_ms=41.0,
)  # fmt: skip


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every update is shown."""
    monkeypatch.setattr(progress, "_LINE_INTERVAL", 0.0)
    monkeypatch.setattr(progress, "_DRAW_INTERVAL", 0.0)


@pytest.mark.usefixtures("eager")
def test_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.shown(quiet=False) as display:
        display.stage("scanning the room")
        display.update(3, 2, 10)
        display.update(30, 7, 60, LOST)
        display.update(30, 7, None, LOST)
    stage, replay, scan, endless = capsys.readouterr().err.splitlines()
    assert stage == "scanning the room …"
    assert replay == "  keyframes 3 of 10, 0.0/s; fused 2 of 10, 0.0/s"
    words = scan.strip().split("; ")
    assert words[:2] == ["sensor lost: no texture", "2 loops closed"]
    assert words[2].startswith("frames 30 of 60, ")
    assert words[4:6] == ["to send 1 (5 kB)", "server 8 acknowledged, 7 fused, delay 41 ms"]
    assert words[6:] == ["left out 1 × quota"]
    assert "frames 30, " in endless


@pytest.mark.usefixtures("eager")
def test_bytes_are_read_in_lines_too(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.reading("checking a journal", quiet=False) as watch:
        watch(1_500_000, 3_000_000)
    assert capsys.readouterr().err == "  checking a journal 1.5 MB of 3 MB, 0 B/s\n"


def test_quiet_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.shown(quiet=True) as display:
        display.stage("scanning the room")
        display.update(3, 2, 10)
    with progress.reading("checking a journal", quiet=True) as watch:
        watch(1, 2)
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("eager")
def test_warnings_stand_above_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.Table():
        logging.getLogger("tsfusion.scanner.scanner").warning("lost [at %s]\x1b[2J", "sea")
        logging.getLogger("tsfusion.scanner.scanner").info("nothing")
    assert capsys.readouterr().err.strip() == "lost [at sea]\\x1b[2J"
    assert not logging.getLogger("tsfusion").handlers


def test_a_terminal_gets_bars_that_go_away() -> None:
    program = (
        "from tsfusion.cli import progress; progress._DRAW_INTERVAL = 0\n"
        "with progress.shown(quiet=False) as display:\n"
        "    display.stage('scanning the room'); display.update(3, 2, 10); display.update(10, 9, 10)\n"
        "print('the end')\n"
    )
    leader, follower = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=follower, stdout=follower, stderr=follower,
        env={**environment(), "TERM": "xterm", "COLUMNS": "100"},
    )  # fmt: skip
    os.close(follower)
    text = ""
    try:
        while "the end" not in text:
            text += os.read(leader, 65536).decode(errors="replace")
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()
        os.close(leader)
    assert "› scanning the room" in text.replace("\x1b[36m", "").replace("\x1b[0m", "")
    assert "3 of 10" in text
    assert "━" in text
    assert text.rindex("\x1b[2K") > text.rindex("━"), "the table was wiped at the end"


def test_a_summary_says_why_keyframes_are_not_in_the_map() -> None:
    told = explained({"thinned": 22, "MapFull": 3, "spool": 0})
    assert told == "22 × thinned (the map was too far behind); 3 × MapFull"
