# SPDX-License-Identifier: MIT
"""Draw a server's health on one screen."""

import time

from msgspec.structs import replace
from rich.console import Console, Group, RenderableType
from rich.segment import Segment, Segments
from rich.table import Table
from rich.text import Text

from tsfusion.cli.health_poll import ServerSnapshot
from tsfusion.cli.output import size
from tsfusion.cli.progress import styled
from tsfusion.core.logs import printable
from tsfusion.core.readable_numbers import span
from tsfusion.wire.messages.health import (
    ClientHealth,
    Health,
    MapHealth,
    Spread,
    headline,
    lost_of_client,
    lost_of_map,
)

MAX_CLIENTS = 40  # rows, for the clients with the newest messages
WIDE = 110  # minimum columns to show all figures
_STATE_STYLES = {"idle": "green", "busy": "green", "failed": "bold red"}
_PROMPT = 1.0  # seconds until an answer counts as missing


def render(snapshot: ServerSnapshot, width: int, *, silent: float = 0.0) -> RenderableType:
    """Return a headline, then problems, the server, its maps, its clients, and refused messages.

    Args:
        width: columns of the terminal; below `WIDE` some figures are left out.
        silent: seconds since the server's last answer, if one is missing; 0 if the server answers.
    """
    parts: list[RenderableType] = []
    if silent:
        parts.append(Text(f"✗ no answer for {span(silent)}", style="bold red"))
    elif snapshot.health is not None:
        still = {**snapshot.still, **snapshot.stalled}
        parts.append(styled(headline(snapshot.health, only=snapshot.only, rate=snapshot.rate, still=still)))
    if silent and snapshot.health is not None:
        parts += [_problem(snapshot.error)] if snapshot.error else []
        parts.append(Text("as it was then:", style="dim"))
    parts += map(_problem, snapshot.problems)
    if snapshot.health is None:
        return Group(*parts)
    is_wide = width >= WIDE
    maps = {name: one for name, one in snapshot.health.maps.items() if snapshot.only in ("", name)}
    parts += [_server(snapshot.address, snapshot.health), _maps(maps, is_wide=is_wide)]
    parts += [note for name, one in maps.items() for note in _notes(name, one)]
    if clients := [one for one in snapshot.health.clients if snapshot.only in ("", one.map)]:
        parts += _clients(clients, is_wide=is_wide)
    if snapshot.health.refused:
        parts.append(Text(f"refused messages: {_reasons(snapshot.health.refused)}", style="yellow"))
    if snapshot.maps or snapshot.older:
        parts.append(_settings(snapshot, is_wide=is_wide))
    parts += [
        Text(printable(f"map {name}: hash and settings are not known now: {why}"), style="yellow")
        for name, why in snapshot.unavailable.items()
    ]
    return Group(*parts)


def _problem(text: str) -> Text:
    return Text(f"✗ {printable(text)}", style="bold red")


def _server(address: str, health: Health) -> Text:
    line = Text(f"{printable(address)}  ")
    line.append(*("ready", "bold green") if health.ready else ("not ready", "bold red"))
    line.append(f"  up {span(health.uptime_s)}, gateway {size(health.rss_bytes)}")
    if health.duplicates:
        line.append(f", {health.duplicates} duplicates")
    return line


def _maps(maps: dict[str, MapHealth], *, is_wide: bool) -> RenderableType:
    delay = ">delay, ms\nmean/p95/max" if is_wide else ">delay\nms, p95"
    more = (">blocks\nof 8³", ">journal\nMB") if is_wide else ()
    table = _table(
        "map", "state:10", ">keyframes\nfused/all:13", ">\nwaiting:7", ">\nlost:5", delay,
        ">memory\nMB:6", *more, ">last\nago:6",
    )  # fmt: skip
    for name, one in maps.items():
        table.add_row(
            _plain(name), _plain(one.state, style=_STATE_STYLES.get(one.state, "yellow")),
            f"{one.keyframes_fused}/{one.keyframes_durable}", _count(one.waiting),
            _count(lost_of_map(one), "bold red"), _delay(one.delay_ms, one.delay_bound_ms, is_wide=is_wide),
            _megabytes(one.map_bytes), *((str(one.blocks), _megabytes(one.journal_bytes)) if is_wide else ()),
            _span(one.last_keyframe_s),
        )  # fmt: skip
    return table


def _clients(clients: list[ClientHealth], *, is_wide: bool) -> list[RenderableType]:
    more = (">received\nMB:8",) if is_wide else ()
    table = _table(
        "client", *(["session"] if is_wide else []), "map", "state:10", ">keyframes\nfused/all:13",
        ">\nwaiting:7", ">\nlost:5", *more, "",
    )  # fmt: skip
    latest = sorted(clients, key=lambda one: (one.state == "gone", one.heard_s))
    for one in latest[:MAX_CLIENTS]:
        name = one.client or ("-" if is_wide else one.session)
        table.add_row(
            _plain(name), *([_plain(one.session)] if is_wide else []), _plain(one.map), _presence(one),
            f"{one.fused}/{one.durable}", _count(one.waiting), _count(lost_of_client(one), "bold red"),
            *([_megabytes(one.received_bytes)] if is_wide else ()), _remarks(one),
            style="dim" if one.state == "gone" else "",
        )  # fmt: skip
    rest = len(latest) - MAX_CLIENTS
    return [table, Text(f"and {rest} more sessions")] if rest > 0 else [table]


def _remarks(one: ClientHealth) -> Text:
    """Return counts that are zero for a healthy client, and why the server takes nothing of it."""
    turned_away = {"refused": one.refused, "rejected": one.rejected}
    words = [_reasons(one.skipped), _reasons({name: count for name, count in turned_away.items() if count})]
    line = _plain("; ".join(filter(None, [*words, one.held and f"held: {one.held}"])), style="yellow")
    if one.corrections:
        line.append(f"{'; ' if line.plain else ''}{one.corrections} × corrected")
    return line


def _presence(one: ClientHealth) -> Text:
    """Return the state of a client; unless it is connected, also the time since its last message."""
    if one.state == "connected":
        return Text(one.state, style="green")
    return Text(f"{one.state} {span(one.heard_s)}", style="yellow" if one.state == "silent" else "")


def _settings(snapshot: ServerSnapshot, *, is_wide: bool) -> RenderableType:
    """Return settings, memory and hash of each map, as its fuser knows them. A busy map has no hash."""
    table = _table(
        "map", ">voxel size", "sensor", ">fuser's memory", "hash", *(["folder"] if is_wide else [])
    )
    for name, status in {**snapshot.older, **snapshot.maps}.items():
        volume = status.config.get("volume", {})
        peak = size(status.peak_rss_bytes.get("fuser", 0))
        known = name in snapshot.maps
        table.add_row(
            _plain(name), f"{volume.get('voxel_size', '–')} m", _plain(str(volume.get("sensor", "–"))), peak,
            _plain(status.map_hash if known else "(known when nothing waits)", style="" if known else "dim"),
            *([_plain(status.state)] if is_wide else []),
        )  # fmt: skip
    return table


def _delay(delay: Spread, bound_ms: float, *, is_wide: bool) -> str:
    if not delay.count:
        return "–"
    whole = f"{delay.mean:.0f}/{delay.p95:.0f}/{delay.max:.0f} ±{bound_ms:.1g}"
    return whole if is_wide else f"{delay.p95:.0f}"


def _notes(name: str, one: MapHealth) -> list[Text]:
    """Return counts that are zero for a healthy map, and figures of its questions."""
    counts = {
        "quarantined": one.quarantined, "× the fuser restarted": one.fuser_restarts,
        "damaged records": one.journal_damaged,
        "keyframes still to be moved to corrected poses": one.corrections_waiting,
        "corrected keyframes that cannot be moved": one.corrections_unavailable,
    }  # fmt: skip
    notes = [f"{count} {what}" for what, count in counts.items() if count]
    if one.rejected:
        notes.append(f"rejected: {_reasons(one.rejected)}")
    lines = [Text(f"map {printable(name)}: {', '.join(notes)}", style="yellow")] if notes else []
    if one.questions:
        took = one.question_ms
        lines.append(
            Text(
                f"map {printable(name)}: questions {_reasons(one.questions)}, "
                f"answered in {took.p50:.1f} ms (p95 {took.p95:.1f}, at most {took.max:.1f})"
            )
        )
    return lines


def _reasons(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} × {printable(reason)}" for reason, count in sorted(counts.items()))


def _count(count: int, style: str = "yellow") -> Text:
    return Text(str(count), style=style if count else "")


def _megabytes(count: int) -> str:
    megabytes = count / 1e6
    return f"{megabytes:.0f}" if megabytes >= 100 else f"{megabytes:.1f}"


def _span(seconds: float | None) -> str:
    return "–" if seconds is None else span(seconds)


def _table(*titles: str) -> Table:
    """Return a table. A title with `>` is for a column of figures; `:7` = at least 7 columns wide."""
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 1, 0, 0))
    for title in titles:
        words, _, least = title.removeprefix(">").partition(":")
        is_figure = title.startswith(">")
        table.add_column(
            words, overflow="fold", justify="right" if is_figure else "left", no_wrap=is_figure,
            min_width=int(least) if least else None,
        )  # fmt: skip
    return table


def _plain(text: str, *, style: str = "") -> Text:
    """Return safe text from clients or files: without terminal commands and markup."""
    return Text(printable(text), style=style)


class StatusScreen:
    """Screen of a server's state. One thread brings the server's answers, another draws."""

    def __init__(self, console: Console, address: str) -> None:
        self._console = console
        self._snapshot = ServerSnapshot(address=address, error=f"no answer yet from {address}")
        self._asked: float | None = None  # time.monotonic() of a question without an answer so far
        self._failed = False  # True if the last question got no answer
        self._answered = time.monotonic()

    def ask(self) -> None:
        """Remember that the server is asked now."""
        self._asked = time.monotonic()

    def answer(self, snapshot: ServerSnapshot) -> None:
        """Remember an answer."""
        self._snapshot, self._failed, self._asked = snapshot, False, None
        self._answered = time.monotonic()

    def fail(self, error: str) -> None:
        """Remember that no answer came, and why."""
        self._snapshot = replace(self._snapshot, error=error)
        self._failed, self._asked = True, None

    def whole(self) -> RenderableType:
        """Return the present state. If an answer is missing, return the last state and its age."""
        now, asked = time.monotonic(), self._asked
        is_missing = self._failed or (asked is not None and now - asked > _PROMPT)
        return render(self._snapshot, self._console.width, silent=now - self._answered if is_missing else 0.0)

    def cut(self) -> RenderableType:
        """Return the lines that fit on the terminal, and how many lines do not."""
        height, whole = self._console.height, self.whole()
        lines = self._console.render_lines(whole, pad=False)
        if len(lines) <= height:
            return whole
        shown = [segment for line in lines[: height - 1] for segment in (*line, Segment.line())]
        rest = len(lines) - height + 1
        return Group(Segments(shown), Text(f"{rest} lines more: a taller window shows them", style="dim"))
