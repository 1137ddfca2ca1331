# SPDX-License-Identifier: MIT
"""Log lines: one event a line whatever is in it, and no more of them than a disk can bear."""

import json
import logging
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from command_processes import python
from hypothesis import given
from hypothesis import strategies as st
from keyframes_and_servers import at_once

from tsfusion.core import logs

SESSION = bytes(range(0xA0, 0xB0))
LINE = {"time", "level", "process", "logger", "message"}
log = logging.getLogger("tsfusion.test")
ReadLines = Callable[[], list[str]]


@pytest.fixture
def lines(capsys: pytest.CaptureFixture[str]) -> ReadLines:
    """Log lines since the last call."""

    def read() -> list[str]:
        return capsys.readouterr().err.splitlines()

    return read


def record(
    message: str = "a %s", *arguments: object, level: int = logging.WARNING, line: int = 1
) -> logging.LogRecord:
    return logging.LogRecord("tsfusion.x", level, "x.py", line, message, arguments or ("b",), None)


def test_text_is_a_line_that_says_what_it_is_about(lines: ReadLines) -> None:
    logs.configure("text", "info")
    log.warning("a message is refused: %s", "too large", extra=logs.about(map="yard", session=SESSION, seq=7))
    log.info("ready")
    assert lines() == [
        "tsfusion: WARNING: a message is refused: too large (map yard, session a0a1a2a3, seq 7)",
        "tsfusion: INFO: ready",
    ]
    logs.configure("text", "info", "fuser")
    log.error("no checkpoint")
    assert lines() == ["tsfusion fuser: ERROR: no checkpoint"]
    logs.configure("text", "info", "fuser", map="yard")
    log.error("no checkpoint")
    log.error("another's", extra=logs.about(map="shed"))
    assert lines() == [
        "tsfusion fuser: ERROR: no checkpoint (map yard)",
        "tsfusion fuser: ERROR: another's (map shed)",
    ]


def test_json_is_an_object_a_line(lines: ReadLines) -> None:
    logs.configure("json", "info", "fuser")
    log.warning("refused", extra=logs.about(map="yard", session=SESSION, seq=0, client="cart", reason="gap"))
    (line,) = lines()
    fields = json.loads(line)
    assert fields.keys() == {*LINE, "map", "session", "seq", "client", "reason"}
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", fields.pop("time"))
    assert fields == {
        "level": "warning", "process": "fuser", "logger": "tsfusion.test", "message": "refused",
        "map": "yard", "session": "a0a1a2a3", "seq": 0, "client": "cart", "reason": "gap",
    }  # fmt: skip


def test_a_traceback_is_a_field(lines: ReadLines) -> None:
    logs.configure("json", "info")
    try:
        raise ValueError("first\nsecond")
    except ValueError:
        log.exception("broken")
    (line,) = lines()
    assert json.loads(line)["exception"].endswith("ValueError: first\nsecond")
    logs.configure("text", "info")
    log.error("broken", exc_info=ValueError("once"))
    assert lines() == ["tsfusion: ERROR: broken", "ValueError: once"]


def test_only_what_is_known_is_shown(lines: ReadLines) -> None:
    logs.configure("json", "info")
    log.warning("x", extra={"about": {"password": "secret", "seq": 1}, "other": 2})
    (line,) = lines()
    assert json.loads(line).keys() == {*LINE, "seq"}
    assert logs.about(map=None, client="", reason=None, session=None) == {"about": {}}


@pytest.mark.parametrize("format", ["text", "json"])
@given(text=st.text())
def test_nothing_in_a_message_breaks_a_line_or_a_terminal(format: str, text: str) -> None:
    made = logs.TextFormatter("server") if format == "text" else logs.JsonFormatter("server")
    entry = record("%s", text)
    entry.__dict__.update(logs.about(map=text, reason=text))
    line = made.format(entry)
    assert len(line.splitlines()) == 1
    assert line.isprintable()


def test_long_messages_are_cut(lines: ReadLines) -> None:
    logs.configure("text", "info")
    log.warning("%s", "x" * 1_000_000)
    (line,) = lines()
    assert len(line) < logs.MESSAGE_CHARACTERS + 100
    assert line.endswith("x…")


def test_levels_are_those_of_our_own_loggers(lines: ReadLines) -> None:
    logs.configure("text", "debug")
    log.debug("ours")
    logging.getLogger("asyncio").debug("theirs")
    logging.getLogger("asyncio").warning("theirs, and important")
    assert lines() == ["tsfusion: DEBUG: ours", "tsfusion: WARNING: theirs, and important"]
    logs.configure("text", "error")
    log.warning("ours")
    assert lines() == []


def test_configuring_again_does_not_double_lines(lines: ReadLines) -> None:
    for _ in range(3):
        logs.configure("text", "info")
    log.info("once")
    assert lines() == ["tsfusion: INFO: once"]


def test_a_flood_is_cut_short_and_counted() -> None:
    now = [100.0]
    limiter = logs.Limiter(most=3, period=10.0, clock=lambda: now[0])
    assert [limiter.allows(record("%s", i)) for i in range(5)] == [True] * 3 + [False] * 2
    assert limiter.allows(record(line=2)), "another place has a count of its own"
    now[0] += 9.9
    assert list(limiter.finished_periods()) == []
    now[0] += 0.2
    (summary,) = limiter.finished_periods()
    assert summary.getMessage() == "2 more like this were left out in 10 s: 4"
    assert summary.levelno == logging.WARNING
    assert limiter.allows(record()), "a new period"
    assert list(limiter.finished_periods(everything=True)) == []


def test_errors_are_cut_short_too_and_what_ends_the_process_is_not() -> None:
    """A peer can bring errors about as fast as it likes."""
    limiter = logs.Limiter(most=1)
    assert [limiter.allows(record(level=logging.ERROR)) for _ in range(3)] == [True, False, False]
    assert all(limiter.allows(record(level=logging.CRITICAL)) for _ in range(50))
    (summary,) = limiter.finished_periods(everything=True)
    assert summary.levelno == logging.ERROR


def test_left_out_lines_are_counted_though_nothing_follows(lines: ReadLines) -> None:
    now = [100.0]
    logs.configure("json", "info")
    (handler,) = (h for h in logging.root.handlers if isinstance(h, logs.Stderr))
    handler._limiter = logs.Limiter(2, 10.0, lambda: now[0])
    for i in range(5):
        log.warning("rubbish %d", i, extra=logs.about(seq=i))
    logs.log_left_out()
    assert len(lines()) == 2
    now[0] += 10.0
    logs.log_left_out()
    logs.log_left_out()
    (line,) = lines()
    assert json.loads(line)["message"] == "3 more like this were left out in 10 s: rubbish 4"
    assert json.loads(line).keys() == LINE


def test_a_flood_from_many_threads_is_bounded(lines: ReadLines) -> None:
    logs.configure("text", "info")

    def flood() -> None:
        for i in range(1000):
            log.warning("rubbish %d", i)

    at_once(*[flood] * 4)
    assert len(lines()) == logs.MOST
    for handler in logging.root.handlers:
        if isinstance(handler, logs.Stderr):
            handler.close()
    (line,) = lines()
    assert f" {4000 - logs.MOST} more like this" in line


def test_what_nobody_handled_is_one_object_too() -> None:
    program = """
from tsfusion.core import logs
logs.configure("json", "info")
raise ValueError("a\\nb")
"""
    done = python(program)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    fields = json.loads(line)
    assert (fields["level"], fields["message"]) == ("critical", r"unexpected: a\nb")
    assert "ValueError" in fields["exception"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_stops_nobody() -> None:
    program = """
import logging
from tsfusion.core import logs
logs.configure("json", "info")
for _ in range(3):
    logging.getLogger("tsfusion.x").error("lost")
print("alive")
"""
    with open("/dev/full", "w") as full:
        done = python(program, stderr=full)
    assert done.stdout == "alive\n"
