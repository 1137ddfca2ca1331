# SPDX-License-Identifier: MIT
"""Tiles come into the scene within a budget, each in its turn, the newest version of each."""

from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
from drawn_scenes import DrawnScene, decoded

from tsfusion.core.limits import Bucket
from tsfusion.geometry.mesh import Mesh
from tsfusion.viewer.map.clipping import Clipping
from tsfusion.viewer.map.map_tiles import CELL, EDGE, MapTiles
from tsfusion.viewer.map.tile_nodes import MOST_UNREAD, PAUSE, ROOT, STEADY_PAUSE, OwnLook, TileNodes
from tsfusion.viewer.map.vertex_colors import VertexColors
from tsfusion.wire.asking.followed_map import SurfaceUpdate

VOXEL = 0.02
LONG = EDGE * CELL * VOXEL  # metres along a tile's edge


def floor(count: int, *, at: float = 0.3, squares: int = 40, color: int = 128) -> SurfaceUpdate:
    """A level surface in `count` tiles in a row along x, in one cell each."""
    u, v = np.meshgrid(np.linspace(0.1, 0.9, squares), np.linspace(0.1, 0.9, squares), indexing="ij")
    one = np.stack((u, v, np.full(u.shape, at)), axis=-1).reshape(-1, 3) * LONG
    corner = np.arange(squares * squares).reshape(squares, squares)[:-1, :-1].ravel()
    faces = np.concatenate((
        np.stack((corner, corner + squares, corner + 1), axis=1),
        np.stack((corner + 1, corner + squares, corner + squares + 1), axis=1),
    ))  # fmt: skip
    vertices = np.concatenate([one + (i * LONG, 0, 0) for i in range(count)]).astype(np.float32)
    whole = np.concatenate([faces + i * len(one) for i in range(count)]).astype(np.int32)
    normals = np.tile(np.array((0, 0, 1), np.float32), (len(vertices), 1))
    mesh = Mesh(vertices, whole, normals, np.full(vertices.shape, color, np.uint8))
    cells = np.array([(i * EDGE, 0, 0) for i in range(count)], np.int32)
    return SurfaceUpdate(
        cells, (np.arange(count + 1) * len(faces)).astype(np.int32), mesh, np.ones(count, bool)
    )


class Page:
    """Tiles, their nodes and a clock."""

    def __init__(self, rate: float) -> None:
        self.scene: Any = DrawnScene()
        self.tiles = MapTiles()
        colors = VertexColors(self.tiles, lambda points: None, {})
        self.nodes = TileNodes(self.scene, self.tiles, colors, Bucket(rate, 0.0, burst=1.0))
        self.nodes.voxel_size = VOXEL
        self.now = 0.0

    def apply(self, update: SurfaceUpdate) -> None:
        self.nodes.changed(self.tiles.apply([update], self.now))

    def pass_time(self, seconds: float, step: float = 0.05) -> None:
        for _ in range(round(seconds / step)):
            self.now += step
            self.nodes.send(self.now)


def test_bytes_a_second_are_bounded_and_everyone_has_a_turn() -> None:
    page, rate = Page(200e3), 200e3
    page.apply(floor(20))
    page.pass_time(0.05)
    size = len(next(iter(page.scene.nodes.values())).glb_data)
    sent: Counter[str] = Counter()
    for _ in range(120):
        before = {name: node.glb_data for name, node in page.scene.nodes.items()}
        page.apply(floor(20, color=100 + len(sent) % 50))
        page.pass_time(0.05)
        sent.update(
            node.name.rstrip("b") for node in page.scene.models if before.get(node.name) != node.glb_data
        )
    assert page.scene.bytes_drawn == page.nodes.bytes_sent
    assert rate * page.now / 2 < page.nodes.bytes_sent <= rate * (page.now + 1) + size
    assert len(sent) == 20
    assert max(sent.values()) - min(sent.values()) <= 1, "who waits longest is next"


def test_of_many_versions_the_newest_is_sent_and_the_last_stays_until_it_is_read() -> None:
    page = Page(1e9)
    page.apply(floor(1, color=10))
    page.pass_time(0.05)
    for color in (50, 90, 130):
        page.apply(floor(1, color=color))
    page.pass_time(PAUSE - 0.1)
    assert len(page.scene.models) == 1, "a tile is not sent again at once"
    page.pass_time(0.1)
    assert len(page.scene.shown()) == len(page.scene.models) == 2
    page.pass_time(PAUSE)
    (node,) = page.scene.models
    assert page.scene.shown() == {node.name}
    assert np.abs(decoded(node.glb_data).colors - 130).max() < 1
    assert page.scene.bytes_drawn == 2 * len(node.glb_data)
    assert len(page.scene.nodes) == 2, "the other node is kept for the next version"
    page.pass_time(6.0)
    assert list(page.scene.nodes.values()) == [node], "but not for ever"


def test_versions_change_between_two_nodes() -> None:
    page = Page(1e9)
    made = Counter[str]()
    add = page.scene.add_glb
    page.scene.add_glb = lambda name, *args, **fields: (made.update([name]), add(name, *args, **fields))[1]
    for step in range(12):
        page.apply(floor(1, color=10 * step))
        page.pass_time(STEADY_PAUSE)
        newest = [node for node in page.scene.models if node.visible]
        assert any(np.abs(decoded(node.glb_data).colors - 10 * step).max() < 1 for node in newest)
    assert made == {"/map/0_0_0": 1, "/map/0_0_0b": 1}


def test_a_tile_that_changes_all_the_time_is_sent_half_as_often() -> None:
    page = Page(1e9)
    sizes = []
    for step in range(80):
        page.apply(floor(1, color=step))
        before = page.scene.bytes_drawn
        page.pass_time(0.1)
        sizes.append(page.scene.bytes_drawn - before)
    sent = np.flatnonzero(sizes)
    assert 4 <= len(sent) <= 6, "at once, after a pause, and then after twice as long"
    page.pass_time(2 * STEADY_PAUSE)
    before = page.scene.bytes_drawn
    page.apply(floor(1, color=200))
    page.pass_time(0.1)
    assert page.scene.bytes_drawn > before, "after a rest it is sent at once"


def test_what_a_plane_hides_is_not_sent_and_comes_back() -> None:
    page = Page(1e9)
    page.apply(floor(3))
    page.pass_time(0.1)
    assert len(page.scene.shown()) == 3
    page.nodes.clip(Clipping(np.array((1.0, 0, 0)), 1.5 * LONG))
    assert page.scene.shown() == {"/map/0_0_0", "/map/1_0_0"}, "hidden at once"
    drawn = page.scene.bytes_drawn
    page.pass_time(2.0)
    cut = decoded(page.scene.nodes["/map/1_0_0b"].glb_data)
    assert cut.vertices[:, 0].max() <= 1.5 * LONG + VOXEL / 256
    page.apply(floor(3, color=60))
    page.pass_time(2.0)
    assert not any(name.startswith("/map/2_0_0") for name in page.scene.shown())
    page.nodes.clip(Clipping())
    page.pass_time(4.0)
    assert page.scene.shown() == {node.name for node in page.scene.models}
    assert len(page.scene.models) == 3
    for node in page.scene.models:
        model = decoded(node.glb_data)
        assert len(model.faces) == 2 * 39 * 39
        assert np.abs(model.colors - 60).max() < 1
    assert page.scene.bytes_drawn > drawn


def test_tiles_that_are_gone_leave_the_scene() -> None:
    page = Page(1e9)
    page.apply(floor(2))
    page.pass_time(0.1)
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    page.apply(
        SurfaceUpdate(np.array([[0, 0, 0]], np.int32), np.zeros(2, np.int32), empty, np.zeros(1, bool))
    )
    page.pass_time(3.0)
    assert set(page.scene.nodes) == {"/map/1_0_0"}
    page.nodes.clear()
    assert not page.scene.nodes


def test_a_look_of_ones_own_hides_the_shared_one_when_all_of_it_is_there_for_who_reads() -> None:
    scene, tiles, unread = DrawnScene(), MapTiles(), dict.fromkeys(range(MOST_UNREAD + 1))
    buffer = SimpleNamespace(message_from_id=unread)
    client: Any = SimpleNamespace(
        scene=scene, _websock_connection=SimpleNamespace(get_message_buffer=lambda: buffer)
    )
    keys = tiles.apply([floor(4)], 0.0)
    look = OwnLook(client, tiles, VertexColors(tiles, lambda points: None, {}), Bucket(1e5, 0.0, burst=0.1))
    look.nodes.voxel_size = VOXEL
    look.changed(keys)
    look.send(0.05)
    assert not scene.nodes, "it has much to read before"
    unread.clear()
    now, counts = 0.05, []
    while ROOT not in scene.nodes:
        assert now < 60
        counts.append(len(scene.models))
        look.send(now := now + 0.05)
    assert len(scene.models) == 4
    assert {1, 2, 3} & set(counts), "the shared one is there until then"
    assert not scene.nodes[ROOT].visible
    look.close()
    assert not scene.nodes
