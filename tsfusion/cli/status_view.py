# SPDX-License-Identifier: MIT
"""A server's health on one screen, for a person."""

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from tsfusion.cli.health_poll import ServerSnapshot
from tsfusion.cli.output import size
from tsfusion.core.logs import printable
from tsfusion.wire.health import ClientHealth, Health, MapHealth, Status
from tsfusion.wire.keyframe_times import Spread

MAX_CLIENTS = 40  # rows: the clients with the newest messages
_STATE_STYLES = {"idle": "green", "busy": "green", "failed": "bold red"}


def render(snapshot: ServerSnapshot) -> RenderableType:
    """Problems first, then the server, its maps, its clients, and what it refused."""
    parts: list[RenderableType] = [Text(f"✗ {printable(one)}", style="bold red") for one in snapshot.problems]
    if snapshot.health is None:
        return Group(*parts)
    maps = {name: one for name, one in snapshot.health.maps.items() if snapshot.only in ("", name)}
    parts += [_server(snapshot.address, snapshot.health), _maps(maps)]
    parts += [note for name, one in maps.items() for note in _notes(name, one)]
    parts += [_details(name, status) for name, status in snapshot.maps.items()]
    parts += [
        Text(printable(f"map {name}: hash and settings are not known now: {why}"), style="yellow")
        for name, why in snapshot.unavailable.items()
    ]
    if clients := [one for one in snapshot.health.clients if snapshot.only in ("", one.map)]:
        parts += _clients(clients)
    if snapshot.health.refused:
        parts.append(Text(f"refused messages: {_reasons(snapshot.health.refused)}", style="yellow"))
    return Group(*parts)


def _server(address: str, health: Health) -> Text:
    line = Text(f"{printable(address)}  ")
    line.append(*("ready", "bold green") if health.ready else ("not ready", "bold red"))
    line.append(f"  up {_duration(health.uptime_s)}, gateway {size(health.rss_bytes)}")
    if health.duplicates:
        line.append(f", {health.duplicates} duplicates")
    return line


def _maps(maps: dict[str, MapHealth]) -> RenderableType:
    table = _table(
        "map", "state", ">keyframes\nfused/all", ">keyframes\nwaiting", ">delay, ms\nmean/p95/max",
        ">blocks\nof 8³", ">memory\nMB", ">journal\nMB", ">last\nago",
    )  # fmt: skip
    for name, one in maps.items():
        table.add_row(
            _plain(name), _plain(one.state, style=_STATE_STYLES.get(one.state, "yellow")),
            f"{one.keyframes_fused}/{one.keyframes_durable}", _waiting(one.waiting),
            _delay(one.delay_ms, one.delay_bound_ms), str(one.blocks), _megabytes(one.map_bytes),
            _megabytes(one.journal_bytes), _duration(one.last_keyframe_s),
        )  # fmt: skip
    return table


def _clients(clients: list[ClientHealth]) -> list[RenderableType]:
    corrects = any(one.corrections for one in clients)
    refuses = any(one.refused or one.rejected for one in clients)
    table = _table(
        "client", "session", "map", "state", ">keyframes\nfused/all", ">keyframes\nwaiting",
        "keyframes\nleft out", ">received\nMB", "held", *([">keyframes\nrefused"] if refuses else ()),
        *([">correc-\ntions"] if corrects else ()),
    )  # fmt: skip
    latest = sorted(clients, key=lambda one: (one.state == "gone", one.heard_s))
    for one in latest[:MAX_CLIENTS]:
        table.add_row(
            _plain(one.client or "-"), _plain(one.session), _plain(one.map), _presence(one),
            f"{one.fused}/{one.durable}", _waiting(one.waiting), Text(_reasons(one.skipped), style="yellow"),
            _megabytes(one.received_bytes), _plain(one.held, style="yellow"),
            *([_waiting(one.refused + one.rejected)] if refuses else ()),
            *([str(one.corrections)] if corrects else ()),
            style="dim" if one.state == "gone" else "",
        )  # fmt: skip
    more = len(latest) - MAX_CLIENTS
    return [table, Text(f"and {more} more sessions")] if more > 0 else [table]


def _presence(one: ClientHealth) -> Text:
    """Whether a client is there; else for how long it has not been heard."""
    if one.state == "connected":
        return Text(one.state, style="green")
    return Text(f"{one.state} {_duration(one.heard_s)}", style="yellow" if one.state == "silent" else "")


def _details(name: str, status: Status) -> Text:
    """The hash, settings and memory of a map, which only its fuser knows."""
    volume = status.config.get("volume", {})
    settings = ", ".join(f"{key} {volume[key]}" for key in ("voxel_size", "sensor") if key in volume)
    peak = status.peak_rss_bytes.get("fuser", 0)
    return _plain(
        f"map {name}: hash {status.map_hash}, {settings}, fuser {size(peak)} at most, {status.state}"
    )


def _delay(delay: Spread, bound_ms: float) -> str:
    if not delay.count:
        return "–"
    return f"{delay.mean:.0f}/{delay.p95:.0f}/{delay.max:.0f} ±{bound_ms:.1g}"


def _notes(name: str, one: MapHealth) -> list[Text]:
    """Counts that are zero for a map that is well."""
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


def _waiting(count: int) -> Text:
    return Text(str(count), style="yellow" if count else "")


def _megabytes(count: int) -> str:
    megabytes = count / 1e6
    return f"{megabytes:.0f}" if megabytes >= 100 else f"{megabytes:.1f}"


def _duration(seconds: float | None) -> str:
    """3725 → 1 h 2 min."""
    if seconds is None:
        return "–"
    minutes, hours, days = int(seconds // 60), int(seconds // 3600), int(seconds // 86400)
    if days:
        return f"{days} d {hours % 24} h"
    if hours:
        return f"{hours} h {minutes % 60} min"
    return f"{minutes} min {int(seconds % 60)} s" if minutes else f"{seconds:.1f} s"


def _table(*titles: str) -> Table:
    """A table; a title that begins with `>` stands over numbers."""
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 1, 0, 0))
    for title in titles:
        table.add_column(
            title.removeprefix(">"), overflow="fold", justify="right" if title.startswith(">") else "left"
        )
    return table


def _plain(text: str, *, style: str = "") -> Text:
    """Text that clients or files may have chosen: no terminal commands, no markup."""
    return Text(printable(text), style=style)
