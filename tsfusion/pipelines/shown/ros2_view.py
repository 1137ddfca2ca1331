# SPDX-License-Identifier: MIT
"""Show a live map to ROS 2: poses, paths, surface, costmap and diagnostics as topics, and three services."""

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import TsfusionError
from tsfusion.datasets.ros2.middleware import TRIGGER, Middleware, message_types
from tsfusion.geometry.map_grids import DistanceSlice, OccupancySlice
from tsfusion.journal.ros2_messages import Converter, Outgoing
from tsfusion.viewer.map.map_tiles import CellKey
from tsfusion.viewer.map.scanner_tracks import ScannerTrack, ScannerTracks
from tsfusion.viewer.map_feed import MapFeed
from tsfusion.viewer.shown_feed import ShownFeed
from tsfusion.wire.asking import queries
from tsfusion.wire.asking.map_client import MapClient
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.health import headline

log = logging.getLogger(__name__)

FLAT, MAP = "map", "tsfusion"  # frames: slices, with up along +z (REP 105), and the map as it is
_TF, _TF_STATIC = "/tf", "/tf_static"
_MESH, _POINTS = "/tsfusion/mesh", "/tsfusion/points"
_GRID, _DISTANCE = "/tsfusion/map", "/tsfusion/distance"
_LATCHED = (_TF_STATIC, _GRID, _DISTANCE, "/path", "/pose")  # ends of topics
_KINDS = {
    _TF: "tf2_msgs/msg/TFMessage",
    _TF_STATIC: "tf2_msgs/msg/TFMessage",
    _MESH: "visualization_msgs/msg/Marker",
    _POINTS: "sensor_msgs/msg/PointCloud2",
    _GRID: "nav_msgs/msg/OccupancyGrid",
    _DISTANCE: "sensor_msgs/msg/Image",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
_SURFACE_S, _SLICE_S, _PLACES_S = 0.5, 1.0, 0.5  # seconds between two versions
_MOST_TILES = 40  # at once, so that other topics get their turn
_ANSWER_S, _MESH_S = 5.0, 60.0


class RosTopics:
    """Topics and services of this process, over every transport."""

    def __init__(self, middlewares: list[Middleware]) -> None:
        self._middlewares, self._store = middlewares, message_types()
        self._announced: set[str] = set()
        for topic, kind in _KINDS.items():
            self._announce(topic, kind)

    def _announce(self, topic: str, kind: str) -> None:
        self._announced.add(topic)
        for middleware in self._middlewares:
            middleware.announce(topic, kind, latched=topic.endswith(_LATCHED))

    def listeners(self, topic: str) -> int:
        """Return the number of those who hear an announced topic; Zenoh's count as one."""
        return sum(middleware.listeners(topic) for middleware in self._middlewares)

    def encode(self, message: Outgoing) -> bytes:
        return bytes(self._store.serialize_cdr(message.content, message.kind))

    def send(self, message: Outgoing, content: bytes | None = None) -> None:
        """Send a message, in the place of its own `content` another."""
        if message.topic not in self._announced:
            self._announce(message.topic, message.kind)
        raw = self.encode(message) if content is None else content
        for middleware in self._middlewares:
            middleware.publish(message.topic, raw)

    def serve(self, service: str, answer: Callable[[], str]) -> None:
        """Answer a service of std_srvs/srv/Trigger by a sentence; an error is one of no success."""

        def respond(_: bytes) -> bytes:
            try:
                success, words = True, answer()
            except (TsfusionError, OSError) as error:
                success, words = False, str(error)
            made = self._store.types[f"{TRIGGER}_Response"](success=success, message=words)
            return bytes(self._store.serialize_cdr(made, f"{TRIGGER}_Response"))

        for middleware in self._middlewares:
            middleware.serve(service, TRIGGER, respond)


class SliceHeights(NamedTuple):
    """Heights between which obstacles are told to a planner, metres along `up`."""

    low: float
    high: float
    up: str


class Ros2View(ShownFeed):
    """Topics and services that show a server's map, in metres.

    Args:
        topics: topics of this process, whose middlewares the caller closes.
        feed: feed of the map, which the caller closes.
        client: client of the same map, which the caller closes.
        heights: of the costmap; None = none is told.
        out: folder that the service `save_map` writes to.
        forget_s: seconds before the last keyframe that the service `forget` takes out.
        ask: further arguments of `wire.asking.queries`: control, keys.
    """

    def __init__(
        self,
        topics: RosTopics,
        feed: MapFeed,
        client: MapClient,
        *,
        heights: SliceHeights | None,
        out: Path,
        forget_s: float,
        ask: dict[str, Any],
    ) -> None:
        self._made = Converter(message_types().types, world=MAP)
        self._places = Ros2Marks(topics, self._made)
        super().__init__(feed, self._places)
        self._topics, self._client, self._heights = topics, client, heights
        self._out, self._forget_s, self._ask = out, forget_s, ask
        self._dirty: set[CellKey] = set()
        self._numbers: dict[CellKey, int] = {}  # of markers
        self._due: dict[str, float] = {}
        self._heard: dict[str, int] = {}
        self._slice: DistanceSlice | None = None
        self._refusal = ""
        self._place_map(np.eye(3))
        for name, answer in (("save_map", self._save), ("forget", self._forget), ("status", self._status)):
            topics.serve(f"/tsfusion/{name}", answer)

    @property
    def is_watched(self) -> bool:
        return True

    def tell_end(self, sentence: str) -> None:
        self._problem = sentence
        self._told()

    def _told(self) -> None:
        health, name = self._health, self.map_name or self._client.map
        found = None if health is None else health.maps.get(name)
        level, words, values = 3, self._problem or "not known yet", dict[str, object]()
        if health is not None and found is not None and not self._problem:
            told = headline(health, only=name)
            level, words = (1 if told.trouble else 0), told.trouble or told.doing
            values = {
                "keyframes fused": found.keyframes_fused, "waiting": found.waiting, "lost": told.lost,
                "delay p95 ms": found.delay_ms.p95,
            }  # fmt: skip
        self._topics.send(self._made.diagnostics(level, f"tsfusion: {name}", words, values, time.time_ns()))

    def _cleared(self, *, is_other: bool) -> None:
        self._dirty |= self._numbers.keys()

    def _changed(self, keys: set[CellKey]) -> None:
        self._dirty |= keys

    def _step(self, now: float) -> None:
        if self._marks.is_due(now):
            self._marks.draw(now)
        if self._is_due("places", now, _PLACES_S):
            self._places.place_again()
        if self._is_due("surface", now, _SURFACE_S):
            self._show_surface()
        if self._heights is not None and self._is_due("slice", now, _SLICE_S):
            self._show_slice(self._heights)

    def _is_due(self, what: str, now: float, pause: float) -> bool:
        if now < self._due.get(what, 0.0):
            return False
        self._due[what] = now + pause
        return True

    def _show_surface(self) -> None:
        """Send some tiles that have changed to those who listen; all of them to somebody new."""
        for topic in (_MESH, _POINTS):
            count = self._topics.listeners(topic)
            if count > self._heard.get(topic, 0):
                self._dirty |= self._tiles.tiles.keys()
            self._heard[topic] = count
        if not any(self._heard.values()):
            return
        for key in [*self._dirty][:_MOST_TILES]:
            self._dirty.discard(key)
            self._show_tile(key)

    def _show_tile(self, key: CellKey) -> None:
        number, now_ns, tile = self._numbers.setdefault(key, len(self._numbers)), time.time_ns(), None
        tile = self._tiles.tiles.get(key)
        marker = self._made.marker(number, _MESH, now_ns, remove=tile is None)
        content = self._topics.encode(marker)
        if tile is None:
            self._topics.send(marker, content)
            return
        self._topics.send(marker, self._made.with_triangles(content, tile.mesh))
        colors = None if tile.mesh.colors is None else tile.mesh.colors[:, ::-1]
        self._topics.send(self._made.cloud(tile.mesh.vertices, colors, _POINTS, now_ns))

    def _show_slice(self, heights: SliceHeights) -> None:
        """Ask for the obstacles between two heights, and send what has changed."""
        try:
            found = self._client.distance_slice(*heights[:2], up=heights.up, timeout=_ANSWER_S).result
        except TsfusionError as error:
            if str(error) != self._refusal:
                self._refusal = str(error)
                log.warning("no costmap: %s", error)
            return
        before, self._slice, self._refusal = self._slice, found, ""
        if before is None or not np.array_equal(before.grid.axes, found.grid.axes):
            self._place_map(found.grid.axes)
        if before is not None and _same(before, found):
            return
        now_ns = time.time_ns()
        self._topics.send(self._made.grid(found.cells, found.grid, _GRID, FLAT, now_ns))
        self._topics.send(self._made.distances(found.distance, _DISTANCE, FLAT, now_ns))

    def _place_map(self, axes: NDArray[np.float64]) -> None:
        """Tell tf how the map lies in the frame of its slices."""
        T_flat_map = np.eye(4)
        T_flat_map[:3, :3] = axes
        flat = Converter(message_types().types, world=FLAT)
        transform = next(flat.place(T_flat_map, MAP, time.time_ns()))
        self._topics.send(transform._replace(topic=_TF_STATIC))

    # --- services, in a thread of a middleware ---

    def _save(self) -> str:
        """Write the present mesh and costmap; return their names."""
        name = self.map_name or self._client.map
        mesh = queries.fetch_mesh(self._client.address, map_name=name, timeout=_MESH_S, **self._ask)
        self._out.mkdir(parents=True, exist_ok=True)
        files = [mesh.save(self._out / f"{name}.ply")]
        if self._slice is not None:
            costmap = OccupancySlice(self._slice.grid, self._slice.cells, knows_free_space=True)
            files += costmap.save(self._out / f"{name}.yaml")
        return ", ".join(str(file) for file in files)

    def _forget(self) -> str:
        """Take the last keyframes out of the map."""
        selection = Selection(since_ns=-round(self._forget_s * 1e9))
        name = self.map_name or self._client.map
        gone = queries.forget(self._client.address, selection, map_name=name, timeout=_MESH_S, **self._ask)
        return f"{gone.keyframes} keyframes of the last {self._forget_s:g} s are forgotten"

    def _status(self) -> str:
        name = self.map_name or self._client.map
        health = queries.fetch_health(self._client.address, map_name=name, timeout=_ANSWER_S, **self._ask)
        told = headline(health, only=name)
        return told.trouble or told.doing


class Ros2Marks(ScannerTracks):
    """Transforms, poses and paths of a map's scanners."""

    def __init__(self, topics: RosTopics, made: Converter) -> None:
        super().__init__()
        self._topics, self._made = topics, made

    def place_again(self) -> None:
        """Tell tf the newest pose of each scanner again, as of now."""
        for scanner in self._scanners.values():
            if scanner.pose is not None:
                self._topics.send(next(self._made.place(scanner.pose, scanner.frame, time.time_ns())))

    def _place(self, scanner: ScannerTrack) -> None:
        if scanner.pose is not None:
            transform, pose = self._made.place(scanner.pose, scanner.frame, time.time_ns())
            self._topics.send(transform)
            self._topics.send(pose._replace(topic=f"/tsfusion/{scanner.frame}/pose"))

    def _draw_paths(self, scanner: ScannerTrack) -> None:
        points = np.array([scanner.now[seq] for seq in sorted(scanner.now)]).reshape(-1, 3)
        topic = f"/tsfusion/{scanner.frame}/path"
        self._topics.send(self._made.path(points, topic, time.time_ns()))

    def _show_picture(self, scanner: ScannerTrack, jpeg: bytes) -> bool:
        return True

    def _line(
        self, scanner: ScannerTrack, kind: str, ends: NDArray[np.float32], color: NDArray[np.uint8]
    ) -> None:
        """Draw nothing: `_draw_paths` sends a whole path."""

    def _remove(self, scanner: ScannerTrack) -> None:
        scanner.now.clear()
        self._draw_paths(scanner)


def _same(one: DistanceSlice, other: DistanceSlice) -> bool:
    grids = one.grid.origin == other.grid.origin and one.grid.shape == other.grid.shape
    return grids and bool((one.cells == other.cells).all() and (one.distance == other.distance).all())
