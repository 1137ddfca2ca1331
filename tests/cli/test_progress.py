# SPDX-License-Identifier: MIT
"""Progress of a run: the same counts as a table on a terminal, as plain lines elsewhere, or not at all."""

import io
import logging
import os
import pty
import re
import subprocess
import sys

import pytest
from command_processes import environment
from msgspec import structs
from rich.console import Console

from tsfusion.cli import progress
from tsfusion.client import ClientStats
from tsfusion.core import limits
from tsfusion.scanner.scanner import ScanState
from tsfusion.wire.messages.messages import explained

STATS = ClientStats(
    sent=9, durable=8, fused=7, refused={}, rejected={"quota": 1}, skipped={}, waiting=1, waiting_bytes=5000,
    state="ok",
)  # fmt: skip
LOST = ScanState(
    state="lost", why="no texture", frames=30, tracked=20, lost=10, submap="default", submaps=1,
    selected={"first": 1, "distance": 8}, loops=2, stats=STATS, link="", keyframe_delay_ms=41.0,
)  # fmt: skip


GOING = structs.replace(STATS, sent=30, durable=30, fused=29, rejected={}, waiting=0, waiting_bytes=0)
BEHIND = structs.replace(GOING, sent=41, durable=33, waiting=8, waiting_bytes=1_200_000)
WELL = structs.replace(LOST, state="tracking", why="", loops=0, stats=GOING)


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every update is shown."""
    monkeypatch.setattr(progress, "_LINE_INTERVAL", 0.0)


class Clock:
    """A clock that moves when it is told to."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in (progress, limits):
        monkeypatch.setattr(module, "time", clock)
    return clock


def drawn(screen: progress.Screen, width: int, *, color: bool = False, trouble: str = "") -> list[str]:
    """The lines of a terminal that shows this."""
    console = Console(
        width=width, force_terminal=True, color_system="truecolor", no_color=not color, highlight=False,
        file=io.StringIO(),
    )  # fmt: skip
    console.print(screen.table(width, trouble=trouble))
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def words_of(lines: list[str]) -> list[str]:
    """The same without colours and columns."""
    return [" ".join(re.sub(r"\x1b\[[0-9;]*m", "", line).split()) for line in lines]


@pytest.mark.usefixtures("eager")
def test_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.shown(quiet=False) as display:
        display.stage("scanning the room")
        display.update(60, GOING)
        display.update(60, STATS, scan=LOST)
        display.update(None, STATS, scan=LOST, link="the server is gone")
    stage, replay, scan, endless = capsys.readouterr().err.splitlines()
    assert stage == "scanning the room …"
    assert replay == ("✓ working · keeping up · lost 0 keyframes; sent 30 of 60; fused 29 of 60; waiting 1")
    assert scan == (
        "✗ sensor lost · keeping up · lost 1 keyframe; frames 30 of 60; keyframes 9; fused 7, delay 41 ms; "
        "waiting 1, 1 to send, 5 kB; sensor lost: no texture; 2 loops closed; lost 1 × quota"
    )
    assert "; frames 30; " in endless
    assert endless.endswith("; server the server is gone")


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("width", [80, 120])
def test_a_table_answers_in_its_first_line_and_fits(width: int, color: bool, clock: Clock) -> None:
    run = progress.RunProgress()
    run.screen(2500, structs.replace(GOING, sent=20, durable=20, fused=19), "", None)
    clock.now += 2.0
    replay = drawn(run.screen(2500, GOING, "", None), width, color=color)
    clock.now += 2.0
    behind = drawn(run.screen(2500, BEHIND, "", None), width, color=color)
    lost = drawn(run.screen(2500, STATS, "", LOST), width, color=color)
    assert words_of(replay)[0] == "✓ working · keeping up · lost 0 keyframes"
    assert words_of(behind)[0] == "! working · behind by 12 keyframes, about 5 s · lost 0 keyframes"
    assert words_of(lost)[0] == "✗ sensor lost · keeping up · lost 1 keyframe"
    for lines in (replay, behind, lost):
        plain = [re.sub(r"\x1b\[[0-9;]*m", "", line).rstrip() for line in lines]
        assert max(map(len, plain)) <= width
        assert len(plain) <= 8
    assert ("\x1b[32m" in replay[0]) == color
    assert words_of(replay)[1].startswith("sent 30 of 2500 5.0/s")
    assert words_of(replay)[2].startswith("fused 29 of 2500 5.0/s 8 min left")
    assert words_of(lost)[-2:] == ["sensor lost: no texture; 2 loops closed", "lost 1 × quota"]


def test_columns_stay_while_figures_grow(clock: Clock) -> None:
    run = progress.RunProgress()
    ends = set()
    for sent in (1, 9, 80, 700, 6000):
        clock.now += 1.0
        counts = structs.replace(GOING, sent=sent, durable=sent, fused=sent)
        ends.add(drawn(run.screen(9000, counts, "", None), 80)[1].index("of 9000"))
    assert len(ends) == 1


def test_what_stands_still_is_said(clock: Clock) -> None:
    run = progress.RunProgress()
    run.screen(60, GOING, "", None)
    clock.now += 7.0
    assert str(run.screen(60, GOING, "", None).headline) == (
        "✗ nothing fused for 7 s · keeping up · lost 0 keyframes"
    )
    moved = structs.replace(GOING, fused=30)
    assert str(run.screen(60, moved, "", None).headline).startswith("✓ working")
    clock.now += 70.0
    assert str(run.screen(60, moved, "", None).headline).startswith("✓ working"), "nothing waits"
    silent = drawn(run.screen(60, moved, "", WELL), 80, trouble="nothing came for 6 s")
    assert words_of(silent)[0].startswith("✗ nothing came for 6 s · keeping up")
    held = run.screen(60, moved, "the disk is full\x1b[2J", None)
    assert str(held.headline).startswith("✗ the server takes nothing · ")
    assert words_of(drawn(held, 80))[-1] == "server the disk is full\\x1b[2J"


@pytest.mark.usefixtures("eager")
def test_bytes_are_read_in_lines_too(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.reading("checking a journal", quiet=False) as watch:
        watch(1_500_000, 3_000_000)
    assert capsys.readouterr().err == "  checking a journal 1.5 MB of 3 MB\n"


@pytest.mark.usefixtures("eager")
def test_a_journal_is_fused_in_lines_too(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.shown(quiet=False) as display:
        display.show_fused(30, 29, 60)
    assert capsys.readouterr().err == "  read 30 of 60; fused 29\n"


@pytest.mark.usefixtures("eager")
def test_keyframes_are_not_counted_on_from_bytes(capsys: pytest.CaptureFixture[str], clock: Clock) -> None:
    with progress.shown(quiet=False) as display:
        for name in ("one journal", "the next"):
            for done in (0, 3_000_000):
                clock.now += 2
                display.show_bytes(f"listing {name}", done, 3_000_000)
        display.show_fused(0, 0, 60)
        clock.now += 2
        display.show_fused(30, 28, 60)
    shown = capsys.readouterr().err
    assert "-" not in shown
    assert shown.splitlines()[-1] == "  read 30 of 60, 15.0/s, 2 s left; fused 28, 14.0/s"


def test_quiet_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.shown(quiet=True) as display:
        display.stage("scanning the room")
        display.update(10, GOING)
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
        "import time; from tsfusion.cli import progress\n"
        "with progress.shown(quiet=False) as display:\n"
        "    display.stage('scanning the room'); display.show_steps('shots', 3, 10); time.sleep(1)\n"
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
