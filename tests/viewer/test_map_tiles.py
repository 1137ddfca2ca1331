# SPDX-License-Identifier: MIT
"""Tiles hold, of each cell, what came last: together they are the mesh of the map."""

import numpy as np
import pytest
from formula_scenes import sphere_views
from growing_maps import SESSION, GrowingMap, surface_update

from tsfusion import Volume
from tsfusion.geometry.mesh import Mesh
from tsfusion.viewer.map import map_tiles
from tsfusion.viewer.map.map_tiles import MapTiles
from tsfusion.wire.asking.followed_map import SurfaceUpdate

RADIUS = 0.3


def triangles(mesh: Mesh) -> np.ndarray:
    """(m, 9) corners of the triangles, each beginning with its lowest corner, sorted."""
    corners = mesh.vertices[mesh.faces]
    first = np.array([np.lexsort(one.T[::-1])[0] for one in corners])
    turned = np.take_along_axis(corners, ((first[:, None] + np.arange(3)) % 3)[..., None], axis=1)
    return np.unique(turned.reshape(-1, 9), axis=0)


def grown(edge: int = 4, count: int = 6) -> tuple[MapTiles, GrowingMap]:
    """Tiles of a sphere that was seen from some sides, refined at the end."""
    feed = GrowingMap(Volume(voxel_size=0.02, threads=2), sphere_views(RADIUS)[:count])
    tiles = MapTiles(edge)
    while not feed.is_whole:
        for event in feed.grow():
            if isinstance(event, SurfaceUpdate):
                tiles.apply([event], float(len(feed.poses)))
    return tiles, feed


@pytest.fixture(scope="module")
def sphere() -> tuple[MapTiles, GrowingMap]:
    return grown()


def test_tiles_are_the_mesh_of_the_map(sphere: tuple[MapTiles, GrowingMap]) -> None:
    tiles, feed = sphere
    whole = map_tiles.whole([tile.mesh for tile in tiles.tiles.values()], None)
    expected = feed.volume.extract_mesh()
    assert len(whole.faces) == len(expected.faces) == tiles.triangles
    np.testing.assert_allclose(triangles(whole), triangles(expected), atol=3e-4)  # solved in other batches
    assert abs(len(whole.vertices) - len(expected.vertices)) < 0.01 * len(expected.vertices)
    assert len(tiles.tiles) > 4


def test_a_tile_has_no_vertex_too_many_and_knows_its_cells(sphere: tuple[MapTiles, GrowingMap]) -> None:
    tiles, _ = sphere
    assert tiles.clients == [SESSION]
    for key, tile in tiles.tiles.items():
        assert np.array_equal(np.unique(tile.mesh.faces), np.arange(len(tile.mesh.vertices)))
        cell = np.stack(np.unravel_index(tile.cell, (tiles.edge,) * 3), axis=1) + np.array(key) * tiles.edge
        middle = tile.mesh.vertices[tile.mesh.faces].mean(axis=1)
        assert np.array_equal(np.floor((middle / 0.02 - 0.5) / 8), cell)
        assert (tile.client[tile.cell_of_vertex] == 0).all()
        assert (tile.changed_s[tile.cell_of_vertex] > 0).all()
        assert (tile.bounds[0] <= tile.mesh.vertices).all()


@pytest.mark.parametrize("together", [2, 5, 100])
def test_updates_at_once_are_the_same_as_one_after_the_other(together: int) -> None:
    feed = GrowingMap(Volume(voxel_size=0.02, threads=2), sphere_views(RADIUS)[:4])
    updates = []
    while not feed.is_whole:
        updates += [event for event in feed.grow() if isinstance(event, SurfaceUpdate)]
    nobody = np.zeros((0, 3), np.int32)
    nothing = Mesh(np.zeros((0, 3), np.float32), nobody, np.zeros((0, 3), np.float32))
    updates.insert(1, SurfaceUpdate(nobody, np.zeros(1, np.int32), nothing, True))
    ours, expected = MapTiles(4), MapTiles(4)
    changed, each = set(), set()
    for i in range(0, len(updates), together):
        changed |= ours.apply(updates[i : i + together], 1.0)
    for update in updates:
        each |= expected.apply([update], 1.0)
    assert changed == each
    assert ours.clients == expected.clients
    assert ours.tiles.keys() == expected.tiles.keys()
    for key, tile in ours.tiles.items():
        other = expected.tiles[key]
        assert np.array_equal(triangles(tile.mesh), triangles(other.mesh))
        assert np.array_equal(np.unique(tile.mesh.faces), np.arange(len(tile.mesh.vertices)))
        assert np.array_equal(np.bincount(tile.cell, minlength=64), np.bincount(other.cell, minlength=64))
        assert np.array_equal(tile.client, other.client)
        assert np.array_equal(tile.changed_s, other.changed_s)


def test_cells_without_triangles_take_theirs_away() -> None:
    tiles, feed = grown(count=3)
    blocks = np.array([np.array(key) * tiles.edge + cell for key, tile in tiles.tiles.items()
                       for cell in np.argwhere(np.ones((tiles.edge,) * 3))], np.int32)  # fmt: skip
    gone = blocks[blocks[:, 0] >= 0]
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    before = tiles.triangles
    changed = tiles.apply([SurfaceUpdate(gone, np.zeros(len(gone) + 1, np.int32), nothing, False)], 9.0)
    assert changed
    assert 0 < tiles.triangles < before
    assert not any(key[0] >= 0 for key in tiles.tiles), "tiles without triangles are not kept"
    again = np.unique(blocks, axis=0)
    tiles.apply([surface_update(feed.volume, again, None)], 10.0)
    assert tiles.triangles == len(feed.volume.extract_mesh(blocks=again).faces)


def test_a_mesh_without_colours_becomes_grey() -> None:
    tiles, feed = MapTiles(), grown(count=2)[1]
    cells = feed.volume.cells_to_mesh(feed.volume.take_dirty())
    whole = surface_update(feed.volume, np.array([[0, 0, 0], [0, 0, 1]], np.int32), "raw")
    assert len(cells) >= 0
    plain = Mesh(whole.mesh.vertices, whole.mesh.faces, whole.mesh.normals)
    tiles.apply([SurfaceUpdate(whole.cells, whole.first_face, plain, False)], 0.0)
    assert not tiles.has_colors
    assert all((tile.mesh.colors == map_tiles.GREY).all() for tile in tiles.tiles.values())


def test_whole_of_nothing_has_no_triangles() -> None:
    assert not len(map_tiles.whole([], None).faces)
