# SPDX-License-Identifier: MIT
"""Send a map's changed tiles to browsers, as nodes of the scene with colours and clipping: only the newest
version, within a limit of bytes a second."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.limits import Bucket
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import Up
from tsfusion.viewer.map import map_tiles, tile_glb
from tsfusion.viewer.map.clipping import Clipping, ClipSide
from tsfusion.viewer.map.map_tiles import CELL, CellKey, MapTiles, Tile
from tsfusion.viewer.map.vertex_colors import VertexColors

if TYPE_CHECKING:
    import viser

# Least seconds between two versions of a tile. A browser drops a model as soon as it gets another one, but
# shows that only after parsing. So a tile uses two nodes in turn, and the old one stays meanwhile. A node
# costs viser ten times as much to make as to change, so an emptied node is kept for some time.
PAUSE = 1.0
STEADY_PAUSE = 2.0  # for a tile that changes all the time: half the work, and nobody sees the difference
_SPARED = 5.0  # seconds that an empty node is kept after its last version
_SOON = 0.5  # seconds; a change this soon after a pause means a tile that changes all the time
_CUT_PAUSE = 0.25  # while somebody moves the clip plane
ROOT = "/map"  # prefix of the nodes' names
_MARGIN = 1.0  # share of a tile's edge by which its triangles may stick out
MOST_UNREAD = 64  # messages to a browser


class TileNodes:
    """Nodes of tiles in the scene; changed tiles are sent, the longest waiting tile first.

    Args:
        bucket: limit of bytes a second, for all tiles together.
        root: prefix of the nodes' names.
        keeps: True if browsers that connect later get the tiles sent before.
    """

    def __init__(
        self,
        scene: "viser.SceneApi",
        tiles: MapTiles,
        colors: VertexColors,
        bucket: Bucket,
        *,
        root: str = ROOT,
        keeps: bool = True,
    ) -> None:
        self._root, self._keeps = root, keeps
        self._scene, self._tiles, self._colors = scene, tiles, colors
        self._bucket = bucket
        self.waiting: dict[CellKey, None] = {}  # in the order of sending
        self._sent_at: dict[CellKey, float] = {}
        self._pauses: dict[CellKey, float] = {}  # seconds until the next version
        self._sides: dict[CellKey, ClipSide] = {}  # side of the version in the scene
        self._nodes: dict[CellKey, viser.GlbHandle] = {}
        self._last: dict[CellKey, tuple[viser.GlbHandle, float]] = {}  # old versions, removal times
        self._spare: dict[CellKey, tuple[viser.GlbHandle, float]] = {}  # empty nodes, removal times
        self._cut: set[CellKey] = set()  # tiles that wait because of a new clipping
        self._hidden: set[CellKey] = set()  # tiles that changed while hidden
        self.clipping = Clipping()
        self.voxel_size = 1.0
        self.bytes_sent = 0

    def is_due(self, now: float) -> bool:
        ends = (end for nodes in (self._last, self._spare) for _, end in nodes.values())
        return any(now >= end for end in ends) or any(now >= self._due(key) for key in self.waiting)

    def has(self, key: CellKey) -> bool:
        return key in self._nodes

    def clear(self) -> None:
        older = (node for nodes in (self._last, self._spare) for node, _ in nodes.values())
        for node in (*self._nodes.values(), *older):
            node.remove()
        for kept in (
            self._nodes,
            self._last,
            self._spare,
            self.waiting,
            self._sent_at,
            self._pauses,
            self._sides,
            self._hidden,
            self._cut,
        ):
            kept.clear()

    def changed(self, keys: Iterable[CellKey]) -> None:
        for key in keys:
            self.waiting.setdefault(key)

    def clip(self, clipping: Clipping) -> None:
        """Hide tiles outside the clipping at once; tiles across its border are cut and sent later."""
        self.clipping = clipping
        for key, tile in list(self._tiles.tiles.items()):
            side, shown = clipping.side(tile.bounds), self._sides.get(key)
            node = self._nodes.get(key)
            if side == "hidden":
                if node is not None:
                    self._hide(key, node)
            elif key in self._hidden or side == "part" or side != shown:
                self._hidden.discard(key)
                self._cut.add(key)
                self.changed((key,))
            elif node is not None:
                node.visible = True

    def send(self, now: float) -> int:
        """Send changed tiles that have waited long enough, within the limit of bytes; return their number."""
        count = 0
        for key, (_, end) in list(self._last.items()):
            if now >= end:
                self._empty_last(key, now)
        for key, (node, end) in list(self._spare.items()):
            if now >= end:
                del self._spare[key]
                node.remove()
        for key in list(self.waiting):
            due = self._due(key)
            if due > now:
                continue
            if self._bucket.wait(1.0, now) > 0:
                break
            del self.waiting[key]
            size = self._send(key, now)
            self._cut.discard(key)
            if size:
                self._sent_at[key] = now
                self._pauses[key] = STEADY_PAUSE if now < due + _SOON else PAUSE
                self._bucket.spend(size)
                self.bytes_sent += size
                count += 1
        return count

    def _due(self, key: CellKey) -> float:
        pause = _CUT_PAUSE if key in self._cut else self._pauses.get(key, PAUSE)
        return self._sent_at.get(key, -np.inf) + pause

    def shown_mesh(self, key: CellKey, tile: Tile) -> Mesh:
        """Return the shown part of a tile, in the chosen colours."""
        mesh = Mesh(tile.mesh.vertices, tile.mesh.faces, tile.mesh.normals, self._colors.colors(key, tile))
        return mesh if self.clipping.side(tile.bounds) == "whole" else self.clipping.cut(mesh)

    def _send(self, key: CellKey, now: float) -> int:
        """Send a tile's present triangles to its node, or hide or remove it; return the bytes sent."""
        tile, node = self._tiles.tiles.get(key), self._nodes.get(key)
        if tile is None:
            if node is not None:
                self._hide(key, node)
                self._nodes.pop(key).remove()
            if key in self._spare:
                self._spare.pop(key)[0].remove()
            self._sides.pop(key, None)
            return 0
        side = self.clipping.side(tile.bounds)
        mesh = None if side == "hidden" else self.shown_mesh(key, tile)
        if mesh is None or not len(mesh.faces):
            self._hidden.add(key)
            if node is not None:
                self._hide(key, node)
            return 0
        self._sides[key] = side
        return self._put(key, mesh, now)

    def _hide(self, key: CellKey, node: "viser.GlbHandle") -> None:
        node.visible = False
        if key in self._last:
            self._last.pop(key)[0].remove()

    def _put(self, key: CellKey, mesh: Mesh, now: float) -> int:
        edge = self._tiles.edge * CELL * self.voxel_size
        corner = edge * (np.array(key, np.float64) - _MARGIN)
        assert mesh.colors is not None
        content = tile_glb.encode(mesh.vertices, mesh.faces, mesh.colors, corner, self.voxel_size)
        if key in self._last:
            self._empty_last(key, now)
        node = self._nodes.get(key)
        if node is not None:
            self._last[key] = (node, now + (_CUT_PAUSE if key in self._cut else PAUSE))
        if key in self._spare:
            other, _ = self._spare.pop(key)
        else:
            other = self._add(key, node)
        other.glb_data = content
        if not self._keeps:
            other._impl.props.glb_data = b""
        if not other.visible:
            other.visible = True
        self._nodes[key] = other
        return len(content)

    def _add(self, key: CellKey, node: "viser.GlbHandle | None") -> "viser.GlbHandle":
        """Add an empty second node for a tile: viser keeps a node's first content in memory for ever."""
        names = [f"{self._root}/" + "_".join(map(str, key)) + version for version in ("", "b")]
        if node is not None:
            names.remove(node.name)
        return self._scene.add_glb(names[0], tile_glb.EMPTY, cast_shadow=False, receive_shadow=False)

    def _empty_last(self, key: CellKey, now: float) -> None:
        """Empty the node of a tile's previous version, and keep the node for the next version."""
        node, _ = self._last.pop(key)
        node.glb_data = tile_glb.EMPTY
        self._spare[key] = (node, now + _SPARED)


class TileLook:
    """Colours of tiles, and the nodes of the scene that show them."""

    def __init__(self, tiles: MapTiles, colors: VertexColors, nodes: TileNodes) -> None:
        self._tiles, self.colors, self.nodes = tiles, colors, nodes

    def changed(self, keys: Iterable[CellKey]) -> None:
        """Send tiles with new triangles, or ask for their values first; a new tile is sent at once."""
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
        """Use an up direction, and fit the colour scale to the values of shown tiles."""
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
    """Tiles with one browser's own colours, which replace the shared tiles once all are sent."""

    def __init__(
        self, client: "viser.ClientHandle", tiles: MapTiles, colors: VertexColors, bucket: Bucket
    ) -> None:
        nodes = TileNodes(client.scene, tiles, colors, bucket, root="/own", keeps=False)
        super().__init__(tiles, colors, nodes)
        self._client = client
        self._missing = set(tiles.tiles)
        self._cover: viser.FrameHandle | None = None  # its node replaces the shared root and hides it

    def send(self, now: float) -> None:
        """Send changed tiles to the browser, unless too many messages to it are unread."""
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
