# SPDX-License-Identifier: MIT
"""Plot a server's delay, queue and memory; write the state of maps and scanners as escaped HTML."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from tsfusion.core.readable_numbers import counted, grouped, size
from tsfusion.viewer.map.vertex_colors import hex_color, item_color
from tsfusion.wire.messages.health import ClientHealth, Health

if TYPE_CHECKING:
    import viser

_MOST = 600  # most stored samples
_HEIGHT = 130  # pixels
_TEXT = "font-size:.85em;line-height:1.5;padding:0 .9em .4em .6em;overflow-wrap:anywhere"
_GOOD, _BAD = "#009e73", "#d55e00"
_ADDRESS = 40  # most shown characters of a name


class HealthPlots:
    """Plots of a server's health, hidden until data comes. Beyond `_MOST` samples, every second one goes."""

    def __init__(self, gui: "viser.GuiApi") -> None:
        self._rows: list[tuple[float, ...]] = []
        self._stride, self._count, self._fused = 1, 0, -1
        self._plots = [
            _plot(gui, "Delay (ms)", ("median", "95 %")),
            _plot(gui, "Keyframes waiting", ("in the server", "at scanners")),
            _plot(gui, "Memory (MB)", ("map", "gateway")),
        ]

    def clear(self) -> None:
        self._rows.clear()
        self._stride, self._count, self._fused = 1, 0, -1

    def note(self, health: Health, map_name: str, now_s: float) -> None:
        """Add a sample of the server's health at time `now_s` to the plots."""
        found = health.maps.get(map_name)
        if found is None:
            return
        spooled = sum(client.waiting for client in health.clients if client.map == map_name)
        before, self._fused = self._fused, found.keyframes_fused
        if before == found.keyframes_fused and not found.waiting and not spooled:
            return
        self._count += 1
        if self._count % self._stride:
            return
        delays = (found.delay_ms.p50, found.delay_ms.p95) if found.delay_ms.count else (np.nan, np.nan)
        sizes = (found.map_bytes / 1e6, health.rss_bytes / 1e6)
        self._rows.append((now_s, *delays, found.waiting, spooled, *sizes))
        if len(self._rows) > _MOST:
            self._rows, self._stride = self._rows[::2], 2 * self._stride

    def draw(self) -> None:
        """Send the samples to the plots in browsers."""
        if len(self._rows) < 2:
            return
        columns = np.array(self._rows, np.float64).T
        for index, plot in enumerate(self._plots):
            plot.data = (columns[0], columns[1 + 2 * index], columns[2 + 2 * index])
            plot.visible = True


def _plot(gui: "viser.GuiApi", title: str, names: tuple[str, str]) -> "viser.GuiUplotHandle":
    from viser import uplot

    lines = [
        uplot.Series(label=name, stroke=hex_color(item_color(index)), width=2, points={"show": False})
        for index, name in enumerate(names)
    ]
    empty = np.zeros(1)
    return gui.add_uplot(
        (empty, empty, empty),
        (uplot.Series(label="after s"), *lines),
        title=f"{title}, over time (s)",
        height=_HEIGHT,
        scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
        visible=False,
    )


def summary(title: str, map_name: str, problem: str, facts: Sequence[str], problems: Sequence[str]) -> str:
    """Return the head of a panel as HTML: the watched map, its state, and its problems.

    Args:
        problem: why the watched map is missing; empty = it is shown.
        problems: problems of the server, one sentence each.
    """
    color, word = (_BAD, escape(problem)) if problem else (_GOOD, "connected")
    dot = f'<span style="color:{color}">{"▲" if problem else "●"}</span>'
    name = f" · {escape(map_name)}" if map_name and map_name not in title else ""
    style = "font:inherit;font-weight:700;display:inline"
    head = (
        f'<h1 style="{style}" data-shown="{escape(map_name or title)}">{escape(title)}</h1>'  # page_head.html
    )
    lines = [head + name, f"{dot} {word}", " · ".join(map(escape, facts))]
    text = "".join(f"<div>{line}</div>" for line in lines if line)
    return f'<div style="{_TEXT}">{text}{"".join(map(_warning, problems))}</div>'


def tables(health: Health, map_name: str, order: Sequence[str]) -> str:
    """Return tables of every scanner and every map of a server.

    `order`: the first 8 hexadecimal digits of the sessions that have a colour in the scene.
    """
    clients = sorted(
        health.clients, key=lambda client: (client.map != map_name, client.client, client.session)
    )
    scanners = [_scanner(client, map_name, order) for client in clients]
    maps = [
        (
            escape(_short(name)),
            found.state,
            grouped(found.keyframes_fused),
            grouped(found.waiting),
            size(found.map_bytes),
        )
        for name, found in sorted(health.maps.items())
    ]
    lost = counted(health.refused)
    notes = [f"refused by the server: {lost}"] if lost else []
    for name, found in sorted(health.maps.items()):
        if counted(found.rejected):
            notes.append(f"{name}: not fused: {counted(found.rejected)}")
    return (
        f'<div style="{_TEXT}">'
        + _table(("scanner", "state", "in map", "of", "waiting"), scanners or [("none", "", "", "", "")])
        + _table(("map", "state", "keyframes", "waiting", "size"), maps)
        + "".join(f"<div>{escape(note)}</div>" for note in notes)
        + "</div>"
    )


def text(content: str) -> str:
    """Return HTML `content` as an HTML paragraph."""
    return f'<div style="{_TEXT}">{content}</div>'


def _scanner(client: ClientHealth, map_name: str, order: Sequence[str]) -> tuple[str, ...]:
    name = escape(_short(client.client or client.session))
    if client.session in order and client.map == map_name:
        name = f'<span style="color:{hex_color(item_color(order.index(client.session)))}">■</span> {name}'
    elif client.map != map_name:
        name += f" → {escape(_short(client.map))}"
    state = f'<span style="color:{_BAD}">{escape(client.held)}</span>' if client.held else client.state
    return name, state, grouped(client.fused), grouped(client.durable), grouped(client.waiting)


def _table(head: Iterable[str], rows: Iterable[tuple[str, ...]]) -> str:
    left, right = "text-align:left;padding:.1em .5em .1em 0", "text-align:right;padding:.1em 0 .1em .5em"

    def row(cells: Iterable[str], tag: str) -> str:
        weight = "600" if tag == "th" else "400"
        styled = (
            f'<{tag} style="{left if index < 2 else right};font-weight:{weight}">{cell}</{tag}>'
            for index, cell in enumerate(cells)
        )
        return f"<tr>{''.join(styled)}</tr>"

    body = "".join(row(cells, "td") for cells in rows)
    return f'<table style="width:100%;border-collapse:collapse;margin:.3em 0">{row(head, "th")}{body}</table>'


def _warning(sentence: str) -> str:
    style = f"border-left:3px solid {_BAD};padding-left:.5em;margin-top:.3em"
    return f'<div style="{style}">{escape(sentence)}</div>'


def _short(name: str) -> str:
    return name if len(name) <= _ADDRESS else name[: _ADDRESS - 1] + "…"
