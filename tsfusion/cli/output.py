# SPDX-License-Identifier: MIT
"""What a person sees while a run goes, and after it. Progress goes to stderr, results to stdout."""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import msgspec
import typer

if TYPE_CHECKING:
    from tsfusion.pipelines.replay import Progress
    from tsfusion.pipelines.replay_results import RunSummary


_PLAIN_INTERVAL = 2.0  # seconds between plain lines


def as_json(value: Any) -> None:
    """Print a struct or dict as indented JSON on stdout."""
    typer.echo(json.dumps(msgspec.to_builtins(value), indent=2, ensure_ascii=False))


def as_json_line(value: Any) -> None:
    """Print a struct or dict as one line of JSON on stdout."""
    typer.echo(json.dumps(msgspec.to_builtins(value), ensure_ascii=False))


def grouped(number: float) -> str:
    """1234567 → 1 234 567."""
    return f"{number:,.0f}".replace(",", "\u202f")


def size(count: float) -> str:
    """Bytes as a person reads them."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


@contextmanager
def progress(*, quiet: bool) -> "Iterator[Progress]":
    """Bars with rate and ETA on a terminal, plain lines elsewhere, nothing when `quiet`."""
    if quiet:
        from tsfusion.pipelines.replay import Silent

        yield Silent()
    elif sys.stderr.isatty():
        with Bars() as bars:
            yield bars
    else:
        yield Lines()


class Lines:
    """A line a stage, and one every few seconds while keyframes go."""

    def __init__(self) -> None:
        self._last = self._started = 0.0

    def stage(self, text: str) -> None:
        """Announce it."""
        typer.echo(f"{text} …", err=True)
        self._started = self._last = time.monotonic()

    def count(self, sent: int, fused: int, total: int) -> None:
        """Say how far it is, unless that was said just now."""
        now = time.monotonic()
        if now - self._last < _PLAIN_INTERVAL:
            return
        self._last = now
        rate = fused / (now - self._started)
        left = f", {(total - fused) / rate:.0f} s left" if rate else ""
        typer.echo(f"  sent {sent}, fused {fused} of {total} ({rate:.1f}/s{left})", err=True)


class Bars:
    """A spinner for the stage; bars for keyframes sent and fused."""

    def __init__(self) -> None:
        from rich import progress as rp
        from rich.console import Console

        self._bars = rp.Progress(
            rp.SpinnerColumn(finished_text="✓"),
            rp.TextColumn("{task.description}"),
            rp.BarColumn(bar_width=32),
            rp.TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            rp.TextColumn("{task.fields[rate]}"),
            rp.TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
            redirect_stdout=False,  # Taichi takes a wrapped stdout for a notebook, and says so
            redirect_stderr=False,
        )
        self._stage: Any = None
        self._tasks: list[Any] = []
        self._started = 0.0

    def __enter__(self) -> "Bars":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def stage(self, text: str) -> None:
        """Tick off the last stage and turn the spinner for this one."""
        self._bars.console.print(f"[cyan]›[/] {text}", highlight=False)
        self._started = time.monotonic()

    def count(self, sent: int, fused: int, total: int) -> None:
        """Move the bars."""
        if not self._tasks:
            self._tasks = [self._bars.add_task(name, total=total, rate="") for name in ("sent ", "fused")]
        elapsed = max(time.monotonic() - self._started, 1e-3)
        for task, done in zip(self._tasks, (sent, fused), strict=True):
            self._bars.update(task, completed=done, rate=f"{done / elapsed:.1f}/s")


@contextmanager
def reading(text: str, *, quiet: bool) -> "Iterator[Callable[[int, int], None]]":
    """What to call with the bytes read and the bytes of all: a bar on a terminal, plain lines elsewhere."""
    if quiet:
        yield lambda _done, _all: None
    elif sys.stderr.isatty():
        from rich import progress as rp
        from rich.console import Console

        columns = (
            rp.TextColumn("{task.description}"), rp.BarColumn(bar_width=32), rp.DownloadColumn(),
            rp.TransferSpeedColumn(), rp.TimeRemainingColumn(),
        )  # fmt: skip
        with rp.Progress(*columns, console=Console(stderr=True), transient=True) as bars:
            task = bars.add_task(text, total=None)
            yield lambda done, total: bars.update(task, completed=done, total=total)
    else:
        yield _ByteLines(text).count


class _ByteLines:
    """A line every few seconds: short jobs say nothing."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._last = time.monotonic()

    def count(self, done: int, total: int) -> None:
        now = time.monotonic()
        if now - self._last >= _PLAIN_INTERVAL:
            self._last = now
            typer.echo(f"{self._text}: {size(done)} of {size(total)}", err=True)


def summary(run: "RunSummary", out: Any) -> None:
    """A run in a few lines."""
    delay = run.delay_ms
    lines = [
        f"keyframes  {run.keyframes_fused}/{run.keyframes_sent} fused in {run.seconds:.1f} s",
        f"delay      mean {delay.mean:.0f} ms, p50 {delay.p50:.0f}, p95 {delay.p95:.0f}, "
        f"p99 {delay.p99:.0f}, max {delay.max:.0f}; slope {run.delay_slope_ms_per_keyframe:+.2f} ms/keyframe",
        f"mesh       {grouped(run.mesh['vertices'])} vertices, {grouped(run.mesh['triangles'])} triangles",
        f"map        {grouped(run.blocks)} blocks, hash {run.map_hash}",
        "memory     " + ", ".join(f"{name} {size(peak)}" for name, peak in run.peak_rss_bytes.items()),
    ]
    if run.keyframes_rejected:
        reasons = "; ".join(f"{count} × {reason}" for reason, count in run.keyframes_rejected.items())
        lines.insert(1, f"rejected   {reasons}")
    if run.accuracy is not None:
        error = run.accuracy
        lines.append(
            f"accuracy   mean {error.mean_mm:.2f} mm, p50 {error.p50_mm:.2f}, p95 {error.p95_mm:.2f} mm "
            "from the known surface"
        )
    lines.append(f"results    {out}/: mesh.ply mesh.glb preview.png delay.csv delay.png run.json")
    typer.echo("\n".join(lines))
