# SPDX-License-Identifier: MIT
"""The last line of a server's terminal: the state in words, below the log."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios

import pytest
from command_processes import environment
from repository import TESTS

PROGRAM = """
import sys; sys.path.insert(0, sys.argv[1])
from health_snapshots import client, health, map_health
from tsfusion.cli.bottom_line import BottomLine
well = map_health(rejected={}, quarantined=0)
with BottomLine() as line:
    line.show(health(ready=False, maps={"default": map_health(state="opening", rejected={})}))
    print("a line of the log", file=sys.stderr)
    line.show(health(client("cart"), maps={"default": well}))
    line.show(health(maps={"default": map_health(rejected={}, waiting=40)}, ready=False))
    line.show(health(maps={"default": well}, ready=False, problems=("the disk is full",)))
"""


def shown(rows: int, columns: int, **variables: str) -> str:
    """Bytes that a terminal of this size is sent."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    process = subprocess.Popen(
        [sys.executable, "-c", "import os, fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n" + PROGRAM,
         str(TESTS / "support")],
        stdin=follower, stdout=follower, stderr=follower, start_new_session=True,
        env={**environment(), "TERM": "xterm-256color", **variables},
    )  # fmt: skip
    os.close(follower)
    text = b""
    try:
        while chunk := _read(leader):
            text += chunk
        assert process.wait(60) == 0, text
    finally:
        process.kill()
        process.wait()
        os.close(leader)
    return text.decode()


def _read(leader: int) -> bytes:
    try:
        return os.read(leader, 65536)
    except OSError:  # the other side is closed
        return b""


@pytest.mark.parametrize("color", [True, False])
@pytest.mark.parametrize(("rows", "columns"), [(24, 80), (30, 120)])
def test_the_last_line_answers_and_goes_away(rows: int, columns: int, color: bool) -> None:
    text = shown(rows, columns, **({} if color else {"NO_COLOR": "1"}))
    lines = [
        re.sub(r"\x1b\[[0-9;]*m", "", line)
        for line in re.findall(rf"\x1b7\x1b\[{rows};1H\x1b\[2K(.*?)\x1b8", text)
    ]
    assert not any("…" in line for line in lines)
    told = [line.partition("   ") for line in lines]
    assert [(head, figures.split(", ")[:2]) for head, _, figures in told] == [
        ("✓ starting · keeping up · lost 0 keyframes", [" 0.0/s", "5 fused"]),
        ("✓ working · keeping up · lost 0 keyframes", [" 0.0/s", "5 fused"]),
        ("! ending · behind by 40 keyframes · lost 0 keyframes", [" 0.0/s", "5 fused"]),
        ("✗ not ready · keeping up · lost 0 keyframes", [" 0.0/s", "5 fused"]),
    ]
    assert max(map(len, lines)) < columns
    assert text.count(f"\x1b[1;{rows - 1}r") == 1, "only the other lines scroll"
    assert text.endswith(f"\x1b[r\x1b[{rows};1H\x1b[2K\x1b8"), "in the end all of them do"
    assert ("\x1b[32m" in text) == color


def test_a_low_terminal_is_left_alone() -> None:
    assert shown(5, 80) == "a line of the log\r\n"
