# SPDX-License-Identifier: MIT
"""Show a map and its changes, which a feed reports as events, in Foxglove."""

import time
from functools import partial

import numpy as np
from foxglove import messages
from numpy.typing import NDArray

from tsfusion.viewer.foxglove import foxglove_messages
from tsfusion.viewer.foxglove.foxglove_messages import MAP, WORLD
from tsfusion.viewer.foxglove.foxglove_server import FoxgloveServer, FoxgloveTopic
from tsfusion.viewer.map.map_tiles import CellKey
from tsfusion.viewer.map.scanner_tracks import ScannerTrack, ScannerTracks
from tsfusion.viewer.map.vertex_colors import item_color
from tsfusion.viewer.map_feed import MapFeed
from tsfusion.viewer.shown_feed import ShownFeed
from tsfusion.wire.asking.followed_map import ScannerSeen

_PAUSE = 1.0  # least seconds between two versions of a tile
_SELDOM = 1.0  # seconds between two estimates of up
_MOST_CAMERAS = 32  # with topics of their own: those that sent pictures last
_FAREWELL = 0.5  # seconds that clients have to receive the last message
_MAP, _SCANNERS, _PATHS, _TF, _STATE = "/map", "/scanners", "/paths", "/tf", "/state"


class FoxgloveView(ShownFeed):
    """Topics that show a map from a feed, in metres and the map's frame.

    Args:
        server: server of the topics, which the caller closes.
        feed: feed of the map, which the caller closes.
    """

    def __init__(self, server: FoxgloveServer, feed: MapFeed) -> None:
        super().__init__(feed, FoxgloveMarks(server))
        self._server = server
        self._next_look = -np.inf
        scene = messages.SceneUpdate.get_schema()
        server.open(FoxgloveTopic(_MAP, scene, foxglove_messages.deleted, _PAUSE))
        server.open(FoxgloveTopic(_SCANNERS, scene, foxglove_messages.deleted))
        server.open(FoxgloveTopic(_PATHS, scene, foxglove_messages.deleted))
        server.open(FoxgloveTopic(_TF, messages.FrameTransforms.get_schema()))
        server.open(FoxgloveTopic(_STATE, foxglove_messages.STATE))
        self._tell_up()

    @property
    def is_watched(self) -> bool:
        return self._server.has_clients

    def tell_end(self, sentence: str) -> None:
        self._problem = sentence
        self._told()
        time.sleep(_FAREWELL if self.is_watched else 0.0)

    def _told(self) -> None:
        content = foxglove_messages.state(self._health, self.map_name, self._problem)
        self._server.put(_STATE, "", lambda: content)

    def _cleared(self, *, is_other: bool) -> None:
        self._server.clear(_MAP)

    def _changed(self, keys: set[CellKey]) -> None:
        for key in keys:
            name, tile = "_".join(map(str, key)), self._tiles.tiles.get(key)
            if tile is None:
                self._server.drop(_MAP, name)
            else:
                triangles = partial(foxglove_messages.triangles, name, tile.mesh, time.time_ns())
                self._server.put(_MAP, name, triangles)

    def _step(self, now: float) -> None:
        if now >= self._next_look:
            self._next_look = now + _SELDOM
            self._up.look(self._tiles)
            if self._up.up != self._told_up:
                self._tell_up()
        if self._marks.is_due(now):
            self._marks.draw(now)

    def _tell_up(self) -> None:
        """Turn the map in the frame `world` so that its up direction is +z."""
        T_world_map, self._told_up = np.eye(4), self._up.up
        if self._up.up is not None:
            T_world_map[:3, :3] = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ self._up.up.to_y()
        content = foxglove_messages.transform(WORLD, MAP, T_world_map, time.time_ns())
        self._server.put(_TF, MAP, lambda: content)


class FoxgloveMarks(ScannerTracks):
    """Frames, frustums, paths and pictures of a map's scanners, as topics."""

    def __init__(self, server: FoxgloveServer) -> None:
        super().__init__()
        self._server = server
        self._cameras: dict[bytes, str] = {}  # topics, the one with the oldest picture first

    def _place(self, scanner: ScannerTrack) -> None:
        if scanner.pose is None:
            self._drop(scanner)
            return
        frame, now_ns = scanner.frame, time.time_ns()
        content = foxglove_messages.transform(MAP, frame, scanner.pose, now_ns)
        self._server.put(_TF, frame, lambda: content)
        is_seen = scanner.newest is not None  # which says whether it has a camera, and its name
        if scanner.nodes.get("outline") is not is_seen:
            scanner.nodes["outline"], title = is_seen, self.name(scanner.session)
            color, ends = np.array(item_color(scanner.number)), _outline(scanner.newest, 10 * self.voxel_size)
            outline = partial(foxglove_messages.lines, frame, frame, ends, color, now_ns, title=title)
            self._server.put(_SCANNERS, frame, outline)

    def _show_picture(self, scanner: ScannerTrack, jpeg: bytes) -> bool:
        topic = self._cameras.pop(scanner.session, "")
        if not topic:
            topic = f"/{scanner.frame}/image"
            self._server.open(FoxgloveTopic(topic, messages.CompressedImage.get_schema()))
            if len(self._cameras) >= _MOST_CAMERAS:
                self._server.withdraw(self._cameras.pop(next(iter(self._cameras))))
        self._cameras[scanner.session] = topic
        picture = partial(foxglove_messages.picture, scanner.frame, jpeg, time.time_ns())
        self._server.put(topic, "", picture)
        return True

    def _line(
        self, scanner: ScannerTrack, kind: str, ends: NDArray[np.float32], color: NDArray[np.uint8]
    ) -> None:
        name = f"{scanner.frame} {kind}"
        if len(ends):
            lines = partial(foxglove_messages.lines, name, MAP, ends, color, time.time_ns())
            self._server.put(_PATHS, name, lines)
        else:
            self._server.drop(_PATHS, name)

    def _remove(self, scanner: ScannerTrack) -> None:
        self._drop(scanner)
        if scanner.session in self._cameras:
            self._server.withdraw(self._cameras.pop(scanner.session))
        for kind in ("paths", "first paths"):
            self._server.drop(_PATHS, f"{scanner.frame} {kind}")

    def _drop(self, scanner: ScannerTrack) -> None:
        scanner.nodes.clear()
        for topic in (_TF, _SCANNERS):
            self._server.drop(topic, scanner.frame)


def _outline(seen: ScannerSeen | None, size: float) -> NDArray[np.float32]:
    """Return (n, 2, 3) lines of a scanner in its frame: a camera's frustum, or three axes."""
    if seen is None or seen.intrinsics is None or seen.shape is None:
        axes = np.stack((np.zeros((3, 3)), size * np.eye(3)), axis=1)
        return axes.astype(np.float32)
    camera, (height, width) = seen.intrinsics, seen.shape
    pixels = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float64)
    slopes = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    corners = size * np.hstack((slopes, np.ones((4, 1))))
    edges = np.stack((corners, np.roll(corners, -1, axis=0)), axis=1)
    rays = np.stack((np.zeros((4, 3)), corners), axis=1)
    return np.concatenate((edges, rays)).astype(np.float32)
