# SPDX-License-Identifier: MIT
"""Progress of a run on stderr: a table that moves on a terminal, plain lines elsewhere, or nothing."""

import logging
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NamedTuple

import typer

from tsfusion.cli.output import counted, size
from tsfusion.core.logs import printable

if TYPE_CHECKING:
    from rich.console import Console

    from tsfusion.pipelines.engine import Progress
    from tsfusion.scanner.scanner import ScanState

_LINE_INTERVAL = 2.0  # seconds between plain lines
_DRAW_INTERVAL = 0.2  # seconds between two drawings of a table
_RATE_SECONDS = 5.0  # over which rates are counted
_BAR_WIDTH = 32  # columns


@contextmanager
def shown(*, quiet: bool) -> "Iterator[Progress]":
    """The progress of a run: nothing is shown when `quiet`."""
    if quiet:
        yield Quiet()
    elif sys.stderr.isatty():
        with Table() as table:
            yield table
    else:
        yield Lines()


class Quiet:
    """Progress that is not shown."""

    def stage(self, text: str) -> None:
        """Show nothing."""

    def update(self, taken: int, fused: int, total: int | None, scan: "ScanState | None" = None) -> None:
        """Show nothing."""


class Lines:
    """A line for each stage, and one every few seconds while frames or keyframes are taken."""

    def __init__(self) -> None:
        self._last = time.monotonic()
        self._rates = _Rates()

    def stage(self, text: str) -> None:
        """Print it."""
        typer.echo(f"{text} …", err=True)
        self._last = time.monotonic()

    def update(self, taken: int, fused: int, total: int | None, scan: "ScanState | None" = None) -> None:
        """Print a line, unless the last one is recent."""
        rows = _rows(taken, fused, total, scan, self._rates)
        if time.monotonic() - self._last >= _LINE_INTERVAL:
            self._last = time.monotonic()
            typer.echo("  " + "; ".join(f"{row.name} {row.text}" for row in rows if row.text), err=True)


class Table:
    """A few rows with bars, drawn again a few times a second; warnings are printed above them."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._console = Console(stderr=True)
        self._live = Live(
            console=self._console,
            auto_refresh=False,
            transient=True,
            redirect_stdout=False,  # Taichi takes a wrapped stdout for a notebook, and says so
            redirect_stderr=False,
        )
        self._drawn = 0.0
        self._rates = _Rates()
        self._warnings = _Warnings(self._console)

    def __enter__(self) -> "Table":
        logging.getLogger("tsfusion").addHandler(self._warnings)
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()
        logging.getLogger("tsfusion").removeHandler(self._warnings)

    def stage(self, text: str) -> None:
        """Print it above the table."""
        self._console.print(f"[cyan]›[/] {text}", highlight=False)

    def update(self, taken: int, fused: int, total: int | None, scan: "ScanState | None" = None) -> None:
        """Draw the table, unless the last drawing is recent."""
        rows = _rows(taken, fused, total, scan, self._rates)
        if time.monotonic() - self._drawn < _DRAW_INTERVAL:
            return
        self._drawn = time.monotonic()
        from rich.progress_bar import ProgressBar
        from rich.table import Table as Grid
        from rich.text import Text

        grid = Grid.grid(padding=(0, 2))
        for row in rows:
            text = Text(row.text, style="bold red" if row.alarm else "")
            done = "" if row.share is None else ProgressBar(1.0, row.share, width=_BAR_WIDTH)
            grid.add_row(Text(row.name, style="dim"), text, done)
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


def _rows(taken: int, fused: int, total: int | None, scan: "ScanState | None", rates: _Rates) -> list[_Row]:
    if scan is not None:
        return _scan_rows(scan, total, rates)
    sent_rate, fused_rate = rates(taken, fused)
    left = f", {(total - fused) / fused_rate:.0f} s left" if total and fused_rate else ""
    return [
        _Row("keyframes", f"{taken}{_of(total)}, {sent_rate:.1f}/s", _share(taken, total)),
        _Row("fused", f"{fused}{_of(total)}, {fused_rate:.1f}/s{left}", _share(fused, total)),
    ]


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


@contextmanager
def reading(text: str, *, quiet: bool) -> "Iterator[Callable[[int, int], None]]":
    """A function that takes the bytes read and all bytes, and shows them as `shown` does."""
    if quiet:
        yield lambda _done, _all: None
    elif sys.stderr.isatty():
        from rich import progress as rp
        from rich.console import Console

        columns = (
            rp.TextColumn("{task.description}"), rp.BarColumn(bar_width=_BAR_WIDTH), rp.DownloadColumn(),
            rp.TransferSpeedColumn(), rp.TimeRemainingColumn(),
        )  # fmt: skip
        with rp.Progress(*columns, console=Console(stderr=True), transient=True) as bars:
            task = bars.add_task(text, total=None)
            yield lambda done, total: bars.update(task, completed=done, total=total)
    else:
        yield _ByteLines(text).count


class _ByteLines:
    """A line every few seconds; none for a short job."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._last = time.monotonic()

    def count(self, done: int, total: int) -> None:
        now = time.monotonic()
        if now - self._last >= _LINE_INTERVAL:
            self._last = now
            typer.echo(f"{self._text}: {size(done)} of {size(total)}", err=True)
