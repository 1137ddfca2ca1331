# SPDX-License-Identifier: MIT
"""Show the progress of a run on stderr: a live table on a terminal, plain lines elsewhere, or nothing."""

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING, NamedTuple

import typer

from tsfusion.cli.output import size
from tsfusion.core.headline import Headline
from tsfusion.core.limits import Rates
from tsfusion.core.logs import printable
from tsfusion.core.readable_numbers import count_of, span
from tsfusion.wire.messages.messages import explained

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.text import Text

    from tsfusion.client import ClientStats
    from tsfusion.pipelines.runs.viewer_child import ViewerChild
    from tsfusion.scanner.scanner import ScanState

_LINE_INTERVAL = 2.0  # seconds between plain lines
_DRAWINGS = 5  # redraws of a table per second
_ENDING = b"\nending: what is on its way is finished (press Ctrl-C again to end at once)\n"
STILL = 5.0  # seconds without new counts, or without a keyframe fused, until this is shown
_WIDTHS = (9, 13, 8, 18)  # minimum columns of name, amount, rate and note
_BAR_WIDTHS = (8, 26)  # minimum and maximum columns
_STYLES = {"good": "green", "notice": "yellow", "bad": "bold red"}


class ScreenRow(NamedTuple):
    """Row of the screen: a name with figures. `share` is the filled part of a bar, 0 to 1; None = no bar."""

    name: str
    amount: str
    rate: str = ""
    note: str = ""
    share: float | None = None

    def __str__(self) -> str:
        return f"{self.name} {', '.join(filter(None, (self.amount, self.rate, self.note)))}"


class Note(NamedTuple):
    """Row of the screen: a name with words."""

    name: str
    text: str
    alarm: bool = False

    def __str__(self) -> str:
        return f"{self.name} {printable(self.text)}"


class Screen(NamedTuple):
    """Rows to show at one moment. `headline` is None if there are no keyframes."""

    rows: list[ScreenRow] = []
    notes: list[Note] = []
    headline: Headline | None = None

    def line(self) -> str:
        """Return all rows and notes on one line."""
        begin = "  " if self.headline is None else f"{self.headline}; "
        return begin + "; ".join(map(str, [*self.rows, *self.notes]))

    def table(self, width: int, *, trouble: str = "") -> "RenderableType":
        """Return all rows for a terminal of `width` columns. `trouble` is shown if the headline has none."""
        from msgspec.structs import replace
        from rich.console import Group

        head = self.headline
        if head is not None and trouble and not head.trouble:
            head = replace(head, trouble=trouble)
        top = [] if head is None else [styled(head)]
        return Group(*top, *([_grid(self.rows, width)] if self.rows else []), *map(_in_words, self.notes))


def styled(headline: Headline) -> "Text":
    """Return a headline in colours. The words alone say the same."""
    from rich.text import Text

    mark, level = headline.mark
    line = Text().append(f"{mark} ", style=_STYLES[level])
    for number, (words, of_part) in enumerate(headline.parts):
        line.append(" · " if number else "", style="dim").append(words, style=_STYLES[of_part])
    return line


class RunProgress:
    """Turns the counts of a run into rows to show."""

    def __init__(self) -> None:
        self._rates = Rates()
        self._step: object = None
        self._moved = 0.0  # time.monotonic() of the last progress, or of no keyframe under way

    def screen(self, total: int | None, stats: "ClientStats", link: str, scan: "ScanState | None") -> Screen:
        """Return the rows to show; for the arguments see `Progress.update`."""
        taken = stats.sent if scan is None else scan.frames
        taking, fusing = self._rates(taken, stats.fused)
        headline = Headline(
            doing="working" if taken else "starting",
            trouble=_trouble(link, scan) or self._standstill(stats),
            waiting=stats.under_way,
            rate=fusing or 0.0,
            lost=sum(stats.left_out.values()),
        )
        to_send = f"{stats.waiting} to send, {size(stats.waiting_bytes)}" if stats.waiting else ""
        if scan is None:
            rows = [ScreenRow("sent", f"{taken}{_of(total)}", _rate(taking), "", _share(taken, total)),
                    ScreenRow("fused", f"{stats.fused}{_of(total)}", _rate(fusing),
                        _left(stats.fused, total, fusing), _share(stats.fused, total))]  # fmt: skip
        else:
            rows = [ScreenRow("frames", f"{taken}{_of(total)}", _rate(taking), _left(taken, total, taking),
                        _share(taken, total)),
                    ScreenRow("keyframes", str(sum(scan.selected.values()))),
                    ScreenRow("fused", str(stats.fused), _rate(fusing), _delay(scan))]  # fmt: skip
        return Screen(
            [*rows, ScreenRow("waiting", str(stats.under_way), "", to_send)],
            _notes(stats, link, scan),
            headline,
        )

    def _standstill(self, stats: "ClientStats") -> str:
        """Return in words how long keyframes wait and none is fused; empty if they move, or none waits."""
        now, step = time.monotonic(), (stats.settled, stats.durable, stats.corrections_waiting)
        if step != self._step or not stats.under_way:
            self._step, self._moved = step, now
        return f"nothing fused for {span(now - self._moved)}" if now - self._moved > STILL else ""


def fused_rows(read: int, fused: int, total: int, rates: Rates) -> list[ScreenRow]:
    """Return rows for the shares of a journal that are read and fused."""
    reading, fusing = rates(read, fused)
    return [
        ScreenRow(
            "read", f"{read}{_of(total)}", _rate(reading), _left(read, total, reading), _share(read, total)
        ),
        ScreenRow("fused", str(fused), _rate(fusing)),
    ]


def byte_row(text: str, done: int, total: int, rates: Rates) -> ScreenRow:
    """Return a row with the bytes read, after `text`."""
    rate, _ = rates(done, 0)
    shown = "" if rate is None else f"{size(rate)}/s"
    return ScreenRow(text, f"{size(done)} of {size(total)}", shown, "", _share(done, total))


def step_row(text: str, done: int, total: int) -> ScreenRow:
    """Return a row with the number of steps done, after `text`."""
    return ScreenRow(text, f"{done}{_of(total)}", share=_share(done, total))


def _trouble(link: str, scan: "ScanState | None") -> str:
    """Return in two or three words why a run does not go on; the notes say more."""
    if scan is not None and scan.state == "lost":
        return "sensor lost"
    if scan is not None and scan.state == "starting" and scan.why:
        return "sensor not localised"
    return "the server takes nothing" if link else ""


def _notes(stats: "ClientStats", link: str, scan: "ScanState | None") -> list[Note]:
    notes = [] if scan is None else [Note("sensor", _sensor(scan), scan.state == "lost")]
    if stats.corrections_waiting:
        moved = count_of(stats.corrections_waiting, "keyframe")
        notes.append(Note("to move", f"{moved}, to corrected poses"))
    if stats.left_out:
        notes.append(Note("lost", explained(stats.left_out), alarm=True))
    return [*notes, Note("server", link, alarm=True)] if link else notes


def _sensor(state: "ScanState") -> str:
    words = state.state if not state.why else f"{state.state}: {state.why}"
    if state.submaps > 1:
        words += f"; map {state.submap} ({state.submaps} so far)"
    return words + (f"; {count_of(state.loops, 'loop')} closed" if state.loops else "")


def _of(total: int | None) -> str:
    return f" of {total}" if total else ""


def _share(count: int, total: int | None) -> float | None:
    return count / total if total else None


def _rate(rate: float | None) -> str:
    return "" if rate is None else f"{rate:.1f}/s"


def _left(count: int, total: int | None, rate: float | None) -> str:
    return f"{span((total - count) / rate)} left" if total and rate and count < total else ""


def _delay(scan: "ScanState") -> str:
    return "" if scan.keyframe_delay_ms is None else f"delay {scan.keyframe_delay_ms:.0f} ms"


def _grid(rows: list[ScreenRow], width: int) -> "RenderableType":
    """Return the rows in columns that do not move while the figures grow."""
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(padding=(0, 2, 0, 0))
    columns = list(zip(*((row.name, row.amount, row.rate, row.note) for row in rows), strict=True))
    widths = [max(least, *map(len, texts)) for least, texts in zip(_WIDTHS, columns, strict=True)]
    for least, align in zip(widths, ("left", "right", "right", "left"), strict=True):
        grid.add_column(min_width=least, justify=align)  # type: ignore[arg-type]
    least, most = _BAR_WIDTHS
    bar = min(most, width - sum(widths) - 2 * len(widths))
    for row in rows:
        shown = row.share is not None and bar >= least
        share = (
            ProgressBar(1.0, row.share or 0.0, width=bar, complete_style="cyan", finished_style="green")
            if shown
            else ""
        )
        grid.add_row(Text(row.name, style="dim"), row.amount, row.rate, row.note, share)
    return grid


def _in_words(note: Note) -> "RenderableType":
    """Return a name with its words in a column beside it."""
    from rich.table import Table
    from rich.text import Text

    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(min_width=_WIDTHS[0])
    grid.add_row(
        Text(note.name, style="dim"), Text(printable(note.text), style="bold red" if note.alarm else "")
    )
    return grid


def shown(*, quiet: bool) -> "Quiet":
    """Return a context manager that shows the progress of a run, or nothing if `quiet`."""
    if quiet:
        return Quiet()
    return Table() if sys.stderr.isatty() else Lines()


@contextmanager
def reading(text: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that gets the bytes read and all bytes, and shows them after `text`."""
    with shown(quiet=quiet) as display:
        yield partial(display.show_bytes, text)


@contextmanager
def ended_by_signals(end: Callable[[], object], *, words: bytes = _ENDING) -> Iterator[None]:
    """Call `end` at the first Ctrl-C or SIGTERM, and print `words`. The second signal interrupts as usual.

    A run then ends as at the end of a recording.
    """
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}

    def stop(signum: int, frame: FrameType | None) -> None:
        for each, handler in before.items():
            signal.signal(each, handler)
        end()
        with suppress(OSError):  # the reader of stderr may have gone away
            os.write(2, words)  # safe in a signal handler, unlike `print`

    for signum in before:
        signal.signal(signum, stop)
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


class Quiet:
    """Takes progress and shows nothing. Base class of the displays."""

    def __init__(self) -> None:
        self._run = RunProgress()
        self._fusing, self._reading = Rates(), Rates()

    def __enter__(self) -> "Quiet":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def stage(self, text: str) -> None:
        """Show which stage of the run begins."""

    def say(self, text: str) -> None:
        """Show an important line, also if the user wants no progress."""
        typer.echo(text, err=True)

    def update(
        self, total: int | None, stats: "ClientStats", *, link: str = "", scan: "ScanState | None" = None
    ) -> None:
        """Show the counts; see `Progress`."""
        self.show(self._run.screen(total, stats, link, scan))

    def show_fused(self, read: int, fused: int, total: int) -> None:
        """Show how many keyframes of a journal are read, and how many of these are in the map."""
        self.show(Screen(fused_rows(read, fused, total, self._fusing)))

    def show_bytes(self, text: str, done: int, total: int) -> None:
        """Show how many bytes are read, after `text`."""
        self.show(Screen([byte_row(text, done, total, self._reading)]))

    def show_steps(self, text: str, done: int, total: int) -> None:
        """Show how many steps are done, after `text`."""
        self.show(Screen([step_row(text, done, total)]))

    def show(self, screen: Screen) -> None:
        """Show a screen in place of the last one."""


class Lines(Quiet):
    """Shows a line for each stage, and one for the counts every few seconds."""

    def __init__(self) -> None:
        super().__init__()
        self._last = time.monotonic()

    def stage(self, text: str) -> None:
        typer.echo(f"{text} …", err=True)
        self._last = time.monotonic()

    def show(self, screen: Screen) -> None:
        if time.monotonic() - self._last >= _LINE_INTERVAL:
            self._last = time.monotonic()
            typer.echo(screen.line(), err=True)


class Table(Quiet):
    """Shows a line for each stage, and below a table with bars, redrawn a few times a second."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        super().__init__()
        self._console = Console(stderr=True, highlight=False)
        self._screen = Screen()
        self._shown_at: float | None = None  # time.monotonic(); None while no counts are expected
        self._live = Live(
            console=self._console,
            get_renderable=self._table,
            refresh_per_second=_DRAWINGS,
            transient=True,
            redirect_stdout=False,  # Taichi would take a wrapped stdout for a notebook, and print so
            redirect_stderr=False,
        )
        self._warnings = _Warnings(self._console)

    def __enter__(self) -> "Table":
        logging.getLogger("tsfusion").addHandler(self._warnings)
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()
        logging.getLogger("tsfusion").removeHandler(self._warnings)

    def stage(self, text: str) -> None:
        self._shown_at = None
        self.say(text)

    def say(self, text: str) -> None:
        self._console.print(f"[cyan]›[/] {text}", highlight=False, soft_wrap=True)

    def show(self, screen: Screen) -> None:
        self._screen, self._shown_at = screen, time.monotonic()

    def _table(self) -> "RenderableType":
        """Return the present table. A thread draws it, so that it can also say that no counts come."""
        still = 0.0 if self._shown_at is None else time.monotonic() - self._shown_at
        trouble = f"nothing came for {span(still)}" if still > STILL else ""
        return self._screen.table(self._console.width, trouble=trouble)


class _Warnings(logging.Handler):
    """Prints warnings above the table. Otherwise the table would be drawn over them."""

    def __init__(self, console: "Console") -> None:
        super().__init__(logging.WARNING)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        text = printable(record.getMessage())
        self._console.print(text, style="yellow", markup=False, highlight=False)


def page_beside(view: str | None, display: "Quiet", *, truth: str | None = None) -> "ViewerChild | None":
    """Return a child process that shows a run's map on a web page, and print the page's address.

    Args:
        view: HOST:PORT; None for no page.
        truth: known surface of the map; see `ViewerChild`.

    Raises:
        MissingDependency, InvalidConfig, TransportError: when the page cannot be shown.
    """
    if view is None:
        return None
    from tsfusion.pipelines.runs.viewer_child import ViewerChild

    return ViewerChild(view, lambda url: display.say(f"page {url}"), truth=truth)


def print_page_again(view: str | None, folder: str, connect: str | None) -> None:
    """Print how to see the map again, after a run with a page.

    Args:
        folder: folder of the run's results.
        connect: address of the server elsewhere that has the map; None if the folder has the map.
    """
    if view is not None:
        typer.echo(f"page       tsfusion view {connect or folder}")
