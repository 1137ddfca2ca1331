# SPDX-License-Identifier: MIT
"""`tsfusion view` as a process, and the address of its page."""

import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from command_processes import COMMAND, environment, read_until

DEADLINE = 60.0


@contextmanager
def running(*command: object, **variables: str) -> Iterator["subprocess.Popen[str]"]:
    """A process whose stdout and stderr are read apart, ended whatever happens."""
    process = subprocess.Popen(
        [*map(str, command)], text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**environment(), "DISPLAY": "", "WAYLAND_DISPLAY": "", **variables},
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def viewing(*arguments: object, **variables: str) -> Any:
    return running(*COMMAND, "view", *arguments, **variables)


def address_of(process: "subprocess.Popen[str]") -> str:
    found = re.search(r"https?://[^\s\"]+", read_until(process, "http://", DEADLINE))
    assert found is not None
    return found[0]


def ended(process: "subprocess.Popen[str]", number: int) -> tuple[int, float, str, str]:
    """Status, seconds, and what was not read yet of stdout and stderr of a process that gets a signal."""
    began = time.monotonic()
    process.send_signal(number)
    said, errors = process.communicate(timeout=DEADLINE)
    return process.returncode, time.monotonic() - began, said, errors
