# SPDX-License-Identifier: MIT
"""`tsfusion status`: what it shows, and the exit status that tells a health check."""

import json
import os
import pty
import re
import signal
import subprocess
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from command_processes import COMMAND, DEADLINE, Here, end, environment, read_until, started, tsfusion
from fake_server import saying, serving, status
from health_snapshots import client, health, map_health
from rich.console import Console

from tsfusion.cli import status_view
from tsfusion.cli.health_poll import READY, ServerWatcher
from tsfusion.cli.health_poll import ServerSnapshot as Seen
from tsfusion.cli.status_view import MAX_CLIENTS, render
from tsfusion.core.errors import TransportError
from tsfusion.wire.messages.health import Health, Spread
from tsfusion.wire.messages.messages import Command, Reply

NOBODY = "tcp://127.0.0.1:9"


def screen(told: Health | None, width: int = 160, *, color: bool = False, **fields: Any) -> str:
    """The screen that shows this health, as text."""
    snapshot = Seen(address="tcp://host:5555", health=told, **fields)
    console = Console(
        width=width, highlight=False, force_terminal=color, color_system="standard" if color else None
    )
    with console.capture() as captured:
        console.print(render(snapshot, width))
    return captured.get()


@pytest.fixture
def asking(here: Here) -> Here:
    """The command, asking at a control address."""
    return lambda control, *more: here("status", "--connect", NOBODY, "--control", control, *more)


def test_a_screen_shows_corrections_where_there_are_any() -> None:
    told = health(client("cart", corrections=3), client("drone"))
    text = screen(told)
    assert "3 × corrected" in next(line for line in text.splitlines() if line.startswith("cart"))
    assert text.count("corrected") == 1


def test_a_screen_shows_it_all() -> None:
    yard = map_health(
        state="busy", keyframes_durable=1204, keyframes_fused=1191, waiting=12, fuser_restarts=2,
        rejected={"MapFull": 1},
    )  # fmt: skip
    told = health(
        client("cart", waiting=12, skipped={"thinned": 31}, held="disk", map="yard"),
        client("", heard_s=7.5, state="silent", refused=2, rejected=1),
        client("drone", heard_s=190.0, state="gone"),
        ready=False, problems=("map yard: the disk is full",), refused={"gap": 3, "header": 1}, duplicates=9,
        maps={"yard": yard, "shed": map_health(state="restarting", last_keyframe_s=None, rejected={})},
    )  # fmt: skip
    more = {"maps": {"yard": status(map="yard")}, "unavailable": {"shed": "the fuser restarts; ask again"}}
    for width in (80, 120, 160):
        text = screen(told, width, rate=3.0, **more)
        lines = [" ".join(line.split()) for line in text.splitlines()]
        assert lines[:2] == [
            "✗ not ready · behind by 24 keyframes, about 8 s · lost 34 keyframes",
            "✗ map yard: the disk is full",
        ]
        assert "tcp://host:5555 not ready up 62 min, gateway 62.9 MB, 9 duplicates" in lines
        if width == 80:
            assert "map state fused/all waiting lost ms, p95 MB ago" in lines
            assert "yard busy 1191/1204 12 1 28 10.5 2 s" in lines
            assert "shed restarting 5/6 0 0 28 10.5 –" in lines
            assert "cart yard connected 6/6 12 31 31 × thinned; held: disk" in lines
            assert "drone default gone 3 min 6/6 0 0" in lines
            assert "1a2b3c4d default silent 8 s 6/6 0 2 2 × refused, 1 ×" in lines
        else:
            assert "map state fused/all waiting lost mean/p95/max MB of 8³ MB ago" in lines
            assert "yard busy 1191/1204 12 1 21/28/61 ±0.5 10.5 1234 3.1 2 s" in lines
            assert "shed restarting 5/6 0 0 21/28/61 ±0.5 10.5 1234 3.1 –" in lines
            assert "cart 1a2b3c4d yard connected 6/6 12 31 3.1 31 × thinned; held: disk" in lines
            assert "- 1a2b3c4d default silent 8 s 6/6 0 2 3.1 2 × refused, 1 × rejected" in lines
        assert "refused messages: 3 × gap, 1 × header" in lines
        assert f"yard 0.04 m kinect 2 B {'1f' * 16}" in [line.split(" state/")[0] for line in lines]
    assert "map yard: 1 quarantined, 2 × the fuser restarted, rejected: 1 × MapFull" in text
    assert "map shed: hash and settings are not known now: the fuser restarts; ask again" in text


def test_a_screen_says_what_corrections_have_to_move() -> None:
    text = screen(health(maps={"default": map_health(corrections_waiting=31, corrections_unavailable=2)}))
    assert "31 keyframes still to be moved to corrected poses, 2 corrected keyframes that cannot be" in text


def test_a_screen_says_how_questions_are_answered() -> None:
    took = Spread(count=7, p50=1.25, p95=8.0, max=21.0)
    asked = map_health(rejected={}, quarantined=0, questions={"answered": 7, "late": 1}, question_ms=took)
    text = screen(health(maps={"default": asked}))
    assert "questions 7 × answered, 1 × late, answered in 1.2 ms (p95 8.0, at most 21.0)" in text


def test_a_server_that_is_well_says_little() -> None:
    text = screen(health(maps={"default": map_health(rejected={}, quarantined=0)}))
    assert "ready" in text
    assert not any(word in text for word in ("✗", "refused", "client", "duplicates", "quarantined", "not"))


def test_nothing_that_peers_say_commands_the_terminal() -> None:
    evil = "\x1b[2J[red]\n\x07\u202e"
    told = health(
        client("x", skipped={evil: 1}, held=evil), problems=(evil,), refused={evil: 1},
        maps={"default": map_health(problem=evil, rejected={evil: 1})},
    )  # fmt: skip
    text = screen(told, unavailable={"default": evil})
    assert all(line.isprintable() for line in text.splitlines())
    assert text.count("[red]") == 6


def test_many_clients_are_cut_short() -> None:
    told = health(*(client(f"robot{i}", heard_s=1000 - i) for i in range(500)))
    text = screen(told)
    assert "robot499 " in text
    assert "robot0 " not in text
    assert f"and {500 - MAX_CLIENTS} more sessions" in text
    only = screen(health(client("a", map="yard"), client("b", map="shed")), only="shed")
    assert "b " in only
    assert "yard" not in only


def test_ready_is_0(asking: Here) -> None:
    with serving(saying(health(client("cart")))) as (control, asked):
        done = asking(control, "--json")
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        (cart,), default = told["health"]["clients"], told["health"]["maps"]["default"]
        assert (cart["keyframes_fused"], cart["keyframes_durable"], cart["keyframes_waiting"]) == (6, 6, 0)
        assert (cart["state"], cart["keyframes_skipped"], default["keyframes_rejected"]) == (
            "connected", {}, {"MapFull": 1},
        )  # fmt: skip
        assert told["maps"]["default"]["map_hash"] == "1f" * 16
        assert (told["unavailable"], told["stalled"], told["exit_status"]) == ({}, [], 0)
        plain = asking(control)
        assert plain.returncode == 0
        assert "\x1b" not in plain.stdout
        assert "cart" in plain.stdout
        assert {command.name for command in asked} == {"health", "status"}


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (health(ready=False), "not ready"),
        (health(ready=False, problems=("map yard: the disk is full",)), "✗ map yard: the disk is full"),
        (
            health(maps={"shed": map_health(), "yard": map_health(problem="stands still")}),
            "  ready  up 62 min",
        ),
    ],
)
def test_not_ready_is_3(told: Health, words: str, asking: Here) -> None:
    with serving(saying(told)) as (control, _):
        done = asking(control)
        assert (done.returncode, done.stderr) == (3, "")
        assert words in done.stdout
        assert json.loads(asking(control, "--json").stdout)["exit_status"] == 3


def test_nobody_is_1(asking: Here) -> None:
    with serving(lambda command: None) as (control, _):
        done = asking(control, "--timeout", 0.3, "--json")
    assert (done.returncode, done.stdout) == (1, "")
    cure = "is `tsfusion serve` running there, and is the port right?"
    nobody = f"no server answered at {NOBODY} (control {control}) within 0.3 s"
    assert done.stderr == f"tsfusion: {nobody}; {cure}\n"


def test_one_that_knows_no_health_is_1(asking: Here) -> None:
    with serving(lambda command: Reply(name="health", status=status())) as (control, _):
        done = asking(control)
    assert done.returncode == 1
    assert "answered without its health" in done.stderr


def test_a_fuser_that_restarts_is_said_and_no_failure(asking: Here) -> None:
    with serving(saying(health(), error="the fuser restarts; ask again")) as (control, _):
        done = asking(control, "--json")
        assert done.returncode == 0
        told = json.loads(done.stdout)
        assert (told["maps"], told["unavailable"]) == ({}, {"default": "the fuser restarts; ask again"})
        assert (
            "map default: hash and settings are not known now: the fuser restarts" in asking(control).stdout
        )


def test_a_fuser_that_is_stuck_is_said_in_time(asking: Here) -> None:
    def answer(command: Command) -> Reply | None:
        return Reply(name="health", health=health()) if command.name == "health" else None

    with serving(answer) as (control, _):
        done = asking(control, "--timeout", 0.5)
    assert done.returncode == 0
    assert "its fuser did not answer within 0." in done.stdout


def waiting(fused: int) -> Health:
    return health(
        maps={"yard": map_health(state="busy", waiting=3, keyframes_fused=fused), "shed": map_health()}
    )


def test_stalled_is_3(asking: Here) -> None:
    with serving(saying(waiting(5))) as (control, asked):
        done = asking(control, "--stall-after", 0.6, "--json")
        assert done.returncode == 3
        assert json.loads(done.stdout)["stalled"] == ["yard"]
        plain = asking(control, "--stall-after", 0.6).stdout
        assert re.search(r"✗ map yard: 3 keyframes wait, and none was fused for \d+ s", plain)
        assert asking(control, "--stall-after", 60, "--map", "shed").returncode == 0
    assert len([command for command in asked if command.name == "health"]) > 4


def test_slow_is_not_stalled(asking: Here) -> None:
    looks = iter(range(1000))
    with serving(saying(lambda: waiting(next(looks) // 3))) as (control, asked):
        assert asking(control, "--stall-after", 60).returncode == 0
    assert len([command for command in asked if command.name == "health"]) == 4


def test_one_map_is_judged_by_itself(asking: Here) -> None:
    maps = {"yard": map_health(state="failed", problem="broken"), "shed": map_health()}
    told = health(ready=False, problems=("map yard: broken",), maps=maps)
    with serving(saying(told)) as (control, asked):
        assert asking(control, "--map", "shed").returncode == 0
        assert {command.map for command in asked if command.name == "status"} == {"shed"}
        assert asking(control, "--map", "yard").returncode == 3
        done = asking(control, "--map", "attic")
        assert done.returncode == 3
        assert "✗ no map attic is open here, but yard, shed" in done.stdout
        told_of = json.loads(asking(control, "--map", "attic", "--json").stdout)
        assert told_of["maps"] == {}


def test_watching_prints_a_line_each_time_and_ends_with_the_server(asking: Here) -> None:
    counts = iter(range(3))

    def answer(command: Command) -> Reply | None:
        return (
            saying(health())(command) if command.name != "health" or next(counts, None) is not None else None
        )

    with serving(answer) as (control, asked):
        done = asking(control, "--watch", 0.1, "--json", "--timeout", 0.5)
    assert done.returncode == 1
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["exit_status"] for line in lines] == [0, 0, 0]
    assert [command.name for command in asked].count("status") == 1, "nothing changed: its fuser is let be"
    assert "no server answered" in done.stderr


@pytest.mark.parametrize("told", [waiting(5), health(ready=False)])
def test_watching_ends_when_nothing_gets_well(told: Health, asking: Here) -> None:
    with serving(saying(told)) as (control, _):
        done = asking(control, "--watch", 0.1, "--stall-after", 0.5)
    assert done.returncode == 3
    assert done.stdout.count("gateway 62.9 MB") > 1


def test_who_reads_slowly_does_not_end_watching() -> None:
    with serving(saying(health())) as (control, _):
        watcher = ServerWatcher(NOBODY, control=control, keys=None, timeout=DEADLINE, stall_after=0.1)
        for _look in range(2):
            assert watcher.check_again().exit_status == READY
            time.sleep(0.2)
            assert not watcher.unwell


def test_a_pause_does_not_end_watching() -> None:
    looks = iter(range(1_000_000))
    with serving(saying(lambda: health(ready=next(looks) % 4 == 0))) as (control, _):
        process = started(
            "status", "--connect", NOBODY, "--control", control, "--watch", 0.1, "--stall-after", 5, "--json"
        )
        try:
            for _ in range(12):
                read_until(process, "exit_status")
        finally:
            code = end(process, signal.SIGINT)
    assert code == 130


@pytest.mark.parametrize("arguments", [["--watch", "0"], ["--stall-after", "0"], ["--timeout", "x"]])
def test_wrong_usage_is_2(arguments: list[str]) -> None:
    assert tsfusion("status", *arguments).returncode == 2


def test_help_tells_the_exit_statuses() -> None:
    text = " ".join(tsfusion("status", "--help").stdout.split())
    assert "0 = ready; 1 = nobody answers; 2 = wrong usage; 3 = it answers, but is not ready" in text


def test_a_terminal_is_redrawn_until_ctrl_c_whatever_becomes_of_the_server() -> None:
    gone: list[bool] = []
    answer = saying(health(client("cart")))
    with serving(lambda command: None if gone else answer(command)) as (control, _):
        leader, follower = pty.openpty()
        command = ["status", "--connect", NOBODY, "--control", control, "--watch", "0.1", "--timeout", "0.3"]
        process = subprocess.Popen(
            [*COMMAND, *command], stdin=follower, stdout=follower, stderr=follower, start_new_session=True,
            env={**environment(), "TERM": "xterm", "COLUMNS": "100"},
        )  # fmt: skip
        os.close(follower)
        try:
            seen = _read_terminal(leader, lambda text: text.count("cart") >= 3)
            assert "\x1b[?1049h" in seen, "drawn on the terminal's other screen"
            assert "\x1b[2K" not in seen, "no line is wiped: nothing flickers"
            gone.append(True)
            _read_terminal(leader, lambda text: text.count("no server answered") >= 2)
            _read_terminal(leader, lambda text: "no answer for" in text and "as it was then" in text)
            gone.clear()
            _read_terminal(leader, lambda text: "keeping up" in text)
            process.send_signal(signal.SIGINT)
            rest = _read_terminal(leader, lambda text: "interrupted" in text)
            left = rest.rpartition("\x1b[?1049l")[2]
            assert "\x1b[?25h" in rest, "the cursor is back"
            assert "keeping up" in left, "the last state is left on the usual screen"
            assert "cart" in left
            assert process.wait(DEADLINE) == 130
        finally:
            process.kill()
            process.wait()
            os.close(leader)


def _read_terminal(leader: int, enough: Callable[[str], bool]) -> str:
    text = ""
    deadline = time.monotonic() + DEADLINE
    while not enough(text):
        assert time.monotonic() < deadline, text
        text += os.read(leader, 65536).decode(errors="replace")
    return text


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize("width", [80, 120])
def test_the_first_line_answers_in_words_and_nothing_wraps(width: int, color: bool) -> None:
    busy = map_health(
        state="busy", keyframes_durable=120_400, keyframes_fused=119_100, waiting=1300, rejected={},
        map_bytes=12_345_000_000, quarantined=0,
        delay_ms=Spread(count=9, mean=2100.0, p50=2000.0, p95=2800.0, p99=3000.0, max=6100.0),
    )  # fmt: skip
    told = health(client("cart", durable=120_400, fused=119_100), maps={"default": busy})
    lines = screen(told, width, color=color, rate=10.0).splitlines()
    plain = [re.sub(r"\x1b\[[0-9;]*m", "", line).rstrip() for line in lines]
    assert plain[0] == "! working · behind by 1300 keyframes, about 2 min · lost 0 keyframes"
    assert len(plain) == 8
    assert max(map(len, plain)) <= width
    assert ("\x1b[33m" in lines[0]) == color


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"last_keyframe_s": 3.0}, "✓ working · keeping up · lost 0 keyframes"),
        ({"last_keyframe_s": None}, "✓ ready, no input · keeping up · lost 0 keyframes"),
        ({"waiting": 2, "fusing_s": 7.0}, "✗ nothing fused for 7 s · keeping up · lost 0 keyframes"),
        ({"rejected": {"MapFull": 1}}, "✗ working · keeping up · lost 1 keyframe"),
        ({"problem": "the disk is full"}, "✗ does not work · keeping up · lost 0 keyframes"),
    ],
)
def test_the_headline_of_a_server(fields: dict[str, Any], words: str) -> None:
    told = health(maps={"default": map_health(**{"rejected": {}, "quarantined": 0, **fields})})
    assert screen(told).splitlines()[0] == words


def test_a_stall_that_began_before_is_seen_at_once(asking: Here) -> None:
    told = health(maps={"yard": map_health(state="busy", waiting=3, fusing_s=50.0)})
    with serving(saying(told)) as (control, asked):
        done = asking(control, "--stall-after", 40)
    assert done.returncode == 3
    assert "✗ nothing fused for 50 s · " in done.stdout
    assert len([command for command in asked if command.name == "health"]) == 2


def test_a_silent_server_is_seen_before_the_question_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(status_view, "time", SimpleNamespace(monotonic=lambda: now[0]))
    console = Console(width=80, height=24, highlight=False)

    def seen() -> list[str]:
        with console.capture() as captured:
            console.print(shown.cut())
        return captured.get().splitlines()

    shown = status_view.StatusScreen(console, "tcp://host:5555")
    shown.ask()
    shown.answer(Seen(address="tcp://host:5555", health=health(client("cart"))))
    now[0] += 60.0
    assert seen()[0].startswith("✗ working"), "the next question comes when it is due"
    shown.ask()
    now[0] += 0.5
    assert seen()[0].startswith("✗ working")
    now[0] += 1.5
    assert seen()[:2] == ["✗ no answer for 62 s", "as it was then:"]
    shown.fail("no server answered")
    assert seen()[1:3] == ["✗ no server answered", "as it was then:"]
    shown.answer(Seen(address="tcp://host:5555", health=health(*(client(f"cart{i}") for i in range(30)))))
    assert len(seen()) == 24
    assert re.fullmatch(r"\d+ lines more: a taller window shows them", seen()[-1])


def test_errors_stay_errors() -> None:
    error = str(TransportError("no server\x1b[2J answered"))
    assert screen(None, error=error) == "✗ no server\\x1b[2J answered\n"
