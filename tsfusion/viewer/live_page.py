# SPDX-License-Identifier: MIT
"""The live page: what a feed tells of a map, in a browser."""

import logging
import sys
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.core.readable_numbers import grouped
from tsfusion.geometry.mesh import Mesh
from tsfusion.viewer import map_tiles, map_views, pointed_surface
from tsfusion.viewer.browser_panel import BrowserPanel, set_theme
from tsfusion.viewer.calm_callbacks import calm
from tsfusion.viewer.map_feed import MapFeed
from tsfusion.viewer.map_tiles import MapTiles
from tsfusion.viewer.map_up import MapUp
from tsfusion.viewer.map_views import View
from tsfusion.viewer.scanner_marks import ScannerMarks
from tsfusion.viewer.shared_panel import SharedPanel
from tsfusion.viewer.tile_nodes import TileNodes
from tsfusion.viewer.vertex_colors import VertexColors
from tsfusion.wire.health import Health
from tsfusion.wire.map_events import (
    Cleared,
    HealthSeen,
    LinkSeen,
    MapEvent,
    PathsFound,
    ScannerSeen,
    SurfaceUpdate,
)

if TYPE_CHECKING:
    import viser

MAX_BYTES_PER_SECOND = 8e6  # to each browser, as triangles
_WAIT = 0.1  # seconds that are waited for an event
_SHARE = 0.008  # of a core, for putting updates into tiles: many at once cost little more than one
_TOGETHER = (0.25, 1.5)  # seconds of updates that are taken at once, at least and at most
_MOST_UPDATES = 64  # that wait for that
_BEHIND = 50  # voxels that a following camera is behind a scanner
_SETTLED = 0.25  # seconds that a time slider rests before the map is rewound
_DRAW_SHARE = 0.01  # of a core, for sending tiles and marks: what changes meanwhile is sent once
_DRAW = (0.25, 1.0)  # seconds between two sendings to browsers, at least and at most
_OFTEN, _SELDOM = 0.3, 1.0  # seconds between two looks at cameras, and at scales and states

log = logging.getLogger(__name__)


class LivePage:
    """A page that shows what a feed tells. Everything is shared by its browsers but for `BrowserPanel`.

    Args:
        server: to fill; whoever made it ends it.
        feed: of the map; whoever made it closes it.
        measures: further quantities to colour by. Each has a name that may end with its unit, `error [m]`,
            and gives (n,) values at (n, 3) points in metres; NaN = none there. Called on another thread.
        max_bytes_per_second: of triangles to each browser, on average.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        feed: MapFeed,
        *,
        measures: Mapping[str, Callable[[NDArray[np.float32]], NDArray[np.floating]]] | None = None,
        max_bytes_per_second: float = MAX_BYTES_PER_SECOND,
    ) -> None:
        self._server, self._feed = server, feed
        self._began = time.monotonic()
        self.map_name, self.voxel_size = "", 0.02
        self._health: Health | None = None
        self._problem = ""
        self._up = MapUp()
        self._tiles = MapTiles()
        self._updates: list[SurfaceUpdate] = []  # that have yet to be applied
        self._next_apply = -np.inf
        self._colors = VertexColors(self._tiles, feed.weights, measures or {})
        self._nodes = TileNodes(
            server.scene,
            self._tiles,
            self._colors,
            max_bytes_per_second=max_bytes_per_second,
            now=self._began,
        )
        self._marks = ScannerMarks(server.scene)
        self._colors.name_clients(self._marks.name)
        self._whole_views = map_views.WholeViews(self._tiles)
        self._browsers: dict[int, BrowserPanel] = {}
        self._next_draw = self._looked = self._reckoned = -np.inf
        self._lock = threading.Lock()  # of `_browsers`
        set_theme(server.gui, dark=False)
        self._panel = SharedPanel(server.gui, feed, self._colors.names, self._marks.show)
        server.on_client_connect(calm(self._welcome))
        server.on_client_disconnect(calm(self._part))

    def run(self, stop: threading.Event, *, memory_bytes: int = sys.maxsize) -> None:
        """Show what happens until `stop` is set.

        Args:
            memory_bytes: that this process may take.

        Raises:
            MemoryError: when it takes more.
            TsfusionError: of the feed.
        """
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # a browser that left
        try:
            while not stop.is_set():
                for event in self._feed.events(_WAIT):
                    self._take(event)
                self._step(time.monotonic())
                if process.rss_bytes() > memory_bytes:
                    raise MemoryError(f"a page may take {memory_bytes >> 20} MB, and it takes more")
        finally:
            self._colors.values.close()

    def _take(self, event: MapEvent) -> None:
        now = time.monotonic()
        match event:
            case Cleared():
                self._clear(event)
            case SurfaceUpdate():
                self._up.note_given(event.mesh.known_up)
                self._updates.append(event)
                if len(self._updates) >= _MOST_UPDATES:
                    self._apply(now)
            case ScannerSeen():
                self._up.note_scanner(event)
                self._marks.note_seen(event)
            case PathsFound():
                self._up.note_paths(event)
                self._marks.note_paths(event)
            case HealthSeen():
                self._health = event.health
                self._panel.plots.note(event.health, self.map_name, now - self._began)
            case LinkSeen():
                self._problem = event.problem

    def _apply(self, now: float) -> None:
        """Put the updates that have come into the tiles."""
        began = time.thread_time()
        keys = self._tiles.apply_all(self._updates, now - self._began)
        rest = _rest(began, _SHARE, _TOGETHER) if self._browsers else _TOGETHER[1]
        self._updates, self._next_apply = [], now + rest
        if not self._colors.is_asked_for:
            self._nodes.changed(keys)
        self._ask(keys)

    def _clear(self, event: Cleared) -> None:
        self._updates.clear()
        self._nodes.clear()
        self._tiles.clear()
        self._whole_views.forget()
        self._marks.clear()
        self._colors.choose(self._colors.mode)
        if event.map != self.map_name:
            self._panel.plots.clear()
            self._up = MapUp()
        self.map_name, self.voxel_size = event.map, event.voxel_size
        self._nodes.voxel_size = self._marks.voxel_size = event.voxel_size

    def _ask(self, keys: set[map_tiles.Key]) -> None:
        """Ask for the values of tiles, where they come from elsewhere; without any they are shown at once."""
        if not self._colors.is_asked_for:
            return
        found = {key: self._tiles.tiles[key] for key in keys if key in self._tiles.tiles}
        self._nodes.changed(key for key in keys if key not in found or not self._nodes.has(key))
        self._colors.values.ask(found)

    def _step(self, now: float) -> None:
        """Work between two looks at the feed."""
        if self._updates and now >= self._next_apply:
            self._apply(now)
        self._obey(now)
        self._nodes.changed(self._colors.values.take_ready())
        if now >= self._reckoned + _SELDOM:
            self._reckoned = now
            self._reckon()
        if not self._browsers:
            return
        if now >= self._next_draw and (self._nodes.is_due(now) or self._marks.is_due(now)):
            began = time.thread_time()
            with self._server.atomic():  # else each message wakes the web server's thread
                self._nodes.send(now)
                self._marks.draw(now)
            self._next_draw = now + _rest(began, _DRAW_SHARE, _DRAW)
        if now >= self._looked + _OFTEN:
            self._looked = now
            with self._lock:
                browsers = list(self._browsers.values())
            for browser in browsers:
                calm(BrowserPanel.update)(browser)

    def _obey(self, now: float) -> None:
        """Do what browsers have asked for."""
        orders = self._panel.take_orders(now, _SETTLED)
        if orders.map_name is not None and orders.map_name != self.map_name:
            self._feed.choose(orders.map_name)
        if orders.place is not None:
            self._feed.seek(orders.place)
        if orders.mode is not None:
            self._colors.choose(orders.mode)
            self._reckoned = now
            self._reckon()
            if not self._colors.is_asked_for:
                self._nodes.changed(self._tiles.tiles)
            self._ask(set(self._tiles.tiles))
        if orders.is_clipping:
            self._next_draw = now
            self._nodes.clip(self._panel.clipping.clipping)

    def _reckon(self) -> None:
        """Bring up direction, scales and states up to date."""
        before = self._up.up
        self._up.look(self._tiles)
        self._colors.up = self._up.direction
        if self._up.up != before:
            self._server.scene.set_up_direction(self._up.direction)
            self._looked = -np.inf  # cameras follow at once: what browsers tell of them is turned, too
        self._whole_views.refresh(self._up.direction)
        if self._colors.fit_scale():
            self._nodes.changed(self._tiles.tiles)
        bounds = [tile.bounds for tile in list(self._tiles.tiles.values())]
        if bounds:
            low = np.min([one[0] for one in bounds], axis=0).astype(np.float64)
            high = np.max([one[1] for one in bounds], axis=0).astype(np.float64)
            self._panel.clipping.fit(low, high, self._up.direction)
        if not self._browsers:
            return
        with self._server.atomic():
            facts = [f"{grouped(self._tiles.triangles)} triangles"] if bounds else ["nothing seen yet"]
            self._panel.tell(
                map_name=self.map_name,
                problem=self._problem,
                facts=facts,
                health=self._health,
                legend=self._colors.legend(),
                sessions=self._marks.sessions,
            )

    def _welcome(self, client: "viser.ClientHandle") -> None:
        panel = BrowserPanel(client, self, self._panel.place)
        with self._lock:
            self._browsers[client.client_id] = panel

    def _part(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            self._browsers.pop(client.client_id, None)

    # What the panels of browsers ask

    def whole_view(self, aspect: float, covered: float) -> View | None:
        """See `browser_panel.Shown`, with what follows."""
        return self._whole_views.of(aspect, covered)

    def scanner_view(self, session: bytes) -> View | None:
        pose = self._marks.pose(session)
        return (
            None
            if pose is None
            else map_views.behind(pose, self._up.direction, distance=50 * self.voxel_size)
        )

    def scanners(self) -> list[tuple[bytes, str]]:
        return [(session, self._marks.name(session)) for session in self._marks.sessions]

    def hit(self, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64] | None:
        return pointed_surface.first_hit(self._tiles, self._nodes.clipping, origin, direction)

    def shown_mesh(self) -> Mesh:
        parts = [self._nodes.shown_mesh(key, tile) for key, tile in list(self._tiles.tiles.items())]
        return map_tiles.whole(parts, self._up.up)


def _rest(began: float, share: float, bounds: tuple[float, float]) -> float:
    """Seconds after which work that began at `began` (`time.thread_time`) has had its share of a core."""
    return min(max((time.thread_time() - began) / share, bounds[0]), bounds[1])
