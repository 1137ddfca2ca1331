# SPDX-License-Identifier: MIT
"""Progress of a run on stderr: a table that moves on a terminal, plain lines elsewhere, or nothing."""

import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING

import typer

from tsfusion.cli.progress_rows import STILL, RunProgress, Screen, byte_row, fused_rows, step_row
from tsfusion.core.logs import printable
from tsfusion.core.rates import Rates
from tsfusion.core.readable_numbers import span

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from tsfusion.client import ClientStats
    from tsfusion.pipelines.runs.viewer_child import ViewerChild
    from tsfusion.scanner.scanner import ScanState

_LINE_INTERVAL = 2.0  # seconds between plain lines
_DRAWINGS = 5  # of a table, a second
_ENDING = b"\nending: what is on its way is finished (press Ctrl-C again to end at once)\n"


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


@contextmanager
def ended_by_signals(end: Callable[[], object]) -> Iterator[None]:
    """Call `end` at the first Ctrl-C or SIGTERM: the run ends as at the end of a recording.

    The second one interrupts as usual.
    """
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}

    def stop(signum: int, frame: FrameType | None) -> None:
        for each, handler in before.items():
            signal.signal(each, handler)
        end()
        with suppress(OSError):  # of a reader that went away
            os.write(2, _ENDING)  # safe inside a handler, which `print` is not

    for signum in before:
        signal.signal(signum, stop)
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


class Quiet:
    """Progress that is not shown."""

    def __init__(self) -> None:
        self._run = RunProgress()
        self._fusing, self._reading = Rates(), Rates()

    def __enter__(self) -> "Quiet":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def stage(self, text: str) -> None:
        """Show which part of the run begins."""

    def say(self, text: str) -> None:
        """Show a line that matters even to who wants no progress."""
        typer.echo(text, err=True)

    def update(
        self, total: int | None, stats: "ClientStats", *, link: str = "", scan: "ScanState | None" = None
    ) -> None:
        """Show the counts; see `Progress`."""
        self.show(self._run.screen(total, stats, link, scan))

    def show_fused(self, read: int, fused: int, total: int) -> None:
        """Show how many keyframes of a journal are read, and how many of those are in the map."""
        self.show(Screen(fused_rows(read, fused, total, self._fusing)))

    def show_bytes(self, text: str, done: int, total: int) -> None:
        """Show how much is read, after `text`."""
        self.show(Screen([byte_row(text, done, total, self._reading)]))

    def show_steps(self, text: str, done: int, total: int) -> None:
        """Show how many steps are done, after `text`."""
        self.show(Screen([step_row(text, done, total)]))

    def show(self, screen: Screen) -> None:
        """Show this in place of what was shown last."""


class Lines(Quiet):
    """A line for each stage, and one for the counts every few seconds."""

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
    """A line for each stage, and below a table with bars, drawn again a few times a second."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        super().__init__()
        self._console = Console(stderr=True, highlight=False)
        self._screen = Screen()
        self._shown_at: float | None = None  # time.monotonic(); None = no counts are to come now
        self._live = Live(
            console=self._console,
            get_renderable=self._table,
            refresh_per_second=_DRAWINGS,
            transient=True,
            redirect_stdout=False,  # Taichi takes a wrapped stdout for a notebook, and says so
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
        """The table now. A thread draws it, so that it also says when nothing comes any more."""
        still = 0.0 if self._shown_at is None else time.monotonic() - self._shown_at
        trouble = f"nothing came for {span(still)}" if still > STILL else ""
        return self._screen.table(self._console.width, trouble=trouble)


class _Warnings(logging.Handler):
    """Warnings go above the table, which would be drawn over them."""

    def __init__(self, console: "Console") -> None:
        super().__init__(logging.WARNING)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        text = printable(record.getMessage())
        self._console.print(text, style="yellow", markup=False, highlight=False)


def page_beside(view: str | None, display: "Quiet", *, truth: str | None = None) -> "ViewerChild | None":
    """The page, whose address is shown where the run's progress is.

    Args:
        view: HOST:PORT; None = no page.
        truth: known surface of the map; see `ViewerChild`.

    Raises:
        MissingDependency, InvalidConfig, TransportError: when it cannot be shown.
    """
    if view is None:
        return None
    from tsfusion.pipelines.runs.viewer_child import ViewerChild

    return ViewerChild(view, lambda url: display.say(f"page {url}"), truth=truth)


def print_page_again(view: str | None, folder: str, connect: str | None) -> None:
    """Say how the map of a run that had a page is seen again.

    Args:
        folder: of the run's results.
        connect: address of the server elsewhere that has the map; None = the folder has it.
    """
    if view is not None:
        typer.echo(f"page       tsfusion view {connect or folder}")
