# SPDX-License-Identifier: MIT
"""Build the panel that all browsers of a page share: the shown map, and the state of the server."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from tsfusion.core.readable_numbers import grouped
from tsfusion.viewer.map_feed import MapFeed, TimeLine
from tsfusion.viewer.page.page_server import calm
from tsfusion.viewer.panels import health_plots
from tsfusion.viewer.panels.health_plots import HealthPlots
from tsfusion.wire.messages.health import Health

if TYPE_CHECKING:
    import viser


_MARKS = {"scanners": "Scanners", "paths": "Paths", "first paths": "Paths before corrections"}


@dataclass
class Orders:
    """Choices that people made in browsers since the last `take_orders`; None = none.

    Attributes:
        map_name: map to show.
        place: number of keyframes after which to show the map.
    """

    map_name: str | None = None
    place: int | None = None


class SharedPanel:
    """Panel that all browsers share: controls and figures in three tabs.

    `show` is called to show or hide objects in the scene. Attributes `view`, `cut`: containers for a
    browser's own controls.
    """

    def __init__(self, gui: "viser.GuiApi", feed: MapFeed, show: Callable[[str, bool], None]) -> None:
        self._feed = feed
        self._orders, self._lock, self._slid_at = Orders(), threading.Lock(), 0.0
        self._wanted_map: str | None = None  # chosen map, until it is shown
        gui.set_panel_label("tsfusion")
        gui.main_panel.dock_right()
        self._head = gui.add_html(health_plots.summary(feed.title, "", "", ["waiting for the map"], ()))
        tabs = gui.add_tab_group()
        with tabs.add_tab("View") as self.view:
            self._map: Any = self._choice_of_maps(gui)
            self._time: Any = self._time_slider(gui)
            for what, label in _MARKS.items():
                box: Any = gui.add_checkbox(label, True)
                box.on_update(calm(partial(_show, show, what)))
        self.cut = tabs.add_tab("Cut")
        with tabs.add_tab("State"):
            self._tables = gui.add_html(health_plots.text("No server is watched."))
            self.plots = HealthPlots(gui)

    def take_orders(self, now: float, rest_s: float) -> Orders:
        """Return what people chose in browsers; a time slider counts once it has rested `rest_s` seconds."""
        with self._lock:
            orders, self._orders = self._orders, Orders()
            if orders.place is not None and now < self._slid_at + rest_s:
                self._orders.place, orders.place = orders.place, None
        return orders

    def tell(
        self,
        *,
        map_name: str,
        problem: str,
        facts: Sequence[str],
        health: Health | None,
        sessions: Sequence[bytes],
    ) -> None:
        """Show the state of the map and of the server in the panel."""
        found = None if health is None else health.maps.get(map_name)
        if found is not None:
            facts = [*facts, f"{grouped(found.keyframes_fused)} keyframes"]
            facts += [f"{grouped(found.waiting)} waiting"] if found.waiting else []
        problems = () if health is None else health.problems
        self._head.content = health_plots.summary(self._feed.title, map_name, problem, facts, problems)
        if health is not None:
            order = [session.hex()[:8] for session in sessions]
            self._tables.content = health_plots.tables(health, map_name, order)
        self.plots.draw()
        names = tuple(self._feed.maps())
        if len(names) > 1:
            if tuple(self._map.options) != names:
                self._map.options = names
            self._map.visible = True
            if self._wanted_map in {None, map_name}:
                self._wanted_map = None
                self._map.value = map_name if map_name in names else self._map.value
        self._fit_time(self._feed.time_line)

    def _choice_of_maps(self, gui: "viser.GuiApi") -> Any:
        names = tuple(self._feed.maps()) or ("",)
        choice = gui.add_dropdown("Map", names, initial_value=names[0], visible=len(names) > 1)
        choice.on_update(calm(self._note_map))
        return choice

    def _time_slider(self, gui: "viser.GuiApi") -> Any:
        slider = gui.add_slider("Keyframe", 0, 1, 1, 1, visible=False, hint="The map as it was after so many")
        slider.on_update(calm(self._note_place))
        return slider

    def _fit_time(self, line: TimeLine | None) -> None:
        self._time.visible = line is not None and line.keyframes > 0
        if line is not None and line.keyframes > 0 and self._time.max != line.keyframes:
            at_end = self._time.value >= self._time.max
            self._time.max = line.keyframes
            if at_end:
                self._time.value = line.keyframes

    def _note_place(self, event: Any) -> None:
        if event.client is None:  # moved by the page itself
            return
        with self._lock:
            self._orders.place, self._slid_at = int(event.target.value), time.monotonic()

    def _note_map(self, event: Any) -> None:
        name = event.target.value
        if event.client is not None and name in self._map.options:  # only the page's thread may use the feed
            with self._lock:
                self._orders.map_name = self._wanted_map = name


def _show(show: Callable[[str, bool], None], what: str, event: Any) -> None:
    show(what, bool(event.target.value))
