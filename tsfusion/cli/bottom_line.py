# SPDX-License-Identifier: MIT
"""Show a server's state on the last line of its terminal, below the scrolling log."""

import os
import sys

from msgspec.structs import replace
from rich.console import Console
from rich.text import Text

from tsfusion.cli.progress import styled
from tsfusion.core.limits import Rates
from tsfusion.core.readable_numbers import count_of
from tsfusion.wire.messages.health import Health, headline

_LEAST_ROWS = 6  # a smaller terminal shows no state
_SAVE, _RESTORE = "\x1b7", "\x1b8"  # save and restore the cursor's position


class BottomLine:
    """The last line of the terminal at stderr. Only the lines above it scroll (DECSTBM).

    So all processes that write to stderr, such as fusers, write above it. Nothing is shown if stderr is no
    terminal, or if another program is in its foreground.
    """

    def __init__(self) -> None:
        self._console = Console(stderr=True, highlight=False)
        self._rates = Rates()
        self._rows = 0  # of the terminal when its last line was reserved; 0 = it is not
        self._was_ready = False

    def __enter__(self) -> "BottomLine":
        return self

    def __exit__(self, *_: object) -> None:
        if self._rows:
            self._write(f"{_SAVE}\x1b[r\x1b[{self._rows};1H\x1b[2K{_RESTORE}")
            self._rows = 0

    def show(self, health: Health) -> None:
        """Show the newest state. Call it about once a second."""
        if not self._is_ours():
            return
        columns, rows = os.get_terminal_size(sys.stderr.fileno())
        if rows < _LEAST_ROWS:
            return
        if rows != self._rows:
            # The line feed makes room where the cursor is on the last line; setting the bounds moves it away.
            self._write(f"\n{_SAVE}\x1b[1;{rows - 1}r{_RESTORE}\x1b[1A")
            self._rows = rows
        line = self._words(health, columns - 1)
        line.truncate(columns - 1, overflow="ellipsis")
        with self._console.capture() as captured:
            self._console.print(line, end="", soft_wrap=True)
        self._write(f"{_SAVE}\x1b[{rows};1H\x1b[2K{captured.get()}{_RESTORE}")

    def _words(self, health: Health, columns: int) -> Text:
        """Return the headline and as many figures as fit into `columns`."""
        fused = sum(one.keyframes_fused for one in health.maps.values())
        rate, _ = self._rates(fused, 0)
        head = headline(health, rate=max(rate or 0.0, 0.0))
        if self._was_ready and not health.ready and not health.problems:
            head = replace(head, doing="ending", trouble="")
        self._was_ready |= health.ready
        scanners = count_of(sum(one.state == "connected" for one in health.clients), "scanner")
        line = styled(head)
        for figure in (f"   {max(rate or 0.0, 0.0):4.1f}/s", f", {fused} fused", f", {scanners}"):
            if len(line) + len(figure) > columns:
                break
            line.append(figure, style="dim")
        return line

    def _is_ours(self) -> bool:
        try:
            return sys.stderr.isatty() and os.tcgetpgrp(sys.stderr.fileno()) == os.getpgrp()
        except OSError:  # this process has no terminal, or lost it
            return False

    def _write(self, text: str) -> None:
        sys.stderr.write(text)  # in one call, so that the terminal never shows half of it
        sys.stderr.flush()
