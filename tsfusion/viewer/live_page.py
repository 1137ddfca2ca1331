# SPDX-License-Identifier: MIT
"""Show a map and its changes, which a feed reports as events, in browsers: the live page."""

import logging
import sys
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.limits import Bucket
from tsfusion.core.readable_numbers import grouped
from tsfusion.geometry.mesh import Mesh
from tsfusion.viewer.map import map_views
from tsfusion.viewer.map.map_tiles import CellKey
from tsfusion.viewer.map.map_views import PageCamera
from tsfusion.viewer.map.scanner_marks import ScannerMarks
from tsfusion.viewer.map.tile_nodes import OwnLook, TileLook, TileNodes
from tsfusion.viewer.map.vertex_colors import VertexColors
from tsfusion.viewer.map_feed import MapFeed
from tsfusion.viewer.page.page_server import calm
from tsfusion.viewer.panels.browser_panel import BrowserPanel, set_theme
from tsfusion.viewer.panels.shared_panel import SharedPanel
from tsfusion.viewer.shown_feed import ShownFeed, rest

if TYPE_CHECKING:
    import viser

MAX_BYTES_PER_SECOND = 8e6  # to each browser, as triangles
_BEHIND = 50  # voxels that a following camera is behind a scanner
_SLIDER_REST_S = 0.25  # seconds that a time slider rests before the map is rewound
_DRAW_SHARE = 0.01  # share of a core for sending tiles and marks: repeated changes are sent once
_DRAW = (0.2, 0.3)  # least and most seconds between two messages to browsers
_OFTEN, _SELDOM = 0.3, 1.0  # seconds between two updates of cameras, and of scales and states
_FAREWELL = 0.5  # seconds that browsers have to receive the last message of a page

log = logging.getLogger(__name__)


class LivePage(ShownFeed):
    """Web page that shows a map from a feed. All browsers share it, except for their `BrowserPanel`.

    Args:
        server: viser's server, which the caller closes.
        feed: feed of the map, which the caller closes.
        measures: more quantities to colour by. A name may end with a unit, `error [m]`. Each function gives
            (n,) values at (n, 3) points in metres, NaN = no value; it is called on another thread.
        max_bytes_per_second: average bytes of triangles to each browser.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        feed: MapFeed,
        *,
        measures: Mapping[str, Callable[[NDArray[np.float32]], NDArray[np.floating]]] | None = None,
        max_bytes_per_second: float = MAX_BYTES_PER_SECOND,
    ) -> None:
        marks = ScannerMarks(server.scene)
        super().__init__(feed, marks)
        self._server = server
        self._measures = measures or {}
        shared, self._own_bucket = (Bucket(max_bytes_per_second, self._began, burst=1.0) for _ in range(2))
        colors = self._new_colors()
        self.shared = TileLook(self._tiles, colors, TileNodes(server.scene, self._tiles, colors, shared))
        self._whole_views = map_views.WholeViews(self._tiles)
        self._browsers: dict[int, BrowserPanel] = {}
        self._next_draw = self._looked = self._reckoned = -np.inf
        self._lock = threading.Lock()  # guards `_browsers`
        set_theme(server.gui, dark=False)
        self._panel = SharedPanel(server.gui, feed, marks.show)
        server.on_client_connect(calm(self._welcome))
        server.on_client_disconnect(calm(self._part))

    def run(self, stop: threading.Event, *, memory_bytes: int = sys.maxsize) -> None:
        """Show the feed's map and its changes until `stop` is set.

        Raises MemoryError if this process takes more than `memory_bytes`, or a TsfusionError of the feed.
        """
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")  # a browser that left
        try:
            super().run(stop, memory_bytes=memory_bytes)
        finally:
            for look in self._looks():
                look.colors.values.close()

    def tell_end(self, sentence: str) -> None:
        """Show `sentence`, the reason why the page ends, in every browser, and wait until it is sent."""
        self._problem, self._health = sentence, None
        self._reckon()
        self._server.flush()
        time.sleep(_FAREWELL if self._browsers else 0.0)

    @property
    def is_watched(self) -> bool:
        return bool(self._browsers)

    def _told(self) -> None:
        if self._health is not None:
            self._panel.plots.note(self._health, self.map_name, time.monotonic() - self._began)

    def _changed(self, keys: set[CellKey]) -> None:
        for look in self._looks():
            look.changed(keys)

    def _cleared(self, *, is_other: bool) -> None:
        for look in self._looks():
            look.clear()
            look.nodes.voxel_size = self.voxel_size
        self._whole_views.forget()
        if is_other:
            self._panel.plots.clear()

    def _looks(self) -> list[TileLook]:
        return [self.shared, *(one.own for one in self._panels() if one.own is not None)]

    def _panels(self) -> list[BrowserPanel]:
        with self._lock:
            return list(self._browsers.values())

    def _new_colors(self) -> VertexColors:
        colors = VertexColors(self._tiles, self._feed.weights, self._measures)
        colors.name_clients(self._marks.name)
        return colors

    def _step(self, now: float) -> None:
        self._obey(now)
        for look in self._looks():
            look.nodes.changed(look.colors.values.take_ready())
        if now >= self._reckoned + _SELDOM:
            self._reckoned = now
            self._reckon()
        if not self._browsers:
            return
        is_due = self._marks.is_due(now) or any(look.nodes.is_due(now) for look in self._looks())
        if now >= self._next_draw and is_due:
            began = time.thread_time()
            with self._server.atomic():  # else each message wakes the web server's thread
                self.shared.nodes.send(now)
                self._marks.draw(now)
            for browser in self._panels():
                calm(BrowserPanel.send)(browser, now)
            self._next_draw = now + rest(began, _DRAW_SHARE, _DRAW)
        if now >= self._looked + _OFTEN:
            self._looked = now
            for browser in self._panels():
                calm(BrowserPanel.update)(browser)

    def _obey(self, now: float) -> None:
        """Carry out what people chose in browsers: another map, another time, other colours."""
        orders = self._panel.take_orders(now, _SLIDER_REST_S)
        if orders.map_name is not None and orders.map_name != self.map_name:
            self._feed.choose(orders.map_name)
        if orders.place is not None:
            self._feed.seek(orders.place)
        for browser in self._panels():
            if browser.is_changed:
                self._next_draw = now
                calm(BrowserPanel.change_look)(browser)

    def _reckon(self) -> None:
        """Compute the up direction, colour scales and slider ranges anew, and show the server's state."""
        before = self._up.up
        self._up.look(self._tiles)
        if self._up.up != before:
            self._server.scene.set_up_direction(self._up.direction)
            self._looked = -np.inf  # update cameras at once: the poses that browsers report turn, too
        self._whole_views.refresh(self._up.direction)
        for look in self._looks():
            look.refresh(self._up.direction)
        bounds = [tile.bounds for tile in list(self._tiles.tiles.values())]
        if bounds:
            low = np.min([one[0] for one in bounds], axis=0).astype(np.float64)
            high = np.max([one[1] for one in bounds], axis=0).astype(np.float64)
            for browser in self._panels():
                calm(BrowserPanel.fit)(browser, low, high, self._up.direction)
        if not self._browsers:
            return
        with self._server.atomic():
            facts = [f"{grouped(self._tiles.triangles)} triangles"] if bounds else ["nothing seen yet"]
            self._panel.tell(
                map_name=self.map_name,
                problem=self._problem,
                facts=facts,
                health=self._health,
                sessions=self._marks.sessions,
            )

    def _welcome(self, client: "viser.ClientHandle") -> None:
        panel = BrowserPanel(client, self, self._panel.view, self._panel.cut, self.shared.colors.names)
        with self._lock:
            self._browsers[client.client_id] = panel

    def _part(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            panel = self._browsers.pop(client.client_id, None)
        if panel is not None and panel.own is not None:
            panel.own.colors.values.close()

    # Questions of the browsers' panels

    def whole_view(self, aspect: float, covered: float) -> PageCamera | None:
        """Return a camera that shows the whole map; see `map_views.whole`."""
        return self._whole_views.of(aspect, covered)

    def scanner_view(self, session: bytes) -> PageCamera | None:
        """Return a camera behind a scanner; None if its pose is unknown."""
        pose, up = self._marks.pose(session), self._up.direction
        return None if pose is None else map_views.behind(pose, up, distance=50 * self.voxel_size)

    def scanners(self) -> list[tuple[bytes, str]]:
        """Return the sessions and names of all scanners."""
        return [(session, self._marks.name(session)) for session in self._marks.sessions]

    def new_look(self, client: "viser.ClientHandle") -> OwnLook:
        look = OwnLook(client, self._tiles, self._new_colors(), self._own_bucket)
        look.nodes.voxel_size, look.colors.up = self.voxel_size, self._up.direction
        return look

    def hit(
        self, look: TileLook, origin: NDArray[np.float64], direction: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Return the (3,) point at which a ray meets the shown surface; None without one."""
        return map_views.first_hit(self._tiles, look.nodes.clipping, origin, direction)

    def shown_mesh(self, look: TileLook) -> Mesh:
        """Return the shown surface as a mesh, in the map's frame."""
        return look.mesh(self._up.up)
