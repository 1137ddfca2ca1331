# SPDX-License-Identifier: MIT
"""Manage the tiles, colours and cut that browsers see: shared by all, or chosen by one."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.limits import Bucket
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import Up
from tsfusion.viewer.map import map_tiles
from tsfusion.viewer.map.map_tiles import CellKey, MapTiles
from tsfusion.viewer.map.tile_nodes import ROOT, TileNodes
from tsfusion.viewer.map.vertex_colors import VertexColors

if TYPE_CHECKING:
    import viser

MOST_UNREAD = 64  # messages to a browser


class TileLook:
    """Colours of tiles, and their nodes in a scene."""

    def __init__(self, tiles: MapTiles, colors: VertexColors, nodes: TileNodes) -> None:
        self._tiles, self.colors, self.nodes = tiles, colors, nodes

    def changed(self, keys: Iterable[CellKey]) -> None:
        """Handle tiles with new triangles. Tiles not shown yet are shown before their values arrive."""
        keys = set(keys)
        if self.colors.is_asked_for:
            found = {key: self._tiles.tiles[key] for key in keys if key in self._tiles.tiles}
            keys = {key for key in keys if key not in found or not self.nodes.has(key)}
            self.colors.values.ask(found)
        self.nodes.changed(keys)

    def choose(self, mode: str) -> None:
        self.colors.choose(mode)
        self.colors.fit_scale()
        self.changed(self._tiles.tiles)

    def refresh(self, up: NDArray[np.float64]) -> None:
        """Take new values, and fit the colour scale to the shown tiles."""
        self.colors.up = up
        if self.colors.fit_scale():
            self.nodes.changed(self._tiles.tiles)

    def clear(self) -> None:
        self.nodes.clear()
        self.colors.choose(self.colors.mode)

    def mesh(self, up: Up | None) -> Mesh:
        """Return the shown surface as a mesh, in the map's frame."""
        parts = [self.nodes.shown_mesh(key, tile) for key, tile in list(self._tiles.tiles.items())]
        return map_tiles.whole(parts, up)


class OwnLook(TileLook):
    """Tiles and colours of one browser, which replace the shared ones once they are complete."""

    def __init__(
        self, client: "viser.ClientHandle", tiles: MapTiles, colors: VertexColors, bucket: Bucket
    ) -> None:
        nodes = TileNodes(client.scene, tiles, colors, bucket, root="/own", keeps=False)
        super().__init__(tiles, colors, nodes)
        self._client = client
        self._missing = set(tiles.tiles)
        self._cover: viser.FrameHandle | None = None  # its node replaces the shared root and hides it

    def send(self, now: float) -> None:
        """Send due tiles, unless too many messages to the browser are unread."""
        unread = self._client._websock_connection.get_message_buffer().message_from_id
        if len(unread) > MOST_UNREAD:
            return
        self.nodes.send(now)
        self._missing &= set(self.nodes.waiting)
        if not self._missing and self._cover is None:
            self._cover = self._client.scene.add_frame(ROOT, show_axes=False, visible=False)

    def close(self) -> None:
        self.colors.values.close()
        if self._cover is not None:
            self._cover.remove()
        self.nodes.clear()
