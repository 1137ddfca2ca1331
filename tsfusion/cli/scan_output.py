# SPDX-License-Identifier: MIT
"""What a person sees while a scan goes, and after it. Progress goes to stderr, results to stdout."""

import logging
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tsfusion.cli import output
from tsfusion.core.logs import printable

if TYPE_CHECKING:
    from rich.console import Console

    from tsfusion.evaluation.trajectory_error import TrajectoryError
    from tsfusion.pipelines.scan import ScanProgress
    from tsfusion.pipelines.scan_results import MapResult, ScanSummary
    from tsfusion.scanner.scanner import ScanState


_LINE_INTERVAL = 2.0  # seconds
_DRAW_INTERVAL = 0.2
_RATE_SECONDS = 5.0  # over which rates are counted


@contextmanager
def watching(*, quiet: bool) -> "Iterator[ScanProgress]":
    """A table that moves on a terminal, plain lines elsewhere, nothing when `quiet`."""
    if quiet:
        yield _Silent()
    elif sys.stderr.isatty():
        with _Table() as table:
            yield table
    else:
        yield _Lines()


class _Silent:
    def stage(self, text: str) -> None:
        """Nothing."""

    def scan(self, state: "ScanState", length: int | None) -> None:
        """Nothing."""


class _Rates:
    """Frames and keyframes a second, over the last seconds."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int, int]] = deque()

    def __call__(self, state: "ScanState") -> tuple[float, float]:
        now = time.monotonic()
        self._seen.append((now, state.frames, sum(state.selected.values())))
        while now - self._seen[0][0] > _RATE_SECONDS:
            self._seen.popleft()
        then, frames, keyframes = self._seen[0]
        seconds = max(now - then, 1e-3)
        return (state.frames - frames) / seconds, (sum(state.selected.values()) - keyframes) / seconds


class _Lines:
    """A line a stage, and one every few seconds while frames come."""

    def __init__(self) -> None:
        self._last = time.monotonic()
        self._rates = _Rates()

    def stage(self, text: str) -> None:
        typer.echo(f"{text} …", err=True)

    def scan(self, state: "ScanState", length: int | None) -> None:
        rates = self._rates(state)
        if time.monotonic() - self._last >= _LINE_INTERVAL:
            self._last = time.monotonic()
            words = "; ".join(f"{name} {value}" for name, value in _rows(state, length, rates) if value)
            typer.echo(f"  {words}", err=True)


class _Above(logging.Handler):
    """Warnings go above the table, which would be drawn over them."""

    def __init__(self, console: "Console") -> None:
        super().__init__(logging.WARNING)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        text = printable(record.getMessage())
        self._console.print(text, style="yellow", markup=False, highlight=False)


class _Table:
    """The scan's state in a few rows, drawn anew a few times a second."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._console = Console(stderr=True)
        self._live = Live(
            console=self._console, auto_refresh=False, transient=True, redirect_stdout=False,
            redirect_stderr=False,
        )  # fmt: skip
        self._drawn = 0.0
        self._rates = _Rates()
        self._above = _Above(self._console)

    def __enter__(self) -> "_Table":
        logging.getLogger("tsfusion").addHandler(self._above)
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()
        logging.getLogger("tsfusion").removeHandler(self._above)

    def stage(self, text: str) -> None:
        self._console.print(f"[cyan]›[/] {text}", highlight=False)

    def scan(self, state: "ScanState", length: int | None) -> None:
        rates = self._rates(state)
        if time.monotonic() - self._drawn < _DRAW_INTERVAL:
            return
        self._drawn = time.monotonic()
        from rich.table import Table
        from rich.text import Text

        table = Table.grid(padding=(0, 2))
        for name, value in _rows(state, length, rates):
            style = "bold red" if name == "sensor" and state.state == "lost" else ""
            table.add_row(Text(name, style="dim"), Text(value, style=style))
        self._live.update(table, refresh=True)


def _rows(state: "ScanState", length: int | None, rates: tuple[float, float]) -> list[tuple[str, str]]:
    """What there is to see: name and words."""
    stats = state.stats
    given_up = {**stats.refused, **stats.rejected, **stats.skipped}
    delay = f", delay {state.keyframe_delay_ms:.0f} ms" if state.keyframe_delay_ms is not None else ""
    return [
        ("sensor", _sensor(state)),
        ("frames", f"{state.frames}{f' of {length}' if length else ''}, {rates[0]:.1f}/s"),
        ("keyframes", f"{sum(state.selected.values())}, {rates[1]:.1f}/s"),
        ("to send", f"{stats.waiting} ({output.size(stats.waiting_bytes)})"),
        ("server", f"{stats.durable} acknowledged, {stats.fused} fused{delay}"),
        ("link", state.link),
        ("left out", _counts(given_up)),
    ]


def _sensor(state: "ScanState") -> str:
    words = state.state if not state.why else f"{state.state}: {state.why}"
    if state.submaps > 1:
        words += f"; map {state.submap} ({state.submaps} so far)"
    return words + (f"; {state.loops} loops closed" if state.loops else "")


def _counts(counts: dict[str, int]) -> str:
    return "; ".join(f"{count} × {reason}" for reason, count in counts.items() if count)


def summary(result: "ScanSummary", out: Path, spool: Path, connect: str | None) -> None:
    """A scan in a few lines; `connect`: the server elsewhere that has the map."""
    delay = result.delay_ms
    ended = "" if result.complete else "; the source was not read to its end"
    lines = [
        f"frames     {result.frames_tracked}/{result.frames} localised by {result.localizer}, "
        f"{result.tracking_cpu_ms:.0f} CPU ms each{ended}",
        f"keyframes  {result.keyframes_sent} sent, {result.keyframes_durable} acknowledged, "
        f"{result.keyframes_fused} fused ({_counts(result.keyframes_by_rule)})",
        f"delay      mean {delay.mean:.0f} ms, p50 {delay.p50:.0f}, p95 {delay.p95:.0f}, max {delay.max:.0f}"
        if delay.count
        else "delay      not known: nothing was fused yet",
    ]
    if result.frames_skipped:
        lines.append(f"left out   {_counts(result.frames_skipped)}")
    if result.keyframes_rejected:
        lines.append(f"rejected   {_counts(result.keyframes_rejected)}")
    for found in result.maps:
        lines += _map_lines(found)
    if result.left:
        why = f" ({result.link})" if result.link else ""
        lines.append(
            f"spool      {result.left} keyframes are not acknowledged{why}: the next scan with "
            f"--spool {spool} sends them"
        )
    lines.append(f"results    {out}/")
    if connect is not None and result.keyframes_durable:
        lines.append(
            f"mesh       tsfusion mesh {connect} {result.maps[0].name}.glb --map {result.maps[0].name}"
        )
    typer.echo("\n".join(lines))


def _map_lines(found: "MapResult") -> list[str]:
    mesh = f", {output.grouped(found.mesh['triangles'])} triangles" if found.mesh else ""
    lines = [f"map        {found.name}: {found.frames} frames, {found.keyframes} keyframes{mesh}"]
    if found.trajectory_error is not None:
        lines.append(f"ATE        {ate(found.trajectory_error)}")
    if found.corrected_error is not None:
        lines.append(f"  loops    {ate(found.corrected_error)} ({found.loops} loops)")
    return lines


def ate(error: "TrajectoryError") -> str:
    """The table of the field in a line, millimetres below a metre."""
    unit, factor = ("mm", 1000.0) if error.rmse < 1 else ("m", 1.0)
    figures: list[tuple[str, Any]] = [
        (name, factor * getattr(error, name)) for name in ("rmse", "mean", "median", "std", "min", "max")
    ]
    words = ", ".join(f"{name} {value:.3g}" for name, value in figures)
    return f"{words} {unit}; drift {error.drift_percent:.2g} % of {error.length:.3g} m"
