# SPDX-License-Identifier: MIT
"""Running the real `tsfusion` command, with deadlines."""

import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import quick_fusers

from tsfusion.core import process

COMMAND = [sys.executable, "-m", "tsfusion"]
QUICK = quick_fusers.server_command(quick_fusers.LAZY)  # the same, its servers sooner ready
QUICK_RUN = quick_fusers.run_command(quick_fusers.LAZY)  # and those of its runs
FORGETFUL_RUN = quick_fusers.run_command(quick_fusers.SUMS)  # for runs that end before their map is asked for
DEADLINE = 240.0  # seconds: a cold kernel compilation on a slow machine that does other things as well
Here = Callable[..., "subprocess.CompletedProcess[str]"]  # of the fixture `here`


def environment() -> dict[str, str]:
    """Variables of this process, of tsfusion's own only one: kernels run on one thread.

    Each test has about a core, and kernels that several threads need are not compiled.
    """
    return {**process.without_flags(), "TSFUSION_THREADS": "1"}


def tsfusion(
    *arguments: object, timeout: float = DEADLINE, command: Sequence[str] = COMMAND, **more: Any
) -> "subprocess.CompletedProcess[str]":
    """Run a command to its end."""
    return subprocess.run(
        [*command, *map(str, arguments)], capture_output=True, text=True, timeout=timeout, env=environment(),
        check=False, stdin=subprocess.DEVNULL, **more,
    )  # fmt: skip


def python(program: str, *arguments: object, **more: Any) -> "subprocess.CompletedProcess[str]":
    """Run Python code in a process of its own, to its end."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "timeout": DEADLINE, "check": False}
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, text=True, **{**options, **more})  # noqa: PLW1510


def started(*arguments: object, command: Sequence[str] = COMMAND) -> "subprocess.Popen[str]":
    """Start a command; its stderr goes with its stdout."""
    return subprocess.Popen(
        [*command, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=environment(), stdin=subprocess.DEVNULL,
    )  # fmt: skip


# What came with the last line that was read. Not Python's own buffer: of that no selector knows.
_unread: "WeakKeyDictionary[subprocess.Popen[str], bytes]" = WeakKeyDictionary()


def read_until(process: "subprocess.Popen[str]", word: str, timeout: float = DEADLINE) -> str:
    """The first line that holds `word`."""
    deadline = time.monotonic() + timeout
    seen, rest = [], _unread.pop(process, b"")
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while time.monotonic() < deadline:
            line, newline, after = rest.partition(b"\n")
            if newline:
                rest = after
                seen.append(line.decode() + "\n")
                if word in seen[-1]:
                    _unread[process] = rest
                    return seen[-1]
            elif selector.select(0.2):
                chunk = os.read(process.stdout.fileno(), 1 << 16)
                if not chunk:
                    break
                rest += chunk
    raise AssertionError(f"no line with {word!r} came, but:\n{''.join(seen)}{rest.decode()}")


@contextmanager
def server(
    state: Path, *arguments: object, command: Sequence[str] = QUICK
) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """A running `tsfusion serve` on free ports: its address and process."""
    words = ("serve", "--listen", "tcp://127.0.0.1:0", "--state", state, "--json", *arguments)
    process = started(*words, command=command)
    try:
        ready = json.loads(read_until(process, '"ready"'))
        yield ready["listen"], process
    finally:
        end(process)


def end(process: "subprocess.Popen[str]", number: int = signal.SIGTERM, timeout: float = 60.0) -> int:
    """Send a signal, wait, and give the exit status."""
    if process.poll() is None:
        process.send_signal(number)
    try:
        return process.wait(timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise
    finally:
        if process.stdout is not None:
            process.stdout.close()


def descendants(pid: int) -> list[int]:
    """Every process below `pid` (Linux)."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    direct = [int(word) for word in children.read_text().split()] if children.exists() else []
    return [pid for child in direct for pid in (child, *descendants(child))]


def alive(pid: int) -> bool:
    """Tell whether a process exists and is no zombie (Linux)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def eventually(condition: Callable[[], bool], timeout: float = 90.0) -> bool:
    """Poll until it holds; False at the deadline."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True
