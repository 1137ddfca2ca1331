# SPDX-License-Identifier: MIT
"""Text that fits the terminal it is written to, and is left alone elsewhere."""

import fcntl
import io
import os
import pty
import struct
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import pytest

from tsfusion.core.readable_numbers import fitted

TEXT = "ready in 5.6 s: keyframes tcp://127.0.0.1:17755, control tcp://127.0.0.1:17756\nshort"


@pytest.fixture
def terminal() -> Iterator[TextIO]:
    """A terminal of 40 columns."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 40, 0, 0))
    with os.fdopen(follower, "w") as stream:
        yield stream
    os.close(leader)


def test_lines_end_between_words(terminal: TextIO) -> None:
    assert fitted(TEXT, terminal).split("\n") == [
        "ready in 5.6 s: keyframes",
        "  tcp://127.0.0.1:17755, control",
        "  tcp://127.0.0.1:17756",
        "short",
    ]
    path = "out/" + "x" * 60
    assert fitted(f"results    {path}", terminal, indent=11).split("\n")[-1].strip() == path


def test_files_get_it_as_it_is(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w") as stream:
        assert fitted(TEXT, stream) == TEXT
    assert fitted(TEXT, stream) == TEXT, "it is closed"
    assert fitted(TEXT, io.StringIO()) == TEXT
