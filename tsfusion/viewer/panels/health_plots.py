# SPDX-License-Identifier: MIT
"""Delay, queue and memory of a server while keyframes come, over the time that a page has been open."""

from typing import TYPE_CHECKING

import numpy as np

from tsfusion.geometry.color_scales import as_hex, of_number
from tsfusion.wire.messages.health import Health

if TYPE_CHECKING:
    import viser

_MOST = 600  # moments that are kept
_HEIGHT = 130  # pixels


class HealthPlots:
    """Three plots, hidden until something is known; what has ended stays. Of a long time half is dropped."""

    def __init__(self, gui: "viser.GuiApi") -> None:
        self._rows: list[tuple[float, ...]] = []
        self._stride, self._count, self._fused = 1, 0, -1
        self._plots = [
            _plot(gui, "Delay (ms)", ("median", "95 %")),
            _plot(gui, "Keyframes waiting", ("in the server", "at scanners")),
            _plot(gui, "Memory (MB)", ("map", "gateway")),
        ]

    def clear(self) -> None:
        """Begin anew."""
        self._rows.clear()
        self._stride, self._count, self._fused = 1, 0, -1

    def note(self, health: Health, map_name: str, now_s: float) -> None:
        """Take the health of a moment into account."""
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
        """Show what has been noted."""
        if len(self._rows) < 2:
            return
        columns = np.array(self._rows, np.float64).T
        for index, plot in enumerate(self._plots):
            plot.data = (columns[0], columns[1 + 2 * index], columns[2 + 2 * index])
            plot.visible = True


def _plot(gui: "viser.GuiApi", title: str, names: tuple[str, str]) -> "viser.GuiUplotHandle":
    from viser import uplot

    lines = [
        uplot.Series(label=name, stroke=as_hex(of_number(index)), width=2, points={"show": False})
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
