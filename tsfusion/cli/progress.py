# SPDX-License-Identifier: MIT
"""Progress of a run on stderr: a table that moves on a terminal, plain lines elsewhere, or nothing."""

import logging
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import typer

from tsfusion.cli.output import counted, size
from tsfusion.core.logs import printable

if TYPE_CHECKING:
    from rich.console import Console

    from tsfusion.scanner.scanner import ScanState

_LINE_INTERVAL = 2.0  # seconds between plain lines
_DRAW_INTERVAL = 0.2  # seconds between two drawings of a table
_RATE_SECONDS = 5.0  # over which rates are counted
_BAR_WIDTH = 32  # columns


def shown(*, quiet: bool) -> "Quiet":
    """The progress of a run, to be entered: nothing is shown when `quiet`."""
    if quiet:
        return Quiet()
    return Table() if sys.stderr.isatty() else Lines()


@contextmanager
def reading(text: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A function that takes the bytes read and all bytes, and shows them after `text`."""
    with shown(quiet=quiet) as display:
        yield partial(display.show_bytes, text)


class Quiet:
    """Progress that is not shown."""

    def __init__(self) -> None:
        self.rates = _Rates()

    def __enter__(self) -> "Quiet":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def stage(self, text: str) -> None:
        """Show which part of the run begins."""

    def say(self, text: str) -> None:
        """Show a line that matters even to who wants no progress."""
        typer.echo(text, err=True)

    def update(self, taken: int, fused: int, total: int | None, scan: "ScanState | None" = None) -> None:
        """Show the counts; see `Progress`."""
        if scan is None:
            self.show(_keyframe_rows(taken, fused, total, self.rates))
        else:
            self.show(_scan_rows(scan, total, self.rates))

    def show_bytes(self, text: str, done: int, total: int) -> None:
        """Show how much is read, after `text`."""
        self.show([_byte_row(text, done, total, self.rates)])

    def show_steps(self, text: str, done: int, total: int) -> None:
        """Show how many steps are done, after `text`."""
        self.show([_Row(text, f"{done}{_of(total)}", _share(done, total))])

    def show(self, rows: "list[_Row]") -> None:
        """Show these rows in place of the last ones."""


class Lines(Quiet):
    """A line for each stage, and one for the rows every few seconds."""

    def __init__(self) -> None:
        super().__init__()
        self._last = time.monotonic()

    def stage(self, text: str) -> None:
        typer.echo(f"{text} …", err=True)
        self._last = time.monotonic()

    def show(self, rows: "list[_Row]") -> None:
        if time.monotonic() - self._last >= _LINE_INTERVAL:
            self._last = time.monotonic()
            typer.echo("  " + "; ".join(f"{row.name} {row.text}" for row in rows if row.text), err=True)


class Table(Quiet):
    """A line for each stage, and below a table with bars, drawn again a few times a second."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        super().__init__()
        self._console = Console(stderr=True)
        self._live = Live(
            console=self._console,
            auto_refresh=False,
            transient=True,
            redirect_stdout=False,  # Taichi takes a wrapped stdout for a notebook, and says so
            redirect_stderr=False,
        )
        self._drawn = 0.0
        self._rows: list[_Row] = []
        self._warnings = _Warnings(self._console)

    def __enter__(self) -> "Table":
        logging.getLogger("tsfusion").addHandler(self._warnings)
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()
        logging.getLogger("tsfusion").removeHandler(self._warnings)

    def stage(self, text: str) -> None:
        self._draw()  # the last counts, for as long as the stage takes
        self.say(text)

    def say(self, text: str) -> None:
        self._console.print(f"[cyan]›[/] {text}", highlight=False, soft_wrap=True)

    def show(self, rows: "list[_Row]") -> None:
        self._rows = rows
        if time.monotonic() - self._drawn >= _DRAW_INTERVAL:
            self._draw()

    def _draw(self) -> None:
        from rich.progress_bar import ProgressBar
        from rich.table import Table as Grid
        from rich.text import Text

        self._drawn = time.monotonic()
        grid = Grid.grid(padding=(0, 2))
        for row in self._rows:
            text = Text(row.text, style="bold red" if row.alarm else "")
            bar = "" if row.share is None else ProgressBar(1.0, row.share, width=_BAR_WIDTH)
            grid.add_row(Text(row.name, style="dim"), text, bar)
        self._live.update(grid, refresh=True)


class _Warnings(logging.Handler):
    """Warnings go above the table, which would be drawn over them."""

    def __init__(self, console: "Console") -> None:
        super().__init__(logging.WARNING)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        text = printable(record.getMessage())
        self._console.print(text, style="yellow", markup=False, highlight=False)


class _Row(NamedTuple):
    """A name and words; `share`: 0 to 1 of a bar, None = no bar."""

    name: str
    text: str
    share: float | None = None
    alarm: bool = False


class _Rates:
    """How much two counts grew a second, over the last seconds."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, int, int]] = deque()

    def __call__(self, first: int, second: int) -> tuple[float, float]:
        now = time.monotonic()
        self._samples.append((now, first, second))
        while now - self._samples[0][0] > _RATE_SECONDS:
            self._samples.popleft()
        then, first_then, second_then = self._samples[0]
        seconds = max(now - then, 1e-3)
        return (first - first_then) / seconds, (second - second_then) / seconds


def _keyframe_rows(taken: int, fused: int, total: int | None, rates: _Rates) -> list[_Row]:
    taken_rate, fused_rate = rates(taken, fused)
    left = f", {(total - fused) / fused_rate:.0f} s left" if total and fused < total and fused_rate else ""
    return [
        _Row("keyframes", f"{taken}{_of(total)}, {taken_rate:.1f}/s", _share(taken, total)),
        _Row("fused", f"{fused}{_of(total)}, {fused_rate:.1f}/s{left}", _share(fused, total)),
    ]


def _byte_row(text: str, done: int, total: int, rates: _Rates) -> _Row:
    return _Row(text, f"{size(done)} of {size(total)}, {size(rates(done, 0)[0])}/s", _share(done, total))


def _scan_rows(state: "ScanState", total: int | None, rates: _Rates) -> list[_Row]:
    stats, keyframes = state.stats, sum(state.selected.values())
    frame_rate, keyframe_rate = rates(state.frames, keyframes)
    delay = f", delay {state.keyframe_delay_ms:.0f} ms" if state.keyframe_delay_ms is not None else ""
    return [
        _Row("sensor", _sensor(state), alarm=state.state == "lost"),
        _Row("frames", f"{state.frames}{_of(total)}, {frame_rate:.1f}/s", _share(state.frames, total)),
        _Row("keyframes", f"{keyframes}, {keyframe_rate:.1f}/s"),
        _Row("to send", f"{stats.waiting} ({size(stats.waiting_bytes)})"),
        _Row("server", f"{stats.durable} acknowledged, {stats.fused} fused{delay}"),
        _Row("link", state.link),
        _Row("left out", counted({**stats.refused, **stats.rejected, **stats.skipped})),
    ]


def _of(total: int | None) -> str:
    return f" of {total}" if total else ""


def _share(count: int, total: int | None) -> float | None:
    return count / total if total else None


def _sensor(state: "ScanState") -> str:
    words = state.state if not state.why else f"{state.state}: {state.why}"
    if state.submaps > 1:
        words += f"; map {state.submap} ({state.submaps} so far)"
    return words + (f"; {state.loops} loops closed" if state.loops else "")
