# SPDX-License-Identifier: MIT
"""The screen of `status --watch`: the last known state of a server, and for how long it has been silent."""

import time

from msgspec.structs import replace
from rich.console import Console, Group, RenderableType
from rich.segment import Segment, Segments
from rich.text import Text

from tsfusion.cli.health_poll import ServerSnapshot
from tsfusion.cli.status_view import render

_PROMPT = 1.0  # seconds: an answer that takes longer is missed


class StatusScreen:
    """Screen of a server's state. One thread brings its answers, another draws."""

    def __init__(self, console: Console, address: str) -> None:
        self._console = console
        self._snapshot = ServerSnapshot(address=address, error=f"no answer yet from {address}")
        self._asked: float | None = None  # time.monotonic(); None = the last question is answered
        self._failed = False  # whether the last question was not
        self._answered = time.monotonic()

    def ask(self) -> None:
        """Note that the server is asked now."""
        self._asked = time.monotonic()

    def answer(self, snapshot: ServerSnapshot) -> None:
        """Note an answer."""
        self._snapshot, self._failed, self._asked = snapshot, False, None
        self._answered = time.monotonic()

    def fail(self, error: str) -> None:
        """Note that there was none, and why."""
        self._snapshot = replace(self._snapshot, error=error)
        self._failed, self._asked = True, None

    def whole(self) -> RenderableType:
        """The state now; where no answer comes, the last one and how old it is."""
        now, asked = time.monotonic(), self._asked
        is_missing = self._failed or (asked is not None and now - asked > _PROMPT)
        return render(self._snapshot, self._console.width, silent=now - self._answered if is_missing else 0.0)

    def cut(self) -> RenderableType:
        """The lines that the terminal has room for, and the number of the others."""
        height, whole = self._console.height, self.whole()
        lines = self._console.render_lines(whole, pad=False)
        if len(lines) <= height:
            return whole
        shown = [segment for line in lines[: height - 1] for segment in (*line, Segment.line())]
        rest = len(lines) - height + 1
        return Group(Segments(shown), Text(f"{rest} lines more: a taller window shows them", style="dim"))
